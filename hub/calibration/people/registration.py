"""Where cameras stand to each other on the ground, from unlabelled people: rigid registration of points in the plane.

Two people seen at one time by two cameras give a rotation and a shift between their ground planes. Hypotheses of all
instants vote (a generalised Hough transform), and the best are verified by how many people of both cameras meet. Where
clocks are independent, this is done for each lag of a grid.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from protocols.geometry.types import Floats, Ints

_INTERVAL_S = 0.4  # between instants: in less nobody moves out of their place
_MOST_INSTANTS = 150  # spread over what two recordings have in common at a lag
_HYPOTHESES = 20_000  # of one lag; of many lags a fifth each, which votes as clearly (seven real cameras, 21 pairs)
_MOST_PAIRS = 400  # of people in one frame, of each camera: all of 20 people; their product is held in memory
_MOST_LAGS, _COARSE_INSTANTS, _COARSE = 120, 40, 1_000  # lags that are tried in full, after a coarse search of more
_APART = 2.0  # heights that two people are apart, at least: nearer ones say little of a rotation
_ALIKE, _ALIKE_RELATIVE = 0.1, 0.12  # heights, and share, by which a distance may differ between two cameras
_LEVER = 5.0  # heights at which a difference of angles counts as one of places: half across what a camera sees well
_VOTE_RADIUS = 0.6  # heights
_PEAKS = 6  # places in the vote that are verified, of each lag
_MEETS = 0.35  # heights between two cameras' places of one person, who takes half of it
_LAG_STEP_S = 0.5  # in which a walker goes half a height: twice as far as two places of one person differ
_FINE_LAG_S = 0.05  # s; 7 cm of a walker's way, of which the adjustment finds the rest
_LONGEST_SPAN_S, _STEP = 0.6, 1.0  # between frames of a camera, and heights that somebody moves in it
_CLOSE = 0.15  # heights, std of a place from one frame's box
_SHARED_REACH_S, _SHARED_STEP_S, _FAR_CLOSER = 2.0, 0.1, 1.3
"""Lags at which cameras on a shared clock are tried, and how much closer people must be there. Right ones are 1.5 times
closer at 0 than at 0.3 s; of cameras 0.3 and 1 s apart people are 1.7 and 3.3 times closer at their lag than at 0."""
_SAME_S, _SAME_PLACE = 3.0, 3.0  # s, heights within which two solutions are one: four steps of a walker
_MIN_MEETINGS, _MIN_RATIO = 30, 1.5
"""Meetings of people, and their number over that of the best other solution. Of 21 pairs of seven real cameras with
spoilt boxes the 19 right ones have ratios of 2.2 and more, and the two pairs that hardly share a view, whose best
solutions are wrong, 1.1."""


@dataclass(frozen=True, slots=True, eq=False)
class GroundPoints:
    """Who stands where, by frame. time: (n,) [s], ascending, on the camera's clock. places: n arrays (k, 2). instants:
    frames with two people or more, an interval apart."""

    time: Floats
    places: list[Floats]
    instants: Ints = field(init=False)

    def __post_init__(self) -> None:
        index = np.flatnonzero([len(one) >= 2 for one in self.places])
        slot = np.floor((self.time[index] - self.time[index[:1]]) / _INTERVAL_S + 1e-6)
        object.__setattr__(self, "instants", index[np.unique(slot, return_index=True)[1]])


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Places of b in the axes of a: ``R(angle) x + shift`` [heights]; t_a = t_b + lag. meetings: of people of both.
    rivals: meetings of the best other solution."""

    angle: float
    shift: Floats
    lag: float
    meetings: int
    rivals: int = 0

    @property
    def accepted(self) -> bool:
        """Whether no other solution explains nearly as many meetings."""
        return self.meetings >= _MIN_MEETINGS and self.meetings >= _MIN_RATIO * self.rivals

    @property
    def matrix(self) -> Floats:
        """The rotation (2, 2)."""
        return rotation(self.angle)

    def inverse(self) -> Registration:
        """Places of a in the axes of b."""
        return replace(self, angle=-self.angle, shift=-self.matrix.T @ self.shift, lag=-self.lag)

    def after(self, other: Registration) -> Registration:
        """``other`` is of the axes in which b's places are wanted, and of a's in them."""
        return replace(
            self,
            angle=other.angle + self.angle,
            shift=other.matrix @ self.shift + other.shift,
            lag=other.lag + self.lag,
        )


