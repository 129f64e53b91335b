"""Cameras whose clock was set during a recording, as a board's is when it receives the time: one side is used.

Frames are numbered while the clock jumps. A jump forward may also be a pause, or lost frames that nobody counted; so
only cameras are looked at that could not be placed, or whose rows on one side of a jump the others do not explain.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.clock_steps import MAX_STEP_S
from hub.bundle.problem import UsedRows
from hub.bundle.residuals import StackedTrajectories
from hub.calibration.resection.moved_cameras import LEAST_ROWS
from hub.calibration.solvers import Solution
from hub.trajectory.image_tracks import BRIDGED_INTERVALS
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.observations import Observations

_MOST_SETTINGS = 3
"""Jumps of a clock in a recording: with more, as of shuffled rows, it is none."""
_LEAST_EXPLAINED = 0.5
"""Share of inliers in a part, over that of the camera's best part, below which its clock is another one. In simulated
worlds pauses left at least 0.97, clocks set by 0.5 s and more 0 to 0.21; where they left more, other tests of clocks
and moves found them."""
_MOVED = ", or it paused and was moved"  # of a jump forward


@dataclass(frozen=True, slots=True)
class SetClock:
    """First and last frames of the parts of a camera's that are used, between jumps of its clock, the largest of which
    is ``size`` [s]. others: how many of its frames are left out. or_else: what else explains it."""

    parts: tuple[tuple[int, int], ...]
    size: float
    others: int
    or_else: str = ""

    def warning(self, name: str) -> str:
        """One sentence for a person."""
        jump = f"its clock was set by about {self.size:+.1f} s while its frames were counted{self.or_else}"
        frames = ", ".join(f"{first} to {last}" for first, last in self.parts)
        return f"{name}: {jump}: only frames {frames} were used, {self.others} others left out"


def set_clocks(names: Iterable[str], observations: Observations) -> dict[str, SetClock]:
    """Those of the cameras whose times jump, by more than what is found of itself, while their frames are counted."""
    out: dict[str, SetClock] = {}
    for name in names:
        frame, time, jumps = _frames(observations, name)
        ends = np.flatnonzero(jumps)
        if len(ends) > _MOST_SETTINGS:  # frames that were lost are not counted: but no clock runs backwards
            ends = ends[np.diff(time)[ends] < 0.0]
        if 0 < len(ends) <= _MOST_SETTINGS:
            kept = max(np.split(frame, ends + 1), key=len)
            size, ranges = _largest(jumps[ends]), ((int(kept[0]), int(kept[-1])),)
            out[name] = SetClock(ranges, size, len(frame) - len(kept), _MOVED if size > 0.0 else "")
    return out


def unexplained_sides(solution: Solution, observations: Observations) -> dict[str, SetClock]:
    """The placed cameras of which the solution explains the rows between some jumps of their times, and not others."""
    found, out = solution.reconstruction, dict[str, SetClock]()
    for number, name in enumerate(found.names):
        frame, time, jumps = _frames(observations, name)
        ends = np.flatnonzero(jumps)
        if not len(ends):
            continue
        stamp, is_known, used = _rows(solution, number)
        parts = list(zip(np.split(frame, ends + 1), np.split(time, ends + 1), strict=True))
        between = np.array([(stamp >= at[0]) & (stamp <= at[-1]) for _, at in parts])
        between &= between.sum(axis=0) == 1  # a clock set back shows some times twice
        known = np.array([np.count_nonzero(is_known[mine]) for mine in between])
        shares = np.array([used[mine].sum() for mine in between]) / np.maximum(known, 1)
        is_good = (shares >= _LEAST_EXPLAINED * shares.max()) | [len(of) < LEAST_ROWS for of, _ in parts]
        borders = ends[is_good[1:] != is_good[:-1]]
        if len(borders):
            kept = [of for (of, _), good in zip(parts, is_good, strict=True) if good]
            others, size = len(frame) - sum(map(len, kept)), _largest(jumps[borders])
            ranges = tuple((int(of[0]), int(of[-1])) for of in kept)
            moved = bool((known[~is_good] >= LEAST_ROWS).all())
            paused = _MOVED if moved else ", or it paused and no other camera saw what it saw then"
            out[name] = SetClock(ranges, size, others, paused if size > 0.0 else "")
    return out


def between_settings(observations: Observations, clocks: Mapping[str, SetClock]) -> Observations:
    """The observations without the other frames of these cameras."""
    tracks = dict(observations.tracks)
    for key, track in observations.tracks.items():
        if clock := clocks.get(key[0]):
            inside = [(track.frame >= first) & (track.frame <= last) for first, last in clock.parts]
            tracks[key] = track.select(np.any(inside, axis=0))
    return replace(observations, tracks={key: track for key, track in tracks.items() if len(track)})


def _frames(observations: Observations, name: str) -> tuple[Ints, Floats, Floats]:
    """A camera's frames (n,), their times [s], and by how much they jump after each but the last [s]; 0 = not."""
    tracks = observations.of_camera(name)
    frame, first = np.unique(np.concatenate([np.zeros(0, np.int64), *(t.frame for t in tracks)]), return_index=True)
    time = np.concatenate([np.zeros(0), *(track.time for track in tracks)])[first]
    if len(frame) < 2:
        return frame, time, np.zeros(0)
    elapsed, counted = np.diff(time), np.diff(frame)
    interval = float(np.median(elapsed / counted))
    jumps = elapsed - counted * interval
    return frame, time, np.where(np.abs(jumps) > max(MAX_STEP_S, BRIDGED_INTERVALS * interval), jumps, 0.0)


def _largest(jumps: Floats) -> float:
    """Of these jumps (n,)."""
    return float(jumps[np.argmax(np.abs(jumps))])


def _rows(solution: Solution, number: int) -> tuple[Floats, Bools, Bools]:
    """Time stamps (n,) [s] of a placed camera's rows, whether a path is known then, and which are inliers."""
    found, prepared, name = solution.reconstruction, solution.prepared, solution.reconstruction.names[number]
    rows, camera = found.problem.of_camera(number), found.state.cameras[number]
    every = UsedRows.of([part.using(np.ones_like(part.use)) for part in rows])
    _, _, _, inside = StackedTrajectories.of(found.state.by_label).support(
        every, camera.reference_time(camera.row_time(every.time, every.pixels))
    )
    stamp = np.concatenate([part.stamps for part in rows]) / prepared.time_scale(name) + prepared.time_origins[name]
    return stamp, inside, np.concatenate([part.use for part in rows])
