"""The pictures of a UAV agent in a Syncline log, as a recording that `track` reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.video_file import Recording
from edge.uav.estimator import decoded
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, UAV_INFO

_FPS = 30.0


class LoggedPictures:
    """The agent and boot with the most pictures. lens, body_from_camera: as far as that agent knew them.

    count: pictures in the log. repaired: pictures that are none, or whose time does not increase.
    """

    def __init__(self, log: Path, *, fps: float | None = None, intrinsics: Intrinsics | None = None) -> None:
        if not log.exists():
            raise InputError("this log does not exist", file=log, remedy="check the path")
        self._reader = LogReader(log)
        names = Counter(_name(logged.message) for logged in self._reader.messages([FLIGHT_IMAGE]))
        if not names:
            what = "this log holds no pictures of a flight"
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
        self._pictures: Iterator[Frame] | None = None
        self._first: Frame | None = None
        self._waiting: Frame | None = None
        self.repaired = 0

    @property
    def info(self) -> DeviceInfo:
        """Size of the first picture."""
        if self._first is None:
            raise RuntimeError("open the log first")
        height, width = self._first.image.shape[:2]
        known = self._info.fps if self._info is not None and self._info.fps > 0.0 else _FPS
        return DeviceInfo(width, height, self._given_fps or known, "log", "stream", self.lens, unknown=("exposure",))

    @property
    def ended(self) -> bool:
        """True after the last picture."""
        return self._pictures is None

    @property
    def first_s(self) -> float:
        """The camera's time of the first picture."""
        return 0.0 if self._first is None else self._first.device_time_ns / NANOSECONDS

    def open(self) -> None:
        """From the first picture on."""
        self._pictures = self._read()
        self._first = next(self._pictures, None)
        if self._first is None:
            raise InputError("no picture of this log can be decoded", remedy="give the video itself")
        self._waiting = self._first

    def read(self, timeout_s: float) -> Frame | None:
        """The next picture."""
        if self._waiting is not None:
            frame, self._waiting = self._waiting, None
            return frame
        following = None if self._pictures is None else next(self._pictures, None)
        if following is None:
            self._pictures = None
        return following

    def close(self) -> None:
        """May be called twice."""
        self._pictures = None

    def _read(self) -> Iterator[Frame]:
        newest = -1
        shape: tuple[int, ...] | None = None
        for logged in self._reader.messages([FLIGHT_IMAGE]):
            message: Any = logged.message
            if _name(message) != self._chosen:
                continue
            image = decoded(message)
            if image is None or message.device_time_ns <= newest or image.shape != (shape or image.shape):
                self.repaired += 1
                continue
            newest, shape = message.device_time_ns, image.shape
            yield Frame(image, message.device_time_ns, message.frame)


def open_pictures(
    video: Path, fps: float | None, intrinsics: Intrinsics | None
) -> tuple[Recording | LoggedPictures, int | None]:
    """An opened recording of a file, a folder or a log; and how many pictures it has, None where it must be asked."""
    if video.suffix.lower() != ".mcap":
        recording = Recording(video, fps=fps, intrinsics=intrinsics)
        recording.open()
        return recording, None
    logged = LoggedPictures(video, fps=fps, intrinsics=intrinsics)
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
