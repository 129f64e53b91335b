"""Outgoing messages by priority, for a link that carries less than there is to say.

When a serial link is full, old positions are replaced by new ones and the least important wait: heartbeats and
acknowledgements go first, then commands, the tracking status, and last what describes the camera.
"""

from __future__ import annotations

import heapq
import itertools
from collections import Counter
from typing import Any

from protocols.core.clocks import NANOSECONDS

_PRIORITIES = {
    "HEARTBEAT": 0,
    "COMMAND_ACK": 0,
    "TIMESYNC": 0,
    "COMMAND_LONG": 1,
    "GIMBAL_MANAGER_SET_PITCHYAW": 1,
    "FOLLOW_TARGET": 1,
    "CAMERA_TRACKING_IMAGE_STATUS": 2,
    "CAMERA_TRACKING_GEO_STATUS": 3,
    "STATUSTEXT": 3,
    "CAMERA_FOV_STATUS": 5,
}
_OTHERS = 4  # priority of message types without one
_ONLY_NEWEST = frozenset(
    {
        "HEARTBEAT",
        "TIMESYNC",
        "GIMBAL_MANAGER_SET_PITCHYAW",
        "FOLLOW_TARGET",
        "CAMERA_TRACKING_IMAGE_STATUS",
        "CAMERA_TRACKING_GEO_STATUS",
        "CAMERA_FOV_STATUS",
    }
)
"""Message types of which a waiting one is replaced by the next."""
_CAPACITY = 64  # messages that wait
_BURST_S = 0.1  # of the link's capacity may lie in the buffers below, which delay what comes after


class Outbox:
    """Messages that wait to be sent. bytes_s: capacity of the link [bytes/s], None: unlimited.

    counters: counts what is dropped, by type ("dropped.CAMERA_FOV_STATUS").
    """

    def __init__(self, bytes_s: float | None, counters: Counter[str]) -> None:
        self._bytes_s = bytes_s
        self._heap: list[tuple[int, int, Any]] = []
        self._order = itertools.count()
        self._tokens = 0.0 if bytes_s is None else _BURST_S * bytes_s
        self._filled_ns: int | None = None
        self._counters = counters

    def put(self, message: Any) -> None:
        """Add a message. The least important one is dropped where there is no room."""
        kind = message.get_type()
        entry = (_PRIORITIES.get(kind, _OTHERS), next(self._order), message)
        if kind in _ONLY_NEWEST:
            for k, (priority, order, waiting) in enumerate(self._heap):
                if waiting.get_type() == kind:
                    self._heap[k] = (priority, order, message)
                    self._counters[f"dropped.{kind}"] += 1
                    return
        heapq.heappush(self._heap, entry)
        if len(self._heap) > _CAPACITY:
            last = max(self._heap)
            self._heap.remove(last)
            heapq.heapify(self._heap)
            self._counters[f"dropped.{last[2].get_type()}"] += 1

    def next(self, now_ns: int) -> Any:
        """The message to send now; None if there is none or the link is full. It waits until ``sent``."""
        if self._bytes_s is not None:
            elapsed = 0 if self._filled_ns is None else max(now_ns - self._filled_ns, 0)
            self._filled_ns = now_ns
            self._tokens = min(self._tokens + self._bytes_s * elapsed / NANOSECONDS, _BURST_S * self._bytes_s)
            if self._tokens <= 0.0:
                return None
        return self._heap[0][2] if self._heap else None

    def sent(self, size: int) -> None:
        """The message of ``next`` was sent with a size [bytes]."""
        heapq.heappop(self._heap)
        self._tokens -= size

    def clear(self) -> None:
        """Drop everything: the link is down, and what waited would be late."""
        self._heap.clear()
