"""Playback of a video file or an image folder as a device."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from edge.devices.base import DeviceInfo, Frame, check_size
from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.playback.playback_clock import PlaybackClock, wait_until
from edge.devices.playback.video_reader import VideoFrame, VideoReader
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Image


def open_video(
    source: str | int | Path,
    *,
    fps: float | None = None,
    loop: bool = False,
    playback_clock: PlaybackClock | None = None,
    intrinsics: Intrinsics | None = None,
) -> VideoPlayback | OpenCvCamera:
    """The device for a source, not yet open.

    source: a file; a folder of images, sorted by name; an index or /dev/… of a USB camera (also a stable name made by
    udev); or a URL.
    fps: of a recording, replaces its time stamps; of a live camera, the requested rate. loop: repeat a recording, with
    continuing time stamps. playback_clock: the clock for playback in real time; None = as fast as possible.
    intrinsics: of this camera.
    """
    text = str(source)
    if isinstance(source, int) or text.isdecimal() or text.startswith("/dev/") or "://" in text:
        return OpenCvCamera(int(text) if text.isdecimal() else text, fps=fps, intrinsics=intrinsics)
    return VideoPlayback(Path(source), fps=fps, loop=loop, playback_clock=playback_clock, intrinsics=intrinsics)


class VideoPlayback:
    """Plays a video file or a folder of images as a device.

    Times are those of ``VideoReader``; an image of a folder that it would leave out raises InputError. The other
    arguments are those of ``open_video``.
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
        self._path, self._fps, self._loop = path, fps, loop
        self._playback_clock, self._intrinsics = playback_clock, intrinsics
        self._reader: VideoReader | None = None
        self._frames: Iterator[VideoFrame] = iter(())
        self._info: DeviceInfo | None = None
        self._pending: tuple[float, Image] | None = None  # the next frame: its time [s] and image
        self._frame = 0
        self._last_s = self._loop_offset = 0.0  # [s]: of the last frame; added by loops
        self._start_s: float | None = None  # playback clock time of device time 0
        self.ended = False

    @property
    def info(self) -> DeviceInfo:
        """Description with the size of the first frame; the exposure is not known."""
        if self._info is None:
            raise RuntimeError("open the recording first")
        return self._info

    @property
    def repaired(self) -> int:
        """Frames so far whose time stamp could not be used."""
        return 0 if self._reader is None else self._reader.repaired

    def open(self) -> None:
        """Raises InputError if no frame can be read."""
        self._reader = VideoReader(self._path, self._fps, strict=True)
        (width, height), fps = self._reader.info.size, self._reader.info.fps
        check_size(self._intrinsics, width, height, str(self._path))
        driver = "images" if self._path.is_dir() else "video"
        self._frames = iter(self._reader)
        self._advance(self._reader)
        self._info = DeviceInfo(width, height, fps, driver, "stream", self._intrinsics, unknown=("exposure",))

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, once it is due on the playback clock."""
        if self.ended or self._reader is None:
            return None
        if self._pending is None:
            self._advance(self._reader)
        if self._pending is None:
            self.ended = True
            return None
        time_s, image = self._pending
        if self._playback_clock is not None:
            if self._start_s is None:
                self._start_s = self._playback_clock.now() - time_s
            if not wait_until(self._playback_clock, self._start_s + time_s, timeout_s):
                return None
        frame = Frame(image, round(time_s * NANOSECONDS), self._frame)
        self._last_s = time_s
        self._frame += 1
        self._pending = None
        return frame

    def close(self) -> None:
        """Release the file."""
        self._frames = iter(())
        self.ended = True

    def _advance(self, reader: VideoReader) -> None:
        """Decode the next frame into ``_pending``; None at the end."""
        found = next(self._frames, None)
        if found is None and self._loop:
            self._loop_offset = self._last_s + 1.0 / reader.info.fps
            self._frames = iter(reader)
            found = next(self._frames, None)
        self._pending = None if found is None else (self._loop_offset + found.time, found.image())
