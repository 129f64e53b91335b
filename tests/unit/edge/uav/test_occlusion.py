"""Prediction of a car out of view: particle weights under occlusion, speed, lane; simulated turns and rendering."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from edge.uav.ground.road_map import CELL, RoadMap
from edge.uav.prediction import occlusion, particle_set
from edge.uav.prediction.particle_set import ParticleSet
from edge.uav.prediction.paths import RoadPath, road_edges, trace_paths
from edge.uav.target.appearance import Candidate
from edge.uav.target.likelihood import evaluate_candidates
from edge.uav.target.motion_history import MotionFit
from edge.uav.target.tracklets import Tracklet, Tracklets
from edge.uav.world import cars
from edge.uav.world.roads import LANE
from edge.uav.world.scenario_builder import ScenarioInputs, sample_camera, turn_at_crossing
from protocols.geometry.types import Floats


def road_map_of(near: object) -> RoadMap:
    """A map about the origin from a function of ground points (n, 2) that returns log-odds."""
    assert callable(near)
    road = RoadMap(np.zeros(2))
    rows, columns = np.mgrid[0:1024, 0:1024]
    points = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * CELL + road._origin
    road._log_odds[:] = near(points).reshape(1024, 1024)
    return road


def crossing(points: Floats) -> Floats:
    """A road 7 wide along X, crossed by another at X = 25."""
    return np.where((np.abs(points[:, 1]) < 3.5) | (np.abs(points[:, 0] - 25.0) < 3.5), 3.0, -3.0)


def straight_fit(speed: float, along: float, std: float) -> MotionFit:
    return MotionFit(0.0, np.zeros(2), np.array([speed, 0.0]), np.array([along, 0.0]), 0.2, std, 0.05, 20)


def particles_at_speed(rng: np.random.Generator, speed: float) -> ParticleSet:
    particles = particle_set.initialise(np.zeros(2), 0.5, 400, rng)
    return replace(particles, heading=rng.normal(0.0, 0.05, 400), speed=np.full(400, speed))


def share_left_near_candidate(score: float, shape: float) -> float:
    """Share of the particle weight that remains near an earlier detected candidate which the particles approach."""
    rng = np.random.default_rng(0)
    particles = particles_at_speed(rng, 10.0)
    particles = replace(
        particles, position=particles.position + np.where(np.arange(400) % 2, 0.0, 8.0)[:, None] * [1.0, 0.0]
    )
    found = Candidate(np.array([0.0, 2.0]), score, score, shape, 1.0)
    tracks: list[Tracklet] = []
    tracklets = Tracklets()
    for k in range(6):
        tracks = tracklets.update(k / 30, [found])
    tracks[0].odds_limit = 0.0
    measurement = evaluate_candidates(
        particles, [found], tracks, np.full(400, 0.03), lambda _: (0.25, 0.25), 4.5, True, lambda _: False
    )
    assert measurement.likelihood is not None
    particles = particles.reweighted(measurement.likelihood)
    about = np.square(particles.position - found.ground).sum(axis=1) < 4.5**2
    return float(particles.weights[about].sum())


def test_particles_near_weakly_similar_background_keep_their_weight() -> None:
    """Background under trees took all weight from particles near it, so that only those that braked were left."""
    assert share_left_near_candidate(0.4, 0.2) == pytest.approx(0.5, abs=0.02)
    assert share_left_near_candidate(0.9, 0.9) < 0.01  # another car excludes the target


def test_the_road_map_is_transferred_to_a_new_ground_frame() -> None:
    """It was lost when telemetry gave a better frame, and a car that left the image just then had no road paths."""
    old = road_map_of(lambda points: np.where(np.abs(points[:, 1]) < 3.5, 3.0, -3.0))
    angle, scale, shift = 0.6, 1.3, np.array([40.0, -25.0])
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    change = np.array([[c, -s, shift[0]], [s, c, shift[1]], [0.0, 0.0, 1.0]])
    new = RoadMap(shift)
    new.transfer_from(old, change)
    along = np.column_stack([np.linspace(-50.0, 50.0, 41), np.zeros(41)])
    for aside, odds in ((0.0, 3.0), (2.5, 3.0), (-2.5, 3.0), (4.5, -3.0), (-4.5, -3.0)):
        points = (along + [0.0, aside]) @ change[:2, :2].T + shift
        assert new.log_odds(points) == pytest.approx(np.full(41, odds))


def test_a_turn_ends_in_the_lane_of_the_driving_side() -> None:
    road = road_map_of(crossing)
    road.smooth_around(np.array([0.0, 1.7]), 75.0)
    for lane in (1.7, -1.7):  # right-hand and left-hand traffic
        right, left = road_edges(road, np.array([[0.0, lane]]), np.zeros(1))
        paths = trace_paths(road, np.array([0.0, lane]), 0.0, 0.0, 60.0, (float(right[0]), float(left[0])))
        ends = {round(float(np.sign(way.points[-1, 1]))): way.points[-4:, 0] for way in paths[1:]}
        assert set(ends) == {-1, 1}
        for side, x in ends.items():
            # Driving to +Y, the right is at -X of the road's middle.
            assert np.mean(x) == pytest.approx(25.0 - side * lane, abs=0.9)


def test_a_driver_who_does_not_brake_before_a_bend_gets_a_higher_lateral_limit() -> None:
    rng = np.random.default_rng(0)
    headings = np.arange(0, 120, 1.5) / 20.0
    steps = 1.5 * np.column_stack([np.cos(headings), np.sin(headings)])
    way = RoadPath(np.vstack([np.zeros(2), np.cumsum(steps, axis=0)[:-1]]), headings, 120.0, 1.0)
    particles = occlusion.assign_paths(particles_at_speed(rng, 10.0), [way], 1.0, rng)
    assert particle_set.raise_lateral_limits(particles, [way]).lateral_limit == pytest.approx(
        np.maximum(particles.lateral_limit, 10.0**2 / 20.0), abs=1.3
    )
    straight = RoadPath(np.column_stack([np.arange(0, 120, 1.5), np.zeros(80)]), np.zeros(80), 120.0, 1.0)
    assert (particle_set.raise_lateral_limits(particles, [straight]).lateral_limit == particles.lateral_limit).all()


@pytest.mark.parametrize(("std", "low", "high"), [(0.8, 4.0, 7.8), (3.0, 7.8, 10.2)])
def test_significant_braking_continues_where_no_road_is_known(std: float, low: float, high: float) -> None:
    rng = np.random.default_rng(1)
    particles = particle_set.initialise_prediction(
        particles_at_speed(rng, 10.0), straight_fit(10.0, -3.0, std), 0.0, 400, rng, paths_known=False
    )
    for _ in range(30):
        particles = particle_set.propagate(particles, 1 / 30, [], False, rng)
    assert low < float(np.median(particles.speed)) < high


@pytest.mark.parametrize("begin", [-5.0, -1.0, 1.0, 5.0])
def test_a_turning_car_is_in_its_lane_before_and_after_the_turn(begin: float) -> None:
    """With a turn that began near the origin the simulated roads were misaligned: cars drove over the lawn."""
    rng = np.random.default_rng(5)
    inputs = ScenarioInputs(rng, sample_camera(rng, (640, 480)), 75, "red", 0.7, 10.0)
    way, _, (main, other) = turn_at_crossing(inputs, begin)
    for road, arcs in (
        (main, np.arange(begin - 100.0, begin - 5.0, 5.0)),
        (other, np.arange(begin + 25.0, 120.0, 5.0)),
    ):
        away = [np.linalg.norm(road.centre.points - point, axis=1).min() for point in way.at(arcs)[0]]
        assert np.array(away) == pytest.approx(np.full(len(arcs), 0.5 * LANE), abs=0.1)


def test_a_car_behind_the_camera_is_not_drawn() -> None:
    """With a camera that sees the horizon, points behind it were projected to arbitrary pixels."""
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
