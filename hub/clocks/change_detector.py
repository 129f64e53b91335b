"""Detection of steps and rate changes of camera clocks while the cameras run.

Step: the frame numbers predict the time between two frames; a device time that differs from it while the frames
arrive on schedule is a step. Rate change: observable only against another clock, the hub's, at which frames arrive,
taken at the lowest delay of each half second. The delays then leave their previous line; the slopes that links and
busy machines produce without a rate change are estimated from the same camera's past.

Both begin a new segment of the clock, as a restart of the agent does. A step is known at once, to about the noise of
two time stamps, so the previous time map, moved by it, holds for the new segment until that is calibrated from its own
observations. A rate change is detected after as little as two seconds; its estimate is refined from the seconds after.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hub.clocks.delay_changepoint import (
    LEVEL_BINS,
    MIN_SCATTER_S,
    WINDOW_BINS,
    RateChangeEstimator,
    StepEstimator,
    fit_changepoint,
    fit_line,
    slope_has_changed,
)
from protocols.session.builder import is_stray_number

MIN_STEP_S = 0.2
"""Smaller steps cannot be distinguished from late frames [s]."""
_STEP_SIGMAS = 5.0  # of what the frame numbers predict, whose period jitters: one in a million by chance
_LONGEST_PAUSE_S = 3600.0
"""Of a camera whose frames waited for the hub, so that no arrival shows whether it paused or its clock was set. A clock
that is set for the first time, as of a board without a battery, steps by years."""
_FETCHED_BINS = 4  # 2 s: more than the jitter of a link
_USUAL_BINS = 8
"""4 s, of which the median is the usual delay: a frame from before a pause, in a bin of its own, does not change it"""
_SCREENING_SIGMAS = 2.0
"""Excess delay, in usual deviations from the line, from which the changepoint test is made at all"""
_BIN_S = 0.5  # s: the smallest delay of each counts
_BASELINE_BINS, _MAX_BINS = 24, 60  # 12 s and 30 s
_REFIT_BINS = 8
"""Bins after which the baseline is fitted again"""
_FORGETTING = 1 / 32  # of the mean period: over 32 frames
_SLOPE_LAG_BINS, _SLOPE_MEMORY = 24, 30
"""Slope statistics: how many bins behind the present, and averaged over how many refits of the baseline"""
_FALSE_ALARM_SHARE, _FALSE_ALARM_WEIGHT = 0.5, 0.2
"""A rate change of which less than this share remains after refinement was a false alarm; weight of its slope in the
statistics from then on"""
_RATE_REFINEMENT_BINS, _STEP_REFINEMENT_BINS = 40, 6
"""Bins for which a rate change and a step are refined"""
_MIN_PRESTEP_BINS, _MAX_PRESTEP_BINS = 8, 20
"""Bins before a step that give its baseline"""
_MAX_PERIODS = 120  # frames kept for the median period
_MAX_NAME_LENGTH = 63  # as names of cameras have it
_MAX_RUNS = 8
"""Runs of one camera's agent that are remembered"""


@dataclass(frozen=True, slots=True)
class ClockChange:
    """The change that begins a new segment of a camera's clock.

    previous_segment, segment: names of the one that ended and of the new one. step_s: new clock less old clock at
    detection [s]; step_std_s: its std. rate_change: new rate over old rate, less 1 (0 for a step). detected_at_s: time
    of detection on the new clock.
    """

    camera: str
    kind: Literal["step", "drift"]
    previous_segment: str
    segment: str
    step_s: float
    step_std_s: float
    rate_change: float = 0.0
    detected_at_s: float = 0.0


@dataclass(slots=True)
class _ClockState:
    """One run of one camera's agent."""

    segments: list[tuple[int, str]]
    """(first sequence, name)"""
    last: tuple[int, int, float, float | None] | None = None
    """(sequence, frame, device time [s], arrival [s])"""
    pause: tuple[float, float, float, float, list[tuple[float, float]]] | None = None
    """Of a jump forward that was taken for one: until when [s] a frame of less delay than this [s] shows it a step, of
    this size and std [s], after these bins"""
    periods: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_PERIODS))
    bins: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_MAX_BINS))
    """(device time, arrival - device time) of the lowest-delay frame of each half second; the last bin is incomplete"""
    bin_start: float = 0.0
    """Device time of the first frame of the last bin"""
    line: tuple[float, float] | None = None
    """Baseline (delay at time 0, slope), fitted some bins ago"""
    bins_until_refit: int = 0
    delay_power: float = 0.0
    """Mean square of the deviations from it some bins later [s²]"""
    slope_power: dict[int, float] = field(default_factory=dict)
    """Mean square of the slopes of delays by window length in bins, over the last minutes"""
    slope_updates: int = 0
    refinement: RateChangeEstimator | StepEstimator | None = None
    """Estimator that refines the last change from the bins after it"""
    origin_ns: int = 0
    period: float = 0.0
    frames_until_period: int = 0


