"""Calibration and triangulation of sessions, for notebooks and for the commands.

The estimators are ``hub.calibration.pipeline`` and ``hub.calibration.triangulation``. This module adds their options,
loads sessions and calibrations from paths, and saves results.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np

from protocols.core.errors import InputError, Refused
from protocols.core.files import check_folder, remove_files, write_atomically, write_together
from protocols.geometry import so3
from protocols.log.read.session import is_log, load_session, no_session
from protocols.session.calibration import (
    Calibration,
    CameraCalibration,
    FixedCalibration,
    TrajectoryTable,
    calibration_text,
    read_calibration,
    trajectory_text,
)
from protocols.session.csv_table import dataframe
from protocols.session.folder import RIG_FILE, labelled_file
from protocols.session.observations import Observations, read_observations
from protocols.session.result import refusal_document, result_document, result_text
from protocols.session.rig import Rig, read_rig
from protocols.session.session import Session

if TYPE_CHECKING:
    import pandas

    from hub.clocks.external_prior import ExternalClockPrior
    from protocols.messages import syncline_pb2 as pb

CALIBRATION, TRAJECTORY, RESULT, REPORT = "calibration.toml", "trajectory.csv", "result.json", "report.html"
Progress: TypeAlias = Callable[[str, float], None]
"""Called with what is being done and the share that is done, 0..1."""
Solver = Literal["joint", "distributed", "paper"]


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """How a session is calibrated.

    solver: "joint" (one bundle adjustment), "distributed" (pose nodes in one process), or "paper" (the papers' own
    methods, for comparison). from_known: a calibration.toml whose intrinsics and poses are kept; only timing and
    trajectories are estimated then, by "joint". thorough: search clock rates of wrong nominal frame rates, and
    interrupted tracks, for cameras that a first search leaves unconnected. seed: of the distributed solver's samples.
    refine_lenses: measured lenses may change within their tolerance ("joint"); else they are kept exactly.
    """

    solver: Solver = "joint"
    from_known: str | Path | None = None
    thorough: bool = True
    seed: int = 0
    refine_lenses: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """A calibrated session. calibration: clocks, poses, trajectories and pair reports. session: the input."""

    calibration: Calibration
    session: Session

    @property
    def cameras(self) -> dict[str, CameraCalibration]:
        """The calibrated cameras by name."""
        return self.calibration.cameras

    @property
    def refused(self) -> dict[str, str]:
        """Reasons of the cameras that could not be calibrated, by name."""
        return self.calibration.refused

    def save(self, out: str | Path, command: str = "") -> dict[str, Any]:
        """Write calibration.toml, trajectory.csv, result.json and report.html to a folder: all of them, or none.

        command: how the result was made, for the report. Returns the content of result.json. Raises InputError.
        """
        from hub.report import build_report

        folder = Path(out)
        check_folder(folder)
        rig, found = self.session.rig, self.calibration
        document = result_document(found, rig, command=command)
        write_together(
            {
                folder / CALIBRATION: calibration_text(found, rig),
                folder / TRAJECTORY: trajectory_text(found.trajectories, labelled=len(found.trajectories) > 1),
                folder / RESULT: result_text(document),
                folder / REPORT: build_report(found, rig, self.session.observations, command),
            }
        )
        return document

    def to_dataframe(self) -> pandas.DataFrame:
        """A table with one row per calibrated camera: clock, pose and their stds. Needs pandas.

        time_offset, clock_rate: t_reference = clock_rate * t_camera + time_offset [s]. x, y, z: its centre in the
        world, with the std of each [rig units]. rx, ry, rz: Rodrigues vector, camera from world [rad]. rms_px: of its
        reprojection errors.
        """
        cameras = list(self.cameras.values())
        rotation = np.array([so3.log(camera.pose.rotation) for camera in cameras]).reshape(-1, 3)
        position = np.array([camera.pose.position for camera in cameras]).reshape(-1, 3)
        std = np.array([camera.position_std for camera in cameras]).reshape(-1, 3)
        return dataframe(
            {
                "camera": [camera.name for camera in cameras],
                "time_offset": [camera.time_map.time_offset for camera in cameras],
                "time_offset_std": [camera.time_offset_std for camera in cameras],
                "clock_rate": [camera.time_map.clock_rate for camera in cameras],
                **{axis: position[:, i] for i, axis in enumerate("xyz")},
                **{f"{axis}_std": std[:, i] for i, axis in enumerate("xyz")},
                **{f"r{axis}": rotation[:, i] for i, axis in enumerate("xyz")},
                "rms_px": [camera.rms_px for camera in cameras],
            }
        )

    def trajectory_dataframe(self) -> pandas.DataFrame:
        """One row per sample: time [s, reference clock], x, y, z, std [rig units], label. Needs pandas."""
        return _trajectories(self.calibration.trajectories)


@dataclass(frozen=True, slots=True, eq=False)
class TriangulationResult:
    """Trajectories of labelled points on the reference clock of a given calibration, in its world and units.

    sigma_px: noise of one pixel coordinate, by camera. unused: why a camera was not used, by name. unplaced: labels
    without a trajectory. observations: of the calibrated cameras, each person under one name in all of them.
    """

    rig: Rig
    tables: tuple[TrajectoryTable, ...]
    sigma_px: dict[str, float]
    unused: dict[str, str]
    unplaced: tuple[str, ...]
    warnings: tuple[str, ...]
    observations: Observations

    def save(self, file: str | Path) -> None:
        """Write time,x,y,z,std,label as CSV, floats with 17 significant digits. Raises InputError."""
        write_atomically(Path(file), trajectory_text(self.tables, labelled=True))

    def to_dataframe(self) -> pandas.DataFrame:
        """One row per sample: time [s, reference clock], x, y, z, std [rig units], label. Needs pandas."""
        return _trajectories(self.tables)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSession(Session):
    """A session as it was recorded. clock_priors: external clock priors (NTP, PTP) of its cameras, by name. people:
    detections of several unlabelled people; observations are then of those associated by colour."""

    clock_priors: Mapping[str, ExternalClockPrior] = field(default_factory=dict)
    people: tuple[pb.Observation, ...] = field(default=(), kw_only=True)


def read_session(path: str | Path, observations: str | Path | None = None) -> Session:
    """The session of a folder, or that a live hub would make of a log, with people and what is known of its clocks.

    observations: another observations file in place of the folder's own. Raises InputError: file, line, what, remedy.
    """
    path = Path(path)
    if not is_log(path) or observations is not None:
        return load_session(path, observations)
    from hub.clocks.observation_stream import session_from_messages
    from protocols.log.read.reader import LogReader
    from protocols.topics import CAMERA_INFO, OBSERVATION, RIG_INFO, STATUS

    reader = LogReader(path)
    topics = [OBSERVATION, CAMERA_INFO, RIG_INFO, STATUS]
    try:
        found = session_from_messages(lambda: ((one.message, one.log_time_ns) for one in reader.messages(topics)))
    except Refused as refusal:
        raise no_session(path, refusal) from None
    damage = (f"the log is damaged: {reader.damage}",) if reader.damage else ()
    return RecordedSession(
        found.rig, found.observations, damage + found.warnings, path.stem, found.priors, people=found.people
    )


def calibrate(
    session: Session | str | Path, options: CalibrationOptions | None = None, progress: Progress | None = None
) -> CalibrationResult:
    """Estimate the clocks and poses of a session's cameras, and the trajectories of the observed points.

    session: as `load_session` or `read_session` returns it, or a path that the latter reads. Raises InputError for
    what cannot be read, and Refused, with reasons by camera, where the data do not determine the result for at least
    two cameras.
    """
    options = options or CalibrationOptions()
    if options.solver not in get_args(Solver):
        raise InputError(f"there is no solver {options.solver!r}", remedy=f"use one of {', '.join(get_args(Solver))}")
    if options.from_known is not None and options.solver != "joint":
        raise InputError("--from-known goes with --solver joint", remedy="leave one of the two out")
    if options.refine_lenses and (options.from_known is not None or options.solver != "joint"):
        remedy = "leave --from-known and --solver out"
        raise InputError("--refine-lenses goes with --solver joint and without --from-known", remedy=remedy)
    session = session if isinstance(session, Session) else read_session(session)
    began = time.process_time()
    try:
        found = _calibrated(session, options, progress)
    except Refused as refused:
        refused.cpu_seconds = time.process_time() - began
        raise
    return replace(found, calibration=replace(found.calibration, cpu_seconds=time.process_time() - began))


def _calibrated(session: Session, options: CalibrationOptions, progress: Progress | None) -> CalibrationResult:
    """The calibration by labelled points, by unlabelled people, or by what calibrates more cameras."""
    if not isinstance(session, RecordedSession) or not session.people:
        return _from_labels(session, options, progress)
    if not len(session.observations) or any(bar[:2] == ("head", "foot") for bar in session.rig.scale_bars):
        return _from_people(session, options, progress)
    from hub.calibration.people.ways import first_complete

    ways = (_from_labels, _from_people) if _suits_people(options) else (_from_labels,)
    return first_complete(
        [partial(way, session, options, progress) for way in ways],
        {message.camera for message in session.people} & session.rig.cameras.keys(),
    )


def _suits_people(options: CalibrationOptions) -> bool:
    """Whether unlabelled people can be calibrated by with these options."""
    return options.solver == "joint" and options.from_known is None and not options.refine_lenses


def _from_labels(session: Session, options: CalibrationOptions, progress: Progress | None) -> CalibrationResult:
    """The calibration by labelled points."""
    from hub.calibration.exchanged_labels import exchanged_back
    from hub.calibration.pipeline import calibrate as estimate_calibration
    from hub.calibration.triangulation import meant_convention, unlikely_speed

    known = None
    if options.from_known is not None:
        known, rig = _fixed(Path(options.from_known), session.rig)
        session = replace(session, rig=rig)
    read, session = session, _with_associated_people(session, progress, known)

    def estimated(session: Session, known: FixedCalibration | None) -> Calibration:
        try:
            return estimate_calibration(
                session.rig,
                session.observations,
                progress,
                solver=options.solver,
                known=known,
                thorough=options.thorough,
                seed=options.seed,
                refine_lenses=options.refine_lenses,
                clock_priors=session.clock_priors if isinstance(session, RecordedSession) else None,
            )
        except np.linalg.LinAlgError as error:
            reason = f"the observations do not determine the poses ({error}): film longer, or move further"
            raise Refused(reason, dict.fromkeys(session.rig.cameras, reason)) from error

    try:
        found = estimated(session, known)
        if not session.rig.bodies:
            observations, exchanges = exchanged_back(found.cameras, session.observations)
            if exchanges:
                session = replace(session, observations=observations, warnings=(*session.warnings, *exchanges))
                found = estimated(session, known)
    except Refused as refused:
        if known is not None:
            scale = known.scale

            def fitting(cameras: dict[str, CameraCalibration]) -> int:
                other = FixedCalibration(cameras, scale)
                return len(estimated(_with_associated_people(read, progress, other), other).cameras)

            refused.reason = meant_convention(known.cameras, fitting) or refused.reason
        refused.warnings = (*session.warnings, *refused.warnings)
        raise
    if known is not None:
        speed = unlikely_speed(found.scale, found.units, found.trajectories)
        found = replace(found, warnings=(*found.warnings, *speed))
    return CalibrationResult(replace(found, warnings=session.warnings + found.warnings), session)


def _from_people(session: RecordedSession, options: CalibrationOptions, progress: Progress | None) -> CalibrationResult:
    """The calibration by unlabelled people, whose heads and feet become the session's observations."""
    from hub.calibration.people.unlabelled import calibrate_people

    if not _suits_people(options):
        what = "unlabelled people go with --solver joint, without --from-known and --refine-lenses"
        raise InputError(what, remedy="leave these out, or label the people: one label a person in all cameras")
    try:
        found, observations = calibrate_people(
            session.rig, session.people, progress, priors=session.clock_priors, seed=options.seed
        )
    except Refused as refused:
        refused.warnings = session.warnings
        raise
    read = replace(session, observations=observations)
    return CalibrationResult(replace(found, warnings=session.warnings + found.warnings), read)


