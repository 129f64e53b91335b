"""Synchronisation of all camera pairs of a session, and correction of wrong frame rates.

Times made from frame numbers with a wrong frame rate run 0.4 to 2.5 times as fast as they should, those of slow motion
up to 10 times. Searching for that in every pair is slow, so only cameras that are not connected to the others are tried
at such rates. The rate found becomes the camera's time scale: its times are multiplied by it, so that later steps see
clock rates near 1.

Where the images are consistent with several lags (periodic motion), external clock priors may select one of them. They
are used last, so that they change no lag that the images determine.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import LARGE_NETWORK
from hub.calibration.pairs.pair_overlap import candidate_pairs
from hub.calibration.pairs.synchronised_groups import ENOUGH_PAIRS, MIN_REDUNDANT, SynchronisedGroups, time_span
from hub.clocks.clock_graph import connected_components
from hub.clocks.external_prior import MAX_CAMERA_DELAY_S, ExternalClockPrior
from hub.sync.common_clock import solve_common_clock_pair
from hub.sync.hypothesis import PairFit, PairSolution, evidence
from hub.sync.pair_solver import FRAME_RATES, SLOW_MOTION_RATES, solve_pair
from hub.sync.settings import PairSettings
from hub.sync.track_cache import TrackCache, ranking_score
from hub.trajectory.image_tracks import smooth_only
from hub.two_view.relative_pose import relative_pose_between
from protocols.geometry.types import Floats
from protocols.session.calibration import FixedCalibration

Progress = Callable[[str, float], None]
"""Progress callback: (what is being done, share of the whole that is done, 0..1)."""

RATE_TOLERANCE = 0.01
"""Relative rate error above which times must have been made with a wrong frame rate: no clock is off by that much."""
_RATIO_TOLERANCE = 0.01  # relative: 29.97 counts as 30
_SMALL_NETWORK = 8  # cameras up to which all failed guided searches are repeated over all lags
_LONG_OVERLAP = 8.0  # s of common motion
_FEW_CANDIDATES = 2
"""Lags that are refined, while none of them is reliable, for a camera that resection can still find: in 48 of 48 pairs
of 12 simulated and 2 real rigs the first one was reliable, and a camera that is broken costs a search of all 18."""
_MIN_CONTRADICTIONS = 2  # pairs that refute the only other pair of a camera
_MAX_PRIOR_WINDOW = 0.5  # s on either side: a less precise prior selects nothing


def solve_pairs(
    prepared: PreparedSession,
    report: Progress,
    *,
    thorough: bool | Literal["first pair"] = False,
    known: FixedCalibration | None = None,
    clock_priors: Mapping[str, ExternalClockPrior] | None = None,
    arrivals: Mapping[str, ExternalClockPrior] | None = None,
) -> tuple[PreparedSession, list[PairSolution]]:
    """All pairs of cameras, uncalibrated ones included, and the session with the time scales that were found.

    thorough: whether to try rates that a wrong nominal frame rate causes, for unconnected cameras. "first pair": only
    until a pair is solved; and a camera whose best pair with three connected ones fails is left to resection. known:
    given poses; pairs of two such cameras then estimate lag and rate only. clock_priors: external clock priors by
    camera; they select a lag only where the images leave it ambiguous, which a warning reports. arrivals: the same by
    times of arrival; pairs that have no solution near them are not searched further.
    """
    names = prepared.names
    todo = candidate_pairs(prepared, arrivals)
    is_large = len(names) > _SMALL_NETWORK and not prepared.shared_clock
    is_vast = len(names) > LARGE_NETWORK
    pairs: dict[tuple[str, str], PairSolution] = {}
    unguided: dict[tuple[str, str], PairSolution] = {}
    synchronised, cache = SynchronisedGroups(), TrackCache()
    # In a large network the order of overlaps serves as well as one by scans, which took 6 % of its time.
    is_ranked = len(todo) > 1 and not prepared.shared_clock and not (is_vast and arrivals)
    queue = deque(_ranked(prepared, todo, report, cache) if is_ranked else todo)
    postponed = set[tuple[str, str]]()
    # Resection against the path of three other cameras finds what a short search does not.
    is_spared = thorough == "first pair" and len(prepared.cameras) > MIN_REDUNDANT
    while queue:
        a, b = queue.popleft()
        if thorough == "first pair" and (a, b) not in postponed and synchronised.has_failed(a, b, pairs.values()):
            postponed.add((a, b))  # until the others are connected, whose path may spare the search
            queue.append((a, b))
            continue
        done = len(pairs)
        report(f"pair {a}–{b}", 0.05 + 0.5 * done / max(len(todo), 1))
        if arrivals and is_vast and synchronised.has_enough(a, b):
            pairs[a, b] = PairSolution(a, b, "not searched: both cameras are in enough solved pairs")
            continue
        predicted_lag = None if prepared.shared_clock else synchronised.lag(prepared, a, b)
        expected = expected_lag(prepared, a, b, arrivals) if arrivals and not prepared.shared_clock else None
        if expected is not None:
            near = PairSettings(predicted_lag_window=expected[1])
            solution = _solve(prepared, (a, b), known, predicted_lag=expected[0], settings=near, cache=cache)
            if not solution.solved or _agrees(solution, predicted_lag) or (is_vast and _is_certain(solution)):
                pairs[a, b] = solution
                synchronised.add(solution)
                continue
        # A pair that was not searched completely is left as it is if by now others connect three cameras.
        is_done = (a, b) in pairs and max(synchronised.size(a), synchronised.size(b)) >= MIN_REDUNDANT
        may_leave = thorough == "first pair" and predicted_lag is None
        if is_done or (may_leave and synchronised.leaves(a, b, pairs.values())):
            unsearched = PairSolution(a, b, "not searched: the most promising pair of the same camera had failed")
            pairs.setdefault((a, b), unsearched)
            continue
        spared = is_spared and (a, b) not in pairs and {a, b} <= prepared.cameras.keys()
        brief = PairSettings(max_unreliable_candidates=_FEW_CANDIDATES) if spared else None
        solution = _solve(prepared, (a, b), known, predicted_lag=predicted_lag, settings=brief, cache=cache)
        # If the predicted lag is right, a pair with a long overlap must agree with it; else it is solved over all lags.
        again = predicted_lag is not None and not solution.solved and (not is_large or _has_long_overlap(solution))
        if again and not (spared and synchronised.size(a) > MIN_REDUNDANT):
            solution, predicted_lag = _solve(prepared, (a, b), known, settings=brief, cache=cache), None
        if predicted_lag is None:
            unguided[a, b] = solution
        if clock_priors and not solution.solved and not prepared.shared_clock:
            solution, warning = _disambiguated_by_priors(prepared, solution, known, clock_priors)
            prepared = replace(prepared, warnings=prepared.warnings + warning)
        pairs[a, b] = solution
        synchronised.add(solution)
        if solution.incomplete and max(synchronised.size(a), synchronised.size(b)) < MIN_REDUNDANT:
            queue.append((a, b))  # all its lags are searched if no other pairs connect three cameras
    place = {name: number for number, name in enumerate(names)}
    pairs = {both: pairs[both] for both in sorted(todo, key=lambda both: (place[both[0]], place[both[1]]))}
    if thorough == "first pair" and not prepared.shared_clock:
        _leave_to_resection(pairs, prepared.cameras)
    if len(names) >= MIN_REDUNDANT and not prepared.shared_clock and known is None:
        # Those selected by external clock priors are ambiguous over all lags.
        for both in [one for one in _isolated_pairs(pairs) if unguided.get(one) is pairs[one]]:
            report(f"pair {both[0]}–{both[1]} by itself", 0.56)
            pairs[both] = unguided[both] = _solve(prepared, both, known, standalone=True, cache=cache)
    if thorough and not prepared.shared_clock:
        prepared = _connect_at_other_rates(prepared, pairs, unguided, known, report, thorough == "first pair")
    return prepared, list(pairs.values())


def solve_new_pairs(
    prepared: PreparedSession,
    new: list[str],
    placed: list[str],
    clock_priors: Mapping[str, ExternalClockPrior] | None = None,
) -> tuple[PreparedSession, list[PairSolution]]:
    """Pairs of the new cameras with placed ones, most promising first, until two of a new camera are solved.

    The session is returned with warnings about lags that clock priors selected.
    """
    cache, out = TrackCache(), []
    for name in new:
        pairs = [
            (one, name) if prepared.names.index(one) < prepared.names.index(name) else (name, one) for one in placed
        ]
        solved = 0
        for pair in _ranked(prepared, pairs, lambda text, share: None, cache):
            solution = _solve(prepared, pair, None, cache=cache)
            if clock_priors and not solution.solved:
                solution, warning = _disambiguated_by_priors(prepared, solution, None, clock_priors)
                prepared = replace(prepared, warnings=prepared.warnings + warning)
            out.append(solution)
            solved += solution.solved
            if solved >= ENOUGH_PAIRS:
                break
    return prepared, out


def _leave_to_resection(pairs: dict[tuple[str, str], PairSolution], calibrated: Container[str]) -> None:
    """Undo the only solved pair of a calibrated camera, next to three others, that its other pairs refute; in place."""
    solved = Counter(name for both, solution in pairs.items() if solution.solved for name in both)
    refuted = Counter(
        name
        for both, solution in pairs.items()
        if solution.refuted or (not solution.solved and _has_long_overlap(solution))
        for name in both
    )
    for (a, b), pair in pairs.items():
        for name, other in ((a, b), (b, a)):
            contradicted = refuted[name] >= max(_MIN_CONTRADICTIONS, solved[name] + 1)
            alone = name in calibrated and solved[name] == 1 and solved[other] >= MIN_REDUNDANT
            if pair.solved and alone and contradicted:
                text = f"its lag contradicts {refuted[name]} other pairs of {name}"
                pairs[a, b] = replace(pair, status=text)


def _isolated_pairs(pairs: Mapping[tuple[str, str], PairSolution]) -> list[tuple[str, str]]:
    """Solved pairs whose cameras are in no other solved pair: nothing else checks their lag."""
    counts = Counter(name for both, solution in pairs.items() if solution.solved for name in both)
    return [both for both, solution in pairs.items() if solution.solved and max(counts[name] for name in both) == 1]


def _disambiguated_by_priors(
    prepared: PreparedSession,
    solution: PairSolution,
    known: FixedCalibration | None,
    clock_priors: Mapping[str, ExternalClockPrior],
) -> tuple[PairSolution, tuple[str, ...]]:
    """The alignment near the lag of the two external clock priors, if it fits as well as any other.

    solution: of the search over all lags, unsolved. It is returned unchanged, without a warning, if it has no
    alignment at all, or if there is none near the prior lag, or one whose inlier support is less than half or whose
    residuals are clearly larger than the best alignment's: then the prior is wrong.
    """
    expected = expected_lag(prepared, solution.a, solution.b, clock_priors)
    if solution.fit is None or expected is None:
        return solution, ()
    lag, lag_window = expected
    settings = PairSettings(predicted_lag_window=lag_window)
    guided = _solve(prepared, (solution.a, solution.b), known, predicted_lag=lag, settings=settings)
    best, fit = solution.fit, guided.fit
    if not guided.solved or fit is None or abs(fit.lag - lag) > lag_window:
        return solution, ()
    if evidence(fit) < settings.max_evidence_ratio * evidence(best):
        return solution, ()
    if fit.residual_px > settings.competing_residual_ratio_at_noise * max(best.residual_px, settings.sigma_px):
        return solution, ()
    warning = (
        f"{solution.a}–{solution.b}: the motion alone is consistent with several lags ({solution.status}); "
        f"the one near the external clock priors was selected (within {1e3 * lag_window:.3g} ms)"
    )
    return guided, (warning,)


def expected_lag(
    prepared: PreparedSession, a: str, b: str, clock_priors: Mapping[str, ExternalClockPrior]
) -> tuple[float, float] | None:
    """``t_a - t_b`` [s] by the priors, times from each camera's origin, and its error bound; None if not known well."""
    if a not in clock_priors or b not in clock_priors:
        return None
    one, other = clock_priors[a], clock_priors[b]
    lag_window = one.error_bound + other.error_bound + MAX_CAMERA_DELAY_S
    if not lag_window <= _MAX_PRIOR_WINDOW:
        return None
    # t_unix = t_a + m_a = t_b + m_b, with times from each camera's time origin
    difference = other.unix_minus_camera - one.unix_minus_camera
    return difference + prepared.time_origins[b] - prepared.time_origins[a], lag_window


