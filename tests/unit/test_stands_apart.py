"""Two cameras with little in common: what stands apart and tells its lag firmly is believed, and how it is turned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hub.calibration import pipeline as solver
from hub.calibration.pipeline import calibrate
from hub.calibration.preprocessing import Prepared, prepare
from hub.sync import final_refinement, pair_solver
from hub.sync.acceptance import judge, stands_apart
from hub.sync.alignment import PairFit, PairSettings, PairSolution, turned_round
from hub.trajectory.image_tracks import SmoothTrack, smooth_only
from hub.two_view.relative_pose import RelativePose, Uncalibrated
from protocols.geometry import so3
from protocols.session.observations import Observations
from tests.bench.drone_pairs import Stretch, stretch

NAMES = ("a", "b")
SETTINGS = PairSettings(firm=True)
STRONG = PairFit(
    rate=1.0001,
    offset=2.0,
    geometry=RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0])),
    cost=0.4,
    sigma_px=0.6,
    inliers=1.0,
    front=1.0,
    support=10.0,
    moving_overlap=10.0,
    middle=10.0,
    parallax=0.8,
    flat_px=6.0,
    misfit=1.0,
    own_px=0.3,
    log10_chance=-0.2,
    cycles=5.0,
)
"""Twice the tracks' own noise is left, as lenses that are a little off leave it; chance does not speak for it."""
WEAK = replace(STRONG, offset=9.0, cycles=2.5)


def tracks(seed: int) -> tuple[Stretch, Prepared, dict[str, dict[str, SmoothTrack]]]:
    """A stretch of 20 s, and the tracks of its two cameras."""
    made = stretch(seed, 20.0)
    assert made is not None
    prepared = prepare(made.rig, made.observations)
    return made, prepared, {name: smooth_only(prepared.camera(name).tracks) for name in NAMES}


def off(made: Stretch, prepared: Prepared, found: PairSolution) -> tuple[float, float]:
    """Errors of a pair's lag [s], in the middle of the stretch, and of its rotation [rad]."""
    assert found.fit is not None
    at_a, at_b = made.at_a - prepared.epochs["a"], made.at_b - prepared.epochs["b"]
    return found.fit.rate * at_b + found.fit.offset - at_a, so3.angle_between(found.fit.pose.rotation, made.turn)


def test_a_strong_alignment_apart_from_all_others_stands_apart() -> None:
    assert "other lags fit nearly as well" in judge(NAMES, [STRONG, WEAK], 200.0, SETTINGS).status
    assert stands_apart(STRONG, [STRONG, WEAK], SETTINGS)
    assert stands_apart(STRONG, [], SETTINGS)


@pytest.mark.parametrize(
    ("best", "others"),
    [
        (STRONG, [replace(WEAK, cycles=3.5)]),  # another one is nearly as strong
        (replace(STRONG, cycles=2.0), [replace(WEAK, cycles=1.1)]),  # a little of it
        (replace(STRONG, cycles=1.0), []),
        (replace(STRONG, support=4.0), []),
        (replace(STRONG, inliers=0.8), []),
        (replace(STRONG, front=0.8), []),
        (replace(STRONG, flat_px=1.5), []),  # a plane leaves hardly more
        (replace(STRONG, rate=1.02), []),
        (replace(STRONG, geometry=Uncalibrated(np.eye(3), np.eye(3), 0.7)), []),
    ],
)
def test_what_is_weak_or_faulty_does_not(best: PairFit, others: list[PairFit]) -> None:
    assert not stands_apart(best, [best, *others], SETTINGS)


@pytest.mark.parametrize("seed", [7065, 7131, 7143])
def test_lenses_a_little_off_keep_no_pair_from_its_answer(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made, prepared, both = tracks(seed)
    found = pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS)
    assert found.solved
    lag, turn = off(made, prepared, found)
    assert abs(lag) < 0.01
    assert turn < np.deg2rad(8.0)
    monkeypatch.setattr(pair_solver, "stands_apart", lambda *_: False)
    assert "other lags fit" in pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS).status


@pytest.mark.parametrize("limit", ["largest_doubt", "firm_turn_std", "largest_swing"])
def test_what_stands_apart_must_be_told_firmly(limit: str) -> None:
    _, _, both = tracks(7065)
    strict = replace(SETTINGS, **{limit: 0.0})
    assert "other lags fit" in pair_solver.solve_pair(both["a"], both["b"], NAMES, strict).status


