"""Playback of recordings as devices: what all share, and a video file or an image folder."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

from edge.devices.base import DeviceInfo, Frame, check_size
from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.playback.playback_clock import PlaybackClock, wait_until
from edge.devices.playback.video_reader import VideoReader
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics


class Playback:
    """A recording as a device: its ``_frames`` in order, each once it is due on the clock.

    playback_clock: the clock for playback in real time; None = as fast as possible.
    """

    def __init__(self, playback_clock: PlaybackClock | None = None) -> None:
        self._playback_clock = playback_clock
        self._info: DeviceInfo | None = None
        self._frames: Iterator[Frame] = iter(())
        self._pending: Frame | None = None
        self._start_s: float | None = None  # playback clock time of device time 0
        self.ended = False

    @property
    def info(self) -> DeviceInfo:
        """Description with the size of the first image; the exposure is not known."""
        if self._info is None:
            raise RuntimeError("open the recording first")
        return self._info

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, once it is due on the playback clock."""
        if self.ended or self._info is None:
            return None
        frame = self._pending = self._pending or next(self._frames, None)
        if frame is None:
            self.ended = True
        elif self._playback_clock is not None:
            time_s = frame.device_time_ns / NANOSECONDS
            if self._start_s is None:
                self._start_s = self._playback_clock.now() - time_s
            if not wait_until(self._playback_clock, self._start_s + time_s, timeout_s):
                return None
        self._pending = None
        return frame

    def close(self) -> None:
        """Release the file. May be called twice."""
        self._frames = iter(())
        self.ended = True


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


class VideoPlayback(Playback):
    """Plays a video file or a folder of images as a device.

    Times are those of ``VideoReader``, from 0 for the first frame; an image of a folder that it would leave out raises
    InputError, as does a looped file of which a later round can read no frame. The other arguments are those of
    ``open_video``.
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
        super().__init__(playback_clock)
        self._path, self._fps, self._loop, self._intrinsics = path, fps, loop, intrinsics
        self._reader: VideoReader | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of the recording so far, one line each; of a loop, those of this round."""
        return () if self._reader is None else self._reader.warnings

    def open(self) -> None:
        """Raises InputError if no frame can be read."""
        self._reader = VideoReader(self._path, self._fps, strict=True)
        (width, height), fps = self._reader.info.size, self._reader.info.fps
        check_size(self._intrinsics, width, height, str(self._path))
        driver = "images" if self._path.is_dir() else "video"
        self._frames = self._read(self._reader)
        self._pending = next(self._frames, None)
        self._info = DeviceInfo(width, height, fps, driver, "stream", self._intrinsics, unknown=("exposure",))

    def _read(self, reader: VideoReader) -> Iterator[Frame]:
        begin_s = 0.0  # of this round
        numbers = itertools.count()
        while True:
            first_s = time_s = None
            for one in reader:
                # Containers may begin at any time: transport streams count on from the camera's start.
                first_s = one.time if first_s is None else first_s
                time_s = begin_s + one.time - first_s
                yield Frame(one.image(), round(time_s * NANOSECONDS), next(numbers))
            if time_s is None:
                raise InputError("no frame can be read from this video", file=self._path, remedy="replace it")
            if not self._loop:
                return
            begin_s = time_s + 1.0 / reader.info.fps
