"""The rig (rig.toml): cameras, their prior intrinsics and poses, and the data that fix gauge and scale."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_toml, toml_line
from protocols.core.names import check_name, is_name
from protocols.core.ranges import (
    MAX_CAMERAS,
    MAX_DISTORTION,
    MAX_FOCAL,
    MAX_FPS,
    MAX_IMAGE_SIDE,
    MAX_LENGTH,
    MAX_TURN,
    MIN_FOCAL,
    MIN_STD,
)
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}
CLOCKS = ("independent", "shared")
MEASURED_FOCAL_STD = 0.02
"""A lens whose focal length has at most this relative std counts as measured, all but the focal length."""
MAX_READOUT_S = 0.06
"""Upper bound [s] of a rolling shutter's readout, from an image's first row to its last."""
_MAX_READOUT_INTERVALS = 1.25  # frame intervals: an answer's estimated readout is at most that, and is read again
_MAX_POINTS = 20_000  # of all rigid bodies
_POSITION_TOLERANCE = 1e-3  # relative: position and translation may differ by rounding, not by more
_KEYS = {
    *("name", "size", "fps", "matrix", "distortions", "fisheye", "focal_std", "readout", "ball_outline", "position"),
    *("position_std", "rotation", "rotation_std", "translation", "body_from_camera", "up"),
}
_METADATA_KEYS = {"units", "clock", "reference", "distances", "wand", "up", "bodies"}
_OPENCV_COUNTS = (4, 5, 8, 12, 14)  # of distortion coefficients, without those of a fisheye
_LIKENESS = 0.8  # of difflib: unit for units is 0.89, and no key of a calibration.toml is above 0.78


@dataclass(frozen=True, slots=True, eq=False)
class RigCamera:
    """One camera of the rig and its prior data.

    size: (width, height) [px]. fps: nominal, 0 = not given. intrinsics: None = uncalibrated.
    position: centre in the world [rig units]. rotation: (3, 3) camera from world.
    position_std: (3,) [rig units]. rotation_std: (3,) [rad]. body_from_camera: (3, 3).
    focal_std: relative std of the focal length; 0 = none is given, and it is exact.
    up: (3,) unit vector, away from the ground in the camera's own axes, as its accelerometer shows at rest.
    ball_outline: whether its rows are centroids of spheres' contours of diameter ``size``, detected without a known
    lens and so not yet corrected to the projection of the centre (``protocols/geometry/camera.py``).
    readout: seconds from the first row of an image to its last (rolling shutter); None = not given.
    table: the camera's table as it is in the file, including keys that this version does not know.
    """

    name: str
    size: tuple[int, int]
    fps: float = 0.0
    intrinsics: Intrinsics | None = None
    position: Floats | None = None
    rotation: Floats | None = None
    position_std: Floats | None = None
    rotation_std: Floats | None = None
    body_from_camera: Floats | None = None
    focal_std: float = 0.0
    up: Floats | None = None
    ball_outline: bool = False
    readout: float | None = None
    table: dict[str, Any] = field(default_factory=dict)

    @property
    def is_measured(self) -> bool:
        """Whether the lens was measured: it is given, and no guess (a data sheet's)."""
        return self.intrinsics is not None and self.focal_std <= MEASURED_FOCAL_STD

    def pose_table(self) -> dict[str, Any]:
        """What is known of pose and uncertainty, as rig.toml and bus messages have it."""
        rotation = None if self.rotation is None else so3.log(self.rotation)
        known = {
            "rotation": rotation,
            "position": self.position,
            "position_std": self.position_std,
            "rotation_std": self.rotation_std,
        }
        return {key: value.tolist() for key, value in known.items() if value is not None}


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """All cameras in the file's order, and the metadata that fixes gauge and scale.

    units: of every length. clock: "independent" or "shared". distances: (camera, camera, length). scale_bars: (label,
    label, length), two points at a fixed distance. up: a world vector (3,), or the name of a camera that knows it
    (``up_in_camera``), or None.
    """

    cameras: dict[str, RigCamera]
    units: str = "m"
    clock: str = "independent"
    distances: tuple[tuple[str, str, float], ...] = ()
    up: Floats | str | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    file: Path | None = None
    scale_bars: tuple[tuple[str, str, float], ...] = ()
    bodies: dict[str, dict[str, Floats]] = field(default_factory=dict)
    """Rigid bodies (boards, tags): by name, the points (3,) of their labels on the body [rig units]."""

    @property
    def bodies_metric(self) -> bool:
        """Whether the bodies' points are in rig units, rather than in squares of an unknown size."""
        return bool(self.bodies) and self.metadata.get("bodies_scale", "metric") == "metric"

    @property
    def shared_clock(self) -> bool:
        """Whether all cameras share one clock, so that rows of the same time correspond."""
        return self.clock == "shared"

    def up_in_camera(self, camera: str) -> Floats:
        """Up (3,) in a camera's axes: as its table gives it, otherwise the camera is taken as levelled."""
        up = self.cameras[camera].up
        return np.array([0.0, -1.0, 0.0]) if up is None else up


def misspelt_keys(rig: Rig) -> tuple[str, ...]:
    """Warnings for keys that are not read and look like one that is: they are kept, so that they are no errors."""
    tables = [*((name, camera.table, _KEYS) for name, camera in rig.cameras.items())]
    return tuple(
        f"[{where}] {key} is no key of a rig and has no effect: did you mean {close[0]}?"
        for where, table, known in (*tables, ("metadata", rig.metadata, _METADATA_KEYS))
        for key in table
        if key not in known and (close := difflib.get_close_matches(key.lower(), known, 1, _LIKENESS))
    )


class _Table:
    """One table of a TOML file with checks that name file and line."""

    def __init__(self, values: dict[str, Any], where: str, file: Path, text: str) -> None:
        self.values, self.where, self.file, self.text = values, where, file, text

    def line(self, key: str | None = None) -> int | None:
        """The line of the table's header, or of ``key`` in it, as far as a plain text scan finds it."""
        return toml_line(self.text, self.where, key)

    def fail(self, key: str | None, what: str, remedy: str) -> InputError:
        return InputError(f"[{self.where}] {what}", file=self.file, line=self.line(key), remedy=remedy)

    def numbers(self, key: str, count: int | tuple[int, ...], what: str, most: float = MAX_LENGTH) -> Floats | None:
        """A list of numbers within ±most, or None where the key is absent."""
        if key not in self.values:
            return None
        remedy = f"give {key} = {what}"
        try:
            array = np.array(self.values[key], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise self.fail(key, f"{key} is not a list of numbers", remedy) from None
        shape = (count,) if isinstance(count, int) else count
        if array.shape != shape:
            raise self.fail(key, f"{key} has shape {list(array.shape)}, not {list(shape)}", remedy)
        if not np.isfinite(array).all() or np.abs(array).max(initial=0.0) > most:
            raise self.fail(key, f"{key} is not finite, or beyond ±{most:g}", remedy)
        return array

    def std(self, key: str, what: str) -> Floats | None:
        """A number >= 0, or three; 0 = exactly known."""
        value = self.values.get(key)
        if value is None:
            return None
        table = self if isinstance(value, list) else _Table({key: [value] * 3}, self.where, self.file, self.text)
        array = table.numbers(key, 3, what)
        if array is not None and not (array >= 0).all():
            raise self.fail(key, f"{key} is negative", f"give {key} = {what}; 0 means exactly known")
        return None if array is None else np.where(array < MIN_STD, 0.0, array)


def read_rig(file: Path) -> Rig:
    """Read rig.toml (or a calibration.toml, which holds the same tables and more).

    Raises InputError: file, line, what is wrong, what to do.
    """
    values, text = read_toml(file, "rig file")
    return parse_rig(values, file, text)


def parse_rig(values: dict[str, Any], file: Path, text: str) -> Rig:
    """The rig of parsed tables. file, text: where they come from, for errors. Raises InputError as ``read_rig``."""
    cameras: dict[str, RigCamera] = {}
    metadata = values.pop("metadata", {})
    if not isinstance(metadata, dict):
        raise InputError("metadata is not a table", file=file, remedy="write [metadata] and its keys below it")
    meta = _Table(metadata, "metadata", file, text)
    if len(values) > MAX_CAMERAS:
        raise InputError(f"{len(values)} cameras, at most {MAX_CAMERAS}", file=file, remedy="split the rig")
    for name, table in values.items():
        if not isinstance(table, dict):
            raise InputError(
                f"{name} = … stands outside a camera's table",
                file=file,
                remedy="put it under [camera] or [metadata]",
            )
        camera = _read_camera(_Table(table, name, file, text))
        if camera.name in cameras:
            raise InputError(f"two cameras are named {camera.name!r}", file=file, remedy="give each its own name")
        cameras[camera.name] = camera
    if not cameras:
        raise InputError("no camera in it", file=file, remedy="add a table per camera: [cam0] name, size, matrix, …")
    units = metadata.get("units", "m")
    if not isinstance(units, str) or units not in METRES_PER_UNIT:
        raise meta.fail("units", f"units = {units!r}", 'use "m", "cm" or "mm"')
    clock = metadata.get("clock", "independent")
    if clock not in CLOCKS:
        raise meta.fail("clock", f"clock = {clock!r}", 'use "independent" or "shared"')
    reference = metadata.get("reference")
    if reference is not None and (not isinstance(reference, str) or reference not in cameras):
        raise meta.fail("reference", f"reference = {reference!r} is no camera", "use a camera of this file")
    distances, up = _read_distances(meta, cameras), _read_up(meta, cameras)
    return Rig(cameras, units, clock, distances, up, dict(metadata), file, _read_scale_bars(meta), _read_bodies(meta))


def _read_bodies(meta: _Table) -> dict[str, dict[str, Floats]]:
    remedy = 'give [metadata.bodies.board] and its points below it: "0" = [0.03, 0.03, 0.0]'
    bodies = meta.values.get("bodies", {})
    if not isinstance(bodies, dict) or not all(isinstance(body, dict) for body in bodies.values()):
        raise meta.fail("bodies", "bodies is not a table of tables", remedy)
    if sum(len(body) for body in bodies.values()) > _MAX_POINTS:
        raise meta.fail("bodies", f"more than {_MAX_POINTS} points", "keep the points that are seen")
    owner: dict[str, str] = {}
    for name, body in bodies.items():
        for label in body:
            if label in owner:
                raise meta.fail("bodies", f"point {label!r} is on {owner[label]} and on {name}", "keep one")
            owner[label] = name
    points = {}
    for name, body in bodies.items():
        table = _Table(body, "metadata", meta.file, meta.text)
        read = {label: table.numbers(label, 3, "[x, y, z]") for label in body}
        points[name] = {label: point for label, point in read.items() if point is not None}
    return points


def _read_scale_bars(meta: _Table) -> tuple[tuple[str, str, float], ...]:
    remedy = 'give wand = [["tip", "grip", 0.5]]: two labels and the length between them'
    return _read_lengths(meta, "wand", ("wand", "label"), remedy)


def _read_distances(meta: _Table, cameras: dict[str, RigCamera]) -> tuple[tuple[str, str, float], ...]:
    remedy = 'give distances = [["cam0", "cam1", 3.42]]'
    return _read_lengths(meta, "distances", ("distance", "camera"), remedy, cameras)


def _read_lengths(
    meta: _Table, key: str, words: tuple[str, str], remedy: str, known: dict[str, RigCamera] | None = None
) -> tuple[tuple[str, str, float], ...]:
    """Lengths between two ends. words: for one of them and for an end. known: cameras that the ends must be."""
    rows = meta.values.get(key, [])
    what, end = words
    out = []
    for row in rows if isinstance(rows, list) else [rows]:
        shape = isinstance(row, list) and len(row) == 3 and all(isinstance(name, str) for name in row[:2])
        if not (shape and isinstance(row[2], int | float) and not isinstance(row[2], bool)):
            raise meta.fail(key, f"{what} {row!r} is not [{end}, {end}, length]", remedy)
        for name in row[:2]:
            if known is not None and name not in known:
                raise meta.fail(key, f"{what} to an unknown {end} {name!r}", f"use a {end} of this file")
        if not MIN_STD <= row[2] <= MAX_LENGTH or row[0] == row[1]:
            raise meta.fail(key, f"{what} {row!r} is not a length between two {end}s", remedy)
        out.append((row[0], row[1], float(row[2])))
    return tuple(out)


def _read_up(meta: _Table, cameras: dict[str, RigCamera]) -> Floats | str | None:
    up = meta.values.get("up")
    if up is None:
        knowing = [name for name, camera in cameras.items() if camera.up is not None]
        if len(knowing) > 1:
            names = ", ".join(knowing)
            raise meta.fail(None, f"several cameras give up ({names})", f'say which one counts: up = "{knowing[0]}"')
        return knowing[0] if knowing else None
    if isinstance(up, str):
        if up not in cameras:
            raise meta.fail("up", f"up names an unknown camera {up!r}", "use a camera of this file, or [x, y, z]")
        return up
    vector = meta.numbers("up", 3, "[x, y, z] or the name of a levelled camera")
    if vector is None or float(np.linalg.norm(vector)) < 1e-9:
        raise meta.fail("up", "up has no direction", "give up = [x, y, z] or the name of a levelled camera")
    return np.asarray(vector / np.linalg.norm(vector))


def _read_camera(table: _Table) -> RigCamera:
    name = table.values.get("name", table.where)
    if not isinstance(name, str):
        raise table.fail("name", f"name = {name!r} is not text", 'give name = "cam0"')
    if not is_name(name):
        check_name(name, file=table.file, line=table.line("name" if "name" in table.values else None))
    # aniposelib's own files call their tables cam_0, cam_1, … and put the camera's name inside.
    theirs = re.fullmatch(r"cam_\d+", table.where) is not None
    if name != table.where and not theirs:
        raise table.fail("name", f"name = {name!r} differs from the table's key", "make them the same")
    for key, value in table.values.items():
        if isinstance(value, dict) and "size" in value and "size" not in table.values:
            inner = _Table(value, f"{table.where}.{key}", table.file, table.text)
            raise inner.fail(None, "is a table in a table", f'a full stop in a name needs quotes: ["{inner.where}"]')
    size = table.numbers("size", 2, "[width, height]", MAX_IMAGE_SIDE)
    if size is None or not (size > 0).all() or not (size == size.round()).all():
        raise table.fail("size", "size is missing or not two whole numbers", "give size = [width, height] in pixels")
    fps = table.values.get("fps", 0.0)
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 <= fps <= MAX_FPS:
        raise table.fail("fps", f"fps = {fps!r} is not a frame rate", "give fps = 30.0")
    width, height = int(size[0]), int(size[1])
    position, rotation = _read_pose(table)
    return RigCamera(
        name=name,
        size=(width, height),
        fps=float(fps),
        intrinsics=_read_intrinsics(table, width, height),
        position=position,
        rotation=rotation,
        position_std=table.std("position_std", "a length, or three"),
        rotation_std=table.std("rotation_std", "radians, or three"),
        body_from_camera=_read_body(table),
        focal_std=_read_focal_std(table),
        up=_read_up_of_camera(table),
        ball_outline=_read_ball_outline(table),
        readout=_read_readout(table, float(fps)),
        table=dict(table.values),
    )


def _read_up_of_camera(table: _Table) -> Floats | None:
    vector = table.numbers("up", 3, "[x, y, z], a direction in this camera's axes (x right, y down, z ahead)")
    if vector is None:
        return None
    if float(np.linalg.norm(vector)) < 1e-9:
        raise table.fail("up", "up has no direction", "give up = [x, y, z] in this camera's axes; levelled: [0, -1, 0]")
    return np.asarray(vector / np.linalg.norm(vector))


def _read_ball_outline(table: _Table) -> bool:
    value = table.values.get("ball_outline", False)
    if not isinstance(value, bool):
        raise table.fail("ball_outline", f"ball_outline = {value!r}", "give true or false")
    return value


def longest_readout(fps: float) -> float:
    """The longest readout [s] that a rig.toml may hold: a sensor is read before its next frame. fps: 0 = unknown."""
    return min(MAX_READOUT_S, _MAX_READOUT_INTERVALS / fps) if fps > 0.0 else MAX_READOUT_S


def _read_readout(table: _Table, fps: float) -> float | None:
    value = table.values.get("readout")
    if value is None:
        return None
    if not isinstance(value, int | float) or isinstance(value, bool) or not -MAX_READOUT_S <= value <= MAX_READOUT_S:
        remedy = "give the seconds from the image's first row to its last, as 0.02; below 0 if the last is read first"
        raise table.fail("readout", f"readout = {value!r}", remedy)
    if abs(value) > longest_readout(fps):
        longer = f"readout = {value!r} is longer than the {1e3 / fps:.3g} ms between two frames at fps = {fps:g}"
        raise table.fail("readout", longer, "a sensor is read before its next frame: correct one of the two")
    return float(value)


def _read_focal_std(table: _Table) -> float:
    """The relative std of a focal length; 0 without one."""
    value = table.values.get("focal_std", 0.0)
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 <= value <= 2.0:
        remedy = "give the focal length's relative std, as 0.1 for 10 %"
        raise table.fail("focal_std", f"focal_std = {value!r}", remedy)
    return float(value)


def _read_body(table: _Table) -> Floats | None:
    matrix = table.numbers("body_from_camera", (3, 3), "a 3x3 rotation")
    if matrix is not None and not (np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) and np.linalg.det(matrix) > 0):
        raise table.fail(
            "body_from_camera", "body_from_camera is not a rotation", "give orthonormal rows, determinant 1"
        )
    return matrix


def _read_intrinsics(table: _Table, width: int, height: int) -> Intrinsics | None:
    matrix = table.numbers("matrix", (3, 3), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", MAX_FOCAL)
    fisheye = table.values.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise table.fail("fisheye", f"fisheye = {fisheye!r}", "give true or false")
    given = table.values.get("distortions")
    count, names = (4, "[k1, k2, k3, k4]") if fisheye else (5, "[k1, k2, p1, p2, k3]")
    if not fisheye and isinstance(given, list) and len(given) in _OPENCV_COUNTS:
        count = len(given)
    distortions = table.numbers("distortions", count, names, MAX_DISTORTION)
    if matrix is None:
        return None
    if not (
        matrix[0, 0] >= MIN_FOCAL
        and matrix[1, 1] >= MIN_FOCAL
        and np.allclose(matrix[2], [0, 0, 1])
        and matrix[1, 0] == 0
    ):
        raise table.fail("matrix", "matrix is not a camera matrix", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    try:
        distortions = opencv_distortions(np.zeros(4) if distortions is None else distortions, fisheye)
    except InputError as error:
        raise table.fail("distortions", error.what, error.remedy) from None
    return Intrinsics(width, height, matrix, distortions, fisheye)


def opencv_distortions(given: Floats, fisheye: bool) -> Floats:
    """Coefficients (5,), of a fisheye (4,), from OpenCV's 0, 4, 5 or more. Raises InputError for another model."""
    kept = 4 if fisheye else 5
    if np.any(given[kept:]):
        what = f"{len(given)} distortion coefficients: the rational and the thin-prism model are not known here"
        raise InputError(what, remedy="calibrate with 4 or 5; the first of these alone are another lens")
    if len(given) not in (0, *_OPENCV_COUNTS):
        raise InputError(f"{len(given)} distortion coefficients", remedy="give 4 or 5")
    return np.append(given[:kept], np.zeros(max(0, kept - len(given))))


def _read_pose(table: _Table) -> tuple[Floats | None, Floats | None]:
    """Position (3,) and rotation (3, 3); a translation is turned into a position."""
    position = table.numbers("position", 3, "[x, y, z]")
    rodrigues = table.numbers("rotation", 3, "a Rodrigues vector, camera from world", MAX_TURN)
    if rodrigues is not None and float(np.linalg.norm(rodrigues)) > 2.0 * np.pi:
        raise table.fail("rotation", "rotation is more than a whole turn", "give a Rodrigues vector in radians")
    translation = table.numbers("translation", 3, "camera from world")
    rotation = None if rodrigues is None else so3.exp(rodrigues)
    if translation is None:
        return position, rotation
    if rotation is None:
        if position is not None:
            return position, None
        raise table.fail("translation", "translation without rotation is no position", "give rotation too, or position")
    centre = -rotation.T @ translation
    if position is None:
        return np.asarray(centre), rotation
    if np.linalg.norm(position - centre) > _POSITION_TOLERANCE * max(float(np.linalg.norm(position)), 1e-3):
        raise table.fail(
            "position",
            f"position {position.round(4).tolist()} contradicts translation, which puts the camera at "
            f"{centre.round(4).tolist()}",
            "remove one of the two, or correct it",
        )
    return position, rotation


def parse_camera_table(values: dict[str, Any], where: str, file: Path, text: str) -> RigCamera:
    """One camera's table of a file that calls it ``where``, checked as rig.toml's are. Raises InputError."""
    return _read_camera(_Table(values, where, file, text))
