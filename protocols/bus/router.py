"""A Zenoh router inside this process, so that a demo or a small rig needs no other program."""

from __future__ import annotations

import socket
from types import TracebackType
from typing import Self

from protocols.bus.session import close_session, open_session
from protocols.bus.settings import LOOPBACK_ROUTER, BusConfig


class Router:
    """Relays between the clients that connect to it while the context is open.

    listen: endpoints; more routers to join in connect. Raises InputError if an address is taken.
    """

    def __init__(self, *listen: str, connect: tuple[str, ...] = ()) -> None:
        self.listen = listen or (LOOPBACK_ROUTER,)
        config = BusConfig(mode="router", listen=self.listen, connect=connect)
        self._session = open_session(config)

    def close(self) -> None:
        """Stop relaying."""
        close_session(self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def free_endpoint() -> str:
    """A loopback endpoint that nobody listens on at this moment, for demos and tests."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
