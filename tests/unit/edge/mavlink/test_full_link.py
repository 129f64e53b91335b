"""Links that carry less than there is to say: a serial line of 57,600 baud, and a full TCP buffer."""

from __future__ import annotations

import errno
import os
import select
import socket
import tty
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.link.outbox import Outbox
from edge.mavlink.link.transport import Tcp, Udp, Url, parse_url
from tests.faults.stations import exchanged

NAN = float("nan")
SENT = {"HEARTBEAT": 10, "COMMAND_ACK": 10, "CAMERA_TRACKING_IMAGE_STATUS": 600, "CAMERA_FOV_STATUS": 2400}


def camera_messages(time_s: float) -> list[Any]:
    """Four times what 57,600 baud carry, at 60 Hz."""
    fov = mavlink.MAVLink_camera_fov_status_message(round(1e3 * time_s), 1, 1, 1, 1, 1, 1, [1.0, 0.5, 0.5, 0.5], 60, 45)
    image = mavlink.MAVLink_camera_tracking_image_status_message(1, 2, 4, 0.5, 0.5, 0.1, 0.4, 0.4, 0.6, 0.6)
    return [*([fov] * 4), image]


@contextmanager
def serial_link(clock: list[float]) -> Iterator[tuple[Link, int]]:
    """A link on a pseudo-terminal, and the file descriptor of its other end."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    url = parse_url(f"serial:{os.ttyname(theirs)}:57600")
    link = Link(
        url, system=None, component=100, allowed=("HEARTBEAT",), vehicle=1, now_ns=lambda: round(1e9 * clock[0])
    )
    link.poll()
    try:
        yield link, ours
    finally:
        link.close()
        os.close(ours)
        os.close(theirs)


def drained(end: int) -> bytes:
    """All bytes that have arrived."""
    data = b""
    while select.select([end], [], [], 0.0)[0]:
        data += os.read(end, 65_536)
    return data


def decoded(data: bytes) -> list[Any]:
    """Messages by pymavlink's own parser, which must find nothing else."""
    codec = mavlink.MAVLink(None)
    messages = codec.parse_buffer(data) or []
    assert codec.total_receive_errors == 0
    return messages


def test_a_full_serial_line_carries_what_matters_first() -> None:
    clock = [0.0]
    arrived: list[tuple[float, Any]] = []
    with serial_link(clock) as (link, end):
        stream = b""
        for k in range(600):  # ten seconds
            clock[0] = k / 60.0
            for message in camera_messages(clock[0]):
                link.send(message)
            if k % 60 == 0:
                link.send(mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3))
            if k % 60 == 30:
                link.send(mavlink.MAVLink_command_ack_message(2005, 0, 0, 0, 255, 190))
            link.poll()
            data = drained(end)
            stream += data
            arrived += [(clock[0], message) for message in decoded(data)]
    assert len(stream) <= 5760 * 10.0 * 1.02
    assert len(stream) > 5760 * 10.0 * 0.9
    counts = Counter(message.get_type() for _, message in arrived)
    assert counts["HEARTBEAT"] == counts["COMMAND_ACK"] == 10
    assert counts["CAMERA_TRACKING_IMAGE_STATUS"] >= 550
    assert 0 < counts["CAMERA_FOV_STATUS"] < counts["CAMERA_TRACKING_IMAGE_STATUS"]
    late = [time - k for k, (time, _) in enumerate(one for one in arrived if one[1].get_type() == "HEARTBEAT")]
    assert max(late) < 0.1
    assert link.counters["dropped.CAMERA_FOV_STATUS"] > 1000
    loads = f"more than 3 times its capacity for 10 s: {', '.join(f'{sent} {kind}' for kind, sent in SENT.items())}"
    exchanged("serial port, 57,600 baud", loads, ", ".join(f"{counts[kind]} {kind}" for kind in SENT))
    sequence = [message.get_seq() for _, message in arrived]
    assert sequence == [k % 256 for k in range(len(sequence))]  # nothing that got a number was lost


def test_messages_are_received_over_the_same_serial_line() -> None:
    with serial_link([0.0]) as (link, end):
        os.write(end, bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 1))))
        link.wait(1.0)
        assert [one.kind for one in link.poll()] == ["HEARTBEAT"]


