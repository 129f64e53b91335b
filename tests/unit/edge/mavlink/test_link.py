"""Validation of messages on a MAVLink link: what is accepted, and the counters of rejections."""

from __future__ import annotations

import itertools
import json
import math
import random
import time
from pathlib import Path
from typing import Any

import pytest

from edge.mavlink.dialect import mavlink
from edge.mavlink.link import connection
from edge.mavlink.link import signing as signing_module
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.link.framing import Framer
from edge.mavlink.link.signing import EPOCH_UNIX_S, TICKS, Signing, read_key, ticks
from edge.mavlink.link.transport import parse_url
from protocols.core.errors import InputError
from tests.support.pipe import Pipe

KEY = bytes(range(32))
UNIX_S = 1_700_000_000.0
KINDS = ("HEARTBEAT", "ATTITUDE", "COMMAND_LONG", "GIMBAL_DEVICE_ATTITUDE_STATUS")


class Sender:
    """One component that sends on a pipe."""

    def __init__(self, pipe: Pipe, system: int = 1, component: int = 1, key: bytes | None = None) -> None:
        self.pipe = pipe
        self.codec: Any = mavlink.MAVLink(None, system, component)
        if key is not None:
            self.codec.signing.secret_key, self.codec.signing.sign_outgoing = key, True
            self.codec.signing.timestamp = ticks(UNIX_S)

    def pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self.codec))
        self.codec.seq = (self.codec.seq + 1) % 256
        return data

    def send(self, message: Any) -> bytes:
        data = self.pack(message)
        self.pipe.send(data, None)
        return data


def heartbeat(autopilot: int = 3, kind: int = 2) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


def attitude(roll: float = 0.1, boot_ms: int = 1000) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ms, roll, 0.0, 0.0, 0.0, 0.0, 0.0)


def make_link(**options: Any) -> tuple[Link, Pipe]:
    ours, theirs = Pipe.pair()
    options.setdefault("system", 1)
    link = Link(None, component=100, allowed=KINDS, transport=ours, unix_s=lambda: UNIX_S, **options)
    return link, theirs


def kinds(received: list[ReceivedMessage]) -> list[str]:
    return [message.kind for message in received]


def test_valid_messages_are_found_between_random_bytes() -> None:
    rng = random.Random(5)
    sender = Sender(Pipe())
    stream, sent = bytearray(), 0
    for k in range(300):
        stream += rng.randbytes(rng.randrange(40)).replace(b"\xfd", b"\x00").replace(b"\xfe", b"\x00")
        stream += sender.pack(attitude(boot_ms=k))
        sent += 1
    framer = Framer()
    got = []
    for at in range(0, len(stream), 37):
        got += [message.time_boot_ms for message, _ in framer.feed(bytes(stream[at : at + 37]))]
    assert got == list(range(sent))


def test_a_false_start_marker_does_not_discard_the_message_after_it() -> None:
    good = Sender(Pipe()).pack(attitude(boot_ms=7))
    framer = Framer()
    got = [m for m, _ in framer.feed(b"\xfd\xff\x00\x00" + good + bytes(300))]
    assert [m.time_boot_ms for m in got] == [7]


def test_messages_are_accepted_only_after_an_autopilots_heartbeat_and_from_that_vehicle() -> None:
    link, pipe = make_link()
    vehicle, other = Sender(pipe), Sender(pipe, system=2)
    vehicle.send(attitude())
    Sender(pipe, component=190).send(heartbeat(autopilot=8))  # a station's
    assert link.poll() == []
    assert link.vehicle is None
    vehicle.send(heartbeat())
    vehicle.send(attitude())
    assert kinds(link.poll()) == ["HEARTBEAT", "ATTITUDE"]
    for kind in (mavlink.MAV_TYPE_ANTENNA_TRACKER, mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_ADSB):
        other.send(heartbeat(mavlink.MAV_AUTOPILOT_GENERIC, kind))
    link.poll()
    assert link.second_sender(time.monotonic_ns()) == ""
    other.send(heartbeat())
    assert link.poll() == []
    assert (link.vehicle, link.counters["refused.other_vehicle"]) == (1, 1)
    assert link.second_sender(time.monotonic_ns()).startswith("system 2 is on this link too, and is not followed")
    chosen, pipe = make_link(vehicle=1)
    for system in (1, 2):
        Sender(pipe, system).send(heartbeat())
    chosen.poll()
    assert (chosen.vehicle, chosen.second_sender(time.monotonic_ns())) == (1, "")


