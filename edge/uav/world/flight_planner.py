"""Flight planner: target motion and drone manoeuvres, solved so that the target is out of view for N frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight import Disturbance, DisturbanceLevels, Flight, flight_over, grid_times, sample_disturbance
from edge.uav.world.flight_world import camera_poses, longest_run, share_in_image
from edge.uav.world.roads import Curve, arc_length_over_time
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

FPS = 30.0  # of the rendered videos; lengths of scenarios and absences are numbers of frames
_RELATIVE_SPEED = 18.0  # mean speed of the target relative to the image footprint at an exit [m/s]
_BRIEF_EXIT_SHORTFALL = 5.0  # by how much the drift may fall short of the image border for a brief exit [m]
_WOBBLE, _WOBBLE_LENGTH = 0.12, 37.0  # lateral amplitude and wavelength [m] of lane keeping


@dataclass(frozen=True, eq=False)
class TargetMotion:
    """The target's motion. path: centre line of its lane; it is at arc length 0 at time ``start_time`` [s].

    cruise: speed on straights [m/s]. lateral_offset: metres to the right of the path by arc length, or None.
    """

    path: Curve
    start_time: float
    cruise: float
    phase: float = 0.0
    lateral_offset: Callable[[Floats], Floats] | None = None

    def arc(self, times: Floats) -> Floats:
        """Arc length (n,) [m] at ``times`` (n,) [s]."""
        cruise_profile = self.cruise * (1.0 + 0.05 * np.sin(2.0 * np.pi * self.path.arc / 63.0 + self.phase))
        return arc_length_over_time(self.path, times - self.start_time, cruise_profile)

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """North, east (n, 2) [m] and course (n,) [rad] at ``times`` (n,) [s]."""
        s = self.arc(times)
        lateral, slope = self._lateral(s), (self._lateral(s + 0.1) - self._lateral(s - 0.1)) / 0.2
        ground, course = self.path.at(s, 0.0)
        normal = np.column_stack([-np.sin(course), np.cos(course)])
        return ground + lateral[:, None] * normal, course + np.arctan(slope)

    def _lateral(self, s: Floats) -> Floats:
        wobble = _WOBBLE * np.sin(2.0 * np.pi * s / _WOBBLE_LENGTH + self.phase)
        return wobble if self.lateral_offset is None else wobble + self.lateral_offset(s)

    def car(self, count: int, colour: tuple[int, int, int], delay: float = 0.0) -> cars.Car:
        """The car of frames 0 … count − 1; ``delay`` [s] gives a car that follows (or precedes) it."""
        ground, course = self.at(np.arange(count) / FPS - delay)
        return cars.Car(ground, course, colour)


@dataclass(frozen=True, slots=True, eq=False)
class CameraSetup:
    """The drone's camera: intrinsics, mounting and nominal viewing geometry.

    yaw: initial yaw of the drone [rad]. offset: (2,) of the image centre on the ground from the target [m].
    """

    lens: Intrinsics
    body_from_camera: Floats
    altitude: float
    yaw: float
    offset: Floats = field(default_factory=lambda: np.zeros(2))

    @property
    def metres_per_pixel(self) -> float:
        """Ground sampling distance at the image centre [m/px]."""
        return self.altitude / self.lens.focal

    @property
    def half(self) -> Floats:
        """Half width and half height (2,) of the image footprint on the ground [m]."""
        return 0.5 * self.metres_per_pixel * np.array([self.lens.width, self.lens.height])

    def border(self, direction: Floats, turned: float = 0.0) -> float:
        """Distance [m] from image centre to border in a ground direction (2,), the yaw changed by ``turned``."""
        yaw = self.yaw + turned
        up = direction @ np.array([np.cos(yaw), np.sin(yaw)])
        right = direction @ np.array([-np.sin(yaw), np.cos(yaw)])
        with np.errstate(divide="ignore"):
            return float(np.min(self.half / np.abs([right, up])))


@dataclass(frozen=True, slots=True, eq=False)
class ExitManoeuvre:
    """The drone drifts off along ``direction`` (2,) (where the target leaves the image), waits, and comes back.

    begin: start time [s]. beyond: how far beyond the image border the target gets [m].
    """

    direction: Floats
    begin: float
    beyond: float


def cosine_ramp(x: Floats) -> Floats:
    """Raised-cosine ramp from 0 to 1 as x goes from 0 to 1."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * x))


def ramp_duration(distance: float) -> float:
    """Duration [s] of a drift of the drone by ``distance`` metres."""
    return max(distance / _RELATIVE_SPEED, 1.0)


FlightPlan = Callable[[float, Floats, Disturbance], Flight]
"""A flight as a function of waiting time (negative: turn back early) [s], time grid and disturbances."""


def solve_exit(
    rng: np.random.Generator, motion: TargetMotion, camera: CameraSetup, frames: int, plan: FlightPlan
) -> tuple[Flight, tuple[int, int]]:
    """The flight with exactly ``frames`` consecutive frames in which no part of the target is in view, and these.

    Bisects the waiting time; where the disturbances make that number impossible, they are redrawn.
    """
    max_wait = frames / FPS + 2.0
    times = grid_times(max_wait + 16.0)
    count = int((times[-1] - 1.0) * FPS)
    target = motion.car(count, (0, 0, 0))
    best: tuple[int, Flight, tuple[int, int]] | None = None
    for _ in range(30):
        disturbance = sample_disturbance(rng, times, DisturbanceLevels())
        low, high = -1.0, max_wait
        for _ in range(24):
            wait = 0.5 * (low + high)
            flight = plan(wait, times, disturbance)
            out, total = _out_of_view(camera, flight, target)
            length = out[1] - out[0]
            count_error = abs(length - frames) + abs(total - length)
            if best is None or count_error < best[0]:
                best = count_error, flight, out
            if count_error == 0:
                return flight, out
            if total < frames:
                low = wait
            else:
                high = wait
            if high - low < 1e-3:
                break
    assert best is not None
    return best[1:]


