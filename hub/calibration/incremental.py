"""Incremental calibration: new rows refine the last answer; only cameras that are not tied to it yet are searched.

A warm start of the estimator that `calibrate` uses: poses, clocks and lenses of the last answer are the initial values
of one bundle adjustment over all rows that are kept (asynchronous calibration paper, section A.6, without its search
over lags and without incremental reconstruction). The same rows give the same answer as from scratch, because the
adjustment converges to the same minimum; what it costs is linear in the rows.

A camera is tied while its rows fit the trajectory that the others give. The older rows of one that was moved
(`moved_cameras`) are dropped, and it is located again by resection, at the clock that it had.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from hub.bundle import clock_steps
from hub.bundle.initialisation import (
    Reconstruction,
    place_cameras,
    triangulate_and_adjust,
)
from hub.bundle.preprocessing import PreparedSession, prepare
from hub.bundle.problem import LARGE_NETWORK, CameraState, ClockStep, FreeParameters
from hub.bundle.residuals import residual_norms
from hub.calibration.acceptance import larger_residuals, misfits, network_failure
from hub.calibration.final_adjustment import MAX_CLOCK_STEPS, bic_prefers, deviances, final_adjustment
from hub.calibration.pairs.moved_pair import LEAST_SIDE_S, PairDivision, find_division, time_map_between
from hub.calibration.pairs.pair_network import describe_failures, expected_lag, solve_new_pairs
from hub.calibration.pipeline import calibrate, heads_of_people
from hub.calibration.resection.moved_cameras import Division, Move, moved_camera, without_moved
from hub.calibration.resection.scan import other_image, scan_resection
from hub.calibration.result import assemble_calibration
from hub.calibration.self_calibration import focal_prior, initial_self_calibration, with_cameras, with_lens
from hub.calibration.solvers import Solution
from hub.clocks.clock_graph import ClockGraph, TimeMapEstimate
from hub.clocks.external_prior import ExternalClockPrior
from hub.clocks.step_correction import (
    Step,
    on_newest_clock,
    on_newest_side,
    shown_since,
    steps_inside,
    with_clock_set,
    with_step,
    with_step_stds,
)
from hub.sync.hypothesis import PairSolution, evidence
from protocols.core.acceptance import PrecisionTest
from protocols.core.clocks import CameraTime, TimeMap
from protocols.core.errors import Refused
from protocols.geometry.pose import Pose
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_WAITS = "waits for the next search of its lag"
_BETTER_KNOWN = 0.7  # a clock step is refined where its std falls below this share: twice the rows
_MOVE_SHOWN_S, _WORSE = 10.0, 1.4
"""Time [s] by which a move of one of two cameras is distinguished from a step of a clock; and residuals after a step,
over those before, that are no step's: of 17 simulated steps they were at most 1.3, after a move 1.5 to 1.7."""


_Start: TypeAlias = tuple[
    Observations, Calibration, tuple[PreparedSession, Reconstruction], dict[str, tuple[Step, ...]]
]


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """An answer, and cameras that were moved: by name, camera time [s] from which on the new pose holds.

    observations: of unlabelled people who were followed for it, in place of those that were given.
    """

    calibration: Calibration
    moved: dict[str, float] = field(default_factory=dict)
    observations: Observations | None = None


