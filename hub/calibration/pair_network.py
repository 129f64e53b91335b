"""All pairs of a session's cameras, each by itself; and clocks whose seconds are no seconds.

Times made of frame numbers with a wrong frame rate run 0.4 to 2.5 times as fast as they should. To look for
that in every pair is dear, so only cameras that nothing ties to the others are tried at such rates. What is
found becomes the camera's pace: from then on its times are counted at it, and everything behind sees clocks
that run about alike.

Where the pictures leave several lags open (a motion that repeats itself), what time services say of the cameras'
clocks may choose among them. It is asked last, so that it changes no answer that the pictures give.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from hub.calibration.clock_graph import components
from hub.calibration.preprocessing import Prepared
from hub.clocks.external_prior import CAMERA_DELAY, Claim
from hub.sync.pair_ranking import promise
from hub.sync.pair_solver import PairFit, PairSettings, PairSolution, evidence, solve_pair
from hub.sync.track_cache import Kept
from hub.trajectory.image_tracks import smooth_only
from hub.two_view.common_clock import solve_shared_pair
from hub.two_view.relative_pose import relative_pose
from protocols.session.calibration import Known

Progress = Callable[[str, float], None]
"""Told what is being done and how much of the whole is done (0..1)."""

FAR_FROM_ONE = 0.01
"""No clock is off by that much: its times were made with a wrong frame rate."""
_FRAME_RATES = (24.0, 25.0, 30.0, 50.0, 60.0)
_SAME_RATIO = 0.01
_FEW = 8  # cameras whose pairs are all looked at closely
_SEVERAL = 3  # cameras that tell of each other
_MUCH = 8.0  # s of common motion
_WIDEST_CLAIM = 0.5  # s on either side: a claim as vague as that chooses nothing


def solve_pairs(
    prepared: Prepared,
    tell: Progress,
    *,
    thorough: bool = False,
    known: Known | None = None,
    claims: Mapping[str, Claim] | None = None,
) -> tuple[Prepared, list[PairSolution]]:
    """All pairs of cameras, lensless ones included, and the session at the paces that were found.

    thorough: whether to try rates that a wrongly told frame rate makes, for cameras that nothing ties.
    known: given poses; then only lags and rates are sought where both have one. claims: what the cameras' machines
    say of their clocks; it chooses where the pictures leave lags open, which a warning tells, and nowhere else.
    """
    names = prepared.names
    todo = list(itertools.combinations(names, 2))
    many = len(names) > _FEW and not prepared.shared_clock
    pairs: dict[tuple[str, str], PairSolution] = {}
    plain: dict[tuple[str, str], PairSolution] = {}
    told, kept = _ToldClocks(), Kept()
    sort = len(todo) > 1 and not prepared.shared_clock
    for done, (a, b) in enumerate(_most_promising_first(prepared, todo, tell, kept) if sort else todo):
        tell(f"pair {a}–{b}", 0.05 + 0.5 * done / max(len(todo), 1))
        near = None if prepared.shared_clock else told.lag(prepared, a, b)
        answer = _solve(prepared, (a, b), known, near=near, kept=kept)
        # Where the others' clocks are right, a pair that sees much must agree; if not, it is heard for itself.
        if near is not None and not answer.solved and (not many or _sees_much(answer)):
            answer, near = _solve(prepared, (a, b), known, kept=kept), None
        if near is None:
            plain[a, b] = answer
        if claims and not answer.solved and not prepared.shared_clock:
            answer, warning = _chosen_by_claims(prepared, answer, known, claims)
            prepared = replace(prepared, warnings=prepared.warnings + warning)
        pairs[a, b] = answer
        told.hear(answer)
    pairs = {both: pairs[both] for both in todo}  # in the rig's order
    if len(names) >= _SEVERAL and not prepared.shared_clock and known is None:
        for both in _by_themselves(pairs):
            if plain.get(both) is not pairs[both]:
                continue  # chosen by what the machines claim: the search through all lags left it open
            tell(f"pair {both[0]}–{both[1]} by itself", 0.56)
            pairs[both] = plain[both] = _solve(prepared, both, known, alone=True, kept=kept)
    if thorough and not prepared.shared_clock:
        prepared = _tie_at_other_rates(prepared, pairs, plain, known, tell)
    return prepared, list(pairs.values())


def _by_themselves(pairs: Mapping[tuple[str, str], PairSolution]) -> list[tuple[str, str]]:
    """The solved pairs whose cameras no other pair ties to anything: what they tell must stand by itself."""
    ties = Counter(name for both, answer in pairs.items() if answer.solved for name in both)
    return [both for both, answer in pairs.items() if answer.solved and max(ties[name] for name in both) == 1]


def _chosen_by_claims(
    prepared: Prepared, answer: PairSolution, known: Known | None, claims: Mapping[str, Claim]
) -> tuple[PairSolution, tuple[str, ...]]:
    """The alignment about the lag that the two machines claim, if it explains what was seen as well as any does.

    answer: of the search through all lags, unsolved. Returned unchanged, without a warning, where it found no
    alignment at all, where nothing near the claim stands, or where what stands there agrees for less than half of
    the time or leaves clearly more than the best does elsewhere: then the claim is wrong.
    """
    if answer.fit is None or answer.a not in claims or answer.b not in claims:
        return answer, ()
    one, other = claims[answer.a], claims[answer.b]
    window = one.error + other.error + CAMERA_DELAY
    if not window <= _WIDEST_CLAIM:
        return answer, ()
    # t_unix = t_a + m_a = t_b + m_b, on the session's times, which begin at each camera's epoch
    lag = other.unix_minus_camera - one.unix_minus_camera + prepared.epochs[answer.b] - prepared.epochs[answer.a]
    settings = PairSettings(near_window=window)
    near = _solve(prepared, (answer.a, answer.b), known, near=lag, settings=settings)
    best, fit = answer.fit, near.fit
    if not near.solved or fit is None or abs(fit.lag - lag) > window:
        return answer, ()
    if evidence(fit) < settings.accept_ratio * evidence(best):
        return answer, ()
    if fit.sigma_px > settings.worse_than_noise * max(best.sigma_px, settings.sigma_px):
        return answer, ()
    warning = (
        f"{answer.a}–{answer.b}: the motion alone leaves several lags open ({answer.status}); of them the one was "
        f"taken that the machines' clocks claim, to {1e3 * window:.3g} ms"
    )
    return near, (warning,)


def _sees_much(answer: PairSolution) -> bool:
    return answer.fit is not None and answer.fit.moving_overlap > _MUCH


def _most_promising_first(
    prepared: Prepared, todo: list[tuple[str, str]], tell: Progress, kept: Kept
) -> list[tuple[str, str]]:
    """The pairs, those first that a coarse scan of all lags likes best: once cameras are tied, the rest is cheap."""
    likes = {}
    for a, b in todo:
        tell(f"coarse look at {a}–{b}", 0.05)
        tracks_a, tracks_b = (smooth_only(prepared.camera(name).tracks) for name in (a, b))
        likes[a, b] = promise(tracks_a, tracks_b, kept=kept)
    return sorted(todo, key=lambda pair: -likes[pair])


class _ToldClocks:
    """Groups of cameras that solved pairs tie, each with one time: ``t_group = rate * t + offset``."""

    def __init__(self) -> None:
        self._maps: dict[str, tuple[str, float, float]] = {}

    def hear(self, pair: PairSolution) -> None:
        """Join the groups of a solved pair's cameras; what is tied already stays as it is."""
        if not pair.solved or pair.fit is None:
            return
        for name in (pair.a, pair.b):
            self._maps.setdefault(name, (name, 1.0, 0.0))
        (group_a, rate_a, offset_a), (group_b, rate_b, offset_b) = self._maps[pair.a], self._maps[pair.b]
        if group_a == group_b:
            return
        # t_a = rate t_b + offset, so group a's time from group b's
        rate = rate_a * pair.fit.rate / rate_b
        offset = rate_a * pair.fit.offset + offset_a - rate * offset_b
        for name, (group, r, o) in list(self._maps.items()):
            if group == group_b:
                self._maps[name] = (group_a, rate * r, rate * o + offset)

    def lag(self, prepared: Prepared, a: str, b: str) -> float | None:
        """``t_a - t_b`` [s] in the middle of the time that both recorded; None where nothing ties them."""
        if a not in self._maps or b not in self._maps or self._maps[a][0] != self._maps[b][0]:
            return None
        (_, rate_a, offset_a), (_, rate_b, offset_b) = self._maps[a], self._maps[b]
        rate, offset = rate_b / rate_a, (offset_b - offset_a) / rate_a
        begin_a, end_a = _span(prepared, a)
        begin_b, end_b = (rate * time + offset for time in _span(prepared, b))
        middle = 0.5 * (max(begin_a, begin_b) + min(end_a, end_b))
        return middle - (middle - offset) / rate


