"""The bus interface that agents use. Two implementations: Zenoh and in-memory. Commands of an operator."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Set
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, Protocol, Self

from google.protobuf.message import Message

from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.topics import COMMAND, Topic
from protocols.validation.rules import SCHEMA_VERSION

_DUPLICATE_WINDOW = 1024  # commands: a click a second for a quarter of an hour


class BusDead(Exception):
    """The bus is unusable (a panic in the transport): the process must exit and be restarted."""


class BusStopped(Exception):
    """Opening the bus was cancelled by the caller's stop condition."""


class Received(NamedTuple):
    """One validated message.

    arrival_ns: the receiver's clock (Unix, ns) when it was received, not when it was drained.
    source: the connection it came from, as the transport names it; "" where unknown.
    """

    topic: Topic
    agent: str
    message: Message
    arrival_ns: int
    source: str = ""


@dataclass(frozen=True, slots=True)
class Refusal:
    """One rejected message. agent: by its key, "" where the key has none; detail: for the user."""

    reason: str
    agent: str
    key: str
    detail: str
    sequence: int | None = None


@dataclass(frozen=True, slots=True)
class AgentEvent:
    """An agent appeared (alive) or disappeared. Two boots of one id count as two agents."""

    role: str
    agent: str
    boot_id: str
    alive: bool


class Publisher(Protocol):
    """Publishes one topic of one agent. Not for use by two threads at once."""

    def put(self, message: Message) -> None:
        """Publish one message; never waits for a slow receiver unless declared with ``block``.

        Raises TypeError for a message of another topic, Rejected if it is too large, BusDead.
        """

    def wait_matched(self, timeout_s: float) -> bool:
        """Wait until a subscriber matches this publisher's key; False on timeout."""

    def close(self) -> None:
        """Stop publishing; the cache for late joiners is discarded."""


class Subscription(Protocol):
    """Messages of one topic, from one or all agents of the site."""

    def drain(self) -> list[Received]:
        """The messages received since the last call, in order of arrival; invalid ones are only counted."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until a message can be drained; False on timeout."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Counts since the start.

        received: valid messages. dropped: this queue was full. lost: never arrived, by the publisher's sequence
        numbers. skipped: the same for topics with Delivery.LATEST. rejected.<reason>: failed validation.
        """

    def ignore(self, agents: Set[str]) -> None:
        """Drop what these agents publish from now on before it is decoded, and of nobody else."""

    def refusals(self) -> list[Refusal]:
        """The messages rejected since the last call, a bounded number of them: the counters include all."""

    def flush(self) -> None:
        """Queue what is held back until missing messages before it arrive; those count as lost."""

    def close(self) -> None:
        """Stop receiving; queued messages can still be drained."""


class AgentWatch(Protocol):
    """Watches which agents are alive on the site."""

    def drain(self) -> list[AgentEvent]:
        """Changes since the last call; the first call reports all agents that are alive."""

    def close(self) -> None:
        """Stop watching."""


class Bus(Protocol):
    """One process's connection to the others of a site."""

    @property
    def site(self) -> str:
        """The site whose keys this bus uses."""

    def publisher(self, topic: Topic, agent: str, *, rate_hz: float | None = None, block: bool = False) -> Publisher:
        """Declare a publisher.

        rate_hz: messages a second if it differs much from the catalogue's; it sets the size of the cache that covers
            an outage of a minute.
        block: wait for a slow link instead of relying on that cache (replay as fast as possible).
        """

    def subscribe(self, topic: Topic, agent: str = "*") -> Subscription:
        """Subscribe to a topic of one agent, or of all; raises InputError for an unusable id."""

    def announce(self, role: str, agent: str, boot_id: str) -> AbstractContextManager[None]:
        """Hold a liveliness token while the context is open; others notice a killed process at once."""

    def watch_agents(self) -> AgentWatch:
        """Watch all agents of the site appear and disappear."""

    def connected(self) -> bool:
        """Whether this process can reach others: a client that lost its router cannot."""

    def close(self) -> None:
        """Close everything that was declared on this bus. May be called twice."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


def agent_status(
    role: str,
    agent: str,
    boot_id: str,
    sequence: int,
    state: str,
    text: str,
    counters: Mapping[str, float] = MappingProxyType({}),
    gauges: Mapping[str, float] = MappingProxyType({}),
) -> pb.AgentStatus:
    """What an agent says of itself; state: starting, running, degraded or stopping."""
    return pb.AgentStatus(
        schema_version=SCHEMA_VERSION, version=VERSION, agent=agent, role=role, boot_id=boot_id, sequence=sequence,
        state=state, message=text, counters=counters, gauges=gauges,
    )  # fmt: skip


class CommandSubscription:
    """The commands addressed to one run of one agent.

    agent, boot: its id and boot id; commands to an earlier run are ignored by a later one. actions: the actions that
    it supports; others are ignored.
    """

    def __init__(self, bus: Bus, agent: str, boot: str, actions: Collection[str]) -> None:
        self._subscription = bus.subscribe(COMMAND)
        self._agent, self._boot, self._actions = agent, boot, frozenset(actions)
        self._known: deque[tuple[str, str, int]] = deque(maxlen=_DUPLICATE_WINDOW)

    def take(self) -> list[str]:
        """The actions requested since the last call, in order."""
        actions = []
        for received in self._subscription.drain():
            command = received.message
            assert isinstance(command, pb.Command)
            identity = (command.sender, command.boot_id, command.sequence)
            if (command.agent, command.agent_boot) != (self._agent, self._boot) or identity in self._known:
                continue
            self._known.append(identity)
            if command.action in self._actions:
                actions.append(command.action)
        return actions

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()
