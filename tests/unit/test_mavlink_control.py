"""What the agent commands the vehicle: nothing unless allowed, and never beyond its bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.link.transport import Pipe
from edge.mavlink.roles.guidance import Aim, Control, Limits
from edge.uav.navigation import Origin

ORIGIN = Origin(47.4, 8.5, 480.0)
VEHICLE, STILL = np.array([0.0, 0.0, -50.0]), np.zeros(3)
AIM = Aim(0.0, np.array([30.0, 40.0]), np.array([8.0, 0.0]), 1.0, 0.0)


class Flown:
    """A control on a link, and what an autopilot hears of it."""

    def __init__(self, **limits: Any) -> None:
        ours, self._pipe = Pipe.pair()
        self._link = Link(None, system=1, component=100, allowed=("HEARTBEAT",), transport=ours, now_ns=lambda: 0)
        vehicle = mavlink.MAVLink(None, 1, 1)
        self._pipe.send(bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(vehicle)), None)
        self._link.poll()
        self.control = Control(self._link, Limits(**limits))
        self.control.begin(VEHICLE)
        self._pipe.receive()

    def tick(self, now_s: float, aim: Aim = AIM, vehicle: np.ndarray = VEHICLE) -> list[Any]:
        """All that is sent at a time."""
        self.control.tick(now_s, aim, vehicle, STILL, ORIGIN)
        reader = mavlink.MAVLink(None)
        return [m for data, _ in self._pipe.receive() for m in reader.parse_buffer(data) or []]


def kinds(messages: list[Any]) -> set[str]:
    return {message.get_type() for message in messages}


def test_nothing_is_sent_unless_it_is_switched_on() -> None:
    flown = Flown()
    assert flown.tick(0.0) == []
    assert flown.control.why == "off"
    assert kinds(Flown(follow=True).tick(0.0)) == {"FOLLOW_TARGET"}
    assert kinds(Flown(gimbal=True).tick(0.0)) == {"COMMAND_LONG", "GIMBAL_MANAGER_SET_PITCHYAW"}


@pytest.mark.parametrize(
    ("aim", "vehicle", "why"),
    [
        (replace(AIM, unseen_s=8.1), VEHICLE, "not seen"),
        (replace(AIM, std_m=15.1), VEHICLE, "known to"),
        (replace(AIM, std_m=math.nan), VEHICLE, "known to"),
        (replace(AIM, place=np.array([301.0, 0.0])), VEHICLE, "farther"),
        (replace(AIM, place=np.array([math.nan, 0.0])), VEHICLE, "farther"),
        (AIM, np.array([0.0, 0.0, -0.5]), "on the ground"),
    ],
)
def test_beyond_its_bounds_it_is_silent_and_says_why(aim: Aim, vehicle: np.ndarray, why: str) -> None:
    flown = Flown(gimbal=True, follow=True)
    assert flown.tick(0.0) != []
    assert flown.tick(1.0, aim, vehicle) == []
    assert why in flown.control.why
    assert flown.tick(2.0) != []  # and goes on when all is well again


def test_what_is_followed_is_where_the_target_is_now_and_no_faster_than_allowed() -> None:
    flown = Flown(follow=True, speed=5.0)
    (told,) = flown.tick(0.5)
    north, east, _ = ORIGIN.local(1e-7 * told.lat, 1e-7 * told.lon, told.alt)
    assert (north, east) == pytest.approx((34.0, 40.0), abs=0.05)  # half a second on, at 8 m/s
    assert told.vel[:2] == pytest.approx([5.0, 0.0])
    assert told.est_capabilities == 0b11


def test_a_frozen_estimate_is_not_driven_on_for_ever() -> None:
    (told,) = Flown(follow=True).tick(60.0)
    assert ORIGIN.local(1e-7 * told.lat, 1e-7 * told.lon, told.alt)[0] == pytest.approx(38.0, abs=0.05)


def test_the_gimbal_looks_at_the_target_and_turns_no_faster_than_allowed() -> None:
    flown = Flown(gimbal=True, rate=math.radians(30.0))
    first = flown.tick(0.0, replace(AIM, velocity=np.zeros(2)))[-1]
    assert first.yaw == pytest.approx(math.atan2(40.0, 30.0), abs=1e-5)
    assert first.pitch == pytest.approx(-math.atan2(49.3, 50.0), abs=1e-5)
    behind = replace(AIM, place=np.array([-30.0, -40.0]), velocity=np.zeros(2))
    second = flown.tick(0.1, behind)[-1]
    turned = (second.yaw - first.yaw + math.pi) % (2.0 * math.pi) - math.pi
    assert abs(turned) == pytest.approx(math.radians(3.0), rel=0.01)
    assert second.flags & mavlink.GIMBAL_MANAGER_FLAGS_YAW_IN_EARTH_FRAME


def test_commands_come_ten_times_a_second_at_most() -> None:
    flown = Flown(follow=True)
    assert sum(len(flown.tick(k / 100)) for k in range(100)) == pytest.approx(10, abs=1)
