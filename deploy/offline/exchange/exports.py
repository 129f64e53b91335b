"""Export of calibrations, trajectories and logs to the formats of other tools."""

from __future__ import annotations

from pathlib import Path

from protocols.core.errors import InputError
from protocols.core.files import file_in
from protocols.formats import colmap, opensfm, ros, toml_rigs, trc, xml_export, yaml_rigs
from protocols.formats.c3d import write_c3d
from protocols.formats.cameras import ExportedFiles, convert_units
from protocols.session.calibration import read_calibration

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
    elif to == "kalibr":
        metric, warnings = convert_units(cameras, rig.units, "m", scale)
        written = yaml_rigs.write_kalibr(metric, out.name)
        written = ExportedFiles(written.files, warnings + written.warnings)
    elif to == "opencv":
        written = yaml_rigs.write_opencv(cameras, rig.units)
    elif to == "ros":
        written = ros.write(cameras)
    elif to == "opensfm":
        written = opensfm.write(cameras, out.name)
    elif to in xml_export.UNITS:
        written = xml_export.write(to, cameras, rig.units, scale, out.name)
    else:
        written = colmap.write(cameras)
    folder = out if to in IN_FOLDERS else out.parent
    return {file_in(folder, name): text for name, text in written.files.items()}, written.warnings


def trajectory_files(source: Path, out: Path, units: str) -> dict[Path, str]:
    """The files of a trajectory in the TRC format. Raises InputError."""
    return {out: trc.trc_text(source, out.name, units)}


def export_log(log: Path, out: Path) -> tuple[int, int, tuple[str, ...]]:
    """Write a log as a session folder; returns numbers of cameras and observations, and warnings. Raises InputError."""
    from deploy.offline.exchange.session_log import rig_tables_of_log
    from protocols.log.read.session import session_from_log
    from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, write_observations, write_rig

    for name in (RIG_FILE, OBSERVATIONS_FILE):
        if (out / name).exists():
            raise InputError(f"a {name} is there already", file=out, remedy="choose another --out")
    rig, observations, warnings = session_from_log(log)
    write_rig(out / RIG_FILE, rig_tables_of_log(rig))
    write_observations(out / OBSERVATIONS_FILE, observations)
    return len(rig.cameras), len(observations), warnings


__all__ = ["IN_FOLDERS", "calibration_files", "export_log", "trajectory_files", "write_c3d"]
