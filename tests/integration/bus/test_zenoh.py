"""What only the bus over Zenoh can show: floods, outages, killed processes, addresses, panics."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from protocols.bus.base import AgentEvent, Bus, BusDead, BusStopped, Received
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.backfill import RecoveryQuery
from protocols.bus.transport.inbox import BYTES_PER_S, MAX_BYTES, MAX_BYTES_OF_KEY, Inbox
from protocols.bus.transport.session import open_session
from protocols.bus.transport.zenoh_bus import ZenohSubscription, open_bus
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, OBSERVATION
from tests.support.receiving import collect, matched, sequences
from tests.support.samples import eventually, observation


@contextmanager
def connected() -> Iterator[tuple[Bus, Bus]]:
    """Two buses through a router."""
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    with Router(endpoint), open_bus("local", config) as sending, open_bus("local", config) as receiving:
        yield sending, receiving


def test_a_history_that_begins_in_the_middle_is_made_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh 1.10.2 sometimes delivers a late joiner's history from the middle on, and counts no loss."""
    take = ZenohSubscription._take

    def from_the_middle(self: ZenohSubscription, sample: zenoh.Sample) -> object:
        wanted = sample.source_info is not None and sample.source_info.source_sn >= 60
        return take(self, sample) if wanted else None

    monkeypatch.setattr(ZenohSubscription, "_take", from_the_middle)
    with connected() as (sending, receiving):
        publishers = {camera: sending.publisher(OBSERVATION, camera) for camera in ("cam0", "cam1")}
        for index in range(100):
            for camera, publisher in publishers.items():
                publisher.put(observation(camera, index))
        subscription = receiving.subscribe(OBSERVATION)
        received = collect(subscription, 200)
        for camera, publisher in publishers.items():
            own = [item for item in received if item.agent == camera]
            assert sequences(own) == list(range(100))
            publisher.put(observation(camera, 100))
        assert sequences(collect(subscription, 2)) == [100, 100]


def lose(monkeypatch: pytest.MonkeyPatch, numbers: range) -> None:
    """The messages with these numbers do not come by themselves."""
    take = ZenohSubscription._take

    def without(self: ZenohSubscription, sample: zenoh.Sample) -> object:
        wanted = sample.source_info is None or sample.source_info.source_sn not in numbers
        return take(self, sample) if wanted else None

    monkeypatch.setattr(ZenohSubscription, "_take", without)


def test_a_gap_is_asked_for_until_the_cache_has_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """A connection that breaks ends a query without an answer."""
    ask = ZenohSubscription._ask
    asked: list[RecoveryQuery[tuple[str, int]]] = []

    def broken_at_first(self: ZenohSubscription, question: RecoveryQuery[tuple[str, int]]) -> None:
        if question.low:
            asked.append(question)
        if len(asked) == 1:
            self._backfill.finish(question, served=False)
        else:
            ask(self, question)

    lose(monkeypatch, range(10, 30))
    monkeypatch.setattr(ZenohSubscription, "_ask", broken_at_first)
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        publisher = matched(sending.publisher(OBSERVATION, "cam0"))
        publisher.put(observation("cam0", 0))
        received = collect(subscription, 1)  # its history is complete
        for index in range(1, 100):
            publisher.put(observation("cam0", index))
        assert sequences([*received, *collect(subscription, 99)]) == list(range(100))
        assert [(one.low, one.high) for one in asked[:2]] == [(10, 29), (10, 29)]
        assert subscription.counters["lost"] == 0


def test_the_last_messages_before_a_pause_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    lose(monkeypatch, range(8, 10))
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        publisher = matched(sending.publisher(OBSERVATION, "cam0"))
        publisher.put(observation("cam0", 0))
        received = collect(subscription, 1)  # its history is complete
        for index in range(1, 10):
            publisher.put(observation("cam0", index))
        assert sequences([*received, *collect(subscription, 9)]) == list(range(10))


def test_what_is_held_back_is_flushed(monkeypatch: pytest.MonkeyPatch) -> None:
    ask = ZenohSubscription._ask

    def without_an_answer(self: ZenohSubscription, question: RecoveryQuery[tuple[str, int]]) -> None:
        if question.low == 0:
            ask(self, question)

    lose(monkeypatch, range(5, 6))
    monkeypatch.setattr(ZenohSubscription, "_ask", without_an_answer)
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        publisher = matched(sending.publisher(OBSERVATION, "cam0"))
        publisher.put(observation("cam0", 0))
        received = collect(subscription, 1)
        for index in range(1, 10):
            publisher.put(observation("cam0", index))
        received += collect(subscription, 4)
        while len(received) < 9:  # those after the gap may still be on their way
            subscription.flush()
            received += subscription.drain()
        assert sequences(received) == [0, 1, 2, 3, 4, 6, 7, 8, 9]
        assert subscription.counters["lost"] == 1


