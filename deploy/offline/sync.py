"""Videos onto one clock: the reference time of every frame, and copies of the videos that line up.

A grid of reference times is laid over the span that all videos share. Each output frame shows, in every video, the
source frame nearest to that time; which one it is stands in a table, so nothing of the choice is hidden.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from edge.devices.base import Image
from edge.devices.playback.video_reader import Film
from protocols.core.clocks import CameraTime, TimeMap
from protocols.core.errors import InputError, Refused
from protocols.geometry.types import Floats

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

_CLOCK_HZ = 90_000  # ticks of the written time stamps, as MPEG has them
_QUALITY = "16"  # of x264: hardly told from the source


@dataclass(frozen=True, slots=True)
class Span:
    """One video's first and last frame on the reference clock [s]."""

    first: float
    last: float


@dataclass(frozen=True, slots=True, eq=False)
class Retimed:
    """What became of one video.

    time, reference: (n,) of all its frames [s], own and reference clock. shown: (k,) for each output frame the
    source frame that it shows. error: (k,) reference time of that frame less the output frame's [s].
    """

    time: Floats
    reference: Floats
    shown: list[int]
    error: Floats


def span_of(film: Film, time_map: TimeMap) -> Span:
    """First and last frame of a video on the reference clock; reads its packets, decodes nothing."""
    import av

    first, last = math.inf, -math.inf
    try:
        with av.open(str(film.path)) as container:
            stream = container.streams.video[0]
            for packet in container.demux(stream):
                if packet.pts is not None and stream.time_base is not None and not packet.is_discard:
                    time = float(packet.pts * stream.time_base)
                    first, last = min(first, time), max(last, time)
    except av.error.FFmpegError as error:
        if not first < last:
            remedy = "replace it"
            raise InputError(f"cannot be read: {error.strerror}", file=film.path, remedy=remedy) from None
    if not first <= last:
        raise InputError("its frames have no time stamps", file=film.path, remedy="convert it to mp4")
    begin, end = (time_map.reference_from_camera(CameraTime(time)) for time in (first, last))
    return Span(begin, end)


def common_grid(spans: dict[str, Span], fps: float) -> Floats:
    """Reference times (k,) [s] of the output frames: multiples of the period within all spans. Raises Refused."""
    begin = max(span.first for span in spans.values())
    end = min(span.last for span in spans.values())
    late = max(spans, key=lambda name: spans[name].first)
    early = min(spans, key=lambda name: spans[name].last)
    # Rounded outwards by a hair: a grid time that is a frame's own must not fall out by the last bit.
    first, last = math.ceil(begin * fps - 1e-6), math.floor(end * fps + 1e-6)
    if last < first:
        raise Refused(
            f"the videos have no time in common: {late} begins at {begin:.3f} s, {early} ends at {end:.3f} s of the "
            "reference clock; is the calibration of these very videos?"
        )
    return np.arange(first, last + 1) / fps


def retime(
    film: Film,
    time_map: TimeMap,
    grid: Floats,
    out: Path | None,
    fps: float,
    tell: Callable[[int], None],
) -> Retimed:
    """Walk through a video once: reference times of all frames, and where ``out`` is given the copy on the grid.

    Copies have a constant rate, as many frames as the grid, the first at time 0, and no sound.
    """
    times: list[float] = []
    references: list[float] = []
    shown: list[int] = []
    done = 0
    with _Writer(out, fps, film.info.size) as writer:
        before: tuple[float, int, Callable[[], Image]] | None = None
        for shot in film:
            reference = float(time_map.reference_from_camera(CameraTime(shot.time)))
            times.append(shot.time)
            references.append(reference)
            if before is not None:
                until = int(np.searchsorted(grid, 0.5 * (before[0] + reference), side="right"))
                writer.write(before[2], until - done)
                shown += [before[1]] * (until - done)
                done = max(done, until)
            before = reference, shot.frame, shot.image
            if shot.frame % 10 == 0:
                tell(shot.frame)
        if before is None:
            raise InputError("no frame can be read from this file", file=film.path, remedy="replace it")
        writer.write(before[2], len(grid) - done)
        shown += [before[1]] * (len(grid) - done)
        writer.finish()
    reference_times = np.array(references)
    return Retimed(np.array(times), reference_times, shown, reference_times[shown] - grid)


