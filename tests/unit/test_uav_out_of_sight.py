"""What is believed of a car out of sight: where it may be hidden, how fast it goes on, in which lane."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from edge.uav.ground.road_map import CELL, RoadMap
from edge.uav.prediction import particle_set as clouds
from edge.uav.prediction.particle_set import Cloud
from edge.uav.prediction.paths import Way, edges, trace
from edge.uav.target.appearance import Candidate
from edge.uav.target.likelihood import judge
from edge.uav.target.motion_history import MotionFit
from edge.uav.target.tracklets import Tracklet, Tracklets
from edge.uav.world import cars
from edge.uav.world.roads import LANE
from edge.uav.world.scenario_builder import Stage, corner, view
from protocols.geometry.types import Floats


def painted(near: object) -> RoadMap:
    """A map about the origin by a function of ground points (n, 2) that gives log-odds."""
    assert callable(near)
    road = RoadMap(np.zeros(2))
    rows, columns = np.mgrid[0:1024, 0:1024]
    points = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * CELL + road._origin
    road._odds[:] = near(points).reshape(1024, 1024)
    return road


def crossing(points: Floats) -> Floats:
    """A road 7 wide along X, crossed by another at X = 25."""
    return np.where((np.abs(points[:, 1]) < 3.5) | (np.abs(points[:, 0] - 25.0) < 3.5), 3.0, -3.0)


def fit_of(speed: float, along: float, std: float) -> MotionFit:
    return MotionFit(0.0, np.zeros(2), np.array([speed, 0.0]), np.array([along, 0.0]), 0.2, std, 0.05, 20)


def driving(rng: np.random.Generator, speed: float) -> Cloud:
    cloud = clouds.scattered(np.zeros(2), 0.5, 400, rng)
    return replace(cloud, heading=rng.normal(0.0, 0.05, 400), speed=np.full(400, speed))


def met(score: float, shape: float) -> float:
    """Share of a cloud's weight that is left within a length of something that it comes to, seen there long before."""
    rng = np.random.default_rng(0)
    cloud = driving(rng, 10.0)
    cloud = replace(cloud, place=cloud.place + np.where(np.arange(400) % 2, 0.0, 8.0)[:, None] * [1.0, 0.0])
    found = Candidate(np.array([0.0, 2.0]), score, score, shape, 1.0)
    tracks: list[Tracklet] = []
    tracklets = Tracklets()
    for k in range(6):
        tracks = tracklets.update(k / 30, [found])
    tracks[0].odds_limit = 0.0
    verdict = judge(cloud, [found], tracks, np.full(400, 0.03), lambda _: (0.25, 0.25), 4.5, True, lambda _: False)
    assert verdict.likelihood is not None
    cloud = cloud.weighted(verdict.likelihood)
    about = np.square(cloud.place - found.ground).sum(axis=1) < 4.5**2
    return float(cloud.weights[about].sum())


def test_a_cloud_that_drives_by_a_leaf_a_little_alike_is_not_driven_off() -> None:
    """Under trees such spots took all weight from the particles that came near, and only who had braked was left."""
    assert met(0.4, 0.2) == pytest.approx(0.5, abs=0.02)
    assert met(0.9, 0.9) < 0.01  # where another car stands, the target is not


def test_the_road_that_was_seen_stays_known_in_a_new_ground_frame() -> None:
    """It was forgotten when telemetry gave a better frame, and a car that left just then had no road to drive on."""
    old = painted(lambda points: np.where(np.abs(points[:, 1]) < 3.5, 3.0, -3.0))
    angle, scale, shift = 0.6, 1.3, np.array([40.0, -25.0])
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    change = np.array([[c, -s, shift[0]], [s, c, shift[1]], [0.0, 0.0, 1.0]])
    new = RoadMap(shift)
    new.take(old, change)
    along = np.column_stack([np.linspace(-50.0, 50.0, 41), np.zeros(41)])
    for aside, odds in ((0.0, 3.0), (2.5, 3.0), (-2.5, 3.0), (4.5, -3.0), (-4.5, -3.0)):
        points = (along + [0.0, aside]) @ change[:2, :2].T + shift
        assert new.at(points) == pytest.approx(np.full(41, odds))


