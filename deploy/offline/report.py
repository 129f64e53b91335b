"""report.html once more: of a folder that `calibrate` or `hub` wrote, or of a log or session that is solved for it."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from deploy.offline.outputs import CALIBRATION, RESULT, TRAJECTORY
from deploy.offline.sessions import is_log, load_session
from hub.report.convergence import Step
from protocols import topics
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError, Refused
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import (
    AdjustmentStep,
    Calibration,
    CameraCalibration,
    PairReport,
    TrajectoryTable,
    read_calibration,
)
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from protocols.session.trajectory import read_trajectory

_GAP_S = 0.25  # a path with a longer hole is two
_FAR = 6.0  # times the camera's own rms: a row so far off did not count


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a report is about. command: as it was typed when the answer was made. missing: what could not be found."""

    outcome: Calibration | Refused
    rig: Rig
    observations: Observations
    command: str
    missing: str = ""
    history: tuple[Step, ...] = ()


def load_answer(source: Path, session: Path | None, tell: Callable[[str, float], None]) -> Answer:
    """The answer in a folder of outputs, or that of a session or log, which is solved now. Raises InputError."""
    if not source.exists():
        raise InputError("there is no such file or folder", file=source, remedy="name a result folder or a log")
    if (source / RESULT).is_file():
        return _from_folder(source, session)
    if session is not None:
        raise InputError("--session goes with a folder of results", file=source, remedy="leave it out")
    if not is_log(source) and not (source / "rig.toml").exists():
        remedy = f"name a folder with {RESULT}, a session folder or a .mcap log"
        raise InputError("neither results nor a session", file=source, remedy=remedy)
    rig, observations, warnings = load_session(source)
    from hub.calibration.pipeline import calibrate

    outcome: Calibration | Refused
    try:
        found = calibrate(rig, observations, tell, thorough=True)
        outcome = replace(found, warnings=warnings + found.warnings)
    except Refused as refused:
        outcome = Refused(refused.reason, refused.cameras, refused.pairs, (*warnings, *refused.warnings))
    return Answer(outcome, rig, observations, "", history=history_of(source))


def _from_folder(folder: Path, session: Path | None) -> Answer:
    document = _document(folder / RESULT)
    command = str(document.get("command") or "")
    metadata = _table(document.get("metadata"))
    place = session or _session_of(folder, command)
    rig: Rig | None = None
    observations = Observations({}, ())
    missing = ""
    if place is not None:
        rig, observations, _ = load_session(place)
    else:
        missing = "the session is not here any more: figures that need what the cameras saw are left out (--session)"
    refused = {str(name): str(why) for name, why in _table(metadata.get("refused")).items()}
    warnings = tuple(str(text) for text in document.get("warnings") or ())
    pairs = tuple(_pair(pair) for pair in document.get("pairs") or ())
    if document.get("status") != "solved":
        if rig is None:
            raise InputError(
                "refused, and its session is not here any more", file=folder, remedy="give the session with --session"
            )
        reason = str(document.get("reason") or "no reason told")
        return Answer(Refused(reason, refused, pairs, warnings), rig, observations, command, missing)
    known, cameras = read_calibration(folder / CALIBRATION)
    file = folder / TRAJECTORY
    tables = read_trajectory(file) if file.exists() else ()
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
        warnings=warnings + ((missing,) if missing else ()),
        cpu_seconds=float(document.get("cpu_seconds") or 0.0),
        convergence=_steps(document.get("convergence")),
        residuals={name: residuals_of(camera, tables, observations) for name, camera in cameras.items()},
    )
    return Answer(calibration, rig or known, observations, command, missing, history_of(place))


def history_of(log: Path | None) -> tuple[Step, ...]:
    """What a hub answered while a log was recorded; nothing for a session that is none."""
    if log is None or not is_log(log):
        return ()
    steps: list[Step] = []
    first: int | None = None
    for logged in LogReader(log).messages([topics.OBSERVATION, topics.CALIBRATION]):
        first = logged.log_time_ns if first is None else first
        message = logged.message
        if isinstance(message, pb.Calibration) and message.status == "solved":
            stds = {camera.camera: camera.time_offset_std for camera in message.cameras}
            steps.append(Step((logged.log_time_ns - first) / NANOSECONDS, stds))
    return tuple(steps)


def residuals_of(camera: CameraCalibration, tables: tuple[TrajectoryTable, ...], observations: Observations) -> Floats:
    """(n, 5): camera time, u, v, du, dv of one camera's rows against the path; far ones did not count."""
    out = []
    for table in tables:
        track = observations.tracks.get((camera.name, table.label))
        if track is None or len(table.time) < 4:
            continue
        moments = camera.time_map.clock_rate * track.time + camera.time_map.time_offset
        place = _places(table, moments)
        good = np.isfinite(place).all(axis=1)
        seen = camera.pose.camera_from_world(place[good])
        front = seen[:, 2] > 0
        pixels = track.pixels[good][front]
        off = pixels - camera.intrinsics.project(seen[front])
        near = np.hypot(off[:, 0], off[:, 1]) < max(_FAR * camera.rms_px, 1.0)
        out.append(np.column_stack([track.time[good][front], pixels, off])[near])
    return np.concatenate(out) if out else np.zeros((0, 5))


def _places(table: TrajectoryTable, moments: Floats) -> Floats:
    """(n, 3) where the point was, NaN where no path is told."""
    from scipy.interpolate import CubicSpline

    out = np.full((len(moments), 3), np.nan)
    breaks = np.flatnonzero(np.diff(table.time) > _GAP_S) + 1
    for part in np.split(np.arange(len(table.time)), breaks):
        if len(part) < 4:
            continue
        time = table.time[part]
        inside = (moments >= time[0]) & (moments <= time[-1])
        if inside.any():
            out[inside] = CubicSpline(time, table.position[part])(moments[inside])
    return out


def _session_of(folder: Path, command: str) -> Path | None:
    """Where what the cameras saw may be: kept in the folder, a log in it, or what the command named."""
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
        document = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=file, remedy="check its rights") from None
    except (ValueError, RecursionError):
        raise InputError("is not JSON", file=file, remedy=remedy) from None
    if not isinstance(document, dict) or document.get("status") not in ("solved", "refused"):
        raise InputError("is no result of `syncline calibrate`", file=file, remedy=remedy)
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
    )


def _steps(value: Any) -> tuple[AdjustmentStep, ...]:
    """The adjustment's steps; what is none is left out, as in files of older versions."""
    steps = []
    for one in value if isinstance(value, list) else []:
        residual = one.get("residual_px") if isinstance(one, dict) else None
        if isinstance(residual, int | float) and math.isfinite(residual) and residual > 0.0:
            steps.append(AdjustmentStep(str(one.get("stage") or ""), float(residual)))
    return tuple(steps)


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
