"""Sender checks at the receiver: one agent per id and one connection per boot; rejections counted by reason and source.

Messages of two processes with one id would interleave undetected, and anyone who knows a camera's key can publish on
it. Without certificates the router does not prevent this, so every receiver enforces these rules:

* of two agents of one role and id the first one is accepted, until it is gone;
* while an agent is alive, only its own boot ids are accepted under its id;
* a boot's messages are accepted only over the connection of its first message, until that has been silent for
  SOURCE_TIMEOUT_S.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Set
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

from google.protobuf.message import Message

from protocols.bus.base import AgentEvent, AgentWatch, Bus, Publisher, Received, Refusal, Subscription
from protocols.core.closing import Closing
from protocols.core.ranges import MAX_CAMERAS
from protocols.messages import syncline_pb2 as pb
from protocols.topics import STATUS, TOPICS, Topic
from protocols.validation.rules import MAX_NUMBERS, RejectionReason

_ROLES = {topic.name: topic.key.partition("/")[0] for topic in TOPICS}
SOURCE_TIMEOUT_S = 10.0
"""Silence after which a boot may use another connection: a log that is replayed twice has the same boot ids."""
_MAX_SOURCES = _MAX_AGENTS = 4 * MAX_CAMERAS  # of a hub: invented names cannot fill the memory
_MAX_HEARD = 16
"""Boots of one agent whose late messages are accepted, and that may be alive at once."""
_PUBLISHED_SOURCES = 48  # of rejections in a status, whose counters are bounded
_NAMED_SOURCES = 3  # of messages that are not usable, in its text
_OF_SENDER = {RejectionReason.SECOND_AGENT.value, RejectionReason.WRONG_SOURCE.value}
"""Reasons that are no fault of a message: the first has an alarm, the other one ends by itself after a restart."""
_SHARING = ("nodes", "shard")  # roles of hubs that calibrate one site together
_MAX_COUNTER_NAME = 64  # characters: the validation's limit


@dataclass(slots=True)
class _AgentBoots:
    """One (role, id): boots alive in order of arrival (alive), and the last boots that were the first (heard)."""

    alive: list[str] = field(default_factory=list)
    heard: deque[str] = field(default_factory=lambda: deque(maxlen=_MAX_HEARD))


class SenderValidator:
    """The rules, without a bus. Roles such as pose nodes do not publish under an id of their own."""

    def __init__(self) -> None:
        self._agents: dict[tuple[str, str], _AgentBoots] = {}
        self._sources: dict[str, tuple[str, float]] = {}

    def handle(self, event: AgentEvent) -> None:
        """Process the appearance or disappearance of an agent."""
        if (event.role, event.agent) not in self._agents and len(self._agents) >= _MAX_AGENTS:
            self._agents = {who: agent for who, agent in self._agents.items() if agent.alive}
            if len(self._agents) >= _MAX_AGENTS:
                return
        agent = self._agents.setdefault((event.role, event.agent), _AgentBoots())
        if event.alive and event.boot_id not in agent.alive:
            if len(agent.alive) < _MAX_HEARD:
                agent.alive.append(event.boot_id)
        elif not event.alive and event.boot_id in agent.alive:
            agent.alive.remove(event.boot_id)
        if agent.alive and agent.alive[0] not in agent.heard:
            agent.heard.append(agent.alive[0])

    def refuse(self, received: Received, now: float) -> tuple[RejectionReason, str] | None:
        """The reason and details why a message is rejected; None if it is accepted. now: any monotonic clock [s]."""
        boot: str = getattr(received.message, "boot_id", "")
        if not boot:
            return None
        agent = self._agents.get((_role(received), received.agent))
        if agent is not None and agent.alive and boot not in agent.heard:
            if boot in agent.alive:
                return RejectionReason.SECOND_AGENT, f"boot {boot[:12]} beside {agent.alive[0][:12]}"
            return RejectionReason.WRONG_SOURCE, f"boot {boot[:12]} is not that of the agent that is alive"
        known = self._sources.get(boot)
        if known is not None and known[0] != received.source and now - known[1] < SOURCE_TIMEOUT_S:
            here, there = known[0] or "a plain publisher", received.source or "a plain publisher"
            return RejectionReason.WRONG_SOURCE, f"boot {boot[:12]} speaks from {here}, not from {there}"
        if known is None and len(self._sources) >= _MAX_SOURCES:
            self._sources = {b: s for b, s in self._sources.items() if now - s[1] < SOURCE_TIMEOUT_S}
        if known is not None or len(self._sources) < _MAX_SOURCES:
            self._sources[boot] = (received.source, now)
        return None

    def alarms(self) -> list[str]:
        """Conditions that need an operator: ids that are in use twice, and hubs that do not know of each other."""
        alive = sorted(who for who, agent in self._agents.items() if agent.alive)
        out = [
            f"{role} {name} runs {len(self._agents[role, name].alive)} times; only the first is heard: "
            "give each an id of its own"
            for role, name in alive
            if len(self._agents[role, name].alive) > 1
        ]
        hubs = [name for role, name in alive if role == "hub" and not any((one, name) in alive for one in _SHARING)]
        if len(hubs) > 1:
            named = ", ".join(hubs[:8])
            out.append(f"hubs {named} each publish a calibration, in worlds of their own: stop all but one")
        return out


def _role(received: Received) -> str:
    if received.topic is STATUS and isinstance(received.message, pb.AgentStatus):
        return received.message.role
    return _ROLES[received.topic.name]


class SenderCheckedSubscription:
    """See ``protocols.bus.base.Subscription``; rejections by sender are counted like failed validations."""

    def __init__(self, bus: SenderCheckedBus, inner: Subscription) -> None:
        self._bus, self._inner = bus, inner
        self._refused: Counter[str] = Counter()

    def drain(self) -> list[Received]:
        """The accepted messages since the last call."""
        self._bus.update_agents()
        accepted, refuse, now = [], self._bus.guard.refuse, self._bus.now()
        passed: set[tuple[str, str, str]] = set()  # who is accepted once is accepted at that time
        for received in self._inner.drain():
            topic, agent, message, _, source = received
            who = agent, getattr(message, "boot_id", ""), source
            if who in passed:
                accepted.append(received)
                continue
            why = refuse(received, now)
            if why is None:
                accepted.append(received)
                if topic is not STATUS:  # whose role is in the message
                    passed.add(who)
                continue
            reason, detail = why
            self._refused[f"rejected.{reason.value}"] += 1
            sequence = getattr(received.message, "sequence", None)
            self._bus.record_refusal(Refusal(reason.value, received.agent, received.topic.name, detail, sequence))
        for refusal in self._inner.refusals():
            self._bus.record_refusal(refusal)
        return accepted

    def wait(self, timeout_s: float) -> bool:
        return self._inner.wait(timeout_s)

    @property
    def counters(self) -> Mapping[str, int]:
        counts = Counter(self._inner.counters)
        counts.update(self._refused)
        counts["received"] -= sum(self._refused.values())
        return counts

    def flush(self) -> None:
        self._inner.flush()

    def ignore(self, agents: Set[str]) -> None:
        self._inner.ignore(agents)

    def refusals(self) -> list[Refusal]:
        """Always empty: rejections are passed on to the bus."""
        return []

    def close(self) -> None:
        self._inner.close()


class _StatusPublisher:
    """Adds the bus's diagnostics to an agent's status before it is published."""

    def __init__(self, bus: SenderCheckedBus, inner: Publisher) -> None:
        self._bus, self._inner = bus, inner

    def put(self, message: Message) -> None:
        if isinstance(message, pb.AgentStatus):
            message = self._bus.with_diagnostics(message)
        self._inner.put(message)

    def wait_matched(self, timeout_s: float) -> bool:
        return self._inner.wait_matched(timeout_s)

    def close(self) -> None:
        self._inner.close()


class SenderCheckedBus(Closing):
    """A bus whose subscriptions accept only messages of verified senders. See ``protocols.bus.base.Bus``.

    now: a monotonic clock [s]. amend: called with every status before it is published; may add to it. seen: called with
    every status that this process publishes. refused: called with every rejection that is reported (their number is
    bounded).
    """

    def __init__(
        self,
        bus: Bus,
        now: Callable[[], float],
        *,
        amend: Callable[[pb.AgentStatus], None] = lambda status: None,
        seen: Callable[[pb.AgentStatus], None] = lambda status: None,
        refused: Callable[[Refusal], None] = lambda refusal: None,
    ) -> None:
        self._bus = bus
        self.now = now
        self._amend, self._seen, self._refused = amend, seen, refused
        self.guard = SenderValidator()
        self._watch: AgentWatch | None = None
        self._by_source: Counter[tuple[str, str]] = Counter()
        self._unusable: dict[str, tuple[float, Refusal]] = {}
        """By agent, or key of none: when its last message was that could not be used [s], and why."""

    @property
    def site(self) -> str:
        return self._bus.site

    def publisher(self, topic: Topic, agent: str, *, rate_hz: float | None = None, block: bool = False) -> Publisher:
        publisher = self._bus.publisher(topic, agent, rate_hz=rate_hz, block=block)
        return _StatusPublisher(self, publisher) if topic is STATUS else publisher

    def subscribe(self, topic: Topic, agent: str = "*") -> Subscription:
        if self._watch is None:
            self._watch = self._bus.watch_agents()
        return SenderCheckedSubscription(self, self._bus.subscribe(topic, agent))

    def announce(self, role: str, agent: str, boot_id: str) -> AbstractContextManager[None]:
        return self._bus.announce(role, agent, boot_id)

    def watch_agents(self) -> AgentWatch:
        return self._bus.watch_agents()

    def connected(self) -> bool:
        return self._bus.connected()

    def close(self) -> None:
        if self._watch is not None:
            self._watch.close()
        self._bus.close()

    def update_agents(self) -> None:
        """Process appearances and disappearances of agents."""
        if self._watch is not None:
            for event in self._watch.drain():
                self.guard.handle(event)

    def record_refusal(self, refusal: Refusal) -> None:
        """Count one rejection by reason and source, and report it."""
        source = refusal.agent or "unknown"
        if (refusal.reason, source) not in self._by_source and len(self._by_source) >= _MAX_SOURCES:
            source = "others"
        self._by_source[refusal.reason, source] += 1
        who = refusal.agent or refusal.key
        if refusal.reason not in _OF_SENDER and (who in self._unusable or len(self._unusable) < _MAX_SOURCES):
            self._unusable[who] = self.now(), refusal
        self._refused(refusal)

    def refusals_by_source(self) -> dict[tuple[str, str], int]:
        """Counts by (reason, agent in the key)."""
        return dict(self._by_source)

    def with_diagnostics(self, status: pb.AgentStatus) -> pb.AgentStatus:
        """The status with refusals by source (``rejected.<reason>@<id>``) and alarms."""
        self.update_agents()
        whole = pb.AgentStatus()
        whole.CopyFrom(status)
        for (reason, source), count in self._by_source.most_common(_PUBLISHED_SOURCES):
            if len(whole.counters) < MAX_NUMBERS:
                whole.counters[f"rejected.{reason}@{source}"[:_MAX_COUNTER_NAME]] = count
        alarms = [*self.guard.alarms(), *self._unusable_alarms()]
        if alarms:
            whole.counters["alarms"] = len(alarms)
            whole.message = "; ".join([*alarms, whole.message])[:1000]
            if whole.state == "running":
                whole.state = "degraded"
        self._amend(whole)
        self._seen(whole)
        return whole

    def _unusable_alarms(self) -> list[str]:
        """Who sends messages that cannot be used, and why: it would only be missing, or silent, without a reason."""
        now = self.now()
        self._unusable = {who: one for who, one in self._unusable.items() if now - one[0] < SOURCE_TIMEOUT_S}
        out = [
            f"messages of {who} are not used: {refusal.detail or refusal.reason}"
            for who, (_, refusal) in sorted(self._unusable.items())
        ]
        more = len(out) - _NAMED_SOURCES
        return [*out[:_NAMED_SOURCES], f"messages of {more} more are not used"] if more > 0 else out
