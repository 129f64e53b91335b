"""QGroundControl's dialogue with the camera, through autopilots that route like ArduPilot and like PX4.

The steps have the names of QGroundControl's source (QGCCameraManager, VehicleCameraControl); the stations are
pymavlink's codec. Time is simulated.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from edge.devices.simulated.aircraft import SimulatedAircraft
from edge.mavlink.dialect import mavlink as M
from edge.mavlink.roles.autopilot import Autopilot
from edge.uav.world import scenarios
from tests.faults.stations import exchanged
from tests.support.pipe import Pipe
from tests.support.uav_flights import Air, Flight
from tests.support.vehicle_link import URI, CameraOnLink

IMAGE = M.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
ACCEPTED, DENIED, UNSUPPORTED = M.MAV_RESULT_ACCEPTED, M.MAV_RESULT_DENIED, M.MAV_RESULT_UNSUPPORTED
BOX = (0.4, 0.4, 0.6, 0.5)


class Station:
    """A ground station on a pipe. name: in the table of results. received: all of the camera's messages."""

    def __init__(self, site: Site, pipe: Pipe, system: int, name: str) -> None:
        self.name = name
        self._site, self._pipe, self._codec = site, pipe, M.MAVLink(None, system, 190)
        self._reader = M.MAVLink(None)
        self.received: list[Any] = []
        self.tracking_rect: tuple[float, ...] | None = None
        self.messages: list[str] = []

    def beat(self) -> None:
        self._send(M.MAVLink_heartbeat_message(M.MAV_TYPE_GCS, M.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3))

    def poll(self) -> None:
        for data, _ in self._pipe.receive():
            for message in self._reader.parse_buffer(data) or []:
                if message.get_srcComponent() == 100:
                    self.received.append(message)
                    if message.get_type() == "CAMERA_TRACKING_IMAGE_STATUS":
                        self.handle_tracking_image_status(message)
                    elif message.get_type() == "STATUSTEXT":
                        self.messages.append(message.text)

    def handle_tracking_image_status(self, message: Any) -> None:
        """handleTrackingImageStatus, and trackingImageStatus as the QML asks for it before it draws."""
        drawn = message.tracking_status == M.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
        corners = (message.rec_top_x, message.rec_top_y, message.rec_bottom_x, message.rec_bottom_y)
        self.tracking_rect = corners if drawn else None

    def send_mav_command(self, command: int, *parameters: float) -> int | None:
        """sendMavCommand: the result in the ACK, within half a second."""
        self.received.clear()
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self._send(M.MAVLink_command_long_message(1, 100, command, 0, *filled))
        self._site.run(0.5)
        acks = [m for m in self.received if m.get_type() == "COMMAND_ACK" and m.command == command]
        result = int(acks[0].result) if acks else None
        step = M.enums["MAV_CMD"][command].name.removeprefix("MAV_CMD_")
        words = [f"{parameter:g}" for parameter in parameters]
        if command in (M.MAV_CMD_REQUEST_MESSAGE, M.MAV_CMD_SET_MESSAGE_INTERVAL):
            words[0] = M.mavlink_map[int(parameters[0])].msgname
        came = {m.get_type() for m in self.received} & {words[0] if words else "", step.removeprefix("REQUEST_")}
        outcome = "no answer" if result is None else M.enums["MAV_RESULT"][result].name.removeprefix("MAV_RESULT_")
        exchanged(self.name, f"{step} {' '.join(words)}".rstrip(), ", ".join((outcome, *came)))
        return result

    def start_tracking(self) -> None:
        """startTracking(QRectF), then _requestTrackingStatus."""
        assert self.send_mav_command(M.MAV_CMD_CAMERA_TRACK_RECTANGLE, *BOX) == ACCEPTED
        assert self.send_mav_command(M.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, 500_000) == ACCEPTED

    def stop_tracking(self) -> None:
        """stopTracking, which also stops the status messages."""
        assert self.send_mav_command(M.MAV_CMD_CAMERA_STOP_TRACKING) == ACCEPTED
        assert self.send_mav_command(M.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, -1) == ACCEPTED

    def statuses(self, seconds: float) -> int:
        """How many tracking statuses arrive in a time."""
        self.received.clear()
        self._site.run(seconds)
        return sum(message.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" for message in self.received)

    def shown(self) -> str:
        """What the operator sees: the box, and the newest message."""
        if self.tracking_rect is not None:
            assert self.tracking_rect == pytest.approx(BOX)
        return ("no box" if self.tracking_rect is None else "box") + f'; "{self.messages[-1]}"'

    def answer(self, kind: str) -> Any:
        """The newest message of a type."""
        return next((message for message in reversed(self.received) if message.get_type() == kind), None)

    def _send(self, message: Any) -> None:
        self._pipe.send(bytes(message.pack(self._codec)), None)


class Site:
    """An autopilot, the camera on one of its links, and a station on each of two others."""

    def __init__(self, *, firmware: int = M.MAV_AUTOPILOT_ARDUPILOTMEGA, camera_forwards: bool = True) -> None:
        self.time = 0.0
        air = Air()
        pipe = air.join()
        self.autopilot = Autopilot(
            SimulatedAircraft(start=np.array([0.0, 0.0, -60.0])),
            air,
            firmware=firmware,
            forwards=lambda address: camera_forwards or address != ("pipe", 0),
        )
        self.camera = CameraOnLink(transport=pipe, now_ns=lambda: round(1e9 * (100.0 + self.time)))
        name = "QGroundControl" if camera_forwards else "QGroundControl, PX4 with MAV_1_FORWARD = 0"
        self.qgc = Station(self, air.join(), 255, name)
        self.other = Station(self, air.join(), 253, "second station")
        self.run(2.5)

    def run(self, seconds: float) -> None:
        for _ in range(round(25 * seconds)):
            if round(25 * self.time) % 25 == 0:
                self.qgc.beat()
                self.other.beat()
            self.time += 0.04
            self.autopilot.step(self.time)
            self.camera.step()
            self.qgc.poll()
            self.other.poll()


@pytest.mark.parametrize("firmware", [M.MAV_AUTOPILOT_ARDUPILOTMEGA, M.MAV_AUTOPILOT_PX4])
def test_qgroundcontrol_finds_the_camera_shows_its_video_and_tracks(firmware: int) -> None:
    site = Site(firmware=firmware)
    qgc = site.qgc
    assert any(m.get_type() == "HEARTBEAT" and m.type == M.MAV_TYPE_CAMERA for m in qgc.received)
    exchanged(qgc.name, "heartbeat", "the camera is found")
    # _requestCameraInfo, _requestCameraSettings, _requestStorageInfo
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_MESSAGE, M.MAVLINK_MSG_ID_CAMERA_INFORMATION) == ACCEPTED
    information = qgc.answer("CAMERA_INFORMATION")
    assert information.flags & M.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_MESSAGE, M.MAVLINK_MSG_ID_CAMERA_SETTINGS) == ACCEPTED
    assert math.isnan(qgc.answer("CAMERA_SETTINGS").zoomLevel)
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_MESSAGE, M.MAVLINK_MSG_ID_STORAGE_INFORMATION, 0) == UNSUPPORTED
    # _checkForVideoStreams: _requestStreamInfo(1), both ways; then resumeStream, stopStream
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_MESSAGE, M.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION, 1) == ACCEPTED
    assert qgc.answer("VIDEO_STREAM_INFORMATION").uri == URI
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 1) == ACCEPTED
    assert qgc.send_mav_command(M.MAV_CMD_VIDEO_STOP_STREAMING, 1) == ACCEPTED
    assert qgc.send_mav_command(M.MAV_CMD_VIDEO_START_STREAMING, 1) == ACCEPTED
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_MESSAGE, M.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS, 1) == ACCEPTED
    # _requestStreamInfo(7); QGCCameraManager::requestCameraFovForComp
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 7) == DENIED
    assert qgc.send_mav_command(M.MAV_CMD_REQUEST_MESSAGE, M.MAVLINK_MSG_ID_CAMERA_FOV_STATUS) == ACCEPTED
    qgc.start_tracking()
    exchanged(qgc.name, "target seen", qgc.shown())
    for state, seconds in (("coasting", 2.5), ("visible", 3.0), ("lost", 2.5)):
        site.camera.component.status.state = state
        site.run(seconds)
        exchanged(qgc.name, f"target {state}", qgc.shown())
        assert (qgc.tracking_rect is not None) == (state == "visible")
    qgc.stop_tracking()
    exchanged(qgc.name, "after that", qgc.shown())
    assert qgc.messages == [
        "Syncline: tracking started",
        "Syncline: target not seen, position predicted",
        "Syncline: target found again",
        "Syncline: target lost, select it again",
        "Syncline: tracking stopped",
    ]


