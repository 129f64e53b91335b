"""Uncertainty of a lag: inaccurate intrinsics, leave-out change, autocorrelation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.preprocessing import prepare
from hub.calibration.pairs.pair_network import solve_pairs
from hub.sync.hypothesis import PairSolution
from hub.sync.lag_uncertainty import LagUncertainty, estimate_lag_uncertainty, recentred
from hub.sync.pair_solver import solve_pair
from hub.sync.samples import Samples, autocorrelation
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view.refinement import FINAL_WIDTH, NoiseModel, RefinementResult, refine
from hub.two_view.relative_pose import FundamentalMatrix, relative_pose_between
from protocols.geometry.camera import Intrinsics
from tests.support import rigs

NAMES = ("a", "b")
RATE_STD = 2e-4


def slow(
    seed: int, focal_error: float, flat: float = 0.3, seconds: float = 20.0
) -> tuple[rigs.Session, list[SmoothTrack]]:
    """Two cameras, given focal lengths ``focal_error`` (log) too long and too short, and a slow, nearly planar path."""
    path = rigs.random_path(np.random.default_rng([seed, 31]), 0.12)
    path.amplitude[:, 2] *= flat
    session = rigs.simulate(seed, 2, seconds, noise=0.05, path=path, ppm=50.0, late=0.5)
    cameras = dict(session.rig.cameras)
    for name, sign in (("cam0", 1.0), ("cam1", -1.0)):
        lens = cameras[name].intrinsics
        assert lens is not None
        matrix = lens.matrix.copy()
        matrix[:2, :2] *= np.exp(sign * focal_error)
        cameras[name] = replace(cameras[name], intrinsics=Intrinsics(lens.width, lens.height, matrix, lens.distortions))
    prepared = prepare(replace(session.rig, cameras=cameras), session.observations())
    tracks = [prepared.cameras[name].tracks["marker"] for name in cameras]
    assert all(isinstance(track, SmoothTrack) for track in tracks)
    return session, [track for track in tracks if isinstance(track, SmoothTrack)]


def aligned(session: rigs.Session, tracks: list[SmoothTrack]) -> tuple[Samples, RefinementResult, float]:
    """Samples, the fit with the given lenses from the true alignment, and the true ``intercept`` [s]."""
    a, b = tracks
    settings = PairSettings()
    lag = session.shown("cam0", 10.0) - a.time_origin - session.shown("cam1", 10.0) + b.time_origin
    samples = Samples([a], [b], lag, settings, settings.refinement_samples)
    true = session.shown("cam1", session.true_time("cam0", samples.centre + a.time_origin)) - b.time_origin
    pose = relative_pose_between(session.poses["cam0"], session.poses["cam1"])
    found = refine(samples, pose, true, 1.0, NoiseModel(a.sigma, b.sigma, RATE_STD), final_width=FINAL_WIDTH)
    assert found is not None
    return samples, found, true


def estimated(seed: int, focal_error: float, std_limit: float) -> tuple[LagUncertainty, float, float, float]:
    """The estimate, its lag error [s], that with the given lenses, and the lag's std by noise alone."""
    session, tracks = slow(seed, focal_error)
    samples, found, true = aligned(session, tracks)
    result = estimate_lag_uncertainty(samples, found, (tracks[0].sigma, tracks[1].sigma), RATE_STD, std_limit)
    noise = float(np.sqrt(np.linalg.pinv(found.normal, hermitian=True)[-2, -2]))
    return result, result.intercept - true, found.intercept - true, noise


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_the_std_includes_inaccurate_intrinsics() -> None:
    """Focal lengths 1.5 % off: errors are a few times those of noise alone, and about the estimated std."""
    kept = [estimated(seed, 0.015, 1.0) for seed in range(6)]
    freed = [estimated(seed, 0.015, 0.0) for seed in range(6)]
    assert rms([error / noise for _, error, _, noise in kept]) > 3.0
    assert rms([error / result.std for result, error, _, _ in kept]) < 2.0
    assert rms([error / result.std for result, error, _, _ in freed]) < 2.0


