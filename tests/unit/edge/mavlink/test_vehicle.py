"""The vehicle's telemetry: whose messages count, and how each source's clock is mapped to the host's."""

from __future__ import annotations

import math
import random
from collections import Counter
from functools import partial
from typing import Any

import numpy as np
import pytest

from edge.agents.target_report import update_tracking_status
from edge.mavlink.dialect import AUTOPILOT, GIMBAL, mavlink
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.roles.camera_messages import CameraMessages
from edge.mavlink.roles.vehicle import MountSample, Vehicle
from edge.uav.navigation import Origin
from tests.support.pipe import Pipe

BOOT_S, DELAY_S = 123.0, 0.01
COMPANION = 191
EARTH = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
HEADING = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME


class NoLink:
    """A link that keeps what is sent."""

    vehicle, open = 1, True

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.counters: Counter[str] = Counter()

    def send(self, message: Any) -> bool:
        self.sent.append(message)
        return True


class VehicleUnderTest:
    """A vehicle whose clock is BOOT_S ahead of the host's, and whose messages arrive after DELAY_S."""

    def __init__(self, *, gimbal: bool = False) -> None:
        self.link = NoLink()
        self.vehicle = Vehicle(self.link, gimbal=gimbal)  # type: ignore[arg-type]
        self.vehicle.tick(0)

    def take(self, message: Any, time_s: float, component: int = AUTOPILOT) -> list[MountSample]:
        """Hand over a message measured at a host time."""
        arrival = round(1e9 * (time_s + DELAY_S))
        return self.vehicle.handle(ReceivedMessage(message, message.get_type(), 1, component, arrival))

    def attitude(
        self, time_s: float, component: int = AUTOPILOT, ahead_s: float = 0.0, yaw: float = 0.0
    ) -> list[MountSample]:
        """An attitude; ahead_s: error of its stamp."""
        q = (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))
        message = mavlink.MAVLink_attitude_quaternion_message(boot_ms(time_s + ahead_s), *q, 0.0, 0.0, 0.0)
        return self.take(message, time_s, component)

    def gimbal(self, time_s: float, ahead_s: float, component: int = GIMBAL, flags: int = EARTH) -> list[MountSample]:
        """A gimbal's attitude, pitched down by 60 degrees."""
        q = [math.cos(math.radians(30.0)), 0.0, -math.sin(math.radians(30.0)), 0.0]
        message = mavlink.MAVLink_gimbal_device_attitude_status_message(
            0, 0, boot_ms(time_s + ahead_s), flags, q, 0, 0, 0, 0
        )
        return self.take(message, time_s, component)

    def position(self, time_s: float, component: int = AUTOPILOT) -> None:
        """A position that moves north at 10 m/s."""
        self.take(
            mavlink.MAVLink_local_position_ned_message(boot_ms(time_s), 10 * time_s, 0, -50, 10, 0, 0),
            time_s,
            component,
        )


def test_angles_are_used_between_rare_quaternions_and_positions_of_each_second() -> None:
    """Of 50 attitudes a second one was used, and no position."""
    one, samples = VehicleUnderTest(), []
    for k in range(300):
        time_s = 0.02 * k
        if k % 50 == 0:
            samples += one.attitude(time_s)
            one.position(time_s)
        else:
            samples += one.take(mavlink.MAVLink_attitude_message(boot_ms(time_s), 0, 0, 0, 0, 0, 0), time_s)
    assert len(samples) > 250
    assert sum(sample.position is None for sample in samples) <= 1
    assert one.vehicle.problem(6_000_000_000) == ""
    for time_s in range(6, 30):
        one.attitude(time_s)
    assert "attitudes come at 1.0 Hz" in one.vehicle.problem(29_500_000_000)


def boot_ms(time_s: float) -> int:
    return round(1e3 * (time_s + BOOT_S))


