"""Track smoothing: outlier rejection, noise estimation, gaps and discontinuities."""

from __future__ import annotations

import numpy as np
import pytest

from hub.trajectory.image_tracks import SmoothTrack, neighbour_test, smooth_track
from protocols.geometry.types import Bools, Floats
from tests.support.rigs import random_path

FOCAL = 1000.0


def track(seed: int, seconds: float = 30.0, fps: float = 30.0, noise_px: float = 0.5) -> tuple[Floats, Floats, Floats]:
    """Time (n,), noisy and true normalised points (n, 2), moving by some hundred pixels a second."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, 1 / fps) + rng.normal(0, 1e-4, round(seconds * fps))
    truth = 0.3 * random_path(rng).at(time)[:, :2]
    return time, truth + rng.normal(0, noise_px / FOCAL, truth.shape), truth


def smoothed(time: Floats, points: Floats, time_origin: float | None = None) -> SmoothTrack:
    found = smooth_track(time, points, FOCAL, time_origin)
    assert found is not None
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("noise_px", [0.3, 1.0, 3.0])
def test_the_noise_is_estimated_within_fifteen_percent(seed: int, noise_px: float) -> None:
    time, points, _ = track(seed, noise_px=noise_px)
    assert smoothed(time, points).sigma_px == pytest.approx(noise_px, rel=0.15)


@pytest.mark.parametrize("fps", [10.0, 25.0, 60.0])
def test_the_noise_is_estimated_at_any_frame_rate(fps: float) -> None:
    time, points, _ = track(1, seconds=60, fps=fps, noise_px=0.8)
    assert smoothed(time, points).sigma_px == pytest.approx(0.8, rel=0.15)


@pytest.mark.parametrize("seed", range(4))
def test_smoothing_brings_points_nearer_to_the_truth(seed: int) -> None:
    time, points, truth = track(seed, noise_px=1.0)
    found = smoothed(time, points).at(time - time[0])
    error = np.sqrt(np.nanmean((found - truth) ** 2)) * FOCAL
    assert error < 0.6


def test_the_speed_is_the_slope_of_the_track() -> None:
    time, points, truth = track(2, noise_px=0.2)
    found = smoothed(time, points).at(time - time[0], 1)
    slope = np.gradient(truth, time, axis=0)
    inner = slice(30, -30)
    scale = np.abs(slope).max()
    assert np.sqrt(np.mean((found - slope)[inner] ** 2)) < 0.03 * scale


@pytest.mark.parametrize("share", [0.05, 0.2, 0.35])
def test_false_detections_are_rejected_and_true_ones_kept(share: float) -> None:
    time, points, _ = track(3, seconds=40)
    rng = np.random.default_rng(9)
    false = rng.random(len(time)) < share
    points[false] = rng.uniform(-0.6, 0.6, (int(false.sum()), 2))
    inlier = smoothed(time, points).inlier
    far = false.copy()
    assert inlier[far].mean() < 0.05
    assert inlier[~false].mean() > 0.95 if share < 0.3 else inlier[~false].mean() > 0.8


def test_static_false_detections_are_rejected() -> None:
    """A lamp in the background that the detector takes for the marker now and then."""
    time, points, truth = track(4, seconds=40)
    false = np.random.default_rng(1).random(len(time)) < 0.15
    points[false] = [0.2, 0.1]
    far = false & (np.linalg.norm(truth - [0.2, 0.1], axis=1) * FOCAL > 20)
    assert smoothed(time, points).inlier[far].mean() < 0.05


def test_isolated_outliers_of_twelve_sigma_are_rejected() -> None:
    time, points, _ = track(5, seconds=40, noise_px=0.5)
    false = np.zeros(len(time), dtype=bool)
    false[20::25] = True
    points[false] += 6.0 / FOCAL  # 12 sigma in each coordinate, and never two in a row
    inlier = smoothed(time, points).inlier
    assert inlier[false].mean() < 0.05
    assert inlier[~false].mean() > 0.97


def test_gaps_separate_stretches() -> None:
    time, points, _ = track(5, seconds=20)
    keep = (time < 8) | (time > 9.5)
    found = smoothed(time[keep], points[keep])
    assert np.isnan(found.at(np.array([8.5, 9.0]) - found.time_origin)).all()
    assert np.isfinite(found.at(np.array([7.8, 9.7]) - found.time_origin)).all()
    assert len(found.basis.starts) == 2


def test_a_few_dropped_frames_are_bridged() -> None:
    time, points, truth = track(6, seconds=20)
    keep = np.ones(len(time), dtype=bool)
    keep[200:204] = False
    found = smoothed(time[keep], points[keep])
    error = np.linalg.norm(found.at(time[200:204] - found.time_origin) - truth[200:204], axis=1) * FOCAL
    assert error.max() < 3


def test_labels_on_every_fourth_frame_make_one_track() -> None:
    """Interpolating tools label at 7.5 per second: gaps are of the labels' interval, not of 0.2 s."""
    time, points, truth = track(7, seconds=40)
    time, points, truth = time[::8], points[::8], truth[::8]  # 3.75 a second: 0.27 s apart
    found = smoothed(time, points)
    assert len(found.basis.starts) == 1
    assert found.inlier.mean() > 0.95