def _agrees(solution: PairSolution, predicted_lag: float | None) -> bool:
    """Whether a solved pair's lag is one that a search about the predicted one would find."""
    if solution.fit is None or predicted_lag is None:
        return False
    return abs(solution.fit.lag - predicted_lag) < PairSettings().predicted_lag_window


def _is_certain(solution: PairSolution) -> bool:
    """Whether no chance makes a solved pair fit at its lag; without a distribution of chance it fits for 8 s."""
    chance = None if solution.fit is None else solution.fit.log10_false_alarm
    return chance is None or chance < PairSettings().certain_lag_log10_false_alarm


def _has_long_overlap(solution: PairSolution) -> bool:
    return solution.fit is not None and solution.fit.moving_overlap > _LONG_OVERLAP


def _ranked(
    prepared: PreparedSession, todo: list[tuple[str, str]], report: Progress, cache: TrackCache
) -> list[tuple[str, str]]:
    """The pairs by descending ranking score of a coarse lag scan; lags within connected groups are then predicted."""
    scores = {}
    for a, b in todo:
        report(f"coarse scan of {a}–{b}", 0.05)
        tracks_a, tracks_b = (smooth_only(prepared.camera(name).tracks) for name in (a, b))
        scores[a, b] = ranking_score(tracks_a, tracks_b, cache=cache)
    return sorted(todo, key=lambda pair: -scores[pair])


