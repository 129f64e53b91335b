"""A MAVLink camera component: camera information, target tracking status, and tracking commands.

MAVLink's units and conventions are confined to this module: image coordinates 0 … 1, 1e-7 degrees, NaN for "not
available".
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from edge.mavlink.dialect import CAMERA, mavlink
from edge.mavlink.link.connection import Link, ReceivedMessage
from protocols.geometry.camera import Intrinsics

MESSAGE_TYPES = ("COMMAND_LONG", "COMMAND_INT", "PARAM_REQUEST_LIST")
NAN = float("nan")
_HEARTBEAT_S = 1.0
_REPEAT_WINDOW_S = 2  # s within which identical commands are retransmissions of the station
_UNKNOWN_INT = 0x7FFFFFFF
_MODEL = b"Syncline UAV tracker"
_DEFAULT_HZ = {"CAMERA_TRACKING_IMAGE_STATUS": 10.0, "CAMERA_TRACKING_GEO_STATUS": 5.0, "CAMERA_FOV_STATUS": 1.0}


@dataclass(frozen=True, slots=True)
class SelectTarget:
    """Command to track the target in a box or at a point.

    left, top, right, bottom: fractions of the image; both corners are equal for a point. by: the sender's system id.
    """

    left: float
    top: float
    right: float
    bottom: float
    by: int

    @property
    def is_point(self) -> bool:
        """Whether only a point was given."""
        return self.left == self.right and self.top == self.bottom


@dataclass(frozen=True, slots=True)
class StopTracking:
    """Command to stop tracking."""

    by: int


@dataclass(frozen=True, slots=True)
class VideoStream:
    """The operator's video stream. kind: "rtsp" or "mjpeg"; uri: its address."""

    kind: str
    uri: str


@dataclass(slots=True)
class TrackingStatus:
    """What the component reports of the target and the camera; the agent keeps it up to date.

    state: "idle", "visible", "coasting", "lost". centre, half_size: of the target's box as fractions of the image, None
    where unknown or outside. geo: latitude, longitude [degrees], altitude [m]. h_acc, distance [m]; velocity: north,
    east [m/s]; course [rad]. camera: latitude, longitude, altitude of the camera; image_centre: of the ground point at
    the image centre. quaternion: of the camera's axes forward, right, down in NED.
    """

    state: str = "idle"
    mode_point: bool = False
    centre: tuple[float, float] | None = None
    half_size: tuple[float, float] | None = None
    geo: tuple[float, float, float] | None = None
    h_acc: float = NAN
    velocity: tuple[float, float] | None = None
    distance: float = NAN
    course: float = NAN
    camera: tuple[float, float, float] | None = None
    image_centre: tuple[float, float, float] | None = None
    quaternion: list[float] | None = None
    boot_ms: int = 0


@dataclass(slots=True)
class _MessageSchedule:
    interval_s: float
    due_s: float = -math.inf


