"""The camera component as a ground station hears it: statuses, orders and what it says of itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.link.transport import Pipe
from edge.mavlink.roles.camera import CameraComponent, Select, Stop, Stream
from protocols.geometry.camera import Intrinsics

ACTIVE, ERROR, COASTING = 1, 2, 8
LENS = Intrinsics(640, 480, np.array([[320.0, 0.0, 319.5], [0.0, 240.0, 239.5], [0.0, 0.0, 1.0]]))


class Wire:
    """A vehicle and a ground station at the far end of a camera component's link."""

    def __init__(
        self,
        obey: Callable[[Select | Stop], bool] = lambda order: True,
        stream: Stream | None = None,
        stations: frozenset[int] = frozenset(),
    ) -> None:
        ours, self.pipe = Pipe.pair()
        self.link = Link(
            None,
            system=None,
            component=100,
            allowed=("HEARTBEAT", "COMMAND_LONG", "COMMAND_INT"),
            transport=ours,
            now_ns=lambda: 0,
        )
        self.camera = CameraComponent(self.link, (640, 480), 30.0, LENS, stream, obey, stations=stations)
        self.now = 0.0
        vehicle = mavlink.MAVLink(None, 1, 1)
        self.pipe.send(bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(vehicle)), None)
        self.link.poll()
        self._station = mavlink.MAVLink(None, 255, 190)

    def order(self, command: int, *parameters: float, confirmation: int = 0, component: int = 100) -> list[Any]:
        """Send a command to the camera; all that it answers."""
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        message = mavlink.MAVLink_command_long_message(1, component, command, confirmation, *filled)
        self.pipe.send(bytes(message.pack(self._station)), None)
        for heard in self.link.poll():
            self.camera.handle(heard, self.now)
        return self.heard()

    def result(self, command: int, *parameters: float, **options: Any) -> int:
        """Of a command."""
        (ack,) = [m for m in self.order(command, *parameters, **options) if m.get_type() == "COMMAND_ACK"]
        assert (ack.target_system, ack.target_component) == (255, 190)
        return int(ack.result)

    def heard(self) -> list[Any]:
        """All that came since the last call, as pymavlink reads it."""
        reader = mavlink.MAVLink(None)
        out = []
        for data, _ in self.pipe.receive():
            out += reader.parse_buffer(data) or []
        assert all((m.get_srcSystem(), m.get_srcComponent()) == (1, 100) for m in out)
        return out

    def told(self, kind: str) -> Any:
        """What it says at once of a kind."""
        self.camera.tell_now()
        return next(message for message in self.heard() if message.get_type() == kind)


@pytest.mark.parametrize(
    ("state", "flags"), [("idle", 0), ("visible", ACTIVE), ("coasting", ACTIVE | COASTING), ("lost", ERROR)]
)
def test_the_state_is_told_as_ground_stations_read_it(state: str, flags: int) -> None:
    wire = Wire()
    wire.camera.shown.state = state
    assert wire.told("CAMERA_TRACKING_IMAGE_STATUS").tracking_status == flags
    assert wire.told("CAMERA_TRACKING_GEO_STATUS").tracking_status == flags


def test_a_target_in_the_picture_has_a_box_cut_at_its_border_and_one_outside_none() -> None:
    wire = Wire()
    shown = wire.camera.shown
    shown.state, shown.centre, shown.half = "visible", (0.95, 0.5), (0.1, 0.2)
    seen = wire.told("CAMERA_TRACKING_IMAGE_STATUS")
    corners = (seen.rec_top_x, seen.rec_top_y, seen.rec_bottom_x, seen.rec_bottom_y)
    assert corners == pytest.approx((0.85, 0.3, 1.0, 0.7), abs=1e-6)
    shown.state, shown.centre = "coasting", (1.05, 0.5)
    away = wire.told("CAMERA_TRACKING_IMAGE_STATUS")
    assert all(math.isnan(value) for value in (away.point_x, away.rec_top_x, away.rec_bottom_y))


def test_the_place_on_the_earth_and_its_accuracy_are_told_and_unknown_is_not_nought() -> None:
    wire = Wire()
    wire.camera.shown.state = "coasting"
    unknown = wire.told("CAMERA_TRACKING_GEO_STATUS")
    assert (unknown.lat, unknown.lon) == (0x7FFFFFFF, 0x7FFFFFFF)
    assert math.isnan(unknown.h_acc)
    assert math.isnan(unknown.vel_n)
    shown = wire.camera.shown
    shown.geo, shown.h_acc, shown.velocity, shown.course = (47.5, -8.25, 400.0), 3.5, (4.0, -3.0), -0.6435
    told = wire.told("CAMERA_TRACKING_GEO_STATUS")
    assert (told.lat, told.lon) == (475000000, -82500000)
    assert (told.h_acc, told.vel_n, told.vel_e) == (3.5, 4.0, -3.0)


