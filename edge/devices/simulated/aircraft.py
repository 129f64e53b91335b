"""A simulated aircraft with a camera, on a given path or in closed loop; the camera is fixed or on a gimbal.

Kinematic multirotor model: accelerations, jerk and turn rates are bounded, and it tilts as it accelerates. Sensor
readings are the true state plus noise; images are rendered from the true state.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.playback_clock import PlaybackClock, wait_until
from edge.mavlink.roles.autopilot import SensorReadings
from edge.uav.world.flight import Flight
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.types import Floats, Image

if TYPE_CHECKING:
    from edge.uav.world.flight_world import FlightWorld

_TRANSFER_S = 0.004  # from mid-exposure to the host
GIMBAL_FROM_CAMERA: Floats = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation of a camera whose optical axis is the gimbal's x axis; its image is level when the gimbal is."""
_STEP_S = 0.01  # of the integration
_HISTORY_S = 3.0  # of states, for sensors and images that are asked for late
_GRAVITY = 9.81  # m/s²
_MAX_ACCELERATION = 4.0  # m/s2: a tilt of 22 degrees
_MAX_JERK = 8.0  # m/s³, of a multirotor that carries a camera
_MAX_SPEED = 18.0  # m/s, the same
_CLOSING_GAIN, _CLOSING_BRAKE = 0.4, 1.2  # 1/s, m/s2: approach gain, and deceleration when closing in
_HOLD_GAIN = 2.0  # 1/s, velocity gain
# Vertical, horizontal in a 4:3 image: greatest allowed angle of the target from the centre.
_TARGET_LIMIT_RAD = np.array([0.31, 0.41])
_OUT_OF_VIEW_RAD = np.array([0.42, 0.53])  # beyond these angles the target is out of view and the tilt is not limited
_MIN_ACCELERATION_LIMIT = 1.5  # m/s²
_STALE_S = 3.0  # age of the last target message after which the aircraft hovers
_GIMBAL_RATE = np.deg2rad(70.0)
_GIMBAL_GAIN = 5.0  # 1/s
_VIBRATION_STD_RAD = np.deg2rad(0.05)


