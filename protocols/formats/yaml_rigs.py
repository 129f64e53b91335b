"""Calibrations in YAML: OpenCV's FileStorage (one file per camera) and Kalibr's camchain.

Kalibr: ``T_cn_cnm1`` transforms points from the previous camera's axes into this camera's, ``T_cam_imu`` from the
body's axes, which are the world here; ``t_imu = t_cam + timeshift_cam_imu``. It has no clock rate: the shift is that in
the middle of the recording, and the whole time map is written as additional keys.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from protocols.core.clocks import TimeMap
from protocols.core.errors import InputError
from protocols.core.files import MAX_TOML, read_text
from protocols.core.names import check_name, key_segment, name_from_file
from protocols.formats.cameras import (
    ExportedFiles,
    ForeignCamera,
    ForeignRig,
    check_skew,
    fit_without_k3,
    parse_array,
    parse_time_map,
    pinhole_matrix,
)
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration
from protocols.session.rig import METRES_PER_UNIT, opencv_distortions

_MAX_CHAIN_ERROR = 1e-3  # m, rad: two paths through the cameras agree to rounding
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")
_FISHEYE = ("fisheye", "equidistant", "kannala_brandt")
_PINHOLE = (
    "plumb_bob", "rational_polynomial", "radtan", "brown", "brown_conrady", "opencv", "pinhole", "perspective",
    "standard", "none", "", "rectified",
)  # fmt: skip


def load(file: Path) -> tuple[dict[str, Any], str]:
    """A YAML file's mapping and its text; OpenCV's matrices as their lists of rows. Raises InputError."""
    import yaml

    text = read_text(file, "calibration", MAX_TOML)

    class Loader(yaml.SafeLoader):
        """Safe, with OpenCV's tag, and with names as they are written: a camera may be called 007 or true."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            mapping = super().construct_mapping(node, deep)
            for key, value in node.value:
                if key.value in ("camera_name", "name") and isinstance(value, yaml.ScalarNode):
                    mapping[key.value] = value.value
            return mapping

    def matrix(loader: Any, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix)
    # OpenCV's first line, %YAML:1.0, is not valid YAML; an empty line in its place keeps the line numbers.
    plain = re.sub(r"\A%YAML:\d\.\d[^\n]*", "", text)
    try:
        values = yaml.load(plain, Loader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else None
        raise InputError(f"not YAML: {error.problem}", file=file, line=line, remedy="correct this line") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"not YAML: {error}", file=file, remedy="correct the file") from None
    if not isinstance(values, dict):
        raise InputError("holds no keys", file=file, line=1, remedy="give a calibration in YAML")
    return {str(key): value for key, value in values.items()}, text


def detect_format(values: Mapping[str, Any]) -> str | None:
    """The calibration format of a YAML file's content; None = unknown."""
    if any(isinstance(value, dict) and "intrinsics" in value for value in values.values()):
        return "kalibr"
    return "opencv" if any(key in values for key in _MATRIX) else None


def read_opencv(files: list[Path]) -> ForeignRig:
    """Read files of cv2.FileStorage or ROS' camera_info, one per camera. Raises InputError."""
    cameras: dict[str, ForeignCamera] = {}
    units: set[str] = set()
    for file in files:
        values, text = load(file)
        camera = _opencv_camera(values, text, file)
        if camera.name in cameras:
            raise InputError(f"a second camera {camera.name!r}", file=file, remedy="give each its own camera_name")
        cameras[camera.name] = camera
        unit = values.get("units")
        if unit is not None:
            if unit not in METRES_PER_UNIT:
                raise InputError(f"units: {unit!r}", file=file, line=_line(text, "units"), remedy="use m, cm or mm")
            units.add(str(unit))
    if len(units) > 1:
        raise InputError(f"units differ ({', '.join(sorted(units))})", file=files[0], remedy="bring them to one")
    return ForeignRig(cameras, units.pop() if units else None)


def write_opencv(cameras: Mapping[str, CameraCalibration], units: str) -> ExportedFiles:
    """One CAMERA.yml per camera, for cv2.FileStorage."""
    return ExportedFiles({f"{name}.yml": _opencv_text(camera, units) for name, camera in cameras.items()})


