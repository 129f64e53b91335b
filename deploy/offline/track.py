"""Offline tracking of one target: reads images and telemetry, writes track.csv and hypotheses.csv, draws overlays."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edge.devices.playback.video_file import Playback
from edge.devices.playback.video_reader import image_files
from edge.uav.base import Basis, Box, Estimate, Telemetry, Tracker, TrackState
from edge.uav.georeference import Georeference
from edge.uav.ground.image_plane import ImagePlane
from edge.uav.ground.localisation import frame_from_telemetry
from edge.uav.navigation import interpolate_positions
from edge.uav.target.box import MIN_BOX_PX
from edge.uav.timing.telemetry_track import TelemetryTrack
from hub.view.uav_overlay import dots
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image
from protocols.session.csv_table import read_csv_table
from protocols.session.rig import RigCamera, read_rig

TRACK, HYPOTHESES, OVERLAY = "track.csv", "hypotheses.csv", "overlay.mp4"
COLUMNS = ("frame", "time", "state", "x", "y", "width", "height", "heading", "std")
GROUND_COLUMNS = ("north", "east", "speed", "course", "std_m")
BASIS = "basis"
_QUATERNION = ("qw", "qx", "qy", "qz")
_POSITION = ("north", "east", "down")
# Their height may be of the sea or the ellipsoid: they give no position above the ground.
_GEODETIC = ("lat", "lon", "alt", "latitude", "longitude", "altitude")
_TELEMETRY_LOOKAHEAD_S = 0.6  # lead with which samples are passed to the tracker: clocks may differ by 0.5 s
_LARGE, _MUCH_LARGER = 0.04, 9.0
"""A box of this share of the picture, a fifth of each side, and so much larger than the box between the two corners
that its numbers may be: from the air few targets are."""

_MARGIN = 0.5  # fraction of the image size added on each side
_MAX_CANVAS_PX = 1280  # side of the overlay's picture: fits a screen
_COLOURS = {TrackState.VISIBLE: (80, 220, 80), TrackState.COASTING: (40, 170, 255), TrackState.LOST: (60, 60, 230)}
_LAYERS = {"road": (110, 80, 30), "tracks": (160, 160, 160)}
_OTHER_LAYER = (0, 220, 220)  # BGR
_PARTICLE = (230, 120, 230)  # BGR


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """The estimate of one frame. frame: 0-based index of the decoded frame. time: [s], 0 = the video's first frame."""

    frame: int
    time: float
    estimate: Estimate


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryFile:
    """Telemetry samples in strictly increasing time. left_out: discarded rows (NaN, no rotation, repeated time).
    back: rows of an earlier time than the row above. others: of a log, the samples of other vehicles and boots.
    unused: its columns of positions that are none."""

    samples: tuple[Telemetry, ...]
    left_out: int
    back: int = 0
    others: tuple[tuple[Telemetry, ...], ...] = ()
    unused: tuple[str, ...] = ()


def parse_target(text: str) -> Box:
    """Parse a bounding box ``x,y,w,h``. Raises InputError."""
    remedy = "give --target x,y,w,h in pixels, x,y the top left, as in 312,200,44,20"
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--target {text!r} is not four numbers", remedy=remedy) from None
    if len(values) != 4 or not all(math.isfinite(value) for value in values):
        raise InputError(f"--target {text!r} is not four finite numbers", remedy=remedy)
    if values[2] <= 0 or values[3] <= 0:
        raise InputError(f"--target {text!r} has no width or height", remedy=remedy)
    return Box(*values)


def corners_for_a_box(box: Box, size: tuple[int, int]) -> tuple[str, ...]:
    """A warning where a box seems to be given by two corners. size: of the picture [px]."""
    x, y, width, height = box.x, box.y, box.width, box.height
    between, area = (width - x) * (height - y), width * height
    if not (
        min(width - x, height - y) >= MIN_BOX_PX and area > max(_LARGE * size[0] * size[1], _MUCH_LARGER * between)
    ):
        return ()
    corners = f"--target {x:g},{y:g},{width - x:g},{height - y:g}"
    return (f"the target is {width:g}x{height:g} px of {size[0]}x{size[1]}: if you gave two corners, give {corners}",)


