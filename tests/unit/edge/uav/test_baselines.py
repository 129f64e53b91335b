"""Baseline trackers: each part of the paper's tracker against its equation, and both trackers on a synthetic scene."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from edge.uav.adaptive_tracker import AdaptiveTracker
from edge.uav.base import Box, Tracker, TrackState
from edge.uav.baselines import histograms, regions, road
from edge.uav.baselines.background import BackgroundFilter, BackgroundMotion, predicted_flow
from edge.uav.baselines.car_models import move_with_background
from edge.uav.baselines.paper_tracker import PaperTracker
from edge.uav.baselines.plain_tracker import AppearanceTest, PlainTracker
from edge.uav.baselines.road_filter import RoadFilter, align_to_edges, line_support
from edge.uav.baselines.white_lines import EdgeDistance, find_sections
from protocols.core.errors import InputError
from protocols.geometry.types import Floats, Image

SIZE = (640, 480)
CENTRE = np.array([319.5, 239.5])
CAR = Box(297.0, 246.0, 46.0, 21.0)
_RED, _ROOF = (40, 40, 200), (30, 30, 120)


@cache
def ground() -> Image:
    """A wide meadow with a straight road, white lines at both sides, and houses; the road's middle is row 500."""
    rng = np.random.default_rng(0)
    patches = cv2.resize(rng.normal(0.0, 1.0, (250, 500)).astype(np.float32), (2000, 1000))
    image = np.clip(np.array([60, 120, 80]) + 18 * patches[..., None] + rng.normal(0, 4, (1000, 2000, 1)), 0, 255)
    image[464:537] = 100 + 4 * patches[464:537, :, None]
    for row in (468, 530):
        image[row : row + 3] = 230
    for column in range(60, 1900, 260):
        cv2.rectangle(image, (column, 300), (column + 90, 380), (160, 110, 60), -1)
    return np.asarray(image, dtype=np.uint8)


def camera_image(left: float, car: float | None, seed: int = 0) -> Image:
    """Image of a camera whose left border is at column ``left`` of the ground, with a car at image column ``car``."""
    shift = np.array([[1.0, 0.0, -left], [0.0, 1.0, -244.0]])
    image = cv2.warpAffine(ground(), shift, SIZE)
    if car is not None:
        for half, colour in ((23.0, _RED), (10.0, _ROOF)):
            corner = np.array([[car - half, 246.0], [car + half, 246.0], [car + half, 266.0], [car - half, 266.0]])
            cv2.fillConvexPoly(image, np.rint(corner * 16).astype(np.int32), colour, cv2.LINE_AA, 4)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def test_equation_2_7_is_one_for_the_same_histogram_and_nought_for_disjoint_ones() -> None:
    p = np.zeros(histograms.BINS)
    p[[3, 5]] = 0.25, 0.75
    other = np.zeros(histograms.BINS)
    other[7] = 1.0
    mixed = 0.5 * (p + other)
    expected = [1.0, 0.0, np.sqrt(0.5)]
    np.testing.assert_allclose(histograms.bhattacharyya(p, np.array([p, other, mixed])), expected)
    np.testing.assert_allclose(histograms.colour_log_likelihood(np.array(expected))[:2], [0.0, -20.0])


def test_greys_share_a_bin_and_hues_do_not() -> None:
    colours = np.array([[100, 100, 100], [200, 200, 200], [4, 4, 24], [40, 40, 200], [200, 40, 40]], dtype=np.uint8)
    bins = histograms.colour_bins(colours)
    assert list(bins[:3]) == [0, 0, 0]
    assert len(set(bins[2:].tolist())) == 3


def test_3_13_a_box_outside_takes_the_mean_and_one_partly_outside_is_filled_from_the_border() -> None:
    image = np.full((480, 640, 3), (60, 140, 80), dtype=np.uint8)
    image[:, :60] = _RED
    box = Box(0.0, 100.0, 40.0, 40.0)
    template, mean = histograms.target_histogram(image, box), histograms.mean_histogram(image)
    places = np.array([[30.0, 200.0], [-10.0, 200.0], [-300.0, 200.0], [400.0, 200.0]])
    whole, partly, outside, green = histograms.border_filled_similarity(image, places, box, template, mean)
    assert whole == pytest.approx(1.0)
    assert partly == pytest.approx(1.0)
    assert outside == pytest.approx(histograms.bhattacharyya(template, mean[None])[0])
    assert green == 0.0
    plain = histograms.visible_similarity(image, places, box, template)
    assert plain[1] < 0.6
    assert plain[2] == 0.0


