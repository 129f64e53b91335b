"""Solvers: from prepared tracks to an adjusted network in the internal gauge, jointly or by the paper's method."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hub.bundle.adjustment import adjust
from hub.bundle.initialisation import (
    Reconstruction,
    place_cameras,
    reconstruct_incrementally,
    reconstruct_with_known_poses,
)
from hub.bundle.noise.noise_scale import residual_std
from hub.bundle.noise.timestamp_jitter import estimate_frame_times
from hub.bundle.preprocessing import NO_INTRINSICS, PreparedSession
from hub.bundle.problem import CameraState, FreeParameters
from hub.calibration.acceptance import CameraTests, misfits, network_failure
from hub.calibration.final_adjustment import final_adjustment
from hub.calibration.pairs.pair_network import (
    Progress,
    coincide,
    describe_failures,
    describe_timing,
    frame_rate_warnings,
)
from hub.calibration.resection.unconnected import connect_by_resection, listed
from hub.calibration.self_calibration import LEAST_CAMERAS, initial_self_calibration, with_updated_lenses
from hub.clocks.clock_graph import ClockGraph, TimeMapEstimate, connected_components, synchronise_clocks
from hub.sync.hypothesis import PairSolution
from hub.trajectory.image_tracks import smooth_only
from hub.two_view.relative_pose import fundamental_from
from protocols.core.acceptance import AcceptanceTest
from protocols.core.errors import Refused
from protocols.session.calibration import FixedCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_LENS_ITERATIONS = 3  # a bound: it stops where no lens changes


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """An adjusted network in the internal gauge and on the internal clock, before publication.

    refused: reason by camera. solver: "joint", "distributed" or "paper".
    """

    reconstruction: Reconstruction
    pairs: tuple[PairSolution, ...]
    refused: dict[str, str]
    prepared: PreparedSession
    solver: str
    warnings: tuple[str, ...] = field(default=())
    known: FixedCalibration | None = None
    """Poses that were given and are kept; their world is then the published one."""
    acceptance: Mapping[str, Sequence[AcceptanceTest]] = field(default_factory=dict)
    """The acceptance tests by camera, those of refused cameras among them."""


def paper_pairs(prepared: PreparedSession, observations: Observations, report: Progress) -> list[PairSolution]:
    """All pairs by the asynchronous calibration paper's method. Raises Refused for a shared clock (no lags)."""
    from hub.baselines.alternating_lag import solve_pair_by_paper

    if prepared.shared_clock:
        raise Refused('the paper\'s method finds lags, and clock = "shared" says there are none', {})
    pairs = []
    todo = list(itertools.combinations(prepared.cameras, 2))
    for done, (a, b) in enumerate(todo):
        report(f"pair {a}–{b}", 0.05 + 0.7 * done / max(len(todo), 1))
        first, second = prepared.cameras[a], prepared.cameras[b]
        pairs.append(
            solve_pair_by_paper(
                (smooth_only(first.tracks), smooth_only(second.tracks)),
                (observations.by_label(a), observations.by_label(b)),
                (first.intrinsics, second.intrinsics),
                (a, b),
            )
        )
    return pairs


def solve_with_unknown_lenses(
    rig: Rig,
    prepared: PreparedSession,
    pairs: list[PairSolution],
    report: Progress,
    *,
    online: bool = False,
    refine_lenses: bool = False,
    thorough: bool = False,
) -> Solution:
    """The network with cameras of unknown intrinsics, where the common trajectory determines their focal lengths.

    Where it does not, those cameras are refused with their timing, as if no self-calibration had been tried.
    """
    trial, trial_pairs = initial_self_calibration(rig, prepared, pairs)
    if trial is prepared:
        return solve_network(prepared, pairs, report, online=online, refine_lenses=refine_lenses, thorough=thorough)
    report("focal lengths", 0.58)
    try:
        for _ in range(_LENS_ITERATIONS):
            solution = solve_network(
                trial, trial_pairs, report, online=online, refine_lenses=refine_lenses, thorough=thorough
            )
            found = dict(zip(solution.reconstruction.names, solution.reconstruction.state.cameras, strict=True))
            lenses = {name: camera.intrinsics for name, camera in found.items()}
            trial, trial_pairs, changed = with_updated_lenses(trial, trial_pairs, lenses)
            if not changed:
                break
    except Refused as refusal:
        reasons = {name: refusal.cameras.get(name, "") for name in prepared.uncalibrated if name in trial.cameras}
        without = replace(prepared, refused=_with_lens_failure(prepared, reasons))
        return solve_network(without, pairs, report, online=online, refine_lenses=refine_lenses, thorough=thorough)
    uncalibrated = [name for name in prepared.uncalibrated if name in trial.cameras]
    left = {name: solution.refused[name] for name in uncalibrated if name in solution.refused}
    refused = solution.refused | {
        name: reason for name, reason in _with_lens_failure(prepared, left).items() if name in left
    }
    # Pairs of a refused camera are reported as they were before self-calibration.
    matrices = {name: prepared.camera(name).intrinsics.matrix for name in prepared.names}
    before = {
        (pair.a, pair.b): replace(
            pair, fundamental=fundamental_from(pair.fit.geometry, matrices[pair.a], matrices[pair.b])
        )
        for pair in pairs
        if {pair.a, pair.b} & set(left) and pair.fit is not None and pair.solved
    }
    reported_pairs = tuple(before.get((pair.a, pair.b), pair) for pair in solution.pairs)
    return replace(solution, refused=in_rig_order(refused, prepared), pairs=reported_pairs)


