"""Detection-to-track assignment: likelihood ratios of position, size and colour, with occlusion tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from hub.tracking.detections import FrameDetections, TrackingCamera
from hub.tracking.filter import kalman
from hub.tracking.filter.kalman import LOG_SIZE
from hub.tracking.filter.measurement import (
    FOOT,
    HEAD,
    LOG_IMAGE_SIZE,
    POINT,
    PredictedMeasurement,
    student_t_inflation,
)
from hub.tracking.filter.target_models import CLUTTER_COLOUR_STD
from hub.tracking.filter.target_states import Targets
from protocols.geometry.types import Bools, Floats, Ints

POINT_GATE = 18.4
"""Gate of the representative point: false-rejection probability 1e-4 (chi2, 2 dof)."""
PART_GATE = 13.8
"""Gate of head and foot: false-rejection probability 1e-3; outside it, that point is not used."""
_SIZE_GATE = 9.0  # chi-squared, three stds
_LOG_OUTLIER = float(np.log(0.05))
"""Of a head or foot outside its gate, while the point is inside: occluded or merged silhouettes, one in twenty."""
_CLUTTER_RADIUS = 0.25
"""Head and foot of a false detection lie anywhere within a quarter of its size of where a target's would be."""
COLOUR_STD = 28.0
"""Largest std of one channel between cameras: light and white balance differ. Adapted by `update_colour_variance`."""
_MIN_COLOUR_STD, _COLOUR_STD_FACTOR = 14.0, 2.0
"""Smallest std, and the factor by which the estimated std is widened: a box also holds parts of other people."""
_CERTAIN, _COLOUR_VARIANCE_GAIN = 0.05, 0.002
"""Pairs with a larger mismatch probability do not adapt the colour variance; gain of one that does."""
_COLOUR_MAX = 24.0  # chi-squared of three channels: once in 40,000 by chance, a shadow or a wrong box
_LOG_CAMERA_MATCH = 1.0
"""Added where the camera's own tracker matched the detection to the target."""
_MIN_WEIGHT = 0.1
"""Fraction of the weight that a detection keeps when it fits another target equally well."""
_WIDTH, _LENGTH = 0.2, 0.6
"""Silhouettes touch within these fractions of the sum of two lengths, across and along the body."""


@dataclass(frozen=True, slots=True, eq=False)
class AssociationScores:
    """Of n targets and m detections. log_ratio: (n, m), logarithm of the likelihood of a pair over that of a false
    detection that is uniform in the image, -inf outside the gate.

    distance: (n, m, 3) squared Mahalanobis distances of point, head, foot, NaN where not measured or outside the gate.
    """

    log_ratio: Floats
    distance: Floats


def association_scores(
    frame: FrameDetections,
    value: Floats,
    noise: Floats,
    targets: Targets,
    predicted: PredictedMeasurement,
    names: tuple[str, ...],
    colour_std: float = COLOUR_STD,
    fixed: Ints | None = None,
) -> AssociationScores:
    """The scores of each target with each detection: of position, size and colour.

    value, noise: (m, 7), (m, 7, 7) measurements of the frame. names: labels of the targets. colour_std: of a channel.
    fixed: (n,) a detection whose distance is wanted whether it is inside the gate or not, -1 = none.
    """
    spread = predicted.jacobian @ targets.covariance @ predicted.jacobian.swapaxes(1, 2)
    own, other = _blocks(spread + predicted.model_noise), _blocks(noise)
    off = value[None, :, POINT] - predicted.value[:, None, POINT]
    distance = np.full((len(targets), len(frame), 3), np.nan)
    distance[:, :, 0] = _squared_distance(own[:, None, 0], other[:, 0], off)
    log_ratio = np.full(distance.shape[:2], -np.inf)
    near = (distance[:, :, 0] < POINT_GATE) & (targets.kind[:, None] == frame.kind[None, :])
    if fixed is not None:
        near[fixed >= 0, fixed[fixed >= 0]] = True
    row, column = np.nonzero(near)
    if not len(row):
        return AssociationScores(log_ratio, distance)
    off = (value[column, :LOG_IMAGE_SIZE] - predicted.value[row, :LOG_IMAGE_SIZE]).reshape(-1, 3, 2)
    distance[row, column] = _squared_distance(own[row], other[column], off)
    selected = predicted.select(row)
    used = gated_rows(value[column], selected, distance[row, column], targets.covariance[row])
    innovation = np.where(used, value[column] - selected.value, 0.0)
    total = spread[row] + matched_noise(noise[column], selected, distance[row, column])
    squared, log_determinant = kalman.fit(innovation, total, used)
    log_likelihood = -0.5 * (squared + log_determinant + np.log(2.0 * np.pi) * used.sum(axis=1))
    log_likelihood -= _log_clutter(frame, column, used, np.isfinite(value[column]))
    log_ratio[row, column] = np.where(distance[row, column, 0] < POINT_GATE, log_likelihood, -np.inf)
    if np.isfinite(frame.colour).any():
        log_ratio[row, column] += colour_score(frame.colour[column], targets.colour[row], colour_std)
    if any(frame.target):
        log_ratio += _LOG_CAMERA_MATCH * (np.array(names)[:, None] == np.array(frame.target)[None, :])
    return AssociationScores(log_ratio, distance)


