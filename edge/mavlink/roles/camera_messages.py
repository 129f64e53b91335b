"""The messages of a MAVLink camera component: camera and stream information, tracking and field-of-view status.

MAVLink's units and conventions are confined to this module: image coordinates 0 … 1, 1e-7 degrees, INT32_MAX and NaN
for "not available".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from edge.mavlink.dialect import mavlink
from protocols.geometry.camera import Intrinsics

NAN = float("nan")
UNKNOWN_INT = 0x7FFFFFFF  # INT32_MAX: the protocol's "not known"
_MAX_ALTITUDE_M = 2e6  # more does not fit into millimetres of 32 bits
_MODEL = b"Syncline UAV tracker"
STREAM_ID = 1
"""Id of the only video stream."""


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


class CameraMessages:
    """Builds the messages of one camera from its ``status``; ``build`` by the message's name.

    size: (width, height) [px]; lens: None where not calibrated. stream: None without video. version: of the software.
    """

    def __init__(
        self,
        size: tuple[int, int],
        fps: float,
        lens: Intrinsics | None,
        stream: VideoStream | None,
        version: tuple[int, int, int],
    ) -> None:
        self._size, self._fps, self._lens, self._stream, self._version = size, fps, lens, stream, version
        self.status = TrackingStatus()

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

    def build(self, kind: str) -> Any:
        """The message of a type, with the present values."""
        return getattr(self, f"_{kind.lower()}")()

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
        return mavlink.MAVLink_camera_settings_message(self.status.boot_ms, mavlink.CAMERA_MODE_VIDEO, NAN, NAN)

    def _video_stream_information(self) -> Any:
        assert self._stream is not None
        rtsp = self._stream.kind == "rtsp"
        hfov = self.fov[0]
        # MAVLink has no type for MJPEG over HTTP: the uri identifies it, and the encoding is reported as unknown.
        return mavlink.MAVLink_video_stream_information_message(
            STREAM_ID,
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
            STREAM_ID,
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
        x, y, radius, box = NAN, NAN, NAN, (NAN,) * 4
        flags = _STATUS_FLAGS[status.state]
        # Outside the image there is no box; the geo status reports the predicted position.
        if status.centre is not None and status.half_size is not None and all(0.0 <= c <= 1.0 for c in status.centre):
            (x, y), (w, h) = status.centre, status.half_size
            radius = max(w, h * self._size[1] / self._size[0])  # of the image's width
            box = (max(x - w, 0.0), max(y - h, 0.0), min(x + w, 1.0), min(y + h, 1.0))
        elif status.state == "visible":
            # QGroundControl draws the box while the flags are ACTIVE alone, also one of NaN.
            flags = _STATUS_FLAGS["coasting"]
        return mavlink.MAVLink_camera_tracking_image_status_message(
            flags, mode, mavlink.CAMERA_TRACKING_TARGET_DATA_IN_STATUS, x, y, radius, *box
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
        heights = [round(1e3 * place[2]) if place[0] != UNKNOWN_INT else UNKNOWN_INT for place in (camera, image)]
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


_STATUS_FLAGS = {
    "idle": mavlink.CAMERA_TRACKING_STATUS_FLAGS_IDLE,
    "visible": mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
    "coasting": mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE | mavlink.CAMERA_TRACKING_STATUS_FLAGS_COASTING,
    "lost": mavlink.CAMERA_TRACKING_STATUS_FLAGS_ERROR,
}


def _scaled_position(geo: tuple[float, float, float] | None) -> tuple[int, int, float]:
    """Latitude, longitude in 1e-7 degrees and altitude [m]; INT32_MAX and NaN where unknown or impossible."""
    if geo is None or not (abs(geo[0]) <= 90.0 and abs(geo[1]) <= 180.0 and abs(geo[2]) < _MAX_ALTITUDE_M):
        return UNKNOWN_INT, UNKNOWN_INT, NAN
    return round(1e7 * geo[0]), round(1e7 * geo[1]), geo[2]