def _is_out_of_order(
    last: tuple[int, int, float, float | None], sequence: int, time: float, arrival: float | None
) -> bool:
    """Whether a frame comes late or its number is none. last, time, arrival: as of ``_ClockState.last``."""
    elapsed = time - last[2] if arrival is None or last[3] is None else arrival - last[3]
    return sequence <= last[0] or is_stray_number(sequence - last[0], elapsed)


class ClockChangeDetector:
    """Detector for the clocks of all cameras. It has no clock of its own: arrival times are passed in."""

    def __init__(self) -> None:
        self._clocks: dict[tuple[str, str], _ClockState] = {}
        self._changes: list[ClockChange] = []

    def handle(
        self,
        camera: str,
        boot: str,
        sequence: int,
        frame: int,
        device_ns: int,
        arrival: float | None,
        *,
        waited: bool = False,
    ) -> tuple[str, ClockChange | None]:
        """Add one frame's time stamp; returns its clock segment, and the change if it begins a new one.

        device_ns: the frame's device time. arrival: time of arrival [s, one clock for all cameras]; None = not known.
        waited: it waited for the hub, which will know more by the frames that come by themselves.
        """
        clock = self._clocks.get((camera, boot))
        if clock is None:
            runs = [key for key in self._clocks if key[0] == camera]
            if len(runs) >= _MAX_RUNS:
                del self._clocks[runs[0]]
            clock = self._clocks[camera, boot] = _ClockState([(0, boot)])
        if clock.last is None:
            clock.origin_ns = device_ns
        time = (device_ns - clock.origin_ns) * 1e-9  # Unix times in ns do not fit a float
        if clock.last is not None and _is_out_of_order(clock.last, sequence, time, arrival):
            name = next((name for first, name in reversed(clock.segments) if first <= sequence), boot)
            return name, None
        change = self._detect_step(clock, camera, sequence, frame, time, arrival, waited)
        clock.last = (sequence, frame, time, arrival)
        if change is None and arrival is not None and self._add_delay(clock, time, arrival):
            change = self._detect_drift(clock, camera, sequence, time)
        if change is not None:
            self._changes.append(change)
        return clock.segments[-1][1], change

    def changes_since(self, camera: str, boot: str) -> list[ClockChange]:
        """The changes that lead from the segment ``boot`` to the present one, in order."""
        chain: list[ClockChange] = []
        for change in self._changes:
            if change.camera == camera and change.previous_segment == (chain[-1].segment if chain else boot):
                chain.append(change)
        return chain

    def change_into(self, boot: str) -> ClockChange | None:
        """The change that began the segment ``boot``, in its present estimate; None if no change did."""
        return next((change for change in reversed(self._changes) if change.segment == boot), None)

    def relative_rate(self, camera: str, boot: str) -> float | None:
        """Rate of the hub's clock relative to this one, less 1, over the last seconds; None = not known yet."""
        clock = self._clocks.get((camera, boot))
        if clock is None or len(clock.bins) < WINDOW_BINS[-1] + 1:
            return None
        return fit_line(np.array(list(clock.bins)[:-1]))[1]

    def _detect_step(
        self,
        clock: _ClockState,
        camera: str,
        sequence: int,
        frame: int,
        time: float,
        arrival: float | None,
        waited: bool,
    ) -> ClockChange | None:
        if clock.last is None:
            return None
        _, last_frame, last_time, last_arrival = clock.last
        elapsed, frames = time - last_time, frame - last_frame
        if frames > 0 and 0.0 < elapsed < MIN_STEP_S + 1.0 and len(clock.periods) < 5:
            clock.periods.append(elapsed / frames)
            return None
        if len(clock.periods) < 5 or frames <= 0:
            return None
        if clock.frames_until_period <= 0:
            # Not with every frame: with a thousand cameras that would cost as much as all the rest.
            clock.period, clock.frames_until_period = (
                float(np.median(clock.periods)),
                min(len(clock.periods), _MAX_PERIODS // 4),
            )
        clock.frames_until_period -= 1
        period = clock.period
        step = elapsed - frames * period
        if abs(step) > MIN_STEP_S:
            spread = max(1.5 * float(np.median(np.abs(np.array(clock.periods) - period))), 1e-4)
            # The error of the period, which is a median, grows with every frame that is missing.
            std = spread * math.hypot(math.sqrt(frames), frames * math.sqrt(0.5 * math.pi / len(clock.periods)))
            clock.pause = None
            if abs(step) < _STEP_SIGMAS * std:
                return None
            if 0.0 < step < _LONGEST_PAUSE_S and (waited or self._is_fetched(clock, last_time, last_arrival)):
                return None  # as likely frames that the camera did not count
            earlier = list(clock.bins)[-1 - _MAX_PRESTEP_BINS : -1] if arrival is not None else []
            if not self._has_usual_delay(clock, time, arrival, step):
                return self._start_segment(clock, camera, "step", sequence, step, std, earlier=earlier)
            delays = [delay for _, delay in earlier]
            if step > 0.0 and len(delays) >= _FETCHED_BINS:
                # A late frame looks alike if the clock was set; those after it show which it was. Less delay than ever
                # by more than links vary, of which the queue of an outage may be drained yet, no pause explains.
                least = min(delays)
                earliest = least - max(MIN_STEP_S, 0.5 * step, float(np.median(delays)) - least)
                clock.pause = time + _USUAL_BINS * _BIN_S, earliest, step, std, earlier
            return None
        clock.periods.append(elapsed / frames)
        if clock.pause is not None and arrival is not None:
            until, earliest, step, std, earlier = clock.pause
            if time > until:
                clock.pause = None
            elif arrival - time < earliest:
                return self._start_segment(clock, camera, "step", sequence, step, std, earlier=earlier)
        return None

    @staticmethod
    def _has_usual_delay(clock: _ClockState, time: float, arrival: float | None, step: float) -> bool:
        """Whether both clocks have advanced: of a camera that stalled without counting frames, for one.

        By the last frame, and by the frames before that: of a machine that was suspended the last frame arrived late.
        """
        assert clock.last is not None
        _, _, last_time, last_arrival = clock.last
        if arrival is None or last_arrival is None or time <= last_time:
            return False
        usual = [last_arrival - last_time]
        if clock.bins:
            usual.append(float(np.median([delay for _, delay in list(clock.bins)[-_USUAL_BINS:]])))
        # A clock that is set forward makes frames seem earlier, never later.
        earliest, latest = (-max(MIN_STEP_S, 0.5 * step), math.inf) if step > 0.0 else (-MIN_STEP_S, MIN_STEP_S)
        return any(earliest < arrival - time - delay < latest for delay in usual)

    @staticmethod
    def _is_fetched(clock: _ClockState, time: float, arrival: float | None) -> bool:
        """Whether the frames up to ``time`` came faster than they were filmed, as those fetched after an outage."""
        if arrival is None or len(clock.bins) < _FETCHED_BINS:
            return False
        begin, delay = clock.bins[-_FETCHED_BINS]
        return arrival - (begin + delay) < 0.5 * (time - begin)

    def _add_delay(self, clock: _ClockState, time: float, arrival: float) -> bool:
        """Add one delay; True when a bin is complete."""
        delay = arrival - time
        if not clock.bins or time - clock.bin_start >= _BIN_S:
            clock.bins.append((time, delay))
            clock.bin_start = time
            return len(clock.bins) > 1
        if delay < clock.bins[-1][1]:
            clock.bins[-1] = (time, delay)
        return False

    def _detect_drift(self, clock: _ClockState, camera: str, sequence: int, now: float) -> ClockChange | None:
        time, delay = clock.bins[-2]
        if clock.refinement is not None:
            self._refine(clock, clock.refinement, time, delay)
        if len(clock.bins) <= _BASELINE_BINS + WINDOW_BINS[-1]:
            return None
        if clock.line is None or clock.bins_until_refit <= 0:
            done = np.array(list(clock.bins)[:-1])
            level, slope, sigma = fit_line(done[: -WINDOW_BINS[0]])
            clock.line, clock.bins_until_refit = (level, slope), _REFIT_BINS
            clock.delay_power = clock.delay_power or sigma * sigma
            _update_slope_statistics(clock, slope)
        clock.bins_until_refit -= 1
        excess = delay - clock.line[0] - clock.line[1] * time
        delay_power = clock.delay_power
        clock.delay_power += _FORGETTING * (min(excess * excess, 9.0 * delay_power) - delay_power)
        if excess * excess < _SCREENING_SIGMAS * _SCREENING_SIGMAS * max(delay_power, MIN_SCATTER_S * MIN_SCATTER_S):
            return None  # nearly always; the test that follows costs more than all the rest
        done = np.array(list(clock.bins)[:-1])
        span = next((n for n in WINDOW_BINS if slope_has_changed(done, n, _expected_slope(clock, n))), None)
        if span is None:
            return None
        base = fit_line(done[:-span])
        onset, slope_change = fit_changepoint(done, span)
        shift, spread = slope_change * (now - onset), abs(slope_change) * _BIN_S + base[2]
        change = self._start_segment(clock, camera, "drift", sequence, -shift, spread, -slope_change)
        change = replace(change, detected_at_s=clock.origin_ns * 1e-9 + now)
        clock.refinement = refinement = RateChangeEstimator(
            len(self._changes), onset, now, (base[0], base[1]), base[2], onset, slope_change, slope_change
        )
        for bin_time, bin_delay in done:
            if bin_time > onset:
                refinement.update(float(bin_time), float(bin_delay))
        return change

    def _refine(
        self, clock: _ClockState, refinement: RateChangeEstimator | StepEstimator, time: float, delay: float
    ) -> None:
        """Refine the estimate of a rate change or a step with one more bin."""
        change = self._changes[refinement.change_index]
        if isinstance(refinement, StepEstimator):
            step, std = refinement.update(time, delay)
            self._changes[refinement.change_index] = replace(change, step_s=step, step_std_s=std)
            if refinement.bins_seen >= _STEP_REFINEMENT_BINS:
                clock.refinement = None
            return
        refinement.update(time, delay)
        rate_change = -refinement.slope_change
        step = rate_change * (refinement.detected_at - refinement.onset)
        self._changes[refinement.change_index] = replace(change, rate_change=rate_change, step_s=step)
        if refinement.count >= _RATE_REFINEMENT_BINS:
            clock.refinement = None
            if abs(refinement.recent_slope) < _FALSE_ALARM_SHARE * abs(refinement.first_slope_change):
                # Another route, or a slew that has ended and moved the clock by as much: the delays cannot tell.
                std = math.hypot(change.step_std_s, np.mean([excess for _, excess in refinement.recent]))
                change = replace(change, rate_change=0.0, step_s=0.0, step_std_s=std)
                self._changes[refinement.change_index] = change
                for span in (WINDOW_BINS[0], WINDOW_BINS[-1]):
                    seen = clock.slope_power.get(span, 0.0)
                    clock.slope_power[span] = seen + _FALSE_ALARM_WEIGHT * (refinement.first_slope_change**2 - seen)

    def _start_segment(
        self,
        clock: _ClockState,
        camera: str,
        kind: Literal["step", "drift"],
        sequence: int,
        step: float,
        std: float,
        rate_change: float = 0.0,
        earlier: Sequence[tuple[float, float]] = (),
    ) -> ClockChange:
        """earlier: bins before a step, by which it is refined where there are enough."""
        previous, first = clock.segments[-1][1], clock.segments[0][1]
        suffix = f"-e{len(clock.segments)}"
        name = first[: _MAX_NAME_LENGTH - len(suffix)] + suffix
        clock.segments.append((sequence, name))
        clock.bins.clear()
        clock.line, clock.delay_power, clock.refinement, clock.pause = None, 0.0, None, None
        if len(earlier) >= _MIN_PRESTEP_BINS:
            level, slope, sigma = fit_line(np.array(earlier))
            clock.refinement = StepEstimator(len(self._changes), step, float(std), (level, slope), sigma)
        return ClockChange(camera, kind, previous, name, step, float(std), rate_change)


def _update_slope_statistics(clock: _ClockState, slope: float) -> None:
    """Update the mean square slope of windows some bins ago, so that no window is compared with itself."""
    bins, last = clock.bins, len(clock.bins) - 2 - _SLOPE_LAG_BINS
    if last < WINDOW_BINS[-1] + LEVEL_BINS:
        return
    clock.slope_updates = min(clock.slope_updates + 1, _SLOPE_MEMORY)
    for span in (WINDOW_BINS[0], WINDOW_BINS[-1]):
        first = last - span
        begin = bins[first][0]
        level = (
            sum(bins[i][1] - slope * (bins[i][0] - begin) for i in range(first - LEVEL_BINS + 1, first + 1))
            / LEVEL_BINS
        )
        weight = product = 0.0
        for i in range(first + 1, last + 1):
            elapsed = bins[i][0] - begin
            weight += elapsed * elapsed
            product += elapsed * (bins[i][1] - slope * elapsed - level)
        seen = clock.slope_power.get(span, 0.0)
        clock.slope_power[span] = seen + ((product / weight) ** 2 - seen) / clock.slope_updates


def _expected_slope(clock: _ClockState, span: int) -> float:
    """Rms slope of windows of ``span`` bins, interpolated (log-log) between the shortest and the longest."""
    one, other = (math.sqrt(clock.slope_power.get(n, 0.0)) for n in (WINDOW_BINS[0], WINDOW_BINS[-1]))
    if not one or not other:
        return max(one, other)
    share = math.log(span / WINDOW_BINS[0]) / math.log(WINDOW_BINS[-1] / WINDOW_BINS[0])
    return math.exp((1.0 - share) * math.log(one) + share * math.log(other))