def test_4_17_4_18_flow_and_4_19_agree_on_the_sign_of_the_background_rotation() -> None:
    points = np.array([[100.0, 0.0], [0.0, 100.0], [-50.0, 70.0]])
    h = np.array([[3.0, -2.0, 0.001]])
    flow = predicted_flow(h, points)[0]
    np.testing.assert_allclose(flow[0], [3.0, -2.0 + 0.1])
    np.testing.assert_allclose(flow[1], [3.0 - 0.1, -2.0])
    moved = BackgroundMotion(3.0, -2.0, 0.001).moved(points + CENTRE, CENTRE) - CENTRE
    np.testing.assert_allclose(moved - points, flow, atol=1e-3)


def test_4_19_to_4_21_drive_and_turn_with_the_background() -> None:
    motion = BackgroundMotion(10.0, -4.0, 0.1)
    state = np.array([[*CENTRE, 5.0, 0.3]])
    x, y, speed, heading = move_with_background(state, motion, CENTRE, np.array([0.5]), np.array([0.0]))[0]
    np.testing.assert_allclose([x, y], CENTRE + [10.0 + 5.0 * np.cos(0.4), -4.0 + 5.0 * np.sin(0.4)])
    assert (speed, heading) == (5.5, pytest.approx(0.4))


def test_the_background_filter_follows_shift_and_turn() -> None:
    rng = np.random.default_rng(2)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (900, 1100)).astype(np.uint8), (0, 0), 3.0)
    texture = cv2.normalize(texture, np.zeros_like(texture), 20, 230, cv2.NORM_MINMAX).astype(np.uint8)
    background, total = BackgroundFilter(SIZE, np.random.default_rng(0)), CENTRE[None] + [80.0, -100.0]
    start = np.array([total[0, 0], total[0, 1], 1.0])
    for k in range(25):
        cos, sin = np.cos(0.004 * k), np.sin(0.004 * k)
        matrix = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
        matrix[:, 2] = CENTRE - matrix[:, :2] @ [550.0 + 3.0 * k, 450.0 - 2.0 * k]
        if k == 0:
            first = np.linalg.inv(np.vstack([matrix, [0.0, 0.0, 1.0]]))
            background.begin(cv2.warpAffine(texture, matrix, SIZE), CAR)
            continue
        motion = background.step(cv2.warpAffine(texture, matrix, SIZE), None)
        total = motion.moved(total, CENTRE)
    assert motion.rotation == pytest.approx(0.004, abs=0.0005)
    assert np.hypot(*(total[0] - matrix @ (first @ start))) < 5.0


def _arc(radius: float = 300.0) -> Floats:
    angle = np.linspace(0.0, 1.2, 40)
    return np.column_stack([300.0 + radius * np.sin(angle), 100.0 + radius * (1.0 - np.cos(angle))])


def test_3_1_the_spline_keeps_to_an_arc_and_continues_it_a_little() -> None:
    extrapolated = road.extrapolated_course(road.RoadMidline(_arc(), 30.0), 60.0, 5.0)
    off = np.abs(np.hypot(extrapolated.points[:, 0] - 300.0, extrapolated.points[:, 1] - 400.0) - 300.0)
    assert off[extrapolated.known].max() < 1.0
    assert off.max() < 6.0
    assert not extrapolated.known.all()


def test_3_9_the_roads_heading_is_the_tangent_or_its_opposite() -> None:
    line = np.column_stack([np.full(30, 50.0), np.arange(30) * 10.0])  # runs across the image: x = S(y) is impossible
    distance, tangent = road.extrapolated_course(road.RoadMidline(line, 30.0), 50.0, 5.0).nearest(
        np.array([[62.0, 140.0]])
    )
    assert distance[0] == pytest.approx(12.0, abs=0.1)
    assert tangent[0] == pytest.approx(np.pi / 2)
    assert road.road_heading(tangent, -1.0)[0] == pytest.approx(1.5 * np.pi)


def test_3_11_3_12_and_4_22_are_one_at_their_best() -> None:
    distance, colour = np.array([0.0, 30.0]), np.array([0.0, -20.0])
    on_road = road.road_log_likelihood(distance, 30.0)
    np.testing.assert_allclose(on_road, [0.0, -1.0])
    mixed = np.exp(road.mixture_log_likelihood(colour, on_road, 0.75))
    np.testing.assert_allclose(mixed, [1.0, 0.75 * np.exp(-20.0) + 0.25 * np.exp(-1.0)])
    angles = road.orientation_log_likelihood(np.array([np.pi - 0.1]), np.array([-np.pi + 0.1]), 0.2)
    assert angles[0] == pytest.approx(-0.5)