def test_what_rests_on_little_motion_must_be_told_more_firmly() -> None:
    _, _, both = tracks(7131)
    for seconds, solved in ((10.0, True), (100.0, False)):
        strict = replace(SETTINGS, plenty_apart=seconds, largest_short_doubt=1e-3)
        assert pair_solver.solve_pair(both["a"], both["b"], NAMES, strict).solved == solved


def test_unrelated_tracks_do_not_tell_their_best_lag_firmly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their strongest alignment stands apart too, and would be believed."""
    kinds: list[bool] = []

    def spied(best: PairFit, fits: list[PairFit], s: PairSettings) -> bool:
        kinds.append(stands_apart(best, fits, s))
        return kinds[-1]

    monkeypatch.setattr(pair_solver, "stands_apart", spied)
    for one, other in ((7304, 7305), (7318, 7319), (7708, 7709)):
        a, b = tracks(one)[2]["a"], tracks(other)[2]["b"]
        assert not pair_solver.solve_pair(a, b, NAMES, SETTINGS).solved
    assert all(kinds)


def test_of_many_starts_the_likeliest_geometry_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen from far away: one start ends 30° off, in a valley, and leaves hardly more."""
    made, prepared, both = tracks(7024)
    found = pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS)
    assert off(made, prepared, found)[1] < np.deg2rad(5.0)
    monkeypatch.setattr(final_refinement, "_SEEDS", 0)
    assert off(made, prepared, pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS))[1] > np.deg2rad(20.0)


def test_a_lag_must_be_told_from_either_side() -> None:
    """Turned round, an alignment is the same one."""
    back = turned_round(STRONG)
    assert back.lag == pytest.approx(-STRONG.lag)
    turn = so3.exp(np.array([0.1, -0.4, 0.2]))
    geometry = RelativePose(turn, so3.exp(np.array([0.5, 0.1, 0.0])) @ np.array([1.0, 0.0, 0.0]))
    back = turned_round(replace(STRONG, geometry=geometry))
    matrix = geometry.matrix.T
    assert np.allclose(back.pose.matrix, matrix) or np.allclose(back.pose.matrix, -matrix)
    again = turned_round(back)
    assert np.allclose(again.pose.rotation, turn)
    assert np.allclose(again.pose.direction, geometry.direction)
    assert again.offset == pytest.approx(STRONG.offset)


def test_a_pair_by_itself_is_judged_so_beside_a_camera_that_sees_nothing_of_it() -> None:
    """Two cameras of which nobody else tells anything are held to the same, whoever else is in the session."""
    made, _, _ = tracks(7065)
    stranger, _, _ = tracks(7099)
    third = replace(stranger.rig.cameras["a"], name="c")
    rig = replace(made.rig, cameras=made.rig.cameras | {"c": third})
    (seen,) = stranger.observations.of_camera("a")
    both = Observations(made.observations.tracks | {("c", seen.label): replace(seen, camera="c")})
    alone, beside = calibrate(made.rig, made.observations), calibrate(rig, both)
    assert list(beside.refused) == ["c"]
    for name in NAMES:
        assert beside.cameras[name].time_map == alone.cameras[name].time_map


def test_rotations_that_fit_alike_are_refused() -> None:
    _, _, both = tracks(7024)
    narrow = replace(SETTINGS, largest_turn_apart=0.0)
    assert "rotations 0° apart" not in pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS).status
    assert "apart fit the motion alike" in pair_solver.solve_pair(both["a"], both["b"], NAMES, narrow).status


def test_a_rate_that_nothing_tells_is_held_while_two_cameras_are_adjusted(monkeypatch: pytest.MonkeyPatch) -> None:
    def rates(seeds: tuple[int, ...]) -> list[float]:
        out = []
        for seed in seeds:
            made, _, _ = tracks(seed)
            a, b = (calibrate(made.rig, made.observations).cameras[name].time_map.clock_rate for name in NAMES)
            out.append(1e6 * abs(b / a - 1.0))
        return out

    seeds = (7021, 7046)
    assert max(rates(seeds)) < 400.0
    free: Callable[..., float] = lambda graph, usual: usual  # noqa: E731
    monkeypatch.setattr(solver, "_rate_std", free)
    assert max(rates(seeds)) > 1000.0


def test_what_a_rate_was_held_by_is_no_knowledge_of_it() -> None:
    made, prepared, both = tracks(7065)
    found = pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS)
    assert found.fit is not None
    assert found.fit.rate_std < 1e-3
    solution = solver.solve_network(prepare(made.rig, made.observations), [found], lambda text, share: None)
    assert solution.scaffold.problem.freedom.rate_std == 1e-3
    assert prepared.epochs == solution.prepared.epochs