def test_statuses_come_with_frames_and_only_while_something_is_followed() -> None:
    wire = Wire()
    wire.camera.tick(0.0, frame=True)
    assert {m.get_type() for m in wire.heard()} == {"HEARTBEAT", "CAMERA_FOV_STATUS"}
    wire.camera.shown.state = "visible"
    wire.camera.tick(0.1, frame=False)
    assert wire.heard() == []
    wire.camera.tick(0.2, frame=True)
    assert {m.get_type() for m in wire.heard()} == {"CAMERA_TRACKING_IMAGE_STATUS", "CAMERA_TRACKING_GEO_STATUS"}


def test_the_lens_tells_the_fields_of_view() -> None:
    wire = Wire()
    wire.camera.tick(0.0, frame=False)
    (fov,) = [m for m in wire.heard() if m.get_type() == "CAMERA_FOV_STATUS"]
    assert (fov.hfov, fov.vfov) == (90.0, 90.0)


def test_a_rectangle_is_a_selection_whichever_corner_comes_first() -> None:
    orders: list[Select | Stop] = []
    wire = Wire(obey=lambda order: orders.append(order) or True)  # type: ignore[func-returns-value]
    assert wire.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0.75, 0.5, 0.25, 0.125) == mavlink.MAV_RESULT_ACCEPTED
    assert wire.result(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.25) == mavlink.MAV_RESULT_ACCEPTED
    assert wire.result(mavlink.MAV_CMD_CAMERA_STOP_TRACKING) == mavlink.MAV_RESULT_ACCEPTED
    assert orders == [Select(0.25, 0.125, 0.75, 0.5, 255), Select(0.5, 0.25, 0.5, 0.25, 255), Stop(255)]


@pytest.mark.parametrize(
    "corners",
    [(0.1, 0.1, 1.2, 0.2), (math.nan, 0.1, 0.2, 0.2), (-0.1, 0.1, 0.2, 0.2), (0.5, 0.1, 0.5, 0.2), (0.5,) * 4],
)
def test_a_box_that_is_none_is_denied_and_nobody_is_asked_to_follow_it(corners: tuple[float, ...]) -> None:
    orders: list[Select | Stop] = []
    wire = Wire(obey=lambda order: orders.append(order) or True)  # type: ignore[func-returns-value]
    assert wire.order(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *corners)[0].result == mavlink.MAV_RESULT_DENIED
    assert orders == []
    assert wire.camera.counters["refused.box"] == 1


def test_an_order_whose_answer_was_lost_is_answered_again_but_not_done_again() -> None:
    orders: list[Select | Stop] = []
    wire = Wire(obey=lambda order: orders.append(order) or True)  # type: ignore[func-returns-value]
    box = (0.25, 0.25, 0.5, 0.5)
    assert wire.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *box) == mavlink.MAV_RESULT_ACCEPTED
    again = wire.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *box, confirmation=1)
    assert again == mavlink.MAV_RESULT_ACCEPTED
    assert len(orders) == 1
    wire.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *box)  # and once more is a new order
    assert len(orders) == 2


def test_a_station_that_may_not_give_orders_is_denied() -> None:
    orders: list[Select | Stop] = []
    wire = Wire(
        obey=lambda order: orders.append(order) or True,  # type: ignore[func-returns-value]
        stations=frozenset({254}),
    )
    assert wire.result(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.5) == mavlink.MAV_RESULT_DENIED
    assert orders == []
    assert wire.camera.counters["refused.station"] == 1


def test_what_is_not_a_cameras_business_is_unsupported_for_it_and_left_to_others_in_a_broadcast() -> None:
    wire = Wire()
    assert wire.result(mavlink.MAV_CMD_IMAGE_START_CAPTURE) == mavlink.MAV_RESULT_UNSUPPORTED
    assert wire.order(mavlink.MAV_CMD_IMAGE_START_CAPTURE, component=0) == []


@pytest.mark.parametrize(
    ("kind", "uri", "number"),
    [
        ("rtsp", "rtsp://10.0.0.7:8554/overlay", mavlink.VIDEO_STREAM_TYPE_RTSP),
        ("mjpeg", "http://10.0.0.7:8560/stream.mjpg", mavlink.VIDEO_STREAM_TYPE_TCP_MPEG),
    ],
)
def test_the_video_is_told_with_its_address_and_only_where_there_is_one(kind: str, uri: str, number: int) -> None:
    request = mavlink.MAV_CMD_REQUEST_MESSAGE
    stream_id = mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION
    wire = Wire(stream=Stream(kind, uri))
    ack, info = wire.order(request, stream_id)
    assert ack.result == mavlink.MAV_RESULT_ACCEPTED
    assert (info.type, info.uri, info.resolution_h, info.hfov) == (number, uri, 640, 90)
    encoding = mavlink.VIDEO_STREAM_ENCODING_H264 if kind == "rtsp" else mavlink.VIDEO_STREAM_ENCODING_UNKNOWN
    assert info.encoding == encoding
    assert Wire().result(request, stream_id) == mavlink.MAV_RESULT_UNSUPPORTED