def test_3_3_to_3_8_trace_the_white_lines_through_the_whole_image() -> None:
    grey = cv2.cvtColor(camera_image(300.0, 320.0), cv2.COLOR_BGR2GRAY)
    edges = EdgeDistance.of(grey)
    found = RoadFilter(SIZE, np.random.default_rng(0)).begin(edges, find_sections(grey, CAR))
    assert found is not None
    assert np.ptp(found.points[:, 0]) > 500.0
    assert np.abs(found.points[:, 1] - 256.5).max() < 4.0  # the lines are at rows 225.5 and 287.5
    assert found.half_width == pytest.approx(31.0, abs=2.0)
    assert line_support(found, edges)[1] > 0.9


@pytest.mark.parametrize("count", [2, 5, 6, 7, 8, 40])
def test_a_road_of_any_length_is_aligned_to_the_edges(count: int) -> None:
    """A road of six points, one fewer than the smoothing window, once raised IndexError on a real video."""
    grey = cv2.cvtColor(camera_image(300.0, 320.0), cv2.COLOR_BGR2GRAY)
    held = road.RoadMidline(np.column_stack([100.0 + 12.0 * np.arange(count), np.full(count, 251.0)]), 31.0)
    moved = align_to_edges(held, EdgeDistance.of(grey))
    assert moved.points.shape == (count, 2)
    if count >= 6:  # half of the way towards the middle between the lines, at most 4 px of it
        assert 252.0 < moved.points[:, 1].mean() < 254.0


def test_no_road_is_found_where_there_is_none() -> None:
    grey = cv2.cvtColor(ground()[560:1000, :640], cv2.COLOR_BGR2GRAY)
    box = Box(300.0, 200.0, 46.0, 21.0)
    assert (
        RoadFilter((640, 440), np.random.default_rng(0)).begin(EdgeDistance.of(grey), find_sections(grey, box)) is None
    )


_STATISTICS = regions.RegionStatistics(
    np.full(3, 100.0), np.full(3, 25.0), np.array([60.0, 130.0, 80.0]), np.full(3, 64.0)
)


def test_4_5_to_4_9_road_other_and_building_where_it_is_neither() -> None:
    pixels = np.array([[[100, 104, 97], [62, 125, 84], [60, 60, 160]]], dtype=np.uint8)
    assert regions.classify(pixels, _STATISTICS).tolist() == [[regions.ROAD, regions.OTHER, regions.BUILDING]]
    distance = regions.band_distances(np.array([105.0, 110.0, 100.0]), _STATISTICS.road_mean, _STATISTICS.road_variance)
    assert float(distance) == pytest.approx(1.0 + 4.0)


def test_the_roads_shape_corrects_regions_and_extends_them_beyond_the_image() -> None:
    labels = np.full((120, 160), regions.OTHER, dtype=np.uint8)
    labels[:, 120:] = regions.BUILDING
    line = np.column_stack([np.arange(0.0, 640.0, 16.0), np.full(40, 240.0)])
    extrapolated = road.extrapolated_course(road.RoadMidline(line, 32.0), 400.0, 6.0)
    fixed = regions.corrected(labels, extrapolated)
    assert (fixed[53:67] == regions.ROAD).all()
    assert fixed[10, 10] == regions.OTHER
    assert fixed[10, 150] == regions.BUILDING
    places = np.array([[320.0, 240.0], [800.0, 240.0], [100.0, 60.0], [-100.0, 60.0], [800.0, 60.0]])
    probable = np.exp(regions.existence(fixed, extrapolated, Box(0.0, 0.0, 24.0, 24.0)).log_likelihood(places))
    np.testing.assert_allclose(probable, [1.0, 1.0, 0.8, 0.8, 0.1], atol=1e-5)


def test_statistics_follow_the_illumination() -> None:
    brighter = np.full((20, 20, 3), 120, dtype=np.uint8)
    labels, road_pixels = np.full((20, 20), regions.ROAD, dtype=np.uint8), np.ones((20, 20), dtype=np.bool_)
    statistics = _STATISTICS
    for _ in range(60):
        statistics = statistics.adapted(brighter, labels, road_pixels)
    assert statistics.road_mean == pytest.approx(np.full(3, 120.0), abs=5.0)
    np.testing.assert_array_equal(statistics.other_mean, _STATISTICS.other_mean)