def update_calibration(
    rig: Rig,
    observations: Observations,
    last: Calibration | None,
    *,
    search: bool = True,
    full: bool = True,
    clock_priors: Mapping[str, ExternalClockPrior] | None = None,
    arrivals: Mapping[str, ExternalClockPrior] | None = None,
    refine_lenses: bool = False,
) -> Update:
    """The calibration from all given rows, starting from the last one.

    last: the answer before, of which cameras with another clock or pose have been removed; None = from scratch.
    search: whether cameras that are not tied are searched. full: whether it is searched over all lags, and whether
    lenses and readouts are tried again. clock_priors: by camera; bounds for lags that the images leave ambiguous.
    arrivals: the same by times of arrival at the hub. refine_lenses: whether measured lenses may change.
    Raises Refused where fewer than two cameras can be placed.
    """
    if last is None or sum(name in last.cameras for name in observations.cameras) < 2:
        found = _from_scratch(rig, observations, full, clock_priors, arrivals, refine_lenses)
        return Update(found if last is None else _in_published_clock(found, last), {})
    observations = heads_of_people(rig, observations)
    if last.reference in rig.cameras:
        rig = replace(rig, metadata={**rig.metadata, "reference": last.reference})
    if since := _since_a_move_of_two(rig, observations, last, full):
        again = partial(update_calibration, rig, search=search, full=full, refine_lenses=refine_lenses)
        return _from_newest_side(*since, partial(again, clock_priors=clock_priors, arrivals=arrivals))
    start, move = _start_and_move(rig, observations, last, full)
    observations, last, (prepared, reconstruction), steps = start
    origins = prepared.time_origins
    moved = {} if move is None else {move[0]: move[1].times[-1] / prepared.time_scale(move[0]) + origins[move[0]]}
    if moved:
        observations = _without_older_rows(observations, moved)
        prepared = _with_estimated_lenses(rig, prepare(rig, observations), last)
    placed = {
        name: state
        for name, state in zip(reconstruction.names, reconstruction.state.cameras, strict=True)
        if name not in moved
    }
    if len(placed) < 2:
        raise Refused("fewer than two cameras stand where they stood", dict.fromkeys(moved, "was moved"))
    pairs: list[PairSolution] = []
    reasons: dict[str, str] = {}
    new = [name for name in (*prepared.cameras, *prepared.uncalibrated) if name not in placed and name not in moved]
    clocks = {name: _clock_of(state) for name, state in placed.items()}
    for name in moved:
        if name in prepared.cameras:  # its times count from another row now
            later = prepared.time_scale(name) * (prepared.time_origins[name] - origins[name])
            clock = _clock_of(_state_of(reconstruction, name))
            clocks[name] = replace(clock, centre=clock.centre - later)
    if new and search:
        reconstruction = _warm_start(prepared, placed) if moved else reconstruction
        for name in (one for one in new if one in prepared.cameras):
            reasons[name] = "no common clock bounds its lag yet"
            expected = _expected_clock(prepared, name, reconstruction, {**(arrivals or {}), **(clock_priors or {})})
            if expected is not None:
                found_clock, reasons[name] = scan_resection(prepared.cameras[name], reconstruction, *expected)
                clocks |= {} if found_clock is None else {name: found_clock}
        unknown = [name for name in new if name not in clocks]
        if full and unknown:
            prepared, pairs = solve_new_pairs(prepared, unknown, list(placed), clock_priors)
            prepared, pairs = initial_self_calibration(rig, prepared, pairs)
            found_clocks = _clocks_from_pairs(pairs, placed, prepared)
            clocks |= {name: clock for name, clock in found_clocks.items() if name in prepared.cameras}
            reasons |= {name: describe_failures(name, pairs) for name in unknown if name not in clocks}
    refused = dict(prepared.refused)
    reasons = {
        name: reasons.get(name) or refused.get(name) or _waits(last.refused.get(name, ""))
        for name in new
        if name not in clocks
    }
    if len(clocks) > len(placed) or moved:
        reconstruction, unplaced = place_cameras(
            prepared.cameras,
            ClockGraph(clocks, tuple(pair for pair in pairs if pair.solved), ()),
            prepared.rows,
            prepared.labels,
            placed,
            _free_parameters(prepared),
        )
        reasons |= unplaced
    # Else rows that the last answer explained no longer fit, or one has joined whose lens was not tested yet.
    near = not larger_residuals(reconstruction, last.cameras) and set(reconstruction.names) <= last.cameras.keys()
    reconstruction, failures, misfitting = _adjust_without_failures(
        prepared, reconstruction, refused | reasons, warm=not full and near, refine_lenses=refine_lenses
    )
    failures |= _other_images(prepared, reconstruction, new if search else [])
    larger = larger_residuals(reconstruction, last.cameras)
    if larger and len(reconstruction.names) == 2:  # each hides in the other's path, as far as this can follow
        texts = {name: f"residuals of {sigma:.1f} px, {rms:.1f} px before" for name, (sigma, rms) in larger.items()}
        listed = "; ".join(f"{name}: {text}" for name, text in texts.items())
        raise Refused(f"the rows contradict the calibration ({listed}): a camera was moved, or its clock set", texts)
    reasons, refuted = reasons | failures, {*moved, *misfitting}
    joint = tuple(pair for pair in pairs if pair.solved) + _tied_pairs(reconstruction.names, pairs)
    solution = Solution(
        reconstruction,
        joint,
        {name: (refused | reasons)[name] for name in prepared.camera_order if name in refused | reasons},
        prepared,
        "joint",
    )
    found = _with_steps(on_newest_side(assemble_calibration(rig, solution, last)), steps)
    found = _in_published_clock(found, last)
    # Cameras of which the present rows say too little stay as they were: world and clock are the same.
    kept = {name: camera for name, camera in last.cameras.items() if name not in found.cameras and name not in refuted}
    refused = {name: reason for name, reason in found.refused.items() if name not in kept}
    return Update(replace(found, cameras=found.cameras | kept, refused=refused), moved)


