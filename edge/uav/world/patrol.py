"""A flight of any length: a car drives round a block of the town, and the drone loses and finds it again and again."""

from __future__ import annotations

import zlib

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight import GRID_HZ, Flight, Shake, fly, grid_times, unrest
from edge.uav.world.flight_planner import FPS, View, ease, ramp_seconds
from edge.uav.world.ground import Area
from edge.uav.world.noise import wander
from edge.uav.world.rendering import Light
from edge.uav.world.roads import LANE, STEP, Bend, Curve, Road, curve, drive, straight
from edge.uav.world.scenario_builder import view
from edge.uav.world.town import build
from edge.uav.world.world import World
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

NAME = "patrol"
LONGEST_S = 3600.0
_SIDES = (90.0, 60.0)  # straights of the block [m]
_RADIUS = 20.0
_FIRST_EXIT_S, _BETWEEN_S = 6.0, 12.0
_MARGIN = 62.0  # of furnished ground about the block [m]
_CRUISE = (8.0, 11.0)
_COLOURS = ("red", "blue", "yellow", "white", "orange")


class Lap:
    """A closed way, driven round and round. path: one lap from arc length 0. cruise: speed on straights [m/s]."""

    def __init__(self, path: Curve, cruise: float, start: float = 0.0) -> None:
        self._path, self._start = path, start
        self.length = path.end
        self._turn = float(path.course[-1] - path.course[0])
        several = Curve(
            -path.end,
            np.vstack([path.points[:-1], path.points[:-1], path.points]),
            np.concatenate([path.course[:-1] - self._turn, path.course[:-1], path.course + self._turn]),
        )
        # The speeds of the middle lap, which knows what comes before and after it.
        fine = np.arange(0.0, 1.5 * path.end / 2.0, 0.05)
        arc = drive(several, fine, cruise)
        self.period = float(np.interp(path.end, arc, fine))
        self._times, self._arc = fine, arc

    def at(self, times: Floats, lateral: float) -> tuple[Floats, Floats]:
        """North, east (n, 2) [m] and course (n,) [rad] at ``times`` (n,) [s], ``lateral`` metres to the right."""
        lap, rest = np.divmod(times + self._start * self.period, self.period)
        ground, course = self._path.at(np.interp(rest, self._times, self._arc), lateral)
        return ground, course + self._turn * lap


def block(rng: np.random.Generator) -> Curve:
    """The middle of the road round the block, one lap: (n, 2) every half metre, closed."""
    a, b = (side * rng.uniform(0.9, 1.1) for side in _SIDES)
    corner = 0.5 * np.pi * _RADIUS
    bends, at = [], 0.0
    for side in (a, b, a, b):
        bends.append(Bend(at + side, 0.5 * np.pi, _RADIUS))
        at += side + corner
    length = STEP * round(at / STEP)
    open_way = curve(bends, 0.0, length, rng.uniform(-np.pi, np.pi))
    n = round(length / STEP) + 1
    points, course = open_way.points[:n], open_way.course[:n]
    share = np.linspace(0.0, 1.0, n)
    points = points - share[:, None] * (points[-1] - points[0])
    course = course - share * (course[-1] - course[0] - 2.0 * np.pi)
    return Curve(0.0, points - points.mean(axis=0), course)


def patrol(seed: int, seconds: float, size: tuple[int, int] = (640, 480)) -> World:
    """The world of this seed; every 12 s the drone drifts off and the car is out of the picture for 1 to 3 s.

    Raises InputError for a size or length out of range.
    """
    if not 1.0 <= seconds <= LONGEST_S:
        raise InputError(f"a flight of {seconds:g} s is out of range", remedy=f"give 1 to {LONGEST_S:.0f}")
    if not (160 <= size[0] <= 4096 and 120 <= size[1] <= 4096):
        raise InputError(f"a picture of {size[0]}x{size[1]} is out of range", remedy="give 160x120 to 4096x4096")
    # Nothing of the world may depend on how long it is watched: every part has a stream of its own.
    base = [seed, zlib.crc32(NAME.encode()), *size]
    rng = np.random.default_rng(base)
    camera = view(rng, size)
    road = Road(block(rng))
    lap = Lap(road.centre, rng.uniform(*_CRUISE), rng.uniform(0.0, 1.0))
    colour = _COLOURS[int(rng.integers(len(_COLOURS)))]
    n = int(seconds * FPS) + 1
    frames = np.arange(n) / FPS
    target = cars.Car(*lap.at(frames, 0.5 * LANE), cars.COLOURS_BGR[colour])
    course = float(road.centre.course[0])
    # One street crosses the block's long sides.
    middle, _ = road.centre.at(np.array([0.5 * _SIDES[0]]))
    across = Road(straight(middle[0], course + 0.5 * np.pi, -110.0, 150.0))
    roads = [road, across]
    flight = _flight(np.random.default_rng([*base, 1]), lap, camera, seconds)
    low = road.centre.points.min(axis=0) - _MARGIN
    high = road.centre.points.max(axis=0) + _MARGIN
    area = Area((float(low[0]), float(high[0])), (float(low[1]), float(high[1])))
    town = build(np.random.default_rng([*base, 2]), area, roads, not_colour=colour)
    traffic = _traffic(np.random.default_rng([*base, 3]), road.centre, frames, colour)
    gain = 1.0 + wander(np.random.default_rng([*base, 4]), n, 1.0 / FPS, 0.02, 1.0)[:, None] * np.ones(3)
    return World(
        name=NAME,
        seed=seed,
        length=n,
        fps=FPS,
        lens=camera.lens,
        body_from_camera=camera.body_from_camera,
        flight=flight,
        town=town,
        target=target,
        traffic=traffic,
        light=Light(gain),
    )


def _flight(rng: np.random.Generator, lap: Lap, camera: View, seconds: float) -> Flight:
    times = grid_times(seconds)
    ground, _ = lap.at(times, 0.5 * LANE)
    away = np.zeros((len(times), 2))
    begin = _FIRST_EXIT_S
    while begin < times[-1]:
        angle = rng.uniform(-np.pi, np.pi)
        direction = np.array([np.cos(angle), np.sin(angle)])
        peak = camera.border(direction, turned=0.0) + 0.5 * cars.LENGTH + rng.uniform(3.0, 6.0)
        ramp = max(ramp_seconds(peak), 1.6)
        back = begin + ramp + rng.uniform(0.0, 1.2)
        share = ease((times - begin) / ramp) - ease((times - back) / ramp)
        away += peak * share[:, None] * direction
        begin += _BETWEEN_S
    shaking = unrest(rng, times, Shake())
    yaw = np.full(len(times), camera.yaw) + wander(rng, len(times), 1.0 / GRID_HZ, 0.25, 6.0)
    return fly(times, ground - away, yaw, camera.altitude, shaking, camera.body_from_camera)


def _traffic(rng: np.random.Generator, path: Curve, frames: Floats, not_colour: str) -> tuple[cars.Car, ...]:
    """Cars that come the other way round, none of them of the target's colour."""
    colours = [name for name in cars.COLOURS_BGR if name != not_colour]
    back = Curve(0.0, path.points[::-1].copy(), path.course[::-1] + np.pi)
    out = []
    cruise = rng.uniform(7.0, 10.0)
    for k in range(4):
        lap = Lap(back, cruise, 0.25 * k + rng.uniform(0.0, 0.1))
        ground, course = lap.at(frames, 0.5 * LANE)
        out.append(cars.Car(ground, course, cars.COLOURS_BGR[colours[int(rng.integers(len(colours)))]]))
    return tuple(out)


__all__ = ["NAME", "Lap", "block", "patrol"]