def _with_associated_people(session: Session, progress: Progress | None, known: FixedCalibration | None) -> Session:
    """The session with one name for one person in all cameras, and a note of what was associated."""
    from hub.calibration.people.association import associate_people

    if session.rig.bodies:
        return session
    rig, observations, note = associate_people(session.rig, session.observations, progress, known)
    return replace(session, rig=rig, observations=observations, warnings=session.warnings + ((note,) if note else ()))


def save_refusal(
    out: str | Path, refusal: Refused, session: Session, command: str = "", solver: str = "joint"
) -> dict[str, Any]:
    """Write result.json and report.html of a refused session, and remove the files of an earlier result.

    Returns the content of result.json. Raises InputError.
    """
    from hub.report import build_report

    folder = Path(out)
    remove_files(folder / name for name in (CALIBRATION, TRAJECTORY))
    document = refusal_document(
        refusal.reason,
        refusal.cameras,
        session.rig,
        command=command,
        solver=solver,
        cpu_seconds=refusal.cpu_seconds,
        pairs=refusal.pairs,
        warnings=refusal.warnings,
        acceptance=refusal.acceptance,
    )
    report = build_report(refusal, session.rig, session.observations, command)
    write_together({folder / RESULT: result_text(document), folder / REPORT: report})
    return document


