"""How the target drives and how the drone loses and finds it: solved so that it is out for just so many frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight import Flight, Shake, Unrest, fly, grid_times, unrest
from edge.uav.world.roads import Curve, drive
from edge.uav.world.world import camera_poses, inside_share, longest_run
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

FPS = 30.0
_RELATIVE_SPEED = 18.0  # mean speed with which the target crosses the picture at an exit [m/s]
_SHORT = 5.0  # by how much a drift may fall short of the border for a brief exit [m]
_WOBBLE, _WOBBLE_LENGTH = 0.12, 37.0  # metres aside, metres along: nobody drives like on rails


@dataclass(frozen=True, eq=False)
class Motion:
    """The target's way. path: of the middle of its lane; it is at arc length 0 at time ``zero`` [s].

    cruise: speed on straights [m/s]. aside: metres to the right of the path by arc length, or None.
    """

    path: Curve
    zero: float
    cruise: float
    phase: float = 0.0
    aside: Callable[[Floats], Floats] | None = None

    def arc(self, times: Floats) -> Floats:
        """Arc length (n,) [m] at ``times`` (n,) [s]."""
        pace = self.cruise * (1.0 + 0.05 * np.sin(2.0 * np.pi * self.path.arc / 63.0 + self.phase))
        return drive(self.path, times - self.zero, pace)

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """North, east (n, 2) [m] and course (n,) [rad] at ``times`` (n,) [s]."""
        s = self.arc(times)
        lateral, slope = self._lateral(s), (self._lateral(s + 0.1) - self._lateral(s - 0.1)) / 0.2
        ground, course = self.path.at(s, 0.0)
        normal = np.column_stack([-np.sin(course), np.cos(course)])
        return ground + lateral[:, None] * normal, course + np.arctan(slope)

    def _lateral(self, s: Floats) -> Floats:
        wobble = _WOBBLE * np.sin(2.0 * np.pi * s / _WOBBLE_LENGTH + self.phase)
        return wobble if self.aside is None else wobble + self.aside(s)

    def car(self, count: int, colour: tuple[int, int, int], delay: float = 0.0) -> cars.Car:
        """The car of frames 0 … count − 1; ``delay`` [s] makes another one that drives behind (or ahead) of it."""
        ground, course = self.at(np.arange(count) / FPS - delay)
        return cars.Car(ground, course, colour)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """How the drone looks on.

    yaw: of the drone at first [rad]. offset: (2,) of the picture's middle from the car [m].
    """

    lens: Intrinsics
    body_from_camera: Floats
    altitude: float
    yaw: float
    offset: Floats = field(default_factory=lambda: np.zeros(2))

    @property
    def metres_per_pixel(self) -> float:
        """On the ground in the middle of the picture."""
        return self.altitude / self.lens.focal

    @property
    def half(self) -> Floats:
        """Half width and half height (2,) of the ground seen [m]."""
        return 0.5 * self.metres_per_pixel * np.array([self.lens.width, self.lens.height])

    def border(self, direction: Floats, turned: float = 0.0) -> float:
        """From the middle to the picture's border along a ground direction (2,) [m], the drone turned by ``turned``."""
        yaw = self.yaw + turned
        up = direction @ np.array([np.cos(yaw), np.sin(yaw)])
        right = direction @ np.array([-np.sin(yaw), np.cos(yaw)])
        with np.errstate(divide="ignore"):
            return float(np.min(self.half / np.abs([right, up])))


@dataclass(frozen=True, slots=True, eq=False)
class Exit:
    """The drone drifts off along ``direction`` (2,) (where the target leaves the picture), waits, and comes back.

    begin: first moment [s]. beyond: how far past the border the target gets [m].
    """

    direction: Floats
    begin: float
    beyond: float


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A flight and the frames from … to (end not included) for which no part of the target is in the picture."""

    flight: Flight
    out: tuple[int, int]


def ease(x: Floats) -> Floats:
    """0 to 1 as x goes from 0 to 1, smoothly."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * x))


def ramp_seconds(distance: float) -> float:
    """How long the drone takes for a drift of ``distance`` metres [s]."""
    return max(distance / _RELATIVE_SPEED, 1.0)


Plan = Callable[[float, Floats, Unrest], Flight]
"""A flight from (waiting time, negative to turn back early [s]; the grid; shaking)."""


def solve(
    rng: np.random.Generator, motion: Motion, view: View, frames: int, plan: Plan, shake: Shake | None = None
) -> Solved:
    """The flight with exactly ``frames`` frames, in one run, that show nothing of the target.

    Bisects the waiting time; where the shaking makes that number impossible it is drawn anew.
    """
    most = frames / FPS + 2.0
    times = grid_times(most + 16.0)
    count = int((times[-1] - 1.0) * FPS)
    target = motion.car(count, (0, 0, 0))
    best: tuple[int, Solved] | None = None
    for _ in range(30):
        shaking = unrest(rng, times, shake or Shake())
        low, high = -1.0, most
        for _ in range(24):
            wait = 0.5 * (low + high)
            flight = plan(wait, times, shaking)
            out, total = _out(view, flight, target)
            length = out[1] - out[0]
            wrong = abs(length - frames) + abs(total - length)
            if best is None or wrong < best[0]:
                best = wrong, Solved(flight, out)
            if wrong == 0:
                return Solved(flight, out)
            if total < frames:
                low = wait
            else:
                high = wait
            if high - low < 1e-3:
                break
    assert best is not None
    return best[1]


