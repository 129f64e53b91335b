"""Watches a router's data path from outside: a process that is alive may have stopped to route.

Two sessions go through the router as agents do; one puts on a key that was never declared, so that the
router has to find the way anew, the other hears it through a wildcard.
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
from protocols.bus.transport.session import close_session, open_session, release, zenoh_call

PERIOD_S = 0.25
DEAD_AFTER_S = 0.9
_LATE_S = 0.4


class Canary:
    """Two sessions through one router. config: how a client reaches it; prefix: keys to use, ``…/canary/<router>``.

    Raises BusDead or InputError where the router does not let them in.
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
                self._ear: zenoh.Subscriber[None] = self._sessions[0].declare_subscriber(
                    f"{self._prefix}/*", self._hear
                )
        except BaseException:
            for session in self._sessions:
                close_session(session)
            raise
        self._last = self._looked = clock()
        # Its own thread: into a router that hangs a put may hang too.
        self._thread = threading.Thread(target=self._sing, name="canary", daemon=True)
        self._thread.start()

    def _sing(self) -> None:
        number = 0
        # Quickly until it is first heard: at the start a subscription takes a moment to be known.
        while not self._stop.wait(PERIOD_S if self.heard else 0.05):
            key = f"{self._prefix}/{number}"
            self._sent = {**self._sent, key: self._clock()} if len(self._sent) < 16 else {key: self._clock()}
            with suppress(BusDead), zenoh_call("canary"):
                self._sessions[1].put(key, b"")
            number += 1

    def _hear(self, sample: zenoh.Sample) -> None:
        self._last = self._clock()
        self.heard += 1
        self.delay_s = self._last - self._sent.get(str(sample.key_expr), self._last)

    def silent_s(self) -> float:
        """For how long nothing has come through; ask it several times a second.

        When the asker itself was held up (the machine slept, the process was stopped) the count begins again.
        """
        now = self._clock()
        if now - self._looked > _LATE_S:
            self._last = now
        self._looked = now
        return now - self._last

    def close(self) -> None:
        """End both sessions."""
        self._stop.set()
        release(self._ear)
        for session in self._sessions:
            close_session(session)