def _solve(
    prepared: PreparedSession,
    names: tuple[str, str],
    known: FixedCalibration | None,
    *,
    thorough: bool = False,
    predicted_lag: float | None = None,
    settings: PairSettings | None = None,
    unguided: PairSolution | None = None,
    cache: TrackCache | None = None,
    standalone: bool = False,
) -> PairSolution:
    a, b = (prepared.camera(name).tracks for name in names)
    if prepared.shared_clock:
        return solve_common_clock_pair(a, b, names)
    given = None
    if known is not None and all(name in known.cameras for name in names):
        poses = [known.cameras[name].pose for name in names]
        if coincide(*(pose.position for pose in poses)):
            return PairSolution(*names, "both cameras are known to be in one place: no motion determines their lag")
        given = relative_pose_between(*poses)
    calibrated = all(name in prepared.cameras for name in names)
    # With more cameras the adjustment estimates lenses and tests each clock: an imprecise lag suffices to start.
    settings = replace(settings or PairSettings(), standalone=standalone or len(prepared.names) < MIN_REDUNDANT)
    if given is not None:
        settings = replace(settings, min_planar_ratio=0.0)  # a given geometry is not left open by planar motion
    return solve_pair(
        smooth_only(a),
        smooth_only(b),
        names,
        settings,
        given,
        calibrated=calibrated,
        thorough=thorough,
        predicted_lag=predicted_lag,
        previous_refusal=unguided,
        cache=cache,
    )


