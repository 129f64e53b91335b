"""Telemetry logs in which several components of a vehicle report an attitude."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.tlog import read_tlog


@pytest.mark.parametrize("ahead_s", [86_400.0, 40.0, -20.0])
def test_only_the_autopilots_attitudes_and_positions_are_read(tmp_path: Path, ahead_s: float) -> None:
    autopilot, companion = (mavlink.MAVLink(None, 1, component) for component in (1, 191))
    data = bytearray()
    for k in range(200):
        boot_ms = 60_000 + 50 * k
        messages = [
            (autopilot, mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.01 * k, 0, 0, 0)),
            (autopilot, mavlink.MAVLink_local_position_ned_message(boot_ms, 0.5 * k, 0, -50, 10, 0, 0)),
        ]
        if k % 20 == 0:
            messages.append((autopilot, mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)))
            other_ms = round(boot_ms + 1e3 * ahead_s)
            attitude = mavlink.MAVLink_attitude_quaternion_message(other_ms, 0.7, 0.7, 0, 0, 0, 0, 0)
            position = mavlink.MAVLink_local_position_ned_message(other_ms, 9e3, 0, 0, 0, 0, 0)
            messages += [(companion, attitude), (companion, position)]
        for codec, message in messages:
            data += (1_700_000_000_000_000 + 50_000 * k).to_bytes(8, "big") + message.pack(codec)
    file = tmp_path / "flight.tlog"
    file.write_bytes(data)
    (log,) = read_tlog(file)
    assert (len(log.samples), log.left_out, log.unreadable) == (200, 0, 0)
    last = log.samples[-1]
    assert last.position is not None
    assert last.position == pytest.approx([99.5, 0.0, -50.0])
    assert math.atan2(last.ned_from_body[1, 0], last.ned_from_body[0, 0]) == pytest.approx(1.99)


def test_of_two_kinds_of_attitudes_and_positions_the_more_frequent_is_read(tmp_path: Path) -> None:
    """A single quaternion, that somebody asked for, left all others unread."""
    codec, data = mavlink.MAVLink(None, 1, 1), bytearray()
    for k in range(100):
        boot_ms = 60_000 + 100 * k
        messages = [
            mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_global_position_int_message(boot_ms, 1, 1, 0, 50_000, 0, 0, 0, 0),
        ]
        if k in (40, 42):
            messages.append(mavlink.MAVLink_attitude_quaternion_message(boot_ms, 1, 0, 0, 0, 0, 0, 0))
            messages.append(mavlink.MAVLink_local_position_ned_message(boot_ms, 0, 0, -7, 0, 0, 0))
        for message in messages:
            data += (1_700_000_000_000_000 + 100_000 * k).to_bytes(8, "big") + message.pack(codec)
    (tmp_path / "a.tlog").write_bytes(data)
    (log,) = read_tlog(tmp_path / "a.tlog")
    assert len(log.samples) == 100
    assert all(one.position is not None and one.position[2] == pytest.approx(-50.0) for one in log.samples)


def test_heights_of_a_log_are_above_home_where_the_local_frame_began_elsewhere(tmp_path: Path) -> None:
    """It was switched on 30 m below the place where it took off, and its estimator is reset after 5 s."""
    codec, data = mavlink.MAVLink(None, 1, 1), bytearray()
    for k in range(200):
        boot_ms, reset_m = 60_000 + 50 * k, 60.0 if k > 100 else 0.0
        messages = [
            mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_local_position_ned_message(boot_ms, reset_m, 0, -80, 0, 0, 0),
        ]
        if k % 10 == 0:
            place = (473977000, 85456000, 538_000, 50_000)
            messages.append(mavlink.MAVLink_global_position_int_message(boot_ms, *place, 0, 0, 0, 0))
        for message in messages:
            data += (1_700_000_000_000_000 + 50_000 * k).to_bytes(8, "big") + message.pack(codec)
    (tmp_path / "a.tlog").write_bytes(data)
    positions = [one.position for one in read_tlog(tmp_path / "a.tlog")[0].samples[5:]]
    assert positions == [pytest.approx([0.0, 0.0, -50.0], abs=0.02)] * 195


@pytest.mark.parametrize("late_s", [0.3, 1.5])
def test_a_second_link_that_is_slower_changes_nothing(tmp_path: Path, late_s: float) -> None:
    """By 0.3 s the local frame was moved by each message; by 1.5 s each was a reboot."""
    codec, stamped = mavlink.MAVLink(None, 1, 1), []
    for k in range(200):
        for message in (
            mavlink.MAVLink_attitude_message(60_000 + 50 * k, 0, 0, 0.01 * k, 0, 0, 0),
            mavlink.MAVLink_local_position_ned_message(60_000 + 50 * k, k, 0, -50, 0, 0, 0),
        ):
            data = message.pack(codec)
            stamped += [(0.05 * k, data), (0.05 * k + late_s, data)]
    stamped.sort(key=lambda one: one[0])
    (tmp_path / "a.tlog").write_bytes(b"".join(round(1e6 * s).to_bytes(8, "big") + data for s, data in stamped))
    (log,) = read_tlog(tmp_path / "a.tlog")
    assert (len(log.samples), log.left_out) == (200, 0)
    assert [one.position for one in log.samples] == [pytest.approx([k, 0, -50]) for k in range(200)]


def test_each_vehicle_and_each_boot_is_a_log_of_its_own(tmp_path: Path) -> None:
    data = bytearray()
    for system, begin_s, first_ms, count in ((1, 0.0, 90_000, 40), (1, 60.0, 9_000, 100), (2, 90.0, 50_000, 60)):
        codec = mavlink.MAVLink(None, system, 1)
        for k in range(count):
            message = mavlink.MAVLink_attitude_message(first_ms + 50 * k, 0, 0, 0, 0, 0, 0)
            data += round(1e6 * (begin_s + 0.05 * k)).to_bytes(8, "big") + message.pack(codec)
    (tmp_path / "a.tlog").write_bytes(data)
    found = [(log.system, len(log.samples), log.samples[0].time) for log in read_tlog(tmp_path / "a.tlog")]
    assert found == [(1, 100, 9.0), (2, 60, 50.0), (1, 40, 90.0)]


def test_boots_of_a_log_without_stamps_are_separate(tmp_path: Path) -> None:
    """That the second one lasts longer made one series of both."""
    codec, data = mavlink.MAVLink(None, 1, 1), bytearray()
    for count, begin_ms in ((100, 10_000), (130, 10_020)):
        for k in range(count):
            data += bytes(8) + mavlink.MAVLink_attitude_message(begin_ms + 50 * k, 0, 0, 0, 0, 0, 0).pack(codec)
    (tmp_path / "a.tlog").write_bytes(data)
    assert [len(log.samples) for log in read_tlog(tmp_path / "a.tlog")] == [130, 100]
