"""Slow motion: an alignment that leaves no more than the noise and stands alone is believed; its rate is a clock's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.preprocessing import prepare
from hub.sync import final_refinement, pair_solver
from hub.sync.acceptance import distinct, judge
from hub.sync.alignment import PairFit, PairSettings, Samples
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view.refinement import WIDE, Noise, refine
from hub.two_view.relative_pose import RelativePose, Uncalibrated, relative_pose
from tests import rigs

NAMES = ("a", "b")
SLOW = PairFit(
    rate=1.0002,
    offset=2.0,
    geometry=RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0])),
    cost=0.2,
    sigma_px=0.3,
    inliers=1.0,
    front=1.0,
    support=7.5,
    moving_overlap=7.5,
    middle=10.0,
    parallax=0.8,
    flat_px=6.0,
    misfit=0.15,
    own_px=0.4,
    log10_chance=0.0,
    cycles=1.3,
)
"""Seven seconds of a drone: too few cycles for chance to be told, and all rows at the noise."""
SHORT = replace(SLOW, offset=9.0, support=3.0, moving_overlap=3.0, cycles=0.5)
JUNK = replace(SLOW, offset=-30.0, support=11.0, moving_overlap=12.0, misfit=6.0, sigma_px=1.2, rate=1.02, cycles=1.8)


def test_what_leaves_no_more_than_the_noise_and_stands_alone_is_believed() -> None:
    assert judge(NAMES, [SLOW], 200.0, PairSettings()).solved
    assert judge(NAMES, [SLOW, SHORT, replace(JUNK, rate=1.0)], 200.0, PairSettings()).solved
    assert judge(NAMES, [SLOW, replace(SHORT, cycles=0.62)], 200.0, PairSettings()).solved  # 1 in 100 as likely


@pytest.mark.parametrize(
    "fits",
    [
        [SLOW, replace(SHORT, support=5.0, moving_overlap=5.0, cycles=0.8)],  # another one fits as well for long
        [replace(SLOW, support=4.5, cycles=1.0)],  # hardly any motion
        [replace(SLOW, cycles=0.7)],  # hardly any cycle of it
        [replace(SLOW, cycles=0.9), replace(SHORT, cycles=0.4)],  # a little stronger than the next, of little
        [replace(SLOW, cycles=8.0), replace(SHORT, cycles=4.5)],  # or of much that repeats itself
        [replace(SLOW, misfit=1.0)],  # more than the noise
        [replace(SLOW, sigma_px=0.6)],
        [replace(SLOW, geometry=Uncalibrated(np.eye(3), np.eye(3), 0.7))],  # without lenses more of anything fits
    ],
)
def test_what_does_not_is_not(fits: list[PairFit]) -> None:
    assert "other lags fit nearly as well" in judge(NAMES, fits, 200.0, PairSettings()).status


def test_an_alignment_against_which_something_speaks_comes_last() -> None:
    assert [fit.offset for fit in distinct([JUNK, SHORT, SLOW], PairSettings())] == [2.0, 9.0, -30.0]


def _tracks(seed: int, seconds: float, noise: float, fastest: float) -> tuple[rigs.Session, SmoothTrack, SmoothTrack]:
    session = rigs.simulate(seed, 2, seconds, noise=noise, fastest=fastest, ppm=50.0, late=0.5)
    prepared = prepare(session.rig, session.observations())
    a, b = (prepared.cameras[name].tracks["marker"] for name in ("cam0", "cam1"))
    assert isinstance(a, SmoothTrack)
    assert isinstance(b, SmoothTrack)
    return session, a, b


def test_a_rate_that_the_motion_does_not_tell_is_a_clocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten slow seconds: a least squares rate is thousands of ppm off, and carries the lag away with it."""
    held: list[float] = []
    free: list[float] = []
    for seed in (11, 12, 13, 14):
        _, a, b = _tracks(seed, 10.0, 1.0, 0.3)
        for usual, found in ((final_refinement._USUAL_RATE, held), (1.0, free)):
            with monkeypatch.context() as patch:
                patch.setattr(final_refinement, "_USUAL_RATE", usual)
                fit = pair_solver.solve_pair({"": a}, {"": b}, NAMES).fit
            assert fit is not None
            found.append(1e6 * abs(fit.rate - 1.0))
    assert max(held) < 200.0
    assert max(free) > 400.0


def test_residuals_that_are_alike_count_as_one() -> None:
    session, a, b = _tracks(21, 20.0, 0.5, 0.6)
    settings = PairSettings()
    pose = relative_pose(session.poses["cam0"], session.poses["cam1"])
    lag = session.shown("cam0", 10.0) - a.epoch - session.shown("cam1", 10.0) + b.epoch
    together = []
    slow = 3.0 / a.focal * np.sin(2 * np.pi * 0.4 * a.time)[:, None] * [1.0, -1.0]  # as a lens that is a little wrong
    for track in (a, replace(a, points=a.points + slow)):
        samples = Samples([track], [b], lag, settings, 2000)
        noise = Noise(0.5 / a.focal, 0.5 / b.focal, settings.rate_std)
        found = refine(samples, pose, samples.centre - lag, 1.0, noise, fixed_geometry=True, narrowest=WIDE)
        assert found is not None
        together.append(samples.together(found))
    assert together[0] < 2.0
    assert together[1] > 8.0