def solve_one_pair(prepared: PreparedSession, names: tuple[str, str], known: FixedCalibration | None) -> PairSolution:
    """One pair of cameras by itself, over all lags. known: given poses; then only lag and rate are estimated."""
    return _solve(prepared, names, known, standalone=True)


def coincide(*positions: Floats) -> bool:
    """Whether positions (3,) differ by no more than rounding, so that rays from them meet nowhere else."""
    extent = np.ptp(np.array(positions), axis=0)
    return bool(np.abs(extent).max() <= 1e-9 * max(float(np.abs(positions).max()), 1e-9))


def _connect_at_other_rates(
    prepared: PreparedSession,
    pairs: dict[tuple[str, str], PairSolution],
    unguided: dict[tuple[str, str], PairSolution],
    known: FixedCalibration | None,
    report: Progress,
    first_pair_only: bool,
) -> PreparedSession:
    """Connect cameras outside the largest group at rates far from 1; ``pairs`` are replaced in place.

    A group that gets connected by one pair is rescaled as a whole, and its other pairs are solved again. unguided:
    results of searches over all lags, which are not repeated.
    """
    names, tried = prepared.names, set[tuple[str, str]]()
    while True:
        groups = connected_components(names, [pair for pair in pairs.values() if pair.solved])
        largest = groups[0] if groups else []
        found = None
        for a, b in pairs:
            across = (a in largest) != (b in largest) if len(largest) > 1 else not pairs[a, b].solved
            if not across or (a, b) in tried:
                continue
            outside = b if a in largest else a
            if first_pair_only and len(largest) > 1 and outside not in prepared.uncalibrated:
                continue  # resection finds it
            tried.add((a, b))
            report(f"pair {a}–{b} at other frame rates", 0.57)
            solution = _solve(prepared, (a, b), known, thorough=True, unguided=unguided.get((a, b)))
            if solution.solved and solution.fit is not None:
                found = solution, solution.fit
                break
        if found is None:
            return prepared
        solution, fit = found
        fixed = solution.b if len(largest) > 1 and solution.b in largest else solution.a
        rescaled = solution.a if fixed == solution.b else solution.b
        group = next(group for group in groups if rescaled in group)
        factor = fit.rate if rescaled == solution.b else 1.0 / fit.rate
        prepared = prepared.with_time_scale(group, factor)
        pairs[solution.a, solution.b] = solution
        for (a, b), pair in pairs.items():
            if a in group or b in group:
                unguided.pop((a, b), None)
            if (a in group) == (b in group) or pair is solution:
                pairs[a, b] = _rescaled(pair, *(factor if name in group else 1.0 for name in (a, b)))
            else:
                pairs[a, b] = unguided[a, b] = _solve(prepared, (a, b), known)


