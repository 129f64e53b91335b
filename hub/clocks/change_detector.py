"""Sees a camera's clock step or change its rate while the camera runs, and keeps what is on both sides apart.

Frame numbers tell how much time should have passed between two frames: a device time that says otherwise, while
the frames arrived as they should, is a step. A change of rate shows only against another clock: the hub's own, at
which frames arrive, taken at the lowest delay of each half second. Delays leave their old line; how steeply they
usually do so in as many seconds, by what links and busy machines do, is told by the same camera's past.

Both begin a new epoch of the clock, as a restart of the agent does. A step is known as soon as it is seen, to
about the noise of two time stamps; so the old time map, moved by it, holds for the new epoch until that has been
solved by itself. A drift is told from as little as two seconds; what it was is told better by the seconds after,
and so the event is amended.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hub.clocks.delay_changepoint import LEAST_S, LEVEL, SPANS, Jump, Rise, bend, left_its_line, line

STEP_S = 0.2
"""Smaller steps are not told from late frames."""
_GATE = 2.0
"""Times what delays usually leave of the old line; below it nothing is looked at"""
_BIN_S = 0.5
_BASE, _BINS = 24, 60
_RENEW = 8
"""Bins after which the old line is found anew"""
_CRAWL = 1 / 32
_LEARNT_LATE, _LEARNT = 24, 30
"""How many bins late it is learnt how steep delays are, and for how many renewals it is remembered"""
_NOT_KEPT, _BELIEVED_LESS = 0.5, 0.2
"""A drift of which less than this is left later was none; such rises are then usual with this weight"""
_RISE_BINS, _JUMP_BINS = 40, 6
"""For how long a drift and a step are told better"""
_LEAST_LINE, _MOST_LINE = 8, 20
"""Bins before a step that tell what delays were"""
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
    """(device time, arrival - device time) of each half second's frame with the lowest delay; the last is not over"""
    began: float = 0.0
    """Device time of the first frame of the last bin"""
    line: tuple[float, float] | None = None
    """(delay at time 0, slope) on which delays were some bins ago"""
    until_renewal: int = 0
    usual: float = 0.0
    """Mean square of what delays leave of it some bins later [s²]"""
    steepness: dict[int, float] = field(default_factory=dict)
    """Mean square of how steeply delays left their line in so many bins, over the last minutes"""
    learnt: int = 0
    after: Rise | Jump | None = None
    """What the bins after the last event tell better"""
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

    def event(self, boot: str) -> ClockEvent | None:
        """The event that began the epoch ``boot``, as it is known by now; None if no event did."""
        return next((event for event in reversed(self._events) if event.boot == boot), None)

    def rate(self, camera: str, boot: str) -> float | None:
        """Rate of the hub's clock against this one, less 1, over the last seconds; None = not known yet."""
        clock = self._clocks.get((camera, boot))
        if clock is None or len(clock.bins) < SPANS[-1] + 1:
            return None
        return line(np.array(list(clock.bins)[:-1]))[1]

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
            before = list(clock.bins)[-1 - _MOST_LINE : -1] if arrival is not None else []
            event = self._begin(clock, camera, "step", sequence, step, max(spread, 1e-4) * np.sqrt(frames))
            if len(before) >= _LEAST_LINE:
                level, slope, sigma = line(np.array(before))
                clock.after = Jump(len(self._events), step, event.std_s, (level, slope), sigma)
            return event
        clock.periods.append(passed / frames)
        return None

    def _bin(self, clock: _Clock, time: float, arrival: float) -> bool:
        """Take one delay; True when a bin is complete."""
        delay = arrival - time
        if not clock.bins or time - clock.began >= _BIN_S:
            clock.bins.append((time, delay))
            clock.began = time
            return len(clock.bins) > 1
        if delay < clock.bins[-1][1]:
            clock.bins[-1] = (time, delay)
        return False

    def _drift(self, clock: _Clock, camera: str, sequence: int, now: float) -> ClockEvent | None:
        time, delay = clock.bins[-2]
        if clock.after is not None:
            self._amend(clock, clock.after, time, delay)
        if len(clock.bins) <= _BASE + SPANS[-1]:
            return None
        if clock.line is None or clock.until_renewal <= 0:
            done = np.array(list(clock.bins)[:-1])
            level, slope, sigma = line(done[: -SPANS[0]])
            clock.line, clock.until_renewal = (level, slope), _RENEW
            clock.usual = clock.usual or sigma * sigma
            _learn(clock, slope)
        clock.until_renewal -= 1
        over = delay - clock.line[0] - clock.line[1] * time
        usual = clock.usual
        clock.usual += _CRAWL * (min(over * over, 9.0 * usual) - usual)
        if over * over < _GATE * _GATE * max(usual, LEAST_S * LEAST_S):
            return None  # nearly always; what follows costs more than all the rest of a thousand cameras
        done = np.array(list(clock.bins)[:-1])
        span = next((n for n in SPANS if left_its_line(done, n, _usual_steepness(clock, n))), None)
        if span is None:
            return None
        base = line(done[:-span])
        at, rise = bend(done, span)
        shift, spread = rise * (now - at), abs(rise) * _BIN_S + base[2]
        event = self._begin(clock, camera, "drift", sequence, -shift, spread, -rise)
        event = replace(event, at_s=clock.origin_ns * 1e-9 + now)
        clock.after = after = Rise(len(self._events), at, now, (base[0], base[1]), base[2], at, rise, rise)
        for one, its in done:
            if one > at:
                after.take(float(one), float(its))
        return event

    def _amend(self, clock: _Clock, after: Rise | Jump, time: float, delay: float) -> None:
        """Tell a drift or a step better, by one more bin."""
        event = self._events[after.number]
        if isinstance(after, Jump):
            step, std = after.take(time, delay)
            self._events[after.number] = replace(event, step_s=step, std_s=std)
            if after.heard >= _JUMP_BINS:
                clock.after = None
            return
        after.take(time, delay)
        rate = -after.rise
        self._events[after.number] = replace(event, rate=rate, step_s=rate * (after.told - after.at))
        if after.count >= _RISE_BINS:
            clock.after = None
            if abs(after.rise) < _NOT_KEPT * abs(after.first_rise):
                for span in (SPANS[0], SPANS[-1]):
                    seen = clock.steepness.get(span, 0.0)
                    clock.steepness[span] = seen + _BELIEVED_LESS * (after.first_rise**2 - seen)

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
        clock.line, clock.usual, clock.after = None, 0.0, None
        return ClockEvent(camera, kind, before, name, step, float(std), rate)