def _with_lens_failure(prepared: PreparedSession, failures: dict[str, str]) -> dict[str, str]:
    """Reasons of refused cameras, with the failure of self-calibration for those that were tried."""
    return {
        name: f"{reason}; its lens could not be estimated from the trajectory: {failures[name]}"
        if failures.get(name)
        else reason
        for name, reason in prepared.refused.items()
    }


def solve_network(
    prepared: PreparedSession,
    pairs: list[PairSolution],
    report: Progress,
    place: Callable[[ClockGraph], tuple[Reconstruction, Mapping[str, str]]] | None = None,
    *,
    online: bool = False,
    refine_lenses: bool = False,
    thorough: bool = False,
    clocks: Mapping[str, TimeMapEstimate] | None = None,
) -> Solution:
    """One adjusted network from the pairs; cameras that do not fit are refused with a reason.

    place: an adjusted network of a clock graph's cameras, and reasons of those that it leaves out; None = incremental
    reconstruction and bundle adjustment. clocks: initial time maps of the cameras that ``place`` takes, where they do
    not come from pairs.
    """
    refused = dict(prepared.refused)
    final = partial(final_adjustment, report=report, online=online, refine_lenses=refine_lenses)
    free_parameters = FreeParameters(clock=not prepared.shared_clock)

    def connected(names: list[str], pairs: list[PairSolution]) -> ClockGraph:
        if clocks is None:
            return _largest_component(prepared, names, pairs, refused)
        return ClockGraph({name: clocks[name] for name in names if name in clocks}, (), ())

    graph = connected(list(prepared.cameras), pairs)
    unfit, failures = set[str](), CameraTests()
    with_rate_prior = replace(free_parameters, rate_std=_rate_prior_std(graph, free_parameters.rate_std))
    placed: dict[str, CameraState] = {}
    while True:
        unplaced: Mapping[str, str]
        if place is not None:
            reconstruction, unplaced = place(graph)
        else:
            session = prepared.cameras, graph, prepared.rows, prepared.labels
            reconstruction, unplaced = (
                place_cameras(*session, placed, with_rate_prior)
                if placed.keys() == graph.clocks.keys()
                else reconstruct_incrementally(*session, lambda text: report(text, 0.6), with_rate_prior)
            )
            reconstruction = final(reconstruction, warm=bool(placed) and not (online or refine_lenses))
            # The narrow rate prior only stabilises the estimate; stds are computed with the usual one.
            usual = replace(reconstruction.problem.free_parameters, rate_std=free_parameters.rate_std)
            reconstruction.problem = replace(reconstruction.problem, free_parameters=usual)
        refused |= unplaced
        tests: CameraTests = {}
        guesses = [n for n, one in prepared.cameras.items() if one.lens_prior and not one.lens_prior.focal_only]
        inconsistent = misfits(reconstruction, guesses)
        failure = inconsistent[0] if inconsistent else network_failure(reconstruction, graph.inlier_pairs, tests)
        if failure is None:
            break
        # The worst one is removed, and the reconstruction that it may have distorted is adjusted without it; from the
        # pairs on where more cameras do not fit.
        worst, failed = failure
        refused[worst], failures[worst] = failed.reason, [failed]
        if not inconsistent:
            unfit.add(worst)  # resection would place it alike
        remaining = [name for name in reconstruction.names if name != worst]
        if len(remaining) < 2:
            raise Refused(f"no two cameras can be placed ({worst}: {failed.reason})", refused, acceptance=failures)
        states = dict(zip(reconstruction.names, reconstruction.state.cameras, strict=True))
        placed = {name: states[name] for name in remaining} if len(inconsistent) < 2 and len(remaining) > 2 else {}
        graph = connected(remaining, list(graph.inlier_pairs))
    unconnected = [name for name in prepared.cameras if name in refused and name not in unfit]
    if thorough and unconnected and not prepared.shared_clock:
        report("resection of further cameras", 0.93)
        prepared, reconstruction, more, reasons = connect_by_resection(
            prepared,
            reconstruction,
            unconnected,
            free_parameters,
            lambda trial: final(trial, warm=not (online or refine_lenses)),
            _misfit,
        )
        if more:
            joint = {(pair.a, pair.b): pair for pair in more}
            pairs = [joint.get((pair.a, pair.b), pair) for pair in pairs]
            prepared = replace(prepared, warnings=prepared.warnings + frame_rate_warnings(prepared, pairs))
        refused = {name: reason for name, reason in refused.items() if name not in reconstruction.names}
        refused |= {name: f"{reason}; {refused[name]}" for name, reason in reasons.items()}
    acceptance = {name: made for name, made in failures.items() if name in refused} | tests
    warnings = tuple(
        f"pair {pair.a}–{pair.b} contradicts the other pairs and was rejected" for pair in graph.outlier_pairs
    )
    refused = in_rig_order(refused, prepared)
    return Solution(reconstruction, tuple(pairs), refused, prepared, "joint", warnings, acceptance=acceptance)


