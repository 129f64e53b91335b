"""The whole line of the hub: tracks → pairs → graph → poses → one adjustment → a published calibration.

No sockets, files or clocks: `calibrate` offline and the live hub run the same code.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from hub.points import sampled_track
from hub.poses.adjust import adjust, noise, residual_norms
from hub.poses.graph import ClockGraph, ClockGuess, average_clocks, components
from hub.poses.initialise import Camera, Scaffold, agreement, grow, place_known
from hub.poses.problem import Freedom, Problem, Rows, State
from hub.publish import publish
from hub.timing.pair import PairSolution, solve_pair
from hub.timing.paper_pairs import paper_pair
from hub.timing.shared import solve_shared_pair
from hub.timing.tracks import Track, smooth_only, smooth_track, without_jumps
from hub.timing.two_view import relative_pose
from protocols.errors import Refused
from protocols.session.calibration import Calibration, Known
from protocols.session.observations import Observations
from protocols.session.rig import Rig

Progress = Callable[[str, float], None]
"""Told what is being done and how much of the whole is done (0..1)."""

_LEAST_AGREEMENT = 0.5  # share of a camera's rows that must fit the common path
_LEAST_ROWS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Cameras that can be tried: smoothed tracks, raw rows; and those that can't, with the reason."""

    cameras: dict[str, Camera]
    rows: dict[str, list[Rows]]
    epochs: dict[str, float]
    labels: list[str]
    refused: dict[str, str]
    order: tuple[str, ...]
    shared_clock: bool = False
    warnings: tuple[str, ...] = ()


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
) -> Calibration:
    """Timing and poses of all cameras from what they saw, with no guess.

    solver: "joint", or "paper" (the paper's alternating method: no adjustment, same frame rates, lags of
    a few frames). known: intrinsics and poses that are given; then only timing and paths are sought.
    Raises Refused, with a reason for every camera, where fewer than two can be tied together.
    """
    tell = progress or (lambda text, share: None)
    if known is not None:
        rig = with_known_lenses(rig, known)
    prepared = prepare(rig, observations)
    if known is not None:
        solution = solve_known(prepared, known, tell)
    elif solver == "paper":
        solution = solve_paper(prepared, paper_pairs(prepared, observations, tell), tell)
    else:
        solution = solve_network(prepared, solve_pairs(prepared, tell), tell)
    tell("covariances", 0.95)
    return publish(rig, solution)


