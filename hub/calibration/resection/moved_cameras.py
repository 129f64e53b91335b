"""Cameras that were moved during a recording: their rows on one side of that are left out.

A camera was moved where, at one and the same lag, its rows before and after some time each have a pose that explains
them, and both poses by far more than one does: a wrong lag or lens and a clock that steps are no better off with two.
Of a camera that was moved several times the same holds for all parts between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hub.bundle.initialisation import CameraInput, Reconstruction, triangulate_and_adjust
from hub.bundle.preprocessing import PreparedSession
from hub.bundle.residuals import residual_norms
from hub.calibration.resection.scan import (
    LIKELY_CANDIDATES,
    MIN_CANDIDATE_RATIO,
    MIN_INLIERS,
    MIN_POINTS,
    TRUNCATION_PX,
    SeenLabel,
    along_path,
    common_rows,
    moment_scan,
    path_moments,
    resect,
    resected_residuals,
    seen_labels,
    verify,
)
from hub.calibration.solvers import Solution
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from protocols.session.observations import Observations

STARTS, _ITERATIONS = (0.25, 0.5, 0.75), 5
"""Shares of the rows at which the division begins; then it goes where the two poses say, until it stays."""
_LEAST_PX = 2.0
"""Rms residual [px] that one pose leaves beyond two. Cameras that stand still gain 1.01 to 1.05 (simulated, also with
lenses 20 % off, clocks that step, wander or drift), and on two recorded rigs, whose lenses are 2 % off and whose
detectors wander, up to 3.2 at 1 px, 2.5 at 2.1 px and 1.4 at 2.2 px; a turn by one degree gains 20 at 8 px."""
_LEAST_S = 1.0  # on each side of a move: half a second of a path gave a pose that was 22° off
LEAST_ROWS, _MOST_ROWS = 30, 400
"""Rows of a camera on each side of a move, as many as a camera of a network needs; of all, and of the ends, about as
many are used, at most twice."""
_SUSPECTS = 4
"""Of a network, cameras without which the others are tried: whose costs change most, and those with most rows, whose
own may change least, as the path follows them."""
_END_S = 4.0
"""Of the ends more rows are used, each counting less: of 150 s evenly spaced, those of a side lasted 4 to 7 s."""
_MOST_MOVES, _WINDOWS = 3, (2, 4)
"""Moves of one camera that are looked for in a recording, and in how many parts of its rows its lag is looked for: of
four at least one is without any of three moves."""
_MARGIN_S = 0.3
"""Around a move, left out too: nobody moves a camera in an instant, and the rows were smoothed across it."""


@dataclass(frozen=True, slots=True)
class Move:
    """Moves of a camera at ``times`` [s] on its clock, by angles of ``turned`` [rad]. part: of the parts between them,
    the one that is used; rows: how many are left out."""

    times: tuple[float, ...]
    turned: tuple[float, ...]
    part: int
    rows: int

    @property
    def span(self) -> tuple[float, float]:
        """Begin and end of the part that is used, infinite where no move bounds it."""
        bounds = (-np.inf, *self.times, np.inf)
        return bounds[self.part], bounds[self.part + 1]

    def warning(self, name: str, *others: str) -> str:
        """One sentence for a person. others: it was moved or one of these, and by what angle is not known."""
        side = "before" if self.part else "after"
        if others:
            who = f"one of {', '.join((name, *others))} was moved at {name}'s time {self.times[0]:.1f} s"
            return f"{who}: the {self.rows} rows {side} that were left out"
        angles = " and ".join(f"{np.degrees(angle):.2g}°" for angle in self.turned)
        when = " and ".join(f"{time:.1f}" for time in self.times)
        who = f"{name}: it was moved (turned by about {angles}) at its time {when} s"
        bounds = zip(("before", "after"), self.span, strict=True)
        left_out = " and ".join(f"{word} {time:.1f} s" for word, time in bounds if np.isfinite(time))
        where = f"{side} that" if len(self.times) == 1 else left_out
        return f"{who}: its {self.rows} rows {where} were left out"


class Division(NamedTuple):
    """Moves of a camera: by how much the cost of one pose is more than that of all of them, the times [s since the
    origin of its track] that divide its rows, and the angles [rad] between the poses on either side of each."""

    gain: float
    times: tuple[float, ...]
    turned: tuple[float, ...]


def moved_cameras(solution: Solution, observations: Observations) -> dict[str, Move]:
    """The refused cameras that were moved, and of the others the one that most probably was."""
    reconstruction, prepared = solution.reconstruction, solution.prepared
    divisions: dict[str, Division] = {}
    for name in [name for name in prepared.cameras if name not in reconstruction.names]:
        labels = seen_labels(prepared.cameras[name], reconstruction)
        maps = _likely_maps(labels, prepared.cameras[name]) if labels and len(reconstruction.names) > 1 else []
        found = max(
            (one for at in maps if (one := _divide(labels, prepared.cameras[name], *at, _MOST_MOVES))), default=None
        )
        divisions |= {} if found is None else {name: found}
    placed = moved_camera(prepared, reconstruction)
    divisions |= {} if placed is None else {placed[0]: placed[1]}
    return {
        name: _longest_part(
            np.array(found.times) / prepared.time_scale(name) + prepared.time_origins[name],
            found.turned,
            np.concatenate([track.time for track in observations.of_camera(name)]),
        )
        for name, found in divisions.items()
    }


def _longest_part(moved: Floats, turned: tuple[float, ...], rows: Floats) -> Move:
    """The moves, of which the part with most rows is used.

    moved: times (k,) of the moves; turned: by what angles; rows: times (n,) of all rows.
    """
    parts = np.diff(np.searchsorted(np.sort(rows), moved), prepend=0, append=len(rows))
    longest = int(parts.argmax())
    return Move(tuple(moved.tolist()), turned, longest, int(parts.sum() - parts[longest]))


def moved_camera(prepared: PreparedSession, reconstruction: Reconstruction) -> tuple[str, Division] | None:
    """Of the placed cameras the one that most probably was moved, which distorts the path for all. None where none was,
    or where fewer than two others are placed.

    One move is looked for: three explained the wrong lenses of a real rig whose cameras stood still.

    It is the one without which the others fit best. The path may follow it, where it has the most frames, and then the
    others seem to have been moved: of two of those, one that was moved before fits the path of those left no better.
    """
    if len(reconstruction.names) < 3:
        return None
    changes = {name: _cost_change(_costs(reconstruction, name)) for name in reconstruction.names}
    if max(changes.values()) >= _LEAST_PX**2:
        likely = _best_without(prepared, reconstruction, changes)
        found = None if likely is None else _division(prepared, reconstruction, *likely)
        if likely is not None and found is not None:
            return likely[0], found
    divided = {name: _division(prepared, reconstruction, name, reconstruction) for name in reconstruction.names}
    return max(((name, one) for name, one in divided.items() if one), key=lambda one: one[1], default=None)


def _best_without(
    prepared: PreparedSession, reconstruction: Reconstruction, changes: Mapping[str, float]
) -> tuple[str, Reconstruction] | None:
    """The camera without which the others fit best, and the reconstruction of those; None where none can be left out.

    A camera fits by how much more it costs than in the best of all these reconstructions: with many false detections it
    costs most, wherever it stands. changes: by how much each camera's cost changes [px²].
    """
    rows = {name: sum(len(part.time) for part in prepared.rows[name]) for name in changes}
    suspects = {name: None for by in (changes, rows) for name in sorted(by, key=by.__getitem__)[-_SUSPECTS:]}
    rest = {name: found for name in suspects if (found := _without(prepared, reconstruction, name)) is not None}
    costs = {
        left_out: {name: float(_costs(one, name).mean()) for name in one.names}
        for left_out, one in (("", reconstruction), *rest.items())
    }
    least = {name: min(one[name] for one in costs.values() if name in one) for name in changes}
    excess = {name: sum(cost - least[other] for other, cost in costs[name].items()) for name in rest}
    best = min(excess, key=excess.__getitem__, default=None)
    return None if best is None else (best, rest[best])


def _costs(reconstruction: Reconstruction, name: str) -> Floats:
    """What a camera's rows (n,) on the paths cost [px²], in the order of their times; rejected ones count."""
    number, paths = reconstruction.names.index(name), reconstruction.state.trajectories
    parts = reconstruction.problem.of_camera(number)
    times = np.concatenate([np.zeros(0), *(part.time for part in parts)])
    norms = (residual_norms(part, reconstruction.state.cameras[number], paths[part.label]) for part in parts)
    costs = np.minimum(np.concatenate([np.zeros(0), *norms])[np.argsort(times, kind="stable")], TRUNCATION_PX) ** 2
    known = ~np.isnan(costs)
    return costs[known] if known.any() else np.full(1, TRUNCATION_PX**2)