def rotation(angle: float) -> Floats:
    """Rotation (2, 2) by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def lag_grid(a: GroundPoints, b: GroundPoints, common_s: float) -> Floats:
    """Lags at which two recordings have ``common_s`` seconds in common."""
    first, last = a.time[0] - b.time[-1] + common_s, a.time[-1] - b.time[0] - common_s
    middle = 0.5 * (first + last)
    half = max(0.5 * (last - first), 0.0)
    count = int(half / _LAG_STEP_S)
    return np.asarray(middle + _LAG_STEP_S * np.arange(-count, count + 1))


def register(a: GroundPoints, b: GroundPoints, lags: Floats, rng: np.random.Generator) -> Registration | None:
    """The registration of b to a in which most people meet; None where no two people were seen at one time.

    lags: that are tried. rng: picks hypotheses.
    """
    if len(lags) > _MOST_LAGS:  # of a long recording: few instants and hypotheses tell the likely ones
        few = [_at_lag(a, b, lag, _COARSE, rng, _COARSE_INSTANTS) for lag in lags.tolist()]
        most = [max((one.meetings for one in found), default=0) for found in few]
        lags = lags[np.sort(np.argsort(most, kind="stable")[-_MOST_LAGS:])]
    budget = _HYPOTHESES if len(lags) == 1 else _HYPOTHESES // 5
    solutions = [one for lag in lags.tolist() for one in _at_lag(a, b, lag, budget, rng)]
    if not solutions:
        return None
    best = _refined(a, b, max(solutions, key=lambda one: one.meetings))
    best = _with_fine_lag(a, b, best) if len(lags) > 1 else _off_the_shared_clock(a, b, best)
    rivals = max((one.meetings for one in solutions if not _same(one, best)), default=0)
    return replace(best, rivals=rivals)


def _with_fine_lag(a: GroundPoints, b: GroundPoints, found: Registration) -> Registration:
    """The lag at which people meet best, with b's places between its frames."""
    for _ in range(2):
        steps = round(_LAG_STEP_S / _FINE_LAG_S)
        lags = found.lag + _FINE_LAG_S * np.arange(-steps, steps + 1)
        trials = [_refined(a, b, replace(found, lag=float(lag))) for lag in lags]
        found = max(trials, key=lambda one: _closeness(a, b, one))
    return found


def _off_the_shared_clock(a: GroundPoints, b: GroundPoints, found: Registration) -> Registration:
    """The same, or at another lag if people meet far better there than at the one lag that was tried."""
    steps = round(_SHARED_REACH_S / _SHARED_STEP_S)
    lags = found.lag + _SHARED_STEP_S * np.arange(-steps, steps + 1)
    best = max((_refined(a, b, replace(found, lag=float(lag))) for lag in lags), key=lambda one: _closeness(a, b, one))
    return best if _closeness(a, b, best) > _FAR_CLOSER * _closeness(a, b, found) else found


def _closeness(a: GroundPoints, b: GroundPoints, found: Registration) -> float:
    """How near people meet: each counts by a normal density with a std of `_CLOSE`."""
    p, q = _meetings(_common(a, b, found.lag), found)
    apart = np.linalg.norm(p - q @ found.matrix.T - found.shift, axis=1)
    return float(np.exp(-0.5 * (apart / _CLOSE) ** 2).sum())


def _same(one: Registration, other: Registration) -> bool:
    turned = _LEVER * abs(2.0 * np.sin(0.5 * (one.angle - other.angle)))
    near = float(np.linalg.norm(one.shift - other.shift)) + turned < _SAME_PLACE
    return near and abs(one.lag - other.lag) < _SAME_S


def _common(a: GroundPoints, b: GroundPoints, lag: float, most: int = _MOST_INSTANTS) -> list[tuple[Floats, Floats]]:
    """Places of both cameras at instants of a, b's between its frames; ``most`` instants of all that they share."""
    wanted = a.time[a.instants] - lag
    if len(b.time) < 2:
        return []
    inside = np.flatnonzero((wanted >= b.time[0]) & (wanted <= b.time[-1]))
    inside = inside[np.unique(np.linspace(0, len(inside) - 1, min(len(inside), most)).round().astype(np.int64))]
    after = np.searchsorted(b.time, wanted[inside]).clip(1, len(b.time) - 1)
    out = []
    for i, j, time in zip(a.instants[inside].tolist(), after.tolist(), wanted[inside].tolist(), strict=True):
        span, before = b.time[j] - b.time[j - 1], time - b.time[j - 1]
        if span > _LONGEST_SPAN_S and min(before, span - before) > _FINE_LAG_S:
            continue
        if len(places := _between(b.places[j - 1], b.places[j], before / span)):
            out.append((a.places[i], places))
    return out


def _between(first: Floats, second: Floats, share: float) -> Floats:
    """Places (n, 2) at a share of the time between two frames: of those who are in both, between; of others there."""
    nearer, other, share = (first, second, share) if share < 0.5 else (second, first, 1.0 - share)
    if not len(other) or not len(nearer):
        return nearer
    apart = np.hypot(nearer[:, None, 0] - other[:, 0], nearer[:, None, 1] - other[:, 1])
    nearest, rows = apart.argmin(axis=1), np.arange(len(nearer))
    same = (apart[rows, nearest] < _STEP) & (apart.argmin(axis=0)[nearest] == rows)
    return np.where(same[:, None], nearer + share * (other[nearest] - nearer), nearer)