def _misfit(reconstruction: Reconstruction, name: str) -> str:
    """Why a camera does not fit the others, or makes one of these fail, which passed without it; "" if it fits."""
    own = [failure for failure in misfits(reconstruction) if failure[0] == name]
    failure = own[0] if own else network_failure(reconstruction, (), {})
    if failure is None or failure[0] == name:
        return "" if failure is None else failure[1].reason
    return f"with it {failure[0]} fails: {failure[1].reason}"


def _rate_prior_std(graph: ClockGraph, usual: float) -> float:
    """Prior std of clock rates: narrow for an isolated pair whose epipolar geometry did not determine the rate.

    The trajectory would not determine it either, and a rate error of thousands of ppm would shift the lag.
    """
    stds = [
        pair.fit.rate_prior_std
        for pair in graph.inlier_pairs
        if pair.fit is not None and np.isfinite(pair.fit.total_lag_std)
    ]
    return min([usual, *stds])


def solve_paper(
    rig: Rig,
    prepared: PreparedSession,
    pairs: list[PairSolution],
    report: Progress,
    sized: Observations | None = None,
) -> Solution:
    """Network from the pairs of the paper's method: averaged clocks, no adjustment.

    Poses by resection, or, where all rows have sizes (``sized``), by the distributed pose paper's method.
    """
    kept = {name: replace(camera, lens_prior=None) for name, camera in prepared.cameras.items()}
    prepared, refused = replace(prepared, cameras=kept), dict(prepared.refused)
    if pairs or sized is None:
        graph = _largest_component(prepared, list(prepared.cameras), pairs, refused)
    else:
        graph = ClockGraph({name: TimeMapEstimate(1.0, 0.0, 0.0) for name in prepared.cameras}, (), ())
    report("placing", 0.8)
    if sized is None:
        reconstruction, unplaced = reconstruct_incrementally(
            prepared.cameras, graph, prepared.rows, prepared.labels, free_parameters=None
        )
    else:
        from hub.baselines.recursive_poses import reconstruct_by_paper

        reconstruction, unplaced = reconstruct_by_paper(rig, prepared, sized, graph)
    if prepared.shared_clock:
        free_parameters = replace(reconstruction.problem.free_parameters, clock=False)
        reconstruction.problem = replace(reconstruction.problem, free_parameters=free_parameters)
    reconstruction.state = replace(
        reconstruction.state, sigma=residual_std(reconstruction.problem, reconstruction.state)
    )
    warning = "the paper's method has no adjustment: its stds assume independent noise and are too small"
    return Solution(
        reconstruction, tuple(pairs), in_rig_order(refused | unplaced, prepared), prepared, "paper", (warning,)
    )


def solve_with_known_poses(
    prepared: PreparedSession, pairs: list[PairSolution], known: FixedCalibration, report: Progress
) -> Solution:
    """Clocks and trajectories only, at given intrinsics and poses."""
    refused = dict(prepared.refused)
    for name in [name for name in prepared.cameras if name not in known.cameras]:
        refused[name] = "not in the known calibration"
    cameras = {name: camera for name, camera in prepared.cameras.items() if name in known.cameras}
    inside = replace(prepared, cameras=cameras, refused=refused)
    if len(cameras) > 1 and coincide(*(known.cameras[name].pose.position for name in cameras)):
        raise Refused(f"the known cameras {', '.join(cameras)} are in one place: their rays meet nowhere else", refused)
    report("adjusting", 0.75)

    def place(graph: ClockGraph) -> tuple[Reconstruction, Mapping[str, str]]:
        poses = {name: known.cameras[name].pose for name in graph.clocks}
        free_clocks = not prepared.shared_clock
        start = reconstruct_with_known_poses(cameras, graph, prepared.rows, prepared.labels, poses, free_clocks)
        problem, state = estimate_frame_times(*adjust(start.problem, start.state)[:2])
        return replace(start, problem=problem, state=state), {}

    return replace(solve_network(inside, pairs, report, place), known=known)


