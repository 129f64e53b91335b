"""Synchronisation of videos: reference times of all frames, and copies resampled to a common time grid.

The grid of reference times covers the common time span of all videos. Each output frame shows, in every video, the
source frame nearest to that time; a table lists which one it is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from edge.devices.playback.video_reader import VideoReader
from protocols.core.clocks import CameraTime, TimeMap
from protocols.core.errors import InputError, Refused
from protocols.core.files import read_text
from protocols.geometry.types import Floats, Image
from protocols.session.calibration import read_calibration, stated_calibration

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

_CLOCK_HZ = 90_000  # time base of the written time stamps, the MPEG one
GRID = "synchronised.csv"
_TIMES = "frame,time,reference_time"
_QUALITY = "16"  # crf of x264: visually close to the source


@dataclass(frozen=True, slots=True)
class Span:
    """One video's first and last frame on the reference clock [s]."""

    first: float
    last: float


@dataclass(frozen=True, slots=True, eq=False)
class SynchronisedVideo:
    """Frame times of one video and the frames of its synchronised copy.

    time, reference: (n,) times of all its frames [s], on its own and on the reference clock. source_frames: (k,) source
    frame that each output frame shows. error: (k,) reference time of that frame minus that of the output frame [s].
    """

    time: Floats
    reference: Floats
    source_frames: list[int]
    error: Floats


def read_time_maps(
    file: Path, films: Mapping[str, VideoReader]
) -> tuple[str, dict[str, TimeMap], Mapping[str, float | None], Mapping[str, str]]:
    """Reference camera, time maps and stds [s] of a calibration.toml, or from the pairs of a result.json, None where
    they are not known; and why other cameras were refused.

    A result.json has lags also where no camera could be placed. Raises InputError, and Refused where it has none.
    """
    if file.suffix.lower() != ".json":
        rig, cameras = read_calibration(file)
        stds = {name: camera.time_offset_std for name, camera in cameras.items()}
        reference = str(rig.metadata.get("reference", next(iter(rig.cameras))))
        maps = {name: camera.time_map for name, camera in cameras.items()}
        return reference, maps, stds, stated_calibration(rig, cameras).refused
    try:
        document = json.loads(read_text(file))
        pairs = [
            (str(a), str(b), float(pair["lag_s"]), float(pair.get("clock_rate") or 1.0), _lag_std(pair))
            for pair in document["pairs"]
            if pair.get("lag_s") is not None
            for a, b in (pair["cameras"],)
        ]
        refused = {str(name): str(why) for name, why in document.get("metadata", {}).get("refused", {}).items()}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        remedy = "give the result.json or the calibration.toml of `calibrate`"
        raise InputError("this is no result of `calibrate`", file=file, remedy=remedy) from None
    return *time_maps_of_pairs(pairs, films), refused


def _lag_std(pair: Mapping[str, Any]) -> float | None:
    """Of the lag of a pair of a result.json [s], None where it is not known. Raises ValueError, TypeError."""
    std = pair.get("lag_std_s")
    return float(std) if std is not None and 0.0 <= float(std) < math.inf else None


def time_maps_of_pairs(
    pairs: Sequence[tuple[str, str, float, float, float | None]], films: Mapping[str, VideoReader]
) -> tuple[str, dict[str, TimeMap], dict[str, float | None]]:
    """Time maps and stds from the lags of pairs (a, b, t_a - t_b in the middle of their overlap [s], rate of a's clock
    by b's, std of the lag [s] or None).

    Raises Refused where the lag of no pair is known.
    """
    usable = [pair for pair in pairs if {pair[0], pair[1]} <= set(films) and all(map(math.isfinite, pair[2:4]))]
    if not usable:
        raise Refused("the lag of no pair of these videos is known: film something that moves in front of both")
    reference = next(name for name in films if any(name in pair[:2] for pair in usable))
    maps = {reference: TimeMap(1.0, 0.0)}
    stds: dict[str, float | None] = {reference: 0.0}
    spans = {name: reference_span(film, TimeMap(1.0, 0.0)) for name, film in films.items()}
    grown = True
    while grown:
        grown = False
        for a, b, lag, rate, std in usable:
            if (a in maps) == (b in maps):
                continue
            known, new = (a, b) if a in maps else (b, a)
            before, grown = stds[known], True
            stds[new] = None if std is None or before is None else math.hypot(before, std)
            first, last = max(spans[a].first, spans[b].first + lag), min(spans[a].last, spans[b].last + lag)
            middle = 0.5 * (first + last)
            a_from_b = TimeMap(rate, middle - rate * (middle - lag))
            b_from_a = TimeMap(1.0 / rate, -a_from_b.time_offset / rate)
            maps[new] = _chained(maps[known], a_from_b if known == a else b_from_a)
    return reference, maps, stds


