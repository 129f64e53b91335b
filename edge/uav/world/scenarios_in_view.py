"""In-view scenarios: the target stays in the image but is hard to see; and the flight of section 3.3 of the paper."""

from __future__ import annotations

import dataclasses

import numpy as np

from edge.uav.world import occluders
from edge.uav.world.flight import DisturbanceLevels, flight_over, grid_times, sample_disturbance
from edge.uav.world.flight_planner import (
    FPS,
    TargetMotion,
    chase_prediction,
    cosine_ramp,
    follow_target,
    hold_target_at,
    out_of_view_interval,
)
from edge.uav.world.noise import smoothed_noise
from edge.uav.world.occluders import Occluder
from edge.uav.world.roads import Bend, Curve, Road, curve_from_bends
from edge.uav.world.scenario_builder import (
    IN_VIEW_FRAMES,
    ROAD_BEGIN,
    ROAD_END,
    ScenarioInputs,
    ScenarioPlan,
    main_road,
    right_lane,
)
from protocols.geometry.types import Floats

_TENFOLD = (0.04, 0.4)  # ground sampling distance [m/px]


def trees(inputs: ScenarioInputs) -> ScenarioPlan:
    """Tree canopies cover the target's lane for 20 to 40 m, with gaps."""
    rng = inputs.rng
    roads, motion = _road(inputs)
    place = rng.uniform(-4.0, 4.0)
    end = place + rng.uniform(20.0, 40.0)
    crowns: list[Occluder] = []
    while place < end:
        at, _ = roads[0].centre.at(np.array([place]), rng.uniform(0.0, 3.5))
        radius = rng.uniform(2.0, 3.4)
        crowns.append(occluders.random_canopy(rng, at[0], radius, rng.uniform(4.5, 6.5)))
        place += radius + rng.uniform(2.0, 7.0)
    flight = follow_target(rng, motion, inputs.camera, IN_VIEW_FRAMES / FPS)
    return ScenarioPlan(inputs.camera, roads, motion, flight, IN_VIEW_FRAMES, scenario_occluders=tuple(crowns))


def bridge(inputs: ScenarioInputs) -> ScenarioPlan:
    """The target drives under a road bridge."""
    rng = inputs.rng
    roads, motion = _road(inputs)
    at, course = roads[0].centre.at(np.array([rng.uniform(5.0, 15.0)]))
    turned = float(course[0]) + np.pi / 2 + rng.uniform(-0.3, 0.3)
    deck = occluders.random_bridge(rng, at[0], turned, 170.0, rng.uniform(9.0, 14.0))
    flight = follow_target(rng, motion, inputs.camera, IN_VIEW_FRAMES / FPS)
    return ScenarioPlan(inputs.camera, roads, motion, flight, IN_VIEW_FRAMES, scenario_occluders=(deck,))


def lighting(inputs: ScenarioInputs) -> ScenarioPlan:
    """Cloud shadows pass, the exposure steps up and down, the white balance drifts."""
    rng = inputs.rng
    roads, motion = _road(inputs)
    moments = np.arange(IN_VIEW_FRAMES, dtype=np.float64)
    gain = np.ones(IN_VIEW_FRAMES)
    now = 1.0
    for start in (60, 105, 150, 195):
        new = rng.uniform(0.5, 0.7) if now > 0.8 else rng.uniform(0.95, 1.25)
        gain = gain + (new - now) * cosine_ramp((moments - start - rng.uniform(-12, 12)) / rng.uniform(4, 25))
        now = new
    tint = 1.0 + np.column_stack([smoothed_noise(rng, IN_VIEW_FRAMES, 1 / FPS, 0.06, 1.5) for _ in range(3)])
    flight = follow_target(rng, motion, inputs.camera, IN_VIEW_FRAMES / FPS)
    return ScenarioPlan(inputs.camera, roads, motion, flight, IN_VIEW_FRAMES, gain=gain[:, None] * tint, clouds=0.4)


