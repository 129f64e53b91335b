"""The scores find what was put in: a known similarity, time map, gap, lag and pose."""

from __future__ import annotations

import numpy as np
import pytest

from protocols.core.clocks import TimeMap
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats
from tests.bench import scoring

MOVE = Similarity(0.31, so3.exp(np.array([0.4, -1.1, 0.7])), np.array([3.0, -2.0, 0.5]))
RATE, OFFSET = 1.0 + 7e-4, -41.3


def path(time: Floats) -> Floats:
    """A drone that stands for 40 s, then flies without repeating itself."""
    t = np.maximum(time - 40.0, 0.0)
    t = np.where(t < 4.0, t**2 / 8.0, t - 2.0)  # it starts gently
    x = 6 * np.sin(0.31 * t) + 2 * np.sin(0.83 * t + 1)
    y = 5 * np.sin(0.23 * t + 0.4) + 1.5 * np.sin(1.07 * t)
    return np.column_stack([x, y, 3 + 2 * np.sin(0.41 * t) + np.sin(0.13 * t + 2)])


def truth() -> tuple[Floats, Floats]:
    time = np.arange(0.0, 160.0, 0.2)
    return time, path(time)


def estimate(noise: float = 0.0, first: float = 20.0, last: float = 140.0) -> tuple[Floats, Floats]:
    """The truth on another clock and in another world: truth time = RATE t + OFFSET."""
    time = np.arange((first - OFFSET) / RATE, (last - OFFSET) / RATE, 1 / 30)
    position = path(RATE * time + OFFSET)
    position = position + np.random.default_rng(1).normal(0, noise, position.shape)
    inverse = Similarity(1 / MOVE.scale, MOVE.rotation.T, -MOVE.rotation.T @ MOVE.shift / MOVE.scale)
    return time, inverse.points(position)


def test_the_map_in_time_and_space_is_found_without_a_guess() -> None:
    found = scoring.align(*estimate(), *truth())
    assert found.rate == pytest.approx(RATE, abs=2e-5)
    time = estimate()[0]
    middle = float(time.mean())
    assert found.rate * middle + found.offset == pytest.approx(RATE * middle + OFFSET, abs=1e-3)
    assert found.similarity.scale == pytest.approx(MOVE.scale, rel=1e-3)
    assert found.rmse < 0.003


def test_noise_comes_out_as_the_error_that_was_put_in() -> None:
    mean, median, rmse, p95 = scoring.align(*estimate(noise=0.05), *truth()).figures()
    # Linear interpolation of a 30 Hz path averages two rows, so a little less than 0.05 sqrt(3).
    assert 0.055 < rmse < 0.05 * np.sqrt(3) * 1.05
    assert median < mean < rmse < p95


def test_no_outlier_is_left_out() -> None:
    time, position = estimate()
    spoiled = position.copy()
    spoiled[1500:1530] += 100.0
    assert scoring.align(time, spoiled, *truth()).error.max() > 1.0


def test_rest_does_not_count() -> None:
    found = scoring.align(*estimate(), *truth())
    assert found.time.min() > 40.0, "it stands until then"


def test_a_rate_that_no_clock_has_is_not_used() -> None:
    time, position = estimate()
    found = scoring.align(time * 1.01, position, *truth())
    assert abs(found.rate - 1) <= scoring.RATE_WITHIN + 1e-9
    assert found.rmse > 0.02


def test_coverage_is_the_share_of_time_two_cameras_saw() -> None:
    a, b = np.arange(0.0, 10.0, 0.04), np.arange(4.0, 20.0, 0.04)
    whole = np.arange(3.8, 10.2, 0.02)
    assert scoring.coverage(whole, [a, b]) > 0.99
    assert scoring.coverage(whole[whole < 7.0], [a, b]) == pytest.approx(0.5, abs=0.01)
    assert scoring.coverage(np.zeros(0), [a, b]) == 0.0
    assert scoring.coverage(whole, [a]) == 0.0


def test_lags_are_compared_at_one_instant() -> None:
    a, b = TimeMap(1.0, 0.0), TimeMap(1.001, 5.0)
    world = TimeMap(1.0002, 100.0)  # the truth's clock from the reference clock
    true_a = TimeMap(world.clock_rate * a.clock_rate, world.clock_rate * a.time_offset + world.time_offset)
    true_b = TimeMap(world.clock_rate * b.clock_rate, world.clock_rate * b.time_offset + world.time_offset)
    assert scoring.lag_difference(a, b, true_a, true_b, 60.0) == pytest.approx(0.0, abs=1e-9)
    late = TimeMap(b.clock_rate, b.time_offset + 0.01)
    assert abs(scoring.lag_difference(a, late, true_a, true_b, 60.0)) == pytest.approx(0.01, rel=1e-2)


def test_poses_are_compared_after_one_similarity() -> None:
    random = np.random.default_rng(4)
    true = {f"cam{i}": Pose(so3.exp(random.normal(0, 1, 3)), random.normal(0, 2, 3)) for i in range(4)}
    same = {name: MOVE.pose(pose) for name, pose in true.items()}
    for apart, angle in scoring.pose_differences(same, true).values():
        assert apart < 1e-9
        assert angle < 1e-7
    turned = dict(same)
    turned["cam2"] = Pose(so3.exp(np.array([0.02, 0, 0])) @ same["cam2"].rotation, same["cam2"].position)
    assert scoring.pose_differences(turned, true)["cam2"][1] == pytest.approx(0.02, abs=1e-6)
