"""A MAVLink camera component: answers the commands of ground stations, and sends its status."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from edge.mavlink.dialect import AUTOPILOT, CAMERA, camera_heartbeat, mavlink, message_name
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.roles.camera_messages import STREAM_ID, UNKNOWN_INT, CameraMessages, TrackingStatus, VideoStream
from edge.mavlink.roles.message_rates import MessageRates
from protocols.geometry.camera import Intrinsics

_HELD_S = 0.5  # a shorter absence is no news
_PAUSE_S = 2.0  # between texts of a target that comes and goes
_TEXTS = {
    "visible": ("Syncline: target found again", mavlink.MAV_SEVERITY_NOTICE),
    "coasting": ("Syncline: target not seen, position predicted", mavlink.MAV_SEVERITY_NOTICE),
    "lost": ("Syncline: target lost, select it again", mavlink.MAV_SEVERITY_WARNING),
    "idle": ("Syncline: tracking stopped", mavlink.MAV_SEVERITY_NOTICE),
}
_STARTED = ("Syncline: tracking started", mavlink.MAV_SEVERITY_NOTICE)
StatusText = tuple[str, int]
"""At most 50 characters, and a MAV_SEVERITY."""
MESSAGE_TYPES = ("HEARTBEAT", "COMMAND_LONG", "COMMAND_INT", "PARAM_REQUEST_LIST")
_HEARTBEAT_S = 1.0  # of every MAVLink component
_REPEAT_WINDOW_S = 2  # s within which identical commands are retransmissions of the station
_DEFAULT_HZ = {"CAMERA_TRACKING_IMAGE_STATUS": 10.0, "CAMERA_TRACKING_GEO_STATUS": 5.0, "CAMERA_FOV_STATUS": 1.0}
_REQUESTS = {
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: "CAMERA_INFORMATION",
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: "CAMERA_SETTINGS",
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: "VIDEO_STREAM_INFORMATION",
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: "VIDEO_STREAM_STATUS",
}
"""Commands from before MAV_CMD_REQUEST_MESSAGE, which stations still send."""
_TRACKING = {
    mavlink.MAV_CMD_CAMERA_TRACK_POINT: 3,
    mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE: 4,
    mavlink.MAV_CMD_CAMERA_STOP_TRACKING: 0,
}
_CAMERA_ID = _TRACKING | {mavlink.MAV_CMD_VIDEO_START_STREAMING: 1, mavlink.MAV_CMD_VIDEO_STOP_STREAMING: 1}
"""Index of the parameter "Target Camera ID", by command."""


class StatusTexts:
    """One text for each change of the target's state that lasts."""

    def __init__(self) -> None:
        self._announced = self._state = "idle"
        self._since_s = self._sent_s = -math.inf
        self._operator: int | None = None

    def select(self, station: int) -> StatusText | None:
        """A station has selected a target. The text if it took over from another one."""
        previous, self._operator = self._operator, station
        tracking, self._announced = self._announced != "idle", "idle"
        if previous is None or previous == station or not tracking:
            return None
        return f"Syncline: station {station} took over from {previous}", mavlink.MAV_SEVERITY_NOTICE

    def stop(self, station: int) -> StatusText | None:
        """A station stops tracking. The text if another one had selected the target."""
        previous, self._operator = self._operator, None
        if previous in (None, station) or self._announced in ("idle", "lost"):
            return None
        return f"Syncline: station {station} stops what {previous} tracks", mavlink.MAV_SEVERITY_NOTICE

    def update(self, state: str, now_s: float) -> StatusText | None:
        """The text that is due. state: as in ``TrackingStatus``."""
        if state != self._state:
            self._state, self._since_s = state, now_s
        if state == self._announced:
            return None
        starts = self._announced == "idle"
        brief = now_s - self._since_s < _HELD_S or now_s - self._sent_s < _PAUSE_S
        if not starts and state not in ("idle", "lost") and brief:
            return None
        self._announced, self._sent_s = state, now_s
        if state == "idle":
            self._operator = None
        return _STARTED if starts and state != "lost" else _TEXTS[state]


@dataclass(frozen=True, slots=True)
class SelectTarget:
    """Command to track the target in a box or at a point.

    left, top, right, bottom: fractions of the image; both corners are equal for a point. by: the sender's system id.
    radius: of a point, as a fraction of the image's width; 0 where none was given.
    """

    left: float
    top: float
    right: float
    bottom: float
    by: int
    radius: float = 0.0

    @property
    def is_point(self) -> bool:
        """Whether only a point was given."""
        return self.left == self.right and self.top == self.bottom