def off_road(inputs: ScenarioInputs) -> ScenarioPlan:
    """The target leaves the road, drives over grass, and comes back."""
    rng = inputs.rng
    roads, motion = _road(inputs, crossing=False)
    start, stay, far = rng.uniform(-12.0, 0.0), rng.uniform(5.0, 20.0), rng.choice([-1.0, 1.0]) * rng.uniform(8.0, 13.0)

    def lateral_offset(s: Floats) -> Floats:
        return np.asarray(far * (cosine_ramp((s - start) / 22.0) - cosine_ramp((s - start - 22.0 - stay) / 22.0)))

    motion = dataclasses.replace(motion, cruise=0.75 * motion.cruise, lateral_offset=lateral_offset)
    s = motion.path.arc
    away = np.abs(lateral_offset(s)) > 1.0
    normal = np.column_stack([-np.sin(motion.path.course), np.cos(motion.path.course)])
    path = Curve(
        float(s[away][0]), (motion.path.points + lateral_offset(s)[:, None] * normal)[away], motion.path.course[away]
    )
    flight = follow_target(rng, motion, inputs.camera, IN_VIEW_FRAMES / FPS)
    return ScenarioPlan(inputs.camera, roads, motion, flight, IN_VIEW_FRAMES, keep_clear=(path,))


def partial(inputs: ScenarioInputs) -> ScenarioPlan:
    """The target stays on the image border, cut about in half, for the requested number of frames."""
    rng = inputs.rng
    roads, motion = _road(inputs)
    border_frames = inputs.frames
    length = 70 + border_frames + 70
    times = grid_times(length / FPS)
    size = np.array([inputs.camera.lens.width, inputs.camera.lens.height])
    axis, sign = int(rng.integers(2)), rng.choice([-1.0, 1.0])
    start, end = 70 / FPS, (70 + border_frames) / FPS
    there = cosine_ramp((times - start + 1.1) / 1.1) - cosine_ramp((times - end) / 1.1)
    inset = 1.0 + smoothed_noise(rng, len(times), times[1] - times[0], 2.5, 0.4)
    pixels = np.tile(0.5 * (size - 1.0), (len(times), 1))
    pixels[:, axis] += sign * there * (0.5 * size[axis] - inset)
    pixels[:, 1 - axis] += there * rng.uniform(-0.3, 0.3) * size[1 - axis]
    flight = hold_target_at(motion, inputs.camera, times, pixels, sample_disturbance(rng, times, DisturbanceLevels()))
    return ScenarioPlan(inputs.camera, roads, motion, flight, length)


def cut(inputs: ScenarioInputs) -> ScenarioPlan:
    """The target is cut about in half by the image border in the first frame, then enters and stays."""
    rng = inputs.rng
    roads, motion = _road(inputs)
    times = grid_times(IN_VIEW_FRAMES / FPS)
    size = np.array([inputs.camera.lens.width, inputs.camera.lens.height])
    axis, sign = int(rng.integers(2)), rng.choice([-1.0, 1.0])
    there = 1.0 - cosine_ramp((times - 0.3) / rng.uniform(0.8, 2.0))
    pixels = np.tile(0.5 * (size - 1.0), (len(times), 1))
    pixels[:, axis] += sign * there * (0.5 * size[axis] - rng.uniform(0.0, 4.0))
    pixels[:, 1 - axis] += there * rng.uniform(-0.3, 0.3) * size[1 - axis]
    flight = hold_target_at(motion, inputs.camera, times, pixels, sample_disturbance(rng, times, DisturbanceLevels()))
    return ScenarioPlan(inputs.camera, roads, motion, flight, IN_VIEW_FRAMES)