def test_labels_interpolated_between_keyframes_are_not_rejected() -> None:
    """Labels interpolated linearly between manual ones have no noise, and kinks."""
    time, _, truth = track(8, seconds=40)
    keys = np.arange(0, len(time), 12)
    points = np.column_stack([np.interp(time, time[keys], truth[keys, d]) for d in range(2)])
    found = smoothed(time, points)
    assert found.inlier.mean() > 0.8
    assert found.sigma_px >= 0.05


def test_a_large_epoch_costs_no_precision() -> None:
    time, points, _ = track(9)
    near, far = smoothed(time, points), smoothed(time + 1.7e9, points)
    assert far.time_origin == time[0] + 1.7e9
    np.testing.assert_allclose(far.time, near.time, atol=5e-7)
    assert far.sigma == pytest.approx(near.sigma, rel=1e-3)


def test_an_epoch_of_zero_is_an_epoch() -> None:
    time, points, _ = track(9)
    found = smoothed(time + 5.0, points, time_origin=0.0)
    assert found.time_origin == 0.0
    assert found.time[0] > 4.9


def test_rows_with_nan_are_left_out() -> None:
    time, points, _ = track(10)
    points[::7] = np.nan
    found = smoothed(time, points)
    assert not found.inlier[::7].any()
    assert found.inlier.mean() > 0.8
    assert len(found.time) == found.inlier.sum()


@pytest.mark.parametrize("count", [0, 1, 3, 7])
def test_too_few_rows_are_no_track(count: int) -> None:
    time, points, _ = track(11)
    assert smooth_track(time[:count], points[:count], FOCAL) is None


def test_points_that_are_all_nan_are_no_track() -> None:
    time, points, _ = track(11)
    assert smooth_track(time, points * np.nan, FOCAL) is None


def test_rows_scattered_over_minutes_are_no_track() -> None:
    rng = np.random.default_rng(0)
    time = np.sort(np.concatenate([[k * 60, k * 60 + 0.03] for k in range(10)]))
    found = smooth_track(time, rng.normal(0, 0.1, (20, 2)), FOCAL)
    assert found is None or np.isnan(found.at(np.array([30.0]))).all()


def test_pure_noise_does_not_pass_for_a_good_track() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(0, 20, 1 / 30)
    found = smooth_track(time, rng.uniform(-0.5, 0.5, (600, 2)), FOCAL)
    assert found is None or found.sigma_px > 20 or found.inlier.mean() < 0.4


def test_a_still_point_is_a_good_track() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(0, 20, 1 / 30)
    found = smoothed(time, 0.1 + rng.normal(0, 0.5 / FOCAL, (600, 2)))
    assert found.sigma_px == pytest.approx(0.5, rel=0.15)
    assert found.inlier.mean() > 0.98