def _out(view: View, flight: Flight, target: cars.Car) -> tuple[tuple[int, int], int]:
    """The longest run out of the picture, and how many frames are out at all."""
    poses = camera_poses(flight, view.body_from_camera, np.arange(len(target.ground)) / FPS)
    away = inside_share(view.lens, *poses, target) == 0.0
    return longest_run(away), int(away.sum())


def out_of_picture(view: View, flight: Flight, motion: Motion, length: int) -> tuple[int, int]:
    """The longest run of frames, from … to (end not included), that show nothing of the target."""
    return _out(view, flight, motion.car(length, (0, 0, 0)))[0]


def drift_off(motion: Motion, view: View, leave: Exit, swing: float = 0.0) -> Plan:
    """The plan of an ``Exit``. swing: by which the drone yaws slowly from the exit on [rad]."""
    to_border = view.border(leave.direction) + 0.5 * cars.LENGTH

    def plan(wait: float, times: Floats, shaking: Unrest) -> Flight:
        peak = to_border + leave.beyond - (leave.beyond + _SHORT) * max(-wait, 0.0)
        ramp = ramp_seconds(peak)
        back = leave.begin + ramp + max(wait, 0.0)
        away = peak * (ease((times - leave.begin) / ramp) - ease((times - back) / ramp))
        ground, _ = motion.at(times)
        aim = ground - away[:, None] * leave.direction + view.offset
        yaw = view.yaw + swing * ease((times - leave.begin) / 5.0)
        return fly(times, aim, yaw, view.altitude, shaking, view.body_from_camera)

    return plan


def turn_away(motion: Motion, view: View, begin: float, angle: float) -> Plan:
    """The target rides near the picture's side; then the drone yaws by ``angle`` [rad] and it leaves over the top."""
    side = np.array([-np.sin(view.yaw), np.cos(view.yaw)]) * np.sign(angle)
    width, height = view.half
    near = min(height + 0.5 * cars.LENGTH + 3.2, width - 0.5 * cars.LENGTH - 3.0)

    def plan(wait: float, times: Floats, shaking: Unrest) -> Flight:
        reach = near + 7.5 * ease((times - begin) / 1.0)
        back = begin + 1.2 + wait
        away = reach * (ease((times - 0.2) / (begin - 0.6)) - ease((times - back) / ramp_seconds(near)))
        yaw = view.yaw + angle * ease((times - begin) / 1.1)
        ground, _ = motion.at(times)
        aim = ground - away[:, None] * side
        return fly(times, aim, yaw, view.altitude, shaking, view.body_from_camera)

    return plan


def follow(rng: np.random.Generator, motion: Motion, view: View, seconds: float, shake: Shake | None = None) -> Flight:
    """The target stays near the middle."""
    times = grid_times(seconds)
    ground, _ = motion.at(times)
    yaw = np.full(len(times), view.yaw)
    shaking = unrest(rng, times, shake or Shake())
    return fly(times, ground + view.offset, yaw, view.altitude, shaking, view.body_from_camera)


def hold_at(motion: Motion, view: View, times: Floats, pixels: Floats, shaking: Unrest) -> Flight:
    """The target's centre is at ``pixels`` (n, 2) at the grid's times (n,), whatever the shaking does."""
    ground, _ = motion.at(times)
    centre = np.column_stack([ground, np.full(len(times), -cars.MIDDLE_HEIGHT)])
    yaw = np.full(len(times), view.yaw)
    aim = ground.copy()
    flight = fly(times, aim, yaw, view.altitude, shaking, view.body_from_camera)
    for _ in range(6):  # each step leaves some hundredths of the error
        turned, position = camera_poses(flight, view.body_from_camera, times)
        seen = np.einsum("nij,nj->ni", view.lens.matrix @ turned, centre - position)
        right, down = (pixels - seen[:, :2] / seen[:, 2:]).T * view.metres_per_pixel
        heading = view.yaw + shaking.angles[:, 2]
        c, s = np.cos(heading), np.sin(heading)
        aim = aim - np.column_stack([-down * c - right * s, -down * s + right * c])
        flight = fly(times, aim, yaw, view.altitude, shaking, view.body_from_camera)
    return flight


def chase(motion: Motion, view: View, times: Floats, delay: float, shaking: Unrest) -> Flight:
    """The drone flies to where the car would be had it kept the course and speed of ``delay`` seconds ago."""
    old, before = motion.at(times - delay)[0], motion.at(times - delay - 0.1)[0]
    aim = old + delay * (old - before) / 0.1
    yaw = np.full(len(times), view.yaw)
    return fly(times, aim, yaw, view.altitude, shaking, view.body_from_camera)
