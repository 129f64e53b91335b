"""Noise scale: correction for redundancy and for autocorrelated residuals."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.adjustment import adjust
from hub.bundle.covariance import covariance
from hub.bundle.noise.noise_scale import (
    _hat_matrix_trace,
    _serial_inflation,
    _within_frame_inflation,
    rescale_noise,
    residual_std,
)
from hub.bundle.normal_equations import build_system
from hub.bundle.residuals import StackedTrajectories
from hub.calibration.pipeline import calibrate
from protocols.geometry.types import Floats
from tests.support.rigs import simulate
from tests.unit.hub.bundle.test_adjustment import dense, simulated_problem


def test_the_absorbed_residuals_are_the_trace_of_the_dense_hat_matrix() -> None:
    problem, state, prior = simulated_problem(3)
    found = covariance(problem, state, prior)
    known = {label: found.free.submatrix(found.a_inv_b.parts[label][1]) for label in problem.by_label}
    paths = StackedTrajectories.of(state.by_label)
    mine = sum(
        _hat_matrix_trace(problem, state, paths, found, known[rows.label], [rows], 2000) for rows in problem.rows
    )
    whole = dense(build_system(problem, state, prior, robust=False)[0])
    priors = dense(build_system(replace(problem, rows=()), state, prior, robust=False)[0])
    scale = 1.0 / np.sqrt(np.diag(whole))  # one tolerance for metres, radians and seconds
    whole, priors = whole * scale * scale[:, None], priors * scale * scale[:, None]
    # The seven gauge directions have no information.
    hat = np.linalg.pinv(whole, rcond=1e-11, hermitian=True) @ (whole - priors)
    assert mine == pytest.approx(float(np.trace(hat)), rel=5e-3)


def test_the_noise_of_simulated_cameras_is_recovered() -> None:
    raw, corrected = [], []
    for seed in range(8):
        problem, state, _ = simulated_problem(seed)
        problem, state, prior = adjust(problem, state)
        raw.append(residual_std(problem, state))
        corrected += [state.sigma, rescale_noise(problem, state, prior).sigma]
    assert np.mean(corrected[::2]) == pytest.approx(0.5, rel=0.03)
    assert np.mean(corrected[1::2]) == pytest.approx(0.5, rel=0.03)
    assert np.mean(raw) < 0.97 * np.mean(corrected)


@pytest.mark.parametrize(("fps", "seed"), [((10.0, 30.0, 60.0), 29), ((6.0, 15.0, 50.0), 26), ((6.0, 15.0, 50.0), 28)])
def test_a_path_that_could_follow_one_camera_does_not_make_its_noise_vanish(fps: tuple[float, ...], seed: int) -> None:
    """The path of the fastest camera can pass through all rows of a slow one, whose noise then seemed 0.01 px."""
    session = simulate(seed, 4, 30.0, noise=1.5, fps=fps, fastest=1.5)
    found = calibrate(session.rig, session.observations())
    residuals = np.array([camera.rms_px for camera in found.cameras.values()])
    assert residuals.min() > 0.5 * residuals.max()


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_serial_inflation_matches_the_closed_form_of_an_ar1_process(correlation: float) -> None:
    rng = np.random.default_rng(int(10 * correlation))
    count = 20_000
    fresh = rng.normal(0.0, np.sqrt(1.0 - correlation**2), (count, 2))
    off: Floats = np.zeros((count, 2))
    for i in range(1, count):
        off[i] = correlation * off[i - 1] + fresh[i]
    found = _serial_inflation([(np.arange(count) / 30.0, off)])
    assert found == pytest.approx((1.0 + correlation) / (1.0 - correlation), rel=0.15)


@pytest.mark.parametrize("ratio", [1.0, 10.0])
def test_serial_inflation_of_rows_of_alternating_noise_is_that_of_their_scores(ratio: float) -> None:
    """The autocorrelation of the first lag, of a precise and a noisy row, is small: nothing was found behind it."""
    rng, count, correlation = np.random.default_rng(3), 20_000, 0.9
    variance = np.where(np.arange(count) % 2, 1.0, ratio**2)
    common: Floats = np.zeros((count, 2))
    for i in range(1, count):
        common[i] = correlation * common[i - 1] + np.sqrt(1.0 - correlation**2) * rng.normal(size=2)
    off = np.sqrt(variance)[:, None] * rng.normal(size=(count, 2)) + common
    found = _serial_inflation([(np.arange(count) / 30.0, off / variance[:, None])])
    lags = np.arange(200)
    shared = correlation ** np.abs(lags[:, None] - lags) / np.outer(variance[:200], variance[:200])
    single = 1.0 / variance[:200]
    assert found == pytest.approx((single.sum() + shared.sum()) / (single.sum() + np.trace(shared)), rel=0.1)


def test_lost_frames_and_the_order_of_rows_change_nothing() -> None:
    rng = np.random.default_rng(1)
    off = np.cumsum(rng.normal(size=(6000, 2)), axis=0)
    off -= np.stack([np.convolve(column, np.ones(31) / 31, "same") for column in off.T], axis=1)
    time, keep = np.arange(6000) / 30.0, np.sort(rng.permutation(6000)[:4500])
    whole = _serial_inflation([(time, off)])
    assert whole > 3.0
    assert _serial_inflation([(time[keep], off[keep])]) == pytest.approx(whole, rel=0.15)
    mixed = rng.permutation(6000)
    assert _serial_inflation([(time[mixed], off[mixed])]) == whole


def test_labels_without_a_row_that_is_predicted_are_no_warning() -> None:
    """Of a camera that lost all its labels numpy warned on the user's terminal."""
    with warnings.catch_warnings(action="error"):
        assert _within_frame_inflation([(np.zeros(0), np.zeros((0, 2)))] * 2) == 1.0