def read_kalibr(file: Path) -> ForeignRig:
    """Read a Kalibr camchain. Clock maps are relative to the first camera. Raises InputError."""
    values, text = load(file)
    cameras: dict[str, ForeignCamera] = {}
    chain: list[tuple[Floats, Floats]] | None = [(np.eye(3), np.zeros(3))]
    shifts: list[float | None] = []
    body: list[tuple[Floats, Floats] | None] = []
    lenses: dict[str, Intrinsics] = {}
    own: dict[str, TimeMap | None] = {}
    # The chain goes by the number; in Kalibr's files cam10 follows cam1.
    for key in sorted(values, key=lambda key: int(key[3:]) if re.fullmatch("cam[0-9]{1,6}", key) else -1):
        table = values[key]
        if not isinstance(table, dict) or "intrinsics" not in table:
            continue
        name = check_name(str(table.get("name", key)), file=file, line=_line(text, key))
        if name in lenses:
            what, line = f"a second camera {name!r}", _line(text, "name", key)
            raise InputError(what, file=file, line=line, remedy="give each its own name")
        lenses[name] = _kalibr_lens(table, key, text, file)
        if len(lenses) > 1:
            if "T_cn_cnm1" not in table:
                chain = None
            elif chain is not None:
                turn, shift = _transform(table["T_cn_cnm1"], f"{key} T_cn_cnm1", file, _line(text, "T_cn_cnm1", key))
                chain.append((turn @ chain[-1][0], turn @ chain[-1][1] + shift))
        line = _line(text, "T_cam_imu", key)
        body.append(_transform(table["T_cam_imu"], f"{key} T_cam_imu", file, line) if "T_cam_imu" in table else None)
        shift_at = _line(text, "timeshift_cam_imu", key)
        given = table.get("timeshift_cam_imu")
        shifts.append(
            None if given is None else float(parse_array(given, (), f"{key} timeshift_cam_imu", file, shift_at))
        )
        own[name] = parse_time_map(table, f"{key} ", file, _line(text, "time_offset", key))
    if not lenses:
        raise InputError("no camera with intrinsics in it", file=file, remedy="give Kalibr's camchain YAML")
    bodies = [pose for pose in body if pose is not None]
    whole = bodies if len(bodies) == len(lenses) else chain
    if chain is not None and len(bodies) == len(lenses):
        _check_chain(chain, bodies, list(lenses), file)
    warnings = [] if whole is not None else ["no T_cn_cnm1 and no T_cam_imu for all cameras: poses are left out"]
    timed = all(shift is not None for shift in shifts)
    for number, (name, lens) in enumerate(lenses.items()):
        pose = None if whole is None else Pose(whole[number][0], -whole[number][0].T @ whole[number][1])
        time_map = own[name]
        if time_map is None and timed:
            # t_imu = t_cam + shift for each: the first camera's clock is the reference.
            time_map = TimeMap(1.0, float(shifts[number] or 0.0) - float(shifts[0] or 0.0))
        cameras[name] = ForeignCamera(name, lens, pose, time_map)
    return ForeignRig(cameras, "m", None, tuple(warnings))


def write_kalibr(cameras: Mapping[str, CameraCalibration], name: str = "camchain.yaml") -> ExportedFiles:
    """A Kalibr camchain of cameras with lengths in metres; the body that Kalibr calls imu is the world."""
    import yaml

    warnings, document = [], {}
    before: Pose | None = None
    for number, (key, camera) in enumerate(cameras.items()):
        check_skew(camera, "Kalibr")
        lens, pose = camera.intrinsics, camera.pose
        coefficients = lens.distortions
        if not lens.fisheye:
            coefficients, warning = fit_without_k3(lens, key, "Kalibr")
            warnings += [warning] if warning else []
        a = lens.matrix
        rate, at = camera.time_map.clock_rate, camera.lag_time
        if rate != 1.0:
            drift = f"{1e6 * (rate - 1.0):+.1f} ppm"
            warnings.append(f"Kalibr has no clock rate: {key}'s timeshift is that at its time {at:.3f} s ({drift})")
        table: dict[str, Any] = {
            "cam_overlaps": [other for other in range(len(cameras)) if other != number],
            "camera_model": "pinhole",
            "distortion_coeffs": coefficients.tolist(),
            "distortion_model": "equidistant" if lens.fisheye else "radtan",
            "intrinsics": [float(value) for value in (a[0, 0], a[1, 1], a[0, 2], a[1, 2])],
            "resolution": [lens.width, lens.height],
            "rostopic": _ros_topic(key),
            "T_cam_imu": _homogeneous(pose.rotation, pose.translation),
            "timeshift_cam_imu": camera.lag,
            "name": key,
            "clock_rate": rate,
            "time_offset": camera.time_map.time_offset,
        }
        if before is not None:
            turn = pose.rotation @ before.rotation.T
            table["T_cn_cnm1"] = _homogeneous(turn, pose.rotation @ (before.position - pose.position))
        document[f"cam{number}"] = table
        before = pose
    return ExportedFiles(
        {name: yaml.safe_dump(document, default_flow_style=None, sort_keys=True, width=400)}, tuple(warnings)
    )