def test_only_the_vehicles_own_signatures_are_counted() -> None:
    link, pipe = make_link()
    Sender(pipe).send(heartbeat())
    Sender(pipe, system=255, component=190, key=KEY).send(heartbeat(autopilot=8))
    link.poll()
    assert link.counters["signed"] == 0
    Sender(pipe, key=KEY).send(heartbeat())
    link.poll()
    assert link.counters["signed"] == 1


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_message_with_a_non_finite_number_is_rejected_and_counted(value: float) -> None:
    link, pipe = make_link()
    sender = Sender(pipe)
    sender.send(heartbeat())
    sender.send(attitude(roll=value))
    assert kinds(link.poll()) == ["HEARTBEAT"]
    assert link.counters["refused.not_finite"] == 1


def test_a_gimbals_attitude_counts_where_rates_are_not_available() -> None:
    """ArduPilot sends NaN for what it does not know: no gimbal of it was ever heard."""
    link, pipe = make_link()
    sender, nan = Sender(pipe), math.nan
    sender.send(heartbeat())
    sender.send(
        mavlink.MAVLink_gimbal_device_attitude_status_message(
            0, 0, 1000, 44, [1.0, 0.0, 0.0, 0.0], nan, nan, nan, 0, nan, nan, 1
        )
    )
    assert kinds(link.poll()) == ["HEARTBEAT", "GIMBAL_DEVICE_ATTITUDE_STATUS"]


@pytest.mark.parametrize(
    ("sent", "problem"),
    [
        (random.Random(1).randbytes(2000), "check the baud rate"),
        (Sender(Pipe(), component=190).pack(heartbeat(autopilot=8)), "messages arrive, but no autopilot's heartbeat"),
    ],
    ids=["garbage", "a station"],
)
def test_what_arrives_in_place_of_the_vehicle_is_named(sent: bytes, problem: str) -> None:
    link, pipe = make_link()
    pipe.send(sent, None)
    assert link.poll() == []
    assert problem in link.problem
    Sender(pipe).send(heartbeat())
    link.poll()
    assert link.problem == ""


