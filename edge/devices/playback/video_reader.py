"""Reading of all frames of a video file or an image folder with their time stamps, for offline processing.

Files are read with PyAV where it is installed (the extra ``video``): it gives the exact presentation time of every
frame, and damaged frames are skipped and counted. Otherwise OpenCV reads them, which skips damaged frames silently.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from edge.devices.playback.video_file import (
    FOLDER_FPS,
    IMAGE_SUFFIXES,
    VideoPlayback,
    check_recording,
    image_files,
    read_image,
)
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.types import Image

if TYPE_CHECKING:
    from av import VideoFrame as AvFrame
    from av.container import InputContainer

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".ts", ".3gp", ".mpg"})
_CUT_S = 1.0  # s: durations of containers count the last frame, and often sound that goes on for longer
_CONVERT = "check that it is a video this machine can decode (try another player, or convert it to mp4)"


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """One frame. frame: 0-based index among the readable frames. time: presentation time [s]; often 0 for the first.

    image: converts to an image (H, W, 3) BGR, rotated upright as by a player; called only where it is needed.
    """

    frame: int
    time: float
    image: Callable[[], Image]


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """size: (width, height) [px], upright. fps: mean rate. frames: approximate number, 0 = not known.

    end: time [s] at which the container says that the video ends; NaN = it does not.
    """

    size: tuple[int, int]
    fps: float
    frames: int
    end: float = math.nan


class VideoReader:
    """Iterates over the frames of a video file, or of an image folder in the order of names, 1/``fps`` apart.

    corrupt: number of frames that could not be decoded so far. repaired: number of frames without a usable time stamp,
    placed one period after their predecessor. resized: number of frames of another size than the first, which are left
    out. cut: what a file that ends too early lacks, in words; "" = nothing.
    Raises InputError if no frame can be read.
    """

    def __init__(self, path: Path, fps: float | None = None) -> None:
        check_recording(path)
        self.path = path
        self.corrupt = 0
        self.repaired = 0
        self.resized = 0
        self.cut = ""
        self._given_fps = fps
        if path.is_dir():
            self._image_files = image_files(path)
            self.info = self._folder_info(fps or FOLDER_FPS)
        elif has_pyav():
            self.info = self._file_info()
        else:
            self.info = self._opencv_info()

    def __iter__(self) -> Iterator[VideoFrame]:
        """All frames from the first one on, in order of time."""
        self.corrupt = self.repaired = self.resized = 0
        if self.path.is_dir():
            return self._read_folder()
        return self._read_file() if has_pyav() else self._read_opencv()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of the file that reading it has shown so far, one line each."""
        size = self.info.size
        found = (
            (self.corrupt, f"{self.corrupt} frames could not be decoded and were skipped"),
            (self.repaired, f"{self.repaired} frames have no usable time stamp"),
            (self.resized, f"{self.resized} frames are not of the first one's size, {size[0]}x{size[1]}, and left out"),
            (self.cut, self.cut),
        )
        return tuple(text for wrong, text in found if wrong)

    def _folder_info(self, fps: float) -> VideoInfo:
        for file in self._image_files:
            image = read_image(file)
            if image is not None:
                return VideoInfo((image.shape[1], image.shape[0]), fps, len(self._image_files))
        raise InputError("none of its images can be read", file=self.path, remedy="replace them")

    def _read_folder(self) -> Iterator[VideoFrame]:
        frame = 0
        for index, file in enumerate(self._image_files):
            image = read_image(file)
            if image is None or (image.shape[1], image.shape[0]) != self.info.size:
                self.corrupt += image is None
                self.resized += image is not None
                continue
            # A skipped image still advances the time.
            yield VideoFrame(frame, index / self.info.fps, partial(np.asarray, image))
            frame += 1

    def _file_info(self) -> VideoInfo:
        import av

        try:
            with av.open(str(self.path)) as container:
                if not container.streams.video:
                    raise InputError("there is no video in this file", file=self.path, remedy=_CONVERT)
                stream = container.streams.video[0]
                first = next(self._decoded(container), None)
                if first is None:
                    raise InputError("no frame can be read from this file", file=self.path, remedy=_CONVERT)
                rate = self._given_fps or float(stream.average_rate or stream.guessed_rate or 0.0)
                # Some containers have no frame count: use the duration.
                seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
                count = stream.frames or round(seconds * rate)
                end = _stated_end(container)
                size = upright_size(first)
        except av.error.FFmpegError as error:
            what = f"no frame can be read from this file: {error.strerror}"
            raise InputError(what, file=self.path, remedy=_CONVERT) from None
        if not (math.isfinite(rate) and rate > 0.0):
            raise InputError("the video states no frame rate", file=self.path, remedy="give its fps")
        return VideoInfo(size, rate, count, end)

    def _read_file(self) -> Iterator[VideoFrame]:
        import av

        last, frame = -math.inf, 0
        with av.open(str(self.path)) as container:
            for decoded in self._decoded(container):
                if decoded.is_corrupt or upright_size(decoded) != self.info.size:
                    self.corrupt += decoded.is_corrupt
                    self.resized += not decoded.is_corrupt
                    continue
                time = decoded.time
                if self._given_fps:
                    time = frame / self._given_fps
                elif time is None or not time > last:
                    self.repaired += 1
                    time = (last if math.isfinite(last) else 0.0) + 1.0 / self.info.fps
                last = time
                yield VideoFrame(frame, time, partial(upright_image, decoded))
                frame += 1
        if not self._given_fps and not self.resized and last + _CUT_S < self.info.end:
            says = f"its container says {self.info.end:.1f} s"
            self.cut = f"it ends at {last:.1f} s, {says}: the file seems to be cut off"

    def _decoded(self, container: InputContainer) -> Iterator[AvFrame]:
        """The decoder's frames; packets that cannot be decoded are counted."""
        import av

        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:
                return  # a truncated file ends here
            if packet is None:
                return
            try:
                yield from packet.decode()
            except av.error.FFmpegError:
                self.corrupt += 1

    def _opencv_info(self) -> VideoInfo:
        recording = VideoPlayback(self.path, fps=self._given_fps)
        recording.open()
        info = recording.info
        recording.close()
        capture = cv2.VideoCapture(str(self.path))
        count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        capture.release()
        return VideoInfo((info.width, info.height), info.fps, count)

    def _read_opencv(self) -> Iterator[VideoFrame]:
        recording = VideoPlayback(self.path, fps=self._given_fps)
        recording.open()
        try:
            while (frame := recording.read(1.0)) is not None:
                self.repaired = recording.repaired
                decoded = frame.image
                yield VideoFrame(frame.frame, frame.device_time_ns / NANOSECONDS, partial(np.asarray, decoded))
        finally:
            recording.close()


