"""Recent detections of the target on the ground, and the robust motion fit to them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from edge.uav.ground.image_plane import apply_homography
from protocols.geometry import kernels
from protocols.geometry.types import Floats

_WINDOW_S = 0.9  # of detections: a longer one averages more, but drivers change their acceleration within a second
_BUFFER = 40  # detections: the window at 44 fps
_RECENCY_S = 0.3  # a detection that is this much older has 1/e of the weight
_INDEPENDENT_SHARE = 0.4  # of a detection's std is independent from frame to frame; the rest is common to all
_ACCELERATION_STD = 3.5  # of a car, along each axis [units/s²]
_RELATIVE_ACCELERATION_STD = 0.3  # the same over the speed, where that is more [1/s]
_VELOCITY_PRIOR_STD = 15.0  # along each axis [units/s]: 54 km/h where a unit is a metre
_REFERENCE_AGE_S = 0.2  # age of the earlier fit against which outliers are judged
_MIN_REFERENCE_SAMPLES = 8  # detections for a fit to serve as that reference


@dataclass(frozen=True, slots=True, eq=False)
class MotionFit:
    """The target's motion at the last detection.

    position, velocity, acceleration: (2,) ground units and seconds. velocity_std, acceleration_std: of one
    coordinate. residual: of the detections, one coordinate. samples: their number.
    """

    time: float
    position: Floats
    velocity: Floats
    acceleration: Floats
    velocity_std: float
    acceleration_std: float
    residual: float
    samples: int

    @property
    def speed(self) -> float:
        return float(np.hypot(*self.velocity))

    @property
    def heading(self) -> float:
        return float(np.arctan2(self.velocity[1], self.velocity[0]))

    @property
    def longitudinal_acceleration(self) -> float:
        """Acceleration along the heading."""
        return float(self.acceleration @ self.velocity) / max(self.speed, 1e-6)

    @property
    def turn_rate(self) -> float:
        """d heading / dt [rad/s]; 0 at very low speed."""
        if self.speed < 1.0:
            return 0.0
        v, a = self.velocity, self.acceleration
        return float(v[0] * a[1] - v[1] * a[0]) / self.speed**2


class MotionHistory:
    """Measured positions of the target on the ground during the last second."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_BUFFER)
        self._positions: deque[Floats] = deque(maxlen=_BUFFER)
        self._stds: deque[float] = deque(maxlen=_BUFFER)
        self._prior: tuple[Floats, float] | None = None
        self._prior_time: float | None = None  # time of the prior
        self._fits: deque[MotionFit] = deque()

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time: float, position: Floats, std: float) -> None:
        """Add one detection: (2,) ground position, std of one coordinate."""
        if not self._times:
            self._prior_time = time
        self._times.append(time)
        self._positions.append(np.asarray(position, dtype=np.float64))
        self._stds.append(std)

    def restart(self, velocity: Floats, std: float) -> None:
        """Restart after a gap, with a prior for the velocity (2,) at that time."""
        self._times.clear()
        self._positions.clear()
        self._stds.clear()
        self._fits.clear()
        self._prior = (np.asarray(velocity, dtype=np.float64), std)

    def transform(self, new_from_old: Floats) -> None:
        """Transform to another ground frame."""
        if self._positions:
            positions = apply_homography(new_from_old, np.array(self._positions))
            self._positions = deque(list(positions), maxlen=_BUFFER)
        self._prior = None
        self._fits.clear()

    def distance_travelled(self) -> float:
        """Distance between the first and the last detection held."""
        return float(np.linalg.norm(self._positions[-1] - self._positions[0])) if len(self._positions) > 1 else 0.0

    def fit(self) -> MotionFit | None:
        """Least squares of position, velocity and a small acceleration over the last second; None with < 3 detections.

        Detections that deviate from a recent fit by more than a car can brake or steer are down-weighted: they are of
        the part of the target that an occluder leaves visible.
        """
        if len(self._times) < 3:
            return None
        times = np.array(self._times)
        recent = times >= times[-1] - _WINDOW_S
        t = times[recent] - times[-1]
        if len(t) < 3 or t[-1] - t[0] < 0.05:
            return None
        positions = np.array(self._positions)[recent]
        stds = np.array(self._stds)[recent]
        # For time-lapse video or units other than metres, acceleration scales with speed.
        mean_speed = float(np.hypot(*(positions[-1] - positions[0]))) / float(t[-1] - t[0])
        acceleration_std = max(_ACCELERATION_STD, _RELATIVE_ACCELERATION_STD * mean_speed)
        mean, spread = np.zeros(2), _VELOCITY_PRIOR_STD
        if self._prior is not None and self._prior_time is not None:
            # The prior is of the time of re-acquisition: its std grows by the acceleration since then.
            mean, spread = (
                self._prior[0],
                float(np.hypot(self._prior[1], acceleration_std * (times[-1] - self._prior_time))),
            )
            if spread > _VELOCITY_PRIOR_STD:
                mean, spread = np.zeros(2), _VELOCITY_PRIOR_STD
        information = np.array([1e-8, 1.0 / spread**2, 1.0 / acceleration_std**2])
        prior_right = np.zeros((3, 2))
        prior_right[1] = mean / spread**2
        # Recent detections get more weight: drivers brake and steer within a second.
        stds = np.maximum(stds * _INDEPENDENT_SHARE, 1e-3) * np.exp(-0.5 * t / _RECENCY_S)
        weight = 1.0 / np.square(stds)
        while self._fits and self._fits[0].time < times[-1] - _REFERENCE_AGE_S:
            self._fits.popleft()
        if self._fits and self._fits[0].samples >= _MIN_REFERENCE_SAMPLES:
            reference = self._fits[0]
            ahead = (times[recent] - reference.time)[:, None]
            expected = reference.position + ahead * (reference.velocity + 0.5 * ahead * reference.acceleration)
            error = np.linalg.norm(expected - positions, axis=1)
            weight = _robust_weights(stds, error)
        solution, normal, error = _robust_fit(t, positions, stds, weight, (information, prior_right))
        residual = float(np.sqrt(0.5 * np.mean(np.square(error))))
        inflate = max(1.0, float(np.sqrt(0.5 * np.mean(np.square(error / stds)))))
        covariance = np.linalg.inv(normal) * inflate**2
        position, velocity, acceleration = solution
        of_velocity, of_acceleration = (float(np.sqrt(covariance[k, k])) for k in (1, 2))
        time, count = float(times[-1]), len(t)
        found = MotionFit(time, position, velocity, acceleration, of_velocity, of_acceleration, residual, count)
        self._fits.append(found)
        return found


