"""Both buses keep the same promises: the one in memory, and Zenoh over real sockets on loopback."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from protocols.bus.base import AgentEvent, Bus, BusDead
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, RIG_INFO, STATUS, Topic, cache_size
from protocols.validation.rules import Rejected
from tests.support.receiving import collect, matched, sequences
from tests.support.samples import calibration, camera_info, eventually, observation, rig_info

Connect = Callable[..., Bus]


@pytest.fixture(params=["memory", "zenoh client", "zenoh peer"])
def connect(request: pytest.FixtureRequest) -> Iterator[Connect]:
    """Makes connections to one network; each stands for a process. All are closed at the end."""
    with ExitStack() as stack:
        if request.param == "memory":
            hub = MemoryHub()

            def make(site: str = "local") -> Bus:
                return stack.enter_context(MemoryBus(hub, site))

        else:
            endpoint = free_endpoint()
            stack.enter_context(Router(endpoint))
            mode = "client" if request.param == "zenoh client" else "peer"

            def make(site: str = "local") -> Bus:
                config = BusConfig(mode=mode, connect=(endpoint,))  # type: ignore[arg-type]
                return stack.enter_context(open_bus(site, config, timeout_s=10.0))

        yield make


def test_messages_arrive_equal_and_in_order(connect: Connect) -> None:
    sending, receiving = connect(), connect()
    subscription = receiving.subscribe(OBSERVATION)
    publishers = {camera: matched(sending.publisher(OBSERVATION, camera)) for camera in ("cam0", "cam1")}
    for index in range(300):
        for camera, publisher in publishers.items():
            publisher.put(observation(camera, index))
    received = collect(subscription, 600)
    for camera in publishers:
        own = [item for item in received if item.agent == camera]
        assert [item.message for item in own] == [observation(camera, index) for index in range(300)]
    assert {item.topic for item in received} == {OBSERVATION}
    arrivals = [item.arrival_ns for item in received]
    assert arrivals == sorted(arrivals)
    assert subscription.counters == {"received": 600, "dropped": 0, "lost": 0}


def test_who_comes_late_to_a_reliable_topic_gets_its_history_in_order(connect: Connect) -> None:
    publisher = connect().publisher(OBSERVATION, "cam0")
    for index in range(200):
        publisher.put(observation("cam0", index))
    late = connect().subscribe(OBSERVATION)
    collected = collect(late, 200)
    assert sequences(collected) == list(range(200))
    for index in range(200, 210):
        publisher.put(observation("cam0", index))
    assert sequences(collect(late, 10)) == list(range(200, 210))
    assert late.counters["lost"] == 0


def test_history_reaches_back_as_far_as_the_cache(connect: Connect) -> None:
    """A minute and a half of one camera is kept; older messages are gone, in silence and by design."""
    assert cache_size(OBSERVATION) == 2700
    assert cache_size(OBSERVATION, rate_hz=120.0) == 10_800
    publisher = connect().publisher(OBSERVATION, "cam0")
    for index in range(3000):
        publisher.put(observation("cam0", index, points=0))
    received = sequences(collect(connect().subscribe(OBSERVATION), 2700))
    assert received == list(range(300, 3000))


def test_who_comes_late_to_a_latest_topic_gets_only_the_last(connect: Connect) -> None:
    publisher = connect().publisher(CALIBRATION, "hub")
    for revision in range(1, 6):
        publisher.put(calibration(revision))
    late = connect().subscribe(CALIBRATION)
    assert [item.message for item in collect(late, 1)] == [calibration(5)]
    publisher.put(calibration(6))
    assert [item.message for item in collect(late, 1)] == [calibration(6)]


def test_a_publisher_that_comes_late_is_found(connect: Connect) -> None:
    subscription = connect().subscribe(CAMERA_INFO)
    for camera in ("cam0", "cam1"):
        connect().publisher(CAMERA_INFO, camera).put(camera_info(camera))
    assert {item.agent for item in collect(subscription, 2)} == {"cam0", "cam1"}


def test_a_camera_that_starts_again_is_heard_again(connect: Connect) -> None:
    subscription = connect().subscribe(OBSERVATION)
    for boot in ("boot-1", "boot-2"):
        with connect() as bus:
            publisher = matched(bus.publisher(OBSERVATION, "cam0"))
            for index in range(5):
                publisher.put(observation("cam0", index, boot))
            received = collect(subscription, 5)
            assert [item.message for item in received] == [observation("cam0", i, boot) for i in range(5)]


def test_a_subscription_to_one_agent_hears_no_other(connect: Connect) -> None:
    sending, receiving = connect(), connect()
    one, everyone = receiving.subscribe(OBSERVATION, "cam1"), receiving.subscribe(OBSERVATION)
    for camera in ("cam0", "cam1"):
        sending.publisher(OBSERVATION, camera).put(observation(camera))
    assert len(collect(everyone, 2)) == 2
    assert [item.agent for item in collect(one, 1)] == ["cam1"]
    assert one.drain() == []


def test_sites_do_not_hear_each_other(connect: Connect) -> None:
    here, there = connect("yard"), connect("hall")
    subscription = here.subscribe(OBSERVATION)
    watch = here.watch_agents()
    with there.announce("camera", "cam9", "boot-1"), here.announce("camera", "cam0", "boot-1"):
        there.publisher(OBSERVATION, "cam0").put(observation("cam0", 1))
        here.publisher(OBSERVATION, "cam0").put(observation("cam0", 2))
        assert sequences(collect(subscription, 1)) == [2]
        events: list[AgentEvent] = []
        assert eventually(lambda: bool(events.extend(watch.drain()) or events))
        assert [event.agent for event in events] == ["cam0"]


def test_nobody_subscribes_is_told(connect: Connect) -> None:
    sending, receiving = connect(), connect()
    publisher = sending.publisher(OBSERVATION, "cam0")
    began = time.monotonic()
    assert not publisher.wait_matched(0.2)
    assert time.monotonic() - began >= 0.2
    receiving.subscribe(OBSERVATION)
    assert publisher.wait_matched(10.0)


def test_waiting_ends_with_a_message_or_with_the_time(connect: Connect) -> None:
    subscription = connect().subscribe(OBSERVATION)
    assert not subscription.wait(0.05)
    connect().publisher(OBSERVATION, "cam0").put(observation("cam0"))
    assert subscription.wait(10.0)
    assert len(subscription.drain()) == 1
    assert not subscription.wait(0.0)


def test_a_message_in_anothers_name_and_a_bad_one_are_counted_not_delivered(connect: Connect) -> None:
    subscription = connect().subscribe(OBSERVATION)
    publisher = matched(connect().publisher(OBSERVATION, "cam0"))
    broken = observation("cam0", 1)
    broken.detections[0].size = -1.0
    for message in (observation("cam1", 0), broken, observation("cam0", 2)):
        publisher.put(message)
    assert sequences(collect(subscription, 1)) == [2]
    assert subscription.counters == {
        "received": 1,
        "dropped": 0,
        "lost": 0,
        "rejected.wrong_sender": 1,
        "rejected.out_of_range": 1,
    }


def test_a_full_queue_drops_the_oldest_and_counts(connect: Connect) -> None:
    subscription = connect().subscribe(RIG_INFO)
    publisher = matched(connect().publisher(RIG_INFO, "hub"))
    for index in range(RIG_INFO.queue + 14):
        publisher.put(rig_info(distance=index + 1.0))
    assert eventually(lambda: subscription.counters["dropped"] == 14)
    received = [item.message for item in subscription.drain()]
    assert received == [rig_info(distance=index + 1.0) for index in range(14, RIG_INFO.queue + 14)]


def test_a_message_that_may_not_be_sent_is_refused_at_the_sender(connect: Connect) -> None:
    publisher = connect().publisher(OBSERVATION, "cam0")
    with pytest.raises(TypeError, match="CameraInfo on a topic of Observation"):
        publisher.put(camera_info())
    with pytest.raises(Rejected, match="oversized"):
        publisher.put(observation(points=20_000))


@pytest.mark.parametrize("bad", ["cam/0", "cam?", "**", "$*", "#", "@adv/", ""])
def test_an_id_that_could_poison_a_router_never_reaches_it(connect: Connect, bad: str) -> None:
    bus = connect()
    for declare in (
        lambda: bus.publisher(OBSERVATION, bad),
        lambda: bus.subscribe(OBSERVATION, bad),
        lambda: bus.announce("camera", bad, "boot-1").__enter__(),
        lambda: bus.announce("camera", "cam0", bad).__enter__(),
        lambda: connect(bad),
    ):
        with pytest.raises(InputError, match="is not usable"):
            declare()


def test_agents_are_seen_coming_and_going_boot_by_boot(connect: Connect) -> None:
    first, second, watching = connect(), connect(), connect()
    events: list[AgentEvent] = []

    def seen(*expected: AgentEvent) -> bool:
        return eventually(lambda: bool(events.extend(watch.drain()) or events == list(expected)))

    def camera(boot: str, alive: bool) -> AgentEvent:
        return AgentEvent("camera", "cam0", boot, alive)

    with first.announce("camera", "cam0", "boot-1"):
        watch = watching.watch_agents()
        assert seen(camera("boot-1", True)), "agents that were alive before are reported"
        with second.announce("camera", "cam0", "boot-2"):
            assert seen(camera("boot-1", True), camera("boot-2", True)), "two boots of one id are two agents"
        assert seen(camera("boot-1", True), camera("boot-2", True), camera("boot-2", False))
    assert eventually(lambda: bool(events.extend(watch.drain()) or events[-1] == camera("boot-1", False)))
    assert len(events) == 4


def test_closing_a_bus_takes_its_agents_and_publishers_with_it(connect: Connect) -> None:
    going, staying = connect(), connect()
    watch = staying.watch_agents()
    alive = going.announce("camera", "cam0", "boot-1")
    alive.__enter__()
    going.publisher(CALIBRATION, "hub").put(calibration())
    events: list[AgentEvent] = []
    assert eventually(lambda: bool(events.extend(watch.drain()) or len(events) == 1))
    going.close()
    going.close()
    assert eventually(lambda: bool(events.extend(watch.drain()) or len(events) == 2))
    assert [event.alive for event in events] == [True, False]
    with pytest.raises(BusDead):
        going.publisher(OBSERVATION, "cam0")
    assert not staying.subscribe(CALIBRATION).wait(0.2)


def test_a_closed_subscription_receives_nothing_more(connect: Connect) -> None:
    subscription = connect().subscribe(OBSERVATION)
    publisher = matched(connect().publisher(OBSERVATION, "cam0"))
    publisher.put(observation("cam0", 0))
    assert subscription.wait(10.0)
    subscription.close()
    subscription.close()
    publisher.put(observation("cam0", 1))
    assert sequences(collect(subscription, 2, timeout_s=0.2)) == [0]


def test_every_topic_can_be_declared(connect: Connect) -> None:
    bus = connect()
    for topic in (OBSERVATION, STATUS):
        assert isinstance(topic, Topic)
        bus.publisher(topic, "cam0", rate_hz=120.0, block=True).close()
        bus.subscribe(topic).close()
