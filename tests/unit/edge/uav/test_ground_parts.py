"""Parts of the ground tracker: appearance, photometric gain, road map, paths, motion fit, particles, likelihood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.uav.base import Box, Telemetry
from edge.uav.ground.image_plane import ImagePlane
from edge.uav.ground.localisation import frame_from_telemetry
from edge.uav.ground.photometric import PhotometricGain, TargetGain
from edge.uav.ground.road_map import CELL, RoadMap
from edge.uav.prediction import occlusion, particle_set
from edge.uav.prediction.driver_model import DriverModel
from edge.uav.prediction.particle_set import NO_PATH
from edge.uav.prediction.paths import RoadPath, road_edges, trace_paths
from edge.uav.target.appearance import AppearanceModel, Candidate
from edge.uav.target.footprint import corners, footprint_from_box, oriented_rectangle
from edge.uav.target.ground_patch import GroundPatch, rectify_patch
from edge.uav.target.likelihood import evaluate_candidates
from edge.uav.target.motion_history import MotionFit, MotionHistory
from edge.uav.target.redetection import path_plausibility
from edge.uav.target.tracklets import Tracklet, Tracklets
from edge.uav.timing.telemetry_track import TelemetryTrack
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

PLANE = ImagePlane((320, 240), None)
FROM_ABOVE = np.diag([10.0 / PLANE.focal, 10.0 / PLANE.focal, 1.0])  # 10 px a unit, origin in the middle


def street(seed: int = 1) -> Image:
    return np.random.default_rng(seed).normal(90, 4, (240, 320, 3)).clip(0, 255).astype(np.uint8)


def draw_car(image: Image, x: float, y: float, colour: tuple[int, int, int] = (40, 40, 200)) -> None:
    """44 x 20 px, with a dark windscreen."""
    x0, y0 = round(x - 22), round(y - 10)
    image[max(y0, 0) : max(y0 + 20, 0), max(x0, 0) : max(x0 + 44, 0)] = colour
    image[max(y0 + 3, 0) : max(y0 + 17, 0), max(x0 + 26, 0) : max(x0 + 33, 0)] = (30, 30, 30)


def ground_of(x: float, y: float) -> Floats:
    return np.array([(x - 159.5) / 10.0, (y - 119.5) / 10.0])


def appearance_of(image: Image, x: float, y: float) -> AppearanceModel:
    appearance = AppearanceModel(4.4, 2.0, 0.1)
    patch = patch_of(image, x, y)
    appearance.learn(patch, ground_of(x, y), 1.0)
    own = min(appearance.candidates(patch), key=lambda c: float(np.linalg.norm(c.ground - ground_of(x, y))))
    appearance.calibrate(own.colour, own.shape, 1.0)
    return appearance


def patch_of(image: Image, x: float, y: float, half: float = 9.0) -> GroundPatch:
    patch = rectify_patch(image, PLANE, FROM_ABOVE, ground_of(x, y), 0.0, (half, half), 0.15)
    assert patch is not None
    return patch


def test_the_target_is_detected_at_its_position_and_a_car_of_another_colour_is_not() -> None:
    first, later = street(1), street(2)
    draw_car(first, 150, 120)
    appearance = appearance_of(first, 150, 120)
    draw_car(later, 171, 114)
    draw_car(later, 120, 150, (160, 60, 30))
    found = appearance.candidates(patch_of(later, 160, 120))
    assert np.linalg.norm(found[0].ground - ground_of(171, 114)) < 0.15
    assert found[0].score > 0.85
    assert all(c.score < 0.62 for c in found[1:])


def test_a_target_half_outside_the_image_is_detected_with_its_visible_share() -> None:
    first, later = street(1), street(2)
    draw_car(first, 150, 120)
    appearance = appearance_of(first, 150, 120)
    draw_car(later, 4, 120)
    best = appearance.candidates(patch_of(later, 20, 120))[0]
    assert np.linalg.norm(best.ground - ground_of(4, 120)) < 0.6
    assert 0.4 < best.visible_share < 0.8
    assert best.score > 0.6


def test_an_empty_street_has_no_strong_candidate() -> None:
    first = street(1)
    draw_car(first, 150, 120)
    appearance = appearance_of(first, 150, 120)
    assert all(c.score < 0.5 for c in appearance.candidates(patch_of(street(3), 150, 120)))


def test_a_patch_outside_the_image_is_none() -> None:
    assert rectify_patch(street(), PLANE, FROM_ABOVE, np.array([400.0, 0.0]), 0.0, (5.0, 5.0), 0.15) is None


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(-3, 3))
@settings(max_examples=40, deadline=None)
def test_cell_and_ground_coordinates_of_a_patch_are_inverse(x: float, y: float, angle: float) -> None:
    patch = GroundPatch(
        np.zeros((9, 15, 3), np.uint8), np.ones((9, 15), np.float32), np.array([x, y]), angle, 0.2, True
    )
    cells = np.array([[0.0, 0.0], [14.0, 8.0], [3.5, 2.0]])
    np.testing.assert_allclose(patch.to_cells(patch.to_ground(cells)), cells, atol=1e-9)


@given(st.floats(3.5, 6.0), st.floats(1.6, 2.2), st.floats(-np.pi, np.pi))
@settings(max_examples=60, deadline=None)
def test_the_length_of_a_car_is_recovered_from_its_upright_box(length: float, width: float, turn: float) -> None:
    box = np.ptp(corners(np.zeros(2), turn, length, width), axis=0)
    found, _ = footprint_from_box(float(box[0]), float(box[1]), turn)
    assert found == pytest.approx(length, rel=0.2)


@pytest.mark.parametrize("turn", [-1.2, -0.6, 0.3, 0.8])
def test_a_turned_rectangle_is_found_in_its_upright_box(turn: float) -> None:
    box = np.ptp(corners(np.zeros(2), turn, 4.4, 1.8), axis=0)
    points = np.stack(np.meshgrid(*2 * [np.linspace(-3.0, 3.0, 41)]), axis=-1).reshape(-1, 2)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    inside = (np.abs(points @ axes) <= [2.2, 0.9]).all(axis=1)
    evidence = np.where(inside, 2.0, 0.3) + np.random.default_rng(1).normal(0.0, 0.4, len(points))
    found = oriented_rectangle(points, evidence, (float(box[0]), float(box[1])))
    assert found is not None
    assert abs(np.sin(found[0] - turn)) < 0.1
    assert found[1] == pytest.approx(4.4, rel=0.1)
    assert oriented_rectangle(points, np.where(np.hypot(*points.T) < 1.5, 2.0, -1.0), (3.0, 3.0)) is None


def test_the_shape_of_a_target_as_bright_as_the_ground_is_not_that_of_the_ground() -> None:
    empty = np.random.default_rng(4).normal((60, 80, 77), 12, (240, 320, 3)).clip(0, 255).astype(np.uint8)
    image = empty.copy()
    image[110:130, 140:184] = (30, 30, 185)  # brightness 76, that of the ground 77
    appearance = appearance_of(image, 161.5, 119.5)
    left = appearance.candidates(patch_of(empty, 161.5, 119.5), min_score=-1.0)
    there = [c.shape for c in left if np.linalg.norm(c.ground - ground_of(161.5, 119.5)) < 1.0]
    assert max(there, default=0.0) < 0.3


def test_a_photometric_gain_is_estimated_and_corrected() -> None:
    photometric = PhotometricGain()
    bright = np.random.default_rng(2).integers(80, 160, (60, 80, 3)).astype(np.uint8)
    dark = np.rint(bright * 0.7).astype(np.uint8)
    points = np.random.default_rng(3).uniform(5, 55, (40, 2))
    photometric.update(bright, points, points)
    photometric.update(np.maximum(dark, np.rint(bright * 0.75).astype(np.uint8)), points, points)
    photometric.update(dark, points, points)
    np.testing.assert_allclose(photometric.gain, 0.7, atol=0.03)
    assert np.abs(photometric.corrected(dark).astype(float) - bright).mean() < 5.0


def test_a_local_gain_change_at_the_target_keeps_its_score() -> None:
    image = street()
    draw_car(image, 160, 120, (90, 92, 94))
    appearance, local_gain, photometric = appearance_of(image, 160, 120), TargetGain(), PhotometricGain()
    local_gain.set_reference(appearance.log_brightness(patch_of(image, 160, 120), ground_of(160, 120)))
    scores = {}
    for k in range(14):
        sunny = np.clip(image * (1.0 + 0.06 * k), 0, 255).astype(np.uint8)
        for name, value in (("shade", local_gain.log_gain), ("without", 0.0)):
            patch = patch_of(photometric.corrected(sunny, value), 160, 120)
            scores[name] = max(c.score for c in appearance.candidates(patch, min_score=-1.0))
        local_gain.update(
            appearance.log_brightness(
                patch_of(photometric.corrected(sunny, local_gain.log_gain), 160, 120), ground_of(160, 120)
            )
        )
    assert local_gain.log_gain == pytest.approx(np.log(1.78), abs=0.06)
    assert scores["without"] < scores["shade"] - 0.1
    assert scores["shade"] > 0.85
    for _ in range(90):
        local_gain.decay(1 / 30)
    assert abs(local_gain.log_gain) < 0.1


def paint_road(road: RoadMap, near: object) -> None:
    """Set the log-odds of the map by a function of ground points (n, 2)."""
    assert callable(near)
    rows, columns = np.mgrid[0:1024, 0:1024]
    points = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * CELL + road._origin
    road._log_odds[:] = near(points).reshape(1024, 1024)


def curved_road(points: Floats) -> Floats:
    """A road 7 wide along X that turns right (towards +Y) at radius 25 from X = 20; known to 60° of the bend."""
    x, y = points[:, 0], points[:, 1]
    around = np.hypot(x - 20.0, y - 25.0)
    on = np.where(x < 20.0, np.abs(y) < 3.5, (np.abs(around - 25.0) < 3.5) & (y < 25.0))
    angle = np.arctan2(x - 20.0, 25.0 - y)
    seen = (x < 20.0) | (angle < np.deg2rad(60))
    return np.where(seen, np.where(on, 3.0, -3.0), 0.0)


def test_the_path_follows_a_bend_at_a_constant_distance_from_the_edge() -> None:
    road = RoadMap(np.zeros(2))
    paint_road(road, curved_road)
    road.smooth_around(np.array([0.0, 1.7]), 60.0)
    right, left = road_edges(road, np.array([[0.0, 1.7]]), np.zeros(1))
    assert right[0] == pytest.approx(1.8, abs=0.6)
    assert left[0] == pytest.approx(5.2, abs=0.6)
    path = trace_paths(road, np.array([0.0, 1.7]), 0.0, 0.0, 44.0, (float(right[0]), float(left[0])))[0]
    radius = np.hypot(path.points[:, 0] - 20.0, path.points[:, 1] - 25.0)
    along_bend = (path.points[:, 0] > 24) & (
        np.arctan2(path.points[:, 0] - 20, 25 - path.points[:, 1]) < np.deg2rad(55)
    )
    assert along_bend.sum() > 8
    assert np.abs(radius[along_bend] - 23.3).max() < 1.5


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_tree_crowns_over_the_lane_do_not_displace_the_path(side: float) -> None:
    """Four crowns cover the lane and 2 to 3 units beyond its centre; the road below them is straight."""
    road = RoadMap(np.zeros(2))
    crowns = np.array([[6.0, 2.5], [13.0, 1.5], [22.0, 2.8], [30.0, 2.0]]) * [1.0, side]

    def under_trees(points: Floats) -> Floats:
        away = np.linalg.norm(points[:, None, :] - crowns, axis=2).min(axis=1)
        return np.where((np.abs(points[:, 1]) < 3.5) & (away > 3.0), 3.0, -3.0)

    paint_road(road, under_trees)
    edge_distances = (1.75, 5.25) if side > 0 else (5.25, 1.75)
    path = trace_paths(road, np.array([0.0, 1.75 * side]), 0.0, 0.0, 40.0, edge_distances)[0]
    assert np.abs(path.points[:, 1] - 1.75 * side).max() < 1.2


def test_beyond_the_known_road_the_curvature_continues_and_decays() -> None:
    road = RoadMap(np.zeros(2))
    paint_road(road, curved_road)
    path = trace_paths(road, np.array([0.0, 0.0]), 0.0, 0.0, 75.0, (3.5, 3.5))[0]
    curvature = np.diff(path.headings) / 1.5
    end = int(path.known_length / 1.5)
    assert path.known_length < 60.0
    assert curvature[end : end + 3].mean() > 0.015
    assert abs(curvature[-1]) < 0.5 * curvature[end]


def test_a_crossing_gives_a_path_to_each_side() -> None:
    road = RoadMap(np.zeros(2))

    def cross(points: Floats) -> Floats:
        return np.where((np.abs(points[:, 1]) < 3.5) | (np.abs(points[:, 0] - 25.0) < 3.5), 3.0, -3.0)

    paint_road(road, cross)
    paths = trace_paths(road, np.zeros(2), 0.0, 0.0, 50.0, (3.5, 3.5))
    ends = [path.points[-1] for path in paths]
    assert abs(ends[0][1]) < 2.0
    assert any(end[1] > 10.0 for end in ends)
    assert any(end[1] < -10.0 for end in ends)
    assert sum(path.weight for path in paths) == pytest.approx(1.0)


def test_the_road_map_learns_asphalt_and_keeps_it_out_of_view() -> None:
    image = np.full((240, 320, 3), (60, 130, 90), np.uint8)
    image += np.random.default_rng(1).integers(0, 8, image.shape, np.uint8)
    image[100:140] = np.random.default_rng(2).integers(86, 96, (40, 320, 3), np.uint8)
    road = RoadMap(np.zeros(2))
    road.learn_colours(image[100:140].reshape(-1, 3), image[::4, ::4].reshape(-1, 3), 1.0)
    road.update(image, 1, PLANE, FROM_ABOVE, None)
    away: Floats = FROM_ABOVE @ np.array([[1.0, 0.0, 40.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for _ in range(3):
        road.update(image, 1, PLANE, away, None)
    on = np.column_stack([np.linspace(-14, 14, 15), np.zeros(15)])
    off = np.column_stack([np.linspace(-14, 14, 15), np.full(15, 8.0)])
    assert (road.log_odds(on) > 0.2).all()
    assert (road.log_odds(off) < -0.2).all()
    assert (road.log_odds(off + [0.0, 300.0]) == 0.0).all()


def test_the_motion_fit_estimates_velocity_and_turn_rate_of_a_noisy_arc() -> None:
    rng = np.random.default_rng(4)
    seen = MotionHistory()
    for k in range(30):
        angle = 10.0 * k / 30 / 20.0  # 10 units/s on a radius of 20
        seen.add(k / 30, 20.0 * np.array([np.sin(angle), 1 - np.cos(angle)]) + rng.normal(0, 0.05, 2), 0.2)
    fit = seen.fit()
    assert fit is not None
    assert fit.speed == pytest.approx(10.0, abs=0.8)
    assert fit.heading == pytest.approx(10.0 * 29 / 30 / 20.0, abs=0.08)
    assert fit.turn_rate == pytest.approx(0.5, abs=0.25)
    assert abs(fit.speed - 10.0) < 4 * fit.velocity_std + 0.3


def test_partial_occlusion_is_not_fitted_as_a_change_of_speed() -> None:
    """The edge of a bridge over the front of the car made the fit brake from 10 to 6.7 units/s in four frames."""
    seen = MotionHistory()
    for k in range(25):
        seen.add(k / 30, np.array([10.0 * k / 30, 0.0]), 0.22)
        before = seen.fit()
    for k in range(25, 29):
        seen.add(k / 30, np.array([10.0 * 24.5 / 30, 0.0]), 0.22)
        fit = seen.fit()
    assert before is not None
    assert fit is not None
    assert before.speed == pytest.approx(10.0, abs=0.1)
    assert fit.speed > 7.2


def test_hard_braking_is_fitted() -> None:
    seen = MotionHistory()
    for k in range(45):
        t, braked = k / 30, max(k - 24, 0) / 30
        seen.add(t, np.array([10.0 * t - 0.5 * 7.0 * braked**2, 0.0]), 0.22)
        fit = seen.fit()
    assert fit is not None
    assert fit.speed == pytest.approx(10.0 - 7.0 * 20 / 30, abs=1.0)


def curved_path(radius: float) -> RoadPath:
    """30 units straight, then a right-hand bend that continues."""
    along = np.arange(0, 120, 1.5)
    headings = np.maximum(along - 30.0, 0.0) / radius
    steps = 1.5 * np.column_stack([np.cos(headings), np.sin(headings)])
    return RoadPath(np.vstack([np.zeros(2), np.cumsum(steps, axis=0)[:-1]]), headings, 120.0, 1.0)


def straight_fit(speed: float, time: float = 0.0, across: float = 0.0) -> MotionFit:
    return MotionFit(time, np.zeros(2), np.array([speed, 0.0]), np.array([0.0, across]), 0.2, 0.3, 0.05, 20)


def test_the_velocity_prior_at_reacquisition_is_relaxed_over_time() -> None:
    """Re-acquired at 7 units/s, the car drove on at 10 round a bend: the fit stayed near 7, and the target was lost."""
    seen, position = MotionHistory(), np.zeros(2)
    seen.restart(np.array([7.0, 0.0]), 0.4)
    for k in range(240):
        course = 0.5 * np.pi * min(k / 120, 1.0)
        step = (10.0 if k > 30 else 7.0) / 30 * np.array([np.cos(course), np.sin(course)])
        position = position + step
        seen.add(k / 30, position, 0.22)
        fit = seen.fit()
        if k == 4:
            first = fit
    assert first is not None
    assert fit is not None
    assert first.velocity == pytest.approx([7.0, 0.0], abs=0.6)  # with few detections the prior dominates
    assert fit.velocity == pytest.approx([0.0, 10.0], abs=0.2)


def test_predicted_particles_slow_down_for_a_bend_and_not_on_a_straight() -> None:
    rng = np.random.default_rng(0)
    for path, low, high in ((curved_path(15.0), 0.0, 8.6), (straight_path(), 9.3, 10.7)):
        particles = particle_set.initialise_prediction(
            particle_set.initialise(np.zeros(2), 0.1, 400, rng), straight_fit(10.0), 0.0, 400, rng
        )
        particles = occlusion.assign_paths(particles, [path], 1.0, rng)
        for _ in range(120):
            particles = particle_set.propagate(particles, 1 / 30, [path], False, rng)
        assert low < np.median(particles.speed) < high


def test_after_a_bend_the_driver_model_returns_to_the_cruise_speed() -> None:
    driver = DriverModel()
    for k in range(20):
        driver.update(straight_fit(12.0, 0.1 * k))
    for k in range(20, 30):
        driver.update(straight_fit(8.0, 0.1 * k, across=3.0))
    parameters = driver.sample(straight_fit(8.0, 3.0, across=3.0), np.full(400, 8.0), np.random.default_rng(0))
    assert np.median(parameters.cruise_speed) == pytest.approx(12.0, abs=0.3)
    assert np.quantile(parameters.lateral_limit, 0.1) > 2.0  # observed in that bend
    unknown = DriverModel().sample(straight_fit(8.0), np.full(400, 8.0), np.random.default_rng(0))
    assert np.median(unknown.cruise_speed) == pytest.approx(8.0, abs=0.2)


@pytest.mark.parametrize(("height", "kind"), [(60.0, "metric"), (6e5, "attitude"), (3.0, "attitude")])
def test_a_height_that_makes_the_target_size_implausible_is_rejected(height: float, kind: str) -> None:
    clock = TelemetryTrack(BODY_FROM_DOWN_CAMERA)
    for k in range(3):
        clock.add(Telemetry(k / 30, np.eye(3), np.array([0.0, 0.0, -height])))
    matrix = np.array([[600.0, 0.0, 159.5], [0.0, 600.0, 119.5], [0.0, 0.0, 1.0]])
    plane = ImagePlane((320, 240), Intrinsics(320, 240, matrix))
    frame = frame_from_telemetry(plane, clock, 1 / 30, Box(150.0, 110.0, 25.0, 12.0))
    assert frame is not None
    assert frame.kind == kind


def straight_path(known: float = 100.0) -> RoadPath:
    points = np.column_stack([np.arange(0, 120, 1.5), np.zeros(80)])
    return RoadPath(points, np.zeros(80), known, 1.0)


def test_particles_follow_their_path_and_spread_beyond_its_known_end() -> None:
    rng = np.random.default_rng(0)
    seen = MotionHistory()
    for k in range(20):
        seen.add(k / 30, np.array([-6.3 + 10.0 * k / 30, 0.0]), 0.2)
    fit = seen.fit()
    assert fit is not None
    spreads = []
    for known in (100.0, 5.0):
        particles = particle_set.initialise(np.zeros(2), 0.1, 400, rng)
        particles = occlusion.assign_paths(
            particle_set.initialise_prediction(particles, fit, 0.0, 400, rng), [straight_path(known)], 1.0, rng
        )
        for _ in range(60):
            particles = particle_set.propagate(particles, 1 / 30, [straight_path(known)], False, rng)
        assert np.median(particles.position[:, 0]) == pytest.approx(20.0, abs=1.5)
        spreads.append(float(particles.position[:, 1].std()))
    assert spreads[0] < 0.6
    assert spreads[1] > 1.5 * spreads[0]


def candidate(x: float, y: float, score: float = 0.95) -> Candidate:
    return Candidate(np.array([x, y]), score, 1.0, 0.9, 1.0)


def test_a_similar_car_in_the_opposite_direction_is_not_accepted_as_the_target() -> None:
    rng = np.random.default_rng(0)
    particles = particle_set.initialise(np.zeros(2), 1.0, 400, rng)
    particles = replace(particles, heading=rng.normal(0.0, 0.05, 400), speed=rng.normal(10.0, 0.7, 400))
    for sign, taken in ((-1.0, False), (1.0, True)):
        tracklets = Tracklets()
        for k in range(6):
            seen = [candidate(1.0 + sign * 10.0 * (k - 5) / 30, 0.5)]
            tracks = tracklets.update(k / 30, seen)
        assert tracks[0].age == 6
        measurement = evaluate_candidates(
            particles, seen, tracks, np.full(400, 0.3), lambda _: (0.25, 0.25), 4.5, True, lambda _: False
        )
        assert (measurement.best is not None) == taken


@pytest.mark.parametrize(("share", "taken"), [(0.45, False), (1.0, True)])
def test_a_similar_car_cut_by_the_image_border_is_not_accepted(share: float, taken: bool) -> None:
    """The image border moves with the target, and a car that it cuts off appears to move with it."""
    rng = np.random.default_rng(1)
    particles = particle_set.initialise(np.zeros(2), 1.0, 400, rng)
    particles = replace(particles, heading=rng.normal(0.0, 0.05, 400), speed=rng.normal(10.0, 0.7, 400))
    tracklets = Tracklets()
    for k in range(6):
        seen = [replace(candidate(1.0 + 10.0 * (k - 5) / 30, 0.5, 0.77), visible_share=share)]
        tracks = tracklets.update(k / 30, seen)
    measurement = evaluate_candidates(
        particles, seen, tracks, np.full(400, 0.03), lambda _: (0.25, 0.25), 4.5, True, lambda _: False
    )
    assert (measurement.best is not None) == taken


@pytest.mark.parametrize(("at", "taken"), [((38.0, 0.0), False), ((3.0, 0.5), True)])
def test_a_similar_car_at_an_unlikely_position_is_never_accepted(at: tuple[float, float], taken: bool) -> None:
    """A following car of the same make is as similar in the hundredth frame as in the first: scores are correlated."""
    rng = np.random.default_rng(3)
    particles = particle_set.initialise(np.zeros(2), 3.0, 400, rng)
    position = particles.position.copy()
    position[0] = (38.0, 0.0)  # one particle at the position of the similar car
    weights = np.full(400, 1.0 / 399.2)
    weights[0] = 0.0005
    particles = replace(
        particles,
        position=position,
        heading=rng.normal(0.0, 0.05, 400),
        speed=rng.normal(10.0, 0.7, 400),
        weights=weights,
    )
    tracklets, found = Tracklets(), False
    for k in range(40):  # all positions move with the cars
        seen = [candidate(at[0] + 10.0 * k / 30, at[1])]
        moved = replace(particles, position=position + np.array([10.0 * k / 30, 0.0]))
        tracks = tracklets.update(k / 30, seen)
        measurement = evaluate_candidates(
            moved, seen, tracks, np.full(400, 0.03), lambda _: (0.25, 0.25), 4.5, True, lambda _: False
        )
        assert measurement.likelihood is not None
        particles = replace(particles, weights=particles.reweighted(measurement.likelihood).weights)
        found |= measurement.best is not None
    assert found == taken


def test_the_heading_of_a_template_is_used_once_its_shape_matches() -> None:
    rng = np.random.default_rng(0)
    particles = particle_set.initialise(np.zeros(2), 0.3, 400, rng)
    heading = np.where(np.arange(400) < 200, 0.0, 0.6)
    particles = replace(particles, heading=heading, speed=np.full(400, 0.5))
    tracklets = Tracklets()
    for k in range(6):
        seen = [replace(candidate(0.0, 0.0), angle=0.6)]
        tracks = tracklets.update(k / 30, seen)
    for shaped, share in ((False, 0.5), (True, 0.9)):
        measurement = evaluate_candidates(
            particles, seen, tracks, np.full(400, 0.3), lambda _: (0.25, 0.25), 4.5, True, lambda _, s=shaped: s
        )
        assert measurement.likelihood is not None
        posterior = particles.reweighted(measurement.likelihood).weights[200:].sum()
        assert posterior == pytest.approx(share, abs=0.1)


def moving_tracklet(position: tuple[float, float], velocity: tuple[float, float], time: float) -> Tracklet:
    out = Tracklet()
    for k in range(8):
        ago = (7 - k) / 30
        out.add(time - ago, candidate(position[0] - ago * velocity[0], position[1] - ago * velocity[1]))
    return out


@pytest.mark.parametrize(
    ("position", "velocity", "low", "high"),
    [
        ((30.0, 0.0), (10.0, 0.0), 0.9, 1.0),  # straight on, 3 s later
        ((12.0, 18.0), (0.0, 10.0), 0.9, 1.0),  # turned off after 12 m
        ((12.0, -18.0), (1.0, -9.0), 0.8, 1.0),
        ((30.0, 3.0), (-10.0, 0.0), 0.0, 0.0),  # comes back on the other lane
        ((12.0, 18.0), (0.0, -10.0), 0.0, 0.0),  # drives towards where the target was last seen
        ((-20.0, 0.0), (10.0, 0.0), 0.0, 0.3),  # was behind it
        ((70.0, 0.0), (10.0, 0.0), 0.0, 0.0),  # too far
        ((30.0, 0.0), (1.0, 0.0), 0.0, 0.0),  # nearly parked
    ],
)
def test_plausibility_of_a_blob_by_the_path_it_must_have_travelled(
    position: tuple[float, float], velocity: tuple[float, float], low: float, high: float
) -> None:
    fit = MotionFit(0.0, np.zeros(2), np.array([10.0, 0.0]), np.zeros(2), 0.2, 0.5, 0.05, 20)
    assert low <= path_plausibility(moving_tracklet(position, velocity, 3.0), fit, 4.5, 3.0) <= high


def test_missed_detections_in_open_view_reduce_particle_weights() -> None:
    particles = particle_set.initialise(np.zeros(2), 3.0, 200, np.random.default_rng(0))
    chance = np.where(particles.position[:, 0] > 0, 0.3, 0.0)
    measurement = evaluate_candidates(particles, [], [], chance, lambda _: (0.25, 0.25), 4.5, True, lambda _: False)
    assert measurement.best is None
    assert measurement.likelihood is not None
    after = particles.reweighted(measurement.likelihood).weights
    assert after[particles.position[:, 0] > 0].sum() < particles.weights[particles.position[:, 0] > 0].sum() - 0.05


def test_particles_keep_their_weights_if_the_likelihood_is_zero_everywhere() -> None:
    particles = particle_set.initialise(np.zeros(2), 1.0, 50, np.random.default_rng(0))
    np.testing.assert_array_equal(particles.reweighted(np.zeros(50)).weights, particles.weights)
    assert (particles.without_paths().path == NO_PATH).all()
