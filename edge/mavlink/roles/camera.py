"""A camera component as ground stations expect one: what it is, what it tracks, and what it is asked to.

Units and conventions are MAVLink's here and nowhere else: image coordinates 0 … 1, 1e-7 degrees, NaN for "not told".
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from edge.mavlink.dialect import CAMERA, mavlink
from edge.mavlink.link.connection import Heard, Link
from protocols.geometry.camera import Intrinsics

KINDS = ("COMMAND_LONG", "COMMAND_INT", "PARAM_REQUEST_LIST")
NAN = float("nan")
_HEARTBEAT_S = 1.0
_SOON = 2  # identical commands within so many seconds are the station's repeats
_UNKNOWN_INT = 0x7FFFFFFF
_MODEL = b"Syncline UAV tracker"
_DEFAULT_HZ = {"CAMERA_TRACKING_IMAGE_STATUS": 10.0, "CAMERA_TRACKING_GEO_STATUS": 5.0, "CAMERA_FOV_STATUS": 1.0}


@dataclass(frozen=True, slots=True)
class Select:
    """Follow what is in this box: top left and bottom right as shares of the picture, or a point (both the same)."""

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
class Stop:
    """Follow nothing any more."""

    by: int


@dataclass(frozen=True, slots=True)
class Stream:
    """The operator's video. kind: "rtsp" or "mjpeg"; uri: where."""

    kind: str
    uri: str


@dataclass(slots=True)
class Shown:
    """What the component tells of the target and the camera; the agent keeps it up to date.

    state: "idle", "visible", "coasting", "lost". centre, half: shares of the picture, None where unknown or outside.
    geo: latitude, longitude [degrees], altitude [m]. h_acc, distance [m]; velocity: north, east [m/s]; course [rad].
    camera: latitude, longitude, altitude of the camera; looking: of the middle of the picture on the ground.
    quaternion: of the camera's axes forward, right, down in NED.
    """

    state: str = "idle"
    mode_point: bool = False
    centre: tuple[float, float] | None = None
    half: tuple[float, float] | None = None
    geo: tuple[float, float, float] | None = None
    h_acc: float = NAN
    velocity: tuple[float, float] | None = None
    distance: float = NAN
    course: float = NAN
    camera: tuple[float, float, float] | None = None
    looking: tuple[float, float, float] | None = None
    quaternion: list[float] | None = None
    boot_ms: int = 0


@dataclass(slots=True)
class _Rate:
    interval_s: float
    due_s: float = -math.inf


