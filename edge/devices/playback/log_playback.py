"""Playback of one camera's images from a recorded log, by their capture times.

A log holds thumbnails at a few hertz (``pictures_hz``), and the images of a UAV agent at full size. Detections are in
the pixels of the logged images, and the intrinsics are scaled to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edge.devices.base import DeviceInfo, Frame, check_size
from edge.devices.playback.playback_clock import PlaybackClock
from edge.devices.playback.video_file import Playback
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.jpeg import ThumbnailScale, decode_jpeg
from protocols.geometry.camera import Intrinsics
from protocols.log.read.images import ImageRun, image_runs, read_images
from protocols.log.read.reader import LogReader


class LogPlayback(Playback):
    """Plays one camera's images of a log; see ``edge.devices.base.Device``.

    log: a file, or the folder of its parts; of a damaged one the intact part is played. camera: its name in the log; of
    its boots the one with the most images is played. playback_clock: see ``Playback``. intrinsics: of the camera, at
    its full size or that of the images; None = those in the log.

    damage: description of the log's damage, known once it is open; "" if none.
    skipped: images that could not be decoded, had another size, or whose time did not increase.
    """

    def __init__(
        self,
        log: Path,
        camera: str,
        *,
        playback_clock: PlaybackClock | None = None,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        super().__init__(playback_clock)
        self._log, self._camera, self._given_intrinsics = log, camera, intrinsics
        self._full = (0, 0)
        self.damage = ""
        self.skipped = 0

    def open(self) -> None:
        """Raises InputError if the log cannot be read or has no images of this camera. Reopening has no effect."""
        if self._info is not None:
            return
        if not self._log.exists():
            raise InputError("this log does not exist", file=self._log, remedy="check the path")
        reader = LogReader(self._log)
        runs = image_runs(reader)
        self.damage = reader.damage
        of_camera = [run for run in runs if run.camera == self._camera]
        if not of_camera:
            others = ", ".join(dict.fromkeys(run.camera for run in runs))
            what = f"no images of {self._camera} in this log"
            remedy = "choose one of these as camera" if others else "record with pictures_hz above 0"
            what += f", only of {others}" if others else ", and of no other camera"
            raise InputError(what, file=self._log, remedy=remedy)
        run = max(of_camera, key=lambda one: len(one.times_ns))
        self._frames = self._read(reader, run)
        self._pending = next(self._frames, None)
        if self._pending is None:
            raise InputError(f"no image of {self._camera} can be decoded", file=self._log, remedy="give another log")
        height, width = self._pending.image.shape[:2]
        info = run.info
        lens = self._given_intrinsics or (None if info is None else Intrinsics.of_message(info))
        if lens is not None and (lens.width, lens.height) == self._full != (width, height):
            lens = _scaled_intrinsics(lens, width, height)
        check_size(lens, width, height, str(self._log))
        readout = 0.0 if info is None else info.readout_s
        # Not the recorded clock kind: for the agent these are time stamps in a file, not this machine's clock.
        self._info = DeviceInfo(width, height, _median_rate(run), "log", "stream", lens, readout, ("exposure",))

    def _read(self, reader: LogReader, run: ImageRun) -> Iterator[Frame]:
        newest: int | None = None
        shape: tuple[int, ...] | None = None
        for logged in read_images(reader, run):
            image = decode_jpeg(logged.jpeg)
            out_of_order = newest is not None and logged.device_time_ns <= newest
            if image is None or out_of_order or image.shape != (shape or image.shape):
                self.skipped += 1
                continue
            if shape is None:
                self._full = (logged.width, logged.height)
            newest, shape = logged.device_time_ns, image.shape
            yield Frame(image, logged.device_time_ns, logged.frame)


def _scaled_intrinsics(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The same intrinsics for the image scaled to ``width`` x ``height``."""
    scale = ThumbnailScale(width / lens.width, height / lens.height, width, height)
    return Intrinsics(width, height, scale.matrix() @ lens.matrix, lens.distortions, lens.fisheye)


def _median_rate(run: ImageRun) -> float:
    """Image rate [Hz] from the median interval; 0 = not known."""
    steps = np.diff(np.array(sorted(run.times_ns), dtype=np.float64))
    steps = steps[steps > 0.0]
    return float(NANOSECONDS / np.median(steps)) if len(steps) else 0.0
