"""Measurement model of the filter: predicted detections of targets in a camera, with Jacobians and noise.

Rows of a measurement: 0, 1 the representative point, 2, 3 the top of the head, 4, 5 the foot point, all in normalised
image coordinates; 6 the logarithm of the image size in normalised units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.tracking.detections import FrameDetections, TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, STATE_DIM, VELOCITY
from hub.tracking.filter.target_models import TARGET_MODELS, UPRIGHT
from protocols.geometry.types import Bools, Floats, Ints

MEASUREMENT_DIM = 7  # three points and a size
POINT, HEAD, FOOT, LOG_IMAGE_SIZE = slice(0, 2), slice(2, 4), slice(4, 6), 6
NOISE_ENTRIES = np.array([0, 0, 1, 1, 2, 3, 4, 5]), np.array([0, 1, 0, 1, 2, 3, 4, 5])
"""Rows and columns of a measured noise that are not zero: the point's covariance, and variances of head and foot."""
BLOCKS = (POINT, HEAD, FOOT, slice(LOG_IMAGE_SIZE, MEASUREMENT_DIM))
_LOG_SIZE_STD = 0.08
"""Of the measured log image size: silhouette sizes fluctuate."""
_MIN_DEPTH = 1e-3  # m: nearer points have no image
_STUDENT_T_DOF = 4.0
"""Degrees of freedom of the Student's t noise of heads and feet: truncated or merged silhouettes cause outliers."""

_ALONG = np.array([(model.point_offset, 0.5, -0.5) for model in TARGET_MODELS])
"""Of point, head and foot above the centre, in sizes."""
_POINTS_VARIANCE = np.array(
    [
        model.common_std**2 + np.kron(np.diag([model.point_std, model.head_std, model.foot_std]) ** 2, np.ones((2, 2)))
        for model in TARGET_MODELS
    ]
)
"""Of point, head and foot, by kind (k, 6, 6), in squared sizes. A box, or a leaning body, is displaced as a whole: the
three points have a part of their noise in common."""


@dataclass(frozen=True, slots=True, eq=False)
class PredictedMeasurement:
    """The predicted measurements of n targets in one camera.

    value: (n, 7), NaN in rows that do not apply (head and foot of targets that are not upright). jacobian: (n, 7, 7).
    model_noise: (n, 7, 7), from the spread of the points on the target and from the uncertainty of the capture time.
    depth: (n,), along the optical axis.
    """

    value: Floats
    jacobian: Floats
    model_noise: Floats
    depth: Floats

    def with_noise_factor(self, factor: Floats) -> PredictedMeasurement:
        """The same with the model's noise multiplied. factor: (n,)."""
        return replace(self, model_noise=self.model_noise * factor[:, None, None])

    def select(self, which: Ints) -> PredictedMeasurement:
        """The rows of some targets."""
        return PredictedMeasurement(*(getattr(self, name)[which] for name in self.__slots__))


def predict_measurement(camera: TrackingCamera, mean: Floats, kind: Ints, up: Floats | None) -> PredictedMeasurement:
    """Predict the measurements of targets with states ``mean`` (n, 7) and ``kind`` (n,) in ``camera``.

    up: (3,) unit vector in world coordinates, None = unknown: then no target is treated as upright.
    """
    n = len(mean)
    rotation = camera.pose.rotation
    size = np.exp(mean[:, LOG_SIZE])
    upright = UPRIGHT[kind] & (up is not None)
    axis = rotation @ up if up is not None else np.zeros(3)
    centre = (mean[:, POSITION] - camera.pose.position) @ rotation.T
    depth = centre[:, 2]
    # The three points of every target at once: (n, 3, ...) of point, head, foot.
    along = size[:, None] * _ALONG[kind]
    where = centre[:, None] + along[:, :, None] * axis
    good = where[:, :, 2] > _MIN_DEPTH * size[:, None]
    good[:, 1:] &= upright[:, None]
    safe = np.where(good, where[:, :, 2], 1.0)[:, :, None]
    seen = where[:, :, :2] / safe
    by_position = ((rotation[:2] - seen[..., None] * rotation[2]) / safe[..., None]).reshape(n, 6, 3)
    value, jacobian = np.full((n, MEASUREMENT_DIM), np.nan), np.zeros((n, MEASUREMENT_DIM, STATE_DIM))
    value[:, :LOG_IMAGE_SIZE] = np.where(good[:, :, None], seen, np.nan).reshape(n, 6)
    jacobian[:, :LOG_IMAGE_SIZE, POSITION] = by_position
    if up is not None:
        jacobian[:, :LOG_IMAGE_SIZE, LOG_SIZE] = (by_position @ up) * np.repeat(along, 2, axis=1)
    noise = np.zeros((n, MEASUREMENT_DIM, MEASUREMENT_DIM))
    spread = by_position * size[:, None, None]
    noise[:, :LOG_IMAGE_SIZE, :LOG_IMAGE_SIZE] = _POINTS_VARIANCE[kind] * (spread @ spread.swapaxes(1, 2))
    if camera.time_std:
        moving = (by_position @ mean[:, VELOCITY, None])[:, :, 0] * camera.time_std
        for rows in (POINT, HEAD, FOOT):
            noise[:, rows, rows] += moving[:, rows, None] * moving[:, None, rows]
    _predict_log_image_size(value, jacobian, mean, depth, upright, rotation)
    noise[:, LOG_IMAGE_SIZE, LOG_IMAGE_SIZE] = _LOG_SIZE_STD**2
    return PredictedMeasurement(value, jacobian, noise, depth)