def _out_of_view(camera: CameraSetup, flight: Flight, target: cars.Car) -> tuple[tuple[int, int], int]:
    """The longest run of out-of-view frames, and their total number."""
    poses = camera_poses(flight, camera.body_from_camera, np.arange(len(target.ground)) / FPS)
    away = share_in_image(camera.lens, *poses, target) == 0.0
    return longest_run(away), int(away.sum())


def out_of_view_interval(camera: CameraSetup, flight: Flight, motion: TargetMotion, length: int) -> tuple[int, int]:
    """The longest run of frames without the target in the image: begin, end (exclusive)."""
    return _out_of_view(camera, flight, motion.car(length, (0, 0, 0)))[0]


def drift_exit(
    motion: TargetMotion, camera: CameraSetup, manoeuvre: ExitManoeuvre, yaw_change: float = 0.0
) -> FlightPlan:
    """The plan of an ``ExitManoeuvre``. yaw_change: slow change of yaw from the exit on [rad]."""
    to_border = camera.border(manoeuvre.direction) + 0.5 * cars.LENGTH

    def plan(wait: float, times: Floats, disturbance: Disturbance) -> Flight:
        peak = to_border + manoeuvre.beyond - (manoeuvre.beyond + _BRIEF_EXIT_SHORTFALL) * max(-wait, 0.0)
        ramp = ramp_duration(peak)
        back = manoeuvre.begin + ramp + max(wait, 0.0)
        away = peak * (cosine_ramp((times - manoeuvre.begin) / ramp) - cosine_ramp((times - back) / ramp))
        ground, _ = motion.at(times)
        aim = ground - away[:, None] * manoeuvre.direction + camera.offset
        yaw = camera.yaw + yaw_change * cosine_ramp((times - manoeuvre.begin) / 5.0)
        return flight_over(times, aim, yaw, camera.altitude, disturbance, camera.body_from_camera)

    return plan


def yaw_exit(motion: TargetMotion, camera: CameraSetup, begin: float, angle: float) -> FlightPlan:
    """The target is held near a side of the image; then the drone yaws by ``angle`` [rad], and it leaves at the top."""
    side = np.array([-np.sin(camera.yaw), np.cos(camera.yaw)]) * np.sign(angle)
    width, height = camera.half
    near = min(height + 0.5 * cars.LENGTH + 3.2, width - 0.5 * cars.LENGTH - 3.0)

    def plan(wait: float, times: Floats, disturbance: Disturbance) -> Flight:
        reach = near + 7.5 * cosine_ramp((times - begin) / 1.0)
        back = begin + 1.2 + wait
        away = reach * (cosine_ramp((times - 0.2) / (begin - 0.6)) - cosine_ramp((times - back) / ramp_duration(near)))
        yaw = camera.yaw + angle * cosine_ramp((times - begin) / 1.1)
        ground, _ = motion.at(times)
        aim = ground - away[:, None] * side
        return flight_over(times, aim, yaw, camera.altitude, disturbance, camera.body_from_camera)

    return plan


def follow_target(rng: np.random.Generator, motion: TargetMotion, camera: CameraSetup, seconds: float) -> Flight:
    """A flight that keeps the target near the image centre."""
    times = grid_times(seconds)
    ground, _ = motion.at(times)
    yaw = np.full(len(times), camera.yaw)
    disturbance = sample_disturbance(rng, times, DisturbanceLevels())
    return flight_over(times, ground + camera.offset, yaw, camera.altitude, disturbance, camera.body_from_camera)


def hold_target_at(
    motion: TargetMotion, camera: CameraSetup, times: Floats, pixels: Floats, disturbance: Disturbance
) -> Flight:
    """A flight with the target's centre at ``pixels`` (n, 2) at the grid times (n,), disturbances compensated."""
    ground, _ = motion.at(times)
    centre = np.column_stack([ground, np.full(len(times), -cars.CENTRE_HEIGHT)])
    yaw = np.full(len(times), camera.yaw)
    aim = ground.copy()
    flight = flight_over(times, aim, yaw, camera.altitude, disturbance, camera.body_from_camera)
    for _ in range(6):  # fixed-point iteration: each step leaves a few per cent of the error
        turned, position = camera_poses(flight, camera.body_from_camera, times)
        seen = np.einsum("nij,nj->ni", camera.lens.matrix @ turned, centre - position)
        right, down = (pixels - seen[:, :2] / seen[:, 2:]).T * camera.metres_per_pixel
        heading = camera.yaw + disturbance.angles[:, 2]
        c, s = np.cos(heading), np.sin(heading)
        aim = aim - np.column_stack([-down * c - right * s, -down * s + right * c])
        flight = flight_over(times, aim, yaw, camera.altitude, disturbance, camera.body_from_camera)
    return flight


def chase_prediction(
    motion: TargetMotion, camera: CameraSetup, times: Floats, delay: float, disturbance: Disturbance
) -> Flight:
    """The drone flies to a constant-velocity prediction from the target state ``delay`` seconds ago."""
    old, before = motion.at(times - delay)[0], motion.at(times - delay - 0.1)[0]
    aim = old + delay * (old - before) / 0.1
    yaw = np.full(len(times), camera.yaw)
    return flight_over(times, aim, yaw, camera.altitude, disturbance, camera.body_from_camera)