def test_estimating_the_lenses_reduces_the_lag_error() -> None:
    freed = [estimated(seed, 0.015, 0.0) for seed in range(6)]
    assert rms([error for _, error, _, _ in freed]) < 0.3 * rms(
        [with_given_lenses for _, _, with_given_lenses, _ in freed]
    )


def test_a_precise_lag_is_not_changed() -> None:
    session, tracks = slow(1, 0.0)
    samples, found, _ = aligned(session, tracks)
    result = estimate_lag_uncertainty(samples, found, (tracks[0].sigma, tracks[1].sigma), RATE_STD, 1.0)
    assert (result.inverse_rate, result.intercept, result.leave_out_change) == (
        found.inverse_rate,
        found.intercept,
        0.0,
    )
    later = samples.thinned(100)
    assert later.count == 100
    assert recentred(found, samples.centre, later).intercept == pytest.approx(
        found.intercept + found.inverse_rate * (later.centre - samples.centre), abs=1e-12
    )


def test_an_inconsistent_part_shows_in_the_leave_out_change() -> None:
    """A fifth of one camera's rows is 50 ms late, as from a stalling recorder."""
    session, (a, b) = slow(2, 0.0)
    changes = []
    for late in (0.0, 0.05):
        fifth = (a.time > np.quantile(a.time, 0.4)) & (a.time < np.quantile(a.time, 0.6))
        stalled = replace(a, points=np.where(fifth[:, None], a.at(a.time - late), a.points))
        samples, found, _ = aligned(session, [stalled, b])
        changes.append(estimate_lag_uncertainty(samples, found, (a.sigma, b.sigma), RATE_STD, 0.0).leave_out_change)
    assert changes[1] > 5.0 * changes[0]


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (PairSettings(max_total_lag_std=1e-9), "lens and readout"),
        (PairSettings(max_lag_std=1e-9, max_leave_out_change=1e-9), "without a fifth"),
    ],
)
def test_a_lag_with_high_sensitivity_is_refused(settings: PairSettings, reason: str) -> None:
    _, (a, b) = slow(0, 0.0)
    answer = solved(a, b, PairSettings())
    assert answer.solved
    assert answer.fit is not None
    assert answer.fit.lag_std < answer.fit.total_lag_std < 0.01
    refused = solved(a, b, settings)
    assert not refused.solved
    assert reason in refused.status


def test_the_start_of_an_adjustment_needs_no_sensitivity_test() -> None:
    _, (a, b) = slow(0, 0.0)
    answer = solved(a, b, PairSettings(standalone=False, max_total_lag_std=1e-9))
    assert answer.solved
    assert answer.fit is not None
    assert np.isnan(answer.fit.total_lag_std)


@pytest.mark.parametrize(("cameras", "tested"), [(2, True), (3, False)])
def test_only_a_standalone_pair_is_tested_for_sensitivity(cameras: int, tested: bool) -> None:
    session = rigs.simulate(4, cameras, 12.0, late=0.5)
    _, found = solve_pairs(prepare(session.rig, session.observations()), lambda *_: None)
    assert all(pair.solved and pair.fit is not None for pair in found)
    assert {np.isfinite(pair.fit.total_lag_std) for pair in found if pair.fit is not None} == {tested}


def solved(a: SmoothTrack, b: SmoothTrack, settings: PairSettings) -> PairSolution:
    return solve_pair({"": a}, {"": b}, NAMES, settings)


def test_a_fundamental_matrix_is_refused() -> None:
    session, tracks = slow(1, 0.0)
    samples, found, _ = aligned(session, tracks)
    uncalibrated = replace(found, geometry=FundamentalMatrix.of(found.geometry.matrix))
    with pytest.raises(TypeError, match="lenses"):
        estimate_lag_uncertainty(samples, uncalibrated, (1e-3, 1e-3), RATE_STD, 0.0)


def test_the_autocorrelation_ends_at_the_last_significant_lag() -> None:
    rng = np.random.default_rng(5)
    assert len(autocorrelation(rng.normal(size=2000))) <= 2
    coloured = autocorrelation(np.convolve(rng.normal(size=2000), np.ones(10), mode="valid"))
    assert coloured[0] == 1.0
    assert 9 <= len(coloured) < 20
    assert coloured[4] == pytest.approx(0.6, abs=0.1)
