"""Detection-to-track assignment: global nearest neighbour on Mahalanobis distance and colour, with occlusion tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from hub.tracking.detections import FrameDetections, TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE
from hub.tracking.filter.measurement import FOOT, HEAD, LOG_IMAGE_SIZE, POINT, PredictedMeasurement
from hub.tracking.filter.target_models import TARGET_MODELS
from hub.tracking.filter.target_states import Targets
from protocols.geometry.types import Bools, Floats, Ints

POINT_GATE = 18.4
"""Gate of the representative point: false-rejection probability 1e-4 (chi2, 2 dof)."""
PART_GATE = 13.8
"""Gate of head and foot: false-rejection probability 1e-3; outside it, that point is not used."""
_SIZE_GATE = 9.0
_UNASSIGNED_COST = 45.0
"""Cost of leaving a detection unassigned: that of a fit at the gate for a target predicted to about 10 px."""
_PART_WEIGHT, _PART_MAX = 0.5, 12.0
COLOUR_STD = 28.0
"""Largest std of one channel between cameras: light and white balance differ. Adapted by `update_colour_variance`."""
_MIN_COLOUR_STD, _COLOUR_STD_FACTOR = 14.0, 2.0
"""Smallest std, and the factor by which the estimated std is widened: a box also holds parts of other people."""
_CERTAIN, _COLOUR_VARIANCE_GAIN = 0.05, 0.002
"""Pairs with a larger mismatch probability do not adapt the colour variance; gain of one that does."""
_COLOUR_MAX = 12.0
_CAMERA_MATCH_BONUS = 2.0
"""Cost reduction where the camera's own tracker matched the detection to the target."""
_CLUTTER_COST = 30.0
"""Cost at which a person's detection may equally be clutter: somebody who is not tracked yet."""
_TEMPERATURE = 4.0
"""Cost difference that makes a pair e times less likely. It would be 2 for independent frames, but their errors are
correlated in time."""
_WIDTH = 0.2
_LENGTH = 0.6
"""Silhouettes touch within these fractions of the sum of two lengths, across and along the body."""
_UPRIGHT = np.array([model.upright for model in TARGET_MODELS])


@dataclass(frozen=True, slots=True, eq=False)
class AssociationCosts:
    """Association costs of n targets and m detections. total: (n, m), inf outside the gate.

    distance: (n, m, 3) squared Mahalanobis distances of point, head, foot, NaN where not measured.
    """

    total: Floats
    distance: Floats


def association_costs(
    frame: FrameDetections,
    value: Floats,
    noise: Floats,
    targets: Targets,
    predicted: PredictedMeasurement,
    names: tuple[str, ...],
    colour_std: float = COLOUR_STD,
) -> AssociationCosts:
    """The cost of assigning each detection to each target: -2 log likelihood with capped head, foot and colour terms.

    value, noise: (m, 7), (m, 7, 7) measurements of the frame. names: labels of the targets. colour_std: of a channel.
    """
    n, m = len(targets), len(frame)
    distance = np.full((n, m, 3), np.nan)
    spread = np.zeros((n, m))
    for part, rows in enumerate((POINT, HEAD, FOOT)):
        jacobian = predicted.jacobian[:, rows]
        own_cost = jacobian @ targets.covariance @ jacobian.transpose(0, 2, 1) + predicted.model_noise[:, rows, rows]
        both = own_cost[:, None] + noise[None, :, rows, rows]
        a, b, c = both[..., 0, 0], both[..., 0, 1], both[..., 1, 1]
        determinant = a * c - b * b
        off = value[None, :, rows] - predicted.value[:, None, rows]
        x, y = off[..., 0], off[..., 1]
        with np.errstate(invalid="ignore", divide="ignore"):
            distance[:, :, part] = (c * x * x - 2.0 * b * x * y + a * y * y) / determinant
            if rows is POINT:
                spread = np.log(determinant / frame.units_per_px[None, :] ** 4)
    parts = np.minimum(np.nan_to_num(distance[:, :, 1:], nan=_PART_MAX / 3.0), _PART_MAX).sum(axis=2)
    with np.errstate(invalid="ignore"):
        colour_distance = ((frame.colour[None] - targets.colour[:, None]) ** 2).sum(axis=2) / colour_std**2
    colour_distance = np.minimum(np.nan_to_num(colour_distance, nan=_COLOUR_MAX / 4.0), _COLOUR_MAX)
    total = distance[:, :, 0] + spread + _PART_WEIGHT * parts + colour_distance
    if any(frame.target):
        total = total - _CAMERA_MATCH_BONUS * (np.array(names)[:, None] == np.array(frame.target)[None, :])
    gated = (
        (distance[:, :, 0] < POINT_GATE) & (targets.kind[:, None] == frame.kind[None, :]) & (total < _UNASSIGNED_COST)
    )
    return AssociationCosts(np.where(gated, total, np.inf), distance)