def write_ros(cameras: Mapping[str, CameraCalibration]) -> ExportedFiles:
    """ROS camera_info, one CAMERA.yaml a camera, which camera_info_manager and ``read_opencv`` read; no poses."""
    import yaml

    files = {}
    for name, camera in cameras.items():
        lens = camera.intrinsics
        projection = np.column_stack([lens.matrix, np.zeros(3)])
        document = {
            "image_width": lens.width,
            "image_height": lens.height,
            "camera_name": name,
            "camera_matrix": _ros_matrix(lens.matrix),
            "distortion_model": "equidistant" if lens.fisheye else "plumb_bob",
            "distortion_coefficients": _ros_matrix(lens.distortions[None]),
            "rectification_matrix": _ros_matrix(np.eye(3)),
            "projection_matrix": _ros_matrix(projection),
        }
        files[f"{name}.yaml"] = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    return ExportedFiles(files, ("a camera_info holds no poses and no clocks: intrinsics only",))


def _ros_matrix(values: Any) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def _opencv_camera(values: Mapping[str, Any], text: str, file: Path) -> ForeignCamera:
    if "camera_name" in values:
        name = check_name(str(values["camera_name"]), file=file, line=_line(text, "camera_name"))
    else:
        name = name_from_file(file.stem, file)
    key = next((key for key in _MATRIX if key in values), None)
    if key is None:
        raise InputError("no camera_matrix in it", file=file, line=1, remedy="give a calibration of cv2.FileStorage")
    matrix = parse_array(_rows(values[key]), (9,), key, file, _line(text, key)).reshape(3, 3)
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.allclose(matrix[2], [0, 0, 1])):
        raise InputError(f"{key} is no camera matrix", file=file, line=_line(text, key), remedy="correct it")
    size = [values.get(f"image_{side}", values.get(f"image_{side.title()}")) for side in ("width", "height")]
    if any(not isinstance(value, int) or value <= 0 for value in size):
        remedy = "add image_width and image_height in pixels"
        raise InputError("no image size in it", file=file, line=1, remedy=remedy)
    model = str(values.get("distortion_model", "fisheye" if values.get("fisheye_model") else "plumb_bob")).lower()
    fisheye = model in _FISHEYE
    if not fisheye and model not in _PINHOLE:
        what, line = f"distortion_model {model!r} is not known here", _line(text, "distortion_model")
        raise InputError(what, file=file, line=line, remedy="convert it to plumb_bob or equidistant")
    place = next((key for key in _DISTORTION if key in values), None)
    flat = [] if place is None else _rows(values[place])
    # Four coefficients may be plumb_bob's or equidistant's, and camera_info names its model.
    if "projection_matrix" in values and "distortion_model" not in values and flat and len(flat) == 4:
        what = "looks like ROS' camera_info, but key distortion_model is missing"
        raise InputError(what, file=file, line=_line(text, str(place)), remedy="add plumb_bob or equidistant")
    if not isinstance(flat, list):
        raise InputError(f"{place} is not numbers", file=file, line=_line(text, str(place)), remedy="give 4 or 5")
    bent = parse_array(flat, (len(flat),), str(place), file, _line(text, str(place)))
    lens = _with_distortion(size, matrix, bent, fisheye, file, _line(text, str(place)))
    pose = None
    if "R" in values and "T" in values and model != "rectified":
        turn = parse_array(_rows(values["R"]), (9,), "R", file, _line(text, "R")).reshape(3, 3)
        shift = parse_array(_rows(values["T"]), (3,), "T", file, _line(text, "T"))
        pose = _pose(turn, shift, "R", file, _line(text, "R"))
    return ForeignCamera(name, lens, pose, parse_time_map(values, "", file, _line(text, "time_offset")))


def _with_distortion(
    size: list[Any], matrix: Floats, bent: Floats, fisheye: bool, file: Path, line: int | None
) -> Intrinsics:
    """A lens with OpenCV's distortion coefficients. Raises InputError."""
    try:
        return Intrinsics(int(size[0]), int(size[1]), matrix, opencv_distortions(bent, fisheye), fisheye)
    except InputError as error:
        raise InputError(error.what, file=file, line=line, remedy=error.remedy) from None


def _opencv_text(camera: CameraCalibration, units: str) -> str:
    import cv2
    import yaml

    lens, pose = camera.intrinsics, camera.pose
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY | cv2.FileStorage_FORMAT_YAML)
    storage.write("camera_name", camera.name)
    storage.write("image_width", lens.width)
    storage.write("image_height", lens.height)
    storage.write("distortion_model", "fisheye" if lens.fisheye else "plumb_bob")
    storage.write("camera_matrix", lens.matrix)
    storage.write("distortion_coefficients", lens.distortions.reshape(1, -1))
    storage.write("R", pose.rotation)
    storage.write("T", pose.translation.reshape(3, 1))
    storage.write("units", units)
    storage.write("time_offset", camera.time_map.time_offset)
    storage.write("clock_rate", camera.time_map.clock_rate)
    text = str(storage.releaseAndGetString())
    # OpenCV writes every name without quotes; YAML would read some as a number, a truth value or not at all.
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_-]*", camera.name) or yaml.safe_load(camera.name) != camera.name:
        text = re.sub(r"(?m)^camera_name: .*$", f'camera_name: "{camera.name}"', text, count=1)
    return text