def _solve(
    prepared: Prepared,
    names: tuple[str, str],
    known: Known | None,
    *,
    thorough: bool = False,
    near: float | None = None,
    settings: PairSettings | None = None,
    plain: PairSolution | None = None,
    kept: Kept | None = None,
    alone: bool = False,
) -> PairSolution:
    a, b = (prepared.camera(name).tracks for name in names)
    if prepared.shared_clock:
        return solve_shared_pair(a, b, names)
    given = None
    if known is not None and all(name in known.cameras for name in names):
        given = relative_pose(known.cameras[names[0]].pose, known.cameras[names[1]].pose)
    calibrated = all(name in prepared.cameras for name in names)
    # With more cameras the adjustment frees lenses itself and judges each clock: a vague lag is a start.
    settings = replace(settings or PairSettings(), firm=alone or len(prepared.names) < _SEVERAL)
    return solve_pair(
        smooth_only(a),
        smooth_only(b),
        names,
        settings,
        given,
        calibrated=calibrated,
        thorough=thorough,
        near=near,
        plain=plain,
        kept=kept,
    )


def _tie_at_other_rates(
    prepared: Prepared,
    pairs: dict[tuple[str, str], PairSolution],
    plain: dict[tuple[str, str], PairSolution],
    known: Known | None,
    tell: Progress,
) -> Prepared:
    """Tie what is not tied to the largest group at rates far from 1; ``pairs`` are replaced in place.

    A group of several that is tied by one pair is paced as a whole, and its other pairs are solved again. plain: what
    searches through all lags said, which are not made again.
    """
    names, tried = prepared.names, set[tuple[str, str]]()
    while True:
        groups = components(names, [pair for pair in pairs.values() if pair.solved])
        largest = groups[0] if groups else []
        found = None
        for a, b in pairs:
            across = (a in largest) != (b in largest) if len(largest) > 1 else not pairs[a, b].solved
            if not across or (a, b) in tried:
                continue
            tried.add((a, b))
            tell(f"pair {a}–{b} at other frame rates", 0.57)
            answer = _solve(prepared, (a, b), known, thorough=True, plain=plain.get((a, b)))
            if answer.solved and answer.fit is not None:
                found = answer, answer.fit
                break
        if found is None:
            return prepared
        answer, fit = found
        stays = answer.b if len(largest) > 1 and answer.b in largest else answer.a
        moves = answer.a if stays == answer.b else answer.b
        group = next(group for group in groups if moves in group)
        factor = fit.rate if moves == answer.b else 1.0 / fit.rate
        prepared = prepared.paced(group, factor)
        pairs[answer.a, answer.b] = answer
        for (a, b), pair in pairs.items():
            if a in group or b in group:
                plain.pop((a, b), None)
            if (a in group) == (b in group) or pair is answer:
                pairs[a, b] = _paced(pair, *(factor if name in group else 1.0 for name in (a, b)))
            else:
                pairs[a, b] = plain[a, b] = _solve(prepared, (a, b), known)