def choose_camera(rig_file: Path, video: Path) -> RigCamera:
    """The camera of a rig file that recorded this video: the only one, or the one named like the video."""
    rig = read_rig(rig_file)
    if len(rig.cameras) == 1:
        return next(iter(rig.cameras.values()))
    name = unicodedata.normalize("NFC", video.stem)
    if name in rig.cameras:
        return rig.cameras[name]
    names = ", ".join(rig.cameras)
    raise InputError(f"knows cameras {names}, none named {name}", file=rig_file, remedy="keep one of them")


def read_telemetry(file: Path) -> TelemetryFile:
    """Read telemetry.csv: time,qw,qx,qy,qz[,north,east,down]; the quaternion is ned_from_body.

    Rows with NaN, empty cells, no rotation or a repeated time are discarded and counted.
    Raises InputError: file, line, what, remedy.
    """
    if file.suffix.lower() in (".bin", ".ulg", ".srt"):
        remedy = "give the .tlog, or export a telemetry.csv with time,qw,qx,qy,qz[,north,east,down]"
        why = ": subtitles have no attitude" if file.suffix.lower() == ".srt" else ""
        raise InputError(f"{file.suffix} telemetry can't be read by this version{why}", file=file, remedy=remedy)
    cells = read_csv_table(file, "telemetry", ("time", *_QUATERNION), (*_POSITION, *_GEODETIC))
    position = _POSITION if cells.columns.keys() >= set(_POSITION) else ()
    table = np.column_stack([cells.numbers_or_gaps(name) for name in ("time", *_QUATERNION, *position)])
    length = np.linalg.norm(table[:, 1:5], axis=1)
    usable = np.isfinite(table[:, :5]).all(axis=1) & (length > 0.5) & (length < 2.0)
    if not usable.any():
        other = ": its quaternions are not of length 1" if np.isfinite(table[:, :5]).all(axis=1).any() else ""
        raise InputError(
            f"no usable row{other}", file=file, line=1, remedy="record telemetry with attitude quaternions"
        )
    left_out, table = int((~usable).sum()), table[usable]
    back = int((np.diff(table[:, 0]) < 0.0).sum())
    table = table[np.argsort(table[:, 0], kind="stable")]
    fresh = np.r_[True, np.diff(table[:, 0]) > 0]
    left_out += int((~fresh).sum())
    table = table[fresh]
    # Positions often come less often than attitudes.
    placed = np.isfinite(table[:, 5:]).all(axis=1) & (table.shape[1] == 8)
    stds = np.zeros(len(table))
    if placed.any() and not placed.all():
        known = [(row[0], row[5:]) for row in table[placed]]
        table[~placed, 5:], stds[~placed] = interpolate_positions(known, table[~placed, 0])
    unused = () if position else tuple(name for name in (*_POSITION, *_GEODETIC) if name in cells.columns)
    return TelemetryFile(tuple(map(_sample, table, stds)), left_out, back, unused=unused)


def _sample(row: Floats, position_std: float) -> Telemetry:
    """A sample from a row with time, quaternion and, if present, position; and the std [m] of that."""
    position = row[5:8].copy() if len(row) == 8 and np.isfinite(row[5:8]).all() else None
    return Telemetry(float(row[0]), so3.from_quaternion(row[1:5]), position, float(position_std))


def check_clock(samples: Sequence[Telemetry], file: Path, start: float, end: float) -> list[str]:
    """A warning if more than a second of the video's time span has no sample within a second, as on another clock.

    Raises InputError if all of it has none.
    """
    times = np.array([sample.time for sample in samples])
    shown = f"times {times[0]:.1f} to {times[-1]:.1f} s, but the video's are {start:.1f} to {end:.1f} s"
    remedy = "give times on the video's clock, 0 = its first frame, in seconds"
    covered = np.clip(np.r_[start - 1.0, times, end + 1.0], start - 1.0, end + 1.0)
    empty = float(np.maximum(np.diff(covered) - 2.0, 0.0).sum())
    outside = times[-1] < start - 1.0 or times[0] > end + 1.0
    if outside or (end > start and end - start - 1e-6 < empty < math.inf):
        raise InputError(shown, file=file, remedy=remedy)
    if not 1.0 < empty < math.inf:
        return []
    return [f"{file}: no sample for {empty:.1f} s of the video: {shown}; {remedy}"]