def _rescaled(pair: PairSolution, factor_a: float, factor_b: float) -> PairSolution:
    """A pair's solution after the times of its cameras were multiplied by the factors."""
    if pair.fit is None:
        return pair
    fit = pair.fit
    rescaled = replace(
        fit, rate=fit.rate * factor_a / factor_b, offset=fit.offset * factor_a, mid_time=fit.mid_time * factor_a
    )
    return replace(pair, fit=rescaled, alternatives=())


def frame_rate_warnings(prepared: PreparedSession, pairs: list[PairSolution]) -> tuple[str, ...]:
    """One sentence for each camera whose times run much faster or slower than those of most connected cameras."""
    if not any(abs(time_scale - 1.0) > RATE_TOLERANCE for time_scale in prepared.time_scales.values()):
        return ()
    connected = connected_components(prepared.names, [pair for pair in pairs if pair.solved])[0]
    typical = max(connected, key=lambda name: sum(_same_time_scale(prepared, name, other) for other in connected))
    consistent = [name for name in connected if _same_time_scale(prepared, name, typical)]
    out = []
    for name in connected:
        if name in consistent:
            continue
        ratio = prepared.time_scale(typical) / prepared.time_scale(name)
        nominal, actual = _likely_frame_rates(ratio, _observed_frame_rate(prepared, name))
        if 2 * len(consistent) > len(connected):
            comparison = f"the others': were they made with {nominal} fps for {actual}{_slow_motion(ratio)}?"
        else:
            nominal_typical, actual_typical = _likely_frame_rates(1.0 / ratio, _observed_frame_rate(prepared, typical))
            comparison = (
                f"{typical}'s: were they made with {nominal} fps for {actual}{_slow_motion(ratio)}, "
                f"or {typical}'s with {nominal_typical} for {actual_typical}{_slow_motion(1.0 / ratio)}?"
            )
        out.append(f"{name}: its times run {ratio:.4g} times as fast as {comparison}")
    return tuple(out)


