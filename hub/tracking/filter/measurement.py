"""What a camera should see of targets, with its derivatives: the measurement model of the filter.

Rows of a measurement: 0, 1 the representative point, 2, 3 the head's top, 4, 5 the foot point, all in normalised
coordinates; 6 the logarithm of the size seen, normalised.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.tracking.camera_frame import Frame, TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, SIZE, VELOCITY
from hub.tracking.filter.target_models import BODIES, PERSON
from protocols.geometry.types import Bools, Floats, Ints

ROWS = 7
POINT, HEAD, FOOT, SEEN_SIZE = slice(0, 2), slice(2, 4), slice(4, 6), 6
PARTS = (POINT, HEAD, FOOT, slice(SEEN_SIZE, ROWS))
_SIZE_STD = 0.08
"""Of the logarithm of a size seen: sizes of silhouettes breathe."""
_LEAST_DEPTH = 1e-3
_HEAVY = 4.0
"""Degrees of freedom of Student's t that heads and feet keep: a silhouette that is cut or joined errs far."""

_UPRIGHT = np.array([body.upright for body in BODIES])
_ABOVE = np.array([body.point_above for body in BODIES])
_POINT_NOISE = np.array([body.point_noise for body in BODIES])
_HEAD_NOISE = np.array([body.head_noise for body in BODIES])
_FOOT_NOISE = np.array([body.foot_noise for body in BODIES])


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What one camera should see of n targets.

    value: (n, 7), NaN in rows that a target has not (head and foot of what does not stand upright). slope: (n, 7, 7).
    body_noise: (n, 7, 7), of where on the body the points lie and of when the camera fired. depth: (n,), along the
    axis. part_std: (n, 3) stds of point, head and foot on the body, in shares of the size; part_noise: (n, 3, 2, 2)
    what a std of 1 would give.
    """

    value: Floats
    slope: Floats
    body_noise: Floats
    depth: Floats
    part_std: Floats
    part_noise: Floats

    def blurred(self, extra: Floats) -> Expected:
        """The same where others stand in the way: (n,) shares of the size that are added to the points' stds."""
        noise = self.body_noise.copy()
        more = ((self.part_std + extra[:, None]) ** 2 - self.part_std**2)[:, :, None, None] * self.part_noise
        for part, rows in enumerate((POINT, HEAD, FOOT)):
            noise[:, rows, rows] += more[:, part]
        noise[:, SEEN_SIZE, SEEN_SIZE] = (_SIZE_STD + extra) ** 2
        return replace(self, body_noise=noise)

    def kept(self, which: Ints) -> Expected:
        """Only of some targets."""
        return Expected(*(getattr(self, name)[which] for name in self.__slots__))


def expect(camera: TrackingCamera, mean: Floats, kind: Ints, up: Floats | None) -> Expected:
    """What ``camera`` should see of targets (n, 7) of ``kind`` (n,) at this moment.

    up: (3,) unit vector of the world, None = not known: then nothing is known to stand upright.
    """
    n = len(mean)
    rotation = camera.pose.rotation
    size = np.exp(mean[:, LOG_SIZE])
    upright = _UPRIGHT[kind] & (up is not None)
    axis = rotation @ up if up is not None else np.zeros(3)
    centre = (mean[:, POSITION] - camera.pose.position) @ rotation.T
    depth = centre[:, 2]
    velocity = mean[:, VELOCITY] @ rotation.T
    # The three points of every target at once: (n, 3, ...) of point, head, foot.
    along = size[:, None] * np.stack([np.where(upright, _ABOVE[kind], 0.0), np.full(n, 0.5), np.full(n, -0.5)], axis=1)
    where = centre[:, None] + along[:, :, None] * axis
    good = (where[:, :, 2] > _LEAST_DEPTH * size[:, None]) & np.isfinite(where[:, :, 2])
    good[:, 1:] &= upright[:, None]
    safe = np.where(good, where[:, :, 2], 1.0)
    seen = where[:, :, :2] / safe[:, :, None]
    by_camera = np.zeros((n, 3, 2, 3))  # derivative by the place in camera axes
    by_camera[:, :, 0, 0] = by_camera[:, :, 1, 1] = 1.0 / safe
    by_camera[:, :, :, 2] = -seen / safe[:, :, None]
    value, slope, noise = np.full((n, ROWS), np.nan), np.zeros((n, ROWS, SIZE)), np.zeros((n, ROWS, ROWS))
    value[:, :SEEN_SIZE] = np.where(good[:, :, None], seen, np.nan).reshape(n, 6)
    slope[:, :SEEN_SIZE, POSITION] = (by_camera @ rotation).reshape(n, 6, 3)
    slope[:, :SEEN_SIZE, LOG_SIZE] = ((by_camera @ axis) * along[:, :, None]).reshape(n, 6)
    std = np.stack([_POINT_NOISE[kind], _HEAD_NOISE[kind], _FOOT_NOISE[kind]], axis=1)
    unit = (size**2)[:, None, None, None] * (by_camera @ by_camera.swapaxes(2, 3))
    moving = (by_camera @ velocity[:, None, :, None])[..., 0] * camera.time_std
    both = (std**2)[:, :, None, None] * unit + moving[:, :, :, None] * moving[:, :, None, :]
    for part, rows in enumerate((POINT, HEAD, FOOT)):
        noise[:, rows, rows] = both[:, part]
    _expect_size(value, slope, mean, depth, upright, rotation)
    noise[:, SEEN_SIZE, SEEN_SIZE] = _SIZE_STD**2
    return Expected(value, slope, noise, depth, std, unit)


