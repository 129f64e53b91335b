"""Velocity of the target over the scene, and where it can be while it is not seen: a Kalman filter in image pixels.

Constant velocity driven by white acceleration, the more the faster the target is: what moves brakes or turns, what
stands sets off slowly. Errors of predictions over absences of 0.5 to 4 s: nadir cars at 4 lengths a second 0.8 lengths
after 0.5 s, boats and people at 0.3 lengths a second 0.7 lengths after 4 s.
"""

from __future__ import annotations

import numpy as np

from protocols.geometry.types import Floats

_SETS_OFF = 0.1  # power spectral density of the acceleration of what stands, in squared target lengths a second cubed
_TURNS = 0.1  # and what is added by its speed squared [1/s]: braking or turning, half of the velocity within 2.5 s
_NOISE, _NOISE_PX = 0.03, 0.3  # std of one measured place, in target lengths and pixels
_SCENE_DRIFT = 0.05  # std of the scene's chained motion after a second, in target lengths
_FIRST_SPEED = 1.5  # std of the velocity before anything was measured, in target lengths a second


class VelocityFilter:
    """Both axes alike. velocity: (2,) [px/s] over the scene."""

    def __init__(self, length: float) -> None:
        self.velocity: Floats = np.zeros(2)
        self._lag: Floats = np.zeros(2)  # of the filtered place from the last measured one
        self._covariance = np.diag([(_NOISE * length + _NOISE_PX) ** 2, (_FIRST_SPEED * length) ** 2])
        self._scene = 0.0  # variance of where the scene is

    @property
    def std(self) -> float:
        """Of the predicted place, one coordinate [px]."""
        return float(np.sqrt(self._covariance[0, 0] + self._scene))

    @property
    def velocity_std(self) -> float:
        """Of the velocity, one coordinate [px/s]."""
        return float(np.sqrt(self._covariance[1, 1]))

    def follow_scene(self, linear: Floats) -> None:
        """Turn and scale with the scene's motion (2, 2)."""
        self.velocity, self._lag = linear @ self.velocity, linear @ self._lag
        zoom = abs(float(np.linalg.det(linear)))
        self._covariance, self._scene = self._covariance * zoom, self._scene * zoom

    def lose_scene(self, std: float) -> None:
        """The motion of the scene is unknown in one frame: std of it, one coordinate [px]."""
        self._scene += std**2

    def turn(self, angle: float) -> None:
        """Turn the velocity by ``angle`` [rad]."""
        c, s = np.cos(angle), np.sin(angle)
        self.velocity = np.array([[c, -s], [s, c]]) @ self.velocity

    def predict(self, dt: float, length: float) -> Floats:
        """Step (2,) over the scene within ``dt`` [s], from the last measured place; length: of the target [px]."""
        step = self._lag + self.velocity * dt
        self._lag = np.zeros(2)
        move = np.array([[1.0, dt], [0.0, 1.0]])
        power = _SETS_OFF * length**2 + _TURNS * float(np.square(self.velocity).sum())
        noise = power * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        noise[0, 0] += (_SCENE_DRIFT * length) ** 2 * dt
        self._covariance = move @ self._covariance @ move.T + noise
        return np.asarray(step)

    def correct(self, offset: Floats, length: float, cut: float) -> None:
        """Measured at ``offset`` (2,) from the predicted place [px]; cut: share of the target beyond the border."""
        self._covariance[0, 0] += self._scene
        self._scene = 0.0
        variance = ((_NOISE + cut) * length + _NOISE_PX) ** 2
        gain = self._covariance[:, 0] / (self._covariance[0, 0] + variance)
        self.velocity = self.velocity + gain[1] * offset
        self._lag = (gain[0] - 1.0) * offset
        self._covariance = self._covariance - np.outer(gain, self._covariance[0])

    def restart(self, velocity: Floats, std: float, length: float) -> None:
        """The target was found again with this velocity (2,) and its std [px/s]."""
        self.velocity, self._lag, self._scene = velocity, np.zeros(2), 0.0
        self._covariance = np.diag([(_NOISE * length + _NOISE_PX) ** 2, std**2])
