"""The paper on timing gives the paper's figures."""

from __future__ import annotations

import numpy as np
import pytest

from hub.timing.paper import alternate, corresponding, overall_lag, search_start
from protocols.errors import Refused
from tests.papers.timing_paper import (
    CAMERA_1,
    CAMERA_2,
    PERIOD,
    PRINTED_F,
    first_failure,
    printed_fundamental,
    project,
    run_lag,
    sweep,
    trajectory_24,
)


def test_equation_23_is_reproduced() -> None:
    assert np.abs(printed_fundamental() - PRINTED_F).max() < 1e-5


def test_the_sweep_fails_where_the_paper_fails_and_is_exact_below() -> None:
    results = sweep()
    limit = first_failure(results)
    assert 0.28 <= limit <= 0.38
    below = [result for result in results if result.tau < limit]
    assert np.mean([abs(result.tau_error) for result in below]) <= 1e-4
    assert np.mean([result.f_error for result in below]) <= 0.13


def test_a_lag_of_the_other_sign_is_found_too() -> None:
    assert run_lag(-0.11).tau_error == pytest.approx(0.0, abs=1e-4)


def test_each_iteration_brings_the_lines_closer_until_the_last() -> None:
    time = np.arange(0.0, 11.0, PERIOD)
    found = alternate(project(CAMERA_1, trajectory_24(time)), project(CAMERA_2, trajectory_24(time + 0.11)))
    distances = [turn.distance for turn in found.turns]
    assert distances[1:-1] == sorted(distances[1:-1], reverse=True)
    assert found.distance == min(distances[1:])


def test_equation_11_rounds_towards_zero() -> None:
    assert [search_start(lag) for lag in (2.7, 0.3, 0.0, -0.3, -2.7)] == [2, 0, 0, 0, -2]


def test_equations_16_to_18_take_the_mean_of_the_fullest_bin() -> None:
    lags = np.array([3.2, 3.4, 3.9, 4.1, -7.0, np.nan, 12.5])
    assert overall_lag(lags) == pytest.approx((3.2 + 3.4 + 3.9) / 3)
    with pytest.raises(Refused):
        overall_lag(np.full(5, np.nan))


def test_equations_19_and_20_interpolate_between_two_frames() -> None:
    a = np.column_stack([np.arange(20.0), np.zeros(20)])
    b = np.column_stack([10.0 * np.arange(20), 5.0 * np.arange(20)])
    first, second, used = corresponding(a, b, 2.25)
    assert used.sum() == 17
    np.testing.assert_allclose(second, np.column_stack([10.0 * (first[:, 0] + 2.25), 5.0 * (first[:, 0] + 2.25)]))


def test_frames_without_a_marker_are_left_out() -> None:
    time = np.arange(0.0, 11.0, PERIOD)
    a, b = project(CAMERA_1, trajectory_24(time)), project(CAMERA_2, trajectory_24(time + 0.05))
    a[50:55], b[200:203] = np.nan, np.nan
    assert -alternate(a, b).lag * PERIOD == pytest.approx(0.05, abs=2e-4)