class CameraComponent:
    """The camera component on one link. size: (width, height) [px]; lens: None where not calibrated.

    stream: None without video. on_command: called with SelectTarget and StopTracking; whether the command was accepted.
    stations: system ids that may send commands; empty: all.
    """

    def __init__(
        self,
        link: Link,
        size: tuple[int, int],
        fps: float,
        lens: Intrinsics | None,
        stream: VideoStream | None,
        on_command: Callable[[SelectTarget | StopTracking], bool],
        *,
        stations: frozenset[int] = frozenset(),
        version: tuple[int, int, int] = (0, 1, 0),
    ) -> None:
        self._link, self._size, self._fps, self._lens, self._stream = link, size, fps, lens, stream
        self._on_command, self._stations, self._version = on_command, stations, version
        self.status = TrackingStatus()
        self.counters: Counter[str] = Counter()
        self._beat_s = -math.inf
        self._rates = {kind: _MessageSchedule(1.0 / rate) for kind, rate in _DEFAULT_HZ.items()}
        self._last: dict[tuple[int, int], _AcknowledgedCommand] = {}

    @property
    def fov(self) -> tuple[float, float]:
        """Horizontal and vertical [degrees]; NaN without a lens."""
        if self._lens is None:
            return NAN, NAN
        matrix = self._lens.matrix
        return (
            math.degrees(2.0 * math.atan(0.5 * self._size[0] / matrix[0, 0])),
            math.degrees(2.0 * math.atan(0.5 * self._size[1] / matrix[1, 1])),
        )

    def handle(self, received: ReceivedMessage, now_s: float) -> None:
        """Handle a message if it addresses the camera."""
        message = received.message
        if received.kind not in ("COMMAND_LONG", "COMMAND_INT"):
            return
        if message.target_system not in (0, self._link.vehicle) or message.target_component not in (0, CAMERA):
            return
        for_us = message.target_component == CAMERA
        if self._stations and received.system not in self._stations and received.system != self._link.vehicle:
            self.counters["refused.station"] += 1
            if for_us:
                self._acknowledge(message, received, mavlink.MAV_RESULT_DENIED)
            return
        parameters = _parameters(message)
        key = (received.system, received.component)
        last = self._last.get(key)
        if (
            last is not None
            and last.same(message, parameters)
            and now_s - last.at_s < _REPEAT_WINDOW_S
            and is_retransmission(message)
        ):
            # The ACK was lost: repeat it without executing the command again.
            self.counters["repeated"] += 1
            self._acknowledge(message, received, last.result)
            return
        result = self._command(message.command, parameters, received)
        if result is None:
            if not for_us:
                return  # a broadcast for other components
            self.counters["unsupported"] += 1
            result = mavlink.MAV_RESULT_UNSUPPORTED
        if len(self._last) > 32:
            self._last.clear()
        self._last[key] = _AcknowledgedCommand(message.command, parameters, result, now_s)
        self._acknowledge(message, received, result)
        self._send_response(message.command, parameters, result)

    def tick(self, now_s: float, *, frame: bool) -> None:
        """Send what is due. frame: a new frame has just been processed."""
        # Also before any vehicle is known: the peer of an outgoing link has to learn that this side exists.
        if now_s >= self._beat_s:
            self._beat_s = now_s + _HEARTBEAT_S
            self._link.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                )
            )
        if self._link.vehicle is None:
            return
        for kind, rate in self._rates.items():
            per_frame = kind != "CAMERA_FOV_STATUS"
            if per_frame and (not frame or self.status.state == "idle"):
                continue
            if rate.interval_s > 0.0 and now_s >= rate.due_s:
                rate.due_s = max(rate.due_s + rate.interval_s, now_s + 0.5 * rate.interval_s)
                self._send_message(kind)

    def send_status_now(self) -> None:
        """Send the tracking status at once, after a change of state."""
        for kind in ("CAMERA_TRACKING_IMAGE_STATUS", "CAMERA_TRACKING_GEO_STATUS"):
            self._send_message(kind)

    def _command(self, command: int, p: tuple[float, ...], received: ReceivedMessage) -> Any:
        """Execute one command; its MAV_RESULT, None where it is not for a camera."""
        accepted, denied = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
        if command in _REQUESTS or command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return accepted if self._requested(command, p) in self._available_messages() else None
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            rate = self._rates.get(_message_name(p[0]))
            if rate is None or not math.isfinite(p[1]):
                return None
            default = 1.0 / _DEFAULT_HZ[_message_name(p[0])]
            rate.interval_s = default if p[1] == 0 else 0.0 if p[1] < 0 else max(1e-6 * p[1], 1.0 / 60.0)
            rate.due_s = -math.inf
            return accepted
        if command == mavlink.MAV_CMD_CAMERA_TRACK_POINT:
            selection = SelectTarget(p[0], p[1], p[0], p[1], received.system)
        elif command == mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE:
            selection = SelectTarget(
                min(p[0], p[2]), min(p[1], p[3]), max(p[0], p[2]), max(p[1], p[3]), received.system
            )
        elif command == mavlink.MAV_CMD_CAMERA_STOP_TRACKING:
            self.counters["stops"] += 1
            return accepted if self._on_command(StopTracking(received.system)) else mavlink.MAV_RESULT_FAILED
        else:
            return None
        inside = all(
            0.0 <= value <= 1.0 for value in (selection.left, selection.top, selection.right, selection.bottom)
        )  # NaN is not
        flat = not selection.is_point and (selection.left == selection.right or selection.top == selection.bottom)
        if not inside or flat or (selection.is_point and command == mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE):
            self.counters["refused.box"] += 1
            return denied
        self.counters["selections"] += 1
        self.status.mode_point = selection.is_point
        return accepted if self._on_command(selection) else mavlink.MAV_RESULT_FAILED

    def _send_response(self, command: int, p: tuple[float, ...], result: int) -> None:
        """Send the data that a command requested, after its ACK."""
        if result != mavlink.MAV_RESULT_ACCEPTED:
            return
        if command in _REQUESTS or command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            self._send_message(self._requested(command, p))
        elif command != mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.send_status_now()

    def _requested(self, command: int, p: tuple[float, ...]) -> str:
        return _REQUESTS.get(command) or _message_name(p[0])

    def _available_messages(self) -> frozenset[str]:
        streams = ("VIDEO_STREAM_INFORMATION", "VIDEO_STREAM_STATUS") if self._stream is not None else ()
        return frozenset(("CAMERA_INFORMATION", "CAMERA_SETTINGS", *self._rates, *streams))

    def _send_message(self, kind: str) -> None:
        if self._link.send(getattr(self, f"_{kind.lower()}")()):
            self.counters["statuses"] += kind in _DEFAULT_HZ

    def _camera_information(self) -> Any:
        flags = mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
        flags |= mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
        if self._stream is not None:
            flags |= mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
        major, minor, patch = self._version
        return mavlink.MAVLink_camera_information_message(
            self.status.boot_ms,
            list(b"Syncline".ljust(32, b"\0")),
            list(_MODEL.ljust(32, b"\0")),
            major | minor << 8 | patch << 16,
            NAN,
            NAN,
            NAN,
            self._size[0],
            self._size[1],
            0,
            flags,
            0,
            b"",
        )

    def _camera_settings(self) -> Any:
        return mavlink.MAVLink_camera_settings_message(self.status.boot_ms, mavlink.CAMERA_MODE_VIDEO)

    def _video_stream_information(self) -> Any:
        assert self._stream is not None
        rtsp = self._stream.kind == "rtsp"
        hfov = self.fov[0]
        # MAVLink has no type for MJPEG over HTTP: the uri identifies it, and the encoding is reported as unknown.
        return mavlink.MAVLink_video_stream_information_message(
            1,
            1,
            mavlink.VIDEO_STREAM_TYPE_RTSP if rtsp else mavlink.VIDEO_STREAM_TYPE_TCP_MPEG,
            mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING,
            self._fps,
            self._size[0],
            self._size[1],
            0,
            0,
            round(hfov) if math.isfinite(hfov) else 0,
            self._stream.kind.encode(),
            self._stream.uri.encode()[:159],
            mavlink.VIDEO_STREAM_ENCODING_H264 if rtsp else mavlink.VIDEO_STREAM_ENCODING_UNKNOWN,
        )

    def _video_stream_status(self) -> Any:
        hfov = self.fov[0]
        return mavlink.MAVLink_video_stream_status_message(
            1,
            mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING,
            self._fps,
            self._size[0],
            self._size[1],
            0,
            0,
            round(hfov) if math.isfinite(hfov) else 0,
        )

    def _camera_tracking_image_status(self) -> Any:
        status = self.status
        mode = mavlink.CAMERA_TRACKING_MODE_RECTANGLE
        if status.state == "idle":
            mode = mavlink.CAMERA_TRACKING_MODE_NONE
        elif status.mode_point:
            mode = mavlink.CAMERA_TRACKING_MODE_POINT
        x, y, box = NAN, NAN, (NAN,) * 4
        # Outside the image there is no box; the geo status reports the predicted position.
        if status.centre is not None and status.half_size is not None and all(0.0 <= c <= 1.0 for c in status.centre):
            (x, y), (w, h) = status.centre, status.half_size
            box = (max(x - w, 0.0), max(y - h, 0.0), min(x + w, 1.0), min(y + h, 1.0))
        return mavlink.MAVLink_camera_tracking_image_status_message(
            _STATUS_FLAGS[status.state], mode, mavlink.CAMERA_TRACKING_TARGET_DATA_IN_STATUS, x, y, NAN, *box
        )

    def _camera_tracking_geo_status(self) -> Any:
        status = self.status
        latitude, longitude, altitude = _scaled_position(status.geo)
        north, east = status.velocity or (NAN, NAN)
        return mavlink.MAVLink_camera_tracking_geo_status_message(
            _STATUS_FLAGS[status.state],
            latitude,
            longitude,
            altitude,
            status.h_acc,
            NAN,
            north,
            east,
            0.0 if status.velocity else NAN,
            NAN,
            status.distance,
            status.course,
            NAN,
        )

    def _camera_fov_status(self) -> Any:
        status, (hfov, vfov) = self.status, self.fov
        camera, image = _scaled_position(status.camera), _scaled_position(status.image_centre)
        heights = [round(1e3 * place[2]) if place[0] != _UNKNOWN_INT else _UNKNOWN_INT for place in (camera, image)]
        return mavlink.MAVLink_camera_fov_status_message(
            status.boot_ms,
            *camera[:2],
            heights[0],
            *image[:2],
            heights[1],
            status.quaternion or [NAN] * 4,
            hfov,
            vfov,
        )

    def _acknowledge(self, message: Any, received: ReceivedMessage, result: int) -> None:
        self._link.send(
            mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, received.system, received.component)
        )