def trim(film: Film, time_map: TimeMap, span: Span, out: Path, tell: Callable[[int], None]) -> Retimed:
    """Every frame of ``span`` once, stamped with its reference time from the span's begin on; no sound."""
    times: list[float] = []
    references: list[float] = []
    shown: list[int] = []
    with _Writer(out, film.info.fps, film.info.size) as writer:
        for shot in film:
            reference = float(time_map.reference_from_camera(CameraTime(shot.time)))
            times.append(shot.time)
            references.append(reference)
            if span.first - 1e-9 <= reference <= span.last + 1e-9:
                writer.write_at(shot.image, reference - span.first)
                shown.append(shot.frame)
            if shot.frame % 10 == 0:
                tell(shot.frame)
        if not shown:
            raise Refused(
                f"{film.path}: no frame of it lies in the {span.last - span.first:.3f} s that all videos share"
            )
        writer.finish()
    return Retimed(np.array(times), np.array(references), shown, np.zeros(len(shown)))


class _Writer:
    """Writes H.264 beside ``file`` and renames at the end: a file of that name is whole. None = writes nothing."""

    def __init__(self, file: Path | None, fps: float, size: tuple[int, int]) -> None:
        self._file, self._fps, self._size = file, fps, size
        self._part = None if file is None else file.with_name(f".{file.stem}.part{file.suffix}")
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._count = 0
        self._last = -1

    def __enter__(self) -> _Writer:
        import av

        if self._part is None or self._file is None:
            return self
        self._file.parent.mkdir(parents=True, exist_ok=True)
        try:
            # MP4 tells a later first frame in units of the film, by default milliseconds.
            self._container = av.open(str(self._part), "w", options={"movie_timescale": str(_CLOCK_HZ)})
            rate = Fraction(self._fps).limit_denominator(1001)
            stream = self._container.add_stream("libx264", rate=rate)
        except (av.error.FFmpegError, ValueError) as error:
            raise InputError(f"no video can be written here: {error}", file=self._file, remedy="check --out") from None
        width, height = self._size
        # H.264 in the common pixel format needs even sides: an odd last row or column is left out.
        stream.width, stream.height, stream.pix_fmt = width - width % 2, height - height % 2, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, _CLOCK_HZ)
        stream.options = {"crf": _QUALITY, "preset": "veryfast", "bf": "0"}
        self._stream = stream
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._container is not None:
            self._container.close()
        if self._part is not None:
            self._part.unlink(missing_ok=True)

    def write(self, image: Callable[[], Image], times: int) -> None:
        """The same picture ``times`` times (0 or less: not at all), on the grid."""
        if self._stream is None or times <= 0:
            return
        picture = image()
        for _ in range(times):
            self._encode(picture, round(self._count * _CLOCK_HZ / self._fps))
            self._count += 1

    def write_at(self, image: Callable[[], Image], time: float) -> None:
        """A picture at a time [s]."""
        if self._stream is not None:
            self._encode(image(), max(round(time * _CLOCK_HZ), self._last + 1))

    def finish(self) -> None:
        """All frames are in: the file takes its name."""
        if self._container is None or self._stream is None or self._part is None or self._file is None:
            return
        self._container.mux(self._stream.encode())
        self._container.close()
        self._container = None
        self._part.replace(self._file)

    def _encode(self, picture: Image, ticks: int) -> None:
        import av

        assert self._stream is not None
        assert self._container is not None
        shown = picture[: self._stream.height, : self._stream.width]
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(shown), format="bgr24")
        frame.pts, frame.time_base = ticks, Fraction(1, _CLOCK_HZ)
        self._last = ticks
        self._container.mux(self._stream.encode(frame))


def times_text(video: Retimed) -> str:
    """frame,time,reference_time of every frame of a video."""
    lines = ["frame,time,reference_time"]
    lines += [f"{i},{t:.17g},{r:.17g}" for i, (t, r) in enumerate(zip(video.time, video.reference, strict=True))]
    return "\n".join(lines) + "\n"


def grid_text(grid: Floats, videos: dict[str, Retimed], header: Callable[[str], str]) -> str:
    """frame,reference_time,CAMERA,… : which source frame each video shows in each output frame."""
    lines = [",".join(["frame", "reference_time", *(header(name) for name in videos)])]
    lines += [",".join(row) for row in _grid_rows(grid, videos)]
    return "\n".join(lines) + "\n"


def _grid_rows(grid: Floats, videos: dict[str, Retimed]) -> Iterator[list[str]]:
    for index, time in enumerate(grid):
        yield [str(index), f"{time:.17g}", *(str(video.shown[index]) for video in videos.values())]
