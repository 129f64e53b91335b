"""Exit scenarios: the target leaves the field of view and comes back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.uav.world import cars
from edge.uav.world.flight_planner import (
    FPS,
    ExitManoeuvre,
    FlightPlan,
    TargetMotion,
    drift_exit,
    ramp_duration,
    solve_exit,
    yaw_exit,
)
from edge.uav.world.roads import LANE, Bend, Curve, Road
from edge.uav.world.scenario_builder import (
    ScenarioInputs,
    ScenarioPlan,
    main_road,
    right_lane,
    right_normal,
    turn_at_crossing,
)
from protocols.geometry.types import Floats

_BEGIN_S = 1.7  # when the exit manoeuvre begins
_TAIL_FRAMES = 75  # after the target has returned
_YAW_BEGIN_S = 2.4  # the same of a yaw


def straight_road(inputs: ScenarioInputs) -> ScenarioPlan:
    """The drone drifts off, in any direction, from a car on a straight road."""
    roads = main_road(inputs, [])
    return exit_scenario(inputs, roads, right_lane(roads[0]), any_direction(inputs.rng))


def bend(inputs: ScenarioInputs) -> ScenarioPlan:
    """The road bends about where the target leaves; the drone keeps about its course."""
    rng = inputs.rng
    angle = rng.choice([-1.0, 1.0]) * rng.uniform(np.deg2rad(50.0), np.deg2rad(100.0))
    first = Bend(rng.uniform(-6.0, 5.0), angle, rng.uniform(16.0, 36.0))
    second = Bend(first.start + first.length + rng.uniform(15.0, 40.0), -0.6 * angle, rng.uniform(25.0, 60.0))
    roads = main_road(inputs, [first, second])
    return exit_scenario(inputs, roads, right_lane(roads[0]), _drift_direction(rng, inputs.course, angle))


def turn_out_of_view(inputs: ScenarioInputs) -> ScenarioPlan:
    """The target turns at a crossing that was in view before, while the target itself is out of view."""
    rng = inputs.rng
    path, _, roads = turn_at_crossing(inputs, rng.uniform(-1.0, 5.0))
    side = rng.choice([-1.0, 1.0]) * right_normal(inputs.course)
    back = -rng.uniform(0.0, 0.5) * np.array([np.cos(inputs.course), np.sin(inputs.course)])
    return exit_scenario(inputs, roads, path, side + back)


def yaw(inputs: ScenarioInputs) -> ScenarioPlan:
    """The drone yaws, so that a target near a side of the image leaves at the top or bottom."""
    roads = main_road(inputs, [])
    angle = inputs.rng.choice([-1.0, 1.0]) * inputs.rng.uniform(np.deg2rad(80.0), np.deg2rad(105.0))
    motion = TargetMotion(right_lane(roads[0]), _YAW_BEGIN_S, inputs.cruise, inputs.rng.uniform(0.0, 6.28))
    return _solved_scenario(inputs, roads, motion, yaw_exit(motion, inputs.camera, _YAW_BEGIN_S, angle))


def distractors(inputs: ScenarioInputs) -> ScenarioPlan:
    """Cars of the target's colour follow it, drive ahead of it and pass it while it is out of view."""
    rng = inputs.rng
    angle = rng.choice([-1.0, 1.0]) * rng.uniform(0.0, np.deg2rad(40.0))
    roads = main_road(inputs, [Bend(rng.uniform(-5.0, 20.0), angle, rng.uniform(40.0, 70.0))], crossing=False)
    plan = exit_scenario(inputs, roads, right_lane(roads[0]), any_direction(rng))
    motion = plan.motion
    times = np.arange(plan.length) / FPS
    behind, ahead = rng.uniform(1.4, 2.3), -rng.uniform(1.6, 2.8)
    lookalikes = []
    for meet in (rng.uniform(0.3, 0.7), rng.uniform(0.8, 1.1)):  # shares of the out-of-view time
        moment = motion.start_time + meet * inputs.frames / FPS
        s = motion.arc(np.array([moment]))[0] - rng.uniform(8.0, 11.0) * (times - moment)
        centre = roads[0].centre
        ground, course = centre.at(np.clip(s, centre.begin, centre.end), -0.5 * LANE)
        lookalikes.append(cars.Car(ground, course + np.pi, inputs.bgr))
    if np.linalg.norm(lookalikes[0].ground - lookalikes[1].ground, axis=1).min() < 9.0:
        lookalikes.pop()
    return replace(plan, lookalike_delays_s=(behind, ahead), lookalikes=tuple(lookalikes), other_traffic_tries=1)


def town(inputs: ScenarioInputs) -> ScenarioPlan:
    """Section 4.4 of the paper: crossings, buildings, other cars; the target turns, the drone flies its own route."""
    rng = inputs.rng
    path, angle, roads = turn_at_crossing(inputs, rng.uniform(-7.0, 1.0))
    plan = exit_scenario(
        inputs, roads, path, _drift_direction(rng, inputs.course, angle), yaw_change=rng.uniform(-0.7, 0.7)
    )
    return replace(plan, other_traffic_tries=9)


def exit_scenario(
    inputs: ScenarioInputs, roads: list[Road], path: Curve, direction: Floats, yaw_change: float = 0.0
) -> ScenarioPlan:
    """The target leaves along ``direction`` (2,) about at arc length 0 and comes back. yaw_change: slow [rad]."""
    rng = inputs.rng
    direction = direction / np.linalg.norm(direction)
    gone = _BEGIN_S + 0.8 * ramp_duration(inputs.camera.border(direction) + 6.0)
    motion = TargetMotion(path, gone, inputs.cruise, rng.uniform(0.0, 6.28))
    leaving = ExitManoeuvre(direction, _BEGIN_S, rng.uniform(4.0, 5.0 + 0.1 * inputs.frames))
    return _solved_scenario(inputs, roads, motion, drift_exit(motion, inputs.camera, leaving, yaw_change))


def any_direction(rng: np.random.Generator) -> Floats:
    """A random unit vector (2,)."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _solved_scenario(inputs: ScenarioInputs, roads: list[Road], motion: TargetMotion, plan: FlightPlan) -> ScenarioPlan:
    flight, out_of_view = solve_exit(inputs.rng, motion, inputs.camera, inputs.frames, plan)
    return ScenarioPlan(inputs.camera, roads, motion, flight, out_of_view[1] + _TAIL_FRAMES)


def _drift_direction(rng: np.random.Generator, course: float, angle: float) -> Floats:
    """Exit direction if the drone keeps the old course: the change of course, rotated randomly by up to 40°."""
    new = course + angle
    change = np.array([np.cos(new) - np.cos(course), np.sin(new) - np.sin(course)])
    turn = rng.uniform(-0.7, 0.7)
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(np.array([[c, -s], [s, c]]) @ change)
