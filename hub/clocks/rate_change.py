"""A clock that began to run faster or slower, told on the line that it ran on before.

Until enough was seen to solve for the new clock by itself, the old one must serve: what is seen is put where the old
clock would have shown it, by the shift and the rate that arrivals tell (`clock_watch`). So the old map keeps rows up to
the present, in place of being carried on beyond them; and the rows between the bend and its detection, which the old
clock never showed so, are put right too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.clocks.change_detector import ClockEvent
from protocols.geometry.types import Floats

_SECOND_NS = 1_000_000_000
_SPLIT_S = 1e-5
"""More than rounding, less than between two frames."""


@dataclass(frozen=True, slots=True)
class Bend:
    """From ``at_s`` [s, the clock's own time] on the clock runs ``1 + rate`` times as fast; told at ``told_s``.

    before, after: names of the epoch that ended there and of the one that began. put: ``at_s`` and ``rate`` as first
    told, by which frames were put on the old clock as they came.
    """

    before: str
    after: str
    at_s: float
    rate: float
    told_s: float
    put: tuple[float, float]

    @classmethod
    def of(cls, event: ClockEvent) -> Bend:
        """The bend of an event of kind "drift". Raises ValueError for one that changes no rate."""
        if event.rate == 0.0:
            raise ValueError(f"{event.kind} of {event.camera}: the rate stays")
        at = event.at_s - event.step_s / event.rate
        return cls(event.before, event.boot, at, event.rate, event.at_s, (at, event.rate))

    def amended(self, event: ClockEvent | None) -> Bend:
        """The same bend as ``event`` tells it by now; None = nothing new."""
        if event is None or event.rate == 0.0:
            return self
        return replace(self, at_s=event.at_s - event.step_s / event.rate, rate=event.rate)

    def on_old_clock(self, device_ns: int) -> int:
        """What the old clock would show [ns] where the new one shows ``device_ns``, a time after the bend."""
        at_s, rate = self.put
        return device_ns - round(rate * (device_ns - round(at_s * _SECOND_NS)))

    def straightened(self, time: Floats) -> Floats:
        """Times (n,) [s] of the old epoch, put right.

        Those between the bend and ``told_s`` are as the clock showed them, later ones as they were put.
        """
        at, rate = self.put
        came_late = time > self.told_s - rate * (self.told_s - at) - _SPLIT_S
        right = came_late if self.put == (self.at_s, self.rate) else np.zeros(time.shape, dtype=np.bool_)
        shown = np.where(came_late, at + (time - at) / (1.0 - rate), time)
        return np.asarray(np.where(right | (shown <= self.at_s), time, shown - self.rate * (shown - self.at_s)))


class Bends:
    """The latest bend of each camera, for as long as the epoch before it serves."""

    def __init__(self) -> None:
        self._of: dict[str, Bend] = {}

    def handle(self, event: ClockEvent) -> None:
        """Take an event; a step ends what a bend began."""
        self._of.pop(event.camera, None)
        if event.kind == "drift":
            self._of[event.camera] = Bend.of(event)

    def serving(self, camera: str, boot: str) -> Bend | None:
        """The camera's bend, if ``boot`` is the epoch before it; forgets it if not: then the new clock is settled."""
        bend = self._of.get(camera)
        if bend is not None and bend.before != boot:
            del self._of[camera]
            return None
        return bend

    def on_old_clock(self, camera: str, boot: str, device_ns: int) -> tuple[str, int] | None:
        """The old epoch's name and time [ns] for a frame of the new epoch ``boot``; None where nothing bent."""
        bend = self._of.get(camera)
        return None if bend is None or bend.after != boot else (bend.before, bend.on_old_clock(device_ns))

    @property
    def cameras(self) -> list[str]:
        """Cameras whose clock bent of late."""
        return list(self._of)


__all__ = ["Bend", "Bends"]