def test_the_histories_of_more_publishers_than_are_asked_at_once_arrive() -> None:
    with connected() as (sending, receiving):
        cameras = [f"cam{number:02d}" for number in range(40)]
        publishers = [sending.publisher(OBSERVATION, camera) for camera in cameras]
        for index in range(30):
            for camera, publisher in zip(cameras, publishers, strict=True):
                publisher.put(observation(camera, index))
        received = collect(receiving.subscribe(OBSERVATION), 1200)
        for camera in cameras:
            assert sequences([item for item in received if item.agent == camera]) == list(range(30))


def test_messages_are_taken_while_a_query_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh held its tables while the channel was full, a query waited for them, and nobody emptied the channel."""
    take, ask, freed, lost = ZenohSubscription._take, ZenohSubscription._ask, threading.Event(), list[int]()

    def with_a_gap(self: ZenohSubscription, sample: zenoh.Sample) -> object:
        if sample.source_info is not None and sample.source_info.source_sn == 5 and not lost:
            return lost.append(5)
        return take(self, sample)

    monkeypatch.setattr(ZenohSubscription, "_take", with_a_gap)
    monkeypatch.setattr(
        ZenohSubscription, "_ask", lambda self, asked: freed.wait(20.0) if asked.witness else ask(self, asked)
    )
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        first, second = (matched(sending.publisher(OBSERVATION, f"cam{number}")) for number in range(2))
        for camera, publisher in (("cam0", first), ("cam1", second)):
            publisher.put(observation(camera, 0))
        assert len(collect(subscription, 2)) == 2, "their histories have been asked for"
        for index in range(1, 20):
            first.put(observation("cam0", index))
        assert eventually(lambda: lost == [5])
        for index in range(1, 20):
            second.put(observation("cam1", index))
        assert len(collect(subscription, 23)) == 23, "four more before the gap, and all of the other camera"
        freed.set()
    assert eventually(lambda: not [one for one in threading.enumerate() if one.name.startswith(("bus ", "recovery "))])


def test_one_message_that_cannot_be_taken_costs_no_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else the subscription would be silent from then on, and Zenoh would wait for it with all others."""
    take, failed = ZenohSubscription._take, []

    def failing_once(self: ZenohSubscription, sample: zenoh.Sample) -> object:
        if sample.source_info is not None and sample.source_info.source_sn == 5 and not failed:
            failed.append(sample)
            raise ValueError("this one")
        return take(self, sample)

    monkeypatch.setattr(ZenohSubscription, "_take", failing_once)
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        publisher = matched(sending.publisher(OBSERVATION, "cam0"))
        for index in range(20):
            publisher.put(observation("cam0", index))
        assert sequences(collect(subscription, 20)) == list(range(20)), "it is fetched from the cache"
    assert failed
    assert "ValueError: this one" in capsys.readouterr().err


def test_more_messages_than_the_channel_holds_arrive_while_nobody_drains() -> None:
    """And in order; a closed subscription leaves no thread behind, and what is queued can still be drained."""
    assert eventually(lambda: not [one for one in threading.enumerate() if one.name.startswith(("bus ", "recovery "))])
    threads = threading.active_count()
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        assert threading.active_count() == threads + 2, "one takes messages, one asks for lost ones"
        publisher = matched(sending.publisher(OBSERVATION, "cam0", rate_hz=1000.0, block=True))
        for index in range(5000):
            publisher.put(observation("cam0", index))
        assert eventually(lambda: subscription.inbox._length == 5000)
        subscription.close()
        assert eventually(lambda: threading.active_count() == threads)
        received = [item for _ in range(20) for item in subscription.drain()]
        assert sequences(received) == list(range(5000))
        arrivals = [item.arrival_ns for item in received]
        assert arrivals == sorted(arrivals)


def test_keys_that_messages_arrive_under_are_declared_once_and_forgotten() -> None:
    """Else Zenoh seeks the way of every message anew among all keys."""
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        for camera in ("cam0", "cam1"):
            publisher = matched(sending.publisher(OBSERVATION, camera))
            for index in range(5):
                publisher.put(observation(camera, index))
        collect(subscription, 10)
        subscription.drain()
        keys = subscription._keys
        assert sorted(map(str, keys._declared)) == [OBSERVATION.key_for("local", name) for name in ("cam0", "cam1")]
        subscription.close()
        assert keys._declared == []