@pytest.mark.parametrize("ahead_s", [86_400.0, 40.0, 0.0])
def test_attitude_position_and_time_of_another_component_are_refused_and_reported(ahead_s: float) -> None:
    under_test = VehicleUnderTest()
    for k in range(20):
        under_test.position(0.1 * k)
        assert len(under_test.attitude(0.1 * k)) == 1
        assert under_test.attitude(0.1 * k + 0.05, COMPANION, ahead_s, yaw=2.0) == []
        under_test.take(mavlink.MAVLink_system_time_message(0, boot_ms(0.1 * k + ahead_s)), 0.1 * k, COMPANION)
        under_test.take(mavlink.MAVLink_local_position_ned_message(boot_ms(0.1 * k), 9e4, 0, 0, 0, 0, 0), 0.1 * k, 191)
    (sample,) = under_test.attitude(2.0)
    np.testing.assert_allclose(sample.ned_from_mount, np.eye(3), atol=1e-9)
    assert sample.position is not None
    assert sample.position == pytest.approx([20.0, 0.0, -50.0], abs=0.2)
    assert abs(sample.host_ns - 2e9) < 2e7
    assert under_test.vehicle.counters["component"] == 60
    problem = under_test.vehicle.problem(2_000_000_000)
    assert problem == "LOCAL_POSITION_NED of component 191 refused: not the autopilot (60 refused)"
    assert under_test.vehicle.problem(30_000_000_000).startswith("no attitude of the autopilot")


@pytest.mark.parametrize("ahead_s", [86_400.0, 40.0, -40.0])
def test_a_wrong_stamp_of_the_autopilot_itself_is_refused_with_its_reason(ahead_s: float) -> None:
    under_test = VehicleUnderTest()
    for k in range(20):
        assert len(under_test.attitude(0.1 * k)) == 1
    assert under_test.attitude(1.95, ahead_s=ahead_s) == []
    assert len(under_test.attitude(2.0)) == 1
    assert under_test.vehicle.counters["time"] == 1
    text = "in the future" if ahead_s > 0 else "went back"
    assert text in under_test.vehicle.problem(2_000_000_000)


@pytest.mark.parametrize(("ahead_s", "flags"), [(45.0, EARTH), (45.0, HEADING), (-100.0, HEADING), (0.0, EARTH)])
def test_a_gimbal_with_its_own_clock_is_mapped_by_itself(ahead_s: float, flags: int) -> None:
    under_test = VehicleUnderTest(gimbal=True)
    for k in range(20):
        assert under_test.attitude(0.1 * k, yaw=0.5) == []
        under_test.position(0.1 * k)
        samples = under_test.gimbal(0.1 * k + 0.01, ahead_s, flags=flags)
        assert len(samples) == 1
    sample = samples[0]
    assert abs(sample.host_ns - 1.91e9) < 5e7
    assert sample.position is not None
    assert sample.position[0] == pytest.approx(19.1, abs=0.5)
    assert abs(sample.vehicle_ns - round(1e9 * (1.91 + BOOT_S))) < 5e7  # by the autopilot's clock
    forward = sample.ned_from_mount[:, 0]
    yaw = 0.5 if flags == HEADING else 0.0
    expected = [0.5 * math.cos(yaw), 0.5 * math.sin(yaw), math.sqrt(0.75)]
    assert forward == pytest.approx(expected, abs=1e-6)
    assert under_test.vehicle.problem(2_000_000_000) == ""


@pytest.mark.parametrize("gimbal", [True, False])
@pytest.mark.parametrize("back_s", [0.3, 0.9, 1.5, 3.0, 50.0, 122.0])
def test_a_clock_that_is_set_back_is_followed_within_three_seconds(back_s: float, gimbal: bool) -> None:
    under_test = VehicleUnderTest(gimbal=gimbal)
    errors: list[tuple[float, float]] = []
    for k in range(160):
        time_s, ahead_s = 0.05 * k, -back_s if k >= 80 else 0.0
        samples = under_test.gimbal(time_s, ahead_s) if gimbal else under_test.attitude(time_s, ahead_s=ahead_s)
        errors += [(time_s, abs(1e-9 * sample.host_ns - time_s)) for sample in samples]
    late = [error for time_s, error in errors if time_s > 7.0]
    assert len(late) == 20 - 1
    assert max(late) < 0.02
    assert sum(under_test.vehicle.clock_resets) == 1