def _from_scratch(
    rig: Rig,
    observations: Observations,
    full: bool,
    clock_priors: Mapping[str, ExternalClockPrior] | None,
    arrivals: Mapping[str, ExternalClockPrior] | None,
    refine_lenses: bool,
) -> Calibration:
    """The calibration of cameras of which nothing is known; of people whose feet it takes to begin, by their heads."""
    found = calibrate(
        rig,
        observations,
        clock_priors=clock_priors,
        arrivals=None if full and len(rig.cameras) <= LARGE_NETWORK else arrivals,
        online=True,
        refine_lenses=refine_lenses,
    )
    found, heads = with_step_stds(on_newest_side(found)), heads_of_people(rig, observations)
    if heads is observations or {table.label for table in found.trajectories} <= set(heads.labels):
        return found
    with suppress(Refused):
        return update_calibration(rig, heads, found, search=False, full=False).calibration
    return found


def _other_images(prepared: PreparedSession, reconstruction: Reconstruction, new: list[str]) -> dict[str, str]:
    """Of the cameras that were not placed, what their images would have to be to fit, where they would."""
    left = [name for name in new if name in prepared.cameras and name not in reconstruction.names]
    return {name: reason for name in left if (reason := other_image(prepared.cameras[name], reconstruction))}


def _waits(before: str) -> str:
    """Why a camera is not calibrated between two searches of its lag: also why it was not before."""
    found_none = before.removeprefix(_WAITS).removeprefix("; before: ")
    return f"{_WAITS}; before: {found_none}" if found_none else _WAITS


def _from_newest_side(
    moves: dict[str, Move], rest: Observations, start: Calibration, again: Callable[[Observations, Calibration], Update]
) -> Update:
    """The update from the rows since a move of one of two cameras. Raises Refused where they say too little yet."""
    name, *others = moves
    warning = moves[name].warning(name, *others)
    try:
        update = again(rest, start)
    except Refused as refusal:
        raise Refused(f"{warning}; {refusal.reason}", dict.fromkeys(moves, "one of two cameras was moved")) from refusal
    found = replace(update.calibration, warnings=(*update.calibration.warnings, warning))
    return Update(found, {name: move.times[-1] for name, move in moves.items()} | update.moved)


def _since_a_move_of_two(
    rig: Rig, observations: Observations, last: Calibration, full: bool
) -> tuple[dict[str, Move], Observations, Calibration] | None:
    """The move of one of two cameras, as of either, the rows since then, and the answer to start from; None without.

    A known clock step may be what was found of the move, so it is also looked for on the clocks as they were read.
    """
    names = [name for name in rig.cameras if name in last.cameras and name in observations.cameras]
    known = steps_inside(last, observations)
    if len(names) != 2 or rig.shared_clock:
        return None
    tried = {True: (known, last)}
    if known:
        as_read = last
        for name, found in known.items():
            as_read = with_clock_set(as_read, name, -sum(size for _, size, _ in found))
        tried[False] = {}, as_read
    for steps, then in tried.values():
        prepared = _with_estimated_lenses(rig, prepare(rig, on_newest_clock(observations, steps)), last)
        if not set(names) <= prepared.cameras.keys():
            return None
        states = _initial_states(prepared, then, names, measured_lenses=full)
        a, b = (prepared.cameras[name] for name in names)
        division = find_division(a, b, time_map_between(*states.values()))
        if division is not None:
            moves = division.moves(prepared, names, observations, keeps_later=True)
            rest = without_moved(observations, moves)
            return moves, rest, _after_move(prepared, then, names, division)
    return None