def combine_hypotheses(one: AssociationCosts, other: AssociationCosts, prior_odds: Floats) -> AssociationCosts:
    """Costs under a mixture of two hypotheses of each target. prior_odds: (n,) of the second against the first."""
    with np.errstate(divide="ignore"):
        less = 2.0 * np.log(prior_odds)[:, None]
    better = other.total - less < one.total
    total = -2.0 * np.logaddexp(-0.5 * one.total, 0.5 * (less - other.total))
    return AssociationCosts(np.asarray(total), np.where(better[:, :, None], other.distance, one.distance))


def assign(total: Floats) -> tuple[Ints, Ints]:
    """Rows and columns of the optimal assignment (Hungarian algorithm) within the gate. total: (n, m) costs."""
    if not np.isfinite(total).any():
        none = np.zeros(0, dtype=np.int64)
        return none, none
    rows, columns = linear_sum_assignment(np.where(np.isfinite(total), total, _UNASSIGNED_COST))
    gated = np.isfinite(total[rows, columns])
    return rows[gated].astype(np.int64), columns[gated].astype(np.int64)


def clutter_cost(kind: Ints) -> Floats:
    """The cost (k,) of explaining a detection as clutter, that is as an object that is not tracked.

    kind: (k,) of the targets. There may be many similar people; another marker is rare.
    """
    return np.where(_UPRIGHT[kind], _CLUTTER_COST, np.inf)


def misassociation_probability(total: Floats, row: Ints, column: Ints, clutter: Floats) -> Floats:
    """The probability (k,) that the detection of a matched pair belongs to something else: 0 to 1/2.

    The alternatives are that two matched targets exchange their detections, that an unassigned target takes it, or
    that it is clutter. total: (n, m) costs, inf = impossible. clutter: (k,) from `clutter_cost`.
    """
    if not len(row):
        return np.zeros(0)
    own_cost = total[row, column]
    crossed = total[np.ix_(row, column)]
    np.fill_diagonal(crossed, np.inf)
    margin = (crossed + crossed.T - own_cost[:, None] - own_cost[None, :]).min(axis=1)
    unassigned = np.setdiff1d(np.arange(len(total)), row)
    if len(unassigned):
        margin = np.minimum(margin, total[np.ix_(unassigned, column)].min(axis=0) - own_cost)
    margin = np.minimum(margin, clutter - own_cost)
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(margin / _TEMPERATURE, 0.0, 60.0))))


def update_colour_variance(before: float, observed: Floats, stored: Floats, mismatch_probability: Floats) -> float:
    """Running estimate of the variance of one colour channel between detections and their targets.

    observed, stored: (k, 3) colours, NaN where missing. mismatch_probability: (k,) from `misassociation_probability`.
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
    n = len(targets)
    point = predicted.value[:, POINT]
    length = np.exp(targets.mean[:, LOG_SIZE]) / np.where(predicted.depth > 0.0, predicted.depth, np.inf)
    along = predicted.value[:, HEAD] - predicted.value[:, FOOT]
    norm = np.linalg.norm(along, axis=1)
    upright = np.isfinite(norm) & (norm > 0.0)
    along = np.where(upright[:, None], along / np.where(upright, norm, 1.0)[:, None], [0.0, 1.0])
    length = np.where(upright, norm, length)
    off = point[None] - point[:, None]
    with np.errstate(invalid="ignore"):
        lengthwise = np.abs((off * along[:, None]).sum(axis=2))
        across = np.abs(off[..., 0] * along[:, None, 1] - off[..., 1] * along[:, None, 0])
        total = length[:, None] + length[None, :]
        width = np.where(upright, _WIDTH, _LENGTH)
        touching = (across < width[:, None] * total) & (lengthwise < _LENGTH * total)
    seen = camera.sees(point, predicted.depth)
    touching &= targets.confirmed[None, :] & seen[None, :] & seen[:, None]
    touching[np.arange(n), np.arange(n)] = False
    further = predicted.depth[:, None] > predicted.depth[None, :]
    return touching.any(axis=1), (touching & further).any(axis=1)