@pytest.mark.parametrize("gimbal", [True, False])
def test_a_source_that_does_not_stamp_is_as_late_as_the_link(gimbal: bool) -> None:
    under_test = VehicleUnderTest(gimbal=gimbal)
    for k in range(100):
        send = under_test.gimbal if gimbal else under_test.attitude
        samples = send(0.1 * k, ahead_s=-BOOT_S - 0.1 * k)
        assert [round(1e-9 * sample.host_ns - 0.1 * k, 3) for sample in samples] == [DELAY_S]
    assert under_test.vehicle.problem(10_000_000_000) == ""


def test_on_the_airframe_a_gimbal_is_not_listened_to() -> None:
    under_test = VehicleUnderTest()
    for k in range(40):
        under_test.attitude(0.1 * k)
        under_test.gimbal(0.1 * k, 45.0 if k < 20 else 0.0, GIMBAL if k % 2 else AUTOPILOT)
    assert under_test.vehicle.clock_resets == (0, 0)
    assert under_test.vehicle.problem(4_000_000_000) == ""


def test_a_second_gimbal_is_not_mixed_with_the_first_and_takes_over_when_that_is_silent() -> None:
    under_test = VehicleUnderTest(gimbal=True)
    for k in range(10):
        assert len(under_test.gimbal(0.1 * k, 45.0)) == 1
        assert under_test.gimbal(0.1 * k + 0.05, 0.0, AUTOPILOT) == []
    assert under_test.vehicle.counters["gimbal"] == 10
    assert under_test.gimbal(3.5, 0.0, COMPANION) == []
    assert len(under_test.gimbal(3.6, 0.0, AUTOPILOT)) == 1


def test_a_position_that_is_no_longer_reported_is_not_known_after_a_second() -> None:
    under_test = VehicleUnderTest()
    for k in range(20):
        under_test.position(0.1 * k)
        under_test.attitude(0.1 * k)
    motion = under_test.vehicle.motion_at(2.4)
    assert motion is not None
    assert motion[0] == pytest.approx([24.0, 0.0, -50.0], abs=0.2)
    known = [sample.position is not None for k in range(20, 40) for sample in under_test.attitude(0.1 * k)]
    assert known == [True] * 4 + [False] * 16, "what is said of the ground is not placed by a guess of 1.5 s"
    assert under_test.vehicle.motion_at(4.0) is None
    status = CameraMessages((640, 480), 30.0, None, None, (0, 1, 0)).status
    update_tracking_status(status, None, under_test.vehicle, (640, 480), None, np.eye(3), 4 * 10**9)
    assert status.camera is None
    assert status.quaternion is not None