def _learn(clock: _Clock, slope: float) -> None:
    """Remember how steeply delays left their line in a few bins, some time ago: nothing is judged by itself."""
    bins, last = clock.bins, len(clock.bins) - 2 - _LEARNT_LATE
    if last < SPANS[-1] + LEVEL:
        return
    clock.learnt = min(clock.learnt + 1, _LEARNT)
    for span in (SPANS[0], SPANS[-1]):
        first = last - span
        begin = bins[first][0]
        before = sum(bins[i][1] - slope * (bins[i][0] - begin) for i in range(first - LEVEL + 1, first + 1)) / LEVEL
        weight = product = 0.0
        for i in range(first + 1, last + 1):
            since = bins[i][0] - begin
            weight += since * since
            product += since * (bins[i][1] - slope * since - before)
        seen = clock.steepness.get(span, 0.0)
        clock.steepness[span] = seen + ((product / weight) ** 2 - seen) / clock.learnt


def _usual_steepness(clock: _Clock, span: int) -> float:
    """Of ``span`` bins, between those that are remembered."""
    one, other = (math.sqrt(clock.steepness.get(n, 0.0)) for n in (SPANS[0], SPANS[-1]))
    if not one or not other:
        return max(one, other)
    share = math.log(span / SPANS[0]) / math.log(SPANS[-1] / SPANS[0])
    return math.exp((1.0 - share) * math.log(one) + share * math.log(other))
