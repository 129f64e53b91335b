"""Slow motion: uniqueness at the noise floor, the clock-rate prior, and autocorrelated residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.preprocessing import prepare
from hub.sync import final_refinement, pair_solver
from hub.sync.acceptance import accept_or_reject, rank_distinct
from hub.sync.hypothesis import PairFit
from hub.sync.samples import Samples
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view.refinement import FINAL_WIDTH, NoiseModel, refine
from hub.two_view.relative_pose import FundamentalMatrix, RelativePose, relative_pose_between
from tests.support import rigs

NAMES = ("a", "b")
SLOW = PairFit(
    rate=1.0002,
    offset=2.0,
    geometry=RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0])),
    residual_px=0.3,
    inliers=1.0,
    in_front=1.0,
    support=7.5,
    moving_overlap=7.5,
    mid_time=10.0,
    parallax=0.8,
    planar_residual_px=6.0,
    misfit=0.15,
    track_noise_px=0.4,
    log10_false_alarm=0.0,
    cycles=1.3,
)
"""Seven seconds of a drone: too few cycles for a null distribution, and a residual at the noise floor."""
SHORT = replace(SLOW, offset=9.0, support=3.0, moving_overlap=3.0, cycles=0.5)
CHANCE = replace(
    SLOW, offset=-30.0, support=11.0, moving_overlap=12.0, misfit=6.0, residual_px=1.2, rate=1.02, cycles=1.8
)


def test_a_unique_alignment_at_the_noise_floor_is_accepted() -> None:
    assert accept_or_reject(NAMES, [SLOW], 200.0, PairSettings()).solved
    assert accept_or_reject(NAMES, [SLOW, SHORT, replace(CHANCE, rate=1.0)], 200.0, PairSettings()).solved
    assert accept_or_reject(
        NAMES, [SLOW, replace(SHORT, cycles=0.62)], 200.0, PairSettings()
    ).solved  # a Bayes factor of just over 100


@pytest.mark.parametrize(
    "fits",
    [
        [
            SLOW,
            replace(SHORT, support=5.0, moving_overlap=5.0, cycles=0.8),
        ],  # another one fits as well with long support
        [replace(SLOW, support=4.5, cycles=1.0)],  # little support
        [replace(SLOW, cycles=0.7)],  # few cycles
        [replace(SLOW, cycles=0.9), replace(SHORT, cycles=0.4)],  # small margin of strength over the next
        [replace(SLOW, cycles=8.0), replace(SHORT, cycles=4.5)],  # the next is over half as strong: periodic motion
        # a plane explains 29 s of another one: what is behind a camera there is not determined
        [SLOW, replace(SHORT, support=29.0, moving_overlap=29.0, cycles=8.0, in_front=0.6, planar_residual_px=0.4)],
        [replace(SLOW, misfit=1.0)],  # residual above the noise
        [replace(SLOW, residual_px=0.6)],
        [
            replace(SLOW, geometry=FundamentalMatrix(np.eye(3), np.eye(3), 0.7))
        ],  # without intrinsics more motion fits by chance
    ],
)
def test_an_ambiguous_or_noisy_alignment_is_rejected(fits: list[PairFit]) -> None:
    assert "other lags fit nearly as well" in accept_or_reject(NAMES, fits, 200.0, PairSettings()).status


def test_alignments_beyond_the_absolute_limits_rank_last() -> None:
    assert [fit.offset for fit in rank_distinct([CHANCE, SHORT, SLOW], PairSettings())] == [2.0, 9.0, -30.0]


def _tracks(seed: int, seconds: float, noise: float, fastest: float) -> tuple[rigs.Session, SmoothTrack, SmoothTrack]:
    session = rigs.simulate(seed, 2, seconds, noise=noise, fastest=fastest, ppm=50.0, late=0.5)
    prepared = prepare(session.rig, session.observations())
    a, b = (prepared.cameras[name].tracks["marker"] for name in ("cam0", "cam1"))
    assert isinstance(a, SmoothTrack)
    assert isinstance(b, SmoothTrack)
    return session, a, b


def test_an_unobservable_rate_follows_the_typical_clock_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten slow seconds: a least-squares rate is thousands of ppm off and biases the lag."""
    with_prior: list[float] = []
    without_prior: list[float] = []
    for seed in (11, 12, 13, 14):
        _, a, b = _tracks(seed, 10.0, 1.0, 0.3)
        for std, found in ((final_refinement._TYPICAL_RATE_STD, with_prior), (1.0, without_prior)):
            with monkeypatch.context() as patch:
                patch.setattr(final_refinement, "_TYPICAL_RATE_STD", std)
                fit = pair_solver.solve_pair({"": a}, {"": b}, NAMES).fit
            assert fit is not None
            found.append(1e6 * abs(fit.rate - 1.0))
    assert max(with_prior) < 200.0
    assert max(without_prior) > 400.0


def test_the_autocorrelation_time_grows_with_coloured_noise() -> None:
    session, a, b = _tracks(21, 20.0, 0.5, 0.6)
    settings = PairSettings()
    pose = relative_pose_between(session.poses["cam0"], session.poses["cam1"])
    lag = session.shown("cam0", 10.0) - a.time_origin - session.shown("cam1", 10.0) + b.time_origin
    autocorrelation_times = []
    slow = 3.0 / a.focal * np.sin(2 * np.pi * 0.4 * a.time)[:, None] * [1.0, -1.0]  # as from inaccurate intrinsics
    for track in (a, replace(a, points=a.points + slow)):
        samples = Samples([track], [b], lag, settings, 2000)
        noise = NoiseModel(0.5 / a.focal, 0.5 / b.focal, settings.rate_prior_std)
        found = refine(samples, pose, samples.centre - lag, 1.0, noise, fixed_geometry=True, final_width=FINAL_WIDTH)
        assert found is not None
        autocorrelation_times.append(samples.autocorrelation_time(found))
    assert autocorrelation_times[0] < 2.0
    assert autocorrelation_times[1] > 8.0