@dataclass(frozen=True, slots=True)
class _AcknowledgedCommand:
    command: int
    parameters: tuple[float, ...]
    result: int
    at_s: float = field(default=-math.inf)

    def same(self, message: Any, parameters: tuple[float, ...]) -> bool:
        return bool(self.command == message.command and repr(self.parameters) == repr(parameters))


def is_retransmission(message: Any) -> bool:
    """Whether the sender marks a command as a retransmission."""
    return int(getattr(message, "confirmation", 0)) > 0


_STATUS_FLAGS = {
    "idle": mavlink.CAMERA_TRACKING_STATUS_FLAGS_IDLE,
    "visible": mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
    "coasting": mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE | mavlink.CAMERA_TRACKING_STATUS_FLAGS_COASTING,
    "lost": mavlink.CAMERA_TRACKING_STATUS_FLAGS_ERROR,
}
_REQUESTS = {
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: "CAMERA_INFORMATION",
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: "CAMERA_SETTINGS",
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: "VIDEO_STREAM_INFORMATION",
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: "VIDEO_STREAM_STATUS",
}
"""Commands from before MAV_CMD_REQUEST_MESSAGE, which stations still send."""


def _parameters(message: Any) -> tuple[float, ...]:
    if message.get_type() == "COMMAND_INT":
        return (message.param1, message.param2, message.param3, message.param4, float(message.x), float(message.y))
    return (message.param1, message.param2, message.param3, message.param4, message.param5, message.param6)


def _message_name(number: float) -> str:
    """The name of a message id that came as a float; "" for an unknown one."""
    kind = mavlink.mavlink_map.get(int(number)) if math.isfinite(number) and number == int(number) else None
    return "" if kind is None else str(kind.msgname)


def _scaled_position(geo: tuple[float, float, float] | None) -> tuple[int, int, float]:
    """Latitude, longitude in 1e-7 degrees and altitude [m]; INT32_MAX and NaN where unknown."""
    if geo is None:
        return _UNKNOWN_INT, _UNKNOWN_INT, NAN
    return round(1e7 * geo[0]), round(1e7 * geo[1]), geo[2]
