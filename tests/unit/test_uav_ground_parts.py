"""Looks, road, ways, motion and evidence of the ground-plane tracker, each by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.uav.ground.frame_init import root_from_telemetry
from edge.uav.ground.image_plane import ImagePlane
from edge.uav.ground.photometric import Light, Shade
from edge.uav.ground.road_map import CELL, RoadMap
from edge.uav.prediction import particle_set as clouds
from edge.uav.prediction.driver_model import Driving
from edge.uav.prediction.particle_set import FREE
from edge.uav.prediction.paths import Way, edges, trace
from edge.uav.target.appearance import Appearance, Candidate, Patch, cut_patch
from edge.uav.target.footprint import corners, oriented
from edge.uav.target.likelihood import judge
from edge.uav.target.motion_history import MotionFit, Sightings
from edge.uav.target.redetection import plausible
from edge.uav.target.tracklets import Tracklet, Tracklets
from edge.uav.timing.telemetry_track import TelemetryClock
from edge.uav.tracker import Box, Telemetry
from edge.uav.world.flight import BODY_FROM_DOWN_CAMERA
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]
PLANE = ImagePlane((320, 240), None)
FROM_ABOVE = np.diag([10.0 / PLANE.focal, 10.0 / PLANE.focal, 1.0])  # 10 px a unit, origin in the middle


def street(seed: int = 1) -> Picture:
    return np.random.default_rng(seed).normal(90, 4, (240, 320, 3)).clip(0, 255).astype(np.uint8)


def put_car(image: Picture, x: float, y: float, colour: tuple[int, int, int] = (40, 40, 200)) -> None:
    """44 x 20 px, with a dark windscreen."""
    x0, y0 = round(x - 22), round(y - 10)
    image[max(y0, 0) : max(y0 + 20, 0), max(x0, 0) : max(x0 + 44, 0)] = colour
    image[max(y0 + 3, 0) : max(y0 + 17, 0), max(x0 + 26, 0) : max(x0 + 33, 0)] = (30, 30, 30)


def ground_of(x: float, y: float) -> Floats:
    return np.array([(x - 159.5) / 10.0, (y - 119.5) / 10.0])


def looks_of(image: Picture, x: float, y: float) -> Appearance:
    looks = Appearance(4.4, 2.0, 0.1)
    patch = patch_of(image, x, y)
    looks.learn(patch, ground_of(x, y), 1.0)
    own = min(looks.candidates(patch), key=lambda c: float(np.linalg.norm(c.ground - ground_of(x, y))))
    looks.calibrate(own.colour, own.shape, 1.0)
    return looks


def patch_of(image: Picture, x: float, y: float, half: float = 9.0) -> Patch:
    patch = cut_patch(image, PLANE, FROM_ABOVE, ground_of(x, y), 0.0, (half, half), 0.15)
    assert patch is not None
    return patch


def test_the_target_is_found_where_it_is_and_a_car_of_another_colour_is_not() -> None:
    first, then = street(1), street(2)
    put_car(first, 150, 120)
    looks = looks_of(first, 150, 120)
    put_car(then, 171, 114)
    put_car(then, 120, 150, (160, 60, 30))
    found = looks.candidates(patch_of(then, 160, 120))
    assert np.linalg.norm(found[0].ground - ground_of(171, 114)) < 0.15
    assert found[0].score > 0.85
    assert all(c.score < 0.62 for c in found[1:])


def test_a_target_cut_in_half_by_the_border_is_still_found_with_its_share() -> None:
    first, then = street(1), street(2)
    put_car(first, 150, 120)
    looks = looks_of(first, 150, 120)
    put_car(then, 4, 120)
    best = looks.candidates(patch_of(then, 20, 120))[0]
    assert np.linalg.norm(best.ground - ground_of(4, 120)) < 0.6
    assert 0.4 < best.seen < 0.8
    assert best.score > 0.6


def test_an_empty_street_has_no_candidate_worth_the_name() -> None:
    first = street(1)
    put_car(first, 150, 120)
    looks = looks_of(first, 150, 120)
    assert all(c.score < 0.5 for c in looks.candidates(patch_of(street(3), 150, 120)))


def test_a_patch_beside_the_picture_is_none() -> None:
    assert cut_patch(street(), PLANE, FROM_ABOVE, np.array([400.0, 0.0]), 0.0, (5.0, 5.0), 0.15) is None


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(-3, 3))
@settings(max_examples=40, deadline=None)
def test_cells_and_ground_of_a_patch_are_inverse(x: float, y: float, angle: float) -> None:
    patch = Patch(np.zeros((9, 15, 3), np.uint8), np.ones((9, 15), np.float32), np.array([x, y]), angle, 0.2, True)
    cells = np.array([[0.0, 0.0], [14.0, 8.0], [3.5, 2.0]])
    np.testing.assert_allclose(patch.at(patch.ground(cells)), cells, atol=1e-9)


@given(st.floats(3.5, 6.0), st.floats(1.6, 2.2), st.floats(-np.pi, np.pi))
@settings(max_examples=60, deadline=None)
def test_a_car_s_length_comes_back_from_its_upright_box(length: float, width: float, turn: float) -> None:
    box = np.ptp(corners(np.zeros(2), turn, length, width), axis=0)
    found, _ = oriented(float(box[0]), float(box[1]), turn)
    assert found == pytest.approx(length, rel=0.2)


def test_the_light_s_change_is_measured_and_undone() -> None:
    light = Light()
    bright = np.random.default_rng(2).integers(80, 160, (60, 80, 3)).astype(np.uint8)
    dark = np.rint(bright * 0.7).astype(np.uint8)
    points = np.random.default_rng(3).uniform(5, 55, (40, 2))
    light.update(bright, points, points)
    light.update(np.maximum(dark, np.rint(bright * 0.75).astype(np.uint8)), points, points)
    light.update(dark, points, points)
    np.testing.assert_allclose(light.gain, 0.7, atol=0.03)
    assert np.abs(light.undone(dark).astype(float) - bright).mean() < 5.0


def test_a_car_that_drives_out_of_a_cloud_s_shadow_keeps_its_looks() -> None:
    image = street()
    put_car(image, 160, 120, (90, 92, 94))
    looks, shade, light = looks_of(image, 160, 120), Shade(), Light()
    shade.teach(looks.brightness(patch_of(image, 160, 120), ground_of(160, 120)))
    scores = {}
    for k in range(14):
        sunny = np.clip(image * (1.0 + 0.06 * k), 0, 255).astype(np.uint8)
        for name, value in (("shade", shade.value), ("without", 0.0)):
            patch = patch_of(light.undone(sunny, value), 160, 120)
            scores[name] = max(c.score for c in looks.candidates(patch, least=-1.0))
        shade.update(looks.brightness(patch_of(light.undone(sunny, shade.value), 160, 120), ground_of(160, 120)))
    assert shade.value == pytest.approx(np.log(1.78), abs=0.06)
    assert scores["without"] < scores["shade"] - 0.1
    assert scores["shade"] > 0.85
    for _ in range(90):
        shade.fade(1 / 30)
    assert abs(shade.value) < 0.1


def paint(road: RoadMap, near: object) -> None:
    """Set the map by a function of ground points (n, 2) that gives log-odds."""
    assert callable(near)
    rows, columns = np.mgrid[0:1024, 0:1024]
    points = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * CELL + road._origin
    road._odds[:] = near(points).reshape(1024, 1024)


def bend(points: Floats) -> Floats:
    """A road 7 wide along X that turns right (towards +Y) on a radius of 25 from X = 20 on; seen to 60° of the bend."""
    x, y = points[:, 0], points[:, 1]
    around = np.hypot(x - 20.0, y - 25.0)
    on = np.where(x < 20.0, np.abs(y) < 3.5, (np.abs(around - 25.0) < 3.5) & (y < 25.0))
    angle = np.arctan2(x - 20.0, 25.0 - y)
    seen = (x < 20.0) | (angle < np.deg2rad(60))
    return np.where(seen, np.where(on, 3.0, -3.0), 0.0)


def test_the_way_follows_a_bend_and_keeps_its_distance_from_the_edge() -> None:
    road = RoadMap(np.zeros(2))
    paint(road, bend)
    road.prepare(np.array([0.0, 1.7]), 60.0)
    right, left = edges(road, np.array([[0.0, 1.7]]), np.zeros(1))
    assert right[0] == pytest.approx(1.8, abs=0.6)
    assert left[0] == pytest.approx(5.2, abs=0.6)
    way = trace(road, np.array([0.0, 1.7]), 0.0, 0.0, 44.0, (float(right[0]), float(left[0])))[0]
    radius = np.hypot(way.points[:, 0] - 20.0, way.points[:, 1] - 25.0)
    along_bend = (way.points[:, 0] > 24) & (np.arctan2(way.points[:, 0] - 20, 25 - way.points[:, 1]) < np.deg2rad(55))
    assert along_bend.sum() > 8
    assert np.abs(radius[along_bend] - 23.3).max() < 1.5


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_crowns_over_the_lane_do_not_push_the_way_off_it(side: float) -> None:
    """Four crowns hang over the lane and hide 2 to 3 units beyond its middle; the road below them goes straight on."""
    road = RoadMap(np.zeros(2))
    crowns = np.array([[6.0, 2.5], [13.0, 1.5], [22.0, 2.8], [30.0, 2.0]]) * [1.0, side]

    def under_trees(points: Floats) -> Floats:
        away = np.linalg.norm(points[:, None, :] - crowns, axis=2).min(axis=1)
        return np.where((np.abs(points[:, 1]) < 3.5) & (away > 3.0), 3.0, -3.0)

    paint(road, under_trees)
    keep = (1.75, 5.25) if side > 0 else (5.25, 1.75)
    way = trace(road, np.array([0.0, 1.75 * side]), 0.0, 0.0, 40.0, keep)[0]
    assert np.abs(way.points[:, 1] - 1.75 * side).max() < 1.2


def test_past_the_known_road_the_bend_goes_on_and_fades() -> None:
    road = RoadMap(np.zeros(2))
    paint(road, bend)
    way = trace(road, np.array([0.0, 0.0]), 0.0, 0.0, 75.0, (3.5, 3.5))[0]
    curvature = np.diff(way.headings) / 1.5
    end = int(way.known / 1.5)
    assert way.known < 60.0
    assert curvature[end : end + 3].mean() > 0.015
    assert abs(curvature[-1]) < 0.5 * curvature[end]


def test_a_crossing_gives_a_way_to_each_side() -> None:
    road = RoadMap(np.zeros(2))

    def cross(points: Floats) -> Floats:
        return np.where((np.abs(points[:, 1]) < 3.5) | (np.abs(points[:, 0] - 25.0) < 3.5), 3.0, -3.0)

    paint(road, cross)
    ways = trace(road, np.zeros(2), 0.0, 0.0, 50.0, (3.5, 3.5))
    ends = [way.points[-1] for way in ways]
    assert abs(ends[0][1]) < 2.0
    assert any(end[1] > 10.0 for end in ends)
    assert any(end[1] < -10.0 for end in ends)
    assert sum(way.weight for way in ways) == pytest.approx(1.0)


def test_the_map_learns_asphalt_from_a_picture_and_remembers_it_out_of_view() -> None:
    picture = np.full((240, 320, 3), (60, 130, 90), np.uint8)
    picture += np.random.default_rng(1).integers(0, 8, picture.shape, np.uint8)
    picture[100:140] = np.random.default_rng(2).integers(86, 96, (40, 320, 3), np.uint8)
    road = RoadMap(np.zeros(2))
    road.learn(picture[100:140].reshape(-1, 3), picture[::4, ::4].reshape(-1, 3), 1.0)
    road.update(picture, 1, PLANE, FROM_ABOVE, None)
    away: Floats = FROM_ABOVE @ np.array([[1.0, 0.0, 40.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for _ in range(3):
        road.update(picture, 1, PLANE, away, None)
    on = np.column_stack([np.linspace(-14, 14, 15), np.zeros(15)])
    off = np.column_stack([np.linspace(-14, 14, 15), np.full(15, 8.0)])
    assert (road.at(on) > 0.2).all()
    assert (road.at(off) < -0.2).all()
    assert (road.at(off + [0.0, 300.0]) == 0.0).all()


def test_the_fit_gives_velocity_and_turn_of_a_noisy_arc() -> None:
    rng = np.random.default_rng(4)
    seen = Sightings()
    for k in range(30):
        angle = 10.0 * k / 30 / 20.0  # 10 units/s on a radius of 20
        seen.add(k / 30, 20.0 * np.array([np.sin(angle), 1 - np.cos(angle)]) + rng.normal(0, 0.05, 2), 0.2)
    fit = seen.fit()
    assert fit is not None
    assert fit.speed == pytest.approx(10.0, abs=0.8)
    assert fit.heading == pytest.approx(10.0 * 29 / 30 / 20.0, abs=0.08)
    assert fit.turn_rate == pytest.approx(0.5, abs=0.25)
    assert abs(fit.speed - 10.0) < 4 * fit.velocity_std + 0.3


def test_what_a_hidden_part_holds_back_is_no_change_of_speed() -> None:
    """A bridge's edge stood still over the car's front: in four frames the fit braked from 10 to 6.7 units/s."""
    seen = Sightings()
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


def test_a_car_that_really_brakes_hard_is_believed() -> None:
    seen = Sightings()
    for k in range(45):
        t, braked = k / 30, max(k - 24, 0) / 30
        seen.add(t, np.array([10.0 * t - 0.5 * 7.0 * braked**2, 0.0]), 0.22)
        fit = seen.fit()
    assert fit is not None
    assert fit.speed == pytest.approx(10.0 - 7.0 * 20 / 30, abs=1.0)


def bending_way(radius: float) -> Way:
    """30 units straight on, then a bend to the right that goes on."""
    along = np.arange(0, 120, 1.5)
    headings = np.maximum(along - 30.0, 0.0) / radius
    steps = 1.5 * np.column_stack([np.cos(headings), np.sin(headings)])
    return Way(np.vstack([np.zeros(2), np.cumsum(steps, axis=0)[:-1]]), headings, 120.0, 1.0)


def straight_fit(speed: float, time: float = 0.0, across: float = 0.0) -> MotionFit:
    return MotionFit(time, np.zeros(2), np.array([speed, 0.0]), np.array([0.0, across]), 0.2, 0.3, 0.05, 20)


def test_the_speed_at_which_it_was_found_again_is_no_opinion_of_its_speed_later() -> None:
    """Found again at 7 units/s, it drove on at 10 round a bend: the fit stayed near 7, and it was lost."""
    seen, place = Sightings(), np.zeros(2)
    seen.begin_anew(np.array([7.0, 0.0]), 0.4)
    for k in range(240):
        course = 0.5 * np.pi * min(k / 120, 1.0)
        step = (10.0 if k > 30 else 7.0) / 30 * np.array([np.cos(course), np.sin(course)])
        place = place + step
        seen.add(k / 30, place, 0.22)
        fit = seen.fit()
        if k == 4:
            first = fit
    assert first is not None
    assert fit is not None
    assert first.velocity == pytest.approx([7.0, 0.0], abs=0.6)  # a few sightings tell little else
    assert fit.velocity == pytest.approx([0.0, 10.0], abs=0.2)


def test_who_is_out_of_sight_slows_down_for_a_bend_and_not_on_the_straight() -> None:
    rng = np.random.default_rng(0)
    for way, low, high in ((bending_way(15.0), 0.0, 8.6), (straight_way(), 9.3, 10.7)):
        cloud = clouds.launched(clouds.scattered(np.zeros(2), 0.1, 400, rng), straight_fit(10.0), 0.0, 400, rng)
        cloud = clouds.on_ways(cloud, [way], 1.0, rng)
        for _ in range(120):
            cloud = clouds.driven(cloud, 1 / 30, [way], False, rng)
        assert low < np.median(cloud.speed) < high


def test_out_of_a_bend_a_driver_goes_back_to_the_speed_of_the_straight() -> None:
    driving = Driving()
    for k in range(20):
        driving.saw(straight_fit(12.0, 0.1 * k))
    for k in range(20, 30):
        driving.saw(straight_fit(8.0, 0.1 * k, across=3.0))
    habits = driving.habits(straight_fit(8.0, 3.0, across=3.0), np.full(400, 8.0), np.random.default_rng(0))
    assert np.median(habits.cruise) == pytest.approx(12.0, abs=0.3)
    assert np.quantile(habits.sideways, 0.1) > 2.0  # it was seen to take that bend
    unknown = Driving().habits(straight_fit(8.0), np.full(400, 8.0), np.random.default_rng(0))
    assert np.median(unknown.cruise) == pytest.approx(8.0, abs=0.2)


@pytest.mark.parametrize(("height", "kind"), [(60.0, "metric"), (6e5, "attitude"), (3.0, "attitude")])
def test_a_height_from_which_the_target_is_a_toy_or_a_ship_is_not_believed(height: float, kind: str) -> None:
    clock = TelemetryClock(BODY_FROM_DOWN_CAMERA)
    for k in range(3):
        clock.add(Telemetry(k / 30, np.eye(3), np.array([0.0, 0.0, -height])))
    matrix = np.array([[600.0, 0.0, 159.5], [0.0, 600.0, 119.5], [0.0, 0.0, 1.0]])
    plane = ImagePlane((320, 240), Intrinsics(320, 240, matrix))
    root = root_from_telemetry(plane, clock, 1 / 30, Box(150.0, 110.0, 25.0, 12.0))
    assert root is not None
    assert root.kind == kind


def straight_way(known: float = 100.0) -> Way:
    points = np.column_stack([np.arange(0, 120, 1.5), np.zeros(80)])
    return Way(points, np.zeros(80), known, 1.0)


def test_particles_on_a_way_drive_along_it_and_spread_past_the_known_end() -> None:
    rng = np.random.default_rng(0)
    seen = Sightings()
    for k in range(20):
        seen.add(k / 30, np.array([-6.3 + 10.0 * k / 30, 0.0]), 0.2)
    fit = seen.fit()
    assert fit is not None
    spreads = []
    for known in (100.0, 5.0):
        cloud = clouds.scattered(np.zeros(2), 0.1, 400, rng)
        cloud = clouds.on_ways(clouds.launched(cloud, fit, 0.0, 400, rng), [straight_way(known)], 1.0, rng)
        for _ in range(60):
            cloud = clouds.driven(cloud, 1 / 30, [straight_way(known)], False, rng)
        assert np.median(cloud.place[:, 0]) == pytest.approx(20.0, abs=1.5)
        spreads.append(float(cloud.place[:, 1].std()))
    assert spreads[0] < 0.6
    assert spreads[1] > 1.5 * spreads[0]


def candidate(x: float, y: float, score: float = 0.95) -> Candidate:
    return Candidate(np.array([x, y]), score, 1.0, 0.9, 1.0)


def test_a_look_alike_that_drives_the_other_way_is_not_taken_for_the_target() -> None:
    rng = np.random.default_rng(0)
    cloud = clouds.scattered(np.zeros(2), 1.0, 400, rng)
    cloud = replace(cloud, heading=rng.normal(0.0, 0.05, 400), speed=rng.normal(10.0, 0.7, 400))
    for sign, taken in ((-1.0, False), (1.0, True)):
        tracklets = Tracklets()
        for k in range(6):
            seen = [candidate(1.0 + sign * 10.0 * (k - 5) / 30, 0.5)]
            tracks = tracklets.update(k / 30, seen)
        assert tracks[0].age == 6
        verdict = judge(cloud, seen, tracks, np.full(400, 0.3), lambda _: (0.25, 0.25), 4.5, True, lambda _: False)
        assert (verdict.best is not None) == taken


@pytest.mark.parametrize(("share", "taken"), [(0.45, False), (1.0, True)])
def test_half_a_look_alike_on_the_border_is_not_what_left(share: float, taken: bool) -> None:
    """The border moves after the target, and what it cuts off with it."""
    rng = np.random.default_rng(1)
    cloud = clouds.scattered(np.zeros(2), 1.0, 400, rng)
    cloud = replace(cloud, heading=rng.normal(0.0, 0.05, 400), speed=rng.normal(10.0, 0.7, 400))
    tracklets = Tracklets()
    for k in range(6):
        seen = [replace(candidate(1.0 + 10.0 * (k - 5) / 30, 0.5, 0.77), seen=share)]
        tracks = tracklets.update(k / 30, seen)
    verdict = judge(cloud, seen, tracks, np.full(400, 0.03), lambda _: (0.25, 0.25), 4.5, True, lambda _: False)
    assert (verdict.best is not None) == taken


@pytest.mark.parametrize(("at", "taken"), [((38.0, 0.0), False), ((3.0, 0.5), True)])
def test_a_look_alike_where_hardly_anything_expects_the_target_never_becomes_it(
    at: tuple[float, float], taken: bool
) -> None:
    """A car of the same make that follows the target is as alike in the hundredth frame as in the first."""
    rng = np.random.default_rng(3)
    cloud = clouds.scattered(np.zeros(2), 3.0, 400, rng)
    place = cloud.place.copy()
    place[0] = (38.0, 0.0)  # one who thinks that it goes that fast
    weights = np.full(400, 1.0 / 399.2)
    weights[0] = 0.0005
    cloud = replace(
        cloud, place=place, heading=rng.normal(0.0, 0.05, 400), speed=rng.normal(10.0, 0.7, 400), weights=weights
    )
    tracklets, found = Tracklets(), False
    for k in range(40):  # all in a frame that moves with the cars
        seen = [candidate(at[0] + 10.0 * k / 30, at[1])]
        moved = replace(cloud, place=place + np.array([10.0 * k / 30, 0.0]))
        tracks = tracklets.update(k / 30, seen)
        verdict = judge(moved, seen, tracks, np.full(400, 0.03), lambda _: (0.25, 0.25), 4.5, True, lambda _: False)
        assert verdict.likelihood is not None
        cloud = replace(cloud, weights=cloud.weighted(verdict.likelihood).weights)
        found |= verdict.best is not None
    assert found == taken


def test_the_heading_that_a_template_tells_counts_once_its_shape_fits() -> None:
    rng = np.random.default_rng(0)
    cloud = clouds.scattered(np.zeros(2), 0.3, 400, rng)
    heading = np.where(np.arange(400) < 200, 0.0, 0.6)
    cloud = replace(cloud, heading=heading, speed=np.full(400, 0.5))
    tracklets = Tracklets()
    for k in range(6):
        seen = [replace(candidate(0.0, 0.0), angle=0.6)]
        tracks = tracklets.update(k / 30, seen)
    for shaped, share in ((False, 0.5), (True, 0.9)):
        verdict = judge(
            cloud, seen, tracks, np.full(400, 0.3), lambda _: (0.25, 0.25), 4.5, True, lambda _, s=shaped: s
        )
        assert verdict.likelihood is not None
        got = cloud.weighted(verdict.likelihood).weights[200:].sum()
        assert got == pytest.approx(share, abs=0.1)


def spot(place: tuple[float, float], velocity: tuple[float, float], time: float) -> Tracklet:
    out = Tracklet()
    for k in range(8):
        ago = (7 - k) / 30
        out.add(time - ago, candidate(place[0] - ago * velocity[0], place[1] - ago * velocity[1]))
    return out


@pytest.mark.parametrize(
    ("place", "velocity", "low", "high"),
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
def test_what_may_be_the_target_by_the_way_it_must_have_driven(
    place: tuple[float, float], velocity: tuple[float, float], low: float, high: float
) -> None:
    fit = MotionFit(0.0, np.zeros(2), np.array([10.0, 0.0]), np.zeros(2), 0.2, 0.5, 0.05, 20)
    assert low <= plausible(spot(place, velocity, 3.0), fit, 4.5, 3.0) <= high


def test_where_nothing_is_seen_in_plain_view_particles_lose_weight() -> None:
    cloud = clouds.scattered(np.zeros(2), 3.0, 200, np.random.default_rng(0))
    chance = np.where(cloud.place[:, 0] > 0, 0.3, 0.0)
    verdict = judge(cloud, [], [], chance, lambda _: (0.25, 0.25), 4.5, True, lambda _: False)
    assert verdict.best is None
    assert verdict.likelihood is not None
    after = cloud.weighted(verdict.likelihood).weights
    assert after[cloud.place[:, 0] > 0].sum() < cloud.weights[cloud.place[:, 0] > 0].sum() - 0.05


def test_a_cloud_keeps_its_weights_where_everything_is_impossible() -> None:
    cloud = clouds.scattered(np.zeros(2), 1.0, 50, np.random.default_rng(0))
    np.testing.assert_array_equal(cloud.weighted(np.zeros(50)).weights, cloud.weights)
    assert (cloud.free().way == FREE).all()
