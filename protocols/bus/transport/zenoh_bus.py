"""The bus over Zenoh. See ``protocols.bus.base`` for the interface and the README for the design."""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from queue import SimpleQueue
from typing import Any, TypeAlias

import zenoh
import zenoh.ext
import zenoh.handlers
from google.protobuf.message import Message

from protocols.bus.base import BusDead, Received
from protocols.bus.settings import BusConfig
from protocols.bus.transport.backfill import MOST_PART, NEWEST, SILENCE_S, Backfill, RecoveryQuery
from protocols.bus.transport.inbox import Arrived, InboxSubscription, LivenessTracker, subscription_key
from protocols.bus.transport.session import close_session, open_session, undeclare_all, zenoh_call
from protocols.core.closing import Closing
from protocols.core.names import check_identifier
from protocols.topics import Delivery, Topic, cache_size, liveliness_key
from protocols.validation.codec import encode, message_class, parse_key, unknown_key

HEARTBEAT_S = 0.5
"""Period after which a subscriber detects that the last message before a pause is missing."""
_POLL_S = 0.005  # for a matching subscriber
_QUERIES_AT_ONCE, _QUERIES_OF_KEY = 8, 2
"""In all, and of one key: who does not answer delays no other. Of 200 publishers 1,000 messages each took 2.2 s with 4
or 8 at once, 2.7 s with 16; with 64 and more the link stalled for seconds, and queries ended without a reply."""
_LEAST_PART, _LONGEST_WAIT_S = 16, 0.5
"""Messages that one query asks for, at least, and for how long it may wait on the link, and what comes by itself behind
it: over 100 kB/s six cameras with 1.2 MB each kept a seventh silent for 16 s with 256 messages, now for 2 to 7 s."""
_GAP_QUERY_S = 10.0  # a third of GAP_TIMEOUT_S: three queries before it is lost
_CHANNEL, _AT_ONCE = 512, 256
"""Samples between Zenoh and a subscription's thread, 3 ms of a flood: while it is full, Zenoh waits. And of these taken
at once: 100 KB, which are in the processor's cache when the reader decodes them."""
_YIELD_S = 1e-4  # after as many: else the reader gets the interpreter's lock back after 5 ms only
_MAX_REPLIES = 65_536  # to one query: the longest inbox
_MAX_KEYS, _KEYS_PER_CALL = 8192, 8  # that are declared in all, and by one drain

_HEARTBEAT_BYTES = 4  # the number of a publisher's newest message
_ADVANCED = "/@adv/pub/"
"""Between the key of an advanced publisher and its identity, in the keys of its token, heartbeats and cache."""

_Source: TypeAlias = tuple[str, int]
"""A publisher's identity in Zenoh: session id and entity id."""
_PLAIN: _Source = ("", 0)
"""A plain publisher, as zenoh-pico's: without recovery, and its gaps are those of its own numbers."""


def _publisher(sample: zenoh.Sample) -> tuple[_Source, str] | None:
    """Of a token or a heartbeat: its publisher and the publisher's key; None of what is neither."""
    key, _, identity = str(sample.key_expr).partition(_ADVANCED)
    session, _, entity = identity.partition("/")
    try:
        return ((session, int(entity.partition("/")[0])), key) if parse_key(key) is not None else None
    except ValueError:
        return None