@pytest.mark.parametrize(
    ("local", "origin_m", "reset_m", "armed_s"),
    [
        pytest.param(True, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, id="as home"),
        pytest.param(True, (70.0, -40.0, -30.0), (0.0, 0.0, 0.0), 0.0, id="switched on elsewhere, 30 m lower"),
        pytest.param(True, (0.0, 0.0, 0.0), (80.0, -50.0, 4.0), 0.0, id="the estimator is reset in flight"),
        pytest.param(False, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, id="global positions alone"),
        pytest.param(False, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.5, id="home is set when it is armed"),
        pytest.param(True, (0.0, 0.0, -25.0), (0.0, 0.0, 0.0), 1.5, id="home is set when it is armed, elsewhere"),
    ],
)
def test_positions_count_from_home_height_in_one_frame_whatever_the_local_frame_does(
    local: bool, origin_m: tuple[float, ...], reset_m: tuple[float, ...], armed_s: float
) -> None:
    """A local frame that began 30 m lower put the target 11 m off; one that was reset 94 m, with 0.3 m accuracy."""
    one, home = VehicleUnderTest(), Origin(47.3977, 8.5456, 488.0)
    samples: list[MountSample] = []
    for k in range(120):
        time_s = 0.05 * k
        truth = np.array([10.0 * time_s, 0.0, -20.0])
        if k % 20 == 0:
            mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if time_s >= armed_s else 0
            one.take(mavlink.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3), time_s)
        if k % 4 == 0:
            latitude, longitude, altitude = home.to_geodetic(*truth)
            # Before it is armed its home is the first fix, 12 m too high; in flight a station sets another home.
            relative_m = 20.0 - (12.0 if time_s < armed_s else 0.0) - (20.0 if time_s > 5.0 else 0.0)
            place = round(1e7 * latitude), round(1e7 * longitude), round(1e3 * altitude), round(1e3 * relative_m)
            one.take(mavlink.MAVLink_global_position_int_message(boot_ms(time_s), *place, 1000, 0, 0, 0), time_s)
        if local:
            reported = truth - origin_m + (np.array(reset_m) if time_s > 3.0 else 0.0)
            one.take(mavlink.MAVLink_local_position_ned_message(boot_ms(time_s), *reported, 10, 0, 0), time_s)
        samples += one.attitude(time_s)
    for sample in samples[40:]:
        origin = one.vehicle.origin
        assert sample.position is not None
        assert origin is not None
        time_s = 1e-9 * sample.host_ns
        assert sample.position[2] == pytest.approx(-20.0, abs=0.1)
        place_m = home.to_ned(*origin.to_geodetic(*sample.position))
        assert place_m == pytest.approx([10.0 * time_s, 0.0, -20.0], abs=0.3)


def test_a_velocity_that_is_not_sent_is_that_of_the_positions() -> None:
    """Betaflight's positions come once or twice a second, with velocity 0."""
    one, home = VehicleUnderTest(), Origin(47.3977, 8.5456, 488.0)
    for time_s in (0.0, 1.0, 2.0):
        latitude, longitude, _ = home.to_geodetic(10.0 * time_s, 0.0, 0.0)
        place = round(1e7 * latitude), round(1e7 * longitude), 538_000, 50_000
        one.take(mavlink.MAVLink_global_position_int_message(boot_ms(time_s), *place, 0, 0, 0, 0), time_s)
    motion = one.vehicle.motion_at(2.9)
    assert motion is not None
    assert motion[0] == pytest.approx([29.0, 0.0, -50.0], abs=0.1)


def test_a_gimbal_that_never_reports_is_named() -> None:
    under_test = VehicleUnderTest(gimbal=True)
    for k in range(40):
        under_test.attitude(0.1 * k)
    assert under_test.vehicle.problem(4_000_000_000) == "no attitude of the gimbal (GIMBAL_DEVICE_ATTITUDE_STATUS)"


def test_an_autopilot_without_a_position_is_named() -> None:
    """Targets had no place on the ground, and the status was that commands are off."""
    under_test = VehicleUnderTest()
    for k in range(40):
        under_test.attitude(0.1 * k)
    assert under_test.vehicle.without_position(2_000_000_000) == ""  # not asked long enough
    assert under_test.vehicle.without_position(4_000_000_000).startswith("no position of the autopilot")
    under_test.position(4.0)  # metres from where it was switched on
    assert under_test.vehicle.without_position(2_000_000_000) == ""
    assert "no latitude and longitude" in under_test.vehicle.without_position(6_000_000_000)
    under_test.take(
        mavlink.MAVLink_global_position_int_message(boot_ms(6.0), 483_000_000, 88_000_000, 0, 50_000, 0, 0, 0, 0), 6.0
    )
    assert under_test.vehicle.without_position(7_000_000_000) == ""
    assert under_test.vehicle.without_position(10_000_000_000).startswith("no position of the autopilot")


