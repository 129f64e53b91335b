"""Scores of a tracker on one car: the estimates of all frames against ground truth.

``out`` is a frame that shows no part of the car, ``in`` one in which its centre lies in the image, occluded or not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edge.uav.base import Estimate, TrackState
from edge.uav.world.flight_world import GroundTruth
from protocols.geometry.types import Bools, Floats

NEAR = 20.0
"""Position error [px] below which an estimate is correct."""
_RUN = 5  # consecutive frames for a re-acquisition, or an identity swap
_WITHIN = 60  # frames after the car is half visible
_HIDDEN = 0.05  # visible share below which the car counts as fully occluded
_GRACE_FRAMES = 2  # first frames of an exit in which the state visible is not counted
_MIN_EXIT_FRAMES = 3  # a shorter absence is no exit
_INSIDE_95 = 2.448  # stds of one coordinate that contain 95 % of an isotropic 2-D Gaussian


@dataclass(slots=True)
class Score:
    """Counts, which add up over several flights.

    Pairs are (count, of total). out_length, out_near: estimates within one car length, 20 px, while out; out_any: the
    estimate or one of the hypotheses within a length. in_near: within 20 px while in. claims_out: reported visible
    while out, from an exit's third frame; says_in: reported visible, at least half visible. claims_hidden: reported
    visible while in and fully occluded. std_95: while out, truth within 2.448 std. reacquired: of exits; delays: frames
    from half visible to re-acquired. swaps: runs on another car. seconds, frames: CPU time of the tracker and number of
    frames.
    """

    out_length: tuple[int, int] = (0, 0)
    out_near: tuple[int, int] = (0, 0)
    out_any: tuple[int, int] = (0, 0)
    in_near: tuple[int, int] = (0, 0)
    claims_out: tuple[int, int] = (0, 0)
    says_in: tuple[int, int] = (0, 0)
    claims_hidden: tuple[int, int] = (0, 0)
    std_95: tuple[int, int] = (0, 0)
    reacquired: tuple[int, int] = (0, 0)
    delays: list[int] = field(default_factory=list)
    swaps: int = 0
    failures: list[str] = field(default_factory=list)
    seconds: float = 0.0
    frames: int = 0

    def add(self, other: Score) -> None:
        """Add the counts of another flight."""
        for name in PAIRS:
            a, b = getattr(self, name), getattr(other, name)
            setattr(self, name, (a[0] + b[0], a[1] + b[1]))
        self.delays += other.delays
        self.failures += other.failures
        self.swaps += other.swaps
        self.seconds += other.seconds
        self.frames += other.frames

    def percent(self, name: str) -> float:
        """A pair as a percentage; nan if the total is 0."""
        good, total = getattr(self, name)
        return 100.0 * good / total if total else float("nan")

    @property
    def delay(self) -> float:
        """Mean frames to re-acquisition; nan where there is none."""
        return float(np.mean(self.delays)) if self.delays else float("nan")

    @property
    def ms(self) -> float:
        """CPU milliseconds a frame."""
        return 1e3 * self.seconds / self.frames if self.frames else float("nan")


PAIRS = (
    "out_length",
    "out_near",
    "out_any",
    "in_near",
    "claims_out",
    "says_in",
    "claims_hidden",
    "std_95",
    "reacquired",
)


def score(truths: Sequence[GroundTruth], estimates: Sequence[Estimate], size: tuple[int, int]) -> Score:
    """Score one flight. truths, estimates: of the same frames; the first one, which is given, is not counted."""
    truths, estimates = truths[1:], estimates[1:]
    true = np.array([(t.x, t.y) for t in truths])
    lost = np.array([e.state == TrackState.LOST for e in estimates])
    guess = np.array([(e.x, e.y) for e in estimates])
    guess[lost] = np.nan
    with np.errstate(invalid="ignore"):
        error = np.hypot(*(guess - true).T)
        error[np.isnan(error)] = np.inf
    out = np.array([t.inside == 0.0 for t in truths])
    within = ((true > -0.5) & (true < np.array(size) - 0.5)).all(axis=1)
    seen = np.array([t.visible for t in truths])
    visible = np.array([e.state == TrackState.VISIBLE for e in estimates])
    length = np.array([t.length for t in truths])
    exits = [run for run in runs(out) if run[1] - run[0] >= _MIN_EXIT_FRAMES]
    settled = np.zeros(len(out), bool)
    for begin, end in exits:
        settled[begin + _GRACE_FRAMES : end] = True
    std = np.array([e.std for e in estimates])
    with np.errstate(invalid="ignore"):
        covered = error < _INSIDE_95 * std
    result = Score(
        out_length=_pair(error < length, out),
        out_near=_pair(error < NEAR, out),
        out_any=_pair(_best_hypothesis_error(true, estimates, error) < length, out),
        in_near=_pair(error < NEAR, within),
        claims_out=_pair(visible, settled),
        says_in=_pair(visible, seen >= 0.5),
        claims_hidden=_pair(visible, within & (seen < _HIDDEN)),
        std_95=_pair(covered, out & ~lost),
    )
    for _, end in exits:
        _count_reacquisition(result, error, seen, end)
    result.swaps = _identity_swaps(truths, guess, error, visible)
    return result


def runs(mask: Bools) -> list[tuple[int, int]]:
    """Start and end (exclusive) of all runs of True."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False]))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _pair(good: Bools, counted: Bools) -> tuple[int, int]:
    return int((good & counted).sum()), int(counted.sum())


def _best_hypothesis_error(true: Floats, estimates: Sequence[Estimate], error: Floats) -> Floats:
    """Smallest error of the estimate and the hypotheses."""
    best = error.copy()
    for k, estimate in enumerate(estimates):
        for hypothesis in estimate.hypotheses:
            best[k] = min(best[k], float(np.hypot(hypothesis.x - true[k, 0], hypothesis.y - true[k, 1])))
    return best


def _count_reacquisition(result: Score, error: Floats, seen: Floats, end: int) -> None:
    """Count one exit that ends at frame ``end``: 20 px for 5 consecutive frames within 60 of half visible."""
    half = np.flatnonzero(seen[end:] >= 0.5)
    if not len(half) or end + half[0] + _RUN > len(error):
        return  # it does not return in this flight: nothing to re-acquire
    first = end + int(half[0])
    good = error < NEAR
    found = next((k for k in range(first, first + _WITHIN) if good[k : k + _RUN].sum() == _RUN), None)
    result.reacquired = result.reacquired[0] + (found is not None), result.reacquired[1] + 1
    if found is not None:
        result.delays.append(found - first)


def _identity_swaps(truths: Sequence[GroundTruth], guess: Floats, error: Floats, visible: Bools) -> int:
    """Number of times it tracked another car for 5 consecutive frames and reported it visible."""
    on_other = np.zeros(len(truths), bool)
    for k, truth in enumerate(truths):
        if visible[k] and error[k] > NEAR and len(truth.others):
            on_other[k] = np.hypot(*(truth.others - guess[k]).T).min() < NEAR
    return sum(end - begin >= _RUN for begin, end in runs(on_other))