def _paced(pair: PairSolution, factor_a: float, factor_b: float) -> PairSolution:
    """A pair after its clocks were made to run so many times as fast."""
    if pair.fit is None:
        return pair
    fit = pair.fit
    paced = replace(
        fit, rate=fit.rate * factor_a / factor_b, offset=fit.offset * factor_a, middle=fit.middle * factor_a
    )
    return replace(pair, fit=paced, others=())


def rate_warnings(prepared: Prepared, pairs: list[PairSolution]) -> tuple[str, ...]:
    """One sentence for each camera whose times run far faster or slower than those of most others it is tied to."""
    if not any(abs(pace - 1.0) > FAR_FROM_ONE for pace in prepared.paces.values()):
        return ()
    tied = components(prepared.names, [pair for pair in pairs if pair.solved])[0]
    usual = max(tied, key=lambda name: sum(_alike(prepared, name, other) for other in tied))
    alike = [name for name in tied if _alike(prepared, name, usual)]
    out = []
    for name in tied:
        if name in alike:
            continue
        ratio = prepared.pace(usual) / prepared.pace(name)
        told, actual = _frame_rates(ratio, _rows_a_second(prepared, name))
        if 2 * len(alike) > len(tied):
            doubt = f"the others': were they made with {told} fps for {actual}?"
        else:
            told_usual, actual_usual = _frame_rates(1.0 / ratio, _rows_a_second(prepared, usual))
            doubt = (
                f"{usual}'s: were they made with {told} fps for {actual}, "
                f"or {usual}'s with {told_usual} for {actual_usual}?"
            )
        out.append(f"{name}: its times run {ratio:.4g} times as fast as {doubt}")
    return tuple(out)


