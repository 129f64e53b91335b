"""Reading of all frames of a video file or an image folder with their time stamps.

Files are read with PyAV where it is installed (the extra ``video``): it gives the exact presentation time of every
frame, and damaged frames are skipped and counted. Otherwise OpenCV reads them, which skips damaged frames silently.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from protocols.core.errors import InputError
from protocols.geometry.types import Image

if TYPE_CHECKING:
    from av import VideoFrame as AvFrame
    from av.container import InputContainer

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
FOLDER_FPS = 30.0
"""Default frame rate of an image folder [Hz]."""
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".ts", ".3gp", ".mpg"})
_CUT_S = 0.5  # s: durations of containers count the last frame, and often sound that goes on for longer
_CONVERT = "check that it is a video this machine can decode (try another player, or convert it to mp4)"


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """One frame. frame: 0-based index among the readable frames. time: presentation time [s]; often 0 for the first.

    image: converts to an image (H, W, 3) BGR, rotated upright as by a player; called only where it is needed.
    """

    frame: int
    time: float
    image: Callable[[], Image]


_Decoded = tuple[float | None, tuple[int, int], Callable[[], Image]]
"""A frame as decoded: its time [s], if stated; its size (width, height) [px]; its conversion to an image."""


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

    Images of a folder are all turned as the first one's EXIF orientation says.
    corrupt: number of frames that could not be decoded so far. repaired: number of frames without a usable time stamp,
    placed one period after their predecessor. resized: number of frames of another size than the first, which are left
    out. cut: what a file that ends too early lacks, in words; "" = nothing.
    Raises InputError if no frame can be read; strict: also for an image of a folder that would be left out.
    """

    def __init__(self, path: Path, fps: float | None = None, *, strict: bool = False) -> None:
        check_recording(path)
        self.path = path
        self.corrupt = 0
        self.repaired = 0
        self.resized = 0
        self.cut = ""
        self._given_fps, self._strict = fps, strict
        if path.is_dir():
            self._image_files = image_files(path)
            self.info = self._folder_info(fps or FOLDER_FPS)
        else:
            self.info = self._file_info() if has_pyav() else self._opencv_info()
        if not (math.isfinite(self.info.fps) and self.info.fps > 0.0):
            raise InputError("the video states no frame rate", file=path, remedy="give its fps")

    def __iter__(self) -> Iterator[VideoFrame]:
        """All frames from the first one on, in order of time. Raises InputError if the file cannot be read any more."""
        self.corrupt = self.repaired = self.resized = 0
        check_recording(self.path)
        return self._read_folder() if self.path.is_dir() else self._read_file()

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
            image, shown = read_image(file), read_image(file, cv2.IMREAD_COLOR)
            if image is not None and shown is not None:
                # Which way the first is turned, so are all: they are of one lens, however the camera was held.
                self._turns = next((k for k in range(4) if np.array_equal(np.rot90(image, k), shown)), 0)
                image = np.rot90(image, self._turns)
                return VideoInfo((image.shape[1], image.shape[0]), fps, len(self._image_files))
        raise InputError("none of its images can be read", file=self.path, remedy="replace them")

    def _read_folder(self) -> Iterator[VideoFrame]:
        frame = 0
        for index, file in enumerate(self._image_files):
            image = read_image(file)
            if image is not None:
                image = np.ascontiguousarray(np.rot90(image, self._turns))
            if image is None or (image.shape[1], image.shape[0]) != self.info.size:
                if self._strict:
                    size = (
                        "cannot be read" if image is None else f"is {image.shape[1]}x{image.shape[0]}, others are not"
                    )
                    raise InputError(f"this image {size}", file=file, remedy="remove or replace it")
                self.corrupt += image is None
                self.resized += image is not None
                continue
            # A skipped image still advances the time.
            yield VideoFrame(frame, index / self.info.fps, partial(np.asarray, image))
            frame += 1

    @contextmanager
    def _opened(self) -> Iterator[InputContainer]:
        """The file in PyAV; its errors become InputError."""
        import av

        try:
            with av.open(str(self.path)) as container:
                if not container.streams.video:
                    raise InputError("there is no video in this file", file=self.path, remedy=_CONVERT)
                yield container
        except av.error.FFmpegError as error:
            what = f"no frame can be read from this file: {error.strerror}"
            raise InputError(what, file=self.path, remedy=_CONVERT) from None

    def _file_info(self) -> VideoInfo:
        with self._opened() as container:
            stream = container.streams.video[0]
            first = next(self._decoded(container), None)
            if first is None:
                raise InputError("no frame can be read from this file", file=self.path, remedy=_CONVERT)
            rate = self._given_fps or float(stream.average_rate or stream.guessed_rate or 0.0)
            # Some containers have no frame count: use the duration.
            seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
            count = stream.frames or round(seconds * rate)
            return VideoInfo(upright_size(first), rate, count, _stated_end(container))

    def _read_file(self) -> Iterator[VideoFrame]:
        last, stamp, frame = -math.inf, -math.inf, 0
        for time, size, image in self._pyav_frames() if has_pyav() else self._opencv_frames():
            if size != self.info.size:
                self.resized += 1
                continue
            stamp = max(stamp, -math.inf if time is None else time)
            if self._given_fps:
                time = frame / self._given_fps
            elif time is None or not last < time < math.inf:
                self.repaired += 1
                time = (last if math.isfinite(last) else 0.0) + 1.0 / self.info.fps
            last = time
            yield VideoFrame(frame, time, image)
            frame += 1
        lasting = max(_CUT_S, 1.5 / self.info.fps)
        if math.isfinite(stamp) and not self.resized and stamp + lasting < self.info.end:
            says = f"its container says {self.info.end:.1f} s"
            self.cut = f"it ends at {stamp:.1f} s, {says}: the file seems to be cut off"

    def _pyav_frames(self) -> Iterator[_Decoded]:
        with self._opened() as container:
            for decoded in self._decoded(container):
                if decoded.is_corrupt:
                    self.corrupt += 1
                else:
                    yield decoded.time, upright_size(decoded), partial(upright_image, decoded)

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
        first = next(self._opencv_frames(), None)
        if first is None:
            raise InputError("no frame can be read from this file", file=self.path, remedy=_CONVERT)
        capture = cv2.VideoCapture(str(self.path))
        rate, count = (capture.get(what) for what in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        end = count / rate if rate > 0.0 and count > 0.0 else math.nan
        return VideoInfo(first[1], self._given_fps or rate, max(int(count), 0), end)

    def _opencv_frames(self) -> Iterator[_Decoded]:
        capture = cv2.VideoCapture(str(self.path))
        try:
            while capture.isOpened():
                ok, image = capture.read()
                if not ok or image is None:
                    return
                # After a read, this is the presentation time of the frame that was read.
                time = capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3
                yield time, (image.shape[1], image.shape[0]), partial(np.asarray, image, np.uint8)
        finally:
            capture.release()


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


def read_image(file: Path, flags: int = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) -> Image | None:
    """The image (h, w, 3) BGR of a file, by default as the sensor gave it; None if it cannot be decoded or is larger
    than OpenCV's limit."""
    try:
        image = cv2.imread(str(file), flags)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _stated_end(container: InputContainer) -> float:
    """Time [s] at which a video ends according to its container; NaN where that says nothing."""
    stream = container.streams.video[0]
    begin = float((stream.start_time or 0) * (stream.time_base or 0))
    if container.format.name == "avi" and stream.frames and stream.average_rate:
        return begin + float(stream.frames / stream.average_rate)  # FFmpeg's duration is of what is there
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