class FlightCamera:
    """Delivers a frame when it is due on the playback clock; overdue frames are skipped and counted in ``late``.

    world: the rendered world. aircraft: gives the camera pose. playback_clock: the true time. clock_offset_s: the
    camera's clock minus the true time [s].
    """

    def __init__(
        self,
        world: FlightWorld,
        aircraft: SimulatedAircraft,
        playback_clock: PlaybackClock,
        *,
        clock_offset_s: float = 0.0,
    ) -> None:
        self._world, self._aircraft, self._playback_clock = world, aircraft, playback_clock
        self._clock_offset_s = clock_offset_s
        self._last = world.length
        self._next = 0
        self._open = False
        self.late = 0

    @property
    def info(self) -> DeviceInfo:
        """Description, valid before opening too."""
        width, height = self._world.size
        return DeviceInfo(width, height, self._world.fps, "simulated", "monotonic", self._world.lens)

    @property
    def ended(self) -> bool:
        return self._next >= self._last

    def open(self) -> None:
        """Start; frames that are overdue from now on are skipped."""
        self._open = True

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None if it is not due within ``timeout_s``."""
        if not self._open or self.ended:
            return None
        due = max(0, int(np.ceil((self._playback_clock.now() - _TRANSFER_S) * self._world.fps - 1.0)))
        if due > self._next:
            self.late += due - self._next
            self._next = due
            if self.ended:
                return None
        index = self._next
        if not wait_until(self._playback_clock, self._world.time(index) + _TRANSFER_S, timeout_s):
            return None
        self._next = index + 1
        return Frame(self.render_frame(index), self.device_time_ns(index), index)

    def device_time_ns(self, index: int) -> int:
        """Time stamp [ns] of a frame on the camera's clock."""
        return round((self._world.time(index) + self._clock_offset_s) * NANOSECONDS)

    def render_frame(self, index: int) -> Image:
        """Render frame ``index`` from the aircraft's pose at its time."""
        rotation, centre = self._aircraft.camera_from_ned(self._world.time(index), self._world.body_from_camera)
        return self._world.render_from(index, rotation, centre)

    def close(self) -> None:
        self._open = False


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A disturbance. begin, seconds [s]: start and duration; velocity: north, east [m/s] of a gust.

    turn: pitch, yaw [rad/s] by which the gimbal is turned away; commands have no effect meanwhile.
    """

    begin: float
    seconds: float
    velocity: tuple[float, float] = (0.0, 0.0)
    turn: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class AircraftPose:
    """True state at a time [s]. ned_from_body, ned_from_gimbal: (3, 3); position, velocity: (3,) NED [m, m/s]."""

    time: float
    ned_from_body: Floats
    ned_from_gimbal: Floats
    position: Floats
    velocity: Floats


class SimulatedAircraft:
    """Simulates one aircraft in steps of 10 ms; states of the last 3 s can be queried.

    path: flown exactly; None: hovers at ``start`` (3,) NED until it gets a target, then keeps the target where a level
    camera's axis meets the ground. pilot: gives the position and velocity (2,) at a time [s] to follow until then, like
    a pilot flying by sight. camera: body_from_camera of a fixed camera; its tilt is compensated by the position; None:
    looks straight down. gimbal: initial pitch, yaw [rad] of a stabilised gimbal; None: the camera is fixed.
    disturbances: gusts and gimbal turns. noise_rad, noise_m: std of the sensor noise per sample. seed: of all noise.
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
        disturbances: tuple[Disturbance, ...] = (),
        noise_rad: float = 0.001,
        noise_m: float = 0.05,
        seed: int = 0,
    ) -> None:
        self._path = path
        self._rng = np.random.default_rng([seed, 77])
        self._noise_rad, self._noise_m = noise_rad, noise_m
        self._disturbances = disturbances
        self._time = -2.0
        self._position = np.array([0.0, 0.0, -60.0]) if start is None else np.asarray(start, np.float64).copy()
        self._velocity, self._acceleration, self._wind = np.zeros(3), np.zeros(3), np.zeros(3)
        self._yaw = yaw
        self._pilot = pilot
        axis = np.array([0.0, 0.0, 1.0]) if camera is None else np.asarray(camera, np.float64)[:, 2]
        ahead = axis[:2] / max(float(axis[2]), 0.3)
        c, s = np.cos(yaw), np.sin(yaw)
        self._axis_offset = np.array(
            [c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]]
        )  # m per metre of height
        if pilot is not None and start is not None:
            position, along = pilot(0.0)
            self._velocity[:2] = along
            self._position[:2] = position + self._position[2] * self._axis_offset + self._time * along
        self._altitude = float(self._position[2])
        self._has_gimbal = gimbal is not None
        self._gimbal = np.array((0.0, 0.0) if gimbal is None else gimbal, np.float64)
        self._commanded = self._gimbal.copy()
        self._target: tuple[float, Floats, Floats] | None = None
        self._vibration = np.zeros(3)
        # The autopilot and the camera query from their own threads.
        self._lock = threading.RLock()
        self._history: deque[AircraftPose] = deque(maxlen=round(_HISTORY_S / _STEP_S))
        self._history.append(self._pose())

    def sensor_readings(self, time: float) -> SensorReadings:
        pose = self.pose(time)
        earlier = self.pose(time - 0.02)
        rates = so3.log(earlier.ned_from_body.T @ pose.ned_from_body) / 0.02
        error, other = self._noise_rad * self._rng.standard_normal((2, 3))
        return SensorReadings(
            pose.ned_from_body @ so3.exp(error),
            pose.position + self._noise_m * self._rng.standard_normal(3),
            pose.velocity,
            rates,
            pose.ned_from_gimbal @ so3.exp(other) if self._has_gimbal else None,
        )

    def point_gimbal(self, time: float, pitch: float, yaw: float, earth: bool) -> None:
        with self._lock:
            self._commanded = np.array([np.clip(pitch, -0.5 * np.pi, 0.5), yaw if earth else yaw + self._yaw])

    def follow_target(self, time: float, position: Floats, velocity: Floats) -> None:
        with self._lock:
            self._target = (time, np.asarray(position, np.float64), np.asarray(velocity, np.float64))

    def pose(self, time: float) -> AircraftPose:
        """The true state at ``time`` [s], at most 3 s in the past."""
        with self._lock:
            while self._time < time - 1e-9:
                self._advance()
            newest = self._history[-1]
            back = (newest.time - time) / _STEP_S
            index = max(len(self._history) - 1 - int(np.ceil(max(back, 0.0) - 1e-6)), 0)
            first, second = self._history[index], self._history[min(index + 1, len(self._history) - 1)]
        fraction = float(np.clip((time - first.time) / _STEP_S, 0.0, 1.0)) if second is not first else 0.0
        gimbal = _interpolate_rotation(first.ned_from_gimbal, second.ned_from_gimbal, fraction)
        if self._path is not None:
            rotation, positions = self._path.at(np.array([time, time - _STEP_S]))
            return AircraftPose(time, rotation[0], gimbal, positions[0], (positions[0] - positions[1]) / _STEP_S)
        return AircraftPose(
            time,
            _interpolate_rotation(first.ned_from_body, second.ned_from_body, fraction),
            gimbal,
            first.position + fraction * (second.position - first.position),
            first.velocity + fraction * (second.velocity - first.velocity),
        )

    def camera_from_ned(self, time: float, body_from_camera: Floats) -> tuple[Floats, Floats]:
        """Rotation (3, 3), and the camera's centre (3,) NED. body_from_camera: (3, 3), not used with a gimbal."""
        pose = self.pose(time)
        if self._has_gimbal:
            return np.asarray((pose.ned_from_gimbal @ GIMBAL_FROM_CAMERA).T), pose.position
        return np.asarray((pose.ned_from_body @ body_from_camera).T), pose.position

    def _advance(self) -> None:
        self._time += _STEP_S
        disturbance = next((p for p in self._disturbances if p.begin <= self._time < p.begin + p.seconds), None)
        if self._path is None:
            self._fly(disturbance)
        self._turn_gimbal(disturbance)
        self._history.append(self._pose())

    def _fly(self, disturbance: Disturbance | None) -> None:
        gust = np.zeros(3) if disturbance is None else np.array([*disturbance.velocity, 0.0])
        target = self._target_motion()
        desired_velocity = np.zeros(3)
        offset: Floats | None = None
        if target is not None:
            position, velocity = target
            height = max(-float(self._position[2]), 1.0)
            gap = position - height * self._axis_offset - self._position[:2]
            distance = float(np.hypot(*gap))
            closing = min(_CLOSING_GAIN * distance, float(np.sqrt(2.0 * _CLOSING_BRAKE * distance)))
            desired_velocity[:2] = velocity + closing * gap / max(distance, 1e-9)
            offset = gap / height
        speed = float(np.linalg.norm(desired_velocity[:2]))
        if speed > _MAX_SPEED:
            desired_velocity *= _MAX_SPEED / speed
        desired_velocity[2] = 0.5 * (self._altitude - self._position[2])
        acceleration = _limit_norm(_HOLD_GAIN * (desired_velocity - self._velocity), _MAX_ACCELERATION)
        if offset is not None and not self._has_gimbal:
            c, s = np.cos(self._yaw), np.sin(self._yaw)
            level = np.array([[c, -s], [s, c]])
            acceleration[:2] = level @ _limit_to_keep_in_view(level.T @ acceleration[:2], level.T @ offset)
        self._acceleration = self._acceleration + _limit_norm(acceleration - self._acceleration, _MAX_JERK * _STEP_S)
        self._velocity = self._velocity + self._acceleration * _STEP_S
        self._wind = gust  # the aircraft moves with the air; the controller holds the airspeed
        self._position = self._position + (self._velocity + gust) * _STEP_S

    def _target_motion(self) -> tuple[Floats, Floats] | None:
        """Position and velocity (2,) of the followed target now; None without one."""
        if self._target is None:
            return None if self._pilot is None else self._pilot(self._time)
        updated, position, velocity = self._target
        if self._time - updated >= _STALE_S:
            return None
        return np.asarray(position[:2] + (self._time - updated) * velocity[:2]), np.asarray(velocity[:2])

    def _turn_gimbal(self, disturbance: Disturbance | None) -> None:
        if disturbance is not None and any(disturbance.turn):
            self._gimbal = self._gimbal + np.array(disturbance.turn) * _STEP_S
        else:
            gap = self._commanded - self._gimbal
            gap[1] = (gap[1] + np.pi) % (2.0 * np.pi) - np.pi
            self._gimbal = self._gimbal + np.clip(_GIMBAL_GAIN * gap, -_GIMBAL_RATE, _GIMBAL_RATE) * _STEP_S
        self._gimbal[0] = np.clip(self._gimbal[0], -0.5 * np.pi, 0.5)
        keep = np.exp(-_STEP_S / 0.2)
        self._vibration = keep * self._vibration + np.sqrt(
            1.0 - keep**2
        ) * _VIBRATION_STD_RAD * self._rng.standard_normal(3)

    def _pose(self) -> AircraftPose:
        x, y, z = np.eye(3)
        c, s = np.cos(self._yaw), np.sin(self._yaw)
        forward = c * self._acceleration[0] + s * self._acceleration[1]
        right = -s * self._acceleration[0] + c * self._acceleration[1]
        pitch, roll = -np.arctan2(forward, _GRAVITY), np.arctan2(right, _GRAVITY)
        rotation = so3.exp(self._yaw * z) @ so3.exp(pitch * y) @ so3.exp(roll * x) @ so3.exp(2.0 * self._vibration)
        gimbal = so3.exp(self._gimbal[1] * z) @ so3.exp(self._gimbal[0] * y) @ so3.exp(self._vibration)
        return AircraftPose(self._time, rotation, gimbal, self._position.copy(), self._velocity + self._wind)


def _interpolate_rotation(first: Floats, second: Floats, fraction: float) -> Floats:
    return np.asarray(so3.exp(fraction * so3.log(second @ first.T)) @ first)


def _limit_to_keep_in_view(acceleration: Floats, offset: Floats) -> Floats:
    """Limit an acceleration (2,) forward, right so that a fixed camera keeps a target at ``offset`` (2,) [rad] in view.

    The aircraft tilts towards its acceleration, which turns the camera the opposite way.
    """
    if (np.abs(offset) > _OUT_OF_VIEW_RAD).any():
        return acceleration
    maximum = np.maximum(_GRAVITY * (_TARGET_LIMIT_RAD - offset), _MIN_ACCELERATION_LIMIT)
    minimum = np.minimum(_GRAVITY * (-_TARGET_LIMIT_RAD - offset), -_MIN_ACCELERATION_LIMIT)
    return np.asarray(np.clip(acceleration, minimum, maximum))


def _limit_norm(vector: Floats, maximum: float) -> Floats:
    size = float(np.linalg.norm(vector))
    return vector if size <= maximum else vector * (maximum / size)
