"""How firm a lag is where lenses are only about as told, and where one part of the motion carries it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pair_network import solve_pairs
from hub.calibration.preprocessing import prepare
from hub.sync.alignment import PairSettings, Samples, correlated
from hub.sync.lag_uncertainty import Leaning, at_centre, leaning
from hub.sync.pair_solver import PairSolution, solve_pair
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view.refinement import WIDE, Noise, Refined, refine
from hub.two_view.relative_pose import Uncalibrated, relative_pose
from protocols.geometry.camera import Intrinsics
from tests import rigs

NAMES = ("a", "b")
RATE_STD = 2e-4


def slow(seed: int, told: float, flat: float = 0.3, seconds: float = 20.0) -> tuple[rigs.Session, list[SmoothTrack]]:
    """Two cameras, whose focal lengths are told ``told`` (log) too long and too short, and a slow, nearly flat path."""
    path = rigs.random_path(np.random.default_rng([seed, 31]), 0.12)
    path.amplitude[:, 2] *= flat
    session = rigs.simulate(seed, 2, seconds, noise=0.05, path=path, ppm=50.0, late=0.5)
    cameras = dict(session.rig.cameras)
    for name, sign in (("cam0", 1.0), ("cam1", -1.0)):
        lens = cameras[name].intrinsics
        assert lens is not None
        matrix = lens.matrix.copy()
        matrix[:2, :2] *= np.exp(sign * told)
        cameras[name] = replace(cameras[name], intrinsics=Intrinsics(lens.width, lens.height, matrix, lens.distortions))
    prepared = prepare(replace(session.rig, cameras=cameras), session.observations())
    tracks = [prepared.cameras[name].tracks["marker"] for name in cameras]
    assert all(isinstance(track, SmoothTrack) for track in tracks)
    return session, [track for track in tracks if isinstance(track, SmoothTrack)]


def aligned(session: rigs.Session, tracks: list[SmoothTrack]) -> tuple[Samples, Refined, float]:
    """Samples, the fit with lenses as told from the true alignment, and the true ``middle`` [s]."""
    a, b = tracks
    settings = PairSettings()
    lag = session.shown("cam0", 10.0) - a.epoch - session.shown("cam1", 10.0) + b.epoch
    samples = Samples([a], [b], lag, settings, settings.samples)
    true = session.shown("cam1", session.true_time("cam0", samples.centre + a.epoch)) - b.epoch
    pose = relative_pose(session.poses["cam0"], session.poses["cam1"])
    found = refine(samples, pose, true, 1.0, Noise(a.sigma, b.sigma, RATE_STD), narrowest=WIDE)
    assert found is not None
    return samples, found, true


def firm(seed: int, told: float, sure: float) -> tuple[Leaning, float, float, float]:
    """What is told of the lag, its error, that with the lenses as told, and its std by noise alone [s]."""
    session, tracks = slow(seed, told)
    samples, found, true = aligned(session, tracks)
    lean = leaning(samples, found, (tracks[0].sigma, tracks[1].sigma), RATE_STD, sure)
    noise = float(np.sqrt(np.linalg.pinv(found.normal, hermitian=True)[-2, -2]))
    return lean, lean.middle - true, found.middle - true, noise


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_a_lens_that_is_a_little_off_is_in_the_std() -> None:
    """Focal lengths 1.5 % off: errors are a few times what noise alone would make, and about what is told."""
    kept = [firm(seed, 0.015, 1.0) for seed in range(6)]
    freed = [firm(seed, 0.015, 0.0) for seed in range(6)]
    assert rms([error / noise for _, error, _, noise in kept]) > 3.0
    assert rms([error / lean.std for lean, error, _, _ in kept]) < 2.0
    assert rms([error / lean.std for lean, error, _, _ in freed]) < 2.0


def test_lenses_that_are_freed_bring_the_lag_nearer() -> None:
    freed = [firm(seed, 0.015, 0.0) for seed in range(6)]
    assert rms([error for _, error, _, _ in freed]) < 0.3 * rms([as_told for _, _, as_told, _ in freed])


def test_a_lag_that_is_sure_stays_as_it_is() -> None:
    session, tracks = slow(1, 0.0)
    samples, found, _ = aligned(session, tracks)
    lean = leaning(samples, found, (tracks[0].sigma, tracks[1].sigma), RATE_STD, 1.0)
    assert (lean.slowness, lean.middle, lean.swing) == (found.slowness, found.middle, 0.0)
    later = samples.thinned(100)
    assert later.count == 100
    assert at_centre(found, samples.centre, later).middle == pytest.approx(
        found.middle + found.slowness * (later.centre - samples.centre), abs=1e-12
    )


def test_a_part_that_disagrees_is_told_by_leaving_it_out() -> None:
    """A fifth of one camera's rows is 50 ms late, as where a recorder stalls."""
    session, (a, b) = slow(2, 0.0)
    swings = []
    for late in (0.0, 0.05):
        fifth = (a.time > np.quantile(a.time, 0.4)) & (a.time < np.quantile(a.time, 0.6))
        stalled = replace(a, points=np.where(fifth[:, None], a.at(a.time - late), a.points))
        samples, found, _ = aligned(session, [stalled, b])
        swings.append(leaning(samples, found, (a.sigma, b.sigma), RATE_STD, 0.0).swing)
    assert swings[1] > 5.0 * swings[0]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (PairSettings(largest_doubt=1e-9), "lenses and shutters"),
        (PairSettings(largest_lag_std=1e-9, largest_swing=1e-9), "without a fifth"),
    ],
)
def test_a_lag_that_leans_too_much_is_refused(settings: PairSettings, told: str) -> None:
    _, (a, b) = slow(0, 0.0)
    answer = solved(a, b, PairSettings())
    assert answer.solved
    assert answer.fit is not None
    assert answer.fit.lag_std < answer.fit.lag_doubt < 0.01
    refused = solved(a, b, settings)
    assert not refused.solved
    assert told in refused.status