def with_known_lenses(rig: Rig, known: Known) -> Rig:
    """The rig with the intrinsics of a known calibration, which may have been refined since."""
    cameras = {
        name: replace(camera, intrinsics=known.cameras[name].intrinsics) if name in known.cameras else camera
        for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def prepare(rig: Rig, observations: Observations) -> Prepared:
    """Undistort and smooth every track; name the cameras that cannot be used."""
    refused: dict[str, str] = {}
    cameras: dict[str, Camera] = {}
    rows: dict[str, list[Rows]] = {}
    epochs: dict[str, float] = {}
    labels = observations.labels
    start = min((float(track.time[0]) for track in observations.tracks.values()), default=0.0)
    warnings: list[str] = []
    for name, rig_camera in rig.cameras.items():
        tracks, jump = without_jumps(observations.of_camera(name))
        if jump:
            warnings.append(f"{name}: {jump}")
        if not tracks:
            refused[name] = "no observations"
            continue
        lens = rig_camera.intrinsics
        if lens is None:
            refused[name] = "no intrinsics (matrix and distortions in rig.toml): run `syncline intrinsics`"
            continue
        epoch = start if rig.shared_clock else min(float(track.time[0]) for track in tracks)
        smooth: dict[str, Track] = {}
        mine = []
        for track in tracks:
            normalised = lens.unproject(track.pixels)
            cleaned: Track | None
            if rig.shared_clock:
                cleaned = sampled_track(track.time, normalised, lens.focal, epoch)
            else:
                cleaned = smooth_track(track.time, normalised, lens.focal, epoch)
            if cleaned is None:
                continue
            smooth[track.label] = cleaned
            use = np.ones(len(track), dtype=np.bool_)
            mine.append(Rows(-1, labels.index(track.label), track.time - epoch, track.pixels, use))
        if not smooth:
            refused[name] = f"too few connected observations ({sum(len(track) for track in tracks)} rows)"
            continue
        cameras[name], rows[name], epochs[name] = Camera(name, lens, smooth), mine, epoch
    return Prepared(cameras, rows, epochs, labels, refused, tuple(rig.cameras), rig.shared_clock, tuple(warnings))


def solve_pairs(prepared: Prepared, tell: Progress) -> list[PairSolution]:
    """All pairs of cameras, each by itself."""
    names = list(prepared.cameras)
    todo = list(itertools.combinations(names, 2))
    pairs = []
    for done, (a, b) in enumerate(todo):
        tell(f"pair {a}–{b}", 0.05 + 0.5 * done / max(len(todo), 1))
        tracks_a, tracks_b = prepared.cameras[a].tracks, prepared.cameras[b].tracks
        pairs.append(
            solve_shared_pair(tracks_a, tracks_b, (a, b))
            if prepared.shared_clock
            else solve_pair(smooth_only(tracks_a), smooth_only(tracks_b), (a, b))
        )
    return pairs


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


def solve_network(prepared: Prepared, pairs: list[PairSolution], tell: Progress) -> Solution:
    """From pairs to one adjusted network; cameras that don't fit are refused by name."""
    refused = dict(prepared.refused)
    freedom = Freedom(clock=not prepared.shared_clock)
    graph = _connect(prepared, list(prepared.cameras), pairs, refused)
    while True:
        scaffold, unplaced = grow(
            prepared.cameras, graph, prepared.rows, prepared.labels, lambda text: tell(text, 0.6), freedom
        )
        refused |= unplaced
        scaffold = _adjust_all(scaffold, tell)
        bad = [name for name in scaffold.names if not _fits(scaffold, name)]
        if not bad:
            break
        # The worst one goes, and what it may have spoilt is made again without it.
        worst = min(bad, key=lambda name: agreement(scaffold, name)[0])
        share, count = agreement(scaffold, worst)
        refused[worst] = f"only {100 * share:.0f} % of its {count} observations fit the path that the others see"
        remaining = [name for name in scaffold.names if name != worst]
        if len(remaining) < 2:
            raise Refused("no two cameras agree on one path", refused)
        graph = _connect(prepared, remaining, list(graph.agreeing), refused)
    warnings = tuple(
        f"pair {pair.a}–{pair.b} contradicts the other pairs and was set aside" for pair in graph.contradicting
    )
    return Solution(scaffold, tuple(pairs), _ordered(refused, prepared), prepared, "joint", warnings)


def solve_paper(prepared: Prepared, pairs: list[PairSolution], tell: Progress) -> Solution:
    """Network from the paper's pairs: clocks averaged, poses by resection, nothing adjusted."""
    refused = dict(prepared.refused)
    graph = _connect(prepared, list(prepared.cameras), pairs, refused)
    tell("placing", 0.8)
    scaffold, unplaced = grow(prepared.cameras, graph, prepared.rows, prepared.labels, freedom=None)
    scaffold.state = replace(scaffold.state, sigma=noise(scaffold.problem, scaffold.state))
    warning = "the paper's method adjusts nothing: its stds count independent noise only and are too small"
    return Solution(scaffold, tuple(pairs), _ordered(refused | unplaced, prepared), prepared, "paper", (warning,))


def solve_known(prepared: Prepared, known: Known, tell: Progress) -> Solution:
    """Only clocks and paths: intrinsics and poses are given and stay as they are."""
    refused = dict(prepared.refused)
    for name in [name for name in prepared.cameras if name not in known.cameras]:
        refused[name] = "not in the known calibration"
    cameras = {name: camera for name, camera in prepared.cameras.items() if name in known.cameras}
    inside = replace(prepared, cameras=cameras)
    pairs = []
    todo = list(itertools.combinations(cameras, 2))
    for done, (a, b) in enumerate(todo):
        tell(f"pair {a}–{b}", 0.05 + 0.5 * done / max(len(todo), 1))
        if prepared.shared_clock:
            pairs.append(solve_shared_pair(cameras[a].tracks, cameras[b].tracks, (a, b)))
            continue
        relative = relative_pose(known.cameras[a].pose, known.cameras[b].pose)
        pairs.append(solve_pair(smooth_only(cameras[a].tracks), smooth_only(cameras[b].tracks), (a, b), known=relative))
    graph = _connect(inside, list(cameras), pairs, refused)
    tell("adjusting", 0.75)
    poses = {name: known.cameras[name].pose for name in graph.clocks}
    scaffold = place_known(cameras, graph, prepared.rows, prepared.labels, poses, not prepared.shared_clock)
    problem, state, _ = adjust(scaffold.problem, scaffold.state)
    return Solution(replace_solution(scaffold, problem, state), tuple(pairs), refused, inside, "joint", known=known)


def _connect(prepared: Prepared, names: list[str], pairs: list[PairSolution], refused: dict[str, str]) -> ClockGraph:
    """The largest group of ``names`` that solved pairs tie together; the others are entered in ``refused``.

    Raises Refused, with every camera's reason, where no pair is solved.
    """
    solved = [pair for pair in pairs if pair.solved and pair.a in names and pair.b in names]
    if not solved:
        raise Refused(_why_nothing(pairs, refused), _ordered(refused | _pair_reasons(names, pairs), prepared))
    groups = components(names, solved)
    for name in [name for name in names if name not in groups[0]]:
        refused[name] = _why_alone(name, groups, pairs)
    inside = [pair for pair in solved if pair.a in groups[0] and pair.b in groups[0]]
    if prepared.shared_clock:
        return ClockGraph({name: ClockGuess(1.0, 0.0, 0.0) for name in groups[0]}, tuple(inside), ())
    return average_clocks(groups[0], inside, {name: prepared.cameras[name].tracks for name in groups[0]})


def _ordered(refused: dict[str, str], prepared: Prepared) -> dict[str, str]:
    """Reasons in the rig's order."""
    return {name: refused[name] for name in prepared.order if name in refused}


def _fits(scaffold: Scaffold, name: str) -> bool:
    share, count = agreement(scaffold, name)
    return share >= _LEAST_AGREEMENT and count >= _LEAST_ROWS


def _adjust_all(scaffold: Scaffold, tell: Progress) -> Scaffold:
    """The final adjustment, with the lens freed where the data clearly ask for it."""
    tell("adjusting", 0.75)
    problem, state, _ = adjust(scaffold.problem, scaffold.state)
    tell("adjusting the lenses", 0.85)
    freed = replace(problem, freedom=replace(problem.freedom, lens=True))
    freed_problem, freed_state, _ = adjust(freed, state, rounds=3)
    if _prefers(freed_problem, freed_state, problem, state):
        problem, state = freed_problem, freed_state
    return replace_solution(scaffold, problem, state)


def replace_solution(scaffold: Scaffold, problem: Problem, state: State) -> Scaffold:
    """The scaffold with another problem and state."""
    return Scaffold(scaffold.names, scaffold.labels, problem, state)


def _prefers(freed: Problem, freed_state: State, fixed: Problem, fixed_state: State) -> bool:
    """Whether focal length and k1 are worth their parameters (Bayesian information criterion).

    The robust likelihood of all rows under each answer's own noise decides.
    """
    rows = sum(len(part.time) for part in fixed.rows)
    gain = _deviance(fixed, fixed_state) - _deviance(freed, freed_state)
    return bool(gain > 2 * len(fixed_state.cameras) * np.log(max(rows, 2)))


def _deviance(problem: Problem, state: State) -> float:
    total = 0.0
    for part in problem.rows:
        norms = residual_norms(part, state.cameras[part.camera], state.trajectories[part.label])
        norms = norms[np.isfinite(norms)]
        sigma = float(state.sigma[part.camera])
        total += float(np.minimum((norms / sigma) ** 2, 25.0).sum()) + 4.0 * len(norms) * np.log(sigma)
    return total


def _why_nothing(pairs: list[PairSolution], refused: dict[str, str]) -> str:
    if not pairs:
        told = "; ".join(f"{name}: {reason}" for name, reason in refused.items())
        return (
            f"fewer than two cameras have usable observations ({told})" if told else "one camera only: a pair is needed"
        )
    told = "; ".join(f"{pair.a}–{pair.b}: {pair.status}" for pair in pairs[:6])
    return f"no pair of cameras could be tied together ({told})"


def _pair_reasons(names: list[str], pairs: list[PairSolution]) -> dict[str, str]:
    return {
        name: "; ".join(f"with {p.b if p.a == name else p.a}: {p.status}" for p in pairs if name in (p.a, p.b))
        or "no other camera to compare with"
        for name in names
    }


def _why_alone(name: str, groups: list[list[str]], pairs: list[PairSolution]) -> str:
    mine = next(group for group in groups if name in group)
    tried = "; ".join(
        f"with {p.b if p.a == name else p.a}: {p.status}" for p in pairs if name in (p.a, p.b) and not p.solved
    )
    if len(mine) > 1:
        return f"tied only to {', '.join(other for other in mine if other != name)}, not to the rest ({tried})"
    return f"could not be tied to any camera ({tried})"


__all__ = [
    "Freedom",
    "Prepared",
    "Progress",
    "Solution",
    "calibrate",
    "prepare",
    "solve_network",
    "solve_pairs",
]