def _largest_component(
    prepared: PreparedSession, names: list[str], pairs: list[PairSolution], refused: dict[str, str]
) -> ClockGraph:
    """Clock graph of the largest component of ``names`` over solved pairs; the others are entered in ``refused``.

    Raises Refused, with every camera's reason, where no pair is solved.
    """
    placeable = [pair for pair in pairs if pair.a in prepared.cameras and pair.b in prepared.cameras]
    solved = [pair for pair in placeable if pair.solved and pair.a in names and pair.b in names]
    if not solved:
        reasons = refused | {name: _unplaced_reason(name, prepared, pairs) for name in names}
        refusal = Refused(_no_pair_reason(prepared, placeable, refused), in_rig_order(reasons, prepared))
        refusal.permanent = (
            len(prepared.uncalibrated) > 0 and len(prepared.cameras) < 2 and len(prepared.names) < LEAST_CAMERAS
        )
        raise refusal
    groups = connected_components(names, solved)
    for name in [name for name in names if name not in groups[0]]:
        refused[name] = _disconnected_reason(name, groups, pairs)
    inside = [pair for pair in solved if pair.a in groups[0] and pair.b in groups[0]]
    if prepared.shared_clock:
        return ClockGraph({name: TimeMapEstimate(1.0, 0.0, 0.0) for name in groups[0]}, tuple(inside), ())
    return synchronise_clocks(groups[0], inside, {name: prepared.cameras[name].tracks for name in groups[0]})


def with_known_timing(prepared: PreparedSession, pairs: list[PairSolution]) -> dict[str, str]:
    """Reasons of the refused cameras, with the estimated timing of those without intrinsics."""
    refused = dict(prepared.refused)
    for name in prepared.uncalibrated:
        timing = describe_timing(name, prepared, pairs)
        refused[name] = (
            f"no intrinsics: only its timing is known (pairs in result.json: {timing}); run `syncline intrinsics`"
            if timing
            else f"{NO_INTRINSICS}; nor is its timing known ({describe_failures(name, pairs)})"
        )
    return refused


def in_rig_order(refused: dict[str, str], prepared: PreparedSession) -> dict[str, str]:
    """Reasons in the rig's order."""
    return {name: refused[name] for name in prepared.camera_order if name in refused}


def _no_pair_reason(prepared: PreparedSession, pairs: list[PairSolution], refused: dict[str, str]) -> str:
    if not pairs:
        short = refused | dict.fromkeys(prepared.uncalibrated, "no intrinsics")
        listed = "; ".join(f"{name}: {reason}" for name, reason in short.items())
        remedy = (
            "; give their intrinsics: `syncline intrinsics` with a board, --model or --field-of-view"
            if prepared.uncalibrated
            else "; film what moves with two cameras or more at the same time"
        )
        return (
            f"fewer than two cameras can be placed ({listed}){remedy}"
            if listed
            else "one camera only: a pair is needed"
        )
    if any(pair.solved for pair in pairs):
        listed = "; ".join(f"{name}: {reason}" for name, reason in in_rig_order(refused, prepared).items())
        return f"no two cameras are left whose views fit together ({listed})"
    listed = "; ".join(f"{pair.a}–{pair.b}: {pair.status}" for pair in pairs[:6])
    return f"no pair of cameras could be synchronised ({listed})"


def _unplaced_reason(name: str, prepared: PreparedSession, pairs: list[PairSolution]) -> str:
    """Why a camera with intrinsics that is connected to no other such camera has no pose."""
    timing = describe_timing(name, prepared, pairs)
    if timing:
        return (
            f"only its timing is known (pairs in result.json: {timing}): connected to no other camera with intrinsics"
        )
    return describe_failures(name, pairs)


def _disconnected_reason(name: str, groups: list[list[str]], pairs: list[PairSolution]) -> str:
    mine = next(group for group in groups if name in group)
    tried = describe_failures(name, pairs)
    if len(mine) > 1:
        return f"connected only to {listed(other for other in mine if other != name)}, not to the rest ({tried})"
    return f"could not be connected to any camera ({tried})"
