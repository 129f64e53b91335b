"""Links that are cut, lossy, slow, reordering, duplicating: no observation is lost, or their number is reported."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.topics import OBSERVATION
from tests.faults.matrix import measured
from tests.faults.processes import Link, Process, bad_link, publisher, receiver, router, rows
from tests.support.receiving import collect, sequences
from tests.support.samples import observation

ENDPOINT = "tcp/10.99.0.2:7447"
Ends = tuple[Process, Process, Link]


@pytest.fixture
def ends(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Ends]:
    """A camera at 30 Hz on one side, router and receiver on the other."""
    with ExitStack() as stack:
        near, far, link = stack.enter_context(bad_link(tmp_path))
        stack.enter_context(router(tmp_path, ENDPOINT, far))
        receiving = stack.enter_context(receiver(ENDPOINT, namespace=far))
        receiving.ready()
        sending = stack.enter_context(publisher(ENDPOINT, outage_s=getattr(request, "param", 60.0), namespace=near))
        assert sending.ready()["ready"]
        yield sending, receiving, link


def final_counts(receiving: Process, patience_s: float = 20.0) -> dict:
    """What was received, once nothing more comes."""
    last, since = -1, time.monotonic()
    while True:
        answer = receiving.ask()
        count = sum(map(len, answer["sequences"].values()))
        if count != last:
            last, since = count, time.monotonic()
        if time.monotonic() - since > 3.0 or time.monotonic() - since > patience_s:
            return answer
        time.sleep(0.2)


def test_a_partition_of_a_minute_loses_nothing(ends: Ends) -> None:
    sending, receiving, link = ends
    time.sleep(2.0)
    link.set(partition=1)
    time.sleep(60.0)
    link.set()
    healed = time.monotonic()
    time.sleep(6.0)
    put = sending.ask("stop")["put"]
    answer = final_counts(receiving)
    (sequences,), (arrivals,) = answer["sequences"].values(), answer["arrivals"].values()
    flowing = min(arrival for arrival in arrivals if arrival > healed) - healed
    lost = put - len(set(sequences))
    measured(
        "partition of 60 s at 30 Hz",
        "0 lost, in order, flowing ≤ 3 s after healing",
        f"{lost} of {put} lost, {'in order' if sequences == sorted(sequences) else 'OUT OF ORDER'}, "
        f"flowing {flowing:.2f} s after healing",
        flowing <= 3.0,
    )
    assert sequences == list(range(put))
    assert answer["counters"]["lost"] == 0


def test_links_that_are_cut_at_once_hold_up_no_other(tmp_path: Path) -> None:
    with ExitStack() as stack:
        near, far, link = stack.enter_context(bad_link(tmp_path))
        stack.enter_context(router(tmp_path, ENDPOINT, far))
        receiving = stack.enter_context(receiver(ENDPOINT, namespace=far))
        receiving.ready()
        for camera, side in (("cam0", far), *((f"cam{index}", near) for index in range(1, 5))):
            assert stack.enter_context(publisher(ENDPOINT, camera, namespace=side)).ready()["ready"]
        time.sleep(2.0)
        link.set(partition=1)
        time.sleep(6.0)
        arrivals = max(receiving.ask()["arrivals"].values(), key=len)  # of cam0, whose link holds
    pause_s = max(later - earlier for earlier, later in itertools.pairwise([*arrivals, time.monotonic()]))
    restarts = (tmp_path / "router.txt").read_text(encoding="utf-8").count("starting anew")
    measured("four links cut at once", "no pause of a fifth", f"{pause_s:.2f} s, {restarts} restarts", pause_s <= 0.5)
    assert restarts == 0


@pytest.mark.parametrize("ends", [4.0], indirect=True)
def test_beyond_the_cache_the_exact_number_is_reported(ends: Ends) -> None:
    """Cache for 4 s and half as much again, a cut of 15 s."""
    sending, receiving, link = ends
    time.sleep(2.0)
    link.set(partition=1)
    time.sleep(15.0)
    link.set()
    time.sleep(6.0)
    put = sending.ask("stop")["put"]
    answer = final_counts(receiving)
    (sequences,) = answer["sequences"].values()
    missing, reported = put - len(sequences), answer["counters"]["lost"]
    measured("cut of 15 s, cache for 4 s", "the exact number of lost ones", f"{missing} missing, {reported} reported")
    assert missing > 0
    assert reported == missing
    assert sequences == sorted(set(sequences))


@pytest.mark.parametrize(
    ("name", "rules"),
    [
        ("30 % loss + 300 ms", {"loss": 0.3, "delay_s": 0.15}),
        ("reordering and duplicates", {"jitter_s": 0.05, "duplicate": 0.3}),
    ],
)
def test_a_bad_link_loses_nothing(ends: Ends, name: str, rules: dict[str, float]) -> None:
    """300 ms there and back."""
    sending, receiving, link = ends
    time.sleep(1.0)
    link.set(**rules)
    time.sleep(15.0)
    link.set()
    healed = time.monotonic()
    time.sleep(4.0)
    put = sending.ask("stop")["put"]
    answer = final_counts(receiving)
    (sequences,), (arrivals,) = answer["sequences"].values(), answer["arrivals"].values()
    flowing = min(arrival for arrival in arrivals if arrival > healed) - healed
    p99 = rows(answer["latencies"], 0.99)
    measured(
        f"{name}, 15 s",
        "0 lost, in order",
        f"{put - len(set(sequences))} of {put} lost, in order, p99 {p99:.2f} s, flowing {flowing:.2f} s after",
        flowing <= 3.0,
    )
    assert sequences == list(range(put))


def test_a_router_is_reached_over_a_long_way(tmp_path: Path) -> None:
    """800 ms there and back, as over two satellites: no attempt was long enough, and "no router answers" was wrong."""
    with ExitStack() as stack:
        near, far, link = stack.enter_context(bad_link(tmp_path))
        stack.enter_context(router(tmp_path, ENDPOINT, far))
        link.set(delay_s=0.4)
        began = time.monotonic()
        connected = bool(stack.enter_context(receiver(ENDPOINT, namespace=near)).line())
        took = time.monotonic() - began
    measured("router 800 ms there and back", "reached", f"reached after {took:.1f} s" if connected else "not reached")
    assert connected


@contextmanager
def slow_link(endpoint: str, bytes_per_s: float) -> Iterator[str]:
    """An endpoint in front of another, from which bytes come no faster."""

    def forward(source: socket.socket, sink: socket.socket, pause_s: float) -> None:
        with suppress(OSError):
            while data := source.recv(1400):
                time.sleep(pause_s * len(data))
                sink.sendall(data)
        sink.close()

    def accept() -> None:
        with suppress(OSError):
            while True:
                near = listening.accept()[0]
                far = socket.create_connection(("127.0.0.1", int(endpoint.rsplit(":", 1)[1])))
                for end in (near, far):
                    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)
                threading.Thread(target=forward, args=(near, far, 0.0), daemon=True).start()
                threading.Thread(target=forward, args=(far, near, 1.0 / bytes_per_s), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=accept, daemon=True).start()
        yield f"tcp/127.0.0.1:{listening.getsockname()[1]}"


def test_a_late_joiner_over_a_slow_link_gets_the_whole_history() -> None:
    """0.4 MB at 300 kB/s."""
    endpoint = free_endpoint()
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as sending:
        publisher = sending.publisher(OBSERVATION, "cam0")
        for index in range(200):
            publisher.put(observation("cam0", index, points=12))
        with slow_link(endpoint, 3e5) as slow, open_bus("local", BusConfig(mode="client", connect=(slow,))) as bus:
            begun = time.monotonic()
            subscription = bus.subscribe(OBSERVATION)
            received = collect(subscription, 200, 40.0)
            measured(
                "late joiner, 200 messages over 300 kB/s",
                "0 lost",
                f"{200 - len(received)} lost, {time.monotonic() - begun:.1f} s",
                True,
            )
            assert sequences(received) == list(range(200))
            assert subscription.counters["lost"] == 0


def test_histories_of_silent_cameras_over_a_slow_link_delay_nothing_else() -> None:
    """Six with 0.7 MB each at 100 kB/s, and one that goes on."""
    endpoint = free_endpoint()
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as sending:
        silent = {f"cam{number}": sending.publisher(OBSERVATION, f"cam{number}") for number in range(6)}
        for index in range(360):
            for name, publisher in silent.items():
                publisher.put(observation(name, index, points=12))
        with slow_link(endpoint, 1e5) as slow, open_bus("local", BusConfig(mode="client", connect=(slow,))) as bus:
            subscription, live, begun = (
                bus.subscribe(OBSERVATION),
                sending.publisher(OBSERVATION, "live"),
                time.monotonic(),
            )
            put: list[float] = []
            heard: dict[str, list[float]] = {}
            while time.monotonic() - begun < 40.0 and len(heard.get("live", ())) < 60:
                if len(put) < 60:
                    live.put(observation("live", len(put), points=12))
                    put.append(time.monotonic())
                time.sleep(0.2)
                for one in subscription.drain():
                    heard.setdefault(one.agent, []).append(time.monotonic())
            late = max(arrival - sent for sent, arrival in zip(put, heard["live"], strict=True))
            measured(
                "histories of six silent cameras, 0.7 MB each over 100 kB/s, beside one that goes on",
                "all heard, the one that goes on within 4 s",
                f"{len(heard) - 1} heard, the other {late:.1f} s late at most",
                late < 4.0,
            )
            assert len(heard) == 7