def _after_move(prepared: PreparedSession, last: Calibration, names: list[str], division: PairDivision) -> Calibration:
    """The answer before with the relative pose and the lag of the rows after a move of one of two cameras.

    The first camera and the baseline's length stay, as nothing shows which camera was moved.
    """
    one, other = (last.cameras[name] for name in names)
    relative, a = division.poses[1], one.pose
    rotation = relative.rotation @ a.rotation
    baseline = float(np.linalg.norm(other.pose.position - a.position))
    pose = Pose(rotation, a.position - baseline * rotation.T @ relative.direction)
    shown_a, shown_b = (
        CameraTime(at / prepared.time_scale(name) + prepared.time_origins[name])
        for name, at in zip(names, division.times, strict=True)
    )
    rate = other.time_map.clock_rate
    offset = float(one.time_map.reference_from_camera(shown_a)) - rate * float(shown_b)
    moved = replace(other, pose=pose, time_map=TimeMap(rate, offset), clock_steps=())
    cameras = {**last.cameras, names[0]: replace(one, clock_steps=()), names[1]: moved}
    return replace(last, cameras=cameras, trajectories=())


def _start_and_move(
    rig: Rig, observations: Observations, last: Calibration, full: bool
) -> tuple[_Start, tuple[str, Division] | None]:
    """As `_with_clock_steps`, and the camera that was moved since, as `moved_camera` gives it.

    A step explains a part of a move, while of what a step leaves two poses explain nothing: of both it is a move.
    """
    start = _with_clock_steps(rig, observations, last, full)
    move, steps = moved_camera(*start[2]), start[3]
    if any(camera.clock_steps != steps.get(name, ()) for name, camera in last.cameras.items()):
        before = _with_clock_steps(rig, observations, last, full, further=False)
        moved_before = moved_camera(*before[2])
        if move is not None or moved_before is not None:
            return before, moved_before
    return start, move


def _with_clock_steps(
    rig: Rig, observations: Observations, last: Calibration, full: bool, further: bool = True
) -> _Start:
    """Observations on the newest side of all clock steps, the last answer on it, the start from both, and the steps.

    Steps that are known are corrected; ``further`` ones are, where they explain the rows better. Raises Refused while
    one of two cameras may have been moved instead.
    """
    steps = steps_inside(last, observations)

    def start(steps: dict[str, tuple[Step, ...]], last: Calibration) -> tuple[PreparedSession, Reconstruction]:
        prepared = _with_estimated_lenses(rig, prepare(rig, on_newest_clock(observations, steps)), last)
        tied = [name for name in prepared.cameras if name in last.cameras]
        return prepared, _warm_start(prepared, _initial_states(prepared, last, tied, measured_lenses=full))

    prepared, reconstruction = start(steps, last)
    for _ in range(MAX_CLOCK_STEPS + 1 if further else 0):
        found = _clock_step(steps, prepared, reconstruction)
        if found is None:
            break
        name, step = found
        newest = max(float(track.time[-1]) for track in observations.of_camera(name))
        if len(reconstruction.names) == 2 and newest - step[0] < LEAST_SIDE_S:
            break  # a move of one of two cameras would look alike yet
        trial_steps, trial_last = with_step(steps, name, step), with_clock_set(last, name, step[1])
        trial = start(trial_steps, trial_last)
        is_recent = len(reconstruction.names) == 2 and newest - step[0] < _MOVE_SHOWN_S
        if is_recent and _fits_worse_since(shown_since(trial_steps, name, step), name, *trial):
            text = f"the rows contradict the calibration since {name}'s time {step[0]:.1f} s"
            raise Refused(f"{text}: a camera was moved, or its clock set", dict.fromkeys(reconstruction.names, text))
        supported = _supported_steps(trial_steps, *trial) if trial[1].names == reconstruction.names else None
        # Of two points with one label a step explains the few rows of the second; the others, rejected, do not speak.
        if supported is None or not _explain_more(supported, trial[1], steps, reconstruction):
            break
        steps, last, (prepared, reconstruction) = supported, trial_last, trial
    return on_newest_clock(observations, steps), last, (prepared, reconstruction), steps