def _at_lag(
    a: GroundPoints, b: GroundPoints, lag: float, budget: int, rng: np.random.Generator, instants: int = _MOST_INSTANTS
) -> list[Registration]:
    """The best-voted registrations at one lag, with their meetings."""
    from scipy.spatial import cKDTree

    common = _common(a, b, lag, instants)
    if not common:
        return []
    parts = [_hypotheses(p, q, max(budget // len(common), 1), rng) for p, q in common if len(q) >= 2]
    found = np.concatenate([np.zeros((0, 3)), *parts])
    if not len(found):
        return []
    middle = np.concatenate([q for _, q in common]).mean(axis=0)
    turned = np.cos(found[:, 0]), np.sin(found[:, 0])
    moved = np.column_stack(
        [turned[0] * middle[0] - turned[1] * middle[1], turned[1] * middle[0] + turned[0] * middle[1]]
    )
    votes = np.column_stack([moved + found[:, 1:], _LEVER * turned[0], _LEVER * turned[1]])
    tree = cKDTree(votes)
    count = np.asarray(tree.query_ball_point(votes, _VOTE_RADIUS, return_length=True))
    out: list[Registration] = []
    for i in np.argsort(-count, kind="stable").tolist():
        if any(np.linalg.norm(votes[i, :2] - one.matrix @ middle - one.shift) < 2.5 * _VOTE_RADIUS for one in out):
            continue
        near = votes[tree.query_ball_point(votes[i], _VOTE_RADIUS)]
        angle = float(np.arctan2(near[:, 3].sum(), near[:, 2].sum()))
        shift = np.median(near[:, :2], axis=0) - rotation(angle) @ middle
        out.append(Registration(angle, shift, lag, 0))
        if len(out) == _PEAKS:
            break
    return [replace(one, meetings=len(_meetings(common, one)[0])) for one in out]


def _hypotheses(p: Floats, q: Floats, most: int, rng: np.random.Generator) -> Floats:
    """Angle and shift (n, 3) by two people of p (k, 2) who are as far apart as two of q (m, 2)."""
    pairs = np.argwhere(~np.eye(len(p), dtype=np.bool_))
    others = np.argwhere(np.triu(np.ones((len(q), len(q)), dtype=np.bool_), 1))
    if len(pairs) > _MOST_PAIRS:
        pairs = rng.permutation(pairs)[:_MOST_PAIRS]
    if len(others) > _MOST_PAIRS:
        others = rng.permutation(others)[:_MOST_PAIRS]
    first, second = p[pairs[:, 1]] - p[pairs[:, 0]], q[others[:, 1]] - q[others[:, 0]]
    far, other = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    alike = np.abs(far[:, None] - other) < _ALIKE + _ALIKE_RELATIVE * other
    i, j = np.nonzero(alike & (other > _APART))
    if len(i) > most:
        chosen = rng.choice(len(i), most, replace=False)
        i, j = i[chosen], j[chosen]
    angle = np.arctan2(first[i, 1], first[i, 0]) - np.arctan2(second[j, 1], second[j, 0])
    centre, mean = 0.5 * (p[pairs[i, 0]] + p[pairs[i, 1]]), 0.5 * (q[others[j, 0]] + q[others[j, 1]])
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([
        angle, centre[:, 0] - c * mean[:, 0] + s * mean[:, 1], centre[:, 1] - s * mean[:, 0] - c * mean[:, 1]
    ])  # fmt: skip


def _meetings(common: list[tuple[Floats, Floats]], found: Registration) -> tuple[Floats, Floats]:
    """Places (n, 2) of a and of b, in their own axes, of people who are each other's nearest and meet."""
    ours, theirs = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for p, q in common:
        moved = q @ found.matrix.T + found.shift
        apart = np.hypot(p[:, None, 0] - moved[:, 0], p[:, None, 1] - moved[:, 1])
        nearest, rows = apart.argmin(axis=1), np.arange(len(p))
        good = (apart[rows, nearest] < _MEETS) & (apart.argmin(axis=0)[nearest] == rows)
        ours.append(p[good])
        theirs.append(q[nearest[good]])
    return np.concatenate(ours), np.concatenate(theirs)


def _refined(a: GroundPoints, b: GroundPoints, found: Registration) -> Registration:
    """The registration by all meetings (Procrustes), at its lag."""
    common = _common(a, b, found.lag)
    for _ in range(3):
        p, q = _meetings(common, found)
        if len(p) < 2:
            return replace(found, meetings=len(p))
        centre, middle = p.mean(axis=0), q.mean(axis=0)
        x, y = (p - centre).T, (q - middle).T
        angle = float(np.arctan2((x[1] * y[0] - x[0] * y[1]).sum(), (x[0] * y[0] + x[1] * y[1]).sum()))
        found = replace(found, angle=angle, shift=centre - rotation(angle) @ middle)
    return replace(found, meetings=len(_meetings(common, found)[0]))