def test_what_only_begins_an_adjustment_need_not_be_firm() -> None:
    _, (a, b) = slow(0, 0.0)
    answer = solved(a, b, PairSettings(firm=False, largest_doubt=1e-9))
    assert answer.solved
    assert answer.fit is not None
    assert np.isnan(answer.fit.lag_doubt)


@pytest.mark.parametrize(("cameras", "firm"), [(2, True), (3, False)])
def test_two_cameras_alone_must_be_firm(cameras: int, firm: bool) -> None:
    session = rigs.simulate(4, cameras, 12.0, late=0.5)
    _, found = solve_pairs(prepare(session.rig, session.observations()), lambda *_: None)
    assert all(pair.solved and pair.fit is not None for pair in found)
    assert {np.isfinite(pair.fit.lag_doubt) for pair in found if pair.fit is not None} == {firm}


def solved(a: SmoothTrack, b: SmoothTrack, settings: PairSettings) -> PairSolution:
    return solve_pair({"": a}, {"": b}, NAMES, settings)


def test_a_fundamental_matrix_has_no_lenses() -> None:
    session, tracks = slow(1, 0.0)
    samples, found, _ = aligned(session, tracks)
    bare = replace(found, geometry=Uncalibrated.of(found.geometry.matrix))
    with pytest.raises(TypeError, match="lenses"):
        leaning(samples, bare, (1e-3, 1e-3), RATE_STD, 0.0)


def test_correlations_end_where_they_no_longer_stand_out() -> None:
    rng = np.random.default_rng(5)
    assert len(correlated(rng.normal(size=2000))) <= 2
    alike = correlated(np.convolve(rng.normal(size=2000), np.ones(10), mode="valid"))
    assert alike[0] == 1.0
    assert 9 <= len(alike) < 20
    assert alike[4] == pytest.approx(0.6, abs=0.1)
