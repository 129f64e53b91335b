"""A simulated aircraft with a camera: on a given path, or flying by itself; the camera on the airframe or a gimbal.

Kinematics of a careful multirotor: accelerations and turn rates are bounded, and it leans as it accelerates. What the
sensors say is the truth with a little noise; what the camera sees is the truth.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edge.mavlink.roles.autopilot import Flying
from edge.uav.world.flight import Flight
from protocols.geometry import so3
from protocols.geometry.types import Floats

GIMBAL_FROM_CAMERA: Floats = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""A camera that looks along its gimbal's x axis, level when the gimbal is."""
_STEP_S = 0.01
_KEPT_S = 3.0
_GRAVITY = 9.81
_ACCELERATION = 4.0  # a lean of 22 degrees
_JERK = 8.0
_SPEED = 18.0
_CLOSING_GAIN, _CLOSING_BRAKE = 0.4, 1.2  # 1/s, m/s2: how quickly it nears the target, and slows down in time
_HOLD_GAIN = 2.0  # 1/s, of the speed
_EYE_RAD = np.array([0.31, 0.41])  # up and across a 4:3 picture: as far from its middle as the target may come
_BLIND_RAD = np.array([0.42, 0.53])  # farther, it is out of the picture, and leaning more costs nothing
_LEAST_PULL = 1.5
_STALE_S = 3.0  # after which an aircraft that follows stays where it is
_GIMBAL_RATE = np.deg2rad(70.0)
_GIMBAL_GAIN = 5.0  # 1/s
_TREMBLE = np.deg2rad(0.05)


@dataclass(frozen=True, slots=True)
class Push:
    """A disturbance. begin, seconds [s]; velocity: north, east [m/s] by which a gust carries the aircraft.

    turn: pitch, yaw [rad/s] by which the gimbal is turned away; meanwhile it does not obey.
    """

    begin: float
    seconds: float
    velocity: tuple[float, float] = (0.0, 0.0)
    turn: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """ned_from_body, ned_from_gimbal (3, 3); position, velocity (3,) NED at a time [s]."""

    time: float
    ned_from_body: Floats
    ned_from_gimbal: Floats
    position: Floats
    velocity: Floats


