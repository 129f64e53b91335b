"""Sees a camera's clock step or change its rate while the camera runs, and keeps what is on both sides apart.

Frame numbers tell how much time should have passed between two frames: a device time that says otherwise, while
the frames arrived as they should, is a step. A change of rate shows only against another clock: the hub's own, at
which frames arrive, taken at the lowest delay of each second.

Both begin a new epoch of the clock, as a restart of the agent does. A step is known as soon as it is seen, to
about the noise of two time stamps; so the old time map, moved by it, holds for the new epoch until that has been
solved by itself.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from protocols.geometry.types import Floats

STEP_S = 0.2
"""Smaller steps are not told from late frames."""
DRIFT = 1e-4
"""Least change of rate that is told; crystals change by a tenth of it with the temperature."""
MOST_DRIFT = 2e-3
"""Greatest change of rate that is one: no crystal does more. Beyond, frames are held up on their way, more and more."""
_SIGMAS = 6.0
_BIN_S = 1.0
_RECENT, _BASE, _BINS = 6, 12, 40
_PERIODS = 120
_NAME = 63


@dataclass(frozen=True, slots=True)
class ClockEvent:
    """A new epoch of a camera's clock.

    boot: its name from now on; before: the epoch that ended. step_s: new clock less old clock, when it was told. std_s:
    of it. rate: new rate over old one, less 1 (0 for a step). at_s: when it was told, on the new clock.
    """

    camera: str
    kind: Literal["step", "drift"]
    before: str
    boot: str
    step_s: float
    std_s: float
    rate: float = 0.0
    at_s: float = 0.0


@dataclass(slots=True)
class _Clock:
    """One run of one camera's agent."""

    epochs: list[tuple[int, str]]
    """(first sequence, name)"""
    last: tuple[int, int, float, float | None] | None = None
    """(sequence, frame, device time [s], arrival [s])"""
    periods: deque[float] = field(default_factory=lambda: deque(maxlen=_PERIODS))
    bins: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_BINS))
    """(device time, lowest arrival - device time) of each second"""
    origin_ns: int = 0
    period: float = 0.0
    renew: int = 0


