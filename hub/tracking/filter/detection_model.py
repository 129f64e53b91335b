"""Detection probability, clutter and noise of each camera's detector, learned from the tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.measurement import FOOT, HEAD, POINT, PredictedMeasurement
from hub.tracking.filter.target_models import KIND_INDEX
from hub.tracking.filter.target_states import DetectionStatistics
from protocols.geometry.types import Bools, Floats, Ints

CORRELATION_S = 0.5
"""Detections and misses of one target in one camera are alike for about this long: silhouettes merge and part, people
walk behind things. A frame counts as the fraction of it that has passed since the camera's last one."""
_GAIN = 0.03
"""Of the running estimates, for each target or frame: a time constant of a hundred."""
_PROBABILITY = (0.1, 0.98)  # limits of the estimate: neither certain nor impossible
_CLUTTER = (0.02, 50.0)  # limits, false detections a frame
_NOISE = (0.5, 16.0)  # limits, of the stated variance
_PERSON = KIND_INDEX["person"]
_OTHER_OBJECTS = 1e-3
"""Expected detections of markers and vehicles that are not tracked: others are rare, so that even a poor fit is the
target."""
_UNSEEN_PROBABILITY = 0.02
"""Of detecting a target outside the picture, by the uncertainty of its position."""


def visible_fraction(camera: TrackingCamera, predicted: PredictedMeasurement) -> Floats:
    """The fraction (n,) of each target that is inside the image: of three points between head and foot."""
    inside = camera.sees(predicted.value[:, POINT], predicted.depth).astype(np.float64)
    upright = np.isfinite(predicted.value[:, HEAD.start : FOOT.stop]).all(axis=1)
    if not upright.any():
        return inside
    ends = [camera.sees(predicted.value[:, rows], predicted.depth) for rows in (HEAD, FOOT)]
    return np.where(upright, (2.0 * inside + ends[0] + ends[1]) / 4.0, inside)


def detection_probability(statistics: DetectionStatistics, visible: Floats, occluded: Bools) -> Floats:
    """The probability (n,) of detecting each target. visible: (n,) from `visible_fraction`."""
    full = np.where(occluded, statistics.occluded, statistics.clear)
    return np.asarray(np.maximum(full * visible, _UNSEEN_PROBABILITY))


def false_detections(statistics: DetectionStatistics, kind: Ints) -> Floats:
    """Expected false detections (n,) that may be taken for targets of each kind."""
    return np.where(kind == _PERSON, statistics.clutter, np.minimum(statistics.clutter, _OTHER_OBJECTS))


def independent_fraction(interval_s: float) -> float:
    """How much of an independent observation a frame is, that long after the camera's last one."""
    return float(min(max(interval_s, 0.0) / CORRELATION_S, 1.0))


def with_frame_noise(
    predicted: PredictedMeasurement, touching: Bools, kind: Ints, statistics: DetectionStatistics
) -> PredictedMeasurement:
    """Predicted measurements with the noise of this camera's detector, of people apart and of touching ones."""
    factor = np.where(touching, statistics.touching_noise, statistics.noise)
    return predicted.with_noise_factor(np.where(kind == _PERSON, factor, 1.0))


def log_odds(probability: Floats) -> Floats:
    """ln(p / (1 - p)), limited where p is 0 or 1."""
    limited = np.clip(probability, 1e-9, 1.0 - 1e-9)
    return np.asarray(np.log(limited / (1.0 - limited)))


def posterior_existence(existence: Floats, probability: Floats, detected: Floats, fraction: float) -> Floats:
    """Existence probabilities (n,) after a frame.

    existence, probability: (n,) before it, and of detection. detected: (n,) marginal probability that the target
    generated one of the detections, given that it may not exist. fraction: from `independent_fraction`. Musicki and
    Evans, "Joint integrated probabilistic data association" (2004).
    """
    missed = existence * (1.0 - probability) / (1.0 - existence * probability)
    before, after = log_odds(existence), log_odds(detected + (1.0 - detected) * missed)
    return np.asarray(1.0 / (1.0 + np.exp(-(before + fraction * (after - before)))))


def updated_statistics(
    before: DetectionStatistics,
    certain: Bools,
    occluded: Bools,
    hit: Bools,
    clutter: float,
    nis_per_dof: Floats,
    touching: Bools,
) -> DetectionStatistics:
    """The statistics after a frame.

    certain: (n,) targets that exist and are in full view. hit: (n,) whether they were detected. clutter: expected
    number of false detections in the frame. nis_per_dof: (k,) normalised innovations squared of certain pairs, and
    touching: (k,) whether the target touches another in the image.
    """

    def gained(value: float, samples: Floats, limits: tuple[float, float], gain: float = _GAIN) -> float:
        if not len(samples):
            return value
        weight = 1.0 - (1.0 - gain) ** len(samples)
        return float(np.clip(value + weight * (float(samples.mean()) - value), *limits))

    clear, behind = certain & ~occluded, certain & occluded
    return replace(
        before,
        clear=gained(before.clear, hit[clear].astype(np.float64), _PROBABILITY),
        occluded=gained(before.occluded, hit[behind].astype(np.float64), _PROBABILITY),
        clutter=gained(before.clutter, np.array([clutter]), _CLUTTER, 3.0 * _GAIN),
        # Factors, not sums: the innovations already contain the present estimates.
        noise=gained(before.noise, before.noise * np.minimum(nis_per_dof[~touching], 4.0), _NOISE),
        touching_noise=gained(
            before.touching_noise, before.touching_noise * np.minimum(nis_per_dof[touching], 4.0), _NOISE
        ),
    )