def triangulate(
    session: Session | str | Path,
    calibration: CalibrationResult | str | Path,
    progress: Progress | None = None,
    *,
    observations: str | Path | None = None,
) -> TriangulationResult:
    """3-D trajectories of labelled points with a given calibration; poses, lenses and clocks are kept.

    session: a Session, or a path: a session folder, an observations.csv by itself, or a log. calibration: a result of
    ``calibrate``, or a calibration.toml. observations: a file to use instead of the session's own. Cameras that the
    calibration does not know are left out with a warning. Raises InputError, and Refused where no point is seen by two
    cameras or the observations contradict the calibration.
    """
    from hub.calibration.exchanged_labels import exchanged_back
    from hub.calibration.people.association import associate_with_calibration
    from hub.calibration.triangulation import triangulate as estimate_trajectories

    if isinstance(session, Session) and observations is not None:
        raise InputError("a session in memory has its own observations", remedy="leave observations out")
    if isinstance(calibration, CalibrationResult):
        rig, known = calibration.session.rig, calibration.cameras
    else:
        rig, known = read_calibration(Path(calibration))
    if isinstance(session, Session):
        seen, warnings = session.observations, session.warnings
    else:
        seen, warnings = _read_rows(Path(session), None if observations is None else Path(observations), rig)
    left = [name for name in seen.cameras if name not in known]
    if left:
        if len(left) == len(seen.cameras):
            what = f"none of its cameras ({', '.join(left)}) is in the calibration ({', '.join(known)})"
            file = None if isinstance(session, Session) else Path(session)
            raise InputError(what, file=file, remedy="take the calibration of these cameras")
        warnings = (*warnings, f"not in the calibration, left out: {', '.join(left)}")
    used = Observations({key: track for key, track in seen.tracks.items() if key[0] in known})
    used, note = associate_with_calibration(rig, known, used)
    used, exchanges = exchanged_back(known, used)
    warnings = (*warnings, *((note,) if note else ()), *exchanges)
    found = estimate_trajectories(rig, known, used, progress)
    return TriangulationResult(
        rig, found.tables, found.sigma_px, found.unused, found.unplaced, (*warnings, *found.warnings), used
    )


