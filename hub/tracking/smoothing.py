"""Tracks of a whole recording: association, smoothing and linking repeated over all scans.

After the tracker has gone forward through a recording, each scan is associated again given the past and the future of
all tracks (a two-filter smoother: Fraser and Potter 1969), and at each boundary between two scans the tracks' pasts are
assigned to the futures that continue them best, which mends exchanged, broken and doubly initiated tracks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from hub.tracking.association.assignment import colour_score, matching_colour_std
from hub.tracking.association.reidentification import EntryExitRates, continuation_scores
from hub.tracking.association.scan import FrameEvidence, associate_jointly
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, STATE_DIM, fused, with_information
from hub.tracking.filter.prediction import (
    continuation_hypotheses,
    fused_predictions,
    log_evidence,
    log_mixture,
    manoeuvre_hypothesis,
    on_floor,
    predict_targets,
    widened_by_evidence,
)
from hub.tracking.filter.target_states import ScanFrame, Targets
from hub.tracking.frame_update import prior_of_births
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats, Ints

ITERATIONS = 7
"""Association, smoothing and linking. What follows a cut is judged one iteration later, so a person who is lost while
somebody else appears beside takes three."""
_WIDTHS = 3
"""Exchanges are tried with so many scans left out, one number an iteration. After them only what is near a changed link
is associated anew."""
_INSIDE, _BESIDE = 0.99, 0.3
"""Existence of a target between its first and its last detection, and one scan before and after."""
_MAX_GAP_S = 6.0
"""Longest time over which a lost track is continued by its motion."""
LOG_ABSENT = -float(np.log(_INSIDE / (1.0 - _INSIDE)))
"""Log odds from unseen scans, below which a track was more probably away than missed by all cameras: it has no place
there, and is cut."""
_LOG_HIDDEN = -5.0
"""Log probability that no camera detects somebody for a while, whatever it should see: one in 150 is behind something
that is not known, or where nobody looks for people."""
_PRESENT = 1.0
"""Log odds by which another link must be better than the present one."""
_IMPOSSIBLE, _CERTAIN = -1e3, 1e3
"""Below and above all log odds of a link."""
_REACH, _DOUBT = 1.5, 2.0
"""Heights within which two tracks are exchanged for the detections' sake, and by how many nats these must not be needed
to: of the exchanges that are right in simulated halls nearly all are within both."""
_REACH_S = 1.5
"""Associations further than this from a change are not tried again: what else is known of a track outweighs it."""
_TRIANGLE = np.triu_indices(STATE_DIM)
_ENTRY = np.zeros((STATE_DIM, STATE_DIM), dtype=np.int64)
"""Of a covariance's entries, which of its upper triangle they are."""
_ENTRY[_TRIANGLE] = _ENTRY.T[_TRIANGLE] = np.arange(len(_TRIANGLE[0]))


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScan:
    """A scan of a recording. now_ns: its reference time. frames: with the numbers of tracks (rows of ``tracks``)."""

    now_ns: int
    frames: tuple[ScanFrame, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedScan:
    """Tracks at the time of a scan. row: (k,) which. mean: (k, 7), from past and future. covariance: (k, 3, 3) of the
    positions. hits: (k,) detections in the scan. odds: (k,) what it adds to the log odds of existence."""

    now_ns: int
    row: Ints
    mean: Floats
    covariance: Floats
    hits: Ints
    odds: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Filtered:
    """States of the tracks ``row`` (k,) at a scan, with its own detections. triangle: (k, 28) of the covariances."""

    row: Ints
    mean: Floats
    triangle: Floats

    def covariance(self, places: Ints) -> Floats:
        """The covariances (m, 7, 7) of some of them."""
        return self.triangle[places][:, _ENTRY]


@dataclass(frozen=True, slots=True, eq=False)
class _ScanEvidence:
    """What a scan's f frames say of the tracks ``row`` (k,).

    column, odds, missed: (f, k + 1) as of `FrameEvidence`, the last of any other track. said: (d, 8, 7) information and
    its vector of the associated detections, frame after frame; where nothing is associated they are zero.
    """

    row: Ints
    column: Ints
    odds: Floats
    missed: Floats
    said: Floats

    @classmethod
    def of(cls, row: Ints, frames: Sequence[FrameEvidence]) -> _ScanEvidence:
        """From that of each frame."""
        column = np.array([[*one.column.tolist(), -1] for one in frames])
        odds, missed = (
            np.array([[*getattr(one, name).tolist(), 0.0] for one in frames]) for name in ("odds", "missed")
        )
        said = [np.hstack([one.information, one.vector[:, None]])[one.column >= 0] for one in frames]
        return cls(row, column, odds, missed, np.concatenate(said))

    def frames(self, row: Ints) -> tuple[FrameEvidence, ...]:
        """That of each frame, of the tracks ``row`` (m,); of others than these nothing is said."""
        places = _places(self.row, row)
        said, parts = self._dense()[places], (self.odds[:, places], self.missed[:, places], self.column[:, places])
        return tuple(
            FrameEvidence(said[:, frame, :STATE_DIM], said[:, frame, STATE_DIM], *each)
            for frame, each in enumerate(zip(*parts, strict=True))
        )

    def total(self, row: Ints) -> tuple[Floats, Floats]:
        """Information (m, 7, 7) and its vector (m, 7) of all frames together, of the tracks ``row`` (m,)."""
        said = self._dense().sum(axis=1)[_places(self.row, row)]
        return said[:, :STATE_DIM], said[:, STATE_DIM]

    def _dense(self) -> Floats:
        """Information and vector (k + 1, f, 8, 7) of each track in each frame."""
        out = np.zeros((*self.column.T.shape, STATE_DIM + 1, STATE_DIM))
        frame, place = np.nonzero(self.column >= 0)
        out[place, frame] = self.said
        return out

    def without(self, row: Ints) -> _ScanEvidence:
        """The same, but nothing of some tracks."""
        gone = np.append(np.isin(self.row, row), False)
        odds, missed = np.where(gone, 0.0, self.odds), np.where(gone, 0.0, self.missed)
        kept = ~gone[np.nonzero(self.column >= 0)[1]]
        return _ScanEvidence(self.row, np.where(gone, -1, self.column), odds, missed, self.said[kept])


class BatchSmoother:
    """Scans, tracks and the evidence between them. tracks: one row a track; linearisation begins at their states."""

    def __init__(
        self,
        scans: Sequence[RecordedScan],
        tracks: Targets,
        states: Sequence[tuple[Ints, Floats, Floats]],
        floor: Floor | None,
        parameters: TrackerParameters,
        colour_variance: float,
    ) -> None:
        self.scans = list(scans)
        self.tracks = tracks
        self.floor, self.parameters = floor, parameters
        self.colour_std = matching_colour_std(colour_variance)
        self.evidence: list[_ScanEvidence] = []
        for scan, (row, mean, covariance) in zip(self.scans, states, strict=True):
            there = replace(tracks.select(row), mean=mean, covariance=covariance)
            found = associate_jointly(scan.frames, there, scan.now_ns, there, parameters.up, self.colour_std, 0)
            self.evidence.append(_ScanEvidence.of(row, found.evidence))
        self._changed = np.ones(len(self.scans), dtype=np.bool_)
        nowhere = np.full((len(tracks), 3), np.nan)
        self._rates = EntryExitRates.of(nowhere, nowhere, np.zeros((0, 3)), 1, parameters.scale.units_per_m)
        self._initial(states)

    def _initial(self, states: Iterable[tuple[Ints, Floats, Floats]]) -> None:
        """A mean of every track at its first state."""
        mean = self.tracks.mean.copy()
        done = np.zeros(len(self.tracks), dtype=np.bool_)
        for row, means, _ in states:
            fresh = ~done[row]
            mean[row[fresh]] = means[fresh]
            done[row] = True
        self.tracks = replace(self.tracks, mean=mean)

    def run(self, iterations: int = ITERATIONS, progress: Callable[[float], None] | None = None) -> list[SmoothedScan]:
        """The smoothed scans after ``iterations`` of association, smoothing and linking."""
        out: list[SmoothedScan] = []
        for number in range(iterations + 1):
            if number:
                self._link(self._cut(out))
            forward, backward = self._filter(1), self._filter(-1)
            if 0 < number < iterations:
                self._rates = self._entry_exit_rates(forward, backward)
                if self._exchange(forward, backward, number):
                    del forward, backward
                    forward, backward = self._filter(1), self._filter(-1)
            out = self._associate(forward, backward, relink=number < iterations)
            del forward, backward
            if number >= _WIDTHS:
                self._changed[:] = False
            if progress is not None:
                progress((number + 1) / (iterations + 1))
        return out

    def _extents(self) -> tuple[Ints, Ints]:
        """First and last scan (n,) in which each track has a detection; first > last = none."""
        n = len(self.tracks)
        first, last = np.full(n, len(self.scans)), np.full(n, -1)
        for index, scan in enumerate(self.scans):
            for one in scan.frames:
                first[one.ids] = np.minimum(first[one.ids], index)
                last[one.ids] = np.maximum(last[one.ids], index)
        return first, last

    def _filter(self, direction: int) -> list[_Filtered]:
        """The filter over all scans, forward (1) or backward in time (-1)."""
        first, last = self._extents()
        empty = first > last
        first, last = np.maximum(first - 1, 0), np.minimum(last + 1, len(self.scans) - 1)
        first[empty] = len(self.scans)
        out: list[_Filtered] = []
        up, units = self.parameters.up, self.parameters.scale.units_per_m
        for index in range(len(self.scans))[::direction]:
            alive = (first <= index) & (index <= last)
            rows = out[-1].row[alive[out[-1].row]] if out else np.zeros(0, dtype=np.int64)
            alive[rows] = False
            rows = np.concatenate([rows, np.flatnonzero(alive)])
            predicted, elapsed = self._predicted(out[-1] if out else None, rows, index, direction)
            said = self.evidence[index].total(rows)
            manoeuvre = manoeuvre_hypothesis(predicted, elapsed, units, up, posture=True)
            widened = widened_by_evidence(predicted, manoeuvre, *said)
            mean, covariance, _ = with_information(predicted.mean, widened, *said)
            out.append(_Filtered(rows, mean, covariance[:, *_TRIANGLE]))
        return out[::direction]

    def _predicted(self, before: _Filtered | None, rows: Ints, index: int, direction: int) -> tuple[Targets, float]:
        """The tracks ``rows`` at a scan from their states at the one before, and the time since [s].

        Of those that have none there, the last ones, nothing is known.
        """
        places = _places(before.row, rows) if before is not None else np.full(len(rows), -1)
        known = int((places >= 0).sum())
        predicted, elapsed = self.tracks.select(rows[:known]), 0.0
        if before is not None:
            elapsed = (self.scans[index].now_ns - self.scans[index - direction].now_ns) / NANOSECONDS
            there = places[:known]
            predicted = replace(predicted, mean=before.mean[there], covariance=before.covariance(there))
            predicted = predict_targets(predicted, elapsed, self.parameters)
            predicted = on_floor(predicted, self.floor, abs(elapsed))
        if known < len(rows):
            births = prior_of_births(self.tracks.select(rows[known:]), self.floor, self.parameters)
            predicted = predicted.concatenate(births)
        return predicted, elapsed

    def _associate(self, forward: list[_Filtered], backward: list[_Filtered], relink: bool) -> list[SmoothedScan]:
        """Every scan associated again, given past and future."""
        first, last = self._extents()
        due, self._changed = self._near_changes(), np.zeros(len(self.scans), dtype=np.bool_)
        out = []
        for index, scan in enumerate(self.scans):
            past, future, since = self._from_both_sides(forward, backward, index)
            _, a, b = np.intersect1d(forward[index].row, backward[index].row, return_indices=True)
            row, past = forward[index].row[a], past.select(a)
            mean, covariance = fused_predictions(
                past, future.select(b), since, self.parameters.scale.units_per_m, self.parameters.up
            )
            inside = (first[row] <= index) & (index <= last[row])
            prior = replace(
                past, mean=mean, covariance=covariance,
                existence=np.where(inside, _INSIDE, _BESIDE), initiation_number=row,
            )  # fmt: skip
            mean, covariance, _ = with_information(mean, covariance, *self.evidence[index].total(row))
            there = replace(prior, mean=mean, covariance=covariance)
            found = associate_jointly(
                scan.frames, there, scan.now_ns, prior, self.parameters.up, self.colour_std,
                2 if relink and due[index] else 0, self.evidence[index].frames(row),
            )  # fmt: skip
            self._changed[index] = found.changed
            self.scans[index] = replace(scan, frames=found.frames)
            self.evidence[index] = _ScanEvidence.of(row, found.evidence)
            mean, spread = found.targets.mean, found.targets.covariance[:, POSITION, POSITION].copy()
            odds = np.asarray(sum(self.evidence[index].odds))[:-1]
            out.append(SmoothedScan(scan.now_ns, row, mean, spread, found.hits, odds))
        means = self.tracks.mean.copy()
        for one in reversed(out):
            means[one.row] = one.mean
        self.tracks = replace(self.tracks, mean=means)
        return out

    def _from_both_sides(
        self, forward: list[_Filtered], backward: list[_Filtered], index: int
    ) -> tuple[Targets, Targets, tuple[float, float]]:
        """The tracks of both lists at a scan, from the scans before and from those after it, and the times between."""
        before, after = forward[index - 1] if index else None, (*backward[index + 1 : index + 2], None)[0]
        past, since = self._predicted(before, forward[index].row, index, 1)
        future, until = self._predicted(after, backward[index].row, index, -1)
        return past, future, (since, -until)

    def _near_changes(self) -> Bools:
        """Which scans (n,) are within ``_REACH_S`` of one whose association or links have changed."""
        times = np.array([scan.now_ns for scan in self.scans])
        changed = times[self._changed]
        if not len(changed):
            return self._changed
        nearest = (
            np.searchsorted(changed, times).clip(1, len(changed) - 1) if len(changed) > 1 else np.zeros_like(times)
        )
        off = np.minimum(np.abs(times - changed[nearest]), np.abs(times - changed[np.maximum(nearest - 1, 0)]))
        return np.asarray(off <= _REACH_S * NANOSECONDS)

    def _cut(self, smoothed: Sequence[SmoothedScan]) -> dict[int, int]:
        """Cut tracks where cameras that should have seen them did not: whoever follows may be somebody else.

        Returns, of each new track, the one that it was cut from.
        """
        before: dict[int, int] = {}
        first, last = self._extents()
        label, count, source = np.arange(len(self.tracks)), len(self.tracks), list(range(len(self.tracks)))
        unseen = np.zeros(len(self.tracks))
        for index, one in enumerate(smoothed):
            hit = one.row[one.hits > 0]
            for track in hit[unseen[hit] < LOG_ABSENT].tolist():
                before[count], label[track] = int(label[track]), count
                source.append(track)
                count += 1
            unseen[hit] = 0.0
            missed = (one.hits == 0) & (first[one.row] < index) & (index < last[one.row])
            unseen[one.row[missed]] += one.odds[missed]
            self._rename(index, label)
        self._select(source)
        return before

    def _exchange(self, forward: list[_Filtered], backward: list[_Filtered], width: int) -> bool:
        """Exchange tracks that continue each other better if the ``width`` scans between are left out; whether any did.

        Where two people meet, the detections of both may be mixed for a while, so that no boundary of two scans shows
        which past belongs to which future: both tracks glide from one to the other. What lies between is associated
        anew. Beyond ``_WIDTHS`` it is one scan, and its detections count.
        """
        first, last = self._extents()
        judged, width = width > _WIDTHS, width if width <= _WIDTHS else 1
        label, untouched = np.arange(len(self.tracks)), 1
        due = self._near_changes()
        for index in range(len(self.scans)):
            new, after = label, index + width
            tracks = np.flatnonzero((first < index) & (after - 1 < last))
            if index >= untouched and len(tracks) > 1 and (due[index] or not judged):
                if judged:
                    follows = self._more_probable_futures(forward, backward, tracks, index)
                else:
                    ends = np.full(len(tracks), index - 1)
                    score = self._link_scores(forward, backward[after], tracks, tracks, ends, after - 1)
                    score = np.maximum(score + np.diag(np.full(len(tracks), _PRESENT)), _IMPOSSIBLE)
                    _, follows = linear_sum_assignment(-score)
                heads, tails = tracks[moved := follows != np.arange(len(tracks))], tracks[follows[moved]]
                if len(heads) and (judged or score[moved, follows[moved]].min() > _IMPOSSIBLE):
                    new = label.copy()
                    new[tails] = label[heads]
                    for between in range(index, after):
                        self._forget(between, heads)
                    untouched = after + 1
            self._rename(index, label)
            label = new
        return untouched > 1

    def _more_probable_futures(
        self, forward: list[_Filtered], backward: list[_Filtered], tracks: Ints, index: int
    ) -> Ints:
        """Whose future (n,) each track gets, so that the detections of a scan and what is around it are most probable.

        Where two tracks are exchanged, each camera's detections of them in the scan are whose they then more probably
        are: judged by the past of the one and the future of the other, with and without a manoeuvre.
        """
        follows = np.arange(len(tracks))
        past, future, since = self._from_both_sides(forward, backward, index)
        before = past.select(_places(forward[index].row, tracks))
        after = future.select(_places(backward[index].row, tracks))
        off = np.linalg.norm(before.mean[:, None, POSITION] - before.mean[None, :, POSITION], axis=2)
        near = (off < _REACH * np.exp(before.mean[:, LOG_SIZE])) & (before.kind[:, None] == before.kind)
        i, j = np.nonzero(np.triu(near, 1))
        how = since, self.parameters.scale.units_per_m, self.parameters.up
        heads, tails = np.stack([i, j, i, j]), np.stack([i, j, j, i])  # rows: as they are, and exchanged
        fit, _, odds = continuation_hypotheses(before.select(heads.ravel()), after.select(tails.ravel()), *how)
        kept = np.array([1, 1, -1, -1]) @ log_mixture(odds, *fit).reshape(4, -1) < _DOUBT
        heads, tails, m = heads[:, kept], tails[:, kept], int(kept.sum())
        if not m:
            return follows
        one, other = before.select(heads.ravel()), after.select(tails.ravel())
        fit, covariances, odds = continuation_hypotheses(one, other, *how)
        mean, covariance = fused_predictions(before.select(heads[2:].ravel()), after.select(tails[2:].ravel()), *how)
        missed, vector = np.zeros((4, m)), np.zeros((4, m, STATE_DIM))
        information = np.zeros((4, m, STATE_DIM, STATE_DIM))
        for frame in self.evidence[index].frames(tracks):
            keep, change = (
                log_evidence(mean, covariance, frame.information[owner.ravel()], frame.vector[owner.ravel()])
                + np.where(frame.column[owner] < 0, frame.missed[heads[2:]], 0.0).ravel()
                for owner in (heads[2:], heads[:1:-1])
            )
            moved = (change - keep).reshape(2, m).sum(axis=0) > 0.0
            owner = np.concatenate([heads[:2], np.where(moved, heads[:1:-1], heads[2:])])
            information += frame.information[owner]
            vector += frame.vector[owner]
            missed += np.where(frame.column[owner] < 0, frame.missed[heads], 0.0)
        measured = information.reshape(-1, STATE_DIM, STATE_DIM), vector.reshape(-1, STATE_DIM)
        for k, (a, b) in enumerate(covariances):
            fit[k] += log_evidence(*fused(one.mean, a, other.mean, b), *measured)
        gain = np.array([-1, -1, 1, 1]) @ (log_mixture(odds, *fit).reshape(4, m) + missed)
        colours = before.colour[heads[:2]]
        gain += 2.0 * np.minimum(colour_score(colours[0], colours[1], self.colour_std), 0.0)
        for k in np.argsort(-gain).tolist():
            pair = heads[:2, k]
            if gain[k] > _PRESENT and (follows[pair] == pair).all():
                follows[pair] = pair[::-1]
        return follows

    def _forget(self, index: int, rows: Ints) -> None:
        """Leave a scan's detections of some tracks to be associated anew."""
        scan = self.scans[index]
        frames = tuple(
            replace(one, ids=one.ids[kept := ~np.isin(one.ids, rows)], column=one.column[kept]) for one in scan.frames
        )
        self.scans[index] = replace(scan, frames=frames)
        self.evidence[index] = self.evidence[index].without(rows)
        self._changed[index] = True

    def _rename(self, index: int, names: Ints) -> None:
        scan, found = self.scans[index], self.evidence[index]
        if np.array_equal(names[found.row], found.row):
            return
        frames = tuple(replace(one, ids=names[one.ids]) for one in scan.frames)
        self.scans[index] = replace(scan, frames=frames)
        self.evidence[index] = replace(found, row=names[found.row])

    def _select(self, source: list[int]) -> None:
        """Tracks with the states of others."""
        tracks = self.tracks.select(np.array(source, dtype=np.int64))
        self.tracks = replace(tracks, initiation_number=np.arange(len(source)))

    def _link(self, before: dict[int, int]) -> None:
        """The tracks' pasts assigned to the futures that continue them best, at every boundary of two scans.

        before: of tracks that were cut just now, what they were cut from: linked again, they have not changed.
        """
        forward, backward = self._filter(1), self._filter(-1)
        self._rates = self._entry_exit_rates(forward, backward)
        first, last = self._extents()
        n = len(self.tracks)
        label, count, source = np.arange(n), n, list(range(n))
        lost: list[tuple[int, int, int]] = []  # pasts without a future: track, scan of its last detection, label
        missed, cut = np.zeros(n), np.zeros(n, dtype=np.bool_)
        for index in range(len(self.scans)):
            missed[self.evidence[index].row] = np.asarray(sum(self.evidence[index].missed))[:-1]
            if index + 1 == len(self.scans):
                self._rename(index, label)
                break
            oldest = self.scans[index + 1].now_ns - _MAX_GAP_S * NANOSECONDS
            alive = (first <= index) & (index < last)
            tails = np.flatnonzero((first <= index + 1) & (index + 1 <= last))
            lost += [(track, index, int(label[track])) for track in np.flatnonzero(last == index).tolist()]
            lost = [one for one in lost if self.scans[one[1]].now_ns >= oldest]
            # A track may be lost and alive: where it was cut, its row holds one person's past and another's present.
            pasts = [(track, index, int(label[track])) for track in np.flatnonzero(alive).tolist()] + lost
            new, present = label.copy(), len(pasts) - len(lost)
            if pasts and len(tails):
                heads, ends = np.array([one[:2] for one in pasts]).T
                score = self._link_scores(forward, backward[index + 1], heads, tails, ends, index)
                score += np.maximum((index - ends) * missed[heads], _LOG_HIDDEN)[:, None]
                own = heads[:present, None] == tails
                score[:present] += _PRESENT * own
                # The states of a track that was cut still hold who was before: the next iteration judges the rest.
                done = cut[heads[:present]]
                score[:present][done] = np.where(own[done], _CERTAIN, -np.inf)
                a, b = linear_sum_assignment(np.where(score > 0.0, -score, 0.0))
                follows = {int(j): int(i) for i, j in zip(a, b, strict=True) if score[i, j] > 0.0}
                for j, tail in enumerate(tails.tolist()):
                    head = follows.get(j)
                    if alive[tail] and (head is None or pasts[head][:2] != (tail, index)):
                        self._changed[index], cut[tail] = True, True
                    if head is not None:
                        new[tail] = pasts[head][2]
                    elif alive[tail]:  # its past goes on elsewhere, or ends
                        new[tail] = count
                        source.append(tail)
                        count += 1
                lost = [one for i, one in enumerate(pasts) if i not in set(follows.values())]
            for tail in np.flatnonzero(first == index + 1).tolist():
                self._changed[index + 1] |= tail in before and new[tail] != label[before[tail]]
            self._rename(index, label)
            label = new
        self._select(source)

    def _entry_exit_rates(self, forward: list[_Filtered], backward: list[_Filtered]) -> EntryExitRates:
        """Where the tracks begin and end; the recording's own ends are none of theirs."""
        first, last = self._extents()
        starts, ends, visits = np.full((len(first), 3), np.nan), np.full((len(first), 3), np.nan), []
        for index, (past, future) in enumerate(zip(forward, backward, strict=True)):
            visits.append(past.mean[(first[past.row] <= index) & (index <= last[past.row])][:, POSITION])
            begun, ended = first[future.row] == index, last[past.row] == index
            if index > 0:
                starts[future.row[begun]] = future.mean[begun][:, POSITION]
            if index + 1 < len(self.scans):
                ends[past.row[ended]] = past.mean[ended][:, POSITION]
        units = self.parameters.scale.units_per_m
        return EntryExitRates.of(starts, ends, np.concatenate(visits), len(self.scans), units)

    def _link_scores(
        self, forward: list[_Filtered], after: _Filtered, heads: Ints, tails: Ints, ends: Ints, index: int
    ) -> Floats:
        """Log odds (h, t) of tail t, at the scan after ``index``, continuing head h, last seen in scan ends[h]."""
        scan = self.scans[index + 1]
        past = self.tracks.select(heads)
        mean, covariance = past.mean.copy(), past.covariance.copy()
        for at in np.unique(ends).tolist():
            rows = _places(forward[at].row, heads[chosen := ends == at])
            mean[chosen], covariance[chosen] = forward[at].mean[rows], forward[at].covariance(rows)
        ended = np.array([self.scans[at].now_ns for at in ends.tolist()], dtype=np.int64)
        gap, ahead = (self.scans[index].now_ns - ended) / NANOSECONDS, (scan.now_ns - ended) / NANOSECONDS
        seen = mean[:, POSITION]
        past = predict_targets(replace(past, mean=mean, covariance=covariance), ahead, self.parameters)
        past = on_floor(past, self.floor, ahead)
        rows = _places(after.row, tails)
        future = replace(self.tracks.select(tails), mean=after.mean[rows], covariance=after.covariance(rows))
        typical = float(np.median(self.tracks.mean[:, LOG_SIZE]))
        units = self.parameters.scale.units_per_m
        manoeuvre = manoeuvre_hypothesis(past, ahead, units, self.parameters.up, posture=True)
        rates = self._rates.log_exit(heads, seen), self._rates.log_entry(tails, future.mean[:, POSITION])
        return continuation_scores(past, future, manoeuvre, gap, rates, units, typical, self.colour_std)


def _places(rows: Ints, wanted: Ints) -> Ints:
    """Where each of ``wanted`` is in ``rows``, -1 = nowhere."""
    place = {track: at for at, track in enumerate(rows.tolist())}
    return np.array([place.get(track, -1) for track in wanted.tolist()], dtype=np.int64)
