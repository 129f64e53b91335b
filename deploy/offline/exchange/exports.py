"""Export of calibrations, trajectories and logs to the formats of other tools."""

from __future__ import annotations

import json
from pathlib import Path

from deploy.offline.follow.results import RESULT, TRACKS
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.files import file_in, read_text, write_atomically
from protocols.formats import colmap, opensfm, toml_rigs, trajectories, xml_rigs, yaml_rigs
from protocols.formats.cameras import ExportedFiles, convert_units
from protocols.session.calibration import csv_cell, read_calibration
from protocols.session.result import TRAJECTORY_FILE
from protocols.session.rig import METRES_PER_UNIT

IN_FOLDERS = ("opencv", "ros", "colmap")
"""Formats with several files, for which --out is a folder."""


def calibration_files(source: Path, to: str, out: Path) -> tuple[dict[Path, str], tuple[str, ...]]:
    """The files of a calibration in the format ``to``, and warnings on what it cannot represent.

    Raises InputError, Refused.
    """
    rig, cameras = read_calibration(source)
    scale = str(rig.metadata.get("scale", "metric"))
    if to in toml_rigs.PROJECT_UNITS:
        written = toml_rigs.write(to, cameras, rig.units, scale, out.name)
    elif to == "opencv":
        written = yaml_rigs.write_opencv(cameras, rig.units)
    elif to == "ros":
        written = yaml_rigs.write_ros(cameras)
    elif to in xml_rigs.UNITS:
        written = xml_rigs.write(to, cameras, rig.units, scale, out.name)
    else:  # their files state no units, and are read as metres
        metric, warnings = convert_units(cameras, rig.units, "m", scale)
        if to == "kalibr":
            written = yaml_rigs.write_kalibr(metric, out.name)
        else:
            written = opensfm.write(metric, out.name) if to == "opensfm" else colmap.write(metric)
        written = ExportedFiles(written.files, warnings + written.warnings)
    folder = out if to in IN_FOLDERS else out.parent
    return {file_in(folder, name): text for name, text in written.files.items()}, written.warnings


def caliscope_volume(source: Path, session: Path, out: Path) -> tuple[dict[Path, str], tuple[str, ...]]:
    """The files of a capture volume of caliscope: the calibration ``source`` with a session's points, and warnings.

    Raises InputError, and Refused where the session does not fit the calibration.
    """
    from hub.api import triangulate

    texts, warnings = calibration_files(source, "caliscope", out / "camera_array.toml")
    rig, cameras = read_calibration(source)
    found = triangulate(session, source)
    metric = rig.metadata.get("scale", "metric") != "arbitrary"
    tables, note = trajectories.point_tables(
        found.observations,
        {name: camera.time_map for name, camera in cameras.items() if name not in found.unused},
        toml_rigs.caliscope_numbers(cameras)[0],
        found.tables,
        METRES_PER_UNIT[rig.units] if metric else 1.0,
    )
    return texts | {out / name: text for name, text in tables.items()}, (*warnings, *found.warnings, *note)


def trajectory_units(source: Path, given: str | None) -> tuple[str, tuple[str, ...]]:
    """The units of a trajectory, by the result.json of the command that wrote it or as given, and warnings on them.

    Raises InputError where both are there and differ.
    """
    result = source.parent / RESULT
    if source.name not in (TRAJECTORY_FILE, TRACKS) or not result.is_file():
        return given or "m", () if given else (f"{source.name} states no units: m is assumed; --units gives another",)
    try:
        document = json.loads(read_text(result))
        stated = document.get("metadata", document)
        units, metric = stated["units"], stated.get("scale") != "arbitrary"
        metres = METRES_PER_UNIT[units]
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError("states no units of the trajectory", file=result, remedy="repeat the command") from None
    if not metric:
        return given or units, (f"the trajectory has no scale: its lengths are baselines, not {given or units}",)
    if given and METRES_PER_UNIT[given] != metres:
        remedy = "leave out --units, which says what the trajectory has, not what is written"
        raise InputError(f"the trajectory is in {units}, not {given}", file=result, remedy=remedy)
    return units, ()


def export_log(log: Path, out: Path) -> tuple[int, int, tuple[str, ...]]:
    """Write a log as a session folder; returns numbers of cameras and observations, and warnings. Raises InputError."""
    from deploy.offline.exchange.session_log import rig_tables_of_log
    from edge.offline.detections import observations_csv
    from protocols.log.read.session import session_from_log
    from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, write_observations, write_rig

    for name in (RIG_FILE, OBSERVATIONS_FILE):
        if (out / name).exists():
            raise InputError(f"a {name} is there already", file=out, remedy="choose another --out")
    rig, observations, warnings = session_from_log(log)
    rows = _rows_with_people(log)
    if rows:
        write_atomically(out / OBSERVATIONS_FILE, observations_csv(rows))
    else:
        write_observations(out / OBSERVATIONS_FILE, observations)
    write_rig(out / RIG_FILE, rig_tables_of_log(rig))  # after the large one: a full disk leaves no session
    return len(rig.cameras), len(rows) or len(observations), warnings


def _rows_with_people(log: Path) -> list[str]:
    """The lines of observations.csv of a log with people or vehicles, whom no label identifies; else none."""
    from deploy.offline.follow.source import read_log
    from edge.offline.detections import cells_of

    messages = {(one.camera, one.sequence): one for one in read_log(log)[0]}
    seen = [(frame, one) for frame in messages.values() for one in frame.detections]
    tracked = [one for _, one in seen if one.kind in ("person", "vehicle")]
    for one in tracked:
        one.label = one.kind
    return [
        ",".join((csv_cell(frame.camera), f"{frame.frame},{frame.device_time_ns / NANOSECONDS:.17g}", cells_of(one)))
        for frame, one in (seen if tracked else ())
    ]
