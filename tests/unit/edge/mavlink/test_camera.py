"""The camera component as seen by a ground station: tracking status, commands and camera information."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.roles import camera as camera_role
from edge.mavlink.roles.camera import ArmFollow, CameraComponent, OperatorCommand, SelectTarget, StopTracking
from edge.mavlink.roles.camera_messages import VideoStream
from edge.mavlink.roles.message_rates import MessageRates
from protocols.geometry.camera import Intrinsics
from tests.support.pipe import Pipe

ACTIVE, ERROR, COASTING = 1, 2, 8
LENS = Intrinsics(640, 480, np.array([[320.0, 0.0, 319.5], [0.0, 240.0, 239.5], [0.0, 0.0, 1.0]]))


class CameraUnderTest:
    """A vehicle and a ground station at the far end of a camera component's link."""

    def __init__(
        self,
        on_command: Callable[[OperatorCommand], bool] = lambda command: True,
        stream: VideoStream | None = None,
        stations: frozenset[int] = frozenset(),
        system: int | None = None,
    ) -> None:
        ours, self.pipe = Pipe.pair()
        self.link = Link(
            None,
            system=system,
            component=100,
            allowed=("HEARTBEAT", "COMMAND_LONG", "COMMAND_INT"),
            transport=ours,
            now_ns=lambda: 0,
        )
        self.camera = CameraComponent(self.link, (640, 480), 30.0, LENS, stream, on_command, stations=stations)
        self.now = 0.0
        vehicle = mavlink.MAVLink(None, 1, 1)
        self.pipe.send(bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(vehicle)), None)
        self.link.poll()

    def command(
        self, command: int, *parameters: float, confirmation: int = 0, component: int = 100, by: int = 255
    ) -> list[Any]:
        """Send a command to the camera; returns all its responses. by: system id of the station."""
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        message = mavlink.MAVLink_command_long_message(1, component, command, confirmation, *filled)
        return self.send(message, by)

    def send(self, message: Any, by: int = 255) -> list[Any]:
        """Send a message of a station to the camera; returns all its responses."""
        self.pipe.send(bytes(message.pack(mavlink.MAVLink(None, by, 190))), None)
        for received in self.link.poll():
            self.camera.handle(received, self.now)
        return self.received()

    def result(self, command: int, *parameters: float, by: int = 255, **options: Any) -> int:
        """The result in the ACK of a command."""
        (ack,) = [m for m in self.command(command, *parameters, by=by, **options) if m.get_type() == "COMMAND_ACK"]
        assert (ack.target_system, ack.target_component) == (by, 190)
        return int(ack.result)

    def fly(self, seconds: float, *beating: int) -> dict[str, int]:
        """Frames at 30 fps while stations send heartbeats; how many messages of each type were sent."""
        counts: dict[str, int] = {}
        for k in range(round(30 * seconds)):
            self.now += 1 / 30
            if k % 30 == 0:
                for station in beating:
                    heartbeat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
                    self.send(heartbeat, station)
            self.camera.tick(self.now, frame=True)
            for message in self.received():
                counts[message.get_type()] = counts.get(message.get_type(), 0) + 1
        return counts

    def received(self) -> list[Any]:
        """All messages since the last call, parsed by pymavlink."""
        reader = mavlink.MAVLink(None)
        out = []
        for data, _ in self.pipe.receive():
            out += reader.parse_buffer(data) or []
        assert all((m.get_srcSystem(), m.get_srcComponent()) == (self.link.system, 100) for m in out)
        return out

    def status_message(self, kind: str) -> Any:
        """The status message of a type, sent at once."""
        self.camera.send_status_now()
        return next(message for message in self.received() if message.get_type() == kind)