def _fits_worse_since(time: float, name: str, prepared: PreparedSession, found: Reconstruction) -> bool:
    """Whether rows since a camera's time [s], of a clock step that is corrected, are above the noise of those before.

    A step explains a part of a move of one of two cameras, until there are the rows to tell that from a step.
    """
    state, ratios = found.state, []
    at = _state_of(found, name).reference_time(
        np.array([prepared.time_scale(name) * (time - prepared.time_origins[name])])
    )
    for number, camera in enumerate(state.cameras):
        rows = found.problem.of_camera(number)
        norms = np.concatenate([residual_norms(part, camera, state.trajectories[part.label]) for part in rows])
        is_since = np.concatenate([camera.reference_time(part.time) for part in rows]) >= at
        ratios.append(norms[is_since] / np.nanmedian(norms[~is_since]))
    return bool(np.nanmedian(np.concatenate(ratios)) > _WORSE)


def _explain_more(
    steps: Mapping[str, tuple[Step, ...]],
    found: Reconstruction,
    known: Mapping[str, tuple[Step, ...]],
    old: Reconstruction,
) -> bool:
    """Whether all rows, also rejected ones, fit better with ``steps`` than with those ``known``, and those of the
    cameras that step by themselves."""
    gain = deviances(old.problem, old.state) - deviances(found.problem, found.state)
    own = sum(gain[i] for i, name in enumerate(found.names) if steps.get(name) != known.get(name))
    parameters = 2 * (sum(map(len, steps.values())) - sum(map(len, known.values())))
    return own > 0.0 and bic_prefers(found.problem, found.state, old.problem, old.state, parameters)


def _clock_step(
    steps: Mapping[str, tuple[Step, ...]], prepared: PreparedSession, reconstruction: Reconstruction
) -> tuple[str, Step] | None:
    """A camera's clock step that its rows show, on the corrected clock.

    First one that is not known; then what is left of a known one, where that is more than its std.
    """
    found = clock_steps.find_clock_step(reconstruction.problem, reconstruction.state)
    if found is None:
        for scale, step, left in _remaining_steps(steps, prepared, reconstruction):
            more = abs(left.size) > left.std or left.std < _BETTER_KNOWN * scale * step[2]
            if more and abs(scale * step[1] + left.size) <= clock_steps.MAX_STEP_S:
                found = left
    if found is None:
        return None
    name = reconstruction.names[found.camera]
    scale = prepared.time_scale(name)
    return name, (found.time / scale + prepared.time_origins[name], found.size / scale, found.std / scale)


def _remaining_steps(
    steps: Mapping[str, tuple[Step, ...]], prepared: PreparedSession, reconstruction: Reconstruction
) -> Iterator[tuple[float, Step, ClockStep]]:
    """(time scale, step, what the rows add to it) of each corrected step."""
    for number, name in enumerate(reconstruction.names):
        scale, origin = prepared.time_scale(name), prepared.time_origins[name]
        for step in steps.get(name, ()):
            at = scale * (shown_since(steps, name, step) - origin)
            yield scale, step, clock_steps.remaining_step(reconstruction.problem, reconstruction.state, number, at)


