"""Cubic B-spline basis: partition of unity, derivatives, banded least squares, and gaps between stretches."""

from __future__ import annotations

import numpy as np
import pytest

from hub.trajectory.splines import SUPPORT, SplineBasis, basis_weights, fit_spline, normal_bands, split_at_gaps
from protocols.geometry.types import Floats


@pytest.fixture
def basis() -> SplineBasis:
    """Three stretches, one shorter than the spacing, at a time that is not 0."""
    return SplineBasis.covering(np.array([-3.0, 2.0, 9.0]), np.array([1.0, 7.3, 9.05]), 0.25)


def times(basis: SplineBasis, count: int, seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    width = basis.intervals * basis.spacing
    which = rng.choice(len(width), count, p=width / width.sum())
    return np.sort(basis.starts[which] + rng.random(count) * width[which])


def dense(basis: SplineBasis, time: Floats, derivative: int = 0) -> Floats:
    index, weights, inside = basis.weights(time, derivative)
    assert inside.all()
    out = np.zeros((len(time), basis.size))
    for k in range(SUPPORT):
        out[np.arange(len(time)), index + k] = weights[:, k]
    return out


def test_weights_are_non_negative_and_sum_to_one() -> None:
    u = np.linspace(0, 1, 101)
    assert (basis_weights(u) >= 0).all()
    np.testing.assert_allclose(basis_weights(u).sum(axis=1), 1, atol=1e-14)
    for derivative in (1, 2):
        np.testing.assert_allclose(basis_weights(u, derivative).sum(axis=1), 0, atol=1e-13)


@pytest.mark.parametrize("derivative", [1, 2])
def test_derivatives_match_finite_differences(basis: SplineBasis, derivative: int) -> None:
    control = np.random.default_rng(1).normal(size=(basis.size, 2))
    time, step = times(basis, 200), 1e-6
    low, high = basis.starts, basis.starts + basis.intervals * basis.spacing
    clear = np.array([np.min(np.abs(np.r_[low, high] - t)) > 1e-3 for t in time])
    slope = basis.evaluate(control, time + step, derivative - 1) - basis.evaluate(control, time - step, derivative - 1)
    np.testing.assert_allclose(
        basis.evaluate(control, time, derivative)[clear], (slope / (2 * step))[clear], rtol=1e-5, atol=1e-3
    )


def test_the_spline_is_twice_continuously_differentiable_across_knots(basis: SplineBasis) -> None:
    control = np.random.default_rng(2).normal(size=(basis.size, 1))
    knots = basis.starts[1] + basis.spacing * np.arange(1, basis.intervals[1])
    for derivative in (0, 1, 2):
        before = basis.evaluate(control, knots - 1e-10, derivative)
        after = basis.evaluate(control, knots + 1e-10, derivative)
        np.testing.assert_allclose(before, after, atol=1e-5)


def test_a_cubic_is_reproduced_everywhere(basis: SplineBasis) -> None:
    time = times(basis, 400)
    values = np.column_stack([time**3 - 2 * time, 0.5 * time**2])
    control = fit_spline(basis, basis.weights(time), values, np.ones(len(time)), stiffness=1e-12)
    np.testing.assert_allclose(basis.evaluate(control, time), values, atol=1e-5)


def test_the_banded_fit_equals_the_dense_fit(basis: SplineBasis) -> None:
    rng = np.random.default_rng(3)
    time, stiffness = times(basis, 300), 0.1
    values, weight = rng.normal(size=(300, 3)), rng.uniform(0.1, 3, 300)
    rows = [np.sqrt(weight)[:, None] * dense(basis, time)]
    third = np.zeros((len(basis.interval_starts()), basis.size))
    for row, start in enumerate(basis.interval_starts()):
        third[row, start : start + 4] = [-1, 3, -3, 1]
    rows.append(np.sqrt(stiffness) * third)
    right = np.r_[np.sqrt(weight)[:, None] * values, np.zeros((len(third), 3))]
    expected = np.linalg.lstsq(np.vstack(rows), right, rcond=None)[0]
    np.testing.assert_allclose(fit_spline(basis, basis.weights(time), values, weight, stiffness), expected, atol=1e-7)


def test_normal_bands_are_the_normal_matrix(basis: SplineBasis) -> None:
    time = times(basis, 100)
    weight = np.random.default_rng(4).random(100)
    index, weights, _ = basis.weights(time)
    a = dense(basis, time)
    bands, full = normal_bands(index, weights, weight, basis.size), (a * weight[:, None]).T @ a
    for distance in range(4):
        np.testing.assert_allclose(bands[3 - distance, distance:], np.diag(full, distance), atol=1e-14)


def test_an_interval_without_data_is_bridged_smoothly() -> None:
    basis = SplineBasis.covering(np.array([0.0]), np.array([10.0]), 0.25)
    time = np.r_[np.linspace(0, 4, 60), np.linspace(6, 10, 60)]
    control = fit_spline(basis, basis.weights(time), np.column_stack([2 * time + 1]), np.ones(120))
    middle = np.linspace(4, 6, 20)
    np.testing.assert_allclose(basis.evaluate(control, middle)[:, 0], 2 * middle + 1, atol=1e-3)


def test_rows_outside_all_stretches_have_no_influence(basis: SplineBasis) -> None:
    time = times(basis, 200)
    values = np.sin(time)[:, None]
    plain = fit_spline(basis, basis.weights(time), values, np.ones(200))
    more = fit_spline(
        basis, basis.weights(np.r_[time, 1.5, -99.0, 50.0]), np.r_[values, [[1e6]] * 3], np.ones(203), stiffness=1e-6
    )
    np.testing.assert_allclose(plain, more, atol=1e-9)


def test_a_stretch_is_covered_from_end_to_end(basis: SplineBasis) -> None:
    ends = np.array([-3.0, 1.0, 2.0, 7.3, 9.0, 9.05])
    assert np.isfinite(basis.evaluate(np.zeros((basis.size, 1)), ends)).all()


def test_values_in_gaps_are_nan(basis: SplineBasis) -> None:
    outside = np.array([-3.5, 1.5, 8.0, 9.6, 1e6, np.nan])
    assert np.isnan(basis.evaluate(np.zeros((basis.size, 1)), outside)).all()


def test_a_nan_time_is_outside_the_spline(basis: SplineBasis) -> None:
    index, _, inside = basis.weights(np.array([np.nan]))
    assert not inside[0]
    assert 0 <= index[0] <= basis.size - SUPPORT


def test_stretches_do_not_share_control_points(basis: SplineBasis) -> None:
    time = times(basis, 300)
    control = np.zeros((basis.size, 1))
    control[basis.offsets[1] : basis.offsets[2]] = 1.0
    values = basis.evaluate(control, time)[:, 0]
    second = (time > 1.5) & (time < 8)
    np.testing.assert_allclose(values, second.astype(float), atol=1e-12)


def test_the_number_of_control_points_adds_up(basis: SplineBasis) -> None:
    np.testing.assert_array_equal(basis.intervals, [16, 22, 1])
    assert basis.size == 16 + 22 + 1 + 9
    np.testing.assert_array_equal(basis.offsets, [0, 19, 44])
    assert len(basis.interval_starts()) == 39
    assert basis.interval_starts()[-1] == 44


def test_stretches_are_cut_at_long_gaps_only() -> None:
    begins, ends = split_at_gaps(np.array([0.0, 0.1, 0.2, 0.41, 1.0, 5.0]), 0.5)
    np.testing.assert_array_equal(begins, [0, 1.0, 5.0])
    np.testing.assert_array_equal(ends, [0.41, 1.0, 5.0])


def test_no_time_has_no_stretch() -> None:
    begins, ends = split_at_gaps(np.zeros(0), 1.0)
    assert len(begins) == len(ends) == 0


@pytest.fixture
def filled() -> SplineBasis:
    """Stretches covered exactly, the second beginning where the first ends; none a multiple of the spacing."""
    return SplineBasis.spanning(np.array([-3.0, 1.1, 9.0]), np.array([1.1, 7.33, 9.05]), 0.25)


def inner_times(basis: SplineBasis, count: int = 300) -> Floats:
    ends = basis.starts + basis.intervals * basis.widths
    rng = np.random.default_rng(0)
    which = rng.integers(0, len(ends), count)
    share = rng.uniform(0.001, 0.999, count)
    return np.sort(basis.starts[which] + share * (ends - basis.starts)[which])


def test_spanning_stretches_end_exactly_where_given(filled: SplineBasis) -> None:
    np.testing.assert_allclose(filled.starts, [-3.0, 1.1, 9.0])
    np.testing.assert_allclose(filled.starts + filled.intervals * filled.widths, [1.1, 7.33, 9.05], atol=1e-12)
    assert (filled.widths <= filled.spacing + 1e-12).all()
    assert filled.begin == -3.0
    assert filled.end == pytest.approx(9.05)


def test_times_belong_to_their_own_stretch_and_gaps_to_none(filled: SplineBasis) -> None:
    control = np.zeros((filled.size, 1))
    control[filled.offsets[1] : filled.offsets[2]] = 1.0
    values = filled.evaluate(control, np.array([1.1 - 1e-6, 1.1 + 1e-6, 7.33 - 1e-6, 7.33 + 1e-6, 9.0, 9.05, 9.06]))
    np.testing.assert_allclose(values[:, 0], [0, 1, 1, np.nan, 0, 0, np.nan], atol=1e-12)


@pytest.mark.parametrize("derivative", [1, 2])
def test_derivatives_use_each_stretchs_own_knot_width(filled: SplineBasis, derivative: int) -> None:
    """Each stretch has knots of its own width, not of the nominal one."""
    control = np.random.default_rng(1).normal(size=(filled.size, 2))
    time, h = inner_times(filled), 1e-6
    clear = (filled.locate(time - h)[0] == filled.locate(time + h)[0]).nonzero()[0]
    before, after = (filled.evaluate(control, time + step, derivative - 1) for step in (-h, h))
    slope = (after - before) / (2 * h)
    found = filled.evaluate(control, time, derivative)
    scale = float(np.abs(found).max())
    np.testing.assert_allclose(found[clear] / scale, slope[clear] / scale, atol=1e-6)


def test_values_and_derivatives_together_equal_those_one_by_one(filled: SplineBasis) -> None:
    control = np.random.default_rng(2).normal(size=(filled.size, 2))
    time = np.r_[inner_times(filled), 8.0, -4.0, np.nan]
    values, slopes = filled.evaluate_with_derivatives(filled.polynomials(control), time)
    np.testing.assert_allclose(values, filled.evaluate(control, time), atol=1e-12)
    np.testing.assert_allclose(slopes, filled.evaluate(control, time, 1), atol=1e-10)


def test_touching_stretches_are_smooth_inside_and_independent_of_each_other(filled: SplineBasis) -> None:
    control = np.random.default_rng(3).normal(size=(filled.size, 1))
    knots = filled.starts[1] + filled.widths[1] * np.arange(1, filled.intervals[1])
    for derivative in (0, 1, 2):
        before = filled.evaluate(control, knots - 1e-9, derivative)
        after = filled.evaluate(control, knots + 1e-9, derivative)
        np.testing.assert_allclose(before, after, atol=1e-5)
    seam = filled.evaluate(control, np.array([1.1 - 1e-9, 1.1 + 1e-9]))
    assert abs(seam[1, 0] - seam[0, 0]) > 0.05


def test_touching_stretches_fit_a_step(filled: SplineBasis) -> None:
    """Values after a discontinuity have no influence on those before."""
    time = inner_times(filled, 500)
    values = np.where(time < 1.1, np.sin(time), 5.0 + np.cos(time))[:, None]
    control = fit_spline(filled, filled.weights(time), values, np.ones(500), stiffness=1e-9)
    np.testing.assert_allclose(filled.evaluate(control, time), values, atol=2e-3)


def test_a_scaled_basis_gives_equal_values_at_scaled_times(filled: SplineBasis) -> None:
    control = np.random.default_rng(4).normal(size=(filled.size, 2))
    time = inner_times(filled)
    wide = filled.scaled(1.2)
    np.testing.assert_allclose(wide.evaluate(control, 1.2 * time), filled.evaluate(control, time), atol=1e-9)
    np.testing.assert_allclose(
        1.2 * wide.evaluate(control, 1.2 * time, 1), filled.evaluate(control, time, 1), atol=1e-7
    )


def test_a_stretch_of_zero_length_is_allowed() -> None:
    basis = SplineBasis.spanning(np.array([0.0, 5.0]), np.array([2.0, 5.0]), 0.25)
    control = np.ones((basis.size, 1))
    np.testing.assert_allclose(basis.evaluate(control, np.array([1.0, 5.0])), 1.0)