def test_what_cannot_be_recovered_is_counted_exactly() -> None:
    """A flood far beyond the cache: every message is received, dropped by the queue, or counted as lost."""
    total = 20_000
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(OBSERVATION)
        publisher = matched(sending.publisher(OBSERVATION, "cam0"))
        for index in range(total):
            publisher.put(observation("cam0", index))
        received: list[Received] = []

        def accounted() -> bool:
            received.extend(subscription.drain())
            counters = subscription.counters
            return len(received) + counters["lost"] + counters["dropped"] == total

        assert eventually(accounted), (len(received), subscription.counters)
        assert sequences(received) == sorted(set(sequences(received)))
        assert sequences(received)[-1] == total - 1


def test_pictures_that_the_link_had_no_room_for_are_counted() -> None:
    """Of a topic of which the newest counts nothing is fetched again, but what never came is no secret."""
    data = b"\xff\xd8" + bytes(400_000) + b"\xff\xd9"
    with connected() as (sending, receiving):
        subscription = receiving.subscribe(FLIGHT_IMAGE)
        publisher = matched(sending.publisher(FLIGHT_IMAGE, "drone"))
        image = pb.FlightImage(schema_version=1, agent="drone", boot_id="b", width=640, height=480, jpeg=data)
        orders: list[int] = []

        def send() -> None:
            image.frame = image.order = image.order + 1
            publisher.put(image)
            orders.extend(item.message.order for item in subscription.drain())  # type: ignore[attr-defined]

        def accounted() -> bool:
            send()  # until one arrives, nobody can know of those before it
            counters = subscription.counters
            known = len(orders) + counters.get("skipped", 0) + counters["dropped"]
            return bool(orders) and known == orders[-1] - orders[0] + 1  # the first itself may not have had room

        for _ in range(400):
            send()
        assert eventually(accounted), (orders[-10:], len(orders), subscription.counters)
        assert orders == sorted(set(orders))
        assert subscription.counters["lost"] == 0


def test_a_gap_of_a_topic_that_is_not_recovered_is_counted_once() -> None:
    with open_bus("local", BusConfig(mode="peer")) as bus:
        subscription = bus.subscribe(FLIGHT_IMAGE)
        for number in (5, 6, 9, 8, 10, 10):  # who comes late hears nothing of what was before
            subscription._count_gap(("session", 1), number)
        subscription._count_gap(("other", 1), 400)
        assert subscription.counters["skipped"] == 2


def test_a_reader_that_stands_still_holds_so_many_bytes_and_no_more() -> None:
    now = [0]
    inbox = Inbox(OBSERVATION, lambda: now[0])

    def push(camera: int, index: int) -> None:
        now[0] += 10**9
        inbox.push(f"syncline/local/camera/cam{camera}/observation", bytes([index]) * 1_000_000)

    for index in range(100):
        push(0, index)
    kept = MAX_BYTES_OF_KEY // 1_000_000
    assert inbox.counters["dropped"] == 100 - kept
    while inbox.wait(0.0):
        inbox.drain()
    for index in range(kept):
        push(0, index)
    assert inbox.counters["dropped"] == 100 - kept
    for index in range(400):
        push(index % 10, index % 256)
    assert inbox._bytes <= MAX_BYTES


def test_bytes_beyond_what_a_sender_may_send_are_not_even_queued() -> None:
    """What passes the gate takes time there: 20 MB a second of one camera took most of a core."""
    now = [0]
    inbox = Inbox(OBSERVATION, lambda: now[0])
    taken = 0
    for _ in range(300):
        now[0] += 33_000_000
        inbox.push("syncline/local/camera/cam0/observation", bytes(700_000))
        taken += len(inbox._queues)
        inbox._taken()
    assert 10.0 * BYTES_PER_S / 700_000 < taken < 15.0 * BYTES_PER_S / 700_000


def test_who_floods_loses_messages_and_the_others_none() -> None:
    """A full queue dropped the oldest message, whoever had sent it."""
    inbox = Inbox(OBSERVATION)
    for index in range(100):
        inbox.push("syncline/local/camera/cam1/observation", observation("cam1", index).SerializeToString())
    for _ in range(70_000):
        inbox.push("syncline/local/camera/cam0/observation", b"garbage")
    assert sequences(inbox.drain()) == list(range(100)), "and they do not wait behind it"
    while inbox.wait(0.0):
        assert inbox.drain() == []
    assert inbox.counters["dropped"] == 100 + 70_000 - OBSERVATION.queue


def test_a_plain_publisher_takes_part_and_its_gaps_are_counted() -> None:
    """A camera of a third party, as with zenoh-pico: no cache, no numbers of the transport."""
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    with Router(endpoint), open_bus("local", config) as receiving:
        subscription = receiving.subscribe(OBSERVATION)
        plain = open_session(config)
        publisher = plain.declare_publisher(OBSERVATION.key_for("local", "GoPro 2"))
        assert eventually(lambda: bool(publisher.matching_status.matching))
        for number in (0, 1, 2, 5, 6):
            publisher.put(observation("GoPro 2", number).SerializeToString())
        assert sequences(collect(subscription, 5)) == [0, 1, 2, 5, 6]
        assert subscription.counters["lost"] == 2
        plain.close()