def test_an_autopilot_that_signs_and_answers_nothing_is_named() -> None:
    under_test = VehicleUnderTest()
    for k in range(40):
        under_test.attitude(0.1 * k)
    assert under_test.vehicle.problem(4_000_000_000) == ""
    under_test.link.counters["signed"] += 1
    assert under_test.vehicle.problem(2_000_000_000) == ""  # not asked long enough
    assert under_test.vehicle.problem(4_000_000_000).endswith("ignores unsigned ones: set key in [mavlink]")
    boot_ns = round(1e9 * (4.0 + BOOT_S))
    under_test.take(mavlink.MAVLink_timesync_message(boot_ns, round(4e9 - 1e9 * DELAY_S)), 4.0)
    assert under_test.vehicle.problem(4_100_000_000) == ""
    for k in range(50, 200):  # a reboot: the clock is another, the vehicle the same
        under_test.attitude(0.1 * k, ahead_s=-120.0)
    assert under_test.vehicle.clock_resets == (1, 0)
    assert under_test.vehicle.problem(20_000_000_000) == ""


def test_samples_are_later_than_each_other_and_never_later_than_their_arrival() -> None:
    under_test = VehicleUnderTest()
    rng = np.random.default_rng(1)
    last, count = -1, 0
    for k in range(300):
        time_s = 0.05 * k
        message = mavlink.MAVLink_attitude_quaternion_message(boot_ms(time_s), 1, 0, 0, 0, 0, 0, 0)
        arrival = round(1e9 * (time_s + rng.uniform(0.0, 0.3)))
        handed_over = ReceivedMessage(message, message.get_type(), 1, AUTOPILOT, arrival)
        for sample in under_test.vehicle.handle(handed_over):
            count += 1
            assert last < sample.host_ns <= arrival
            last = sample.host_ns
    assert count > 250


def test_whatever_numbers_the_vehicle_sends_nothing_raises_and_every_sample_is_bounded() -> None:
    rng = random.Random(4)
    big = (0.0, 1.0, -1.0, 1e4, -1e6, 3e38, -3e38, 1e-38)
    whole = (0, 1, -1, 2**31 - 1, -(2**31), 473977000)
    ours, theirs = Pipe.pair()
    link = Link(None, system=1, component=100, allowed=(), transport=ours, vehicle=1)
    messages = CameraMessages((640, 480), 30.0, None, None, (0, 1, 0))
    vehicle = Vehicle(link, gimbal=False)
    count = 0
    for k in range(3000):
        now = 10**9 + k * 10_000_000
        number, integer = partial(rng.choice, big), partial(rng.choice, whole)
        boot = rng.choice((k * 10, k * 10, rng.randrange(2**32), 0, 2**32 - 1)) if k > 10 else 1 + k * 10
        q = rng.choice(([1.0, 0.0, 0.0, 0.0], [number() for _ in range(4)]))
        message = rng.choice(
            (
                mavlink.MAVLink_attitude_quaternion_message(boot, *q, 0, 0, 0),
                mavlink.MAVLink_attitude_message(boot, number(), number(), number(), 0, 0, 0),
                mavlink.MAVLink_local_position_ned_message(boot, *(number() for _ in range(6))),
                mavlink.MAVLink_global_position_int_message(
                    boot, integer(), integer(), integer(), integer(), 0, 0, 0, 0
                ),
                mavlink.MAVLink_timesync_message(integer() * 2**30, rng.choice((now, integer() * 2**30))),
            )
        )
        received = ReceivedMessage(message, message.get_type(), 1, AUTOPILOT, now)
        for sample in vehicle.handle(received):
            count += 1
            assert now - 5 * 10**9 <= sample.host_ns <= now
        update_tracking_status(messages.status, None, vehicle, (640, 480), None, np.eye(3), now)
        assert link.send(messages.build("CAMERA_FOV_STATUS"))
        assert link.send(messages.build("CAMERA_TRACKING_GEO_STATUS"))
        theirs.receive()
    assert count > 100
