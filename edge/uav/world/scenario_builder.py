"""Scenario builder: inputs and plan of a scenario, camera and road layouts that the scenarios share."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA, Flight, rotation
from edge.uav.world.flight_planner import CameraSetup, TargetMotion
from edge.uav.world.occluders import Occluder
from edge.uav.world.roads import LANE, Bend, Curve, Road, curve_from_bends, straight_curve
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

ROAD_BEGIN, ROAD_END = -140.0, 330.0  # m: arc length at which a road begins and ends
IN_VIEW_FRAMES = 240  # length of an in-view scenario
_FOCAL_640 = 600.0  # px at 640 wide; wider images get a longer focal length and altitude, at the same 0.1 m/px
_METRES_PER_PIXEL = 0.1  # straight below: as fine as the rendered ground


@dataclass(frozen=True, eq=False)
class ScenarioInputs:
    """Random inputs from which every scenario is planned.

    frames: requested number of frames, 0 without a choice. course: of the road [rad]. cruise: of the target [m/s].
    """

    rng: np.random.Generator
    camera: CameraSetup
    frames: int
    colour: str
    course: float
    cruise: float

    @property
    def bgr(self) -> tuple[int, int, int]:
        """The target's colour (BGR)."""
        return cars.COLOURS_BGR[self.colour]


@dataclass(frozen=True, eq=False)
class ScenarioPlan:
    """The plan of a scenario: roads, target motion, flight, occluders, traffic and illumination.

    lookalike_delays_s: cars of the target's colour in its own lane, by their delay [s] (negative: ahead of it).
    lookalikes: further cars of the target's colour. other_traffic_tries: attempts per road to add another car.
    gain: (length, 3) of blue, green, red, or None. clouds: depth of cloud shadows.
    """

    camera: CameraSetup
    roads: list[Road]
    motion: TargetMotion
    flight: Flight
    length: int
    scenario_occluders: tuple[Occluder, ...] = ()
    keep_clear: tuple[Curve, ...] = ()
    lookalike_delays_s: tuple[float, ...] = ()
    lookalikes: tuple[cars.Car, ...] = ()
    other_traffic_tries: int = 3
    gain: Floats | None = field(default=None)
    clouds: float = 0.0


def sample_camera(rng: np.random.Generator, size: tuple[int, int]) -> CameraSetup:
    """A random downward-looking camera of this size, tilted up to 6 degrees, at a ground sampling of 0.1 m/px."""
    focal = _FOCAL_640 * float(np.sqrt(size[0] / 640.0))
    matrix = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    tilt, none = np.deg2rad(rng.uniform(-6.0, 6.0, 1)), np.zeros(1)
    mounting = rotation(none, tilt, none)[0] @ BODY_FROM_DOWN_CAMERA
    yaw, offset = rng.uniform(-np.pi, np.pi), rng.uniform(-3.0, 3.0, 2)
    return CameraSetup(Intrinsics(size[0], size[1], matrix), mounting, _METRES_PER_PIXEL * focal, yaw, offset)


def main_road(inputs: ScenarioInputs, bends: list[Bend], crossing: bool = True, sway: float = 0.0008) -> list[Road]:
    """A road along the given course and, with probability 0.67, one that crosses it well before arc length 0."""
    rng = inputs.rng
    road = Road(curve_from_bends(bends, ROAD_BEGIN, ROAD_END, inputs.course, sway * rng.standard_normal(2)))
    out = [road]
    if crossing and rng.random() < 0.67:
        out.append(crossing_road(rng, road, rng.uniform(-60.0, -22.0)))
    return out


def crossing_road(rng: np.random.Generator, road: Road, s: float) -> Road:
    """A road that crosses ``road`` at its arc length ``s``."""
    place, course = road.centre.at(np.array([s]))
    angle = float(course[0]) + np.pi / 2 + rng.uniform(-0.35, 0.35)
    return Road(straight_curve(place[0], angle, -140.0, 140.0))


def right_lane(road: Road) -> Curve:
    """Centre line of the lane on the right of a road's direction."""
    return road.centre.offset(0.5 * LANE)


def right_normal(course: float) -> Floats:
    """Unit vector (2,) to the right of a course [rad]."""
    return np.array([-np.sin(course), np.cos(course)])


def turn_at_crossing(inputs: ScenarioInputs, begin: float) -> tuple[Curve, float, list[Road]]:
    """A turn at a crossing: the path (through the origin on the given course), the turn angle [rad], the two roads.

    begin: arc length at which the turn begins [m]. The roads continue straight in both directions.
    """
    rng = inputs.rng
    right = bool(rng.random() < 0.5)
    angle = rng.uniform(np.deg2rad(78.0), np.deg2rad(102.0)) * (1.0 if right else -1.0)
    path = curve_from_bends(
        [Bend(begin, angle, rng.uniform(6.5, 8.0) if right else rng.uniform(9.0, 11.0))],
        ROAD_BEGIN,
        ROAD_END,
        inputs.course,
    )
    # The turn may begin before the origin: the roads lie along the path before and after the turn.
    places, (old, new) = path.at(np.array([begin - 10.0, begin + 40.0]))
    main = Road(straight_curve(places[0] - 0.5 * LANE * right_normal(old), old, -130.0, 180.0))
    other = Road(straight_curve(places[1] - 0.5 * LANE * right_normal(new), new, -190.0, 290.0))
    return path, angle, [main, other]
