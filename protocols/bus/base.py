"""What agents see of the bus. Two implementations keep this contract: Zenoh and memory."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from google.protobuf.message import Message

from protocols.topics import Topic


class BusDead(Exception):
    """The bus cannot be used any more (a panic in the transport): exit and be restarted."""


class BusStopped(Exception):
    """Opening the bus was given up because the caller asked to stop."""


@dataclass(frozen=True, slots=True)
class Received:
    """One message that passed the gate.

    arrival_ns: the receiver's clock (Unix, ns) when it came off the wire, not when it was drained.
    source: the connection that it came from, as the transport names it; "" where it does not.
    """

    topic: Topic
    agent: str
    message: Message
    arrival_ns: int
    source: str = ""


@dataclass(frozen=True, slots=True)
class Refusal:
    """One message that was not let in. agent: by its key, "" where that names none; detail: for a person."""

    reason: str
    agent: str
    key: str
    detail: str
    sequence: int | None = None


@dataclass(frozen=True, slots=True)
class AgentEvent:
    """An agent appeared (alive) or is gone. Two boots of one id are two agents here."""

    role: str
    agent: str
    boot_id: str
    alive: bool


class Publisher(Protocol):
    """Publishes one topic of one agent. Not for use by two threads at once."""

    def put(self, message: Message) -> None:
        """Hand one message over; never waits for a slow receiver unless declared with ``block``.

        Raises TypeError for a message of another topic, Rejected if it is too big, BusDead.
        """

    def wait_matched(self, timeout_s: float) -> bool:
        """Wait until somebody subscribes to this publisher's key; False when the time is up."""

    def close(self) -> None:
        """Stop publishing; what late joiners could still have fetched is gone."""


class Subscription(Protocol):
    """Messages of one topic, from one or all agents of the site."""

    def drain(self) -> list[Received]:
        """What arrived since the last call, in order of arrival; bad messages are only counted."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until there is something to drain; False when the time is up."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Counts since the start.

        received: passed the gate. dropped: this queue was full. lost: never came, by the publisher's count.
        skipped: the same of a topic of which only the newest counts. rejected.<reason>: stopped at the gate.
        """

    def refusals(self) -> list[Refusal]:
        """What was refused since the last call, the first few of it: the counters have all."""

    def close(self) -> None:
        """Stop receiving; what is queued can still be drained."""


class AgentWatch(Protocol):
    """Who is alive on the site."""

    def drain(self) -> list[AgentEvent]:
        """Changes since the last call; the first call tells of everyone who is there."""

    def close(self) -> None:
        """Stop watching."""


class Bus(Protocol):
    """One process's connection to the others of a site."""

    @property
    def site(self) -> str:
        """The site whose keys this bus uses."""

    def publisher(self, topic: Topic, agent: str, *, rate_hz: float | None = None, block: bool = False) -> Publisher:
        """Declare a publisher.

        rate_hz: messages a second if it differs much from the catalogue's; sizes the cache that heals
            an outage of a minute.
        block: wait for a slow link instead of relying on that cache (replay as fast as possible).
        """

    def subscribe(self, topic: Topic, agent: str = "*") -> Subscription:
        """Subscribe to a topic of one agent, or of all; raises InputError for an unusable id."""

    def announce(self, role: str, agent: str, boot_id: str) -> AbstractContextManager[None]:
        """Be seen as alive while the context is open; the others notice a killed process at once."""

    def watch_agents(self) -> AgentWatch:
        """Watch all agents of the site come and go."""

    def close(self) -> None:
        """Close everything that was declared on this bus. May be called twice."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