def _kalibr_lens(table: Mapping[str, Any], key: str, text: str, file: Path) -> Intrinsics:
    line = _line(text, "intrinsics", key)
    if table.get("camera_model", "pinhole") != "pinhole":
        what = f"{key} has camera_model {table['camera_model']!r}"
        raise InputError(what, file=file, line=_line(text, "camera_model", key), remedy="only pinhole is known here")
    fx, fy, cx, cy = parse_array(table["intrinsics"], (4,), f"{key} intrinsics", file, line)
    if not (fx > 0 and fy > 0):
        raise InputError(f"{key} has a focal length <= 0", file=file, line=line, remedy="correct it")
    size = parse_array(table.get("resolution"), (2,), f"{key} resolution", file, _line(text, "resolution", key))
    model = str(table.get("distortion_model", "none"))
    at = _line(text, "distortion_model", key)
    if model not in ("radtan", "equidistant", "none"):
        remedy = "calibrate with radtan or equidistant"
        raise InputError(f"{key} has distortion_model {model!r}", file=file, line=at, remedy=remedy)
    fisheye = model == "equidistant"
    bent = np.zeros(4)
    if model != "none":
        where = _line(text, "distortion_coeffs", key)
        bent = parse_array(table.get("distortion_coeffs"), (4,), f"{key} distortion_coeffs", file, where)
    matrix = pinhole_matrix(float(fx), float(fy), float(cx), float(cy))
    return Intrinsics(int(size[0]), int(size[1]), matrix, bent if fisheye else np.r_[bent, 0.0], fisheye)


def _check_chain(
    chain: list[tuple[Floats, Floats]], bodies: list[tuple[Floats, Floats]], names: list[str], file: Path
) -> None:
    """Raise InputError where T_cam_imu contradicts T_cn_cnm1."""
    for name, (turn, shift), (body_turn, body_shift) in zip(names, chain, bodies, strict=True):
        expected = turn @ bodies[0][0], turn @ bodies[0][1] + shift
        size = max(1.0, float(np.linalg.norm(expected[1])))
        if max(np.abs(expected[0] - body_turn).max(), np.abs(expected[1] - body_shift).max() / size) > _MAX_CHAIN_ERROR:
            remedy = "remove one of the two"
            raise InputError(f"T_cam_imu of {name} contradicts the chain of T_cn_cnm1", file=file, remedy=remedy)


def _transform(value: Any, what: str, file: Path, line: int | None) -> tuple[Floats, Floats]:
    matrix = parse_array(value, (4, 4), what, file, line)
    pose = _pose(matrix[:3, :3], matrix[:3, 3], what, file, line)
    return pose.rotation, matrix[:3, 3].copy()


def _pose(turn: Floats, shift: Floats, what: str, file: Path, line: int | None) -> Pose:
    if not (np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) and np.linalg.det(turn) > 0):
        raise InputError(f"{what} is no rotation", file=file, line=line, remedy="give orthonormal rows, determinant 1")
    # A matrix that is orthonormal to rounding is kept bit for bit.
    exact = np.abs(turn @ turn.T - np.eye(3)).max() < 1e-12
    rotation = turn.copy() if exact else so3.nearest(turn)
    return Pose(rotation, -rotation.T @ shift)


def _homogeneous(rotation: Floats, translation: Floats) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return [[float(value) for value in row] for row in matrix]


def _ros_topic(name: str) -> str:
    """The topic of a camera's images. ROS allows ASCII letters, digits and ``_`` in it: other bytes become ``_XX_``.

    Such names have a namespace of their own, so that different cameras have different topics.
    """
    segment = key_segment(name)
    if segment == name:
        return f"/{name}/image_raw"
    return "/encoded/" + re.sub("%(..)", r"_\1_", segment.replace("_", "%5F").replace("-", "%2D")) + "/image_raw"


def _rows(value: Any) -> Any:
    """The elements of a matrix (OpenCV's and ROS' mapping with data, or nested lists) as one list."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        return [item for row in value for item in row]
    return value


def _line(text: str, key: str, within: str | None = None) -> int | None:
    """The line of a key, below that of ``within`` where given."""
    inside = within is None
    for number, row in enumerate(text.splitlines(), 1):
        if within is not None and re.match(rf"[\"']?{re.escape(within)}[\"']?\s*:", row):
            inside = True
        elif within is not None and inside and re.match(r"\S", row):
            return None
        if inside and key and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*:", row):
            return number
    return None
