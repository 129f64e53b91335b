"""The images of a UAV agent in a Syncline log, as a frame source for `track`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.video_file import Playback, VideoPlayback
from edge.uav.estimator import decode_image
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, UAV_INFO

_FPS = 30.0  # where the log does not tell


class LoggedFlightImages(Playback):
    """Images of the agent and boot with the most images. lens, body_from_camera: as known to that agent.

    source: that agent and boot. count: images in the log. first_s: camera time of the first image [s].
    Raises InputError if the log has no image that can be decoded.
    """

    def __init__(self, log: Path, *, fps: float | None = None, intrinsics: Intrinsics | None = None) -> None:
        super().__init__()
        if not log.exists():
            raise InputError("this log does not exist", file=log, remedy="check the path")
        self._reader = LogReader(log)
        names = Counter(_name(logged.message) for logged in self._reader.messages([FLIGHT_IMAGE]))
        if not names:
            what = "this log contains no flight images"
            raise InputError(what, file=log, remedy="give the video, or record a UAV agent with [images]")
        self.source, self.count = names.most_common(1)[0]
        known: pb.UavInfo | None = None
        for logged in self._reader.messages([UAV_INFO]):
            message: Any = logged.message
            if _name(message) == self.source:
                known = message
                break
        self.lens = intrinsics or (None if known is None else Intrinsics.of_message(known))
        self.body_from_camera = _mounting(known)
        self._left_out = 0
        self._frames = self._read()
        self._pending = first = next(self._frames, None)
        if first is None:
            raise InputError("no image of this log can be decoded", remedy="give the video itself")
        self.first_s = first.device_time_ns / NANOSECONDS
        height, width = first.image.shape[:2]
        rate = fps or (known.fps if known is not None and known.fps > 0.0 else _FPS)
        self._info = DeviceInfo(width, height, rate, "log", "stream", self.lens, unknown=("exposure",))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of the log so far, one line each."""
        damage, left_out = self._reader.damage, self._left_out
        return (
            *((f"damaged: {damage}; only its intact part was tracked",) if damage else ()),
            *((f"{left_out} images cannot be decoded, or their times do not increase: left out",) if left_out else ()),
        )

    def _read(self) -> Iterator[Frame]:
        newest = -1
        shape: tuple[int, ...] | None = None
        for logged in self._reader.messages([FLIGHT_IMAGE]):
            message: Any = logged.message
            if _name(message) != self.source:
                continue
            image = decode_image(message)
            if image is None or message.device_time_ns <= newest or image.shape != (shape or image.shape):
                self._left_out += 1
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
    return logged, logged.count


def _name(message: Any) -> tuple[str, str]:
    return message.agent, message.boot_id


def _mounting(info: pb.UavInfo | None) -> Floats | None:
    return np.array(info.body_from_camera).reshape(3, 3) if info is not None and info.body_from_camera else None
