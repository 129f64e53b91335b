"""Resection of a single camera from a known path: its clock, the clock's std, and its noise model."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from edge.scenes.common.base import look_at_pose
from protocols.core.clocks import TimeMap
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from tests.bench import resection
from tests.bench.resection import ErrorModel, Resection, resect

LENS = Intrinsics(1920, 1080, np.array([[1500.0, 0, 960], [0, 1500.0, 540], [0, 0, 1]]))
NOMINAL = Intrinsics(1920, 1080, np.array([[1470.0, 0, 960], [0, 1470.0, 540], [0, 0, 1]]))
POSE = look_at_pose(np.array([25.0, -20.0, 2.0]), np.array([0.0, 0.0, 3.0]))
CLOCK, GUESS = TimeMap(1 + 3e-4, 12.5), TimeMap(1.0, 12.3)
STEP = 0.08
TIME = np.arange(40.0, 120.0, STEP)
MIDDLE = float(np.median(TIME))
CORRELATED = ErrorModel(white_px=0.4, correlated_px=2.0, time_constant=3.0)
SEEDS = range(20)


def path(time: Floats) -> Floats:
    """A flight (n, 3) [m] that does not repeat itself, 2 to 4 m/s."""
    x = 6 * np.sin(0.31 * time) + 2 * np.sin(0.83 * time + 1)
    y = 5 * np.sin(0.23 * time + 0.4) + 1.5 * np.sin(1.07 * time)
    return np.column_stack([x, y, 3 + 2 * np.sin(0.41 * time) + np.sin(0.13 * time + 2)])


SURVEYED = np.arange(40.0, 150.0, 0.2)
TRUE_PIXELS = LENS.project(POSE.camera_from_world(path(CLOCK.clock_rate * TIME + CLOCK.time_offset)))


def errors(seed: int, model: ErrorModel = CORRELATED) -> Floats:
    """Errors (n, 2) [px] at TIME, drawn sample by sample."""
    random = np.random.default_rng(seed)
    correlation = np.exp(-STEP / model.time_constant)
    innovation = random.normal(0, model.correlated_px * np.sqrt(1 - correlation**2), (len(TIME), 2))
    innovation[0] = random.normal(0, model.correlated_px, 2)
    return lfilter([1.0], [1.0, -correlation], innovation, axis=0) + random.normal(0, model.white_px, innovation.shape)


def resected(wrong: Floats) -> Resection:
    return resect(NOMINAL, TIME, TRUE_PIXELS + wrong, GUESS, SURVEYED, path(SURVEYED))


def time_error(clock: TimeMap) -> float:
    """Clock error [s] at the middle."""
    return (clock.clock_rate - CLOCK.clock_rate) * MIDDLE + clock.time_offset - CLOCK.time_offset


@cache
def runs() -> list[Resection]:
    return [resected(errors(seed)) for seed in SEEDS]


def independent_time_error(wrong: Floats) -> float:
    """Clock error [s] at the middle of ordinary least squares started at the truth."""

    def residual(p: Floats) -> Floats:
        at = CLOCK.clock_rate * TIME + CLOCK.time_offset + p[6] + 1e-3 * p[7] * (TIME - MIDDLE)
        points = POSE.camera_from_world(path(at)) @ so3.exp(p[:3]).T + p[3:6]
        centre = LENS.matrix[:2, 2]
        return np.asarray(((LENS.project(points) - centre) * (1 + p[8]) + centre - TRUE_PIXELS - wrong).ravel())

    return float(least_squares(residual, np.zeros(9), x_scale="jac").x[6])


def test_the_time_std_is_consistent_under_correlated_errors() -> None:
    off = np.array([time_error(run.time_map) / run.time_std for run in runs()])
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.4


def test_correlated_errors_affect_the_clock_less_than_in_ordinary_least_squares() -> None:
    ours = np.array([time_error(run.time_map) for run in runs()])
    plain = np.array([independent_time_error(errors(seed)) for seed in SEEDS])
    assert np.sqrt(np.mean(ours**2)) < 0.9 * np.sqrt(np.mean(plain**2))


def test_the_noise_model_is_recovered() -> None:
    found = np.array([[run.errors.white_px, run.errors.correlated_px, run.errors.time_constant] for run in runs()])
    white, correlated, time_constant = np.median(found, axis=0)
    assert white == pytest.approx(CORRELATED.white_px, rel=0.05)
    # The nine parameters absorb some of the slowest errors.
    assert correlated == pytest.approx(CORRELATED.correlated_px, rel=0.25)
    assert time_constant == pytest.approx(CORRELATED.time_constant, rel=0.4)


def test_a_camera_with_independent_errors_keeps_its_clock_pose_and_focal_length() -> None:
    wrong = np.random.default_rng(3).normal(0, 0.5, TRUE_PIXELS.shape)
    wrong[::40] += 80.0  # false detections
    found = resected(wrong)
    assert found.time_std < 1e-3
    assert abs(time_error(found.time_map)) < 3 * found.time_std
    assert found.time_map.clock_rate == pytest.approx(CLOCK.clock_rate, abs=5e-5)
    assert found.focal_scale == pytest.approx(1500 / 1470, abs=2e-3)
    np.testing.assert_allclose(found.pose.position, POSE.position, atol=0.1)
    assert found.median_px < 0.8


def test_the_order_of_rows_does_not_matter() -> None:
    wrong = errors(50)
    mixed = np.random.default_rng(4).permutation(len(TIME))
    found = resect(NOMINAL, TIME[mixed], (TRUE_PIXELS + wrong)[mixed], GUESS, SURVEYED, path(SURVEYED))
    assert found.errors == resected(wrong).errors


def test_a_camera_with_almost_no_rows_within_the_truth_is_refused() -> None:
    with pytest.raises(ValueError, match="rows lie within the truth"):
        resect(NOMINAL, TIME, TRUE_PIXELS, TimeMap(1.0, 108.0), SURVEYED, path(SURVEYED))


def test_observations_of_something_else_are_refused() -> None:
    elsewhere = np.random.default_rng(5).uniform(0, 1000, TRUE_PIXELS.shape)
    with pytest.raises(ValueError, match="no pose"):
        resect(NOMINAL, TIME, elsewhere, GUESS, SURVEYED, path(SURVEYED))


def test_a_fit_that_does_not_converge_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resection, "_ROUNDS", 1)
    with pytest.raises(ValueError, match="converge"):
        resected(errors(51))
