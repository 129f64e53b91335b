"""Who the vehicle is: restarted routers, strangers, changed system ids, and clocks that are behind."""

from __future__ import annotations

from typing import Any

import pytest

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.link.signing import TICKS, Signing, ticks
from tests.faults.stations import exchanged

A, B, C = ("10.0.0.1", 5000), ("10.0.0.1", 6000), ("10.0.0.9", 5000)
KEY = bytes(range(32))
UNIX_S = 1_700_000_000.0
HOME = (473977000, 85456000)
FAR = (473977000, 86456000)  # 7 km


class Socket:
    """A bound socket with any number of senders. sent: what was sent, by address."""

    def __init__(self) -> None:
        self.waiting: list[tuple[bytes, tuple[str, int]]] = []
        self.sent: list[tuple[bytes, Any]] = []

    def wait(self, timeout_s: float) -> bool:
        return True

    def receive(self) -> list[tuple[bytes, tuple[str, int]]]:
        out, self.waiting = self.waiting, []
        return out

    def send(self, data: bytes, address: Any) -> bool:
        self.sent.append((data, address))
        return True

    def close(self) -> None:
        pass


class LinkUnderTest:
    """A link on a bound socket, and autopilots anywhere. Times in seconds of the host's clock."""

    def __init__(self, *, key: bytes | None = None, vehicle: int | None = None) -> None:
        self.socket, self.now = Socket(), 0.0
        self.key = key
        self.link = Link(
            None,
            system=None,
            component=100,
            allowed=("HEARTBEAT", "ATTITUDE", "GLOBAL_POSITION_INT"),
            signing=None if key is None else Signing(key),
            vehicle=vehicle,
            transport=self.socket,
            now_ns=lambda: round(1e9 * (100.0 + self.now)),
            unix_s=lambda: UNIX_S + self.now,
        )
        self.received: list[Any] = []

    def autopilot(
        self,
        address: tuple[str, int],
        seconds: float,
        *,
        system: int = 1,
        boot_s: float = 500.0,
        place: tuple[int, int] | None = HOME,
        behind_s: float = 0.0,
        telemetry: bool = True,
    ) -> float | None:
        """An autopilot sends for some time at 10 Hz; when it was first accepted, after its start [s].

        boot_s: its uptime at time 0. behind_s: how far its signing time is behind. telemetry: not only heartbeats.
        """
        codec = mavlink.MAVLink(None, system, 1)
        if self.key is not None:
            codec.signing.secret_key, codec.signing.sign_outgoing = self.key, True
        began, first = self.now, None
        for k in range(round(10 * seconds)):
            if self.key is not None:
                codec.signing.timestamp = ticks(UNIX_S + self.now - behind_s)
            boot_ms = round(1e3 * (boot_s + self.now))
            messages = [mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0)] if telemetry else []
            if k % 10 == 0:
                messages.insert(0, mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
            if telemetry and place is not None and k % 2 == 0:
                messages.append(mavlink.MAVLink_global_position_int_message(boot_ms, *place, 500000, 20000, 0, 0, 0, 0))
            self.socket.waiting = [(bytes(message.pack(codec)), address) for message in messages]
            got = self.link.poll()
            if got and first is None and self.link.vehicle == system:
                first = self.now - began
            self.received += got
            self.now += 0.1
        return first

    def silence(self, seconds: float) -> None:
        self.now += seconds

    def report(self) -> str:
        return self.link.report(round(1e9 * (100.0 + self.now)))


@pytest.mark.parametrize("down_s", [0.0, 0.5, 30.0])
def test_a_restarted_router_is_followed_to_its_new_port_within_two_seconds(down_s: float) -> None:
    under_test = LinkUnderTest()
    assert under_test.autopilot(A, 3.0) == 0.0
    under_test.silence(down_s)
    relocked = under_test.autopilot(B, 4.0)
    assert relocked is not None
    assert relocked <= 2.0
    assert under_test.link.counters["handed_over"] == 1
    exchanged(
        "mavlink-router, udpin", f"away for {down_s:g} s, back on another port", f"heard again after {relocked:.1f} s"
    )


def test_of_a_vehicle_that_only_sends_heartbeats_another_port_is_followed_soon_and_another_host_late() -> None:
    for address, soon in ((B, True), (C, False)):
        under_test = LinkUnderTest()
        under_test.autopilot(A, 3.0, telemetry=False)
        relocked = under_test.autopilot(address, 12.0, telemetry=False)
        assert relocked is not None
        assert (relocked <= 2.0) == soon


@pytest.mark.parametrize(
    ("stranger", "why"),
    [
        ({"boot_s": 90_000.0}, "boot time is another"),
        ({"boot_s": 450.0, "place": None}, "boot time is another"),
        ({"place": FAR}, "somewhere else"),
        ({"boot_s": -15.0, "place": FAR}, "somewhere else"),
        ({"system": 2, "boot_s": -15.0, "place": None}, "boot time is another"),
    ],
)
def test_an_unsigned_stranger_never_takes_the_link_and_the_vehicle_gets_it_back(
    stranger: dict[str, Any], why: str
) -> None:
    under_test = LinkUnderTest()
    under_test.autopilot(A, 3.0)
    under_test.silence(12.0)
    assert under_test.autopilot(C, 5.0, **stranger) is None
    assert why in under_test.report()
    assert under_test.link.counters["refused.identity"] > 0
    back = under_test.autopilot(B, 3.0)
    assert back is not None
    assert back <= 0.2
    exchanged(
        "second autopilot, unsigned",
        f"in a silence of 12 s: {' '.join(f'{key} {value}' for key, value in stranger.items())}",
        f'not followed, "… {why} …"',
    )


@pytest.mark.parametrize("telemetry", [True, False])
def test_a_vehicle_that_is_back_at_its_address_gets_the_link_from_whoever_resembled_it(telemetry: bool) -> None:
    under_test = LinkUnderTest()
    under_test.autopilot(A, 3.0, telemetry=telemetry)
    under_test.silence(12.0)
    assert under_test.autopilot(C, 3.0, telemetry=telemetry) is not None  # nothing distinguishes it from the vehicle
    for _ in range(3):
        under_test.autopilot(A, 0.5, telemetry=telemetry)
        under_test.received.clear()
        under_test.autopilot(C, 0.5, telemetry=telemetry)
        assert under_test.received == []
    assert under_test.report() == "10.0.0.9:5000 sends as well, and is not followed"


def test_a_stranger_beside_the_vehicle_is_reported_and_not_followed() -> None:
    under_test = LinkUnderTest()
    under_test.autopilot(A, 1.0)
    under_test.socket.waiting = [(b"anything", C)]
    assert under_test.link.poll() == []
    assert under_test.report() == "10.0.0.9:5000 sends as well, and is not followed"
    under_test.silence(11.0)
    assert under_test.report() == ""


def test_an_autopilot_that_rebooted_behind_a_restarted_router_is_followed() -> None:
    under_test = LinkUnderTest()
    under_test.autopilot(A, 3.0)
    under_test.silence(20.0)
    assert under_test.autopilot(B, 3.0, boot_s=-15.0) == pytest.approx(0.0)  # it booted 15 s into the test


def test_a_changed_system_id_is_followed_once_the_old_one_is_silent() -> None:
    under_test = LinkUnderTest()
    under_test.autopilot(A, 3.0)
    changed = under_test.autopilot(A, 4.0, system=7)
    assert changed is not None
    assert 1.0 < changed <= 2.0
    assert under_test.link.vehicle == 7
    exchanged("autopilot, unsigned", "its system id changes", f"followed after {changed:.1f} s")
    fixed = LinkUnderTest(vehicle=1)
    fixed.autopilot(A, 3.0)
    assert fixed.autopilot(A, 4.0, system=7) is None
    assert "set in the configuration" in fixed.report()


def test_with_a_key_another_address_is_followed_when_the_old_one_is_silent() -> None:
    under_test = LinkUnderTest(key=KEY)
    under_test.autopilot(A, 2.0)
    relocked = under_test.autopilot(B, 4.0, boot_s=90_000.0)  # whatever its boot time
    assert relocked is not None
    assert 1.4 < relocked <= 2.0


def test_a_signed_autopilot_a_day_behind_is_named_and_answered() -> None:
    under_test = LinkUnderTest(key=KEY)
    assert under_test.autopilot(A, 1.0, behind_s=86_400.0) is None
    assert under_test.link.problem == "the autopilot signs with the key, but its clock is 86400 s behind"
    hello = mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)
    under_test.link.send(hello)
    data, address = under_test.socket.sent[-1]
    assert address == A  # by which it gets the time: it takes over the greatest timestamp it receives
    assert int.from_bytes(data[-12:-6], "little") >= ticks(UNIX_S)
    assert under_test.autopilot(A, 1.0) == 0.0
    assert under_test.link.problem == ""
    exchanged("signed autopilot, udpin", "its clock a day behind", "named, answered, followed once it has the time")


