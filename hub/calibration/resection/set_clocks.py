"""Cameras whose clock was set during a recording, as a board's is when it receives the time: the longest part is used.

Frames are numbered while the clock jumps. A jump forward may also be a pause, or lost frames that nobody counted; so
only cameras that could not be placed are looked at.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.clock_steps import MAX_STEP_S
from hub.trajectory.image_tracks import BRIDGED_INTERVALS
from protocols.session.observations import Observations

_MOST_SETTINGS = 3
"""Jumps of a clock in a recording: with more, as of shuffled rows, it is none."""


@dataclass(frozen=True, slots=True)
class SetClock:
    """A camera's frames ``first`` to ``last``, between jumps of its clock, the largest of which is ``size`` [s].
    others: how many of its frames are left out."""

    first: int
    last: int
    size: float
    others: int

    def warning(self, name: str) -> str:
        """One sentence for a person."""
        return (
            f"{name}: its clock was set by about {self.size:+.1f} s while its frames were counted: "
            f"only frames {self.first} to {self.last} were used, {self.others} others left out"
        )


def set_clocks(names: Iterable[str], observations: Observations) -> dict[str, SetClock]:
    """Those of the cameras whose times jump, by more than what is found of itself, while their frames are counted."""
    out: dict[str, SetClock] = {}
    for name in names:
        tracks = observations.of_camera(name)
        frame, first = np.unique(np.concatenate([np.zeros(0, np.int64), *(t.frame for t in tracks)]), return_index=True)
        if len(frame) < 2:
            continue
        elapsed, counted = np.diff(np.concatenate([track.time for track in tracks])[first]), np.diff(frame)
        interval = float(np.median(elapsed / counted))
        jumps = elapsed - counted * interval
        ends = np.flatnonzero(np.abs(jumps) > max(MAX_STEP_S, BRIDGED_INTERVALS * interval))
        if len(ends) > _MOST_SETTINGS:  # frames that were lost are not counted: but no clock runs backwards
            ends = ends[elapsed[ends] < 0.0]
        if not 0 < len(ends) <= _MOST_SETTINGS:
            continue
        kept = max(np.split(frame, ends + 1), key=len)
        size = float(jumps[ends[np.argmax(np.abs(jumps[ends]))]])
        out[name] = SetClock(int(kept[0]), int(kept[-1]), size, len(frame) - len(kept))
    return out


def between_settings(observations: Observations, clocks: Mapping[str, SetClock]) -> Observations:
    """The observations without the other frames of these cameras."""
    tracks = dict(observations.tracks)
    for key, track in observations.tracks.items():
        if clock := clocks.get(key[0]):
            tracks[key] = track.select((track.frame >= clock.first) & (track.frame <= clock.last))
    return replace(observations, tracks={key: track for key, track in tracks.items() if len(track)})
