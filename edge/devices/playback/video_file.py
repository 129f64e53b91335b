"""Recordings through OpenCV: a video file, or a folder of pictures."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from edge.devices.base import DeviceInfo, Frame, Image, check_size
from edge.devices.playback.playback_clock import Pace
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
FOLDER_FPS = 30.0
"""Frame rate of an image folder that nobody told one of."""


class Recording:
    """A video file or a folder of pictures.

    Frame times of a file are its container's presentation times, so that a variable frame rate is kept; where they
    do not increase (broken or missing time stamps) the frame follows its predecessor by a nominal period, and
    ``repaired`` counts it. Pictures are ``fps`` apart. The time of the first frame is what the file says, mostly 0.
    """

    def __init__(
        self,
        path: Path,
        *,
        fps: float | None = None,
        loop: bool = False,
        pace: Pace | None = None,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        self._path = path
        self._given_fps = fps
        self._loop = loop
        self._pace = pace
        self._intrinsics = intrinsics
        self._pictures: list[Path] | None = None
        self._capture: cv2.VideoCapture | None = None
        self._info: DeviceInfo | None = None
        self._pending: Image | None = None
        self._frame = 0
        self._in_file = 0
        self._time = -math.inf  # [s] of the last frame
        self._shift = 0.0  # [s] added by loops
        self._started: float | None = None  # pace time of time 0
        self._ended = False
        self.repaired = 0

    @property
    def info(self) -> DeviceInfo:
        """Size of the first frame; the exposure is not known."""
        if self._info is None:
            raise RuntimeError("open the recording first")
        return self._info

    @property
    def ended(self) -> bool:
        """True after the last frame."""
        return self._ended

    def open(self) -> None:
        """Raises InputError where there is nothing to read."""
        self._pending = self._rewind()
        fps = self._given_fps or (FOLDER_FPS if self._capture is None else self._capture.get(cv2.CAP_PROP_FPS))
        if not (math.isfinite(fps) and fps > 0.0):
            raise InputError("the video does not tell its frame rate", file=self._path, remedy="give its fps")
        height, width = self._pending.shape[:2]
        check_size(self._intrinsics, width, height, str(self._path))
        driver = "video" if self._capture is not None else "images"
        self._info = DeviceInfo(width, height, float(fps), driver, "stream", self._intrinsics, unknown=("exposure",))

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, once its time has come."""
        if self._ended or self._info is None:
            return None
        if self._pending is None and not self._advance():
            self._ended = True
            return None
        assert self._pending is not None
        moment = self._next_time()
        if self._pace is not None:
            if self._started is None:
                self._started = self._pace.now() - moment
            wait = self._started + moment - self._pace.now()
            if wait > timeout_s:
                self._pace.sleep(timeout_s)
                return None
            self._pace.sleep(wait)
        frame = Frame(self._pending, round(moment * NANOSECONDS), self._frame)
        self.repaired += moment != self._stamped()
        self._time = moment
        self._frame += 1
        self._in_file += 1
        self._pending = None
        return frame

    def close(self) -> None:
        """Release the file."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None
        self._ended = True

    def _rewind(self) -> Image:
        """(Re)open and give the first frame."""
        self._in_file = 0
        if not self._path.exists():
            raise InputError("this video does not exist", file=self._path, remedy="check the path")
        if self._path.is_dir():
            self._pictures = sorted(p for p in self._path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
            if not self._pictures:
                kinds = ", ".join(sorted(IMAGE_SUFFIXES))
                raise InputError("no pictures in this folder", file=self._path, remedy=f"put {kinds} files in it")
            return self._picture(0)
        if self._capture is not None:
            self._capture.release()
        self._capture = cv2.VideoCapture(str(self._path))
        good, image = self._capture.read() if self._capture.isOpened() else (False, None)
        if not good or image is None:
            remedy = "check that it is a video this machine can decode (try another player, or convert it to mp4)"
            raise InputError("no frame can be read from this file", file=self._path, remedy=remedy)
        return np.asarray(image, dtype=np.uint8)

    def _advance(self) -> bool:
        """Fetch the next frame into ``_pending``; False at the end."""
        if self._pictures is not None:
            if self._in_file < len(self._pictures):
                self._pending = self._picture(self._in_file)
                return True
        elif self._capture is not None:
            good, image = self._capture.read()
            if good and image is not None:
                self._pending = np.asarray(image, dtype=np.uint8)
                return True
        if not self._loop or self._info is None:
            return False
        self._shift = self._time + 1.0 / self._info.fps
        self._pending = self._rewind()
        return True

    def _picture(self, index: int) -> Image:
        assert self._pictures is not None
        image = cv2.imread(str(self._pictures[index]), cv2.IMREAD_COLOR)
        if image is None:
            remedy = "remove or replace it"
            raise InputError("this picture cannot be read", file=self._pictures[index], remedy=remedy)
        if self._info is not None and image.shape[:2] != (self._info.height, self._info.width):
            size = f"{image.shape[1]}x{image.shape[0]}"
            remedy = "keep pictures of one size in a folder"
            raise InputError(f"this picture is {size}, the first one is not", file=self._pictures[index], remedy=remedy)
        return np.asarray(image, dtype=np.uint8)

    def _stamped(self) -> float:
        """The pending frame's time [s] as the container or the given rate says."""
        if self._capture is None or self._given_fps is not None:
            return self._shift + self._in_file / self.info.fps
        # After a read, this is the presentation time of the frame that was read.
        return self._shift + self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3

    def _next_time(self) -> float:
        stamped = self._stamped()
        if math.isfinite(stamped) and stamped > self._time:
            return stamped
        return (self._time if math.isfinite(self._time) else 0.0) + 1.0 / self.info.fps