@pytest.mark.parametrize(
    ("state", "flags"), [("idle", 0), ("visible", ACTIVE), ("coasting", ACTIVE | COASTING), ("lost", ERROR)]
)
def test_the_tracking_state_is_encoded_in_the_status_flags(state: str, flags: int) -> None:
    under_test = CameraUnderTest()
    under_test.camera.status.state = state
    under_test.camera.status.centre = under_test.camera.status.half_size = (0.5, 0.5)
    assert under_test.status_message("CAMERA_TRACKING_IMAGE_STATUS").tracking_status == flags
    assert under_test.status_message("CAMERA_TRACKING_GEO_STATUS").tracking_status == flags


def test_a_box_is_clipped_to_the_image_and_a_target_outside_has_none() -> None:
    under_test = CameraUnderTest()
    status = under_test.camera.status
    status.state, status.centre, status.half_size = "visible", (0.95, 0.5), (0.1, 0.2)
    seen = under_test.status_message("CAMERA_TRACKING_IMAGE_STATUS")
    corners = (seen.rec_top_x, seen.rec_top_y, seen.rec_bottom_x, seen.rec_bottom_y)
    assert corners == pytest.approx((0.85, 0.3, 1.0, 0.7), abs=1e-6)
    status.state, status.centre = "coasting", (1.05, 0.5)
    away = under_test.status_message("CAMERA_TRACKING_IMAGE_STATUS")
    status.state = "visible"  # QGroundControl would draw a box of NaN
    assert under_test.status_message("CAMERA_TRACKING_IMAGE_STATUS").tracking_status == ACTIVE | COASTING
    assert all(math.isnan(value) for value in (away.point_x, away.rec_top_x, away.rec_bottom_y))


def test_position_and_accuracy_are_reported_and_unknown_values_are_marked() -> None:
    under_test = CameraUnderTest()
    under_test.camera.status.state = "coasting"
    unknown = under_test.status_message("CAMERA_TRACKING_GEO_STATUS")
    assert (unknown.lat, unknown.lon) == (0x7FFFFFFF, 0x7FFFFFFF)
    assert math.isnan(unknown.h_acc)
    assert math.isnan(unknown.vel_n)
    status = under_test.camera.status
    status.geo, status.h_acc, status.velocity, status.course = (47.5, -8.25, 400.0), 3.5, (4.0, -3.0), -0.6435
    status_message = under_test.status_message("CAMERA_TRACKING_GEO_STATUS")
    assert (status_message.lat, status_message.lon) == (475000000, -82500000)
    assert (status_message.h_acc, status_message.vel_n, status_message.vel_e) == (3.5, 4.0, -3.0)


def test_tracking_status_is_sent_with_frames_and_only_while_there_is_a_target() -> None:
    under_test = CameraUnderTest()
    under_test.camera.tick(0.0, frame=True)
    assert {m.get_type() for m in under_test.received()} == {"HEARTBEAT", "CAMERA_FOV_STATUS"}
    under_test.camera.status.state = "visible"
    under_test.camera.tick(0.1, frame=False)
    assert [m.get_type() for m in under_test.received()] == ["STATUSTEXT"]
    under_test.camera.tick(0.2, frame=True)
    assert {m.get_type() for m in under_test.received()} == {
        "CAMERA_TRACKING_IMAGE_STATUS",
        "CAMERA_TRACKING_GEO_STATUS",
    }


def test_the_fields_of_view_follow_from_the_intrinsics() -> None:
    under_test = CameraUnderTest()
    under_test.camera.tick(0.0, frame=False)
    (fov,) = [m for m in under_test.received() if m.get_type() == "CAMERA_FOV_STATUS"]
    assert (fov.hfov, fov.vfov) == (90.0, 90.0)


def test_a_rectangle_is_a_selection_whichever_corner_comes_first() -> None:
    commands: list[OperatorCommand] = []
    under_test = CameraUnderTest(on_command=lambda command: commands.append(command) or True)  # type: ignore[func-returns-value]
    assert (
        under_test.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0.75, 0.5, 0.25, 0.125) == mavlink.MAV_RESULT_ACCEPTED
    )
    assert under_test.result(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.25) == mavlink.MAV_RESULT_ACCEPTED
    assert under_test.result(mavlink.MAV_CMD_CAMERA_STOP_TRACKING) == mavlink.MAV_RESULT_ACCEPTED
    assert commands == [
        SelectTarget(0.25, 0.125, 0.75, 0.5, 255),
        SelectTarget(0.5, 0.25, 0.5, 0.25, 255),
        StopTracking(255),
    ]


