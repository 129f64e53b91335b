"""An in-process MAVLink transport with two ends, for simulations that run faster than real time."""

from __future__ import annotations

from collections import deque

from edge.mavlink.link.transport import ONLY, Address


class Pipe:
    """One end."""

    def __init__(self) -> None:
        self._inbox: deque[bytes] = deque()
        self.other: Pipe | None = None

    @classmethod
    def pair(cls) -> tuple[Pipe, Pipe]:
        """Two connected ends."""
        a, b = cls(), cls()
        a.other, b.other = b, a
        return a, b

    def wait(self, timeout_s: float) -> bool:
        return bool(self._inbox)

    def receive(self) -> list[tuple[bytes, Address]]:
        out = [(data, ONLY) for data in self._inbox]
        self._inbox.clear()
        return out

    def send(self, data: bytes, address: Address | None) -> bool:
        if self.other is not None:
            self.other._inbox.append(data)
        return True

    def close(self) -> None:
        self._inbox.clear()