def test_the_appearance_test_accepts_the_target_and_not_the_background() -> None:
    appearance_test = AppearanceTest.from_surroundings(
        camera_image(300.0, 320.0), CAR, histograms.target_histogram(camera_image(300.0, 320.0), CAR)
    )
    assert appearance_test.background < 0.6
    assert appearance_test.accepts(0.95)
    assert not appearance_test.accepts(appearance_test.background)


def _flight(tracker: Tracker, frames: int, leaving: int) -> tuple[list[TrackState], list[float]]:
    """The car drives at 3 px a frame; from frame leaving on the drone slows down, flies backwards and so loses it."""
    states, errors, left = [], [], 300.0
    for k in range(frames):
        left += 0.0 if k == 0 else 3.0 - min(max(k - leaving, 0), 15)
        car = 620.0 + 3.0 * k - left
        image = camera_image(left, car if car < 680.0 else None, k)
        estimate = tracker.begin(image, 0.0, CAR) if k == 0 else tracker.handle_frame(image, k / 30.0)
        states.append(estimate.state)
        errors.append(float(np.hypot(estimate.x - car, estimate.y - 256.0)))
    return states, errors


def test_the_plain_tracker_tracks_a_visible_target_and_reports_its_loss() -> None:
    states, errors = _flight(PlainTracker(SIZE), 110, 15)
    assert max(errors[:40]) < 15.0
    assert set(states[:40]) == {TrackState.VISIBLE}
    assert TrackState.VISIBLE not in states[50:]
    assert states[-1] is TrackState.LOST


def test_the_paper_tracker_follows_the_car_out_of_view_where_the_plain_one_cannot() -> None:
    states, errors = _flight(PaperTracker(SIZE, section=3), 64, 15)
    assert max(errors[:40]) < 15.0
    assert set(states[52:]) == {TrackState.COASTING}
    assert max(errors) < 46.0  # a car's length
    assert _flight(PlainTracker(SIZE), 64, 15)[1][-1] > 80.0


def test_section_4_tracks_while_visible_and_coasts_out_of_view() -> None:
    tracker = PaperTracker(SIZE)
    states, errors = _flight(tracker, 56, 15)
    assert max(errors[:40]) < 15.0
    assert set(states[52:]) == {TrackState.COASTING}
    assert tracker.diagnostics.course is not None
    assert tracker.diagnostics.motion.x == pytest.approx(12.0, abs=0.4)


def test_the_same_seed_gives_the_same_track() -> None:
    assert _flight(PaperTracker(SIZE, seed=3), 6, 3)[1] == _flight(PaperTracker(SIZE, seed=3), 6, 3)[1]


@pytest.mark.parametrize("tracker", [PlainTracker, PaperTracker, AdaptiveTracker])
@pytest.mark.parametrize(
    "box",
    [
        Box(700.0, 10.0, 40.0, 20.0),
        Box(100.0, 100.0, 2.0, 2.0),
        Box(float("nan"), 1.0, 9.0, 9.0),
        Box(1.0, 1.0, -5.0, 9.0),
    ],
)
def test_an_invalid_box_is_refused(
    tracker: type[PlainTracker] | type[PaperTracker] | type[AdaptiveTracker], box: Box
) -> None:
    with pytest.raises(InputError):
        tracker(SIZE).begin(camera_image(300.0, 320.0), 0.0, box)


@pytest.mark.parametrize("tracker", [PlainTracker, PaperTracker])
def test_bad_frames_are_coasted_over(tracker: type[PlainTracker] | type[PaperTracker]) -> None:
    follower = tracker(SIZE)
    follower.begin(camera_image(300.0, 320.0), 0.0, CAR)
    bad: list[Image | None] = [None, np.zeros((10, 10, 3), dtype=np.uint8), np.zeros((480, 640), dtype=np.uint8)]
    for k, image in enumerate(bad, 1):
        assert follower.handle_frame(image, k / 30.0).state is TrackState.COASTING
    for k in range(4, 10):
        estimate = follower.handle_frame(np.zeros((480, 640, 3), dtype=np.uint8), k / 30.0)
    assert np.isfinite([estimate.std, estimate.width]).all()
    with pytest.raises(InputError):
        tracker(SIZE).begin(np.zeros((480, 640), dtype=np.uint8), 0.0, CAR)
