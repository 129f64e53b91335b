"""Input of a report: read from a result folder of `calibrate` or `hub`, or computed from a log or session."""

from __future__ import annotations

import json
import math
import shlex
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from deploy.offline.progress import Progress
from hub.api import CALIBRATION, RESULT, TRAJECTORY, calibrate, read_session
from hub.report.time_figures import OffsetStdSample
from protocols import topics
from protocols.core.acceptance import AcceptanceTest, PairReport
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError, Refused
from protocols.core.files import read_text
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.log.read.session import is_log
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import (
    AdjustmentStep,
    Calibration,
    CameraCalibration,
    TrajectoryTable,
    read_calibration,
    read_trajectory,
)
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_MAX_GAP_S = 0.25  # a trajectory with a longer gap is split
_OUTLIER_RMS_FACTOR = 6.0  # times the camera's own rms: rows with a larger residual were rejected as outliers


@dataclass(frozen=True, slots=True, eq=False)
class ReportInput:
    """Data of a report. command: the command line that made the result. missing: what could not be found.

    history: offset std over the time of a recording, for logs.
    """

    outcome: Calibration | Refused
    rig: Rig
    observations: Observations
    command: str
    missing: str = ""
    history: tuple[OffsetStdSample, ...] = ()


def load_report_input(source: Path, session: Path | None, progress: Progress) -> ReportInput:
    """The results in an output folder, or those of a session or log, which is calibrated now. Raises InputError."""
    if not source.exists():
        raise InputError("there is no such file or folder", file=source, remedy="name a result folder or a log")
    if (source / RESULT).is_file():
        return _input_from_folder(source, session)
    if session is not None:
        raise InputError("--session goes with a folder of results", file=source, remedy="leave it out")
    if not is_log(source) and not (source / "rig.toml").exists():
        remedy = f"name a folder with {RESULT}, a session folder or a .mcap log"
        raise InputError("neither results nor a session", file=source, remedy=remedy)
    read = read_session(source)
    outcome: Calibration | Refused
    try:
        result = calibrate(read, progress=progress)
        outcome, read = result.calibration, result.session
    except Refused as refused:
        outcome = refused
    return ReportInput(outcome, read.rig, read.observations, "", history=offset_std_history(source))


def _input_from_folder(folder: Path, session: Path | None) -> ReportInput:
    document = _document(folder / RESULT)
    command = str(document.get("command") or "")
    metadata = _table(document.get("metadata"))
    place = session or _find_session(folder, command)
    rig: Rig | None = None
    observations = Observations({}, ())
    missing = ""
    if place is not None:
        read = read_session(place)
        rig, observations = read.rig, read.observations
    else:
        missing = "its session is not found: figures of the observations are left out; give it or its log by --session"
        observations = Observations({}, (missing,))
    refused = {str(name): str(why) for name, why in _table(metadata.get("refused")).items()}
    warnings = tuple(str(text) for text in document.get("warnings") or ())
    pairs = tuple(_pair(pair) for pair in document.get("pairs") or ())
    acceptance = {name: _tests(tests) for name, tests in _table(document.get("acceptance")).items()}
    if document.get("status") != "solved":
        if rig is None:
            raise InputError(
                "refused, and its session is not found", file=folder, remedy="give it or its log by --session"
            )
        reason = str(document.get("reason") or "no reason given")
        refusal = Refused(reason, refused, pairs, warnings, acceptance)
        return ReportInput(refusal, rig, observations, command, missing)
    known, cameras = read_calibration(folder / CALIBRATION)
    cameras = {name: _with_lag(camera, _table(document.get("cameras"))) for name, camera in cameras.items()}
    file = folder / TRAJECTORY
    tables = read_trajectory(file) if file.exists() else ()
    if place is not None and tables and not {table.label for table in tables} & set(observations.labels):
        missing = "its points are of people who were followed: figures of the observations are left out"
        observations = Observations({}, (missing,))
    calibration = Calibration(
        cameras=cameras,
        reference=str(metadata.get("reference") or next(iter(cameras))),
        scale=str(metadata.get("scale") or "arbitrary"),
        units=known.units,
        solver=str(metadata.get("solver") or ""),
        version=str(metadata.get("version") or ""),
        refused=refused,
        trajectories=tables,
        pairs=pairs,
        warnings=warnings,
        cpu_seconds=float(document.get("cpu_seconds") or 0.0),
        convergence=_steps(document.get("convergence")),
        acceptance=acceptance,
        residuals={name: camera_residuals(camera, tables, observations) for name, camera in cameras.items()},
    )
    return ReportInput(calibration, rig or known, observations, command, missing, offset_std_history(place))


def offset_std_history(log: Path | None) -> tuple[OffsetStdSample, ...]:
    """Offset std of the calibrations that a hub published during a recording; empty for a session folder."""
    if log is None or not is_log(log):
        return ()
    steps: list[OffsetStdSample] = []
    first: int | None = None
    for logged in LogReader(log).messages([topics.OBSERVATION, topics.CALIBRATION]):
        first = logged.log_time_ns if first is None else first
        message = logged.message
        if isinstance(message, pb.Calibration) and message.status == "solved":
            stds = {camera.camera: camera.time_offset_std for camera in message.cameras}
            steps.append(OffsetStdSample((logged.log_time_ns - first) / NANOSECONDS, stds))
    return tuple(steps)


