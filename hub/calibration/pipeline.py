"""The calibration pipeline: tracks, camera pairs, clock graph, reconstruction, bundle adjustment, calibration.

No sockets, files or clocks: `syncline calibrate` and the live hub run the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from hub.bundle.preprocessing import PreparedSession, prepare
from hub.calibration.acceptance import LAG_CONFLICT, check_stature
from hub.calibration.pairs.moved_pair import likely_maps, moves_of_two, time_map_between
from hub.calibration.pairs.pair_network import Progress, frame_rate_warnings, solve_pairs
from hub.calibration.pairs.pair_reports import isolated_pair_report
from hub.calibration.resection.moved_cameras import Move, moved_cameras, without_moved
from hub.calibration.resection.set_clocks import SetClock, between_settings, set_clocks, unexplained_sides
from hub.calibration.result import assemble_calibration
from hub.calibration.solvers import (
    Solution,
    paper_pairs,
    solve_network,
    solve_paper,
    solve_with_known_poses,
    solve_with_unknown_lenses,
    with_known_timing,
)
from hub.clocks.external_prior import ExternalClockPrior
from hub.sync.hypothesis import PairSolution
from protocols.core.acceptance import first_failure
from protocols.core.errors import Refused
from protocols.session.calibration import Calibration, FixedCalibration
from protocols.session.folder import enlargements
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_SMALL_BODY = 4  # points of a single tag
_FAR_BETTER = 0.5  # residuals of noise are the same in pictures of any size, and a wrong size's are 10 times as large


def calibrate(
    rig: Rig,
    observations: Observations,
    progress: Progress | None = None,
    *,
    solver: str = "joint",
    known: FixedCalibration | None = None,
    thorough: bool = False,
    seed: int = 0,
    clock_priors: Mapping[str, ExternalClockPrior] | None = None,
    arrivals: Mapping[str, ExternalClockPrior] | None = None,
    online: bool = False,
    refine_lenses: bool = False,
) -> Calibration:
    """Timing and poses of all cameras from their observations, without initial values.

    solver: "joint" (bundle adjustment), "distributed" (pose nodes), or "paper" (the asynchronous calibration paper's
    alternating method: no adjustment, equal frame rates, lags of a few frames). known: given intrinsics and poses;
    then only timing and trajectories are estimated. thorough: whether unconnected cameras get a second, far slower
    search over clock rates that a wrong nominal frame rate causes (times made from frame numbers, which a live
    camera's are not) and over interrupted tracks. seed: of the random samples of the pose nodes; the other solvers are
    deterministic. clock_priors: external clock priors by camera, used only where the images leave lags ambiguous.
    arrivals: the same by times of arrival at a hub; lags far from them are not searched. online, refine_lenses: see
    `final_adjustment`. Raises Refused, with a reason for every camera and the pair reports, where fewer than two
    cameras can be placed.
    """
    report = progress or (lambda text, share: None)
    rig = rig if known is None else with_known_intrinsics(rig, known)
    if rig.bodies and solver == "joint" and not online and _has_bodies(rig, observations):
        from hub.calibration.rigid_body.solve import calibrate_bodies

        try:
            return calibrate_bodies(rig, observations, report, known)
        except Refused:
            # The pose of a small tag is too coarse to connect cameras: its corners are points that move.
            if max(len(body) for body in rig.bodies.values()) > _SMALL_BODY:
                raise
            rig = replace(rig, bodies={}, scale_bars=rig.scale_bars + _diagonals(rig))
    again = partial(
        calibrate,
        rig,
        progress=progress,
        thorough=thorough,
        clock_priors=clock_priors,
        arrivals=arrivals,
        online=online,
        refine_lenses=refine_lenses,
    )
    if solver == "joint" and known is None and (heads := heads_of_people(rig, observations)) is not observations:
        with suppress(Refused):  # heads of people of one height lie in a plane, which places no camera
            return again(heads)
    prepared = prepare(rig, observations)
    has_sizes = solver == "paper" and known is None and _have_sizes(prepared, observations)
    if has_sizes and prepared.shared_clock:
        pairs = []  # no lags to estimate
    elif solver == "paper" and known is None:
        pairs = paper_pairs(prepared, observations, report)
    else:
        # With a solved path, resection finds the other cameras, at a fraction of the cost of further pairs.
        extent: bool | Literal["first pair"] = (
            "first pair" if thorough and solver == "joint" and known is None else thorough
        )
        prepared, pairs = solve_pairs(
            prepared, report, thorough=extent, known=known, clock_priors=clock_priors, arrivals=arrivals
        )
        prepared = replace(
            prepared,
            refused=with_known_timing(prepared, pairs),
            warnings=prepared.warnings + frame_rate_warnings(prepared, pairs),
        )
    may_move = thorough and solver == "joint" and known is None and not prepared.shared_clock
    of_two = solver == "joint" and known is None and not prepared.shared_clock and len(prepared.cameras) == 2
    try:
        if known is not None:
            solution = solve_with_known_poses(prepared, pairs, known, report)
        elif solver == "paper":
            solution = solve_paper(rig, prepared, pairs, report, observations if has_sizes else None)
        elif solver == "distributed":
            from hub.distributed.solver import DistributedPoseSolver

            nodes = DistributedPoseSolver(rig, prepared, observations, report, seed)
            solution = solve_network(prepared, pairs, report, nodes)
            solution = replace(solution, solver="distributed", warnings=solution.warnings + nodes.warnings)
        else:
            solution = solve_with_unknown_lenses(
                rig, prepared, pairs, report, online=online, refine_lenses=refine_lenses, thorough=thorough
            )
        if may_move and (found := _from_still_parts(solution, observations, again)):
            return found
        clocks = solution.reconstruction.state.cameras
        maps = [time_map_between(*clocks)] if of_two and len(clocks) == 2 == len(solution.prepared.cameras) else []
        if not (moves := moves_of_two(solution.prepared, maps, observations, online)):
            report("covariances", 0.95)
            calibration = assemble_calibration(rig, solution, refine_lenses=refine_lenses, online=online)
            _check(calibration, rig, observations, again if may_move or online else None)
            return calibration
    except Refused as refusal:
        if may_move and (found := _between_settings(set_clocks(prepared.cameras, observations), observations, again)):
            return found
        likely = likely_maps(rig, observations, prepared, pairs) if of_two else ()
        if not (moves := moves_of_two(prepared, likely, observations, online)):
            raise _with_pairs(refusal, prepared, pairs) from None
    return _from_one_side(moves, observations, again)


def heads_of_people(rig: Rig, observations: Observations) -> Observations:
    """The observations without the feet where the target is people and there are several, whose heads are enough.

    A detected foot is ten times as inexact as a head, and for a whole step at a time, which passes for clocks and
    stamps: of five simulated rigs with four people for 36 s it left one, with lags 25 ms off at stds of 9 to 11.
    """
    heads = {key: track for key, track in observations.tracks.items() if key[1].endswith("-head")}
    several = rig.metadata.get("target") == "person" and len({label for _, label in heads}) > 1
    return replace(observations, tracks=heads) if several and len(heads) < len(observations.tracks) else observations


def _have_sizes(prepared: PreparedSession, observations: Observations) -> bool:
    """Whether all rows have sizes."""
    from hub.baselines.recursive_poses import all_tracks_have_sizes  # the other solvers do not need to load it

    return all_tracks_have_sizes(prepared, observations)


def _with_pairs(refusal: Refused, prepared: PreparedSession, pairs: list[PairSolution]) -> Refused:
    """The refusal with what is known of the pairs."""
    failed = ((name, first_failure(tests)) for name, tests in refusal.acceptance.items())
    conflicting = {name: test for name, test in failed if test is not None and test.name == LAG_CONFLICT}
    rejected = [replace(p, status=conflicting[p.b].reason) if p.b in conflicting else p for p in pairs]
    refusal.pairs = tuple(isolated_pair_report(pair, prepared) for pair in rejected)
    refusal.warnings = prepared.warnings
    return refusal


def _from_still_parts(
    solution: Solution, observations: Observations, again: Callable[[Observations], Calibration]
) -> Calibration | None:
    """The calibration without the shorter sides of jumps of clocks, or of moves of cameras; None without either.

    Also None where what is left says too little: then all rows have to do.
    """
    left_out = [name for name in solution.prepared.cameras if name in solution.refused]
    if found := _between_settings(set_clocks(left_out, observations), observations, again):
        return found
    if moves := moved_cameras(solution, observations):
        with suppress(Refused):
            found = again(without_moved(observations, moves))
            warnings = tuple(move.warning(name) for name, move in moves.items())
            return replace(found, warnings=(*found.warnings, *warnings))
    return _between_settings(unexplained_sides(solution, observations), observations, again)


def _check(
    found: Calibration, rig: Rig, observations: Observations, again: Callable[[Observations], Calibration] | None
) -> None:
    """Raise Refused where people change their height, and where rows in the upper left of all pictures place more
    cameras, or fit far better, as those of smaller pictures. again: calibrates other rows; None = do not try that."""
    check_stature(found.trajectories)
    if again is None:
        return
    fits = [(len(found.cameras), -_median_rms(found), 1)]
    for factor in enlargements(rig, observations):
        tracks = {
            key: replace(track, pixels=factor * (track.pixels + 0.5) - 0.5)
            for key, track in observations.tracks.items()
        }
        with suppress(Refused):
            enlarged = again(replace(observations, tracks=tracks))
            fits.append((len(enlarged.cameras), -_median_rms(enlarged) / factor, factor))
    cameras, fit, factor = max(fits)
    if factor > 1 and (cameras > len(found.cameras) or -fit < _FAR_BETTER * _median_rms(found)):
        raise Refused(
            f"as those of pictures of 1/{factor} the size that rig.toml states, the rows place {cameras} cameras and "
            f"fit to {-fit:.2g} px; as given, {len(found.cameras)} cameras and {_median_rms(found):.2g} px: correct "
            "size and matrix, or scale u and v"
        )


def _median_rms(found: Calibration) -> float:
    """Residuals of the median camera [px]."""
    return float(np.median([camera.rms_px for camera in found.cameras.values()]))


def _between_settings(
    clocks: Mapping[str, SetClock], observations: Observations, again: Callable[[Observations], Calibration]
) -> Calibration | None:
    """The calibration from one side of these jumps of cameras' clocks; None without any, or if it places none."""
    if not clocks:
        return None
    try:
        found = again(between_settings(observations, clocks))
    except Refused:
        return None
    warnings = [clock.warning(name) for name, clock in clocks.items() if name in found.cameras]
    return replace(found, warnings=(*found.warnings, *warnings)) if warnings else None


def _from_one_side(
    moves: Mapping[str, Move], observations: Observations, again: Callable[[Observations], Calibration]
) -> Calibration:
    """The calibration from one side of a move of one of two cameras. Raises Refused where that says too little."""
    name, *others = moves
    warning = moves[name].warning(name, *others)
    try:
        found = again(without_moved(observations, moves))
    except Refused as refusal:
        refusal.reason = f"{warning}; {refusal.reason}"
        raise
    return replace(found, warnings=(*found.warnings, warning))


def _has_bodies(rig: Rig, observations: Observations) -> bool:
    """Whether observations are of the points of a rigid body."""
    from hub.calibration.rigid_body.views import body_labels

    return bool(body_labels(observations, rig.bodies))


def _diagonals(rig: Rig) -> tuple[tuple[str, str, float], ...]:
    """The diagonals of single tags as scale bars, where their size is known."""
    if not rig.bodies_metric:
        return ()
    corners = [list(body.items()) for body in rig.bodies.values()]
    return tuple((a, c, float(np.linalg.norm(at_a - at_c))) for (a, at_a), _, (c, at_c), _ in corners)


def with_known_intrinsics(rig: Rig, known: FixedCalibration) -> Rig:
    """The rig with the intrinsics and readouts of a given calibration, which may have been refined."""
    cameras = {
        name: replace(
            camera,
            intrinsics=known.cameras[name].intrinsics,
            focal_std=0.0,
            readout=known.cameras[name].readout or camera.readout,
        )
        if name in known.cameras
        else camera
        for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)
