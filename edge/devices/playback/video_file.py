"""Playback of a video file or an image folder through OpenCV."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np

from edge.devices.base import DeviceInfo, Frame, check_size
from edge.devices.playback.playback_clock import PlaybackClock, wait_until
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Image

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
FOLDER_FPS = 30.0
"""Default frame rate of an image folder [Hz]."""


def check_recording(path: Path) -> None:
    """Raise InputError unless ``path`` is a regular file or a folder: a pipe that nobody writes to is waited for."""
    if not path.exists():
        raise InputError("this video does not exist", file=path, remedy="check the path")
    if not path.is_file() and not path.is_dir():
        raise InputError("is not a regular file", file=path, remedy="give a video file, or a folder of images")


def image_files(folder: Path) -> list[Path]:
    """The images in a folder, by name, numbers by value (2.png before 10.png). Raises InputError if there are none."""
    files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    files.sort(key=lambda file: ([int(x) if x.isdecimal() else x for x in re.split(r"(\d+)", file.name)], file.name))
    if not files:
        kinds = ", ".join(sorted(IMAGE_SUFFIXES))
        raise InputError("no images in this folder", file=folder, remedy=f"put {kinds} files in it")
    return files


def read_image(file: Path) -> Image | None:
    """The image (h, w, 3) BGR of a file; None if it cannot be decoded or is larger than OpenCV's limit."""
    try:
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


class VideoPlayback:
    """Plays a video file or a folder of images as a device.

    Frame times of a file are the container's presentation times, so that a variable frame rate is kept. A frame whose
    time does not increase (broken or missing time stamp) is placed one nominal period after its predecessor and counted
    in ``repaired``. Images of a folder are 1/``fps`` apart. The time of the first frame is that in the file, mostly 0.
    """

    def __init__(
        self,
        path: Path,
        *,
        fps: float | None = None,
        loop: bool = False,
        playback_clock: PlaybackClock | None = None,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        self._path = path
        self._given_fps = fps
        self._loop = loop
        self._playback_clock = playback_clock
        self._intrinsics = intrinsics
        self._image_files: list[Path] | None = None
        self._capture: cv2.VideoCapture | None = None
        self._info: DeviceInfo | None = None
        self._pending: Image | None = None
        self._frame = 0
        self._file_index = 0
        self._time = -math.inf  # [s] of the last frame
        self._loop_offset = 0.0  # [s] added by loops
        self._start_s: float | None = None  # playback clock time of device time 0
        self.ended = False
        self.repaired = 0

    @property
    def info(self) -> DeviceInfo:
        """Description with the size of the first frame; the exposure is not known."""
        if self._info is None:
            raise RuntimeError("open the recording first")
        return self._info

    def open(self) -> None:
        """Raises InputError if no frame can be read."""
        self._pending = self._rewind()
        fps = self._given_fps or (FOLDER_FPS if self._capture is None else self._capture.get(cv2.CAP_PROP_FPS))
        if not (math.isfinite(fps) and fps > 0.0):
            raise InputError("the video states no frame rate", file=self._path, remedy="give its fps")
        height, width = self._pending.shape[:2]
        check_size(self._intrinsics, width, height, str(self._path))
        driver = "video" if self._capture is not None else "images"
        self._info = DeviceInfo(width, height, float(fps), driver, "stream", self._intrinsics, unknown=("exposure",))

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, once it is due on the playback clock."""
        if self.ended or self._info is None:
            return None
        if self._pending is None and not self._advance():
            self.ended = True
            return None
        assert self._pending is not None
        time_s = self._next_time()
        if self._playback_clock is not None:
            if self._start_s is None:
                self._start_s = self._playback_clock.now() - time_s
            if not wait_until(self._playback_clock, self._start_s + time_s, timeout_s):
                return None
        frame = Frame(self._pending, round(time_s * NANOSECONDS), self._frame)
        self.repaired += time_s != self._container_time()
        self._time = time_s
        self._frame += 1
        self._file_index += 1
        self._pending = None
        return frame

    def close(self) -> None:
        """Release the file."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None
        self.ended = True

    def _rewind(self) -> Image:
        """(Re)open the source and return the first frame."""
        self._file_index = 0
        check_recording(self._path)
        if self._path.is_dir():
            self._image_files = image_files(self._path)
            return self._read_image(0)
        if self._capture is not None:
            self._capture.release()
        self._capture = cv2.VideoCapture(str(self._path))
        ok, image = self._capture.read() if self._capture.isOpened() else (False, None)
        if not ok or image is None:
            remedy = "check that it is a video this machine can decode (try another player, or convert it to mp4)"
            raise InputError("no frame can be read from this file", file=self._path, remedy=remedy)
        return np.asarray(image, dtype=np.uint8)

    def _advance(self) -> bool:
        """Decode the next frame into ``_pending``; False at the end."""
        if self._image_files is not None:
            if self._file_index < len(self._image_files):
                self._pending = self._read_image(self._file_index)
                return True
        elif self._capture is not None:
            ok, image = self._capture.read()
            if ok and image is not None:
                self._pending = np.asarray(image, dtype=np.uint8)
                return True
        if not self._loop or self._info is None:
            return False
        self._loop_offset = self._time + 1.0 / self._info.fps
        self._pending = self._rewind()
        return True

    def _read_image(self, index: int) -> Image:
        assert self._image_files is not None
        image = read_image(self._image_files[index])
        if image is None:
            remedy = "remove or replace it"
            raise InputError("this image cannot be read", file=self._image_files[index], remedy=remedy)
        if self._info is not None and image.shape[:2] != (self._info.height, self._info.width):
            size = f"{image.shape[1]}x{image.shape[0]}"
            remedy = "keep images of one size in a folder"
            raise InputError(
                f"this image is {size}, the first one is not", file=self._image_files[index], remedy=remedy
            )
        return image

    def _container_time(self) -> float:
        """The pending frame's time [s] from the container or the given rate."""
        if self._capture is None or self._given_fps is not None:
            return self._loop_offset + self._file_index / self.info.fps
        # After a read, this is the presentation time of the frame that was read.
        return self._loop_offset + self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3

    def _next_time(self) -> float:
        stamped = self._container_time()
        if math.isfinite(stamped) and stamped > self._time:
            return stamped
        return (self._time if math.isfinite(self._time) else 0.0) + 1.0 / self.info.fps