def _robust_fit(
    t: Floats, positions: Floats, stds: Floats, weight: Floats, prior: tuple[Floats, Floats]
) -> tuple[Floats, Floats, Floats]:
    """Position, velocity and acceleration (3, 2) in three steps, their normal matrix (3, 3) and the errors (n,).

    prior: information (3,) and right-hand side (3, 2).
    """
    if kernels.AVAILABLE:
        out = np.empty((3, 2)), np.empty((3, 3)), np.empty(len(t))
        kernels.call("fit_motion", len(t), t, positions, stds, *prior, weight, *out)
        return out
    design = np.column_stack([np.ones_like(t), t, 0.5 * t * t])
    for _ in range(3):
        normal = (design * weight[:, None]).T @ design + np.diag(prior[0])
        right = (design * weight[:, None]).T @ positions + prior[1]
        solution: Floats = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        error: Floats = np.asarray(np.linalg.norm(design @ solution - positions, axis=1))
        weight = _robust_weights(stds, error)
    return solution, normal, error


def _robust_weights(stds: Floats, error: Floats) -> Floats:
    """Cauchy weights (n,) of detections from their stds and their distance to a motion (n,), both ground units."""
    return np.asarray(1.0 / np.square(stds) / (1.0 + np.square(error / (3.0 * stds))))