def _cost_change(costs: Floats) -> float:
    """By how much the mean of a camera's costs changes [px²] where it changes most."""
    at = int(likely_division(costs) * len(costs))
    return abs(float(costs[:at].mean() - costs[at:].mean())) if LEAST_ROWS <= at <= len(costs) - LEAST_ROWS else 0.0


def _without(prepared: PreparedSession, reconstruction: Reconstruction, name: str) -> Reconstruction | None:
    """The reconstruction of the other placed cameras, adjusted without one; None where they see no path."""
    placed = dict(zip(reconstruction.names, reconstruction.state.cameras, strict=True))
    del placed[name]
    cameras = {other: prepared.cameras[other] for other in prepared.cameras if other in placed}
    first, second, *_ = cameras
    free = reconstruction.problem.free_parameters
    try:
        return triangulate_and_adjust(cameras, placed, prepared.rows, prepared.labels, (first, second), free)
    except Refused:
        return None


def _division(
    prepared: PreparedSession, reconstruction: Reconstruction, name: str, paths: Reconstruction
) -> Division | None:
    """As `_divide`: of a placed camera, against the paths of a reconstruction with or without it."""
    given, clock = prepared.cameras[name], reconstruction.state.cameras[reconstruction.names.index(name)]
    lens, labels = clock.intrinsics, seen_labels(given, paths)
    if lens is not given.intrinsics:  # it was estimated, and the tracks are in coordinates of the given one
        rays = [lens.unproject(given.intrinsics.project_normalised(one.track.points)) for one in labels]
        labels = [replace(one, track=replace(one.track, points=ray)) for one, ray in zip(labels, rays, strict=True)]
    offset = clock.offset - clock.rate * clock.centre
    return _divide(labels, replace(given, intrinsics=lens), clock.rate, offset, 1) if labels else None