@pytest.mark.parametrize(("given", "radius"), [(0.125, 0.125), (0.0, 0.0), (math.nan, 0.0), (-1.0, 0.0), (7.0, 0.0)])
def test_a_point_may_have_a_radius(given: float, radius: float) -> None:
    commands: list[OperatorCommand] = []
    under_test = CameraUnderTest(on_command=lambda command: commands.append(command) or True)  # type: ignore[func-returns-value]
    assert under_test.result(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.25, given) == mavlink.MAV_RESULT_ACCEPTED
    assert commands == [SelectTarget(0.5, 0.25, 0.5, 0.25, 255, radius)]


@pytest.mark.parametrize(
    "corners",
    [(0.1, 0.1, 1.2, 0.2), (math.nan, 0.1, 0.2, 0.2), (-0.1, 0.1, 0.2, 0.2), (0.5, 0.1, 0.5, 0.2), (0.5,) * 4],
)
def test_an_invalid_box_is_denied_and_not_passed_on(corners: tuple[float, ...]) -> None:
    commands: list[OperatorCommand] = []
    under_test = CameraUnderTest(on_command=lambda command: commands.append(command) or True)  # type: ignore[func-returns-value]
    assert under_test.command(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *corners)[0].result == mavlink.MAV_RESULT_DENIED
    assert commands == []
    assert under_test.camera.counters["refused.box"] == 1


def test_a_retransmitted_command_is_acknowledged_again_but_not_executed_again() -> None:
    commands: list[OperatorCommand] = []
    under_test = CameraUnderTest(on_command=lambda command: commands.append(command) or True)  # type: ignore[func-returns-value]
    box = (0.25, 0.25, 0.5, 0.5)
    assert under_test.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *box) == mavlink.MAV_RESULT_ACCEPTED
    again = under_test.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *box, confirmation=1)
    assert again == mavlink.MAV_RESULT_ACCEPTED
    assert len(commands) == 1
    under_test.result(
        mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *box
    )  # without the confirmation count it is a new command
    assert len(commands) == 2


def test_a_command_int_that_names_no_camera_is_for_this_one() -> None:
    """Its x and y are integers, of which INT32_MAX is not set."""
    chosen: list[OperatorCommand] = []
    under_test = CameraUnderTest(lambda command: chosen.append(command) is None)
    unset = 0x7FFFFFFF
    for command, corners in (
        (mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, (0.25, 0.25, 0.5, 0.5)),
        (mavlink.MAV_CMD_CAMERA_TRACK_POINT, (0.5, 0.5, 0.0, float("nan"))),
    ):
        message = mavlink.MAVLink_command_int_message(1, 100, 0, command, 0, 0, *corners, unset, unset, 0.0)
        (ack,) = [one for one in under_test.send(message) if one.get_type() == "COMMAND_ACK"]
        assert ack.result == mavlink.MAV_RESULT_ACCEPTED
    assert len(chosen) == 2


def test_a_camera_with_a_system_id_of_its_own_is_reached_by_it() -> None:
    """It announced itself as system 7, and took commands only for system 1, the vehicle."""
    orders: list[OperatorCommand] = []
    under_test = CameraUnderTest(lambda command: not orders.append(command), system=7)
    parameters = (0.4, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0)
    for system in (1, 7):
        message = mavlink.MAVLink_command_long_message(system, 100, mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0, *parameters)
        acknowledged = [m for m in under_test.send(message) if m.get_type() == "COMMAND_ACK"]
        assert len(acknowledged) == (system == 7)
    assert len(orders) == 1


