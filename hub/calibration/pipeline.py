"""The whole line of the hub: tracks → pairs → graph → poses → one adjustment → a published calibration.

No sockets, files or clocks: `calibrate` offline and the live hub run the same code.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from hub.baselines.session_lags import paper_pair
from hub.bundle import covariance as cov
from hub.bundle import rolling_shutter
from hub.bundle.adjustment import adjust, noise, residual_norms
from hub.bundle.correlated_noise import with_lasting_errors
from hub.bundle.noise_scale import together
from hub.bundle.problem import Freedom, Problem, State
from hub.bundle.timestamp_jitter import settle
from hub.calibration.clock_graph import ClockGraph, ClockGuess, average_clocks, components
from hub.calibration.initialisation import Scaffold, agreement, grow, place_known
from hub.calibration.pair_network import Progress, rate_warnings, solve_pairs, timing_told
from hub.calibration.preprocessing import NO_INTRINSICS, Prepared, prepare
from hub.calibration.result import focal_stds, lone_pair_report, publish
from hub.calibration.self_calibration import LARGEST_STD, refocused, self_calibrated
from hub.clocks.external_prior import Claim
from hub.sync.pair_solver import PairSolution
from hub.trajectory.image_tracks import smooth_only
from hub.trajectory.smoothness_prior import motion_prior
from hub.two_view.relative_pose import fundamental_from
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, Known
from protocols.session.observations import Observations
from protocols.session.rig import Rig

if TYPE_CHECKING:
    from hub.distributed.solver import PlacedByNodes

_LEAST_AGREEMENT = 0.5  # share of a camera's rows that must fit the common path
_LEAST_ROWS = 30
_LARGEST_TURN_STD = 0.05  # rad
_LARGEST_CLOCK_STD = 10e-3  # s: a frame is more than three of them
_FARTHEST_FROM_PAIR = 20e-3  # s
_APART = "the path tells its clock"
_LENS_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """An adjusted network in the internal gauge, before publication."""

    scaffold: Scaffold
    pairs: tuple[PairSolution, ...]
    refused: dict[str, str]
    prepared: Prepared
    solver: str
    warnings: tuple[str, ...] = field(default=())
    known: Known | None = None
    """Poses that were given and stay: then their world is the published one."""


def calibrate(
    rig: Rig,
    observations: Observations,
    progress: Progress | None = None,
    *,
    solver: str = "joint",
    known: Known | None = None,
    thorough: bool = False,
    seed: int = 0,
    claims: Mapping[str, Claim] | None = None,
) -> Calibration:
    """Timing and poses of all cameras from what they saw, with no guess.

    solver: "joint", or "paper" (the paper's alternating method: no adjustment, same frame rates, lags of
    a few frames). known: intrinsics and poses that are given; then only timing and paths are sought.
    thorough: whether cameras that nothing ties get a second, far dearer search: clock rates that a
    wrongly told frame rate makes (times made of frame numbers: a live camera's are not), and torn tracks.
    seed: of the samples by which pose nodes begin ("distributed"); the other solvers draw nothing at random.
    claims: what cameras' machines say of their clocks; asked only where the pictures leave lags open.
    Raises Refused, with a reason for every camera and what is known of pairs, where fewer than two can be placed.
    """
    tell = progress or (lambda text, share: None)
    if known is not None:
        rig = with_known_lenses(rig, known)
    prepared = prepare(rig, observations)
    by_sizes = False
    if solver == "paper" and known is None:
        from hub.baselines.session_poses import all_sized  # the other solvers are spared the nodes

        by_sizes = all_sized(prepared, observations)
    if by_sizes and prepared.shared_clock:
        pairs = []  # nothing to find
    elif solver == "paper" and known is None:
        pairs = paper_pairs(prepared, observations, tell)
    else:
        prepared, pairs = solve_pairs(prepared, tell, thorough=thorough, known=known, claims=claims)
        prepared = replace(
            prepared,
            refused=_with_timing(prepared, pairs),
            warnings=prepared.warnings + rate_warnings(prepared, pairs),
        )
    try:
        if known is not None:
            solution = solve_known(prepared, pairs, known, tell)
        elif solver == "paper":
            solution = solve_paper(prepared, pairs, tell, observations if by_sizes else None)
        elif solver == "distributed":
            from hub.distributed.solver import PlacedByNodes

            solution = solve_network(prepared, pairs, tell, PlacedByNodes(rig, prepared, observations, tell, seed))
        else:
            solution = solve_with_guesses(rig, prepared, pairs, tell)
        tell("covariances", 0.95)
        return publish(rig, solution)
    except Refused as refusal:
        apart = {name: reason for name, reason in refusal.cameras.items() if reason.startswith(_APART)}
        left = [replace(pair, status=apart[pair.b]) if pair.b in apart else pair for pair in pairs]
        refusal.pairs = tuple(lone_pair_report(pair, prepared) for pair in left)
        refusal.warnings = prepared.warnings
        raise


def with_known_lenses(rig: Rig, known: Known) -> Rig:
    """The rig with the intrinsics of a known calibration, which may have been refined since, and its readouts."""
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


def paper_pairs(prepared: Prepared, observations: Observations, tell: Progress) -> list[PairSolution]:
    """All pairs by the paper's method. Raises Refused for a shared clock, where there is no lag to find."""
    if prepared.shared_clock:
        raise Refused('the paper\'s method finds lags, and clock = "shared" says there are none', {})
    pairs = []
    todo = list(itertools.combinations(prepared.cameras, 2))
    for done, (a, b) in enumerate(todo):
        tell(f"pair {a}–{b}", 0.05 + 0.7 * done / max(len(todo), 1))
        first, second = prepared.cameras[a], prepared.cameras[b]
        pairs.append(
            paper_pair(
                (smooth_only(first.tracks), smooth_only(second.tracks)),
                (observations.by_label(a), observations.by_label(b)),
                (first.intrinsics, second.intrinsics),
                (a, b),
            )
        )
    return pairs


def solve_with_guesses(rig: Rig, prepared: Prepared, pairs: list[PairSolution], tell: Progress) -> Solution:
    """The network with the cameras whose lens nobody measured, as far as the common path tells their focal lengths.

    Where it does not, those cameras are refused with what is known of their timing, as if they had not been tried.
    """
    trial, seen = self_calibrated(rig, prepared, pairs)
    if trial is prepared:
        return solve_network(prepared, pairs, tell)
    tell("focal lengths", 0.58)
    try:
        for _ in range(_LENS_ROUNDS):
            solution = solve_network(trial, seen, tell)
            found = dict(zip(solution.scaffold.names, solution.scaffold.state.cameras, strict=True))
            trial, seen, changed = refocused(trial, seen, {name: one.intrinsics for name, one in found.items()})
            if not changed:
                break
    except Refused as refusal:
        told = {name: refusal.cameras.get(name, "") for name in trial.cameras if trial.cameras[name].guess is not None}
        return solve_network(replace(prepared, refused=_with_attempt(prepared, told)), pairs, tell)
    guessed = [name for name in trial.cameras if trial.cameras[name].guess is not None]
    left = {name: solution.refused[name] for name in guessed if name in solution.refused}
    refused = solution.refused | {
        name: reason for name, reason in _with_attempt(prepared, left).items() if name in left
    }
    # What is told of a refused camera's pairs is what they said before a lens was tried.
    lenses = {name: prepared.camera(name).intrinsics.matrix for name in prepared.names}
    before = {
        (pair.a, pair.b): replace(pair, fundamental=fundamental_from(pair.fit.geometry, lenses[pair.a], lenses[pair.b]))
        for pair in pairs
        if {pair.a, pair.b} & set(left) and pair.fit is not None and pair.solved
    }
    told_pairs = tuple(before.get((pair.a, pair.b), pair) for pair in solution.pairs)
    return replace(solution, refused=_ordered(refused, prepared), pairs=told_pairs)


def _with_attempt(prepared: Prepared, told: dict[str, str]) -> dict[str, str]:
    """Reasons of refused cameras, and why the path does not tell the lens of those that were tried."""
    return {
        name: f"{reason}; its lens could not be found from the path: {told[name]}" if told.get(name) else reason
        for name, reason in prepared.refused.items()
    }


def solve_network(
    prepared: Prepared, pairs: list[PairSolution], tell: Progress, nodes: PlacedByNodes | None = None
) -> Solution:
    """From pairs to one adjusted network; cameras that don't fit are refused by name.

    nodes: places the cameras of a graph; None = one after the other, then all in one adjustment.
    """
    refused = dict(prepared.refused)
    freedom = Freedom(clock=not prepared.shared_clock)
    graph = _connect(prepared, list(prepared.cameras), pairs, refused)
    held = replace(freedom, rate_std=_rate_std(graph, freedom.rate_std))
    while True:
        if nodes is not None:
            scaffold, unplaced = nodes(graph)
        else:
            scaffold, unplaced = grow(
                prepared.cameras, graph, prepared.rows, prepared.labels, lambda text: tell(text, 0.6), held
            )
            scaffold = _adjust_all(scaffold, tell)
            # What the rate was held by is no knowledge of it: stds are by what is known of clocks.
            free = replace(scaffold.problem.freedom, rate_std=freedom.rate_std)
            scaffold.problem = replace(scaffold.problem, freedom=free)
        refused |= unplaced
        bad = [name for name in scaffold.names if not _fits(scaffold, name)]
        # A lens that was guessed may be what is wrong with all the others.
        bad = [name for name in bad if prepared.cameras[name].guess is not None] or bad
        if bad:
            # The worst one goes, and what it may have spoilt is made again without it.
            worst = min(bad, key=lambda name: agreement(scaffold, name)[0])
            share, count = agreement(scaffold, worst)
            refused[worst] = f"only {100 * share:.0f} % of its {count} observations fit the path that the others see"
        else:
            worst, reason = _vaguest_lens(scaffold)
            if not reason:
                worst, reason = _loosest(scaffold)
            if not reason:
                worst, reason = _apart_from_pair(scaffold, graph)
            if not reason:
                break
            refused[worst] = reason
        remaining = [name for name in scaffold.names if name != worst]
        if len(remaining) < 2:
            raise Refused(f"no two cameras can be placed ({worst}: {refused[worst]})", refused)
        graph = _connect(prepared, remaining, list(graph.agreeing), refused)
    warnings = tuple(
        f"pair {pair.a}–{pair.b} contradicts the other pairs and was set aside" for pair in graph.contradicting
    )
    solver = "joint"
    if nodes is not None:
        solver, warnings = "distributed", warnings + nodes.warnings
    return Solution(scaffold, tuple(pairs), _ordered(refused, prepared), prepared, solver, warnings)


def _rate_std(graph: ClockGraph, usual: float) -> float:
    """Prior std of rates: narrow where two cameras have only each other and epipolar lines did not tell the rate.

    The path would not tell it either, and a rate thousands of ppm off carries the lag away with it.
    """
    told = [pair.fit.rate_std for pair in graph.agreeing if pair.fit is not None and np.isfinite(pair.fit.lag_doubt)]
    return min([usual, *told])


def _vaguest_lens(scaffold: Scaffold) -> tuple[str, str]:
    """The unmeasured camera whose focal length the path tells worst, and how badly; "" where all are told well."""
    stds = focal_stds(scaffold.problem, scaffold.state)
    worst = int(np.argmax(stds))
    if stds[worst] <= LARGEST_STD:
        return "", ""
    return scaffold.names[worst], f"the common motion tells its focal length only to {100 * stds[worst]:.1f} % (std)"


def _loosest(scaffold: Scaffold) -> tuple[str, str]:
    """The camera that is least tied to any other, and what is too uncertain about it; "" for nothing."""
    problem, state = scaffold.problem, scaffold.state
    found = cov.covariance(problem, state, motion_prior(problem, state))
    turns = cov.turn_stds(found.cameras, state)
    clocks = np.zeros_like(turns)
    if problem.freedom.clock:
        clocks = cov.common_clock_stds(found, problem, state)
    for between, limit, unit, text in (
        (turns, _LARGEST_TURN_STD, np.rad2deg(1.0), "the common motion tells its orientation only to {:.1f}° (std)"),
        (clocks, _LARGEST_CLOCK_STD, 1e3, "the common motion tells its clock only to {:.1f} ms (std, mid-overlap)"),
    ):
        np.fill_diagonal(between, np.inf)
        best = between.min(axis=1)
        # Of two that are alike, the later one: the first camera is most often the reference.
        loosest = int(len(best) - 1 - np.argmax(best[::-1]))
        if best[loosest] > limit:
            return scaffold.names[loosest], text.format(unit * best[loosest])
    return "", ""


def _apart_from_pair(scaffold: Scaffold, graph: ClockGraph) -> tuple[str, str]:
    """The later camera of a pair by itself whose lag the adjustment did not leave where it was, and by how much.

    Epipolar lines and the path are two ways to the lag that lean on other things: where they differ, one of them is
    wrong. Of three cameras and more a pair's lag is a beginning only.
    """
    for pair in graph.agreeing:
        if pair.fit is None or not np.isfinite(pair.fit.lag_doubt):
            continue
        a, b = (scaffold.state.cameras[scaffold.names.index(name)] for name in (pair.a, pair.b))
        at_a = np.array([pair.fit.middle])
        at_b = (at_a - pair.fit.offset) / pair.fit.rate
        apart = float(abs(a.reference_time(at_a) - b.reference_time(at_b))[0])
        if apart > _FARTHEST_FROM_PAIR:
            return pair.b, f"{_APART} {1e3 * apart:.0f} ms apart from what epipolar lines tell"
    return "", ""


def solve_paper(
    prepared: Prepared, pairs: list[PairSolution], tell: Progress, sized: Observations | None = None
) -> Solution:
    """Network from the paper's pairs: clocks averaged, nothing adjusted.

    Poses by resection, or, where all rows tell sizes (``sized``), by the paper's distributed method.
    """
    refused = dict(prepared.refused)
    if pairs or sized is None:
        graph = _connect(prepared, list(prepared.cameras), pairs, refused)
    else:
        graph = ClockGraph({name: ClockGuess(1.0, 0.0, 0.0) for name in prepared.cameras}, (), ())
    tell("placing", 0.8)
    if sized is None:
        scaffold, unplaced = grow(prepared.cameras, graph, prepared.rows, prepared.labels, freedom=None)
    else:
        from hub.baselines.session_poses import place_by_paper

        scaffold, unplaced = place_by_paper(prepared, sized, graph)
    if prepared.shared_clock:
        freedom = replace(scaffold.problem.freedom, clock=False)
        scaffold.problem = replace(scaffold.problem, freedom=freedom)
    scaffold.state = replace(scaffold.state, sigma=noise(scaffold.problem, scaffold.state))
    warning = "the paper's method adjusts nothing: its stds count independent noise only and are too small"
    return Solution(scaffold, tuple(pairs), _ordered(refused | unplaced, prepared), prepared, "paper", (warning,))


def solve_known(prepared: Prepared, pairs: list[PairSolution], known: Known, tell: Progress) -> Solution:
    """Only clocks and paths: intrinsics and poses are given and stay as they are."""
    refused = dict(prepared.refused)
    for name in [name for name in prepared.cameras if name not in known.cameras]:
        refused[name] = "not in the known calibration"
    cameras = {name: camera for name, camera in prepared.cameras.items() if name in known.cameras}
    inside = replace(prepared, cameras=cameras)
    graph = _connect(inside, list(cameras), pairs, refused)
    tell("adjusting", 0.75)
    poses = {name: known.cameras[name].pose for name in graph.clocks}
    scaffold = place_known(cameras, graph, prepared.rows, prepared.labels, poses, not prepared.shared_clock)
    problem, state, _ = adjust(scaffold.problem, scaffold.state)
    solution = replace_solution(scaffold, *settle(problem, state))
    return Solution(solution, tuple(pairs), _ordered(refused, prepared), inside, "joint", known=known)


def _connect(prepared: Prepared, names: list[str], pairs: list[PairSolution], refused: dict[str, str]) -> ClockGraph:
    """The largest group of ``names`` that solved pairs tie together; the others are entered in ``refused``.

    Raises Refused, with every camera's reason, where no pair is solved.
    """
    placeable = [pair for pair in pairs if pair.a in prepared.cameras and pair.b in prepared.cameras]
    solved = [pair for pair in placeable if pair.solved and pair.a in names and pair.b in names]
    if not solved:
        reasons = refused | {name: _why_unplaced(name, prepared, pairs) for name in names}
        raise Refused(_why_nothing(prepared, placeable, refused), _ordered(reasons, prepared))
    groups = components(names, solved)
    for name in [name for name in names if name not in groups[0]]:
        refused[name] = _why_alone(name, groups, pairs)
    inside = [pair for pair in solved if pair.a in groups[0] and pair.b in groups[0]]
    if prepared.shared_clock:
        return ClockGraph({name: ClockGuess(1.0, 0.0, 0.0) for name in groups[0]}, tuple(inside), ())
    return average_clocks(groups[0], inside, {name: prepared.cameras[name].tracks for name in groups[0]})


def _with_timing(prepared: Prepared, pairs: list[PairSolution]) -> dict[str, str]:
    """Reasons of the refused, where cameras without intrinsics say what is known of their clocks."""
    refused = dict(prepared.refused)
    for name in prepared.lensless:
        told = timing_told(name, prepared, pairs)
        refused[name] = (
            f"no intrinsics: only its timing is known (pairs in result.json: {told}); run `syncline intrinsics`"
            if told
            else f"{NO_INTRINSICS}; nor is its timing known ({_tried(name, pairs) or 'no other camera'})"
        )
    return refused


def _ordered(refused: dict[str, str], prepared: Prepared) -> dict[str, str]:
    """Reasons in the rig's order."""
    return {name: refused[name] for name in prepared.order if name in refused}


def _fits(scaffold: Scaffold, name: str) -> bool:
    share, count = agreement(scaffold, name)
    return share >= _LEAST_AGREEMENT and count >= _LEAST_ROWS


def _adjust_all(scaffold: Scaffold, tell: Progress) -> Scaffold:
    """The final adjustment, with the lens freed where the data clearly ask for it."""
    tell("adjusting", 0.75)
    problem, state, _ = adjust(scaffold.problem, scaffold.state, progress=lambda text: tell(text, 0.75))
    problem, state = settle(problem, state, lambda text: tell(text, 0.8))
    tell("adjusting the lenses", 0.85)
    freed = replace(problem, freedom=replace(problem.freedom, lens=True))
    freed_problem, freed_state, _ = adjust(freed, state, rounds=2, progress=lambda text: tell(text, 0.85))
    if _prefers(freed_problem, freed_state, problem, state):
        problem, state = freed_problem, freed_state
    if problem.freedom.clock and rolling_shutter.worth_freeing(problem, state, motion_prior(problem, state)):
        tell("adjusting the readouts", 0.9)
        read_problem, read_state, _ = adjust(rolling_shutter.freed(problem), state, rounds=2)
        if rolling_shutter.plausible(read_state) and _prefers(read_problem, read_state, problem, state, 1):
            problem, state = read_problem, read_state
    tell("errors that last", 0.92)
    problem, state = with_lasting_errors(problem, state)
    return replace_solution(scaffold, problem, state)


def replace_solution(scaffold: Scaffold, problem: Problem, state: State) -> Scaffold:
    """The scaffold with another problem and state."""
    return Scaffold(scaffold.names, scaffold.labels, problem, state)


def _prefers(freed: Problem, freed_state: State, fixed: Problem, fixed_state: State, each: int = 2) -> bool:
    """Whether ``each`` parameters a camera (focal length and k1) are worth it (Bayesian information criterion).

    The robust likelihood of all rows under each answer's own noise decides; rows that err alike count as one.
    """
    cameras = range(len(fixed_state.cameras))
    alike = np.array([together(freed, freed_state, camera) for camera in cameras])
    rows = sum(len(part.time) / alike[part.camera] for part in fixed.rows)
    gain = float(((_deviances(fixed, fixed_state) - _deviances(freed, freed_state)) / alike).sum())
    return bool(gain > each * len(cameras) * np.log(max(rows, 2)))


def _deviances(problem: Problem, state: State) -> Floats:
    """(cameras,) twice the negative logarithm of the likelihood of each camera's rows."""
    total = np.zeros(len(state.cameras))
    for part in problem.rows:
        norms = residual_norms(part, state.cameras[part.camera], state.trajectories[part.label])
        norms = norms[np.isfinite(norms)]
        sigma = float(state.sigma[part.camera])
        total[part.camera] += float(np.minimum((norms / sigma) ** 2, 25.0).sum()) + 4.0 * len(norms) * np.log(sigma)
    return total


def _why_nothing(prepared: Prepared, pairs: list[PairSolution], refused: dict[str, str]) -> str:
    if not pairs:
        short = refused | dict.fromkeys(prepared.lensless, "no intrinsics")
        told = "; ".join(f"{name}: {reason}" for name, reason in short.items())
        remedy = (
            "; tell their lenses: `syncline intrinsics` with a board, --model or --field-of-view"
            if prepared.lensless
            else "; film the marker with two cameras or more at the same time"
        )
        return f"fewer than two cameras can be placed ({told}){remedy}" if told else "one camera only: a pair is needed"
    told = "; ".join(f"{pair.a}–{pair.b}: {pair.status}" for pair in pairs[:6])
    return f"no pair of cameras could be tied together ({told})"


def _why_unplaced(name: str, prepared: Prepared, pairs: list[PairSolution]) -> str:
    """Why a camera with intrinsics that is tied to none other with them has no place."""
    told = timing_told(name, prepared, pairs)
    if told:
        return f"only its timing is known (pairs in result.json: {told}): tied to no other camera with intrinsics"
    return _tried(name, pairs) or "no other camera to compare with"


def _tried(name: str, pairs: list[PairSolution]) -> str:
    return "; ".join(
        f"with {p.b if p.a == name else p.a}: {p.status}" for p in pairs if name in (p.a, p.b) and not p.solved
    )


def _why_alone(name: str, groups: list[list[str]], pairs: list[PairSolution]) -> str:
    mine = next(group for group in groups if name in group)
    tried = _tried(name, pairs)
    if len(mine) > 1:
        return f"tied only to {', '.join(other for other in mine if other != name)}, not to the rest ({tried})"
    return f"could not be tied to any camera ({tried})"


__all__ = [
    "Freedom",
    "Progress",
    "Solution",
    "calibrate",
    "solve_network",
]