def test_a_signed_vehicle_that_was_switched_off_and_lost_its_time_is_named_and_answered_at_its_new_port() -> None:
    under_test = LinkUnderTest(key=KEY)
    under_test.autopilot(A, 2.0)
    under_test.silence(20.0)
    assert under_test.autopilot(B, 1.0, boot_s=-22.0, behind_s=86_400.0) is None
    assert "its clock is 86400 s behind" in under_test.link.problem
    under_test.link.send(mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3))
    assert under_test.socket.sent[-1][1] == B
    assert under_test.autopilot(B, 1.0, boot_s=-22.0) == 0.0
    assert under_test.link.problem == ""


@pytest.mark.parametrize(("key", "why"), [(None, "does not sign"), (bytes(32), "signs with another key")])
def test_an_autopilot_without_the_key_is_named(key: bytes | None, why: str) -> None:
    under_test = LinkUnderTest(key=KEY)
    under_test.key = key
    assert under_test.autopilot(A, 1.0) is None
    assert why in under_test.link.problem


def test_a_key_holder_cannot_push_the_signing_time_ahead() -> None:
    signing = Signing(KEY)
    codec = mavlink.MAVLink(None, 9, 1)
    codec.signing.secret_key, codec.signing.sign_outgoing = KEY, True
    stamp = ticks(UNIX_S)
    for _ in range(1000):
        stamp += 4 * TICKS
        codec.signing.timestamp = stamp
        frame = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(codec))
        signing.rejection_reason(frame, 9, 1, UNIX_S)
    assert signing.next_time(UNIX_S) <= ticks(UNIX_S) + 5 * TICKS + 1
    # … nor fill the table of senders for good.
    for system in range(1, 100):
        codec = mavlink.MAVLink(None, system, 1)
        codec.signing.secret_key, codec.signing.sign_outgoing = KEY, True
        codec.signing.timestamp = ticks(UNIX_S)
        frame = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(codec))
        signing.rejection_reason(frame, system, 1, UNIX_S)
    codec.signing.timestamp = ticks(UNIX_S + 120.0)
    frame = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(codec))
    assert signing.rejection_reason(frame, 200, 1, UNIX_S + 120.0) is None