def test_an_outage_of_the_router_loses_nothing() -> None:
    """Observations put while the router is down arrive after it is back, in order."""
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    router = Router(endpoint)
    with open_bus("local", config) as sending, open_bus("local", config) as receiving:
        subscription = receiving.subscribe(OBSERVATION)
        publisher = matched(sending.publisher(OBSERVATION, "cam0"))
        for index in range(20):
            publisher.put(observation("cam0", index))
        received = collect(subscription, 20)
        router.close()
        assert eventually(lambda: not publisher.wait_matched(0.0))
        for index in range(20, 60):
            publisher.put(observation("cam0", index))
        with Router(endpoint):
            assert matched(publisher)
            publisher.put(observation("cam0", 60))
            received += collect(subscription, 41, timeout_s=15.0)
            assert sequences(received) == list(range(61))
            assert subscription.counters["lost"] == 0


AGENT = """
import sys, time
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
with open_bus("local", BusConfig(mode="client", connect=(sys.argv[1],)), timeout_s=10.0) as bus:
    with bus.announce("camera", "cam0", "boot-1"):
        print("ready", flush=True)
        sys.stdin.read()
"""


@pytest.mark.parametrize("end", ["kill -9", "in order"])
def test_an_agents_end_is_seen_at_once(end: str) -> None:
    endpoint = free_endpoint()
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as bus:
        watch = bus.watch_agents()
        events: list[AgentEvent] = []
        agent = subprocess.Popen(
            [sys.executable, "-c", AGENT, endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        try:
            assert agent.stdout is not None
            assert agent.stdin is not None
            assert agent.stdout.readline() == "ready\n"
            assert eventually(lambda: bool(events.extend(watch.drain()) or events))
            assert events == [AgentEvent("camera", "cam0", "boot-1", True)]
            began = time.monotonic()
            if end == "kill -9":
                agent.send_signal(signal.SIGKILL)
            else:
                agent.stdin.close()
            assert eventually(lambda: bool(events.extend(watch.drain()) or len(events) == 2))
            assert time.monotonic() - began < 1.5
            assert events[1] == AgentEvent("camera", "cam0", "boot-1", False)
            assert agent.wait(10.0) == (-signal.SIGKILL if end == "kill -9" else 0)
        finally:
            agent.kill()
            agent.wait()
            for pipe in (agent.stdin, agent.stdout):
                assert pipe is not None
                pipe.close()


def test_a_client_waits_for_its_router() -> None:
    endpoint = free_endpoint()
    opened: list[Bus] = []
    config = BusConfig(mode="client", connect=(endpoint,))
    opening = threading.Thread(target=lambda: opened.append(open_bus("local", config, timeout_s=20.0)))
    opening.start()
    opening.join(0.3)
    assert opening.is_alive(), "there is no router yet"
    with Router(endpoint):
        opening.join(10.0)
        assert len(opened) == 1
        opened[0].close()


def test_a_client_without_a_router_gives_up_when_told_to() -> None:
    config = BusConfig(mode="client", connect=(free_endpoint(),))
    with pytest.raises(InputError, match=r"no router answers at tcp/127.0.0.1:[0-9]+ .*; start one there") as error:
        open_bus("local", config, timeout_s=0.2)
    assert "\n" not in str(error.value)
    asked: list[None] = []

    def stop() -> bool:
        asked.append(None)
        return len(asked) > 2

    with pytest.raises(BusStopped):
        open_bus("local", config, stop=stop)


def test_an_address_that_is_taken_is_told_in_one_line() -> None:
    endpoint = free_endpoint()
    with (
        Router(endpoint),
        pytest.raises(InputError, match=r"Address already in use.*; check connect = ") as error,
    ):
        Router(endpoint)
    assert "\n" not in str(error.value)
    assert ".rs:" not in str(error.value)


def test_a_panic_in_the_transport_is_fatal_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh's panics are no Exception, so a plain ``except Exception`` would let them through."""
    panic = type("PanicException", (BaseException,), {})

    class Panicking:
        def put(self, payload: bytes) -> None:
            raise panic("called `Option::unwrap()` on a `None` value")

        def undeclare(self) -> None:
            raise panic("again")

    endpoint = free_endpoint()
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as bus:
        publisher = bus.publisher(OBSERVATION, "cam0")
        monkeypatch.setattr(publisher, "_publisher", Panicking())
        with pytest.raises(BusDead, match="the transport panicked"):
            publisher.put(observation("cam0"))
        publisher.close()