def test_a_turn_ends_in_the_lane_on_the_side_on_which_the_car_drives() -> None:
    road = painted(crossing)
    road.prepare(np.array([0.0, 1.7]), 75.0)
    for lane in (1.7, -1.7):  # where they drive on the right, and on the left
        right, left = edges(road, np.array([[0.0, lane]]), np.zeros(1))
        ways = trace(road, np.array([0.0, lane]), 0.0, 0.0, 60.0, (float(right[0]), float(left[0])))
        ends = {round(float(np.sign(way.points[-1, 1]))): way.points[-4:, 0] for way in ways[1:]}
        assert set(ends) == {-1, 1}
        for side, x in ends.items():
            # Driving to +Y, the right is at -X of the road's middle.
            assert np.mean(x) == pytest.approx(25.0 - side * lane, abs=0.9)


def test_who_does_not_brake_before_a_bend_takes_it_fast() -> None:
    rng = np.random.default_rng(0)
    headings = np.arange(0, 120, 1.5) / 20.0
    steps = 1.5 * np.column_stack([np.cos(headings), np.sin(headings)])
    way = Way(np.vstack([np.zeros(2), np.cumsum(steps, axis=0)[:-1]]), headings, 120.0, 1.0)
    cloud = clouds.on_ways(driving(rng, 10.0), [way], 1.0, rng)
    assert clouds.unhurried(cloud, [way]).sideways == pytest.approx(np.maximum(cloud.sideways, 10.0**2 / 20.0), abs=1.3)
    straight = Way(np.column_stack([np.arange(0, 120, 1.5), np.zeros(80)]), np.zeros(80), 120.0, 1.0)
    assert (clouds.unhurried(cloud, [straight]).sideways == cloud.sideways).all()


@pytest.mark.parametrize(("std", "low", "high"), [(0.8, 4.0, 7.8), (3.0, 7.8, 10.2)])
def test_a_braking_that_is_surely_seen_goes_on_where_no_road_is_known(std: float, low: float, high: float) -> None:
    rng = np.random.default_rng(1)
    cloud = clouds.launched(driving(rng, 10.0), fit_of(10.0, -3.0, std), 0.0, 400, rng, on_ways=False)
    for _ in range(30):
        cloud = clouds.driven(cloud, 1 / 30, [], False, rng)
    assert low < float(np.median(cloud.speed)) < high


@pytest.mark.parametrize("begin", [-5.0, -1.0, 1.0, 5.0])
def test_who_turns_off_drives_in_the_lane_before_and_after(begin: float) -> None:
    """Where the turn began about the origin, the roads lay askew to the way: cars drove over the lawn."""
    rng = np.random.default_rng(5)
    stage = Stage(rng, view(rng, (640, 480)), 75, "red", 0.7, 10.0)
    way, _, (main, other) = corner(stage, begin)
    for road, arcs in (
        (main, np.arange(begin - 100.0, begin - 5.0, 5.0)),
        (other, np.arange(begin + 25.0, 120.0, 5.0)),
    ):
        away = [np.linalg.norm(road.centre.points - point, axis=1).min() for point in way.at(arcs)[0]]
        assert np.array(away) == pytest.approx(np.full(len(arcs), 0.5 * LANE), abs=0.1)


def test_a_car_behind_the_camera_is_not_drawn() -> None:
    """A camera that sees the horizon: projected, what is behind it lay anywhere, or nowhere."""
    looks_north = np.array([[100.0, 160.0, 0.0, 0.0], [0.0, 120.0, 100.0, 3000.0], [0.0, 1.0, 0.0, 0.0]])
    looks_north = looks_north[:, [1, 0, 2, 3]]  # depth is north
    for north in (-40.0, -1e-9, 0.0, 1.0):
        image = np.zeros((240, 320, 3), np.uint8)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            cars.draw(image, looks_north, np.array([north, 0.0]), 0.3, (0, 0, 255))
        assert not image.any()
    cars.draw(image, looks_north, np.array([40.0, 0.0]), 0.3, (0, 0, 255))
    assert image.any()
