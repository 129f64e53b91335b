"""A minimal ground station: finds the camera behind an autopilot, selects a target, receives its tracking status."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from edge.mavlink.dialect import CAMERA, STATION, mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.link.transport import parse_url
from protocols.core.clocks import NANOSECONDS

_MESSAGE_TYPES = (
    "HEARTBEAT",
    "COMMAND_ACK",
    "CAMERA_INFORMATION",
    "VIDEO_STREAM_INFORMATION",
    "CAMERA_TRACKING_IMAGE_STATUS",
    "CAMERA_TRACKING_GEO_STATUS",
    "CAMERA_FOV_STATUS",
)
_SYSTEM = 255  # of ground stations by convention
_HEARTBEAT_S = 1.0  # of every MAVLink component
_RETRY_S = 1.0  # the protocol's proposal for commands
_MAX_TRIES = 5  # the same


@dataclass(frozen=True, slots=True)
class TargetReport:
    """The camera's report of its target. flags: CAMERA_TRACKING_STATUS_FLAGS; box: fractions of the image or NaN.

    geo: latitude, longitude [degrees] and horizontal accuracy [m], None before the first.
    """

    flags: int
    box: tuple[float, float, float, float]
    geo: tuple[float, float, float] | None = None

    @property
    def state(self) -> str:
        """The flags as "idle", "visible", "coasting" or "lost"."""
        if self.flags & mavlink.CAMERA_TRACKING_STATUS_FLAGS_ERROR:
            return "lost"
        if self.flags & mavlink.CAMERA_TRACKING_STATUS_FLAGS_COASTING:
            return "coasting"
        return "visible" if self.flags & mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE else "idle"


class GroundStation:
    """A ground station on one link; call ``poll`` often.

    url: address of the autopilot. camera_seen: whether the camera's heartbeat was received. information: its
    CAMERA_INFORMATION. report: the newest tracking status. counts: received camera messages by type.
    """

    def __init__(self, url: str, *, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._link = Link(parse_url(url), system=_SYSTEM, component=STATION, allowed=_MESSAGE_TYPES, now_ns=now_ns)
        self._now_ns = now_ns
        self._beat_s = self._asked_s = -1e9
        self._pending: tuple[int, tuple[float, ...], int] | None = None
        self._sent_s = -1e9
        self.camera_seen = False
        self.information: Any = None
        self.stream: Any = None
        self.report: TargetReport | None = None
        self.results: dict[int, int] = {}
        self.counts: dict[str, int] = {}

    def poll(self, timeout_s: float = 0.0) -> None:
        """Receive messages and send what is due."""
        self._link.wait(timeout_s)
        for received in self._link.poll():
            if received.component == CAMERA:
                self.counts[received.kind] = self.counts.get(received.kind, 0) + 1
                self._handle(received.kind, received.message)
        now = self._now_ns() / NANOSECONDS
        if now >= self._beat_s:
            self._beat_s = now + _HEARTBEAT_S
            self._link.send(
                mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
            )
        if self.camera_seen and self._pending is None and now >= self._asked_s + 2.0:
            self._asked_s = now
            if self.information is None:
                self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION)
            elif self.stream is None and self.information.flags & mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM:
                self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION)
        if self._pending is not None and now >= self._sent_s + _RETRY_S:
            command, parameters, tries = self._pending
            self._pending = None
            if tries < _MAX_TRIES:
                self._command(command, *parameters, tries=tries + 1)

    def select(self, left: float, top: float, right: float, bottom: float) -> None:
        """Command the camera to track the target in a box, as fractions of the image."""
        self.results.pop(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, None)
        self._command(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, left, top, right, bottom)

    @property
    def selected(self) -> bool | None:
        """Whether the last selection was accepted; None while there is no response."""
        result = self.results.get(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE)
        return None if result is None else bool(result == mavlink.MAV_RESULT_ACCEPTED)

    def stop(self) -> None:
        """Command the camera to stop tracking."""
        self._command(mavlink.MAV_CMD_CAMERA_STOP_TRACKING)

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _handle(self, kind: str, message: Any) -> None:
        if kind == "HEARTBEAT":
            self.camera_seen = True
        elif kind == "COMMAND_ACK":
            self.results[message.command] = message.result
            if self._pending is not None and self._pending[0] == message.command:
                self._pending = None
        elif kind == "CAMERA_INFORMATION":
            self.information = message
        elif kind == "VIDEO_STREAM_INFORMATION":
            self.stream = message
        elif kind == "CAMERA_TRACKING_IMAGE_STATUS":
            box = (message.rec_top_x, message.rec_top_y, message.rec_bottom_x, message.rec_bottom_y)
            self.report = TargetReport(message.tracking_status, box, None if self.report is None else self.report.geo)
        elif kind == "CAMERA_TRACKING_GEO_STATUS" and self.report is not None and message.lat != 0x7FFFFFFF:
            place = (1e-7 * message.lat, 1e-7 * message.lon, message.h_acc)
            self.report = TargetReport(self.report.flags, self.report.box, place)

    def _command(self, command: int, *parameters: float, tries: int = 0) -> None:
        if self._link.vehicle is None:
            return
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self._link.send(mavlink.MAVLink_command_long_message(self._link.vehicle, CAMERA, command, tries, *filled))
        self._pending = (command, parameters, tries)
        self._sent_s = self._now_ns() / NANOSECONDS