class CameraComponent:
    """Answers on one link. size: (width, height) [px]; lens: None where not calibrated. stream: None without video.

    obey: is told of Select and Stop and says whether it could. stations: system ids that may give orders; empty: all.
    """

    def __init__(
        self,
        link: Link,
        size: tuple[int, int],
        fps: float,
        lens: Intrinsics | None,
        stream: Stream | None,
        obey: Callable[[Select | Stop], bool],
        *,
        stations: frozenset[int] = frozenset(),
        version: tuple[int, int, int] = (0, 1, 0),
    ) -> None:
        self._link, self._size, self._fps, self._lens, self._stream = link, size, fps, lens, stream
        self._obey, self._stations, self._version = obey, stations, version
        self.shown = Shown()
        self.counters: Counter[str] = Counter()
        self._beat_s = -math.inf
        self._rates = {kind: _Rate(1.0 / rate) for kind, rate in _DEFAULT_HZ.items()}
        self._last: dict[tuple[int, int], _Answered] = {}

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

    def handle(self, heard: Heard, now_s: float) -> None:
        """Take a message that may be meant for the camera."""
        message = heard.message
        if heard.kind not in ("COMMAND_LONG", "COMMAND_INT"):
            return
        if message.target_system not in (0, self._link.vehicle) or message.target_component not in (0, CAMERA):
            return
        for_us = message.target_component == CAMERA
        if self._stations and heard.system not in self._stations and heard.system != self._link.vehicle:
            self.counters["refused.station"] += 1
            if for_us:
                self._acknowledge(message, heard, mavlink.MAV_RESULT_DENIED)
            return
        parameters = _parameters(message)
        key = (heard.system, heard.component)
        last = self._last.get(key)
        if (
            last is not None
            and last.same(message, parameters)
            and now_s - last.at_s < _SOON
            and message_repeats(message)
        ):
            # Its ACK was lost: say it again, but don't do it again.
            self.counters["repeated"] += 1
            self._acknowledge(message, heard, last.result)
            return
        result = self._command(message.command, parameters, heard)
        if result is None:
            if not for_us:
                return  # a broadcast that is for others
            self.counters["unsupported"] += 1
            result = mavlink.MAV_RESULT_UNSUPPORTED
        if len(self._last) > 32:
            self._last.clear()
        self._last[key] = _Answered(message.command, parameters, result, now_s)
        self._acknowledge(message, heard, result)
        self._answer(message.command, parameters, result)

    def tick(self, now_s: float, *, frame: bool) -> None:
        """Say what is due. frame: a new frame has just been looked at."""
        # Also before a vehicle is heard: who is called has to know that somebody is there.
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
            paced = kind != "CAMERA_FOV_STATUS"
            if paced and (not frame or self.shown.state == "idle"):
                continue
            if rate.interval_s > 0.0 and now_s >= rate.due_s:
                rate.due_s = max(rate.due_s + rate.interval_s, now_s + 0.5 * rate.interval_s)
                self._tell(kind)

    def tell_now(self) -> None:
        """The state has changed: say it at once."""
        for kind in ("CAMERA_TRACKING_IMAGE_STATUS", "CAMERA_TRACKING_GEO_STATUS"):
            self._tell(kind)

    def _command(self, command: int, p: tuple[float, ...], heard: Heard) -> Any:
        """Obey one command; its result, None where it is not ours."""
        accepted, denied = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
        if command in _REQUESTS or command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return accepted if self._requested(command, p) in self._known() else None
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            rate = self._rates.get(_kind(p[0]))
            if rate is None or not math.isfinite(p[1]):
                return None
            default = 1.0 / _DEFAULT_HZ[_kind(p[0])]
            rate.interval_s = default if p[1] == 0 else 0.0 if p[1] < 0 else max(1e-6 * p[1], 1.0 / 60.0)
            rate.due_s = -math.inf
            return accepted
        if command == mavlink.MAV_CMD_CAMERA_TRACK_POINT:
            order = Select(p[0], p[1], p[0], p[1], heard.system)
        elif command == mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE:
            order = Select(min(p[0], p[2]), min(p[1], p[3]), max(p[0], p[2]), max(p[1], p[3]), heard.system)
        elif command == mavlink.MAV_CMD_CAMERA_STOP_TRACKING:
            self.counters["stops"] += 1
            return accepted if self._obey(Stop(heard.system)) else mavlink.MAV_RESULT_FAILED
        else:
            return None
        inside = all(0.0 <= value <= 1.0 for value in (order.left, order.top, order.right, order.bottom))  # NaN is not
        flat = not order.is_point and (order.left == order.right or order.top == order.bottom)
        if not inside or flat or (order.is_point and command == mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE):
            self.counters["refused.box"] += 1
            return denied
        self.counters["selections"] += 1
        self.shown.mode_point = order.is_point
        return accepted if self._obey(order) else mavlink.MAV_RESULT_FAILED

    def _answer(self, command: int, p: tuple[float, ...], result: int) -> None:
        """Send what a command asked for, after its ACK."""
        if result != mavlink.MAV_RESULT_ACCEPTED:
            return
        if command in _REQUESTS or command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            self._tell(self._requested(command, p))
        elif command != mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.tell_now()

    def _requested(self, command: int, p: tuple[float, ...]) -> str:
        return _REQUESTS.get(command) or _kind(p[0])

    def _known(self) -> frozenset[str]:
        streams = ("VIDEO_STREAM_INFORMATION", "VIDEO_STREAM_STATUS") if self._stream is not None else ()
        return frozenset(("CAMERA_INFORMATION", "CAMERA_SETTINGS", *self._rates, *streams))

    def _tell(self, kind: str) -> None:
        if self._link.send(getattr(self, f"_{kind.lower()}")()):
            self.counters["statuses"] += kind in _DEFAULT_HZ

    def _camera_information(self) -> Any:
        flags = mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
        flags |= mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
        if self._stream is not None:
            flags |= mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
        major, minor, patch = self._version
        return mavlink.MAVLink_camera_information_message(
            self.shown.boot_ms,
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
        return mavlink.MAVLink_camera_settings_message(self.shown.boot_ms, mavlink.CAMERA_MODE_VIDEO)

    def _video_stream_information(self) -> Any:
        assert self._stream is not None
        rtsp = self._stream.kind == "rtsp"
        hfov = self.fov[0]
        # MAVLink has no type for MJPEG over HTTP: the uri says what it is, and the encoding is told as unknown.
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
        shown = self.shown
        mode = mavlink.CAMERA_TRACKING_MODE_RECTANGLE
        if shown.state == "idle":
            mode = mavlink.CAMERA_TRACKING_MODE_NONE
        elif shown.mode_point:
            mode = mavlink.CAMERA_TRACKING_MODE_POINT
        x, y, box = NAN, NAN, (NAN,) * 4
        # Off the picture there is no box: where it is thought to be, the geo status tells.
        if shown.centre is not None and shown.half is not None and all(0.0 <= c <= 1.0 for c in shown.centre):
            (x, y), (w, h) = shown.centre, shown.half
            box = (max(x - w, 0.0), max(y - h, 0.0), min(x + w, 1.0), min(y + h, 1.0))
        return mavlink.MAVLink_camera_tracking_image_status_message(
            _STATUS[shown.state], mode, mavlink.CAMERA_TRACKING_TARGET_DATA_IN_STATUS, x, y, NAN, *box
        )

    def _camera_tracking_geo_status(self) -> Any:
        shown = self.shown
        latitude, longitude, altitude = _scaled(shown.geo)
        north, east = shown.velocity or (NAN, NAN)
        return mavlink.MAVLink_camera_tracking_geo_status_message(
            _STATUS[shown.state],
            latitude,
            longitude,
            altitude,
            shown.h_acc,
            NAN,
            north,
            east,
            0.0 if shown.velocity else NAN,
            NAN,
            shown.distance,
            shown.course,
            NAN,
        )

    def _camera_fov_status(self) -> Any:
        shown, (hfov, vfov) = self.shown, self.fov
        camera, image = _scaled(shown.camera), _scaled(shown.looking)
        heights = [round(1e3 * place[2]) if place[0] != _UNKNOWN_INT else _UNKNOWN_INT for place in (camera, image)]
        return mavlink.MAVLink_camera_fov_status_message(
            shown.boot_ms,
            *camera[:2],
            heights[0],
            *image[:2],
            heights[1],
            shown.quaternion or [NAN] * 4,
            hfov,
            vfov,
        )

    def _acknowledge(self, message: Any, heard: Heard, result: int) -> None:
        self._link.send(
            mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, heard.system, heard.component)
        )