def _read_rows(session: Path, observations: Path | None, rig: Rig) -> tuple[Observations, tuple[str, ...]]:
    """The observations that a path holds, and warnings. The calibration knows the cameras: no rig.toml is needed."""
    if is_log(session):
        read = read_session(session, observations)
        if isinstance(read, RecordedSession) and read.people:
            what = "several unlabelled people, who have no points to triangulate"
            raise InputError(what, file=session, remedy="follow them: `syncline follow`")
        return read.observations, read.warnings
    if not session.exists():
        raise InputError("this session does not exist", file=session, remedy="give a session folder or a .mcap log")
    # A rig.toml, and the calibration's refused cameras, only name what the calibration has left out.
    names = dict.fromkeys(rig.cameras)
    if session.is_dir() and (session / RIG_FILE).exists():
        names |= dict.fromkeys(read_rig(session / RIG_FILE).cameras)
    names |= dict.fromkeys(rig.metadata.get("refused", {}))
    seen = read_observations(observations or (labelled_file(session) if session.is_dir() else session), names)
    return seen, seen.warnings


def _fixed(file: Path, rig: Rig) -> tuple[FixedCalibration, Rig]:
    """The given poses, and the rig in their units: the result's world is theirs."""
    given, cameras = read_calibration(file)
    both = {name: camera for name, camera in cameras.items() if name in rig.cameras}
    if len(both) < 2:
        raise InputError(
            f"knows only {len(both)} of the session's cameras ({', '.join(rig.cameras)})",
            file=file,
            remedy="use a calibration of this rig",
        )
    return FixedCalibration(both, str(given.metadata.get("scale", "metric"))), replace(rig, units=given.units)


def _trajectories(tables: tuple[TrajectoryTable, ...]) -> pandas.DataFrame:
    columns: Mapping[str, Any] = {
        "time": np.concatenate([np.zeros(0), *(table.time for table in tables)]),
        **{
            axis: np.concatenate([np.zeros(0), *(table.position[:, i] for table in tables)])
            for i, axis in enumerate("xyz")
        },
        "std": np.concatenate([np.zeros(0), *(table.std for table in tables)]),
        "label": [table.label for table in tables for _ in range(len(table.time))],
    }
    return dataframe(columns)
