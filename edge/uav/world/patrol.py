"""A flight of any length: the target circles a block and leaves and re-enters the field of view periodically."""

from __future__ import annotations

import zlib

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight import GRID_HZ, DisturbanceLevels, Flight, flight_over, grid_times, sample_disturbance
from edge.uav.world.flight_planner import FPS, CameraSetup, cosine_ramp, ramp_duration
from edge.uav.world.flight_world import FlightWorld
from edge.uav.world.ground_texture import Area
from edge.uav.world.noise import smoothed_noise
from edge.uav.world.rendering import Illumination
from edge.uav.world.roads import LANE, STEP, Bend, Curve, Road, arc_length_over_time, curve_from_bends, straight_curve
from edge.uav.world.scenario_builder import sample_camera
from edge.uav.world.town import build_town
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

NAME = "patrol"
LONGEST_S = 3600.0  # s: an hour
_SIDES = (90.0, 60.0)  # straights of the block [m]
_RADIUS = 20.0  # m of the road's middle in the block's corners
_FIRST_EXIT_S, _EXIT_INTERVAL_S = 6.0, 12.0  # time to learn the target, and to have it back in view between two exits
_MARGIN = 62.0  # m of modelled ground around the block
_CRUISE = (8.0, 11.0)  # m/s: 29 to 40 km/h, in town
_COLOURS = ("red", "blue", "yellow", "white", "orange")


class ClosedRoute:
    """A closed route that is driven repeatedly. path: one lap from arc length 0. cruise: speed on straights [m/s]."""

    def __init__(self, path: Curve, cruise: float, start: float = 0.0) -> None:
        self._path, self._start = path, start
        self.length = path.end
        self._turn = float(path.course[-1] - path.course[0])
        several = Curve(
            -path.end,
            np.vstack([path.points[:-1], path.points[:-1], path.points]),
            np.concatenate([path.course[:-1] - self._turn, path.course[:-1], path.course + self._turn]),
        )
        # The speed profile of the middle lap of three, so that it is periodic.
        fine = np.arange(0.0, 1.5 * path.end / 2.0, 0.05)
        arc = arc_length_over_time(several, fine, cruise)
        self.period = float(np.interp(path.end, arc, fine))
        self._times, self._arc = fine, arc

    def at(self, times: Floats, lateral: float) -> tuple[Floats, Floats]:
        """North, east (n, 2) [m] and course (n,) [rad] at ``times`` (n,) [s], ``lateral`` metres to the right."""
        lap, rest = np.divmod(times + self._start * self.period, self.period)
        ground, course = self._path.at(np.interp(rest, self._times, self._arc), lateral)
        return ground, course + self._turn * lap


def block_route(rng: np.random.Generator) -> Curve:
    """Centre line of the road round the block, one lap: (n, 2) every half metre, closed."""
    a, b = (side * rng.uniform(0.9, 1.1) for side in _SIDES)
    corner = 0.5 * np.pi * _RADIUS
    bends, at = [], 0.0
    for side in (a, b, a, b):
        bends.append(Bend(at + side, 0.5 * np.pi, _RADIUS))
        at += side + corner
    length = STEP * round(at / STEP)
    open_path = curve_from_bends(bends, 0.0, length, rng.uniform(-np.pi, np.pi))
    n = round(length / STEP) + 1
    points, course = open_path.points[:n], open_path.course[:n]
    share = np.linspace(0.0, 1.0, n)
    points = points - share[:, None] * (points[-1] - points[0])
    course = course - share * (course[-1] - course[0] - 2.0 * np.pi)
    return Curve(0.0, points - points.mean(axis=0), course)


