"""Scenarios in which the target stays in the picture (but is hard to see), and the paper's own flight."""

from __future__ import annotations

import dataclasses

import numpy as np

from edge.uav.world import occluders
from edge.uav.world.flight import Shake, fly, grid_times, unrest
from edge.uav.world.flight_planner import FPS, Motion, chase, ease, follow, hold_at, out_of_picture
from edge.uav.world.noise import wander
from edge.uav.world.occluders import Solid
from edge.uav.world.roads import Bend, Curve, Road, curve
from edge.uav.world.scenario_builder import AHEAD, BEHIND, RIDE_FRAMES, Script, Stage, along, right_lane
from protocols.geometry.types import Floats

_TENFOLD = (0.04, 0.4)  # metres on the ground a pixel


def trees(stage: Stage) -> Script:
    """Crowns of trees hang over the target's lane for 20 to 40 m, with gaps."""
    rng = stage.rng
    roads, motion = _road(stage)
    place = rng.uniform(-4.0, 4.0)
    end = place + rng.uniform(20.0, 40.0)
    crowns: list[Solid] = []
    while place < end:
        at, _ = roads[0].centre.at(np.array([place]), rng.uniform(0.0, 3.5))
        radius = rng.uniform(2.0, 3.4)
        crowns.append(occluders.canopy(rng, at[0], radius, rng.uniform(4.5, 6.5)))
        place += radius + rng.uniform(2.0, 7.0)
    flight = follow(rng, motion, stage.view, RIDE_FRAMES / FPS)
    return Script(stage.view, roads, motion, flight, RIDE_FRAMES, special=tuple(crowns))


def bridge(stage: Stage) -> Script:
    """The target drives under a road bridge."""
    rng = stage.rng
    roads, motion = _road(stage)
    at, course = roads[0].centre.at(np.array([rng.uniform(5.0, 15.0)]))
    turned = float(course[0]) + np.pi / 2 + rng.uniform(-0.3, 0.3)
    deck = occluders.bridge(rng, at[0], turned, 170.0, rng.uniform(9.0, 14.0))
    flight = follow(rng, motion, stage.view, RIDE_FRAMES / FPS)
    return Script(stage.view, roads, motion, flight, RIDE_FRAMES, special=(deck,))


def lighting(stage: Stage) -> Script:
    """Shadows of clouds pass, the exposure jumps up and down, the white balance drifts."""
    rng = stage.rng
    roads, motion = _road(stage)
    moments = np.arange(RIDE_FRAMES, dtype=np.float64)
    gain = np.ones(RIDE_FRAMES)
    now = 1.0
    for start in (60, 105, 150, 195):
        new = rng.uniform(0.5, 0.7) if now > 0.8 else rng.uniform(0.95, 1.25)
        gain = gain + (new - now) * ease((moments - start - rng.uniform(-12, 12)) / rng.uniform(4, 25))
        now = new
    tint = 1.0 + np.column_stack([wander(rng, RIDE_FRAMES, 1 / FPS, 0.06, 1.5) for _ in range(3)])
    flight = follow(rng, motion, stage.view, RIDE_FRAMES / FPS)
    return Script(stage.view, roads, motion, flight, RIDE_FRAMES, gain=gain[:, None] * tint, clouds=0.4)


def off_road(stage: Stage) -> Script:
    """The target leaves the road, drives over grass, and comes back."""
    rng = stage.rng
    roads, motion = _road(stage, crossing=False)
    start, stay, far = rng.uniform(-12.0, 0.0), rng.uniform(5.0, 20.0), rng.choice([-1.0, 1.0]) * rng.uniform(8.0, 13.0)

    def aside(s: Floats) -> Floats:
        return np.asarray(far * (ease((s - start) / 22.0) - ease((s - start - 22.0 - stay) / 22.0)))

    motion = dataclasses.replace(motion, cruise=0.75 * motion.cruise, aside=aside)
    s = motion.path.arc
    away = np.abs(aside(s)) > 1.0
    normal = np.column_stack([-np.sin(motion.path.course), np.cos(motion.path.course)])
    way = Curve(float(s[away][0]), (motion.path.points + aside(s)[:, None] * normal)[away], motion.path.course[away])
    flight = follow(rng, motion, stage.view, RIDE_FRAMES / FPS)
    return Script(stage.view, roads, motion, flight, RIDE_FRAMES, keep_clear=(way,))


def partial(stage: Stage) -> Script:
    """The target rides on the picture's border, cut about in half, for so many frames."""
    rng = stage.rng
    roads, motion = _road(stage)
    ride = stage.frames
    length = 70 + ride + 70
    times = grid_times(length / FPS)
    size = np.array([stage.view.lens.width, stage.view.lens.height])
    axis, sign = int(rng.integers(2)), rng.choice([-1.0, 1.0])
    start, end = 70 / FPS, (70 + ride) / FPS
    there = ease((times - start + 1.1) / 1.1) - ease((times - end) / 1.1)
    inset = 1.0 + wander(rng, len(times), times[1] - times[0], 2.5, 0.4)
    pixels = np.tile(0.5 * (size - 1.0), (len(times), 1))
    pixels[:, axis] += sign * there * (0.5 * size[axis] - inset)
    pixels[:, 1 - axis] += there * rng.uniform(-0.3, 0.3) * size[1 - axis]
    flight = hold_at(motion, stage.view, times, pixels, unrest(rng, times, Shake()))
    return Script(stage.view, roads, motion, flight, length)