def _predict_log_image_size(
    value: Floats, jacobian: Floats, mean: Floats, depth: Floats, upright: Bools, rotation: Floats
) -> None:
    """Row 6: log distance from head to foot of upright targets, else log of size over depth."""
    across = value[:, HEAD] - value[:, FOOT]
    length2 = (across**2).sum(axis=1)
    tall = upright & (length2 > 0.0)
    if not tall.all():
        ahead = depth > 0.0
        safe = np.where(ahead, depth, 1.0)
        value[:, LOG_IMAGE_SIZE] = np.where(ahead, mean[:, LOG_SIZE] - np.log(safe), np.nan)
        jacobian[:, LOG_IMAGE_SIZE, POSITION] = np.where(ahead, -1.0 / safe, 0.0)[:, None] * rotation[2]
        jacobian[:, LOG_IMAGE_SIZE, LOG_SIZE] = 1.0
    if tall.any():
        length2, across = length2[tall], across[tall]
        value[tall, LOG_IMAGE_SIZE] = 0.5 * np.log(length2)
        ends = jacobian[tall]
        by_difference = (across / length2[:, None])[:, None, :]
        jacobian[tall, LOG_IMAGE_SIZE] = (by_difference @ (ends[:, HEAD] - ends[:, FOOT]))[:, 0]


def student_t_inflation(squared: Floats) -> Floats:
    """Variance inflation factor of a head or foot point, from its squared Mahalanobis distance (...); 1 where NaN.

    The inverse of the Student's t weight in iteratively reweighted least squares, limited to weights of at most 1
    (Lange, Little and Taylor 1989).
    """
    return np.asarray(np.fmax((_STUDENT_T_DOF + squared) / (_STUDENT_T_DOF + 2.0), 1.0))


def student_t_cost(squared: Floats) -> Floats:
    """Robust cost of a squared Mahalanobis distance (...); its derivative is 1 / `student_t_inflation`."""
    beyond = 2.0 + (_STUDENT_T_DOF + 2.0) * np.log(student_t_inflation(squared))
    return np.where(squared > 2.0, beyond, squared)


def measurements_of(frame: FrameDetections, detection: Ints) -> tuple[Floats, Floats]:
    """Measurements (m, 7) of some detections (m,), NaN where missing, and their noise (m, 7, 7).

    The size row is omitted where head and foot are both measured, because it is computed from them.
    """
    m = len(detection)
    value = np.full((m, MEASUREMENT_DIM), np.nan)
    noise = np.zeros((m, MEASUREMENT_DIM, MEASUREMENT_DIM))
    value[:, POINT], value[:, HEAD], value[:, FOOT] = (
        frame.point[detection],
        frame.head[detection],
        frame.foot[detection],
    )
    complete = np.isfinite(value[:, 2:6]).all(axis=1)
    value[:, LOG_IMAGE_SIZE] = np.where(complete, np.nan, np.log(frame.size[detection]))
    noise[:, POINT, POINT] = frame.noise[detection]
    pixel2 = frame.units_per_px[detection] ** 2
    for row in range(2, 6):
        noise[:, row, row] = 2.0 * pixel2
    return value, noise


def noise_of(entries: Floats) -> Floats:
    """The noise (m, 7, 7) of measurements with these of its entries (m, 8)."""
    noise = np.zeros((len(entries), MEASUREMENT_DIM, MEASUREMENT_DIM))
    noise[:, *NOISE_ENTRIES] = entries
    return noise