class ClockWatch:
    """All cameras' clocks. Estimator without a clock of its own: arrivals are passed in."""

    def __init__(self) -> None:
        self._clocks: dict[tuple[str, str], _Clock] = {}
        self._events: list[ClockEvent] = []

    def handle(
        self, camera: str, boot: str, sequence: int, frame: int, device_ns: int, arrival: float | None
    ) -> tuple[str, ClockEvent | None]:
        """Take one frame's stamp; returns the epoch it belongs to, and the event if it begins one.

        device_ns: the frame's device time. arrival: when it came [s, one clock for all cameras]; None = not known.
        """
        clock = self._clocks.get((camera, boot))
        if clock is None:
            clock = self._clocks[camera, boot] = _Clock([(0, boot)])
        if clock.last is not None and sequence <= clock.last[0]:
            name = next((name for first, name in reversed(clock.epochs) if first <= sequence), boot)
            return name, None
        if clock.last is None:
            clock.origin_ns = device_ns
        time = (device_ns - clock.origin_ns) * 1e-9  # Unix times in ns do not fit a float
        event = self._step(clock, camera, sequence, frame, time, arrival)
        clock.last = (sequence, frame, time, arrival)
        if event is None and arrival is not None and self._bin(clock, time, arrival):
            event = self._drift(clock, camera, sequence, time)
        if event is not None:
            self._events.append(event)
        return clock.epochs[-1][1], event

    def since(self, camera: str, boot: str) -> list[ClockEvent]:
        """The events that lead from the epoch ``boot`` to the present one, in order."""
        chain: list[ClockEvent] = []
        for event in self._events:
            if event.camera == camera and event.before == (chain[-1].boot if chain else boot):
                chain.append(event)
        return chain

    def rate(self, camera: str, boot: str) -> float | None:
        """Rate of the hub's clock against this one, less 1, over the last seconds; None = not known yet."""
        clock = self._clocks.get((camera, boot))
        if clock is None or len(clock.bins) < _RECENT + 1:
            return None
        return _slope(np.array(list(clock.bins)[:-1]))[0]

    def _step(
        self, clock: _Clock, camera: str, sequence: int, frame: int, time: float, arrival: float | None
    ) -> ClockEvent | None:
        if clock.last is None:
            return None
        _, last_frame, last_time, last_arrival = clock.last
        passed, frames = time - last_time, frame - last_frame
        if frames > 0 and 0.0 < passed < STEP_S + 1.0 and len(clock.periods) < 5:
            clock.periods.append(passed / frames)
            return None
        if len(clock.periods) < 5 or frames <= 0:
            return None
        if clock.renew <= 0:
            # Not with every frame: of a thousand cameras that would cost as much as all the rest.
            clock.period, clock.renew = float(np.median(clock.periods)), min(len(clock.periods), _PERIODS // 4)
        clock.renew -= 1
        period = clock.period
        step = passed - frames * period
        if abs(step) > STEP_S:
            waited = None if arrival is None or last_arrival is None else arrival - last_arrival
            # A camera that stood still without counting frames: the time has passed for both.
            if passed > 0.0 and waited is not None and abs(passed - waited) < STEP_S:
                return None
            spread = float(np.median(np.abs(np.array(clock.periods) - period))) * 1.5
            return self._begin(clock, camera, "step", sequence, step, max(spread, 1e-4) * np.sqrt(frames))
        clock.periods.append(passed / frames)
        return None

    def _bin(self, clock: _Clock, time: float, arrival: float) -> bool:
        """Take one delay; True when a second is complete."""
        delay = arrival - time
        if not clock.bins or time - clock.bins[-1][0] >= _BIN_S:
            clock.bins.append((time, delay))
            return True
        if delay < clock.bins[-1][1]:
            clock.bins[-1] = (clock.bins[-1][0], delay)
        return False

    def _drift(self, clock: _Clock, camera: str, sequence: int, time: float) -> ClockEvent | None:
        done = np.array(list(clock.bins)[:-1])
        if len(done) < _RECENT + _BASE:
            return None
        first = float(done[0, 0])
        done = done - done[0]
        base, recent = done[:-_RECENT], done[-_RECENT:]
        before, sigma_before = _slope(base)
        now, sigma_now = _slope(recent)
        change, sigma = now - before, float(np.hypot(sigma_before, sigma_now))
        if not max(DRIFT, _SIGMAS * sigma) < abs(change) < MOST_DRIFT:
            return None  # nearly always; what follows costs more than all the rest of a thousand cameras
        # Links and busy machines make delays that wander: what slopes of this length did before tells by how much.
        slopes = [_slope(base[i : i + _RECENT])[0] for i in range(len(base) - _RECENT + 1)]
        wander = 1.5 * float(np.std(slopes))
        if abs(change) <= _SIGMAS * float(np.hypot(sigma, wander)):
            return None
        shift, change = _bent(done, time - first)
        event = self._begin(clock, camera, "drift", sequence, -shift, abs(change) * _BIN_S + sigma_now, -change)
        return replace(event, at_s=clock.origin_ns * 1e-9 + time)

    def _begin(
        self,
        clock: _Clock,
        camera: str,
        kind: Literal["step", "drift"],
        sequence: int,
        step: float,
        std: float,
        rate: float = 0.0,
    ) -> ClockEvent:
        before, first = clock.epochs[-1][1], clock.epochs[0][1]
        suffix = f"-e{len(clock.epochs)}"
        name = first[: _NAME - len(suffix)] + suffix
        clock.epochs.append((sequence, name))
        clock.bins.clear()
        return ClockEvent(camera, kind, before, name, step, float(std), rate)


def _bent(bins: Floats, now: float) -> tuple[float, float]:
    """How far delays (n, 2) have left their old line at time ``now``, and by how much they rise faster since they bent.

    The line with one bend within the last _RECENT bins that fits best; its place is one of a grid, six to a bin.
    """
    time, delay = bins[:, 0], bins[:, 1]
    best, found = np.inf, (0.0, 0.0)
    for bend in np.linspace(time[-_RECENT - 1], time[-3], 6 * (_RECENT - 2) + 1):
        rows = np.column_stack([np.ones_like(time), time, np.maximum(time - bend, 0.0)])
        line = np.linalg.lstsq(rows, delay, rcond=None)[0]
        left = float(((rows @ line - delay) ** 2).sum())
        if left < best:
            best, found = left, (float(line[2]) * (now - float(bend)), float(line[2]))
    return found


def _slope(bins: Floats) -> tuple[float, float]:
    """Slope of delays over time, and its std by the scatter around the line, which is never taken below 20 us."""
    time, delay = bins[:, 0] - bins[:, 0].mean(), bins[:, 1]
    spread = float(time @ time)
    slope = float(time @ delay) / spread
    rest = delay - delay.mean() - slope * time
    sigma = float(np.sqrt(rest @ rest / max(len(bins) - 2, 1)))
    return slope, max(sigma, 2e-5) / float(np.sqrt(spread))