def without_moved(observations: Observations, moves: Mapping[str, Move]) -> Observations:
    """The observations of which those of moved cameras are from the part that is used."""
    tracks = {}
    for key, track in observations.tracks.items():
        move = moves.get(key[0])
        if move is not None:
            begin, end = move.span
            track = track.select((track.time > begin + _MARGIN_S) & (track.time < end - _MARGIN_S))
        if len(track):
            tracks[key] = track
    return replace(observations, tracks=tracks)


def _likely_maps(labels: list[SeenLabel], camera: CameraInput) -> list[tuple[float, float]]:
    """Rates and offsets at which one part of a camera's rows has a pose: a move leaves the others untouched."""
    moments, maps = path_moments(labels), []
    times = np.concatenate([one.track.time for one in labels])
    for begin, end in (window for count in _WINDOWS for window in pairwise(np.linspace(0.0, 1.0, count + 1).tolist())):
        first, last = np.quantile(times, (begin, end))
        samples = []
        for one in labels:
            time, points = along_path(one.track)
            inside = (time >= first) & (time <= last)
            samples.append((one, time[inside], points[inside]))
        scan = sorted(moment_scan(labels, moments, 1.0, (begin, end)), key=lambda one: one.score)
        placed = [verify(one, samples, camera) for one in scan[: LIKELY_CANDIDATES // 2]]
        maps += [(one.rate, one.offset) for one in placed if one.inliers >= MIN_INLIERS]
    return maps


def likely_division(costs: Floats) -> float:
    """Share of the rows behind which the mean of their costs (n,) under one pose changes most.

    The better half of a camera's last quarter is from before a move, unless an eighth of all rows is after it.
    """
    return float(np.argmax(np.abs(np.cumsum(costs - costs.mean()))) + 1) / len(costs)


def best_division(
    count: int, least: int, costs: Callable[[slice], Floats], starts: Iterable[float]
) -> tuple[float, int]:
    """Mean cost of ``count`` rows by two poses, and how many of them have the first.

    costs: of all rows under the pose that fits a part of them. least: rows on either side.
    """
    best = float("inf"), least
    for start in starts:
        at = int(start * count)
        for _ in range(_ITERATIONS):
            first, second = costs(slice(at)), costs(slice(at, None))
            total = np.cumsum(first - second) + second.sum()  # where the first ends behind each row
            new = least + int(np.argmin(total[least - 1 : count - least]))
            best = min(best, (float(total[new - 1]) / count, new))
            if new == at:
                break
            at = new
    return best


class _Rows(NamedTuple):
    """Rows in the order of their times (n,) [s]: positions (n, 3), image points (n, 2) and weights (n,).

    least: rows of either side of a move.
    """

    world: Floats
    image: Floats
    times: Floats
    weight: Floats
    focal: float
    least: int

    def part(self, rows: slice) -> _Rows:
        """Some of them."""
        part = {name: getattr(self, name)[rows] for name in ("world", "image", "times", "weight")}
        return self._replace(**part)

    def costs(self, rows: slice = slice(None)) -> Floats:
        """Costs (n,) [px²] of all rows under the pose that fits some of them."""
        residual = resected_residuals(self.world[rows], self.image[rows], self.world, self.image, self.focal)
        return np.asarray(self.weight * np.minimum(residual, TRUNCATION_PX) ** 2)


def _divide(labels: list[SeenLabel], camera: CameraInput, rate: float, offset: float, most: int) -> Division | None:
    """The moves, at most ``most``, that explain a camera's rows; None if one pose does, or if they do not."""
    samples = [(one, one.track.time, one.track.points) for one in labels]
    world, image, internal = common_rows(samples, rate, offset)
    if not len(internal):
        return None
    order = np.argsort(internal, kind="stable")
    times, row = (internal[order] - offset) / rate, np.arange(len(order))
    is_end = np.minimum(times - times[0], times[-1] - times) < _END_S
    every, often = (max(1, int(np.count_nonzero(part)) // _MOST_ROWS) for part in (times, is_end))
    picked = np.flatnonzero((row % every == 0) | (is_end & (row % often == 0)))
    used, weight = order[picked], np.diff(picked, append=len(order)) * len(picked) / len(order)
    times, least = (internal[used] - offset) / rate, max(MIN_POINTS, LEAST_ROWS // often)
    rows = _Rows(world[used], image[used], times, weight, camera.intrinsics.focal, least)
    found = _still_parts(rows, most)
    if found is None or not found[1]:
        return None
    cost, cuts = found
    poses = [resect(rows.world[a:b], rows.image[a:b]) for a, b in pairwise((0, *cuts, len(times)))]
    turns = [one[0] @ other[0].T for one, other in pairwise(poses) if one is not None and other is not None]
    if len(turns) < len(cuts):
        return None
    cosines = np.clip([0.5 * (np.trace(turn) - 1.0) for turn in turns], -1.0, 1.0)
    middles = 0.5 * (times[np.array(cuts) - 1] + times[cuts])
    gain = float(rows.costs().sum()) / max(cost, 1e-9)
    return Division(gain, tuple(middles.tolist()), tuple(np.arccos(cosines).tolist()))


def _still_parts(rows: _Rows, most: int) -> tuple[float, list[int]] | None:
    """What rows cost by one pose for each part between moves [px²], and the rows at which parts begin, but the first.

    most: moves. None if one pose explains a part, or all where there is no move, too badly.
    """
    count, by_one = len(rows.times), rows.costs()
    together, explained = float(by_one.sum()), by_one < rows.weight * TRUNCATION_PX**2
    one = (together, list[int]()) if np.average(explained, weights=rows.weight) >= MIN_INLIERS else None
    if most == 0 or together < count * _LEAST_PX**2 or count < 2 * rows.least:
        return one  # whatever two poses explain
    _, at = best_division(count, rows.least, rows.costs, (*STARTS, likely_division(by_one)))
    times = rows.times
    if at in (rows.least, count - rows.least) or min(times[at - 1] - times[0], times[-1] - times[at]) < _LEAST_S:
        return one  # or the move is nearer to an end yet, and some rows beyond it would be taken for this side's
    before = _still_parts(rows.part(slice(at)), most - 1)
    after = None if before is None else _still_parts(rows.part(slice(at, None)), most - 1 - len(before[1]))
    if before is None or after is None:
        return one
    cost, cuts = before[0] + after[0], [*before[1], at, *(at + cut for cut in after[1])]
    gains = together / max(cost, 1e-9) >= MIN_CANDIDATE_RATIO and together - cost >= count * _LEAST_PX**2
    return (cost, cuts) if gains else one