def positions_fit(
    lens: Intrinsics, mounting: Floats, samples: Sequence[Telemetry], first: TrackedFrame, target: Box
) -> bool:
    """Whether the target of the first frame has a plausible length by the telemetry's positions, or no place at all."""
    track = TelemetryTrack(mounting)
    for sample in samples:
        if sample.time <= first.time + _TELEMETRY_LOOKAHEAD_S:
            track.add(sample)
    frame = frame_from_telemetry(ImagePlane((lens.width, lens.height), lens), track, first.time, target)
    return frame is None or frame.kind == "metric"


def count_frames(video: Path) -> int:
    """Number of frames of a video according to its header, or of images in a folder; 0 if unknown."""
    if video.is_dir():
        return len(image_files(video))
    capture = cv2.VideoCapture(str(video))
    count = capture.get(cv2.CAP_PROP_FRAME_COUNT) if capture.isOpened() else 0.0
    capture.release()
    return int(count) if math.isfinite(count) and 0 < count < 1e9 else 0


def track_recording(
    recording: Playback,
    tracker: Tracker,
    target: Box,
    *,
    start: int = 0,
    telemetry: Sequence[Telemetry] = (),
    georeference: Georeference | None = None,
    show: Callable[[Image, TrackedFrame], object] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[TrackedFrame]:
    """Run a tracker over an opened recording, from frame ``start`` on.

    georeference: corrects positions to the telemetry's frame. show: called with every image and its estimate.
    progress: called with the index of every decoded frame.
    Raises InputError if the recording ends before ``start``, and the tracker's errors about the target.
    """
    waiting = iter(telemetry)
    sample = next(waiting, None)
    first: float | None = None
    count = 0
    while (frame := recording.read(0.0)) is not None:
        moment = frame.device_time_ns / NANOSECONDS
        first = moment if first is None else first
        time = moment - first
        if progress is not None:
            progress(count)
        if count >= start:
            while sample is not None and sample.time <= time + _TELEMETRY_LOOKAHEAD_S:
                tracker.handle_telemetry(sample)
                if georeference is not None:
                    georeference.add(sample)
                sample = next(waiting, None)
            if count == start:
                estimate = tracker.begin(frame.image, time, target)
            else:
                estimate = tracker.handle_frame(frame.image, time)
            if georeference is not None:
                estimate = georeference.corrected(estimate, time)
            tracked = TrackedFrame(count, time, estimate)
            if show is not None:
                show(frame.image, tracked)
            yield tracked
        count += 1
    if count <= start:
        what = f"the video ends after {count} frames, before --start {start}"
        raise InputError(what, remedy="give a smaller --start")


def track_text(rows: Sequence[TrackedFrame]) -> str:
    """Text of track.csv; the ground-plane columns and the basis only if any frame has them."""
    metric = any(math.isfinite(row.estimate.north) for row in rows)
    based = any(row.estimate.basis is not None for row in rows)
    lines = [",".join(COLUMNS + (GROUND_COLUMNS if metric else ()) + ((BASIS,) if based else ()))]
    for row in rows:
        e = row.estimate
        lost = e.state is TrackState.LOST
        place = ["", ""] if lost else [_cell(e.x), _cell(e.y)]
        cells = [str(row.frame), _cell(row.time), e.state.value, *place]
        cells += [_cell(value) for value in (e.width, e.height, e.heading, e.std)]
        if metric:
            cells += [_cell(value) for value in (e.north, e.east, e.speed, e.course, e.std_m)]
        if based:
            cells.append("" if e.basis is None else e.basis.value)
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def basis_summary(rows: Sequence[TrackedFrame]) -> dict[str, dict[str, int | str]]:
    """Frames by frame of reference, the best one first, each with the reason that the last of them had."""
    found: dict[str, dict[str, int | str]] = {}
    for basis in Basis:
        chosen = [row.estimate for row in rows if row.estimate.basis is basis]
        if chosen:
            found[basis.value] = {"frames": len(chosen), "reason": chosen[-1].reason}
    return found


def hypotheses_text(rows: Sequence[TrackedFrame]) -> str:
    """Text of hypotheses.csv: frames with more than one hypothesis, in descending order of weight."""
    lines = ["frame,rank,weight,x,y"]
    for row in rows:
        ranked = sorted(row.estimate.hypotheses, key=lambda hypothesis: -hypothesis.weight)
        if len(ranked) < 2:
            continue
        for rank, hypothesis in enumerate(ranked):
            cells = (_cell(value) for value in (hypothesis.weight, hypothesis.x, hypothesis.y))
            lines.append(",".join((str(row.frame), str(rank), *cells)))
    return "\n".join(lines) + "\n"


def _cell(value: float) -> str:
    return f"{value:.17g}" if math.isfinite(value) else ""


def draw(image: Image, tracked: TrackedFrame) -> Image:
    """The image on a larger canvas (h, w, 3) with road, tracks, paths, particles and the estimate; even sizes."""
    height, width = image.shape[:2]
    scale = min(1.0, _MAX_CANVAS_PX / (width * (1 + 2 * _MARGIN)))
    canvas_size = tuple(int(side * (1 + 2 * _MARGIN) * scale) // 2 * 2 for side in (width, height))
    canvas = np.full((canvas_size[1], canvas_size[0], 3), 28, np.uint8)
    small = cv2.resize(image, (int(width * scale), int(height * scale)), interpolation=cv2.INTER_AREA)
    x0, y0 = int(width * _MARGIN * scale), int(height * _MARGIN * scale)
    canvas[y0 : y0 + small.shape[0], x0 : x0 + small.shape[1]] = small
    estimate = tracked.estimate
    for name, points in estimate.layers.items():
        dots(canvas, _to_canvas(points, scale, x0, y0), _LAYERS.get(name, _OTHER_LAYER), 2)
    if estimate.particles is not None:
        dots(canvas, _to_canvas(estimate.particles, scale, x0, y0), _PARTICLE, 2)
    cv2.rectangle(canvas, (x0, y0), (x0 + small.shape[1] - 1, y0 + small.shape[0] - 1), (255, 255, 255), 1)
    colour = _COLOURS[estimate.state]
    for hypothesis in estimate.hypotheses:
        at = _to_canvas(np.array([[hypothesis.x, hypothesis.y]]), scale, x0, y0)[0]
        if _drawable(at):
            cv2.circle(canvas, (int(at[0]), int(at[1])), 5, colour, 1, cv2.LINE_AA)
    at = _to_canvas(np.array([[estimate.x, estimate.y]]), scale, x0, y0)[0]
    if _drawable(at) and estimate.state is not TrackState.LOST:
        half = 0.5 * scale * np.array([estimate.width, estimate.height])
        if np.isfinite(half).all():
            low, high = (at - half).astype(int), (at + half).astype(int)
            cv2.rectangle(canvas, (int(low[0]), int(low[1])), (int(high[0]), int(high[1])), colour, 2, cv2.LINE_AA)
        if np.isfinite(estimate.std):
            radius = int(min(2.0 * estimate.std * scale, 4000.0))
            cv2.circle(canvas, (int(at[0]), int(at[1])), radius, colour, 1, cv2.LINE_AA)
    text = f"{tracked.frame}  {tracked.time:.2f} s  {estimate.state.value}"
    cv2.putText(canvas, text, (12, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA)
    if estimate.basis is not None:
        why = f"{estimate.basis.value}: {estimate.reason}"
        cv2.putText(canvas, why, (12, 48), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (200, 200, 200), 1, cv2.LINE_AA)
    return canvas


def _to_canvas(points: Floats, scale: float, x0: int, y0: int) -> Floats:
    return np.asarray(points * scale + [x0, y0], dtype=np.float64)


def _drawable(at: Floats) -> bool:
    return bool(np.isfinite(at).all() and np.abs(at).max() < 1e4)