def patrol_world(seed: int, seconds: float, size: tuple[int, int] = (640, 480)) -> FlightWorld:
    """The world of this seed; every 12 s the drone drifts off and the target is out of view for 1 to 3 s.

    Raises InputError for a size or length out of range.
    """
    if not 1.0 <= seconds <= LONGEST_S:
        raise InputError(f"a flight of {seconds:g} s is out of range", remedy=f"give 1 to {LONGEST_S:.0f}")
    if not (160 <= size[0] <= 4096 and 120 <= size[1] <= 4096):
        raise InputError(f"an image of {size[0]}x{size[1]} is out of range", remedy="give 160x120 to 4096x4096")
    # The world must not depend on the length of the flight, so every part has its own random stream.
    base = [seed, zlib.crc32(NAME.encode()), *size]
    rng = np.random.default_rng(base)
    camera = sample_camera(rng, size)
    road = Road(block_route(rng))
    route = ClosedRoute(road.centre, rng.uniform(*_CRUISE), rng.uniform(0.0, 1.0))
    colour = _COLOURS[int(rng.integers(len(_COLOURS)))]
    n = int(seconds * FPS) + 1
    frames = np.arange(n) / FPS
    target = cars.Car(*route.at(frames, 0.5 * LANE), cars.COLOURS_BGR[colour])
    course = float(road.centre.course[0])
    # One street crosses the long sides of the block.
    middle, _ = road.centre.at(np.array([0.5 * _SIDES[0]]))
    across = Road(straight_curve(middle[0], course + 0.5 * np.pi, -110.0, 150.0))
    roads = [road, across]
    flight = _flight(np.random.default_rng([*base, 1]), route, camera, seconds)
    low = road.centre.points.min(axis=0) - _MARGIN
    high = road.centre.points.max(axis=0) + _MARGIN
    area = Area((float(low[0]), float(high[0])), (float(low[1]), float(high[1])))
    town = build_town(np.random.default_rng([*base, 2]), area, roads, not_colour=colour)
    traffic = _traffic(np.random.default_rng([*base, 3]), road.centre, frames, colour)
    gain = 1.0 + smoothed_noise(np.random.default_rng([*base, 4]), n, 1.0 / FPS, 0.02, 1.0)[:, None] * np.ones(3)
    return FlightWorld(
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
        illumination=Illumination(gain),
    )


def _flight(rng: np.random.Generator, route: ClosedRoute, camera: CameraSetup, seconds: float) -> Flight:
    times = grid_times(seconds)
    ground, _ = route.at(times, 0.5 * LANE)
    away = np.zeros((len(times), 2))
    begin = _FIRST_EXIT_S
    while begin < times[-1]:
        angle = rng.uniform(-np.pi, np.pi)
        direction = np.array([np.cos(angle), np.sin(angle)])
        peak = camera.border(direction, turned=0.0) + 0.5 * cars.LENGTH + rng.uniform(3.0, 6.0)
        ramp = max(ramp_duration(peak), 1.6)
        back = begin + ramp + rng.uniform(0.0, 1.2)
        share = cosine_ramp((times - begin) / ramp) - cosine_ramp((times - back) / ramp)
        away += peak * share[:, None] * direction
        begin += _EXIT_INTERVAL_S
    disturbance = sample_disturbance(rng, times, DisturbanceLevels())
    yaw = np.full(len(times), camera.yaw) + smoothed_noise(rng, len(times), 1.0 / GRID_HZ, 0.25, 6.0)
    return flight_over(times, ground - away, yaw, camera.altitude, disturbance, camera.body_from_camera)


def _traffic(rng: np.random.Generator, path: Curve, frames: Floats, not_colour: str) -> tuple[cars.Car, ...]:
    """Oncoming cars, none of them of the target's colour."""
    colours = [name for name in cars.COLOURS_BGR if name != not_colour]
    back = Curve(0.0, path.points[::-1].copy(), path.course[::-1] + np.pi)
    out = []
    cruise = rng.uniform(7.0, 10.0)
    for k in range(4):
        route = ClosedRoute(back, cruise, 0.25 * k + rng.uniform(0.0, 0.1))
        ground, course = route.at(frames, 0.5 * LANE)
        out.append(cars.Car(ground, course, cars.COLOURS_BGR[colours[int(rng.integers(len(colours)))]]))
    return tuple(out)