def test_a_serial_line_that_takes_nothing_neither_blocks_nor_tears_a_message() -> None:
    clock = [0.0]
    with serial_link(clock) as (link, end):
        for k in range(3000):  # nobody reads: the kernel's buffer is full after a second
            clock[0] = k / 60.0
            for message in camera_messages(clock[0]):
                link.send(message)
        assert link.open
        assert link.counters["broken"] == 0
        data = drained(end)
        clock[0] += 1.0
        link.poll()
        data += drained(end)
        assert len(decoded(data)) > 30


def test_a_full_tcp_buffer_delays_and_replaces_but_never_breaks_the_link() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        transport = Tcp(Url("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        with peer:
            transport._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
            link = Link(None, system=1, component=100, allowed=(), transport=transport, vehicle=1)
            for k in range(5000):
                for message in camera_messages(k / 60.0):
                    assert link.send(message)
            link.send(mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3))
            assert link.counters["broken"] == 0
            peer.settimeout(0.2)
            data = b""
            while True:
                try:
                    data += peer.recv(65_536)
                except TimeoutError:
                    break
                link.poll()
            link.close()
    messages = decoded(data)
    assert len(messages) > 10
    assert "HEARTBEAT" in [message.get_type() for message in messages[-3:]]


def test_over_udp_nothing_waits() -> None:
    peer = Udp(Url("udpin", "127.0.0.1", 0), bound=True)
    link = Link(parse_url(f"udpout:127.0.0.1:{peer.port}"), system=1, component=100, allowed=(), vehicle=1)
    link.poll()
    for message in camera_messages(0.0):
        assert link.send(message)
    peer.wait(1.0)
    assert len(peer.receive()) == 5
    link.close()
    peer.close()


@pytest.mark.parametrize("error", [errno.ENETUNREACH, errno.ENETDOWN, errno.EPERM])
def test_a_network_that_is_away_costs_datagrams_and_not_the_socket(error: int) -> None:
    transport = Udp(Url("udpin", "127.0.0.1", 0), bound=True)
    link = Link(None, system=1, component=100, allowed=("HEARTBEAT",), transport=transport)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        beat = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 1)))
        vehicle.sendto(beat, ("127.0.0.1", transport.port))
        link.wait(1.0)
        assert len(link.poll()) == 1

        def away(*_: object) -> int:
            raise OSError(error, os.strerror(error))

        working = transport._socket
        transport._socket = SimpleNamespace(sendto=away, recvfrom=working.recvfrom)  # type: ignore[assignment]
        assert link.send(mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3))
        transport._socket = working
        vehicle.sendto(beat, ("127.0.0.1", transport.port))
        link.wait(1.0)
        assert len(link.poll()) == 1
    assert link.counters["broken"] == 0
    link.close()


def test_the_queue_is_bounded_and_the_least_important_goes_first() -> None:
    counters: Counter[str] = Counter()
    outbox = Outbox(1.0, counters)
    for _ in range(100):
        outbox.put(mavlink.MAVLink_statustext_message(6, b"hello"))
    outbox.put(mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3))
    assert counters["dropped.STATUSTEXT"] == 37
    assert outbox.next(0).get_type() == "HEARTBEAT"


@pytest.mark.parametrize("kind", ["HEARTBEAT", "CAMERA_TRACKING_IMAGE_STATUS"])
def test_of_a_status_only_the_newest_waits(kind: str) -> None:
    counters: Counter[str] = Counter()
    outbox = Outbox(None, counters)
    for k in range(5):
        messages = {
            "HEARTBEAT": mavlink.MAVLink_heartbeat_message(30, 8, 0, k, 4, 3),
            "CAMERA_TRACKING_IMAGE_STATUS": mavlink.MAVLink_camera_tracking_image_status_message(
                1, 2, 4, 0.1 * k, NAN, NAN, NAN, NAN, NAN, NAN
            ),
        }
        outbox.put(messages[kind])
    newest = outbox.next(0)
    assert getattr(newest, "custom_mode", 4) == 4
    assert getattr(newest, "point_x", 0.4) == pytest.approx(0.4)
    outbox.sent(10)
    assert outbox.next(0) is None
    assert counters[f"dropped.{kind}"] == 4
