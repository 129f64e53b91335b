"""Untrusted MAVLink messages: refused with a reason, counted; the signing state survives a restart."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

pytest.importorskip("pymavlink")

from edge.mavlink.link.signing import Signing, ticks
from tests.faults.matrix import measured
from tests.faults.mavlink_frames import UNIX_S, VEHICLE, Vehicle, Wire, link

KEY, OTHER = bytes(range(32)), bytes(32)


def test_unsigned_wrong_replayed_future_nan_and_garbage_are_refused(tmp_path: Path) -> None:
    wire, vehicle = Wire(), Vehicle(KEY)
    listening = link(wire, Signing(KEY, tmp_path / "signing.json"))

    def receive(*data: bytes) -> list[str]:
        wire.waiting += [(one, VEHICLE) for one in data]
        return [received.kind for received in listening.poll()]

    assert receive(vehicle.heartbeat()) == ["HEARTBEAT"]
    good = vehicle.attitude()
    assert receive(good) == ["ATTITUDE_QUATERNION"]
    assert receive(Vehicle().attitude()) == []
    assert receive(Vehicle(OTHER).attitude()) == []
    assert receive(good) == []
    assert receive(vehicle.attitude(at=ticks(UNIX_S + 60.0))) == []
    assert receive(vehicle.attitude(float("nan"))) == []
    assert receive(random.Random(0).randbytes(5000)) == []
    after = [kind for _ in range(10) for kind in receive(vehicle.attitude())]
    assert "ATTITUDE_QUATERNION" in after, "what began like a frame in the garbage may cost a few, not all"
    counts = listening.counters
    expected = {"unsigned": 1, "wrong_key": 1, "replayed": 1, "future": 1, "not_finite": 1}
    assert {reason: counts[f"refused.{reason}"] for reason in expected} == expected
    assert counts["garbled_bytes"] > 0
    measured("MAVLink: unsigned, wrong key, replayed, future, NaN, garbage", "refused, counted", str(expected))


def test_the_state_of_signing_survives_a_restart(tmp_path: Path) -> None:
    state, vehicle = tmp_path / "signing.json", Vehicle(KEY)
    wire = Wire()
    signing = Signing(KEY, state)
    first = link(wire, signing)
    old = [vehicle.heartbeat(), vehicle.attitude()]
    wire.waiting += [(one, VEHICLE) for one in old]
    assert len(first.poll()) == 2
    signing.save()
    second = link(wire, Signing(KEY, state))
    wire.waiting += [(one, VEHICLE) for one in old]
    assert second.poll() == []
    assert second.counters["refused.replayed"] == 2
    wire.waiting.append((vehicle.heartbeat(), VEHICLE))
    assert [received.kind for received in second.poll()] == ["HEARTBEAT"]
    measured("MAVLink: restart", "signing state survives", "2 of 2 old messages refused as replayed")
