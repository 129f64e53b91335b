"""Whether a camera's clock jumped forward in a log since it was set, or because frames were lost that nobody counted.

After a pause a camera's times are as far behind the log's, and the other cameras', as they were before it. What
both sides of the jump say is used, unlike in `hub.clocks.change_detector`, which has to decide at once.
"""

from __future__ import annotations

import itertools
from array import array
from collections import defaultdict

import numpy as np

from hub.clocks.change_detector import MIN_STEP_S, ClockChange
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb

_WINDOW_S, _LEAST_FRAMES = 4.0, 5
"""What is compared on each side of a jump, as long as a hub waits for what comes after one; and how many frames of it:
as many as the detector needs to look for jumps"""
_QUANTILES = (0.5, 0.75)
"""Of the delays, all of which a step shifts; on the clock of a camera that lost frames, lower ones say nothing"""
_RATES = 0.5, 2.0  # of a clock, not of times that are all equal, or of a recording that was replayed fast
_MAX_NS = 2**63 - 1  # of a log time, which may be any of 64 bits, in a signed integer

FrameKey = tuple[str, str, int]
"""Camera, boot id and sequence number."""


class RecordedTimes:
    """The times of a log's frames, in the order in which they were written."""

    def __init__(self) -> None:
        self._number = itertools.count()
        self._rows: defaultdict[tuple[str, str], array[int]] = defaultdict(lambda: array("q"))
        self._steps: defaultdict[tuple[str, str], list[tuple[int, int, float]]] = defaultdict(list)

    def handle(self, message: pb.Observation, log_time_ns: int, change: ClockChange | None) -> None:
        """Add a frame, as its camera sent it, and the change of its clock that seems to begin with it."""
        key = message.camera, message.boot_id
        if change is not None and change.kind == "step":
            self._steps[key].append((len(self._rows[key]) // 3, message.sequence, change.step_s))
        self._rows[key].extend((message.device_time_ns, min(log_time_ns, _MAX_NS), next(self._number)))

    def pauses(self) -> set[FrameKey]:
        """The frames before which a clock did not jump: those of lost frames, by every clock that can tell."""
        tables = {key: np.frombuffer(rows, np.int64).reshape(-1, 3) for key, rows in self._rows.items()}
        out = set[FrameKey]()
        for key, steps in self._steps.items():
            others = [table for other, table in tables.items() if other[0] != key[0]]
            parts = np.split(tables[key], [at for at, _, _ in steps])
            for (_, sequence, size), before, after in zip(steps, parts, parts[1:], strict=False):
                sides = _near(before, -1), _near(after, 0)
                enough = size > 0.0 and min(map(len, sides)) >= _LEAST_FRAMES
                if enough and _is_pause(sides, others, min(0.5 * size, MIN_STEP_S)):
                    out.add((*key, sequence))
        return out


def _near(rows: Ints, last: int) -> Ints:
    """The rows (n, 3) of a camera within the window beside one of them."""
    inside: Bools = np.abs(rows[:, 0] - rows[last, 0]) <= _WINDOW_S * NANOSECONDS
    return rows[inside]


def _is_pause(sides: tuple[Ints, Ints], others: list[Ints], most: float) -> bool:
    """Whether most of the other cameras and the log's times say so, as far as they are clocks. most: of a shift [s].

    Those of the log alone say nothing where they are the cameras' own, as other makers may write them.
    """
    by_log, others_say = _is_steady(sides, [rows[:, 1] for rows in sides], most), []
    for table in others:
        last = [np.searchsorted(table[:, 2], rows[:, 2]) - 1 for rows in sides]
        if min(map(np.min, last)) >= 0:
            others_say.append(_is_steady(sides, [table[at, 0] for at in last], most))
    every = [by_log, *others_say]
    return by_log is not False and True in others_say and every.count(True) > every.count(False)


def _is_steady(sides: tuple[Ints, Ints], clock: list[Ints], most: float) -> bool | None:
    """Whether the frames' delays on a clock, (n,) times [ns] a side, are the same on both; None where it is none."""
    found: list[Floats] = []
    for rows, times in zip(sides, clock, strict=True):
        elapsed, shown = (float(np.max(one) - np.min(one)) for one in (times, rows[:, 0]))
        if not _RATES[0] * shown < elapsed < _RATES[1] * shown:
            return None
        found.append(np.quantile((times - clock[0][0] - (rows[:, 0] - sides[0][0, 0])) / NANOSECONDS, _QUANTILES))
    return bool((np.abs(found[1] - found[0]) < most).all())
