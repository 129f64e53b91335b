"""The pictures of one camera in a recorded log, played by the capture times that the camera gave them.

What a recorder keeps are small pictures, a few a second (``pictures_hz``), and a UAV agent's at their full size: what
is seen in them is told in their own pixels, and the lens is scaled to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from edge.devices.base import DeviceInfo, Frame, Image, check_size
from edge.devices.playback.playback_clock import Pace
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.log.read.images import PictureRun, picture_runs, pictures
from protocols.log.read.reader import LogReader
from protocols.log.write.thumbnails import Scale
from protocols.messages import syncline_pb2 as pb


class LoggedCamera:
    """One camera's pictures in a log; see ``edge.devices.base.Device``.

    log: a file, or the folder of its parts; of a damaged one, what is whole. camera: as the log names it; of its runs
    the one with the most pictures is played. pace: a clock by which they are played in real time; None = as fast as
    they are read. intrinsics: of the camera, at its full size or at the pictures'; None = what the log tells.

    damage: what is wrong with the log, known once it is open; "" if nothing.
    skipped: pictures that were none, were of another size, or whose time did not increase.
    """

    def __init__(
        self, log: Path, camera: str, *, pace: Pace | None = None, intrinsics: Intrinsics | None = None
    ) -> None:
        self._log, self._camera, self._pace, self._given = log, camera, pace, intrinsics
        self._info: DeviceInfo | None = None
        self._frames: Iterator[Frame] = iter(())
        self._pending: Frame | None = None
        self._started: float | None = None  # pace time of device time 0
        self._closed = False
        self._full = (0, 0)
        self.damage = ""
        self.skipped = 0

    @property
    def info(self) -> DeviceInfo:
        """Size of the pictures; their usual rate."""
        if self._info is None:
            raise RuntimeError("open the log first")
        return self._info

    @property
    def ended(self) -> bool:
        """True after the last picture."""
        return self._closed or (self._info is not None and self._pending is None)

    def open(self) -> None:
        """Raises InputError where the log cannot be read or has no pictures of this camera. Opened again: nothing."""
        if self._info is not None:
            return
        if not self._log.exists():
            raise InputError("this log does not exist", file=self._log, remedy="check the path")
        reader = LogReader(self._log)
        runs = picture_runs(reader)
        self.damage = reader.damage
        mine = [run for run in runs if run.camera == self._camera]
        if not mine:
            others = ", ".join(dict.fromkeys(run.camera for run in runs))
            what = f"no pictures of {self._camera} in this log"
            remedy = "choose one of these as camera" if others else "record with pictures_hz above 0"
            what += f", only of {others}" if others else ", and of no other camera"
            raise InputError(what, file=self._log, remedy=remedy)
        run = max(mine, key=lambda one: len(one.times_ns))
        self._frames = self._read(reader, run)
        self._pending = next(self._frames, None)
        if self._pending is None:
            raise InputError(f"no picture of {self._camera} can be decoded", file=self._log, remedy="give another log")
        height, width = self._pending.image.shape[:2]
        info = run.info
        lens = self._given if self._given is not None else _lens(info)
        if lens is not None and (lens.width, lens.height) == self._full != (width, height):
            lens = _scaled(lens, width, height)
        check_size(lens, width, height, str(self._log))
        readout = 0.0 if info is None else info.readout_s
        # Not the recorded kind of clock: to the agent these are time stamps in a file, not this machine's clock.
        self._info = DeviceInfo(width, height, _rate(run), "log", "stream", lens, readout, ("exposure",))

    def read(self, timeout_s: float) -> Frame | None:
        """The next picture, once its time has come."""
        if self._pending is None or self._closed:
            return None
        if self._pace is not None:
            moment = self._pending.device_time_ns / NANOSECONDS
            if self._started is None:
                self._started = self._pace.now() - moment
            wait = self._started + moment - self._pace.now()
            if wait > timeout_s:
                self._pace.sleep(timeout_s)
                return None
            self._pace.sleep(wait)
        frame, self._pending = self._pending, next(self._frames, None)
        return frame

    def close(self) -> None:
        """May be called twice."""
        self._closed = True

    def _read(self, reader: LogReader, run: PictureRun) -> Iterator[Frame]:
        newest: int | None = None
        shape: tuple[int, ...] | None = None
        for picture in pictures(reader, run):
            image = _decoded(picture.jpeg)
            late = newest is not None and picture.device_time_ns <= newest
            if image is None or late or image.shape != (shape or image.shape):
                self.skipped += 1
                continue
            if shape is None:
                self._full = (picture.width, picture.height)
            newest, shape = picture.device_time_ns, image.shape
            yield Frame(image, picture.device_time_ns, picture.frame)


def _decoded(jpeg: bytes) -> Image | None:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _lens(info: pb.CameraInfo | None) -> Intrinsics | None:
    """As the camera told it."""
    if info is None or not info.matrix:
        return None
    distortions = np.array(info.distortions) if info.distortions else np.zeros(4 if info.fisheye else 5)
    return Intrinsics(info.width, info.height, np.array(info.matrix).reshape(3, 3), distortions, info.fisheye)


def _scaled(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The same lens in the pixels of a smaller picture of the whole image."""
    scale = Scale(width / lens.width, height / lens.height, width, height)
    return Intrinsics(width, height, scale.matrix() @ lens.matrix, lens.distortions, lens.fisheye)


def _rate(run: PictureRun) -> float:
    """Pictures a second by the usual distance of two [Hz]; 0 = not known."""
    steps = np.diff(np.array(sorted(run.times_ns), dtype=np.float64))
    steps = steps[steps > 0.0]
    return float(NANOSECONDS / np.median(steps)) if len(steps) else 0.0
