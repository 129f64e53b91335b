"""Two cameras with little common motion: unique maxima with a precise lag are accepted, and their rotation is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.preprocessing import PreparedSession, prepare
from hub.calibration import solvers as solver
from hub.calibration.pipeline import calibrate
from hub.sync import final_refinement, pair_solver
from hub.sync.acceptance import accept_or_reject, is_unique_maximum
from hub.sync.hypothesis import PairFit, PairSolution, swap_cameras
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack, smooth_only
from hub.two_view.relative_pose import FundamentalMatrix, RelativePose
from protocols.geometry import so3
from protocols.session.observations import Observations
from tests.bench.drone_pairs import Stretch, stretch

NAMES = ("a", "b")
SETTINGS = PairSettings(standalone=True)
STRONG = PairFit(
    rate=1.0001,
    offset=2.0,
    geometry=RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0])),
    residual_px=0.6,
    inliers=1.0,
    in_front=1.0,
    support=10.0,
    moving_overlap=10.0,
    mid_time=10.0,
    parallax=0.8,
    planar_residual_px=6.0,
    misfit=1.0,
    track_noise_px=0.3,
    log10_false_alarm=-0.2,
    cycles=5.0,
)
"""A residual of twice the tracks' noise, as from inaccurate intrinsics; the false-alarm probability is high."""
WEAK = replace(STRONG, offset=9.0, cycles=2.5)


def tracks(seed: int) -> tuple[Stretch, PreparedSession, dict[str, dict[str, SmoothTrack]]]:
    """A stretch of 20 s, and the tracks of its two cameras."""
    made = stretch(seed, 20.0)
    assert made is not None
    prepared = prepare(made.rig, made.observations)
    return made, prepared, {name: smooth_only(prepared.camera(name).tracks) for name in NAMES}


def off(made: Stretch, prepared: PreparedSession, found: PairSolution) -> tuple[float, float]:
    """Errors of a pair's lag [s], at the middle of the stretch, and of its rotation [rad]."""
    assert found.fit is not None
    at_a, at_b = made.at_a - prepared.time_origins["a"], made.at_b - prepared.time_origins["b"]
    return found.fit.rate * at_b + found.fit.offset - at_a, so3.angle_between(found.fit.pose.rotation, made.rotation)


def test_a_much_stronger_alignment_is_a_unique_maximum() -> None:
    assert "other lags fit nearly as well" in accept_or_reject(NAMES, [STRONG, WEAK], 200.0, SETTINGS).status
    assert is_unique_maximum(STRONG, [STRONG, WEAK], SETTINGS)
    assert is_unique_maximum(STRONG, [], SETTINGS)


@pytest.mark.parametrize(
    ("best", "others"),
    [
        (STRONG, [replace(WEAK, cycles=3.5)]),  # another one is nearly as strong
        (replace(STRONG, cycles=2.0), [replace(WEAK, cycles=1.1)]),  # small margin
        (replace(STRONG, cycles=1.0), []),
        (replace(STRONG, support=4.0), []),
        (replace(STRONG, inliers=0.8), []),
        (replace(STRONG, in_front=0.8), []),
        (replace(STRONG, planar_residual_px=1.5), []),  # the residual of a plane is hardly larger
        (replace(STRONG, rate=1.02), []),
        (replace(STRONG, geometry=FundamentalMatrix(np.eye(3), np.eye(3), 0.7)), []),
    ],
)
def test_a_weak_or_invalid_alignment_is_no_unique_maximum(best: PairFit, others: list[PairFit]) -> None:
    assert not is_unique_maximum(best, [best, *others], SETTINGS)


@pytest.mark.parametrize("seed", [7065, 7131, 7143])
def test_pairs_with_inaccurate_intrinsics_are_solved(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made, prepared, both = tracks(seed)
    found = pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS)
    assert found.solved
    lag, rotation_error = off(made, prepared, found)
    assert abs(lag) < 0.01
    assert rotation_error < np.deg2rad(8.0)
    monkeypatch.setattr(pair_solver, "is_unique_maximum", lambda *_: False)
    assert "other lags fit" in pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS).status


@pytest.mark.parametrize("limit", ["max_total_lag_std", "unique_max_rotation_std", "max_leave_out_change"])
def test_a_unique_maximum_must_pass_the_sensitivity_test(limit: str) -> None:
    _, _, both = tracks(7065)
    strict = replace(SETTINGS, **{limit: 0.0})
    assert "other lags fit" in pair_solver.solve_pair(both["a"], both["b"], NAMES, strict).status


