"""Monitors a router's data path with a canary: a process that is alive may have stopped routing.

Two sessions connect to the router as agents do; one publishes on a key that was never declared, so that the router
must resolve the route anew, the other receives it through a wildcard subscription.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress

import zenoh

from protocols.bus.base import BusDead
from protocols.bus.settings import BusConfig
from protocols.bus.transport.session import close_session, open_session, undeclare_all, zenoh_call

PERIOD_S = 0.25  # a quarter of DEAD_AFTER_S
DEAD_AFTER_S = 0.9  # so that with a restart and reconnection an outage stays below two seconds
_LATE_S = 0.4  # after which the caller itself was stopped, and not the router


class Canary:
    """Two sessions through one router. config: how a client reaches it; prefix: keys to use, ``…/canary/<router>``.

    Raises BusDead or InputError where the router refuses them.
    """

    def __init__(self, config: BusConfig, prefix: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._prefix = f"{prefix}/{uuid.uuid4().hex[:12]}"
        self._sent: dict[str, float] = {}
        self._stop = threading.Event()
        self.delay_s = 0.0
        self.heard = 0
        self._sessions = [open_session(config, timeout_s=5.0)]
        try:
            self._sessions.append(open_session(config, timeout_s=5.0))
            with zenoh_call("canary"):
                self._subscriber: zenoh.Subscriber[None] = self._sessions[0].declare_subscriber(
                    f"{self._prefix}/*", self._receive
                )
        except BaseException:
            for session in self._sessions:
                close_session(session)
            raise
        self._last = self._looked = clock()
        # Its own thread: a put to a router that hangs may hang too.
        self._thread = threading.Thread(target=self._publish, name="canary", daemon=True)
        self._thread.start()

    def _publish(self) -> None:
        number = 0
        # Fast until the first message arrives: a new subscription takes a moment to become effective.
        while not self._stop.wait(PERIOD_S if self.heard else 0.05):
            key = f"{self._prefix}/{number}"
            self._sent = {**self._sent, key: self._clock()} if len(self._sent) < 16 else {key: self._clock()}
            with suppress(BusDead), zenoh_call("canary"):
                self._sessions[1].put(key, b"")
            number += 1

    def _receive(self, sample: zenoh.Sample) -> None:
        self._last = self._clock()
        self.heard += 1
        self.delay_s = self._last - self._sent.get(str(sample.key_expr), self._last)

    def silent_s(self) -> float:
        """Seconds since the last message came through; call it several times a second.

        If the caller itself was delayed (the machine slept, the process was stopped) the count restarts.
        """
        now = self._clock()
        if now - self._looked > _LATE_S:
            self._last = now
        self._looked = now
        return now - self._last

    def close(self) -> None:
        """End both sessions."""
        self._stop.set()
        undeclare_all(self._subscriber)
        for session in self._sessions:
            close_session(session)