def test_identical_points_are_a_track_without_noise() -> None:
    found = smoothed(np.arange(0, 20, 1 / 30), np.full((600, 2), 0.1))
    assert found.inlier.all()
    np.testing.assert_allclose(found.at(np.array([3.3, 10.0])), 0.1, atol=1e-6)


def test_the_callers_arrays_are_not_changed() -> None:
    time, points, _ = track(12)
    before = time.copy(), points.copy()
    smooth_track(time, points, FOCAL)
    np.testing.assert_array_equal(time, before[0])
    np.testing.assert_array_equal(points, before[1])


@pytest.mark.parametrize("typical", [0.2, 5.0])
def test_a_track_more_or_less_exact_than_the_cameras_others_is_smoothed_as_if_alone(typical: float) -> None:
    """A head beside its foot: what a fit absorbs was counted as for rows of the camera's typical noise, so the head's
    knots were chosen twice as dense as its frames, and its path followed every row."""
    time, points, _ = track(5, fps=10.0, noise_px=2.0)
    alone = smoothed(time, points)
    found = smooth_track(time, points, FOCAL, relative_std=np.full(len(time), typical))
    assert found is not None
    assert found.basis.spacing == alone.basis.spacing
    np.testing.assert_allclose(found.control, alone.control, rtol=1e-9, atol=1e-12)
    assert found.sigma == pytest.approx(alone.sigma / typical)


def test_the_neighbour_test_tolerates_forty_percent_of_outliers() -> None:
    time, points, _ = track(13, seconds=60)
    rng = np.random.default_rng(2)
    false = rng.random(len(time)) < 0.4
    points[false] = rng.uniform(-0.6, 0.6, (int(false.sum()), 2))
    good = neighbour_test(time, points, floor=1.5 / FOCAL)
    assert good[~false].mean() > 0.6
    assert good[false].mean() < 0.15


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_neighbour_test_takes_any_number_of_rows(count: int) -> None:
    time, points, _ = track(14)
    assert neighbour_test(time[:count], points[:count], 1e-3).shape == (count,)