def _slow_motion(ratio: float) -> str:
    """A hint at slow motion where times run ``ratio`` times as fast as they should."""
    return " (slow motion)" if ratio > 1.9 else ""  # 50 fps shown at 25, or more


def _same_time_scale(prepared: PreparedSession, a: str, b: str) -> bool:
    return abs(prepared.time_scale(a) / prepared.time_scale(b) - 1.0) < RATE_TOLERANCE


def _observed_frame_rate(prepared: PreparedSession, name: str) -> float:
    """The camera's frame rate by its own time stamps."""
    interval = min(float(np.median(np.diff(track.time))) for track in prepared.camera(name).tracks.values())
    return prepared.time_scale(name) / interval


def _likely_frame_rates(ratio: float, observed: float) -> tuple[str, str]:
    """The frame rate that times were likely made with, and the true one, if they run ``ratio`` times as fast.

    observed: frame rate by the camera's own time stamps.
    """
    rates = (*FRAME_RATES, *SLOW_MOTION_RATES)
    standard = [(a, b) for a in rates for b in rates if abs(b / a / ratio - 1.0) < _RATIO_TOLERANCE]
    likely = min(standard, key=lambda pair: abs(pair[0] - observed), default=(observed, observed * ratio))
    return f"{likely[0]:.3g}", f"{likely[1]:.3g}"


def describe_timing(name: str, prepared: PreparedSession, pairs: list[PairSolution]) -> str:
    """Lags of a camera from its solved pairs: "12.3450 s against cam0, …"; "" where none is solved."""
    parts = []
    for pair in pairs:
        if not pair.solved or pair.fit is None or name not in (pair.a, pair.b):
            continue
        lag = pair_lag(prepared, pair, pair.fit)
        parts.append(f"{lag:.4f} s against {pair.b}" if name == pair.a else f"{-lag:.4f} s against {pair.a}")
    return ", ".join(parts)


def describe_failures(name: str, pairs: list[PairSolution]) -> str:
    """Why a camera's pairs are not solved, each reason once."""
    tried: dict[str, list[str]] = {}
    for pair in pairs:
        if name in (pair.a, pair.b) and not pair.solved:
            tried.setdefault(pair.status, []).append(pair.b if pair.a == name else pair.a)
    found = (f"with {', '.join(others)}: {status}" for status, others in tried.items())
    return "; ".join(found) or "no other camera to compare with"


def pair_lag(prepared: PreparedSession, pair: PairSolution, fit: PairFit) -> float:
    """``t_a - t_b`` [s] on the cameras' own clocks, in the middle of the common recording time."""
    begin_a, end_a = time_span(prepared, pair.a)
    begin_b, end_b = (fit.rate * time + fit.offset for time in time_span(prepared, pair.b))
    middle = 0.5 * (max(begin_a, begin_b) + min(end_a, end_b))
    shown_a = prepared.time_origins[pair.a] + middle / prepared.time_scale(pair.a)
    return shown_a - prepared.time_origins[pair.b] - (middle - fit.offset) / fit.rate / prepared.time_scale(pair.b)