@dataclass(frozen=True, slots=True)
class StopTracking:
    """Command to stop tracking."""

    by: int


@dataclass(frozen=True, slots=True)
class ArmFollow:
    """Command to follow the target with the vehicle, or to stop following."""

    follow: bool
    by: int


OperatorCommand = SelectTarget | StopTracking | ArmFollow


class CameraComponent:
    """The camera component on one link. size: (width, height) [px]; lens: None where not calibrated.

    stream: None without video. on_command: called with an operator's command; whether it was accepted.
    stations: system ids that may send commands; empty: all.
    """

    def __init__(
        self,
        link: Link,
        size: tuple[int, int],
        fps: float,
        lens: Intrinsics | None,
        stream: VideoStream | None,
        on_command: Callable[[OperatorCommand], bool],
        *,
        stations: frozenset[int] = frozenset(),
        version: tuple[int, int, int] = (0, 1, 0),
    ) -> None:
        self._link, self._on_command, self._stations = link, on_command, stations
        self._messages = CameraMessages(size, fps, lens, stream, version)
        streams = ("VIDEO_STREAM_INFORMATION", "VIDEO_STREAM_STATUS") if stream is not None else ()
        self._available = frozenset(("CAMERA_INFORMATION", "CAMERA_SETTINGS", *_DEFAULT_HZ, *streams))
        self._has_stream = stream is not None
        self.counters: Counter[str] = Counter()
        self._beat_s = -math.inf
        self._rates = MessageRates(_DEFAULT_HZ)
        self._texts = StatusTexts()
        self._last: dict[tuple[int, int], _AcknowledgedCommand] = {}

    @property
    def status(self) -> TrackingStatus:
        """What is reported of the target and the camera."""
        return self._messages.status

    def handle(self, received: ReceivedMessage, now_s: float) -> None:
        """Handle a message if it addresses the camera."""
        message = received.message
        station = (received.system, received.component)
        if received.kind == "HEARTBEAT" and received.component != AUTOPILOT:
            self._rates.hear(station, now_s, new=message.type == mavlink.MAV_TYPE_GCS)
        if received.kind not in ("COMMAND_LONG", "COMMAND_INT"):
            return
        if message.target_system not in (0, self._link.system) or message.target_component not in (0, CAMERA):
            return
        for_us = message.target_component == CAMERA
        if self._stations and received.system not in self._stations and received.system != self._link.vehicle:
            self.counters["refused.station"] += 1
            if for_us:
                self._acknowledge(message, received, mavlink.MAV_RESULT_DENIED)
            return
        self._rates.hear(station, now_s)
        parameters = _parameters(message)
        last = self._last.get(station)
        if (
            last is not None
            and last.same(message, parameters)
            and now_s - last.at_s < _REPEAT_WINDOW_S
            and int(getattr(message, "confirmation", 0)) > 0  # a retransmission
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
        self._last[station] = _AcknowledgedCommand(message.command, parameters, result, now_s)
        self._acknowledge(message, received, result)
        self._send_response(message.command, parameters, result)

    def tick(self, now_s: float, *, frame: bool) -> None:
        """Send what is due. frame: a new frame has just been processed."""
        # Also before any vehicle is known: the peer of an outgoing link has to learn that this side exists.
        if now_s >= self._beat_s:
            self._beat_s = now_s + _HEARTBEAT_S
            self._link.send(camera_heartbeat())
        if self._link.vehicle is None:
            return
        for kind in _DEFAULT_HZ:
            per_frame = kind != "CAMERA_FOV_STATUS"
            if per_frame and (not frame or self.status.state == "idle"):
                continue
            if self._rates.is_due(kind, now_s):
                self._send_message(kind)
        self._send_text(self._texts.update(self.status.state, now_s))

    def send_status_now(self) -> None:
        """Send the tracking status at once, after a change of state."""
        for kind in ("CAMERA_TRACKING_IMAGE_STATUS", "CAMERA_TRACKING_GEO_STATUS"):
            self._send_message(kind)

    def is_present(self, system: int, now_s: float) -> bool:
        """Whether a station was heard within the last 10 s."""
        return self._rates.is_present(system, now_s)

    def say(self, text: str) -> None:
        """Send a line of at most 50 characters to the stations' message lists."""
        self._send_text((text, mavlink.MAV_SEVERITY_WARNING))

    def _command(self, command: int, p: tuple[float, ...], received: ReceivedMessage) -> Any:
        """Execute one command; its MAV_RESULT, None where it is not for a camera."""
        accepted, denied = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
        if command in _CAMERA_ID and not (math.isnan(p[_CAMERA_ID[command]]) or p[_CAMERA_ID[command]] in (0, CAMERA)):
            return denied if received.message.target_component == CAMERA else None  # for another camera
        if command in _REQUESTS or command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            kind = self._requested(command, p)
            if kind not in self._available:
                return None
            stream = p[0] if command in _REQUESTS else p[1]
            return accepted if not kind.startswith("VIDEO_STREAM") or stream in (0, STREAM_ID) else denied
        if command in (mavlink.MAV_CMD_VIDEO_START_STREAMING, mavlink.MAV_CMD_VIDEO_STOP_STREAMING):
            # The stream is always there, and costs nothing while nobody opens it: one station cannot end another's.
            return None if not self._has_stream else accepted if p[0] in (0, STREAM_ID) else denied
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            kind = message_name(p[0])
            if kind not in _DEFAULT_HZ:
                return None
            if not math.isfinite(p[1]):
                return denied
            self._rates.set_interval((received.system, received.component), kind, p[1])
            return accepted
        if command == mavlink.MAV_CMD_CAMERA_TRACK_POINT:
            radius = p[2] if 0.0 < p[2] <= 1.0 else 0.0  # NaN is not
            selection = SelectTarget(p[0], p[1], p[0], p[1], received.system, radius)
        elif command == mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE:
            selection = SelectTarget(
                min(p[0], p[2]), min(p[1], p[3]), max(p[0], p[2]), max(p[1], p[3]), received.system
            )
        elif command == mavlink.MAV_CMD_DO_FOLLOW:
            if received.message.target_component != CAMERA:
                return None  # a broadcast is the autopilot's own follow-me
            by_station = math.isfinite(p[0]) and received.system != self._link.vehicle
            return accepted if by_station and self._on_command(ArmFollow(p[0] > 0, received.system)) else denied
        elif command == mavlink.MAV_CMD_CAMERA_STOP_TRACKING:
            self.counters["stops"] += 1
            return accepted if self._stop(received.system) else mavlink.MAV_RESULT_FAILED
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
        if not self._on_command(selection):
            return mavlink.MAV_RESULT_FAILED
        self.status.mode_point = selection.is_point
        self._rates.select((received.system, received.component))
        self._send_text(self._texts.select(received.system))
        return accepted

    def _stop(self, station: int) -> bool:
        stopped = self._on_command(StopTracking(station))
        self._send_text(self._texts.stop(station) if stopped else None)
        return stopped

    def _send_response(self, command: int, p: tuple[float, ...], result: int) -> None:
        """Send the data that a command requested, after its ACK."""
        if result != mavlink.MAV_RESULT_ACCEPTED:
            return
        if command in _REQUESTS or command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            kind = self._requested(command, p)
            self._send_message(kind)
            if kind == "VIDEO_STREAM_STATUS":
                # MAVSDK asks for this one first, and for the stream's address only 20 s later.
                self._send_message("VIDEO_STREAM_INFORMATION")
        elif command in _TRACKING:
            self.send_status_now()

    def _requested(self, command: int, p: tuple[float, ...]) -> str:
        return _REQUESTS.get(command) or message_name(p[0])

    def _send_message(self, kind: str) -> None:
        if self._link.send(self._messages.build(kind)):
            self.counters["statuses"] += kind in _DEFAULT_HZ

    def _send_text(self, text: StatusText | None) -> None:
        if text is not None:
            self._link.send(mavlink.MAVLink_statustext_message(text[1], text[0].encode()[:50]))

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


def _parameters(message: Any) -> tuple[float, ...]:
    if message.get_type() == "COMMAND_INT":
        x, y = (math.nan if value == UNKNOWN_INT else float(value) for value in (message.x, message.y))
        return message.param1, message.param2, message.param3, message.param4, x, y
    return (message.param1, message.param2, message.param3, message.param4, message.param5, message.param6)