def _chained(outer: TimeMap, inner: TimeMap) -> TimeMap:
    """The map that applies ``inner`` first."""
    return TimeMap(outer.clock_rate * inner.clock_rate, outer.clock_rate * inner.time_offset + outer.time_offset)


def reference_span(film: VideoReader, time_map: TimeMap) -> Span:
    """Reference times of the first and last frame of a video; reads packet time stamps without decoding."""
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


def common_time_grid(spans: dict[str, Span], fps: float) -> Floats:
    """Reference times (k,) [s] of the output frames: multiples of the period within all spans. Raises Refused."""
    begin = max(span.first for span in spans.values())
    end = min(span.last for span in spans.values())
    late = max(spans, key=lambda name: spans[name].first)
    early = min(spans, key=lambda name: spans[name].last)
    # Rounded outwards by 1e-6: rounding errors must not exclude a grid time that equals a frame's time.
    first, last = math.ceil(begin * fps - 1e-6), math.floor(end * fps + 1e-6)
    if last < first:
        raise Refused(
            f"the videos have no time in common: {late} begins at {begin:.3f} s, {early} ends at {end:.3f} s of the "
            "reference clock; is the calibration of these same videos?"
        )
    return np.arange(first, last + 1) / fps


def retime(
    film: VideoReader,
    time_map: TimeMap,
    grid: Floats,
    out: Path | None,
    fps: float,
    progress: Callable[[int], None],
) -> SynchronisedVideo:
    """Compute the reference times of all frames of a video and, if ``out`` is given, write its copy on the grid.

    Copies have a constant rate, as many frames as the grid, the first at time 0, and no audio.
    """
    times: list[float] = []
    references: list[float] = []
    source_frames: list[int] = []
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
                source_frames += [before[1]] * (until - done)
                done = max(done, until)
            before = reference, shot.frame, shot.image
            if shot.frame % 10 == 0:
                progress(shot.frame)
        if before is None:
            raise InputError("no frame can be read from this file", file=film.path, remedy="replace it")
        writer.write(before[2], len(grid) - done)
        source_frames += [before[1]] * (len(grid) - done)
        writer.finish()
    reference_times = np.array(references)
    return SynchronisedVideo(np.array(times), reference_times, source_frames, reference_times[source_frames] - grid)


def trim(
    film: VideoReader, time_map: TimeMap, span: Span, out: Path, progress: Callable[[int], None]
) -> SynchronisedVideo:
    """Write every frame within ``span`` once, stamped with its reference time since the start of the span; no audio."""
    times: list[float] = []
    references: list[float] = []
    source_frames: list[int] = []
    with _Writer(out, film.info.fps, film.info.size) as writer:
        for shot in film:
            reference = float(time_map.reference_from_camera(CameraTime(shot.time)))
            times.append(shot.time)
            references.append(reference)
            if span.first - 1e-9 <= reference <= span.last + 1e-9:
                writer.write_at(shot.image, reference - span.first)
                source_frames.append(shot.frame)
            if shot.frame % 10 == 0:
                progress(shot.frame)
        if not source_frames:
            raise Refused(
                f"{film.path}: no frame of it lies in the {span.last - span.first:.3f} s that all videos share"
            )
        writer.finish()
    return SynchronisedVideo(np.array(times), np.array(references), source_frames, np.zeros(len(source_frames)))