@pytest.mark.parametrize(
    ("command", "before"),
    [
        (mavlink.MAV_CMD_CAMERA_TRACK_POINT, (0.5, 0.5, 0.1)),
        (mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, (0.1, 0.1, 0.2, 0.2)),
        (mavlink.MAV_CMD_CAMERA_STOP_TRACKING, ()),
        (mavlink.MAV_CMD_VIDEO_START_STREAMING, (1,)),
        (mavlink.MAV_CMD_VIDEO_STOP_STREAMING, (1,)),
    ],
)
def test_a_command_for_another_camera_is_not_executed(command: int, before: tuple[float, ...]) -> None:
    commands: list[OperatorCommand] = []
    stream = VideoStream("rtsp", "rtsp://10.0.0.7:8554/overlay")
    under_test = CameraUnderTest(on_command=lambda one: commands.append(one) or True, stream=stream)  # type: ignore[func-returns-value]
    for other in (1, 101):
        assert under_test.result(command, *before, other) == mavlink.MAV_RESULT_DENIED
        assert under_test.command(command, *before, other, component=0) == []
    assert commands == []
    for ours in (0, 100, math.nan):
        assert under_test.result(command, *before, ours) == mavlink.MAV_RESULT_ACCEPTED


def test_a_station_that_is_not_allowed_is_denied() -> None:
    commands: list[OperatorCommand] = []
    under_test = CameraUnderTest(
        on_command=lambda command: commands.append(command) or True,  # type: ignore[func-returns-value]
        stations=frozenset({254}),
    )
    assert under_test.result(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.5) == mavlink.MAV_RESULT_DENIED
    assert commands == []
    assert under_test.camera.counters["refused.station"] == 1


def test_other_commands_are_unsupported_and_ignored_in_a_broadcast() -> None:
    under_test = CameraUnderTest()
    assert under_test.result(mavlink.MAV_CMD_IMAGE_START_CAPTURE) == mavlink.MAV_RESULT_UNSUPPORTED
    assert under_test.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, component=0) == []


@pytest.mark.parametrize(
    ("kind", "uri", "number"),
    [
        ("rtsp", "rtsp://10.0.0.7:8554/overlay", mavlink.VIDEO_STREAM_TYPE_RTSP),
        ("mjpeg", "http://10.0.0.7:8560/stream.mjpg", mavlink.VIDEO_STREAM_TYPE_TCP_MPEG),
    ],
)
def test_the_video_stream_is_described_only_where_there_is_one(kind: str, uri: str, number: int) -> None:
    request = mavlink.MAV_CMD_REQUEST_MESSAGE
    stream_id = mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION
    under_test = CameraUnderTest(stream=VideoStream(kind, uri))
    ack, info = under_test.command(request, stream_id)
    assert ack.result == mavlink.MAV_RESULT_ACCEPTED
    assert (info.type, info.uri, info.resolution_h, info.hfov) == (number, uri, 640, 90)
    encoding = mavlink.VIDEO_STREAM_ENCODING_H264 if kind == "rtsp" else mavlink.VIDEO_STREAM_ENCODING_UNKNOWN
    assert info.encoding == encoding
    assert CameraUnderTest().result(request, stream_id) == mavlink.MAV_RESULT_UNSUPPORTED


IMAGE = mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
QGC, OTHER = 255, 253


def tracked(under_test: CameraUnderTest, by: int) -> None:
    under_test.result(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0.1, 0.1, 0.2, 0.2, by=by)
    status = under_test.camera.status
    status.state, status.centre, status.half_size = "visible", (0.15, 0.15), (0.05, 0.05)


def test_a_station_that_slows_or_stops_the_status_changes_nothing_for_the_others() -> None:
    under_test = CameraUnderTest()
    under_test.fly(0.1, QGC, OTHER)
    tracked(under_test, QGC)
    # As QGroundControl does after a selection, and after it has stopped tracking.
    for interval_us in (500_000, -1):
        assert under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, interval_us, by=QGC) == 0
        assert under_test.fly(3.0, QGC, OTHER)["CAMERA_TRACKING_IMAGE_STATUS"] == pytest.approx(30, abs=2)