def cut(stage: Stage) -> Script:
    """The target is cut about in half by the picture's border in the first frame, then comes in and stays."""
    rng = stage.rng
    roads, motion = _road(stage)
    times = grid_times(RIDE_FRAMES / FPS)
    size = np.array([stage.view.lens.width, stage.view.lens.height])
    axis, sign = int(rng.integers(2)), rng.choice([-1.0, 1.0])
    there = 1.0 - ease((times - 0.3) / rng.uniform(0.8, 2.0))
    pixels = np.tile(0.5 * (size - 1.0), (len(times), 1))
    pixels[:, axis] += sign * there * (0.5 * size[axis] - rng.uniform(0.0, 4.0))
    pixels[:, 1 - axis] += there * rng.uniform(-0.3, 0.3) * size[1 - axis]
    flight = hold_at(motion, stage.view, times, pixels, unrest(rng, times, Shake()))
    return Script(stage.view, roads, motion, flight, RIDE_FRAMES)


def climb(stage: Stage) -> Script:
    """The drone climbs (or sinks) tenfold: the target is some 110 px long and 11 px, or the other way round."""
    rng = stage.rng
    roads, motion = _road(stage)
    times = grid_times(RIDE_FRAMES / FPS)
    low, high = (metres * stage.view.lens.focal for metres in _TENFOLD)
    share = ease((times - 1.0) / (RIDE_FRAMES / FPS - 2.0))
    if rng.random() < 0.5:
        share = 1.0 - share
    # By equal factors in equal times: what is seen grows or shrinks evenly.
    altitude = low * (high / low) ** share
    view = dataclasses.replace(stage.view, altitude=high)
    ground, _ = motion.at(times)
    yaw = np.full(len(times), view.yaw)
    calm = Shake(position_m=0.3, altitude_m=0.3)
    flight = fly(times, ground, yaw, altitude, unrest(rng, times, calm), view.body_from_camera)
    return Script(view, roads, motion, flight, RIDE_FRAMES)


def far(stage: Stage) -> Script:
    """From high above: the target is about 10 px long, and stays in the picture."""
    rng = stage.rng
    roads, motion = _road(stage)
    view = dataclasses.replace(stage.view, altitude=rng.uniform(0.42, 0.47) * stage.view.lens.focal)
    flight = follow(rng, motion, view, RIDE_FRAMES / FPS)
    return Script(view, roads, motion, flight, RIDE_FRAMES)


def winding(stage: Stage) -> Script:
    """Section 3.3 of the paper: a winding road and a drone whose simple controller loses the car when it bends.

    The controller flies to where the car would be had it kept course and speed for ``delay`` seconds; the delay is the
    shortest at which the car is out of the picture for 20 frames and more in one piece. It is fed with the truth, so
    that the flight does not depend on a tracker. The drone flies lower, at 0.075 m a pixel.
    """
    rng = stage.rng
    view = dataclasses.replace(stage.view, altitude=0.75 * stage.view.altitude, offset=np.zeros(2))
    bends, place, side = [], rng.uniform(0.0, 8.0), rng.choice([-1.0, 1.0])
    for _ in range(5):
        bends.append(Bend(place, side * rng.uniform(np.deg2rad(80.0), np.deg2rad(125.0)), rng.uniform(18.0, 28.0)))
        place += bends[-1].length + rng.uniform(12.0, 28.0)
        side = -side
    roads = [along(stage, [], crossing=False)[0]]
    roads[0] = dataclasses.replace(roads[0], centre=curve(bends, BEHIND, AHEAD, stage.course))
    motion = Motion(right_lane(roads[0]), 2.0, stage.cruise, rng.uniform(0.0, 6.28))
    times = grid_times((RIDE_FRAMES + 60) / FPS)
    shaking = unrest(rng, times, Shake())
    for delay in np.arange(1.5, 7.0, 0.25):
        flight = chase(motion, view, times, float(delay), shaking)
        out = out_of_picture(view, flight, motion, RIDE_FRAMES + 60)
        if out[1] - out[0] >= 20:
            break
    return Script(view, roads, motion, flight, RIDE_FRAMES + 60)


def _road(stage: Stage, crossing: bool = True) -> tuple[list[Road], Motion]:
    """A road with a mild bend somewhere and the target on its right lane, at arc length 0 after 2.5 s."""
    rng = stage.rng
    mild = Bend(rng.uniform(15.0, 40.0), rng.uniform(-0.6, 0.6), rng.uniform(50.0, 90.0))
    roads = along(stage, [mild], crossing)
    return roads, Motion(right_lane(roads[0]), 2.5, stage.cruise, rng.uniform(0.0, 6.28))