def climb(inputs: ScenarioInputs) -> ScenarioPlan:
    """The drone climbs (or sinks) tenfold: the target is some 110 px long and 11 px, or the other way round."""
    rng = inputs.rng
    roads, motion = _road(inputs)
    times = grid_times(IN_VIEW_FRAMES / FPS)
    low, high = (metres * inputs.camera.lens.focal for metres in _TENFOLD)
    share = cosine_ramp((times - 1.0) / (IN_VIEW_FRAMES / FPS - 2.0))
    if rng.random() < 0.5:
        share = 1.0 - share
    # Exponential in time, so that the image scale changes at a constant relative rate.
    altitude = low * (high / low) ** share
    camera = dataclasses.replace(inputs.camera, altitude=high)
    ground, _ = motion.at(times)
    yaw = np.full(len(times), camera.yaw)
    calm = DisturbanceLevels(position_m=0.3, altitude_m=0.3)
    flight = flight_over(times, ground, yaw, altitude, sample_disturbance(rng, times, calm), camera.body_from_camera)
    return ScenarioPlan(camera, roads, motion, flight, IN_VIEW_FRAMES)


def far(inputs: ScenarioInputs) -> ScenarioPlan:
    """High altitude: the target is about 10 px long and stays in view."""
    rng = inputs.rng
    roads, motion = _road(inputs)
    camera = dataclasses.replace(inputs.camera, altitude=rng.uniform(0.42, 0.47) * inputs.camera.lens.focal)
    flight = follow_target(rng, motion, camera, IN_VIEW_FRAMES / FPS)
    return ScenarioPlan(camera, roads, motion, flight, IN_VIEW_FRAMES)


def winding(inputs: ScenarioInputs) -> ScenarioPlan:
    """Section 3.3 of the paper: a winding road and a drone whose simple controller loses the car in a bend.

    The controller flies to where the car would be had it kept course and speed for ``delay`` seconds; the delay is the
    shortest at which the car is out of view for at least 20 consecutive frames. It uses the ground truth, so
    that the flight does not depend on a tracker. The drone flies lower, at 0.075 m/px.
    """
    rng = inputs.rng
    camera = dataclasses.replace(inputs.camera, altitude=0.75 * inputs.camera.altitude, offset=np.zeros(2))
    bends, place, side = [], rng.uniform(0.0, 8.0), rng.choice([-1.0, 1.0])
    for _ in range(5):
        bends.append(Bend(place, side * rng.uniform(np.deg2rad(80.0), np.deg2rad(125.0)), rng.uniform(18.0, 28.0)))
        place += bends[-1].length + rng.uniform(12.0, 28.0)
        side = -side
    roads = [main_road(inputs, [], crossing=False)[0]]
    roads[0] = dataclasses.replace(roads[0], centre=curve_from_bends(bends, ROAD_BEGIN, ROAD_END, inputs.course))
    motion = TargetMotion(right_lane(roads[0]), 2.0, inputs.cruise, rng.uniform(0.0, 6.28))
    times = grid_times((IN_VIEW_FRAMES + 60) / FPS)
    disturbance = sample_disturbance(rng, times, DisturbanceLevels())
    for delay in np.arange(1.5, 7.0, 0.25):
        flight = chase_prediction(motion, camera, times, float(delay), disturbance)
        out = out_of_view_interval(camera, flight, motion, IN_VIEW_FRAMES + 60)
        if out[1] - out[0] >= 20:
            break
    return ScenarioPlan(camera, roads, motion, flight, IN_VIEW_FRAMES + 60)


def _road(inputs: ScenarioInputs, crossing: bool = True) -> tuple[list[Road], TargetMotion]:
    """A road with a gentle bend and the target on its right lane, at arc length 0 after 2.5 s."""
    rng = inputs.rng
    mild = Bend(rng.uniform(15.0, 40.0), rng.uniform(-0.6, 0.6), rng.uniform(50.0, 90.0))
    roads = main_road(inputs, [mild], crossing)
    return roads, TargetMotion(right_lane(roads[0]), 2.5, inputs.cruise, rng.uniform(0.0, 6.28))