def _supported_steps(
    steps: Mapping[str, tuple[Step, ...]], prepared: PreparedSession, reconstruction: Reconstruction
) -> dict[str, tuple[Step, ...]] | None:
    """The steps, each with a std, if all are as large as a step has to be in the adjustment to the corrected rows."""
    stds = dict[tuple[str, float], float]()
    for scale, step, left in _remaining_steps(steps, prepared, reconstruction):
        whole = replace(left, size=scale * step[1] + left.size)
        if not clock_steps.is_step_supported(reconstruction.problem, whole):
            return None
        stds[reconstruction.names[left.camera], step[0]] = left.std / scale
    return {
        name: tuple((at, size, std if np.isfinite(std) else stds[name, at]) for at, size, std in known)
        for name, known in steps.items()
    }


def _with_steps(found: Calibration, steps: Mapping[str, tuple[Step, ...]]) -> Calibration:
    """The calibration with the steps that were corrected before it was adjusted."""
    cameras = {
        name: replace(camera, clock_steps=(*steps.get(name, ()), *camera.clock_steps))
        for name, camera in found.cameras.items()
    }
    return with_step_stds(replace(found, cameras=cameras) if steps else found)


def _adjust_without_failures(
    prepared: PreparedSession,
    reconstruction: Reconstruction,
    refused: Mapping[str, str],
    *,
    warm: bool,
    refine_lenses: bool,
) -> tuple[Reconstruction, dict[str, str], set[str]]:
    """The adjusted network without cameras that fail, their reasons, and which of them the rows refute.

    refused: reasons so far. Raises Refused where fewer than two cameras are left.
    """
    reasons, refuted = dict[str, str](), set[str]()
    while True:
        reconstruction = final_adjustment(
            reconstruction, lambda text, share: None, warm=warm, online=True, refine_lenses=refine_lenses
        )
        failure = next(iter(misfits(reconstruction)), None) or network_failure(reconstruction, (), {})
        if failure is None:
            return reconstruction, reasons, refuted
        worst, reason = failure[0], failure[1].reason
        reasons[worst] = reason
        if not isinstance(failure[1], PrecisionTest):
            refuted.add(worst)
        remaining = dict(zip(reconstruction.names, reconstruction.state.cameras, strict=True))
        del remaining[worst]
        if len(remaining) < 2:
            raise Refused(f"no two cameras can be placed ({worst}: {reason})", {**refused, **reasons})
        reconstruction = _warm_start(prepared, remaining)


def _free_parameters(prepared: PreparedSession) -> FreeParameters:
    return FreeParameters(clock=not prepared.shared_clock)


def _initial_states(
    prepared: PreparedSession, last: Calibration, names: list[str], measured_lenses: bool
) -> dict[str, CameraState]:
    """The last answer as states on an internal time: the published reference time since the first row.

    measured_lenses: whether to start from the measured lenses, so that whether to estimate them is
    decided as from scratch: with a refined lens that absorbed it once, an error would confirm itself.
    """
    maps = {name: last.cameras[name].time_map for name in names}
    start = min(float(maps[n].reference_from_camera(CameraTime(prepared.time_origins[n]))) for n in names)
    out = {}
    for name in names:
        centre = _centre(prepared, name)
        camera_time = CameraTime(centre / prepared.time_scale(name) + prepared.time_origins[name])
        offset = float(maps[name].reference_from_camera(camera_time)) - start
        camera = last.cameras[name]
        given = prepared.cameras[name]
        lens = given.intrinsics if measured_lenses and given.lens_prior is None else camera.intrinsics
        out[name] = CameraState(lens, camera.pose, maps[name].clock_rate, offset, centre)
    return out


def _centre(prepared: PreparedSession, name: str) -> float:
    """Middle of a camera's span [s] since its origin."""
    times = [part.time for part in prepared.rows[name]]
    return 0.5 * (min(float(time.min()) for time in times) + max(float(time.max()) for time in times))


def _with_estimated_lenses(rig: Rig, prepared: PreparedSession, last: Calibration) -> PreparedSession:
    """The session with the lenses that the last answer estimated for cameras without measured intrinsics."""
    names = [n for n in prepared.uncalibrated if n in last.cameras and last.cameras[n].focal_std > 0.0]
    if not names:
        return prepared
    lenses = {n: with_lens(prepared, n, last.cameras[n].intrinsics, focal_prior(rig, n)) for n in names}
    return with_cameras(prepared, lenses)