def _expect_size(value: Floats, slope: Floats, mean: Floats, depth: Floats, upright: Bools, rotation: Floats) -> None:
    """Row 6: head to foot of what stands upright, else the size over the depth."""
    safe = np.where(depth > 0.0, depth, np.nan)
    value[:, SEEN_SIZE] = mean[:, LOG_SIZE] - np.log(safe)
    slope[:, SEEN_SIZE, POSITION] = -np.nan_to_num(1.0 / safe)[:, None] * rotation[2]
    slope[:, SEEN_SIZE, LOG_SIZE] = 1.0
    across = value[:, HEAD] - value[:, FOOT]
    length2 = (across**2).sum(axis=1)
    tall = upright & (length2 > 0.0)
    if tall.any():
        by_difference = (across / np.where(tall, length2, 1.0)[:, None])[:, None, :]
        chained = (by_difference @ (slope[:, HEAD] - slope[:, FOOT]))[:, 0]
        value[:, SEEN_SIZE] = np.where(tall, 0.5 * np.log(np.where(tall, length2, 1.0)), value[:, SEEN_SIZE])
        slope[:, SEEN_SIZE] = np.where(tall[:, None], chained, slope[:, SEEN_SIZE])


def doubt(squared: Floats) -> Floats:
    """How many times larger the variance of a head or foot is, by its squared Mahalanobis distance (...), NaN = 1.

    The weight of Student's t in iterated least squares, never above 1 (Lange, Little and Taylor 1989).
    """
    return np.maximum(np.nan_to_num((_HEAVY + squared) / (_HEAVY + 2.0), nan=1.0), 1.0)


def heavy(squared: Floats) -> Floats:
    """The misfit that ``doubt`` minimises, where a Gaussian's is the squared Mahalanobis distance (...) itself."""
    beyond = 2.0 + (_HEAVY + 2.0) * np.log(doubt(squared))
    return np.where(squared > 2.0, beyond, squared)


def measured(frame: Frame, detection: Ints) -> tuple[Floats, Floats]:
    """Measurements (m, 7) of some detections (m,), NaN where not told, and their noise (m, 7, 7).

    The size row is left out where head and foot are told: it is made of them.
    """
    m = len(detection)
    value = np.full((m, ROWS), np.nan)
    noise = np.zeros((m, ROWS, ROWS))
    value[:, POINT], value[:, HEAD], value[:, FOOT] = (
        frame.point[detection],
        frame.head[detection],
        frame.foot[detection],
    )
    whole = np.isfinite(value[:, 2:6]).all(axis=1)
    value[:, SEEN_SIZE] = np.where(whole, np.nan, np.log(frame.size[detection]))
    noise[:, POINT, POINT] = frame.noise[detection]
    pixel2 = frame.per[detection] ** 2
    for row in range(2, 6):
        noise[:, row, row] = 2.0 * pixel2
    return value, noise


def length_of(kind: str, metre: float) -> float:
    """The size a target of a kind is expected to have [world units]."""
    return metre * next((body.size_m for body in BODIES if body.kind == kind), PERSON.size_m)