def test_a_tcp_connection_whose_other_side_is_gone_is_made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight controller that is switched off closes nothing: its link was dead for a quarter of an hour."""
    now, opened = [0], []

    def open_anew(url: object) -> Pipe:
        ours, theirs = Pipe.pair()
        opened.append(theirs)
        return ours

    monkeypatch.setattr(connection, "open_transport", open_anew)
    link = Link(parse_url("tcp:10.0.0.1:5760"), system=1, component=100, allowed=KINDS, now_ns=lambda: now[0])
    for k in range(300):
        now[0] = (k + 1) * 100_000_000
        if opened and k < 50:
            Sender(opened[0]).send(heartbeat())
        if k > 200:
            Sender(opened[-1]).send(heartbeat())
        link.poll()
    assert len(opened) == 2
    assert now[0] - link.last_received_ns < 200_000_000


def test_a_message_type_that_is_not_allowed_is_ignored() -> None:
    link, pipe = make_link()
    sender = Sender(pipe)
    sender.send(heartbeat())
    sender.send(mavlink.MAVLink_statustext_message(6, b"hello"))
    assert kinds(link.poll()) == ["HEARTBEAT"]
    assert link.counters["not_needed"] == 1


def test_with_a_key_only_fresh_signed_messages_are_accepted() -> None:
    link, pipe = make_link(signing=Signing(KEY))
    good = Sender(pipe, key=KEY)
    first = good.send(heartbeat())
    assert kinds(link.poll()) == ["HEARTBEAT"]
    pipe.send(first, None)  # a replay
    Sender(pipe).send(attitude())
    Sender(pipe, key=bytes(32)).send(attitude())
    good.codec.signing.timestamp += 6 * TICKS
    good.send(attitude())
    assert link.poll() == []
    reasons = {name: count for name, count in link.counters.items() if name.startswith("refused")}
    assert reasons == {"refused.replayed": 1, "refused.unsigned": 1, "refused.wrong_key": 1, "refused.future": 1}
    good.codec.signing.timestamp = ticks(UNIX_S) + TICKS
    good.send(attitude())
    assert kinds(link.poll()) == ["ATTITUDE"]


def test_a_new_sender_more_than_a_minute_late_is_rejected() -> None:
    link, pipe = make_link(signing=Signing(KEY))
    late = Sender(pipe, key=KEY)
    late.codec.signing.timestamp = ticks(UNIX_S) - 61 * TICKS
    late.send(heartbeat())
    assert link.poll() == []
    assert link.counters["refused.late"] == 1


def test_after_a_restart_replays_are_rejected_and_no_timestamp_is_reused(tmp_path: Path) -> None:
    state = tmp_path / "times.json"
    link, pipe = make_link(signing=Signing(KEY, state))
    frame = Sender(pipe, key=KEY).send(heartbeat())
    assert kinds(link.poll()) == ["HEARTBEAT"]
    link.send(heartbeat(autopilot=8))
    used = json.loads(state.read_text())["sent"]
    link.close()
    again, pipe = make_link(signing=Signing(KEY, state))
    pipe.send(frame, None)
    assert again.poll() == []
    assert again.counters["refused.replayed"] == 1
    # Even where the clock has been set back.
    assert Signing(KEY, state).next_time(UNIX_S - 1e6) > used


def test_sent_messages_are_signed_and_pymavlink_accepts_them() -> None:
    link, pipe = make_link(signing=Signing(KEY))
    assert link.send(heartbeat(autopilot=8))
    receiver: Any = mavlink.MAVLink(None)
    receiver.robust_parsing = True
    receiver.signing.secret_key = KEY
    ((data, _),) = pipe.receive()
    assert receiver.parse_buffer(data)[0].get_type() == "HEARTBEAT"
    receiver.signing.secret_key = bytes(32)
    assert receiver.parse_buffer(data)[0].get_type() == "BAD_DATA"


def test_a_camera_uses_the_system_id_of_its_vehicle() -> None:
    link, pipe = make_link(system=None)
    Sender(pipe, system=42).send(heartbeat())
    link.poll()
    pipe.receive()
    link.send(heartbeat(autopilot=8))
    ((data, _),) = pipe.receive()
    message = mavlink.MAVLink(None).parse_buffer(data)[0]
    assert (message.get_srcSystem(), message.get_srcComponent()) == (42, 100)


def test_another_component_with_the_same_ids_is_named_and_an_echo_is_not() -> None:
    """Two cameras of one vehicle: stations saw one, both took its commands, and nothing said so."""
    link, pipe = make_link(system=None)
    Sender(pipe).send(heartbeat())
    link.poll()
    link.send(heartbeat(autopilot=8))
    ((own, _),) = pipe.receive()
    pipe.send(own, None)
    link.poll()
    assert link.second_sender(time.monotonic_ns()) == ""
    twin = Sender(pipe, component=100)
    for _ in range(2):
        twin.send(heartbeat(autopilot=8))
    link.poll()
    assert link.second_sender(time.monotonic_ns()).startswith("another component 100 of system 1 is on this link")


def test_a_broken_link_is_reopened_with_increasing_pauses() -> None:
    now = [0]
    link = Link(parse_url("tcp:127.0.0.1:1"), system=1, component=100, allowed=KINDS, now_ns=lambda: now[0])
    tried = []
    for _ in range(3000):
        before = link.counters["broken"]
        assert link.poll() == []
        if link.counters["broken"] > before:
            tried.append(now[0])
        now[0] += 10_000_000
    gaps = [b - a for a, b in itertools.pairwise(tried)]
    assert gaps == sorted(gaps)
    assert gaps[0] < 300_000_000
    assert 900_000_000 < gaps[-1] <= 1_010_000_000  # a router that restarts is found within a second
    assert not link.send(heartbeat())


@pytest.mark.parametrize(
    ("text", "kind", "number"),
    [
        ("udpin:0.0.0.0:14550", "udpin", 14550),
        ("udp:127.0.0.1:0", "udpin", 0),
        ("udpout:10.0.0.2:14551", "udpout", 14551),
        ("tcp:localhost:5760", "tcp", 5760),
        ("serial:/dev/ttyAMA0:921600", "serial", 921600),
        ("/dev/ttyACM0,57600", "serial", 57600),
        ("/dev/ttyACM0", "serial", 57600),
    ],
)
def test_addresses_have_the_syntax_of_mavlink_tools(text: str, kind: str, number: int) -> None:
    url = parse_url(text)
    assert (url.kind, url.number) == (kind, number)


@pytest.mark.parametrize(
    "text", ["", "udpin", "udpout:host:0", "udpin:host:70000", "http://x", "serial:ttyS0", "a b", "udp://:1"]
)
def test_other_addresses_are_refused_with_a_remedy(text: str) -> None:
    with pytest.raises(InputError, match="write it like"):
        parse_url(text)


def test_a_key_is_32_bytes_or_64_digits(tmp_path: Path) -> None:
    file = tmp_path / "key"
    file.write_bytes(KEY)
    assert read_key(file) == KEY
    file.write_text(KEY.hex() + "\n")
    assert read_key(file) == KEY
    file.write_text("secret")
    with pytest.raises(InputError, match="sha256sum"):
        read_key(file)
    with pytest.raises(InputError, match="check the path"):
        read_key(tmp_path / "none")


def test_an_unreadable_file_of_signing_timestamps_is_refused(tmp_path: Path) -> None:
    state = tmp_path / "times.json"
    state.write_text("{}")
    with pytest.raises(InputError, match="delete it"):
        Signing(KEY, state)


def test_signing_timestamps_count_from_2015() -> None:
    assert ticks(EPOCH_UNIX_S) == 0
    assert ticks(EPOCH_UNIX_S + 1.0) == TICKS
    assert ticks(0.0) == 0  # a clock that was never set


def test_a_full_disk_costs_the_flight_nothing_and_the_times_are_stored_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, now = tmp_path / "times.json", [UNIX_S]
    full = [True]

    def write(file: Path, text: str) -> None:
        if full[0]:
            raise InputError("No space left on device", file=file)
        file.write_text(text)

    monkeypatch.setattr(signing_module, "write_atomically", write)
    ours, pipe = Pipe.pair()
    link = Link(
        None,
        system=1,
        component=100,
        allowed=KINDS,
        transport=ours,
        signing=Signing(KEY, state),
        unix_s=lambda: now[0],
    )
    sender = Sender(pipe, key=KEY)
    for _ in range(3):
        now[0] += 6.0
        sender.codec.signing.timestamp = ticks(now[0])
        sender.send(heartbeat())
        assert kinds(link.poll()) == ["HEARTBEAT"]
        assert link.send(heartbeat(autopilot=8))
    assert link.report(0) == "signing times are not on disk: No space left on device"
    full[0] = False
    now[0] += 6.0
    link.send(heartbeat(autopilot=8))
    link.poll()
    assert link.report(0) == ""
    assert json.loads(state.read_text())["sent"] >= ticks(now[0])
    full[0] = True
    link.close()  # at the end of a flight as well


def test_while_the_clock_is_not_set_the_time_of_the_last_run_goes_on(tmp_path: Path) -> None:
    state, passed = tmp_path / "times.json", [0.0]
    first = Signing(KEY, state)
    first.next_time(UNIX_S)
    first.save()
    again = Signing(KEY, state, monotonic_s=lambda: passed[0])
    passed[0] = 100.0
    assert ticks(UNIX_S + 100.0) <= again.next_time(0.0) <= ticks(UNIX_S + 106.0)
