"""Registry of the town scenarios by name: ``get("exit-bend", seed=3, frames=60)``."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edge.uav.world import cars, scenarios_exit, scenarios_in_view
from edge.uav.world.flight import Flight
from edge.uav.world.flight_planner import FPS, CameraSetup
from edge.uav.world.flight_world import FlightWorld, camera_poses
from edge.uav.world.ground_texture import Area
from edge.uav.world.noise import smoothed_noise
from edge.uav.world.rendering import Illumination
from edge.uav.world.roads import LANE, Road
from edge.uav.world.scenario_builder import ScenarioInputs, ScenarioPlan, sample_camera
from edge.uav.world.town import build_town
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

_UNOCCLUDED_FRAMES = 33  # initial frames in which no building or tree occludes the target


@dataclass(frozen=True, slots=True)
class Scenario:
    """An entry of the registry. frames: default number, None: not selectable. about: one line."""

    make_plan: Callable[[ScenarioInputs], ScenarioPlan]
    frames: int | None
    about: str


SCENARIOS = {
    "exit-straight": Scenario(scenarios_exit.straight_road, 45, "out of view on a straight road"),
    "exit-bend": Scenario(scenarios_exit.bend, 60, "out of view in a bend"),
    "turn-out-of-view": Scenario(scenarios_exit.turn_out_of_view, 75, "turns off at a crossing while out of view"),
    "yaw": Scenario(scenarios_exit.yaw, 45, "out of view because the drone yaws"),
    "distractors": Scenario(scenarios_exit.distractors, 60, "out of view among cars of the same colour"),
    "trees": Scenario(scenarios_in_view.trees, None, "under trees"),
    "bridge": Scenario(scenarios_in_view.bridge, None, "under a bridge"),
    "lighting": Scenario(scenarios_in_view.lighting, None, "the illumination changes"),
    "off-road": Scenario(scenarios_in_view.off_road, None, "drives over grass"),
    "partial": Scenario(scenarios_in_view.partial, 90, "cut in half by the image border"),
    "cut": Scenario(scenarios_in_view.cut, None, "cut in half by the image border in the first frame"),
    "climb": Scenario(scenarios_in_view.climb, None, "the drone climbs or sinks tenfold"),
    "far": Scenario(scenarios_in_view.far, None, "10 px long, from high above"),
    "paper-3.3": Scenario(scenarios_in_view.winding, None, "a winding road, a drone with a simple controller"),
    "paper-4.4": Scenario(scenarios_exit.town, 60, "crossings, buildings, many cars; only the car turns"),
}


def get(name: str, seed: int, size: tuple[int, int] = (640, 480), frames: int | None = None) -> FlightWorld:
    """The world of a scenario; the same arguments always give the same one.

    size: width, height [px]. frames: for how many frames (5 to 300) no part of the target is in the image (of
    ``partial``: for how many it is cut by the border); None: the scenario's default.
    Raises InputError for an unknown name, an invalid size or number, or frames given to a scenario without exit.
    """
    if name not in SCENARIOS:
        raise InputError(f"there is no scenario {name!r}", remedy=f"use one of {', '.join(SCENARIOS)}")
    scenario = SCENARIOS[name]
    if frames is not None and scenario.frames is None:
        raise InputError(f"scenario {name} has no selectable number of frames", remedy="omit frames")
    wanted = scenario.frames if frames is None else frames
    if wanted is not None and not 5 <= wanted <= 300:
        raise InputError(f"{wanted} frames out of view are out of range", remedy="give 5 to 300")
    if not (160 <= size[0] <= 4096 and 120 <= size[1] <= 4096):
        raise InputError(f"an image of {size[0]}x{size[1]} is out of range", remedy="give 160x120 to 4096x4096")
    if seed < 0:
        raise InputError(f"seed {seed} is negative", remedy="give 0 or more")
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), wanted or 0, *size])
    colour = list(cars.COLOURS_BGR)[int(rng.integers(len(cars.COLOURS_BGR)))]
    course, cruise = rng.uniform(-np.pi, np.pi), rng.uniform(8.0, 12.5)
    inputs = ScenarioInputs(rng, sample_camera(rng, size), wanted or 0, colour, course, cruise)
    return _build_world(name, seed, inputs, scenario.make_plan(inputs))


def _build_world(name: str, seed: int, inputs: ScenarioInputs, plan: ScenarioPlan) -> FlightWorld:
    """Build the town within the field of view of the flight, and add other traffic."""
    rng, n, camera = inputs.rng, plan.length, plan.camera
    area = _visible_area(camera, plan.flight, n)
    target = plan.motion.car(n, inputs.bgr)
    town = build_town(
        rng,
        area,
        plan.roads,
        scenario_occluders=plan.scenario_occluders,
        keep_clear=plan.keep_clear,
        not_colour=inputs.colour,
        sight_lines=_initial_sight_lines(camera, plan.flight, target),
    )
    lookalikes = [plan.motion.car(n, inputs.bgr, delay) for delay in plan.lookalike_delays_s]
    traffic = [*lookalikes, *plan.lookalikes]
    traffic += _other_traffic(rng, plan.roads, area, n, [target, *traffic], inputs.colour, plan.other_traffic_tries)
    gain = np.ones((n, 3)) if plan.gain is None else plan.gain
    gain = gain * (1.0 + smoothed_noise(rng, n, 1.0 / FPS, 0.02, 1.0)[:, None])
    return FlightWorld(
        name=name,
        seed=seed,
        length=n,
        fps=FPS,
        lens=camera.lens,
        body_from_camera=camera.body_from_camera,
        flight=plan.flight,
        town=town,
        target=target,
        traffic=tuple(traffic),
        illumination=Illumination(gain, plan.clouds),
    )


def _initial_sight_lines(camera: CameraSetup, flight: Flight, target: cars.Car) -> list[tuple[Floats, Floats]]:
    """Camera positions and target points of the first frames, while a tracker initialises."""
    frames = np.arange(0, _UNOCCLUDED_FRAMES, 4)
    _, position = camera_poses(flight, camera.body_from_camera, frames / FPS)
    return list(zip(position, cars.body_points_batch(target.ground[frames], target.course[frames]), strict=True))


def _visible_area(camera: CameraSetup, flight: Flight, length: int) -> Area:
    """The ground area within the field of view of any frame, with a margin."""
    turned, position = camera_poses(flight, camera.body_from_camera, np.arange(0, length, 4) / FPS)
    w, h = camera.lens.width, camera.lens.height
    rays = np.linalg.inv(camera.lens.matrix) @ np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1.0]]).T
    world = np.einsum("nji,jk->nki", turned, rays)
    ground = position[:, None, :2] - position[:, None, 2:] * world[..., :2] / world[..., 2:]
    low, high = ground.min(axis=(0, 1)) - 14.0, ground.max(axis=(0, 1)) + 14.0
    return Area((float(low[0]), float(high[0])), (float(low[1]), float(high[1])))


def _other_traffic(
    rng: np.random.Generator, roads: list[Road], area: Area, n: int, known: list[cars.Car], not_colour: str, tries: int
) -> list[cars.Car]:
    """Other traffic: cars that collide neither with the ``known`` cars nor with each other."""
    times = np.arange(n) / FPS
    colours = [name for name in cars.COLOURS_BGR if name != not_colour]
    out: list[cars.Car] = []
    for road in roads:
        for _ in range(tries):
            back = -1.0 if rng.random() < 0.6 else 1.0
            s = rng.uniform(road.centre.begin, road.centre.end) + back * rng.uniform(6.0, 13.0) * times
            ground, course = road.centre.at(np.clip(s, road.centre.begin, road.centre.end), back * 0.5 * LANE)
            colour = cars.COLOURS_BGR[colours[int(rng.integers(len(colours)))]]
            new = cars.Car(ground, course if back > 0 else course + np.pi, colour)
            if area.contains(ground).any() and _keeps_distance(new, [*known, *out]):
                out.append(new)
    return out


def _keeps_distance(car: cars.Car, others: list[cars.Car]) -> bool:
    """Whether a car never comes near another one, except in the opposite lane."""
    for other in others:
        gap = other.ground - car.ground
        ahead = np.cos(other.course - car.course)
        far = np.linalg.norm(gap, axis=1)
        if (far < np.where(ahead < -0.9, 2.6, 8.0)).any():
            return False
    return True