def camera_residuals(
    camera: CameraCalibration, tables: tuple[TrajectoryTable, ...], observations: Observations
) -> Floats:
    """Residuals (n, 5) of one camera from the trajectory: camera time [s], u, v, du, dv [px]; without outliers."""
    out = []
    for table in tables:
        track = observations.tracks.get((camera.name, table.label))
        if track is None or len(table.time) < 4:
            continue
        moments = camera.time_map.clock_rate * track.time + camera.time_map.time_offset
        place = _interpolated_positions(table, moments)
        good = np.isfinite(place).all(axis=1)
        seen = camera.pose.camera_from_world(place[good])
        front = seen[:, 2] > 0
        pixels = track.pixels[good][front]
        off = pixels - camera.intrinsics.project(seen[front])
        near = np.hypot(off[:, 0], off[:, 1]) < max(_OUTLIER_RMS_FACTOR * camera.rms_px, 1.0)
        out.append(np.column_stack([track.time[good][front], pixels, off])[near])
    return np.concatenate(out) if out else np.zeros((0, 5))


def _interpolated_positions(table: TrajectoryTable, moments: Floats) -> Floats:
    """Interpolated positions (n, 3) of a trajectory, NaN in its gaps."""
    from scipy.interpolate import CubicSpline

    out = np.full((len(moments), 3), np.nan)
    breaks = np.flatnonzero(np.diff(table.time) > _MAX_GAP_S) + 1
    for part in np.split(np.arange(len(table.time)), breaks):
        if len(part) < 4:
            continue
        time = table.time[part]
        inside = (moments >= time[0]) & (moments <= time[-1])
        if inside.any():
            out[inside] = CubicSpline(time, table.position[part])(moments[inside])
    return out


def _find_session(folder: Path, command: str) -> Path | None:
    """The session of a result folder: stored in it, a log in it, or the one that the command line named."""
    if (folder / "session" / "observations.csv").is_file():
        return folder / "session"
    logs = sorted(folder.glob("*.mcap"))
    if len(logs) == 1:
        return logs[0]
    try:
        words = shlex.split(command)
    except ValueError:
        return None
    if len(words) > 2 and words[1] == "calibrate" and "--observations" not in words:
        for word in words[2:]:
            place = Path(word)
            if not word.startswith("-") and ((place / "observations.csv").is_file() or place.suffix == ".mcap"):
                return place if place.exists() else None
    return None


def _document(file: Path) -> dict[str, Any]:
    remedy = "calibrate again"
    try:
        document = json.loads(read_text(file, "result"))
    except (ValueError, RecursionError):
        raise InputError("is not JSON", file=file, remedy=remedy) from None
    if not isinstance(document, dict) or document.get("status") not in ("solved", "refused"):
        raise InputError("is not a result of `syncline calibrate`", file=file, remedy=remedy)
    return document


def _pair(pair: Any) -> PairReport:
    table = _table(pair)
    cameras = table.get("cameras")
    if not isinstance(cameras, list) or len(cameras) != 2:
        raise InputError("result.json has a pair without its cameras", remedy="calibrate again")

    def number(key: str) -> float | None:
        value = table.get(key)
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None

    matrix = table.get("fundamental")
    fundamental = np.array(matrix, dtype=np.float64).reshape(3, 3) if isinstance(matrix, list) else None
    return PairReport(
        (str(cameras[0]), str(cameras[1])),
        str(table.get("status") or ""),
        number("lag_s"),
        number("clock_rate"),
        fundamental,
        number("inliers"),
        number("rms_px"),
        number("lag_std_s"),
        _tests(table.get("acceptance")),
    )


def _tests(value: Any) -> tuple[AcceptanceTest, ...]:
    """Acceptance tests as result.json has them; invalid entries, as in files of older versions, are skipped."""
    out = []
    for one in value if isinstance(value, list) else []:
        with suppress(msgspec.ValidationError):
            out.append(msgspec.convert(one, AcceptanceTest))
    return tuple(out)


def _with_lag(camera: CameraCalibration, tables: dict[str, Any]) -> CameraCalibration:
    """The camera with the instant of its lag and the stds there, which only result.json holds."""
    table = _table(tables.get(camera.name))
    values = [table.get(key) for key in ("lag_time_s", "lag_std_s", "clock_rate_ppm_std")]
    time, std, rate_std = (float(v) if isinstance(v, int | float) and math.isfinite(v) else 0.0 for v in values)
    return replace(camera, lag_time=time, lag_std=std, clock_rate_std=1e-6 * rate_std)


def _steps(value: Any) -> tuple[AdjustmentStep, ...]:
    """The adjustment's steps; invalid entries, as in files of older versions, are skipped."""
    steps = []
    for one in value if isinstance(value, list) else []:
        residual = one.get("residual_px") if isinstance(one, dict) else None
        if isinstance(residual, int | float) and math.isfinite(residual) and residual > 0.0:
            steps.append(AdjustmentStep(str(one.get("stage") or ""), float(residual)))
    return tuple(steps)


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