def _stated_end(container: InputContainer) -> float:
    """Time [s] at which a video ends according to its container; NaN where that says nothing."""
    stream = container.streams.video[0]
    begin = float((stream.start_time or 0) * (stream.time_base or 0))
    if stream.duration and stream.time_base:
        return begin + float(stream.duration * stream.time_base)
    # Matroska has durations of tracks in tags, as 00:00:13.998000000, and one of the whole file.
    hours, minutes, seconds = (stream.metadata.get("DURATION", "").split(":") + ["", ""])[:3]
    try:
        return 3600.0 * float(hours) + 60.0 * float(minutes) + float(seconds)
    except ValueError:
        return (container.start_time + container.duration) / 1e6 if container.duration else math.nan


def has_pyav() -> bool:
    """Whether PyAV is installed."""
    return find_spec("av") is not None


def upright_size(decoded: AvFrame) -> tuple[int, int]:
    """(width, height) [px] of a frame as ``upright_image`` turns it."""
    turned = abs(round(decoded.rotation / 90)) % 2 == 1
    return (decoded.height, decoded.width) if turned else (decoded.width, decoded.height)


def upright_image(decoded: AvFrame) -> Image:
    """The image (H, W, 3) BGR, rotated by the container's display matrix, as phones store portrait video."""
    image = np.asarray(decoded.to_ndarray(format="bgr24"), dtype=np.uint8)
    turns = round(decoded.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(image, turns)) if turns else image


def is_video(path: Path) -> bool:
    """Whether a file has the suffix of a video, or a folder contains images."""
    if path.is_dir():
        return any(p.suffix.lower() in IMAGE_SUFFIXES for p in path.iterdir())
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")
