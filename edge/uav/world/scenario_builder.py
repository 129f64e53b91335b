"""What the scenarios are made of: the stage that each starts from, the script that each writes, and their roads."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA, Flight, rotation
from edge.uav.world.flight_planner import Motion, View
from edge.uav.world.occluders import Solid
from edge.uav.world.roads import LANE, Bend, Curve, Road, curve, straight
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

BEHIND, AHEAD = -140.0, 330.0  # metres of road before and after arc length 0
RIDE_FRAMES = 240  # of a flight without an exit
_FOCAL_640 = 600.0  # px at 640 wide; wider pictures get a longer lens and fly higher, at the same 0.1 m a pixel
_METRES_PER_PIXEL = 0.1


@dataclass(frozen=True, eq=False)
class Stage:
    """What every scenario starts from.

    frames: how many were asked for, 0 where there are none. course: of the road [rad]. cruise: of the target [m/s].
    """

    rng: np.random.Generator
    view: View
    frames: int
    colour: str
    course: float
    cruise: float

    @property
    def bgr(self) -> tuple[int, int, int]:
        """The target's colour."""
        return cars.COLOURS_BGR[self.colour]


@dataclass(frozen=True, eq=False)
class Script:
    """What a scenario decides.

    followers_s: the target's doubles in its own lane, by how much later they pass [s] (negative: ahead of it).
    doubles: further cars of the target's colour. strangers: tries a road to let another car drive on it.
    gain: (length, 3) brightness of blue, green, red, or None. clouds: depth of their shadows. shadowless: solids
    whose shadow is not painted.
    """

    view: View
    roads: list[Road]
    motion: Motion
    flight: Flight
    length: int
    special: tuple[Solid, ...] = ()
    keep_clear: tuple[Curve, ...] = ()
    followers_s: tuple[float, ...] = ()
    doubles: tuple[cars.Car, ...] = ()
    strangers: int = 3
    gain: Floats | None = field(default=None)
    clouds: float = 0.0


def view(rng: np.random.Generator, size: tuple[int, int]) -> View:
    """A camera of this size that looks down, mounted up to 6 degrees askew, flying at 0.1 m a pixel."""
    focal = _FOCAL_640 * float(np.sqrt(size[0] / 640.0))
    matrix = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    tilt, none = np.deg2rad(rng.uniform(-6.0, 6.0, 1)), np.zeros(1)
    mounting = rotation(none, tilt, none)[0] @ BODY_FROM_DOWN_CAMERA
    yaw, offset = rng.uniform(-np.pi, np.pi), rng.uniform(-3.0, 3.0, 2)
    return View(Intrinsics(size[0], size[1], matrix), mounting, _METRES_PER_PIXEL * focal, yaw, offset)


def along(stage: Stage, bends: list[Bend], crossing: bool = True, sway: float = 0.0008) -> list[Road]:
    """A road along the stage's course and, two times in three, one that crosses it well before arc length 0."""
    rng = stage.rng
    road = Road(curve(bends, BEHIND, AHEAD, stage.course, sway * rng.standard_normal(2)))
    out = [road]
    if crossing and rng.random() < 0.67:
        out.append(across(rng, road, rng.uniform(-60.0, -22.0)))
    return out


def across(rng: np.random.Generator, road: Road, s: float) -> Road:
    """A road that crosses ``road`` at its arc length ``s``."""
    place, course = road.centre.at(np.array([s]))
    angle = float(course[0]) + np.pi / 2 + rng.uniform(-0.35, 0.35)
    return Road(straight(place[0], angle, -140.0, 140.0))


def right_lane(road: Road) -> Curve:
    """The middle of the lane on the right of a road's direction."""
    return road.centre.offset(0.5 * LANE)


def right_of(course: float) -> Floats:
    """Unit vector (2,) to the right of a course [rad]."""
    return np.array([-np.sin(course), np.cos(course)])


def corner(stage: Stage, begin: float) -> tuple[Curve, float, list[Road]]:
    """A turn at a crossing: the way (it passes the origin on the stage's course), its angle [rad], the two roads.

    begin: arc length at which the turn begins [m]. The roads go on straight both ways.
    """
    rng = stage.rng
    right = bool(rng.random() < 0.5)
    angle = rng.uniform(np.deg2rad(78.0), np.deg2rad(102.0)) * (1.0 if right else -1.0)
    way = curve(
        [Bend(begin, angle, rng.uniform(6.5, 8.0) if right else rng.uniform(9.0, 11.0))], BEHIND, AHEAD, stage.course
    )
    # At the origin it may turn already: the roads lie along the way before the turn and after it.
    places, (old, new) = way.at(np.array([begin - 10.0, begin + 40.0]))
    main = Road(straight(places[0] - 0.5 * LANE * right_of(old), old, -130.0, 180.0))
    other = Road(straight(places[1] - 0.5 * LANE * right_of(new), new, -190.0, 290.0))
    return way, angle, [main, other]