@dataclass(frozen=True, slots=True)
class _Answered:
    command: int
    parameters: tuple[float, ...]
    result: int
    at_s: float = field(default=-math.inf)

    def same(self, message: Any, parameters: tuple[float, ...]) -> bool:
        return bool(self.command == message.command and repr(self.parameters) == repr(parameters))


def message_repeats(message: Any) -> bool:
    """Whether the sender says that it says this again."""
    return int(getattr(message, "confirmation", 0)) > 0


_STATUS = {
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
"""Commands of before MAV_CMD_REQUEST_MESSAGE, which stations still send."""


def _parameters(message: Any) -> tuple[float, ...]:
    if message.get_type() == "COMMAND_INT":
        return (message.param1, message.param2, message.param3, message.param4, float(message.x), float(message.y))
    return (message.param1, message.param2, message.param3, message.param4, message.param5, message.param6)


def _kind(number: float) -> str:
    """The name of a message id that came as a float; "" for none."""
    kind = mavlink.mavlink_map.get(int(number)) if math.isfinite(number) and number == int(number) else None
    return "" if kind is None else str(kind.msgname)


def _scaled(geo: tuple[float, float, float] | None) -> tuple[int, int, float]:
    """1e-7 degrees and metres; the greatest integer and NaN where unknown."""
    if geo is None:
        return _UNKNOWN_INT, _UNKNOWN_INT, NAN
    return round(1e7 * geo[0]), round(1e7 * geo[1]), geo[2]
