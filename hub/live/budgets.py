"""What one camera may cost the hub: rows a second, labels of its own, people, boots; who has no end in view is refused.

Rates are bounded on two clocks, the hub's and the camera's own: windows of what is kept are windows on the camera's
clock, and a clock that hardly advances would fill them without end.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from protocols.core.clocks import NANOSECONDS
from protocols.core.ranges import MAX_CAMERAS
from protocols.messages import syncline_pb2 as pb

_MAX_DETECTIONS = 256
"""Of one frame, those with the highest scores: association compares every one with every track."""
_ROWS_PER_S, _BURST_ROWS = 8_000.0, 32_000.0
"""Frames and detections of a camera a second: twelve points at 330 Hz take half of it. The burst is what a camera of
100 Hz sends after an outage of a minute."""
_PEOPLE_PER_S = 600.0
"""Detections of people a second that are kept for calibration: twenty people at 30 Hz."""
_REORDERED_S = 1.0  # s: a frame may be late by as much, on its own clock


@dataclass(slots=True)
class _Bucket:
    """A token bucket. time: of the last refill, on a clock that may be set back."""

    rate: float
    burst: float
    tokens: float
    time: float | None = None

    def refill(self, time: float) -> None:
        last = self.time
        if last is not None and time > last:
            tokens = self.tokens + (time - last) * self.rate
            self.tokens = tokens if tokens < self.burst else self.burst
        # Frames may arrive out of order; a clock that was set back begins anew.
        if last is None or not last - _REORDERED_S < time < last:
            self.time = time

    def take(self, cost: float) -> bool:
        taken = cost <= self.tokens
        self.tokens -= cost if taken else 0.0
        return taken


@dataclass(slots=True)
class _CameraBudget:
    """boot: whose clock ``own`` and ``people`` are on."""

    boot: str = ""
    hub: _Bucket = field(default_factory=lambda: _Bucket(_ROWS_PER_S, _BURST_ROWS, _BURST_ROWS))
    own: _Bucket = field(default_factory=lambda: _Bucket(_ROWS_PER_S, _BURST_ROWS, _BURST_ROWS))
    people: _Bucket = field(default_factory=lambda: _Bucket(_PEOPLE_PER_S, 2.0 * _PEOPLE_PER_S, 2.0 * _PEOPLE_PER_S))


class CameraBudgets:
    """The budgets of all cameras. counts: frames left out, by camera; when: hub time [s] of the last of them."""

    def __init__(self) -> None:
        self._cameras: dict[str, _CameraBudget] = {}
        self.counts: Counter[str] = Counter()
        self.when: dict[str, float] = {}

    def admit(self, message: pb.Observation, now: float) -> pb.Observation | None:
        """The observation, with no more detections than are used, or None; now: the hub's clock [s]."""
        budget = self._of(message.camera)
        if budget is None:
            return None
        hub, own = budget.hub, budget.own
        if budget.boot != message.boot_id:
            # A new clock; on the hub's clock a camera that restarts has no more than before.
            budget.boot, own.time = message.boot_id, None
        count = len(message.detections)
        cost = 1.0 + count
        if hub.time != now:
            hub.refill(now)
        own.refill(message.device_time_ns / NANOSECONDS)
        if hub.tokens < cost or own.tokens < cost:
            self.counts[message.camera] += 1
            self.when[message.camera] = now
            return None
        hub.tokens -= cost
        own.tokens -= cost
        if count <= _MAX_DETECTIONS:
            return message
        best = sorted(range(len(message.detections)), key=lambda index: -message.detections[index].score)
        copy = pb.Observation()
        copy.CopyFrom(message)
        del copy.detections[:]
        copy.detections.extend(message.detections[index] for index in sorted(best[:_MAX_DETECTIONS]))
        return copy

    def admits_people(self, message: pb.Observation) -> bool:
        """Whether an admitted observation may also be kept for calibration from people."""
        people = self._cameras[message.camera].people
        people.refill(message.device_time_ns / NANOSECONDS)
        return people.take(sum(detection.kind == "person" for detection in message.detections))

    def admits_camera(self, camera: str) -> bool:
        """Whether there is room for this camera."""
        return self._of(camera) is not None

    def _of(self, camera: str) -> _CameraBudget | None:
        budget = self._cameras.get(camera)
        if budget is None and len(self._cameras) < MAX_CAMERAS:
            budget = self._cameras[camera] = _CameraBudget()
        return budget

    def exceeded(self, now: float, within_s: float) -> list[str]:
        """Cameras of which frames were left out in the last ``within_s``."""
        return sorted(camera for camera, when in self.when.items() if now - when < within_s)