def _warm_start(prepared: PreparedSession, states: dict[str, CameraState]) -> Reconstruction:
    cameras = {name: camera for name, camera in prepared.cameras.items() if name in states}
    names = list(cameras)
    return triangulate_and_adjust(
        cameras, states, prepared.rows, prepared.labels, (names[0], names[1]), _free_parameters(prepared)
    )


def _state_of(reconstruction: Reconstruction, name: str) -> CameraState:
    return reconstruction.state.cameras[reconstruction.names.index(name)]


def _clock_of(state: CameraState) -> TimeMapEstimate:
    return TimeMapEstimate(state.rate, state.offset, state.centre)


def _without_older_rows(observations: Observations, since: Mapping[str, float]) -> Observations:
    tracks = {}
    for key, track in observations.tracks.items():
        keep = track.time >= since.get(key[0], -np.inf)
        if keep.any():
            tracks[key] = track.select(keep)
    return replace(observations, tracks=tracks)


def _clocks_from_pairs(
    pairs: list[PairSolution], placed: Mapping[str, CameraState], prepared: PreparedSession
) -> dict[str, TimeMapEstimate]:
    """Time maps of new cameras from their best pair with a placed one."""
    out: dict[str, TimeMapEstimate] = {}
    best: dict[str, float] = {}
    for pair in pairs:
        fit = pair.fit
        if not pair.solved or fit is None:
            continue
        known, new = (pair.a, pair.b) if pair.a in placed else (pair.b, pair.a)
        if evidence(fit) <= best.get(new, 0.0):
            continue
        best[new] = evidence(fit)
        # t_a = rate t_b + offset
        rate, offset = (fit.rate, fit.offset) if new == pair.b else (1.0 / fit.rate, -fit.offset / fit.rate)
        state, centre = placed[known], _centre(prepared, new)
        out[new] = TimeMapEstimate(
            state.rate * rate, float(state.reference_time(np.array([rate * centre + offset]))[0]), centre
        )
    return out


def _expected_clock(
    prepared: PreparedSession,
    name: str,
    reconstruction: Reconstruction,
    common: Mapping[str, ExternalClockPrior],
) -> tuple[TimeMapEstimate, float] | None:
    """A new camera's time map by a clock that it has in common with a placed one, and its error bound [s]."""
    found = []
    for other, state in zip(reconstruction.names, reconstruction.state.cameras, strict=True):
        expected = expected_lag(prepared, other, name, common)
        if expected is not None:
            lag, window = expected
            centre = _centre(prepared, name)
            offset = float(state.reference_time(np.array([centre + lag]))[0])
            found.append((window, offset, TimeMapEstimate(state.rate, offset, centre)))
    if not found:
        return None
    window, _, estimate = min(found, key=lambda one: one[:2])
    return estimate, window


def _tied_pairs(names: list[str], pairs: list[PairSolution]) -> tuple[PairSolution, ...]:
    """Pairs that needed no search: both cameras are in the joint solution."""
    searched = {(pair.a, pair.b) for pair in pairs if pair.solved}
    return tuple(
        PairSolution(a, b, "ok") for i, a in enumerate(names) for b in names[i + 1 :] if (a, b) not in searched
    )


def _in_published_clock(found: Calibration, last: Calibration) -> Calibration:
    """The answer on the published reference clock: its camera may be gone, or its clock may have been set since."""
    if found.reference not in last.cameras:
        return found
    base = last.cameras[found.reference].time_map
    if base == TimeMap(clock_rate=1.0, time_offset=0.0):
        return found
    cameras = {
        name: replace(
            camera,
            time_map=TimeMap(
                clock_rate=base.clock_rate * camera.time_map.clock_rate,
                time_offset=base.clock_rate * camera.time_map.time_offset + base.time_offset,
            ),
        )
        for name, camera in found.cameras.items()
    }
    trajectories = tuple(
        replace(table, time=base.clock_rate * table.time + base.time_offset) for table in found.trajectories
    )
    return replace(found, cameras=cameras, trajectories=trajectories, reference=last.reference)