def _alike(prepared: Prepared, a: str, b: str) -> bool:
    return abs(prepared.pace(a) / prepared.pace(b) - 1.0) < FAR_FROM_ONE


def _rows_a_second(prepared: Prepared, name: str) -> float:
    """The camera's frame rate as its own times tell it."""
    interval = min(float(np.median(np.diff(track.time))) for track in prepared.camera(name).tracks.values())
    return prepared.pace(name) / interval


def _frame_rates(ratio: float, told: float) -> tuple[str, str]:
    """The frame rate that times were likely made with, and the true one, where they run ``ratio`` times as fast."""
    usual = [(a, b) for a in _FRAME_RATES for b in _FRAME_RATES if abs(b / a / ratio - 1.0) < _SAME_RATIO]
    likely = min(usual, key=lambda pair: abs(pair[0] - told), default=(told, told * ratio))
    return f"{likely[0]:.3g}", f"{likely[1]:.3g}"


def timing_told(name: str, prepared: Prepared, pairs: list[PairSolution]) -> str:
    """What solved pairs say of a camera's clock: "12.3450 s against cam0, …"; "" where none is solved."""
    parts = []
    for pair in pairs:
        if not pair.solved or pair.fit is None or name not in (pair.a, pair.b):
            continue
        lag = pair_lag(prepared, pair, pair.fit)
        parts.append(f"{lag:.4f} s against {pair.b}" if name == pair.a else f"{-lag:.4f} s against {pair.a}")
    return ", ".join(parts)


def pair_lag(prepared: Prepared, pair: PairSolution, fit: PairFit) -> float:
    """``t_a - t_b`` [s] as the cameras' clocks show it, in the middle of the time that both recorded."""
    begin_a, end_a = _span(prepared, pair.a)
    begin_b, end_b = (fit.rate * time + fit.offset for time in _span(prepared, pair.b))
    middle = 0.5 * (max(begin_a, begin_b) + min(end_a, end_b))
    shown_a = prepared.epochs[pair.a] + middle / prepared.pace(pair.a)
    return shown_a - prepared.epochs[pair.b] - (middle - fit.offset) / fit.rate / prepared.pace(pair.b)


def _span(prepared: Prepared, name: str) -> tuple[float, float]:
    tracks = prepared.camera(name).tracks.values()
    return min(float(track.time[0]) for track in tracks), max(float(track.time[-1]) for track in tracks)


__all__ = ["Progress", "pair_lag", "rate_warnings", "solve_pairs", "timing_told"]