def _squared_distance(own: Floats, other: Floats, off: Floats) -> Floats:
    """Squared Mahalanobis distances (...) at ``off`` (..., 2), of the sum of two covariances (..., 2, 2)."""
    a, b, c = (own[..., i, j] + other[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    x, y = off[..., 0], off[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))


def _blocks(matrix: Floats) -> Floats:
    """The blocks (n, 3, 2, 2) of point, head and foot of covariances (n, 7, 7)."""
    return np.stack([matrix[:, rows, rows] for rows in (POINT, HEAD, FOOT)], axis=1)


def colour_score(observed: Floats, stored: Floats, std: float) -> Floats:
    """Log likelihood ratios (k,) of colours (k, 3) of detections and targets against anything else's; 0 if unknown."""
    off2 = ((observed - stored) ** 2).sum(axis=1)
    score = 3.0 * np.log(CLUTTER_COLOUR_STD / std) - 0.5 * np.minimum(off2 / std**2, _COLOUR_MAX)
    return np.asarray(np.nan_to_num(score))


def matched_noise(
    noise: Floats, predicted: PredictedMeasurement, distance: Floats, sure: Floats | None = None
) -> Floats:
    """Measurement covariances (k, 7, 7) of k pairs: of detection and model, heads and feet with Student's t tails.

    sure: (k,) probability of each pair. A detection that is as probably another's has next to no weight: where two
    targets cross, the cameras that resolve them decide.
    """
    total = np.where(np.isfinite(noise), noise, 0.0) + predicted.model_noise
    for part, rows in ((1, HEAD), (2, FOOT)):
        total[:, rows, rows] *= student_t_inflation(distance[:, part])[:, None, None]
    if sure is not None:
        total /= np.maximum(2.0 * sure - 1.0, _MIN_WEIGHT)[:, None, None] ** 2
    return total


def _log_clutter(frame: FrameDetections, column: Ints, used: Bools, measured: Bools) -> Floats:
    """Log density (k,) of a false detection in the used rows, and what heads and feet outside their gates cost."""
    low, high = frame.camera.low, frame.camera.high
    density = np.full(len(column), -float(np.log(np.prod(high - low))))
    size = frame.size[column]
    with np.errstate(invalid="ignore", divide="ignore"):
        part = -np.log(np.pi * (_CLUTTER_RADIUS * size) ** 2)
    part = np.where(np.isfinite(part), part, 0.0)
    for rows in (HEAD, FOOT):
        there = used[:, rows].all(axis=1)
        density += np.where(there, part, np.where(measured[:, rows].all(axis=1), -_LOG_OUTLIER, 0.0))
    return density - np.where(used[:, LOG_IMAGE_SIZE], np.log(2.0), 0.0)


def combine_hypotheses(one: AssociationScores, other: AssociationScores, prior_odds: Floats) -> AssociationScores:
    """Scores under a mixture of two hypotheses of each target. prior_odds: (n,) of the second against the first."""
    with np.errstate(divide="ignore"):
        second = other.log_ratio + np.log(prior_odds)[:, None]
    better = second > one.log_ratio
    return AssociationScores(
        np.asarray(np.logaddexp(one.log_ratio, second)), np.where(better[:, :, None], other.distance, one.distance)
    )


def assign(log_ratio: Floats) -> tuple[Ints, Ints]:
    """Rows and columns of the most probable assignment (Hungarian algorithm).

    log_ratio: (n, m), of a pair against a missed target and a false detection; only pairs above 0 are assigned.
    """
    good = log_ratio > 0.0
    if not good.any():
        none = np.zeros(0, dtype=np.int64)
        return none, none
    rows, columns = linear_sum_assignment(np.where(good, -log_ratio, 0.0))
    kept = good[rows, columns]
    return rows[kept].astype(np.int64), columns[kept].astype(np.int64)


def update_colour_variance(before: float, observed: Floats, stored: Floats, mismatch_probability: Floats) -> float:
    """Running estimate of the variance of one colour channel between detections and their targets.

    observed, stored: (k, 3) colours, NaN where missing. mismatch_probability: (k,) that the detection belongs to
    something else.
    """
    off = np.minimum(((observed - stored) ** 2).mean(axis=1), COLOUR_STD**2)
    for one in off[(mismatch_probability < _CERTAIN) & np.isfinite(off)].tolist():
        before += _COLOUR_VARIANCE_GAIN * (one - before)
    return before


def matching_colour_std(variance: float) -> float:
    """The std of a colour channel used in the association cost."""
    return float(np.clip(_COLOUR_STD_FACTOR * np.sqrt(variance), _MIN_COLOUR_STD, COLOUR_STD))


def gated_rows(value: Floats, predicted: PredictedMeasurement, distance: Floats, covariance: Floats) -> Bools:
    """Mask (k, 7) of the valid rows of matched measurements: a head or foot outside its gate is wrong or occluded."""
    used = np.isfinite(value) & np.isfinite(predicted.value)
    for part, rows in ((1, HEAD), (2, FOOT)):
        used[:, rows] &= (distance[:, part] < PART_GATE)[:, None]
    if not used[:, LOG_IMAGE_SIZE].any():
        return used
    jacobian = predicted.jacobian[:, LOG_IMAGE_SIZE]
    spread = (
        np.einsum("ni,nij,nj->n", jacobian, covariance, jacobian)
        + predicted.model_noise[:, LOG_IMAGE_SIZE, LOG_IMAGE_SIZE]
    )
    with np.errstate(invalid="ignore"):
        used[:, LOG_IMAGE_SIZE] &= (
            value[:, LOG_IMAGE_SIZE] - predicted.value[:, LOG_IMAGE_SIZE]
        ) ** 2 < _SIZE_GATE * spread
    return used


def occlusions(camera: TrackingCamera, predicted: PredictedMeasurement, targets: Targets) -> tuple[Bools, Bools]:
    """Occlusion state of targets in one image: (touching, occluded), (n,) each.

    touching: the silhouette touches that of another confirmed target, so the two may be detected as one. occluded:
    that other target is in front.
    """
    seen = np.flatnonzero(camera.sees(predicted.value[:, POINT], predicted.depth))
    point, depth = predicted.value[seen, POINT], predicted.depth[seen]
    along = predicted.value[seen, HEAD] - predicted.value[seen, FOOT]
    norm = np.linalg.norm(along, axis=1)
    upright = np.isfinite(norm) & (norm > 0.0)
    along = np.where(upright[:, None], along / np.where(upright, norm, 1.0)[:, None], [0.0, 1.0])
    length = np.where(upright, norm, np.exp(targets.mean[seen, LOG_SIZE]) / depth)
    x, y = (point[:, axis] - point[:, None, axis] for axis in (0, 1))
    lengthwise = np.abs(x * along[:, None, 0] + y * along[:, None, 1])
    across = np.abs(x * along[:, None, 1] - y * along[:, None, 0])
    total = length[:, None] + length
    width = np.where(upright, _WIDTH, _LENGTH)
    touching = (across < width[:, None] * total) & (lengthwise < _LENGTH * total) & targets.confirmed[seen]
    np.fill_diagonal(touching, False)
    out = np.zeros((2, len(targets)), dtype=np.bool_)
    out[:, seen] = touching.any(axis=1), (touching & (depth[:, None] > depth)).any(axis=1)
    return out[0], out[1]