def test_a_station_alone_gets_what_it_asks_for() -> None:
    under_test = CameraUnderTest()
    tracked(under_test, QGC)
    under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, 500_000, by=QGC)
    assert under_test.fly(3.0, QGC)["CAMERA_TRACKING_IMAGE_STATUS"] == pytest.approx(6, abs=1)
    under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, -1, by=QGC)
    assert "CAMERA_TRACKING_IMAGE_STATUS" not in under_test.fly(3.0, QGC)
    under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, 0, by=QGC)
    assert under_test.fly(3.0, QGC)["CAMERA_TRACKING_IMAGE_STATUS"] == pytest.approx(30, abs=2)
    assert under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, math.nan, by=QGC) == mavlink.MAV_RESULT_DENIED
    unknown = under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 1000, by=QGC)
    assert unknown == mavlink.MAV_RESULT_UNSUPPORTED


def test_a_selection_and_a_departure_restore_the_default_rate() -> None:
    under_test = CameraUnderTest()
    tracked(under_test, QGC)
    under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, -1, by=QGC)
    assert "CAMERA_TRACKING_IMAGE_STATUS" not in under_test.fly(1.0, QGC)
    tracked(under_test, QGC)
    assert under_test.fly(3.0, QGC)["CAMERA_TRACKING_IMAGE_STATUS"] == pytest.approx(30, abs=2)
    under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, 3_600_000_000, by=QGC)
    under_test.fly(0.1)
    under_test.now += 10.0  # the station is gone
    assert under_test.fly(3.0)["CAMERA_TRACKING_IMAGE_STATUS"] == pytest.approx(30, abs=2)


def test_a_script_that_selects_and_sends_no_heartbeats_is_not_forgotten_while_others_slow_the_status() -> None:
    under_test = CameraUnderTest()
    under_test.fly(0.1, QGC)
    tracked(under_test, OTHER)
    for interval_us in (-1, 500_000):
        under_test.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, interval_us, by=QGC)
        for _ in range(2):  # longer than a station's silence
            assert under_test.fly(6.0, QGC)["CAMERA_TRACKING_IMAGE_STATUS"] == pytest.approx(60, abs=2)


def test_a_companion_that_has_given_a_command_is_present_by_its_own_heartbeats() -> None:
    rates = MessageRates({"CAMERA_FOV_STATUS": 1.0})
    companion, now = (1, 191), 0.0
    rates.hear(companion, now, new=False)
    assert not rates.is_present(1, now)
    rates.hear(companion, now)
    rates.set_interval(companion, "CAMERA_FOV_STATUS", 100_000)
    for _ in range(30):
        now += 1.0
        rates.hear(companion, now, new=False)
        assert rates.interval("CAMERA_FOV_STATUS", now) == pytest.approx(0.1)


def test_any_number_of_stations_is_remembered_only_up_to_a_limit() -> None:
    rates = MessageRates({"CAMERA_FOV_STATUS": 1.0})
    for system in range(200):
        rates.hear((system, 190), 0.01 * system)
        rates.set_interval((system, 190), "CAMERA_FOV_STATUS", 100_000 * (system + 1))
    assert len(rates._stations) == 32
    assert rates.interval("CAMERA_FOV_STATUS", 2.0) == pytest.approx(16.9)


def test_video_stream_commands_are_acknowledged_and_unknown_streams_refused() -> None:
    accepted, denied, unsupported = (
        mavlink.MAV_RESULT_ACCEPTED,
        mavlink.MAV_RESULT_DENIED,
        mavlink.MAV_RESULT_UNSUPPORTED,
    )
    under_test = CameraUnderTest(stream=VideoStream("rtsp", "rtsp://10.0.0.7:8554/overlay"))
    information, status = mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION, mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS
    for stream, result in ((0, accepted), (1, accepted), (7, denied), (math.nan, denied)):
        for command in (mavlink.MAV_CMD_VIDEO_START_STREAMING, mavlink.MAV_CMD_VIDEO_STOP_STREAMING):
            assert under_test.result(command, stream) == result
        for legacy in (
            mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION,
            mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS,
        ):
            assert under_test.result(legacy, stream) == result
        for message in (information, status):
            answers = under_test.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message, stream)
            assert answers[0].result == result
            assert {m.stream_id for m in answers[1:]} == ({1} if result == accepted else set())
    assert CameraUnderTest().result(mavlink.MAV_CMD_VIDEO_START_STREAMING, 1) == unsupported