class ZenohPublisher:
    """See ``protocols.bus.base.Publisher``."""

    def __init__(self, session: zenoh.Session, topic: Topic, key: str, cache: int, block: bool) -> None:
        self._class = message_class(topic)
        self._session = session
        self._key = key
        self._putting = zenoh_call(f"put {key}")
        self._matcher: Any = None  # its stub has the type of matching_status wrong
        reliable = topic.delivery is Delivery.RELIABLE
        congestion = zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP
        with zenoh_call(f"declare {key}"):
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                encoding=zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(f"syncline.v1.{topic.message}"),
                congestion_control=congestion,
                priority=zenoh.Priority.DATA_LOW if topic.bulky else zenoh.Priority.DATA,
                cache=zenoh.ext.CacheConfig(max_samples=cache),
                # Also without recovery: it adds sequence numbers, which a plain publisher does not.
                sample_miss_detection=zenoh.ext.MissDetectionConfig(
                    heartbeat=HEARTBEAT_S if reliable else None, sporadic_heartbeat=None
                ),
                publisher_detection=True,
            )

    def put(self, message: Message) -> None:
        if type(message) is not self._class:
            raise TypeError(f"{message.DESCRIPTOR.name} on a topic of {self._class.DESCRIPTOR.name}")
        payload = encode(message)
        try:  # a context costs 0.3 us where nothing fails
            self._publisher.put(payload)
        except BaseException:
            with self._putting:
                raise

    def wait_matched(self, timeout_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        with zenoh_call(f"match {self._key}"):
            if self._matcher is None:
                # An advanced publisher does not report matching subscribers; a plain one on the same key does.
                self._matcher = self._session.declare_publisher(self._key)
            while not self._matcher.matching_status.matching:
                if time.monotonic() >= deadline:
                    return False
                time.sleep(_POLL_S)
        return True

    def close(self) -> None:
        """Undeclare; closing twice, or after the session, is no error."""
        undeclare_all(self._matcher, self._publisher)


class _DeclaredKeys:
    """Declares the keys of received messages.

    Zenoh 1.10.2 caches routes for declared keys only. For all others it compares the key with every known key for each
    message: with 1,000 cameras that is 110 us of CPU, more than all other work per message.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.met: set[str] = set()
        """Valid keys of received messages, a bounded number of them."""
        self._new: deque[str] = deque()
        self._declared: list[zenoh.KeyExpr] = []

    def meet(self, key: str) -> None:
        """Note a message's key; called from a thread that only enqueues, so nothing is declared here."""
        if len(self.met) < _MAX_KEYS:
            self.met.add(key)
            self._new.append(key)

    def declare(self) -> None:
        """Declare some of the new ones."""
        for _ in range(min(len(self._new), _KEYS_PER_CALL)):
            key = self._new.popleft()
            if parse_key(key) is None:  # received through a wildcard: validation rejects it
                continue
            with zenoh_call(f"declare {key}"):
                self._declared.append(self._session.declare_keyexpr(key))

    def close(self) -> None:
        """Undeclare them; after the session this is no error."""
        while self._declared:
            with suppress(BusDead), zenoh_call("undeclare"):
                self._session.undeclare(self._declared.pop())


@dataclass(slots=True)
class _OpenQuery:
    """A query to a publisher's cache and the replies that were not read yet. failed: whether one was an error."""

    question: RecoveryQuery[_Source]
    begun: float
    replies: deque[zenoh.Reply]
    failed: bool = False
    reading: threading.Lock = field(default_factory=threading.Lock)


class ZenohSubscription(InboxSubscription):
    """See ``protocols.bus.base.Subscription``."""

    def __init__(self, session: zenoh.Session, topic: Topic, key: str, clock_ns: Callable[[], int]) -> None:
        self._session = session
        super().__init__(topic, clock_ns)
        self._reliable = topic.delivery is Delivery.RELIABLE
        self._clock_ns = clock_ns
        self._arrived: deque[Arrived] = deque()
        self._turn = threading.Lock()
        """Held while messages are taken from the channel or decoded: by turns, not alternately for each."""
        self._questions: SimpleQueue[RecoveryQuery[_Source] | None] = SimpleQueue()
        self._backfill: Backfill[_Source] = Backfill(self._push, self._questions.put, self.inbox.count_lost)
        self._waiting: deque[RecoveryQuery[_Source]] = deque()
        """Queries that wait until another one has ended."""
        self._open_queries: dict[int, _OpenQuery] = {}
        self._last_reply = 0.0  # to any of them
        self._part, self._fastest_s = _LEAST_PART, float("inf")
        self._counting = threading.Lock()
        self._newest: dict[tuple[str, _Source], int] = {}
        self._fetched: dict[tuple[str, _Source], int] = {}
        """Number of the message that was taken from a publisher's cache; it and older ones may yet arrive."""
        self._keys = _DeclaredKeys(session)
        with zenoh_call(f"subscribe {key}"):
            self._subscriber = session.declare_subscriber(key, zenoh.handlers.FifoChannel(_CHANNEL))
        threading.Thread(target=self._collect, args=(self._subscriber.handler,), name=f"bus {key}").start()
        # A query waits for Zenoh's tables, which Zenoh holds while it waits for room in the channel.
        asking = map(self._ask, iter(self._questions.get, None))
        threading.Thread(target=deque, args=(asking, 0), name=f"recovery {key}").start()
        self._heartbeats: zenoh.Subscriber[Any] | None = None
        try:
            with zenoh_call(f"watch {key}"):
                # The oldest of too many heartbeats are dropped: each is said again.
                if self._reliable:
                    ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_CHANNEL)
                    self._heartbeats = session.declare_subscriber(f"{key}{_ADVANCED}**", ring)
                self._publishers: zenoh.Subscriber[None] = session.liveliness().declare_subscriber(
                    f"{key}{_ADVANCED}**", zenoh.handlers.Callback(self._appeared, indirect=False), history=True
                )
        except BaseException:  # its threads would never end
            undeclare_all(self._heartbeats, self._subscriber)
            self._questions.put(None)
            raise

    def _appeared(self, token: zenoh.Sample) -> None:
        """Query the history of a publisher that has appeared; called from Zenoh's threads."""
        if token.kind != zenoh.SampleKind.PUT or (publisher := _publisher(token)) is None:
            return
        source, key = publisher
        if self._reliable:
            self._backfill.appeared(source, key)
        else:
            self._questions.put(RecoveryQuery(source, key, 0, NEWEST, None, 0))

    def _take_heartbeats(self, heartbeats: zenoh.Subscriber[Any]) -> None:
        with suppress(zenoh.ZError):  # undeclared
            while (beat := heartbeats.handler.try_recv()) is not None:
                number = beat.payload.to_bytes()
                if len(number) == _HEARTBEAT_BYTES and (publisher := _publisher(beat)) is not None:
                    self._backfill.heartbeat(*publisher, int.from_bytes(number, "little"))

    def _collect(self, channel: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """Queue what arrives, until the subscription is closed.

        A thread that waits without the interpreter's lock and then takes all there is: a callback of Zenoh's needs the
        lock for each message, and the reader between them. It only enqueues, since a full channel blocks the session.
        """
        while True:
            try:
                samples = [channel.recv()]
            except zenoh.ZError:  # undeclared, and nothing is left
                return
            with self._turn:
                with suppress(zenoh.ZError):
                    while len(samples) < _AT_ONCE and (sample := channel.try_recv()) is not None:
                        samples.append(sample)
                taken = []
                for sample in samples:
                    try:
                        if (one := self._take(sample)) is not None:
                            taken.append(one)
                    except Exception:  # noqa: BLE001 - of one message: the others are taken all the same
                        traceback.print_exc()
                self._backfill.take(taken)
                self.inbox.push_all(self._arrived)
            if len(samples) == _AT_ONCE:
                time.sleep(_YIELD_S)

    def _take(self, sample: zenoh.Sample) -> tuple[_Source, int | None, str, bytes] | None:
        """Publisher, its number if gaps are to be closed, key and payload; None of what is not wanted."""
        payload = sample.payload.to_bytes()
        if not payload and sample.kind != zenoh.SampleKind.PUT:  # a DELETE has no payload
            return None
        source, key = sample.source_info, str(sample.key_expr)
        if key not in self._keys.met:
            if parse_key(key) is None:  # nothing is remembered of it
                self.inbox.refuse(unknown_key(), key)
                return None
            self._keys.meet(key)
        if source is None:
            return _PLAIN, None, key, payload
        identity = source.source_id
        name = (str(identity.zid), identity.eid)
        if self._reliable:
            return name, source.source_sn, key, payload
        self._count_gap((key, name), source.source_sn)
        return (name, None, key, payload) if self._fetched.get((key, name), -1) < source.source_sn else None

    def _count_gap(self, publisher: tuple[str, _Source], number: int) -> None:
        """Count the losses of a topic that is not recovered."""
        newest = self._newest.get(publisher)
        if newest is None and len(self._newest) >= _MAX_KEYS:
            self._newest.clear()
        if newest is None or newest < number:
            if newest is not None and number > newest + 1:
                self.inbox.count_skipped(number - newest - 1)
            self._newest[publisher] = number

    def _take_latest(self, source: _Source, key: str, number: int, payload: bytes) -> None:
        """Take the history of a topic of which only the newest message matters."""
        with self._turn:
            if self._newest.get((key, source), -1) < number:
                self._newest[key, source] = self._fetched[key, source] = number
                self._push(source, key, payload)

    def _push(self, source: _Source, key: str, payload: bytes) -> None:
        self._arrived.append((key, payload, self._clock_ns(), source[0], source is not _PLAIN))

    def _ask(self, question: RecoveryQuery[_Source]) -> None:
        """Query one publisher's cache; its replies arrive on a Zenoh thread."""
        source, lock, served = question.source, self._counting, False
        still_open = 1 if question.witness is None else 2
        if self._reliable:
            question = replace(question, most=self._part)
        opened = _OpenQuery(question, time.monotonic(), deque(maxlen=(question.most or _MAX_REPLIES) + 1))
        if self._reliable:
            with lock:
                if not self._may_ask(question):
                    self._waiting.append(question)
                    return
                self._open_queries[question.number] = opened

        def witnessed(reply: zenoh.Reply) -> None:
            nonlocal served
            served = served or reply.ok is not None

        def done() -> None:
            nonlocal still_open
            self._read(opened)
            with lock:
                still_open -= 1
                if still_open:
                    return
                self._open_queries.pop(question.number, None)
                self._adapt_part(question.most, time.monotonic() - opened.begun)
            if self._reliable:
                self._ask_next()
                self._backfill.finish(question, served or (question.witness is None and not opened.failed))
            self.inbox.push_all(self._arrived)

        most = "" if question.most is None else f";_max={question.most}"

        def get(low: int, high: int, take: Callable[[zenoh.Reply], None]) -> None:
            with zenoh_call(f"fetch {question.key}"):
                self._session.get(
                    f"{question.key}{_ADVANCED}{source[0]}/{source[1]}/**?_sn={low}..{high}{most}",
                    zenoh.handlers.Callback(take, drop=done, indirect=False),
                    consolidation=zenoh.ConsolidationMode.NONE,
                    accept_replies=zenoh.ReplyKeyExpr.ANY,
                    timeout=_GAP_QUERY_S,
                )

        try:
            # Zenoh calls its method directly: with a function in Python in between, all took twice as long.
            get(question.low, question.high, opened.replies.append)
            if question.witness is not None:
                # Sent after the other query on the same route: if this one is answered, so was that one.
                get(question.witness, question.witness, witnessed)
        except BusDead:
            with lock:
                self._open_queries.pop(question.number, None)
            self._backfill.finish(question, served=False)
            self.inbox.push_all(self._arrived)

    def _adapt_part(self, most: int | None, seconds: float) -> None:
        """Ask for more at once, or less, by how much longer than the fastest answer one took: it waited on the link."""
        self._fastest_s = min(self._fastest_s, seconds)
        waited = seconds - self._fastest_s
        if waited > _LONGEST_WAIT_S and self._part == _LEAST_PART:
            self._fastest_s = seconds  # a smaller part is no faster: the way there and back takes as long
        elif waited > _LONGEST_WAIT_S:
            self._part = max(self._part // 2, _LEAST_PART)
        elif waited < 0.5 * _LONGEST_WAIT_S and most == self._part:
            self._part = min(2 * self._part, MOST_PART)

    def _may_ask(self, question: RecoveryQuery[_Source]) -> bool:
        keys = [one.question.key for one in self._open_queries.values()]
        return keys.count(question.key) < _QUERIES_OF_KEY and len(keys) < _QUERIES_AT_ONCE

    def _ask_next(self) -> None:
        """Of the queries that wait, the first whose turn it is."""
        with self._counting:
            self._waiting = deque(filter(self._backfill.awaits, self._waiting))
            if (following := next(filter(self._may_ask, self._waiting), None)) is not None:
                self._waiting.remove(following)
                self._questions.put(following)

    def _read_replies(self) -> None:
        """Take what has come of them; those whose publishers do not answer no longer keep others waiting."""
        now = time.monotonic()
        with self._counting:
            opened = list(self._open_queries.values())
        for one in opened:
            if one.replies:
                self._last_reply = now
                self._read(one)
        silent = [one for one in opened if now - max(one.begun, self._last_reply) > SILENCE_S]
        if silent:
            with self._counting:
                for one in silent:
                    self._open_queries.pop(one.question.number, None)
            self._ask_next()

    def _read(self, opened: _OpenQuery) -> None:
        question, replies = opened.question, opened.replies
        with opened.reading:
            while replies:
                sample = replies.popleft().ok
                if sample is None:  # as Zenoh's when the time is up
                    opened.failed = True
                elif sample.source_info is not None:
                    number, key = sample.source_info.source_sn, str(sample.key_expr)
                    if self._reliable:
                        self._backfill.answer(question, number, key, sample.payload.to_bytes())
                    elif key == question.key:
                        self._take_latest(question.source, key, number, sample.payload.to_bytes())

    def drain(self) -> list[Received]:
        self._keys.declare()
        if self._heartbeats is not None:
            self._take_heartbeats(self._heartbeats)
        self._backfill.poll()
        if self._open_queries:
            self._read_replies()
        if self._arrived:
            self.inbox.push_all(self._arrived)
        with self._turn:
            return super().drain()

    def flush(self) -> None:
        """Queue what was fetched and what waits for it."""
        if self._open_queries:
            self._read_replies()
        self._backfill.flush()
        self.inbox.push_all(self._arrived)

    def close(self) -> None:
        """Undeclare: a process with an open subscription never exits."""
        undeclare_all(self._publishers, self._heartbeats, self._subscriber)
        self._questions.put(None)
        self._keys.close()


class ZenohWatch(LivenessTracker):
    """See ``protocols.bus.base.AgentWatch``."""

    def __init__(self, session: zenoh.Session, site: str) -> None:
        super().__init__()
        key = f"syncline/{site}/alive/**"
        with zenoh_call(f"watch {key}"):
            self._subscriber: zenoh.Subscriber[None] = session.liveliness().declare_subscriber(
                key, self._take, history=True
            )

    def _take(self, sample: zenoh.Sample) -> None:
        self.mark(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def close(self) -> None:
        undeclare_all(self._subscriber)


class ZenohBus(Closing):
    """See ``protocols.bus.base.Bus``. Made by ``open_bus``."""

    def __init__(
        self,
        session: zenoh.Session,
        site: str,
        clock_ns: Callable[[], int],
        outage_s: float,
        needs_others: bool = False,
    ) -> None:
        self._session = session
        self._needs_others = needs_others
        self._had_others = self._has_lost_others = False
        self._site = check_identifier(site, "site")
        self._clock_ns = clock_ns
        self._outage_s = outage_s
        self._declared: list[ZenohPublisher | ZenohSubscription | ZenohWatch] = []

    @property
    def site(self) -> str:
        return self._site

    def publisher(
        self, topic: Topic, agent: str, *, rate_hz: float | None = None, block: bool = False
    ) -> ZenohPublisher:
        key = topic.key_for(self._site, agent)
        publisher = ZenohPublisher(self._session, topic, key, cache_size(topic, rate_hz, self._outage_s), block)
        self._declared.append(publisher)
        return publisher

    def subscribe(self, topic: Topic, agent: str = "*") -> ZenohSubscription:
        key = subscription_key(topic, self._site, agent)
        subscription = ZenohSubscription(self._session, topic, key, self._clock_ns)
        self._declared.append(subscription)
        return subscription

    @contextmanager
    def announce(self, role: str, agent: str, boot_id: str) -> Iterator[None]:
        key = liveliness_key(self._site, role, agent, boot_id)
        with zenoh_call(f"announce {key}"):
            token = self._session.liveliness().declare_token(key)
        try:
            yield
        finally:
            undeclare_all(token)

    def watch_agents(self) -> ZenohWatch:
        watch = ZenohWatch(self._session, self._site)
        self._declared.append(watch)
        return watch

    def connected(self) -> bool:
        """Whether this process can reach others: a client without its router cannot, nor a peer that lost all others or
        meets nobody where it is set to connect. Another peer that has met nobody yet may be the first.
        """
        with zenoh_call("routers"):
            info = self._session.info
            others = bool(info.routers_zid() or info.peers_zid())
        self._has_lost_others = not others and (self._has_lost_others or self._had_others)
        self._had_others = others
        return others or not (self._needs_others or self._has_lost_others)

    def close(self) -> None:
        while self._declared:
            self._declared.pop().close()
        close_session(self._session)


def open_bus(
    site: str,
    config: BusConfig | None = None,
    *,
    stop: Callable[[], bool] | None = None,
    timeout_s: float | None = None,
) -> ZenohBus:
    """Connect to the others of ``site``.

    stop: called while a client waits for its router; True raises BusStopped.
    timeout_s: how long a client waits for its router before InputError; None waits for ever.
    Raises InputError, in one line, for a site or an endpoint that cannot be used.
    """
    check_identifier(site, "site")
    config = config or BusConfig()
    session = open_session(config, stop=stop, timeout_s=timeout_s)
    return ZenohBus(
        session,
        site,
        time.time_ns,
        config.outage_s,
        needs_others=config.mode == "client" or (config.mode == "peer" and bool(config.connect)),
    )
