"""The images of a UAV agent in a Syncline log, as a frame source for `track`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.video_file import VideoPlayback
from edge.uav.estimator import decode_image
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, UAV_INFO

_FPS = 30.0  # where the log does not tell


class LoggedFlightImages:
    """Images of the agent and boot with the most images. lens, body_from_camera: as known to that agent.

    count: images in the log. repaired: images that cannot be decoded, or whose time does not increase.
    """

    def __init__(self, log: Path, *, fps: float | None = None, intrinsics: Intrinsics | None = None) -> None:
        if not log.exists():
            raise InputError("this log does not exist", file=log, remedy="check the path")
        self._reader = LogReader(log)
        names = Counter(_name(logged.message) for logged in self._reader.messages([FLIGHT_IMAGE]))
        if not names:
            what = "this log contains no flight images"
            raise InputError(what, file=log, remedy="give the video, or record a UAV agent with [images]")
        self._chosen, self.count = names.most_common(1)[0]
        self._info: pb.UavInfo | None = None
        for logged in self._reader.messages([UAV_INFO]):
            message: Any = logged.message
            if _name(message) == self._chosen:
                self._info = message
                break
        self._given_fps = fps
        self.lens = intrinsics or _lens(self._info)
        self.body_from_camera = _mounting(self._info)
        self._frames: Iterator[Frame] | None = None
        self._first: Frame | None = None
        self._pending: Frame | None = None
        self.repaired = 0

    @property
    def info(self) -> DeviceInfo:
        """Device information, with the size of the first image."""
        if self._first is None:
            raise RuntimeError("open the log first")
        height, width = self._first.image.shape[:2]
        known = self._info.fps if self._info is not None and self._info.fps > 0.0 else _FPS
        return DeviceInfo(width, height, self._given_fps or known, "log", "stream", self.lens, unknown=("exposure",))

    @property
    def ended(self) -> bool:
        """True after the last image."""
        return self._frames is None

    @property
    def first_s(self) -> float:
        """Camera time of the first image [s]."""
        return 0.0 if self._first is None else self._first.device_time_ns / NANOSECONDS

    def open(self) -> None:
        """Start reading at the first image. Raises InputError if none can be decoded."""
        self._frames = self._read()
        self._first = next(self._frames, None)
        if self._first is None:
            raise InputError("no image of this log can be decoded", remedy="give the video itself")
        self._pending = self._first

    def read(self, timeout_s: float) -> Frame | None:
        """The next image; None after the last."""
        if self._pending is not None:
            frame, self._pending = self._pending, None
            return frame
        following = None if self._frames is None else next(self._frames, None)
        if following is None:
            self._frames = None
        return following

    def close(self) -> None:
        """May be called twice."""
        self._frames = None

    def _read(self) -> Iterator[Frame]:
        newest = -1
        shape: tuple[int, ...] | None = None
        for logged in self._reader.messages([FLIGHT_IMAGE]):
            message: Any = logged.message
            if _name(message) != self._chosen:
                continue
            image = decode_image(message)
            if image is None or message.device_time_ns <= newest or image.shape != (shape or image.shape):
                self.repaired += 1
                continue
            newest, shape = message.device_time_ns, image.shape
            yield Frame(image, message.device_time_ns, message.frame)


def open_recording(
    video: Path, fps: float | None, intrinsics: Intrinsics | None
) -> tuple[VideoPlayback | LoggedFlightImages, int | None]:
    """Open a video file, a folder of images or a log; returns it and, for a log, its number of images, else None."""
    if video.suffix.lower() != ".mcap":
        recording = VideoPlayback(video, fps=fps, intrinsics=intrinsics)
        recording.open()
        return recording, None
    logged = LoggedFlightImages(video, fps=fps, intrinsics=intrinsics)
    logged.open()
    return logged, logged.count


def _name(message: Any) -> tuple[str, str]:
    return message.agent, message.boot_id


def _lens(info: pb.UavInfo | None) -> Intrinsics | None:
    if info is None or not info.matrix:
        return None
    distortions = np.array(info.distortions) if info.distortions else np.zeros(5)
    return Intrinsics(info.width, info.height, np.array(info.matrix).reshape(3, 3), distortions, info.fisheye)


def _mounting(info: pb.UavInfo | None) -> Floats | None:
    return np.array(info.body_from_camera).reshape(3, 3) if info is not None and info.body_from_camera else None