def fast_track(seed: int, fps: float, slowest: float, fastest: float, noise_px: float) -> tuple[Floats, Floats, Floats]:
    """Time (n,), noisy and true normalised points (n, 2) of motion between two frequencies [Hz]."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 30, 1 / fps)
    frequency, phase = rng.uniform(slowest, fastest, (2, 6)), rng.uniform(0, 2 * np.pi, (2, 6))
    truth = np.stack(
        [0.04 * np.sin(2 * np.pi * np.outer(time, f) + p).sum(axis=1) for f, p in zip(frequency, phase, strict=True)], 1
    )
    return time, truth + rng.normal(0, noise_px / FOCAL, truth.shape), truth


@pytest.mark.parametrize("seed", range(4))
def test_a_fast_track_of_a_slow_camera_is_interpolated(seed: int) -> None:
    """Three points per period: the spline must follow the object between them too."""
    time, points, truth = fast_track(seed, 60.0, 0.5, 3.0, 0.5)
    rows = np.arange(0, len(time), 6)  # 10 fps
    found = smoothed(time[rows], points[rows])
    assert found.inlier.mean() > 0.97
    assert len(found.discontinuities) == 0
    error = np.linalg.norm(found.at(time) - truth, axis=1)[30:-30] * FOCAL
    at_rows = np.isin(np.arange(30, len(time) - 30), rows)
    assert np.sqrt(np.mean(error[at_rows] ** 2)) < 0.95  # the points themselves: 0.71
    assert np.median(error) < 1.2
    assert np.quantile(error, 0.95) < 2.5  # of swings of some 100 px


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("fps", "fastest"), [(10.0, 3.0), (30.0, 1.2), (30.0, 3.0)])
def test_a_smooth_fast_track_has_no_discontinuities(seed: int, fps: float, fastest: float) -> None:
    time, points, _ = fast_track(seed, fps, 0.05, fastest, 0.5)
    found = smoothed(time, points)
    assert len(found.discontinuities) == 0
    assert found.inlier.mean() > 0.97


CUTS = np.array([5.0, 7.0, 15.0, 16.5])


def two_objects(seed: int, away: float) -> tuple[Floats, Floats, Bools, Floats]:
    """A track that follows another object in two intervals: time, points, its rows, and the steps [px] at CUTS."""
    time, points, _ = fast_track(seed, 30.0, 0.05, 1.2, 0.5)
    _, other, _ = fast_track(seed + 50, 30.0, 0.05, 1.2, 0.5)
    intervals = np.searchsorted(CUTS, time + 1e-9)
    second = intervals % 2 == 1
    points[second] = other[second] + away
    before, after = (np.searchsorted(time, CUTS - 1e-9) + step for step in (-1, 0))
    return time, points, second, np.linalg.norm(points[before] - points[after], axis=1) * FOCAL


@pytest.mark.parametrize("seed", range(4))
def test_discontinuities_are_detected_where_another_object_is_followed(seed: int) -> None:
    time, points, second, _ = two_objects(seed, 0.5)
    found = smoothed(time, points)
    assert len(found.discontinuities) == len(CUTS)
    np.testing.assert_allclose(found.discontinuities, CUTS, atol=0.05)
    assert found.inlier[second].mean() > 0.8, "the second object is a track of its own, no outlier"
    again = found.at(found.time)
    error = np.linalg.norm(again - points[found.inlier], axis=1) * FOCAL
    assert error.max() < 5.0, "the spline smooths over a discontinuity"


def test_most_discontinuities_to_a_near_object_are_detected() -> None:
    hits, extra = [], 0
    for seed in range(8):
        time, points, _, far = two_objects(seed, 0.0)
        discontinuities = smoothed(time, points).discontinuities
        hits += [
            bool(len(discontinuities)) and bool(np.abs(discontinuities - cut).min() < 0.06) for cut in CUTS[far > 60]
        ]
        extra += sum(bool(np.abs(CUTS - jump).min() > 0.06) for jump in discontinuities)
    assert np.mean(hits) > 0.7
    assert extra == 0


def test_single_outliers_are_no_discontinuities() -> None:
    time, points, _ = fast_track(1, 30.0, 0.05, 1.2, 0.5)
    points[50::60] += 0.2
    found = smoothed(time, points)
    assert len(found.discontinuities) == 0
    assert not found.inlier[50::60].any()


def test_a_scaled_track_shows_the_same_points_later() -> None:
    time, points, _ = fast_track(2, 30.0, 0.05, 1.2, 0.5)
    found = smoothed(time, points)
    slow = found.scaled(1.25)
    when = np.linspace(1, 28, 200)
    np.testing.assert_allclose(slow.at(1.25 * when), found.at(when), atol=1e-12)
    point, speed = slow.point_and_velocity(1.25 * when)
    np.testing.assert_allclose(point, found.at(when), atol=1e-12)
    np.testing.assert_allclose(1.25 * speed, found.at(when, 1), atol=1e-9)
    assert slow.span == pytest.approx(1.25 * found.span)


def test_rows_weigh_as_the_detector_says() -> None:
    """Half of the rows have six times the noise: smoothed by their stds, the track is nearer to the truth."""
    rng = np.random.default_rng(5)
    time = np.arange(600) / 30.0
    truth = 0.2 * np.column_stack([np.sin(2.1 * time), np.cos(1.3 * time)])
    relative = np.where(rng.random(len(time)) < 0.5, 1.0, 6.0)
    points = truth + rng.normal(0.0, 0.5 / FOCAL, truth.shape) * relative[:, None]
    errors = []
    for stds in (None, relative):
        found = smooth_track(time, points, FOCAL, relative_std=stds)
        assert found is not None
        errors.append(float(np.sqrt(np.nanmean((found.at(time) - truth) ** 2))))
    assert errors[1] < 0.75 * errors[0]