class _Writer:
    """Writes H.264 to a temporary file that is renamed to ``file`` when complete. None = writes nothing."""

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
            # MP4 stores the delay of the first frame in units of the movie time scale, by default milliseconds.
            self._container = av.open(str(self._part), "w", options={"movie_timescale": str(_CLOCK_HZ)})
            rate = Fraction(self._fps).limit_denominator(1001)
            stream = self._container.add_stream("libx264", rate=rate)
        except (av.error.FFmpegError, ValueError) as error:
            raise InputError(f"no video can be written here: {error}", file=self._file, remedy="check --out") from None
        width, height = self._size
        # H.264 with yuv420p needs even image sides: an odd last row or column is cropped.
        stream.width, stream.height, stream.pix_fmt = width - width % 2, height - height % 2, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, _CLOCK_HZ)
        stream.options = {"crf": _QUALITY, "preset": "veryfast", "bf": "0"}
        self._stream = stream
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        try:
            if self._container is not None:
                self._container.close()
        finally:  # on a full disk it cannot be closed either
            if self._part is not None:
                self._part.unlink(missing_ok=True)

    def write(self, image: Callable[[], Image], times: int) -> None:
        """Write an image ``times`` times (0 or less: not at all) on the grid."""
        if self._stream is None or times <= 0:
            return
        decoded = image()
        for _ in range(times):
            self._encode(decoded, round(self._count * _CLOCK_HZ / self._fps))
            self._count += 1

    def write_at(self, image: Callable[[], Image], time: float) -> None:
        """Write an image at a time [s]."""
        if self._stream is not None:
            self._encode(image(), max(round(time * _CLOCK_HZ), self._last + 1))

    def finish(self) -> None:
        """Finish encoding and rename the file to its final name."""
        if self._container is None or self._stream is None or self._part is None or self._file is None:
            return
        self._container.mux(self._stream.encode())
        self._container.close()
        self._container = None
        self._part.replace(self._file)

    def _encode(self, image: Image, ticks: int) -> None:
        import av

        assert self._stream is not None
        assert self._container is not None
        cropped = image[: self._stream.height, : self._stream.width]
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(cropped), format="bgr24")
        frame.pts, frame.time_base = ticks, Fraction(1, _CLOCK_HZ)
        self._last = ticks
        self._container.mux(self._stream.encode(frame))


def earlier_results(out: Path, written: Container[Path]) -> tuple[list[Path], list[Path]]:
    """Tables of an earlier run in ``out`` that are not ``written`` anew, and its videos, which may be anyone's."""
    tables = [out / GRID]
    for file in sorted(out.glob("*.csv")):
        with file.open("rb") as content:
            tables += [file] if content.read(len(_TIMES)).decode("utf-8", "replace") == _TIMES else []
    videos = [file.with_suffix(".mp4") for file in tables]
    return [file for file in tables if file not in written], [f for f in videos if f.exists() and f not in written]


def times_text(video: SynchronisedVideo) -> str:
    """CSV text with frame,time,reference_time of every frame of a video."""
    lines = [_TIMES]
    lines += [f"{i},{t:.17g},{r:.17g}" for i, (t, r) in enumerate(zip(video.time, video.reference, strict=True))]
    return "\n".join(lines) + "\n"


def grid_text(grid: Floats, videos: dict[str, SynchronisedVideo], header: Callable[[str], str]) -> str:
    """CSV text with frame,reference_time,CAMERA,…: the source frame of each video in each output frame."""
    lines = [",".join(["frame", "reference_time", *(header(name) for name in videos)])]
    for index, time in enumerate(grid):
        lines.append(
            ",".join([str(index), f"{time:.17g}", *(str(one.source_frames[index]) for one in videos.values())])
        )
    return "\n".join(lines) + "\n"