def test_unknown_zoom_and_focus_are_nan() -> None:
    _, settings = CameraUnderTest().command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS)
    assert math.isnan(settings.zoomLevel)
    assert math.isnan(settings.focusLevel)


def test_status_texts_say_what_happens_to_the_target() -> None:
    under_test = CameraUnderTest()
    texts: list[str] = []

    def fly(state: str, seconds: float) -> None:
        under_test.camera.status.state = state
        for _ in range(round(10 * seconds)):
            under_test.now += 0.1
            under_test.camera.tick(under_test.now, frame=True)
            texts.extend(m.text for m in under_test.received() if m.get_type() == "STATUSTEXT")

    tracked(under_test, QGC)
    for state, seconds in (("visible", 5), ("coasting", 0.3), ("visible", 1), ("coasting", 3), ("visible", 3)):
        fly(state, seconds)
    assert texts == [
        "Syncline: tracking started",
        "Syncline: target not seen, position predicted",
        "Syncline: target found again",
    ]
    texts.clear()
    for _ in range(20):  # a target that comes and goes floods no message list
        fly("coasting", 0.6)
        fly("visible", 0.6)
    assert 2 <= len(texts) <= 12
    texts.clear()
    answers = under_test.command(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.5, by=OTHER)
    assert "Syncline: station 253 took over from 255" in [m.text for m in answers if m.get_type() == "STATUSTEXT"]
    fly("lost", 1)
    fly("idle", 1)
    assert texts == ["Syncline: target lost, select it again", "Syncline: tracking stopped"]
    texts.clear()
    tracked(under_test, QGC)
    fly("visible", 1)
    stop = mavlink.MAV_CMD_CAMERA_STOP_TRACKING
    for station, said in ((OTHER, ["Syncline: station 253 stops what 255 tracks"]), (OTHER, []), (QGC, [])):
        answers = under_test.command(stop, by=station)
        assert [m.text for m in answers if m.get_type() == "STATUSTEXT"] == said
    tracked(under_test, QGC)
    fly("lost", 1)
    assert "STATUSTEXT" not in [m.get_type() for m in under_test.command(stop, by=OTHER)], "nothing is tracked"
    assert all(len(text) <= 50 for text, _ in camera_role._TEXTS.values())


def test_only_a_station_arms_following_and_only_at_the_camera() -> None:
    commands: list[OperatorCommand] = []
    under_test = CameraUnderTest(on_command=lambda command: commands.append(command) or True)  # type: ignore[func-returns-value]
    follow = mavlink.MAV_CMD_DO_FOLLOW
    assert under_test.result(follow, 1, by=QGC) == mavlink.MAV_RESULT_ACCEPTED
    assert under_test.result(follow, 0, by=QGC) == mavlink.MAV_RESULT_ACCEPTED
    assert under_test.result(follow, math.nan, by=QGC) == mavlink.MAV_RESULT_DENIED
    assert under_test.result(follow, 1, by=1) == mavlink.MAV_RESULT_DENIED  # the vehicle itself
    assert under_test.command(follow, 1, component=0, by=QGC) == []  # the autopilot's own follow-me
    assert commands == [ArmFollow(True, QGC), ArmFollow(False, QGC)]
    assert under_test.camera.is_present(QGC, under_test.now)
    assert not under_test.camera.is_present(QGC, under_test.now + 11.0)
    assert not under_test.camera.is_present(OTHER, under_test.now)