class SimulatedAircraft:
    """One aircraft. Time only goes forward, in steps of 10 ms; what it did lately can still be asked for.

    path: flown exactly; None: hovers at ``start`` (3,) NED until it is told to follow, then keeps the target where a
    level camera's axis meets the ground. pilot: place and velocity (2,) at a time [s] that is followed before that, as
    by a pilot's eye. camera: body_from_camera of a fixed camera, whose tilt is flown out; None: straight down.
    gimbal: pitch, yaw [rad] of a stabilised gimbal at first; None: the camera is fixed. pushes: disturbances.
    noise_rad, noise_m: of what the sensors say, a sample. seed: of all noise.
    """

    def __init__(
        self,
        path: Flight | None = None,
        *,
        start: Floats | None = None,
        yaw: float = 0.0,
        pilot: Callable[[float], tuple[Floats, Floats]] | None = None,
        camera: Floats | None = None,
        gimbal: tuple[float, float] | None = None,
        pushes: tuple[Push, ...] = (),
        noise_rad: float = 0.001,
        noise_m: float = 0.05,
        seed: int = 0,
    ) -> None:
        self._path = path
        self._rng = np.random.default_rng([seed, 77])
        self._noise_rad, self._noise_m = noise_rad, noise_m
        self._pushes = pushes
        self._time = -2.0
        self._position = np.array([0.0, 0.0, -60.0]) if start is None else np.asarray(start, np.float64).copy()
        self._velocity, self._acceleration, self._carried = np.zeros(3), np.zeros(3), np.zeros(3)
        self._yaw = yaw
        self._pilot = pilot
        axis = np.array([0.0, 0.0, 1.0]) if camera is None else np.asarray(camera, np.float64)[:, 2]
        ahead = axis[:2] / max(float(axis[2]), 0.3)
        c, s = np.cos(yaw), np.sin(yaw)
        self._looks_ahead = np.array([c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]])  # per metre of height
        if pilot is not None and start is not None:
            place, along = pilot(0.0)
            self._velocity[:2] = along
            self._position[:2] = place + self._position[2] * self._looks_ahead + self._time * along
        self._altitude = float(self._position[2])
        self._has_gimbal = gimbal is not None
        self._gimbal = np.array((0.0, 0.0) if gimbal is None else gimbal, np.float64)
        self._wanted = self._gimbal.copy()
        self._target: tuple[float, Floats, Floats] | None = None
        self._tremble = np.zeros(3)
        # The autopilot and the camera ask from threads of their own.
        self._lock = threading.RLock()
        self._past: deque[Pose] = deque(maxlen=round(_KEPT_S / _STEP_S))
        self._past.append(self._pose())

    def flying(self, time: float) -> Flying:
        """What the sensors say at ``time`` [s]."""
        pose = self.pose(time)
        earlier = self.pose(time - 0.02)
        rates = so3.log(earlier.ned_from_body.T @ pose.ned_from_body) / 0.02
        error, other = self._noise_rad * self._rng.standard_normal((2, 3))
        return Flying(
            pose.ned_from_body @ so3.exp(error),
            pose.position + self._noise_m * self._rng.standard_normal(3),
            pose.velocity,
            rates,
            pose.ned_from_gimbal @ so3.exp(other) if self._has_gimbal else None,
        )

    def point(self, time: float, pitch: float, yaw: float, earth: bool) -> None:
        """Turn the gimbal."""
        with self._lock:
            self._wanted = np.array([np.clip(pitch, -0.5 * np.pi, 0.5), yaw if earth else yaw + self._yaw])

    def chase(self, time: float, position: Floats, velocity: Floats) -> None:
        """Follow a target."""
        with self._lock:
            self._target = (time, np.asarray(position, np.float64), np.asarray(velocity, np.float64))

    def pose(self, time: float) -> Pose:
        """The truth at ``time`` [s], not more than 3 s ago."""
        with self._lock:
            while self._time < time - 1e-9:
                self._advance()
            newest = self._past[-1]
            back = (newest.time - time) / _STEP_S
            index = max(len(self._past) - 1 - int(np.ceil(max(back, 0.0) - 1e-6)), 0)
            first, second = self._past[index], self._past[min(index + 1, len(self._past) - 1)]
        share = float(np.clip((time - first.time) / _STEP_S, 0.0, 1.0)) if second is not first else 0.0
        gimbal = _between(first.ned_from_gimbal, second.ned_from_gimbal, share)
        if self._path is not None:
            turned, places = self._path.at(np.array([time, time - _STEP_S]))
            return Pose(time, turned[0], gimbal, places[0], (places[0] - places[1]) / _STEP_S)
        return Pose(
            time,
            _between(first.ned_from_body, second.ned_from_body, share),
            gimbal,
            first.position + share * (second.position - first.position),
            first.velocity + share * (second.velocity - first.velocity),
        )

    def camera_from_ned(self, time: float, body_from_camera: Floats) -> tuple[Floats, Floats]:
        """(3, 3), and the camera's centre (3,) NED; body_from_camera: of a fixed camera, a gimbal has its own."""
        pose = self.pose(time)
        if self._has_gimbal:
            return np.asarray((pose.ned_from_gimbal @ GIMBAL_FROM_CAMERA).T), pose.position
        return np.asarray((pose.ned_from_body @ body_from_camera).T), pose.position

    def _advance(self) -> None:
        self._time += _STEP_S
        push = next((p for p in self._pushes if p.begin <= self._time < p.begin + p.seconds), None)
        if self._path is None:
            self._fly(push)
        self._turn_gimbal(push)
        self._past.append(self._pose())

    def _fly(self, push: Push | None) -> None:
        gust = np.zeros(3) if push is None else np.array([*push.velocity, 0.0])
        told = self._followed()
        wanted = np.zeros(3)
        aside: Floats | None = None
        if told is not None:
            place, velocity = told
            height = max(-float(self._position[2]), 1.0)
            gap = place - height * self._looks_ahead - self._position[:2]
            far = float(np.hypot(*gap))
            closing = min(_CLOSING_GAIN * far, float(np.sqrt(2.0 * _CLOSING_BRAKE * far)))
            wanted[:2] = velocity + closing * gap / max(far, 1e-9)
            aside = gap / height
        speed = float(np.linalg.norm(wanted[:2]))
        if speed > _SPEED:
            wanted *= _SPEED / speed
        wanted[2] = 0.5 * (self._altitude - self._position[2])
        pull = _limited(_HOLD_GAIN * (wanted - self._velocity), _ACCELERATION)
        if aside is not None and not self._has_gimbal:
            c, s = np.cos(self._yaw), np.sin(self._yaw)
            level = np.array([[c, -s], [s, c]])
            pull[:2] = level @ _kept_in_sight(level.T @ pull[:2], level.T @ aside)
        self._acceleration = self._acceleration + _limited(pull - self._acceleration, _JERK * _STEP_S)
        self._velocity = self._velocity + self._acceleration * _STEP_S
        self._carried = gust  # the air moves, and the aircraft with it; its speed is held through the air
        self._position = self._position + (self._velocity + gust) * _STEP_S

    def _followed(self) -> tuple[Floats, Floats] | None:
        """Place and velocity (2,) of what is followed now."""
        if self._target is None:
            return None if self._pilot is None else self._pilot(self._time)
        told, place, velocity = self._target
        if self._time - told >= _STALE_S:
            return None
        return np.asarray(place[:2] + (self._time - told) * velocity[:2]), np.asarray(velocity[:2])

    def _turn_gimbal(self, push: Push | None) -> None:
        if push is not None and any(push.turn):
            self._gimbal = self._gimbal + np.array(push.turn) * _STEP_S
        else:
            gap = self._wanted - self._gimbal
            gap[1] = (gap[1] + np.pi) % (2.0 * np.pi) - np.pi
            self._gimbal = self._gimbal + np.clip(_GIMBAL_GAIN * gap, -_GIMBAL_RATE, _GIMBAL_RATE) * _STEP_S
        self._gimbal[0] = np.clip(self._gimbal[0], -0.5 * np.pi, 0.5)
        keep = np.exp(-_STEP_S / 0.2)
        self._tremble = keep * self._tremble + np.sqrt(1.0 - keep**2) * _TREMBLE * self._rng.standard_normal(3)

    def _pose(self) -> Pose:
        x, y, z = np.eye(3)
        c, s = np.cos(self._yaw), np.sin(self._yaw)
        forward = c * self._acceleration[0] + s * self._acceleration[1]
        right = -s * self._acceleration[0] + c * self._acceleration[1]
        pitch, roll = -np.arctan2(forward, _GRAVITY), np.arctan2(right, _GRAVITY)
        turned = so3.exp(self._yaw * z) @ so3.exp(pitch * y) @ so3.exp(roll * x) @ so3.exp(2.0 * self._tremble)
        gimbal = so3.exp(self._gimbal[1] * z) @ so3.exp(self._gimbal[0] * y) @ so3.exp(self._tremble)
        return Pose(self._time, turned, gimbal, self._position.copy(), self._velocity + self._carried)


def _between(first: Floats, second: Floats, share: float) -> Floats:
    return np.asarray(so3.exp(share * so3.log(second @ first.T)) @ first)


def _kept_in_sight(pull: Floats, aside: Floats) -> Floats:
    """An acceleration (2,) forward, right by which a fixed camera does not lose a target ``aside`` (2,) [rad] of it.

    The aircraft leans to where it accelerates, and the camera looks the other way.
    """
    if (np.abs(aside) > _BLIND_RAD).any():
        return pull
    most = np.maximum(_GRAVITY * (_EYE_RAD - aside), _LEAST_PULL)
    least = np.minimum(_GRAVITY * (-_EYE_RAD - aside), -_LEAST_PULL)
    return np.asarray(np.clip(pull, least, most))


def _limited(vector: Floats, most: float) -> Floats:
    size = float(np.linalg.norm(vector))
    return vector if size <= most else vector * (most / size)