def test_a_unique_maximum_with_short_support_needs_a_more_precise_lag() -> None:
    _, _, both = tracks(7131)
    for seconds, solved in ((10.0, True), (100.0, False)):
        strict = replace(SETTINGS, unique_long_support=seconds, max_total_lag_std_short=1e-3)
        assert pair_solver.solve_pair(both["a"], both["b"], NAMES, strict).solved == solved


def test_unrelated_tracks_fail_the_sensitivity_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their strongest alignment is a unique maximum too, and would otherwise be accepted."""
    results: list[bool] = []

    def recorded(best: PairFit, fits: list[PairFit], s: PairSettings) -> bool:
        results.append(is_unique_maximum(best, fits, s))
        return results[-1]

    monkeypatch.setattr(pair_solver, "is_unique_maximum", recorded)
    for one, other in ((7304, 7305), (7318, 7319), (7708, 7709)):
        a, b = tracks(one)[2]["a"], tracks(other)[2]["b"]
        assert not pair_solver.solve_pair(a, b, NAMES, SETTINGS).solved
    assert all(results)


def test_the_most_likely_geometry_of_many_starts_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Distant motion: one start ends 30° off, in a flat valley, at a hardly larger cost."""
    made, prepared, both = tracks(7024)
    found = pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS)
    assert off(made, prepared, found)[1] < np.deg2rad(5.0)
    monkeypatch.setattr(final_refinement, "_FIVE_POINT_SEEDS", 0)
    assert off(made, prepared, pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS))[1] > np.deg2rad(20.0)


def test_swapping_the_cameras_inverts_an_alignment() -> None:
    back = swap_cameras(STRONG)
    assert back.lag == pytest.approx(-STRONG.lag)
    rotation = so3.exp(np.array([0.1, -0.4, 0.2]))
    geometry = RelativePose(rotation, so3.exp(np.array([0.5, 0.1, 0.0])) @ np.array([1.0, 0.0, 0.0]))
    back = swap_cameras(replace(STRONG, geometry=geometry))
    matrix = geometry.matrix.T
    assert np.allclose(back.pose.matrix, matrix) or np.allclose(back.pose.matrix, -matrix)
    again = swap_cameras(back)
    assert np.allclose(again.pose.rotation, rotation)
    assert np.allclose(again.pose.direction, geometry.direction)
    assert again.offset == pytest.approx(STRONG.offset)


def test_a_standalone_pair_is_tested_as_such_beside_an_unconnected_camera() -> None:
    """Two cameras without other connections pass the same tests, whatever other cameras are in the session."""
    made, _, _ = tracks(7065)
    unrelated, _, _ = tracks(7099)
    third = replace(unrelated.rig.cameras["a"], name="c")
    rig = replace(made.rig, cameras=made.rig.cameras | {"c": third})
    (seen,) = unrelated.observations.of_camera("a")
    both = Observations(made.observations.tracks | {("c", seen.label): replace(seen, camera="c")})
    alone, beside = calibrate(made.rig, made.observations), calibrate(rig, both)
    assert list(beside.refused) == ["c"]
    for name in NAMES:
        assert beside.cameras[name].time_map == alone.cameras[name].time_map


def test_equally_likely_rotations_are_refused() -> None:
    _, _, both = tracks(7024)
    strict = replace(SETTINGS, max_rotation_ambiguity=0.0)
    assert "rotations 0° apart" not in pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS).status
    assert "apart fit the motion equally well" in pair_solver.solve_pair(both["a"], both["b"], NAMES, strict).status


@pytest.mark.parametrize("seed", [7021, 7046])
def test_an_unobservable_rate_stays_near_a_crystals_in_a_two_camera_adjustment(seed: int) -> None:
    made, _, _ = tracks(seed)
    a, b = (calibrate(made.rig, made.observations).cameras[name].time_map.clock_rate for name in NAMES)
    assert 1e6 * abs(b / a - 1.0) < 400.0


def test_the_rate_prior_of_a_pair_is_not_used_as_an_observation() -> None:
    made, prepared, both = tracks(7065)
    found = pair_solver.solve_pair(both["a"], both["b"], NAMES, SETTINGS)
    assert found.fit is not None
    assert found.fit.rate_prior_std < 1e-3
    solution = solver.solve_network(prepare(made.rig, made.observations), [found], lambda text, share: None)
    assert solution.reconstruction.problem.free_parameters.rate_std == 1e-3
    assert prepared.time_origins == solution.prepared.time_origins
