"""All frames of a video file or a folder of pictures, each with its own time: what offline commands walk through.

PyAV reads files where it is installed (the extra ``video``): it tells the container's exact presentation time of
every frame, and damaged frames can be skipped and counted. Without it OpenCV reads them, which skips damage unseen.
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

from edge.devices.base import Image
from edge.devices.playback.video_file import FOLDER_FPS, IMAGE_SUFFIXES, Recording
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".ts", ".3gp", ".mpg"})
_CONVERT = "check that it is a video this machine can decode (try another player, or convert it to mp4)"


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One frame. frame: 0-based, of the frames that could be read. time: [s] as the file says; often 0 for the first.

    image: makes the picture (H, W, 3) BGR, upright as a player shows it; only worth its time where it is looked at.
    """

    frame: int
    time: float
    image: Callable[[], Image]


@dataclass(frozen=True, slots=True)
class FilmInfo:
    """size: (width, height) [px] as shown. fps: mean rate. frames: about how many there are, 0 = not told."""

    size: tuple[int, int]
    fps: float
    frames: int


class Film:
    """A video file, or a folder of pictures ``fps`` apart in the order of their names.

    corrupt: frames that could not be decoded so far. repaired: frames without a usable time stamp, put one
    period after their predecessor. Raises InputError where nothing can be read.
    """

    def __init__(self, path: Path, fps: float | None = None) -> None:
        if not path.exists():
            raise InputError("this video does not exist", file=path, remedy="check the path")
        self.path = path
        self.corrupt = 0
        self.repaired = 0
        self._given_fps = fps
        if path.is_dir():
            self._pictures = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
            self.info = self._folder_info(fps or FOLDER_FPS)
        elif has_pyav():
            self.info = self._file_info()
        else:
            self.info = self._opencv_info()

    def __iter__(self) -> Iterator[Shot]:
        """All frames from the first one on, in order of time."""
        self.corrupt = self.repaired = 0
        if self.path.is_dir():
            return self._folder()
        return self._file() if has_pyav() else self._opencv()

    def _folder_info(self, fps: float) -> FilmInfo:
        if not self._pictures:
            kinds = ", ".join(sorted(IMAGE_SUFFIXES))
            raise InputError("no pictures in this folder", file=self.path, remedy=f"put {kinds} files in it")
        for file in self._pictures:
            image = cv2.imread(str(file), cv2.IMREAD_COLOR)
            if image is not None:
                return FilmInfo((image.shape[1], image.shape[0]), fps, len(self._pictures))
        raise InputError("none of its pictures can be read", file=self.path, remedy="replace them")

    def _folder(self) -> Iterator[Shot]:
        frame = 0
        for index, file in enumerate(self._pictures):
            image = cv2.imread(str(file), cv2.IMREAD_COLOR)
            if image is None or (image.shape[1], image.shape[0]) != self.info.size:
                self.corrupt += 1
                continue
            picture = np.asarray(image, dtype=np.uint8)
            # A picture that is skipped still takes its time.
            yield Shot(frame, index / self.info.fps, partial(np.asarray, picture))
            frame += 1

    def _file_info(self) -> FilmInfo:
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
                # Some containers don't count: then the duration does.
                seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
                count = stream.frames or round(seconds * rate)
                turned = abs(round(first.rotation / 90)) % 2 == 1
                size = (first.height, first.width) if turned else (first.width, first.height)
        except av.error.FFmpegError as error:
            what = f"no frame can be read from this file: {error.strerror}"
            raise InputError(what, file=self.path, remedy=_CONVERT) from None
        if not (math.isfinite(rate) and rate > 0.0):
            raise InputError("the video does not tell its frame rate", file=self.path, remedy="give its fps")
        return FilmInfo(size, rate, count)

    def _file(self) -> Iterator[Shot]:
        import av

        last, frame = -math.inf, 0
        with av.open(str(self.path)) as container:
            for picture in self._decoded(container):
                if picture.is_corrupt:
                    self.corrupt += 1
                    continue
                time = picture.time
                if self._given_fps:
                    time = frame / self._given_fps
                elif time is None or not time > last:
                    self.repaired += 1
                    time = (last if math.isfinite(last) else 0.0) + 1.0 / self.info.fps
                last = time
                yield Shot(frame, time, partial(upright, picture))
                frame += 1

    def _decoded(self, container: InputContainer) -> Iterator[VideoFrame]:
        """Whatever the decoder gives; packets that it cannot make sense of are counted."""
        import av

        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:
                return  # a file that was cut off ends here
            if packet is None:
                return
            try:
                yield from packet.decode()
            except av.error.FFmpegError:
                self.corrupt += 1

    def _opencv_info(self) -> FilmInfo:
        recording = Recording(self.path, fps=self._given_fps)
        recording.open()
        info = recording.info
        recording.close()
        capture = cv2.VideoCapture(str(self.path))
        count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        capture.release()
        return FilmInfo((info.width, info.height), info.fps, count)

    def _opencv(self) -> Iterator[Shot]:
        recording = Recording(self.path, fps=self._given_fps)
        recording.open()
        try:
            while (frame := recording.read(1.0)) is not None:
                self.repaired = recording.repaired
                picture = frame.image
                yield Shot(frame.frame, frame.device_time_ns / NANOSECONDS, partial(np.asarray, picture))
        finally:
            recording.close()


def has_pyav() -> bool:
    """Whether PyAV is installed."""
    return find_spec("av") is not None


def upright(picture: VideoFrame) -> Image:
    """The picture (H, W, 3) BGR as a player shows it: phones store portrait lying, with a note."""
    image = np.asarray(picture.to_ndarray(format="bgr24"), dtype=np.uint8)
    turns = round(picture.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(image, turns)) if turns else image


def is_video(path: Path) -> bool:
    """Whether a file looks like a video by its name, or a folder holds pictures."""
    if path.is_dir():
        return any(p.suffix.lower() in IMAGE_SUFFIXES for p in path.iterdir())
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")