def test_the_next_station_hears_everything_after_qgroundcontrol_has_stopped() -> None:
    site = Site()
    site.qgc.start_tracking()
    site.qgc.stop_tracking()
    assert site.other.send_mav_command(M.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.5, 0.1) == ACCEPTED
    assert site.other.statuses(2.0) >= 18
    exchanged(site.other.name, "after QGroundControl's interval of -1", "10 statuses a second")
    assert site.qgc.send_mav_command(M.MAV_CMD_SET_MESSAGE_INTERVAL, IMAGE, 500_000) == ACCEPTED
    assert site.other.statuses(2.0) >= 18
    exchanged(site.other.name, "after QGroundControl's interval of 500 ms", "10 statuses a second")
    assert site.qgc.send_mav_command(M.MAV_CMD_CAMERA_TRACK_RECTANGLE, *BOX) == ACCEPTED
    text = "Syncline: station 255 took over from 253"
    assert text in site.other.messages
    exchanged(site.other.name, "selection by QGroundControl", f'"{text}"')


def test_without_forwarding_on_its_port_a_px4_keeps_station_and_camera_apart() -> None:
    site = Site(firmware=M.MAV_AUTOPILOT_PX4, camera_forwards=False)
    assert site.camera.link.vehicle == 1  # the camera hears the autopilot
    assert site.qgc.received == []
    assert site.qgc.send_mav_command(M.MAV_CMD_CAMERA_TRACK_RECTANGLE, *BOX) is None
    assert site.camera.commands == []


def test_a_camera_that_is_mounted_otherwise_than_stated_gives_no_position() -> None:
    """Positions were some 50 m off, with an accuracy of 0.5 m, and nobody was told."""
    flight = Flight(scenarios.get("far", 1, (320, 240)), turned=np.diag([-1.0, -1.0, 1.0]))
    flight.run(1.5)
    assert flight.select()
    flight.run(7.7)
    status = flight.agent.status(0)
    texts = [message.text for message in flight.station.received["STATUSTEXT"]]
    estimate = flight.agent.estimate
    assert estimate is not None
    assert math.isnan(estimate.north)
    assert status.state == "degraded"
    assert "as of a camera turned by 180 degrees: check body_from_camera" in status.message
    assert any("attitude unlike the images" in text for text in texts)
