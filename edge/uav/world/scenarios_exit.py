"""Scenarios in which the target leaves the picture and comes back."""

from __future__ import annotations

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight_planner import FPS, Exit, Motion, Plan, drift_off, ramp_seconds, solve, turn_away
from edge.uav.world.roads import LANE, Bend, Curve, Road
from edge.uav.world.scenario_builder import Script, Stage, along, corner, right_lane, right_of
from protocols.geometry.types import Floats

_BEGIN_S = 1.7  # when the drone begins to lose the target
_TAIL_FRAMES = 75  # after the target is back
_YAW_BEGIN_S = 2.4


def straight_road(stage: Stage) -> Script:
    """The drone drifts off, to any side, from a car on a road without bends."""
    roads = along(stage, [])
    return leave(stage, roads, right_lane(roads[0]), any_direction(stage.rng))


def bend(stage: Stage) -> Script:
    """The road bends about where the target leaves; the drone flies on rather straight."""
    rng = stage.rng
    angle = rng.choice([-1.0, 1.0]) * rng.uniform(np.deg2rad(50.0), np.deg2rad(100.0))
    first = Bend(rng.uniform(-6.0, 5.0), angle, rng.uniform(16.0, 36.0))
    second = Bend(first.start + first.length + rng.uniform(15.0, 40.0), -0.6 * angle, rng.uniform(25.0, 60.0))
    roads = along(stage, [first, second])
    return leave(stage, roads, right_lane(roads[0]), _straying(rng, stage.course, angle))


def turn_out_of_view(stage: Stage) -> Script:
    """The target turns off at a crossing that has been in the picture, but while it is out of the picture itself."""
    rng = stage.rng
    way, _, roads = corner(stage, rng.uniform(-1.0, 5.0))
    side = rng.choice([-1.0, 1.0]) * right_of(stage.course)
    back = -rng.uniform(0.0, 0.5) * np.array([np.cos(stage.course), np.sin(stage.course)])
    return leave(stage, roads, way, side + back)


def yaw(stage: Stage) -> Script:
    """The drone yaws, so that a car near the picture's side goes out over its top or bottom."""
    roads = along(stage, [])
    angle = stage.rng.choice([-1.0, 1.0]) * stage.rng.uniform(np.deg2rad(80.0), np.deg2rad(105.0))
    motion = Motion(right_lane(roads[0]), _YAW_BEGIN_S, stage.cruise, stage.rng.uniform(0.0, 6.28))
    return _solved(stage, roads, motion, turn_away(motion, stage.view, _YAW_BEGIN_S, angle))


def distractors(stage: Stage) -> Script:
    """Cars of the target's colour follow it, drive ahead of it and pass it while it is out."""
    rng = stage.rng
    angle = rng.choice([-1.0, 1.0]) * rng.uniform(0.0, np.deg2rad(40.0))
    roads = along(stage, [Bend(rng.uniform(-5.0, 20.0), angle, rng.uniform(40.0, 70.0))], crossing=False)
    script = leave(stage, roads, right_lane(roads[0]), any_direction(rng))
    motion, n = script.motion, script.length
    times = np.arange(n) / FPS
    behind, ahead = rng.uniform(1.4, 2.3), -rng.uniform(1.6, 2.8)
    doubles = []
    for meet in (rng.uniform(0.3, 0.7), rng.uniform(0.8, 1.1)):  # of the way that is driven out of the picture
        moment = motion.zero + meet * stage.frames / FPS
        s = motion.arc(np.array([moment]))[0] - rng.uniform(8.0, 11.0) * (times - moment)
        centre = roads[0].centre
        ground, course = centre.at(np.clip(s, centre.begin, centre.end), -0.5 * LANE)
        doubles.append(cars.Car(ground, course + np.pi, stage.bgr))
    if np.linalg.norm(doubles[0].ground - doubles[1].ground, axis=1).min() < 9.0:
        doubles.pop()
    return Script(
        script.view, roads, motion, script.flight, n, followers_s=(behind, ahead), doubles=tuple(doubles), strangers=1
    )


def town(stage: Stage) -> Script:
    """Section 4.4 of the paper: crossings, buildings, other cars; the target turns, the drone flies its own route."""
    rng = stage.rng
    way, angle, roads = corner(stage, rng.uniform(-7.0, 1.0))
    script = leave(stage, roads, way, _straying(rng, stage.course, angle), swing=rng.uniform(-0.7, 0.7))
    return Script(script.view, roads, script.motion, script.flight, script.length, strangers=9)


def leave(stage: Stage, roads: list[Road], way: Curve, direction: Floats, swing: float = 0.0) -> Script:
    """The target leaves along ``direction`` (2,) about at arc length 0 and comes back. swing: slow yaw [rad]."""
    rng = stage.rng
    direction = direction / np.linalg.norm(direction)
    gone = _BEGIN_S + 0.8 * ramp_seconds(stage.view.border(direction) + 6.0)
    motion = Motion(way, gone, stage.cruise, rng.uniform(0.0, 6.28))
    leaving = Exit(direction, _BEGIN_S, rng.uniform(4.0, 5.0 + 0.1 * stage.frames))
    return _solved(stage, roads, motion, drift_off(motion, stage.view, leaving, swing))


def any_direction(rng: np.random.Generator) -> Floats:
    """A unit vector (2,)."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _solved(stage: Stage, roads: list[Road], motion: Motion, plan: Plan) -> Script:
    solved = solve(stage.rng, motion, stage.view, stage.frames, plan)
    return Script(stage.view, roads, motion, solved.flight, solved.out[1] + _TAIL_FRAMES)


def _straying(rng: np.random.Generator, course: float, angle: float) -> Floats:
    """Where the target leaves if the drone keeps to the old course: the change of course, and up to 40° beside."""
    new = course + angle
    change = np.array([np.cos(new) - np.cos(course), np.sin(new) - np.sin(course)])
    turn = rng.uniform(-0.7, 0.7)
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(np.array([[c, -s], [s, c]]) @ change)
