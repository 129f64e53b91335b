"""`syncline export`: writes results in other tools' formats, and logs as session folders."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from deploy.commands.common import Json, UnusedSeed, answer, check_file, closing_lines
from protocols.core.errors import InputError

Format = Literal[
    "aniposelib", "caliscope", "pose2sim", "freemocap", "opencv", "kalibr", "colmap", "ros", "opensfm", "qualisys",
    "vicon", "optitrack", "trc", "c3d", "session",
]  # fmt: skip


def export(
    source: Path,
    /,
    *,
    to: Format | None = None,
    out: Path,
    session: Path | None = None,
    units: Literal["m", "cm", "mm"] | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Write a calibration or a trajectory in another tool's format, or a log as a session folder.

    aniposelib, caliscope, pose2sim, freemocap: one TOML file in the units that the tool expects. kalibr: a camchain
    YAML with timeshift_cam_imu. opencv: one CAMERA.yml per camera for cv2.FileStorage. colmap: cameras.txt, images.txt,
    points3D.txt. ros: one camera_info CAMERA.yaml per camera. opensfm: one reconstruction.json. qualisys,
    vicon, optitrack: one XML file (.qca.txt, .xcp, .mcal). trc, c3d: a trajectory
    for OpenSim and motion capture, in the world frame, with gaps marked. session: rig.toml and observations.csv of
    a log.
    Information that a format cannot represent is listed in a warning.

    Example: syncline export out/calibration.toml --to caliscope --out camera_array.toml

    Example: syncline export out/trajectory.csv --to trc --out path.trc

    Example: syncline export out/calibration.toml --to caliscope --session my-session --out capture_volume

    Example: syncline export flight.mcap --out my-session

    Parameters
    ----------
    source
        calibration.toml; trajectory.csv, track.csv or tracks.csv for trc and c3d; a .mcap log for session.
    to
        The format; for a .mcap log always session.
    out
        The folder for opencv, ros, colmap, session, and for caliscope with --session; the file for all others.
    session
        For caliscope: a session folder, an observations file or a log, whose points are written too, as a capture
        volume: camera_array.toml, image_points.csv (an xy.csv) and world_points.csv, at instants common to all cameras.
    units
        For trc and c3d: the length unit that the trajectory has. Default: what result.json beside it says, else m.
    """
    from deploy.offline.exchange import exports
    from protocols.core.files import check_folder, write_together
    from protocols.formats.trajectories import trc_text, write_c3d
    from protocols.log.read.session import is_log

    log = is_log(source)
    if to is None and not log:
        raise InputError("--to is missing", file=source, remedy=f"give --to {', '.join(get_args(Format)[:-1])}")
    if session is not None and to != "caliscope":
        raise InputError("--session goes with --to caliscope", remedy="leave it out")
    if log and to not in (None, "session"):
        remedy = "calibrate it first, then export its calibration.toml"
        raise InputError(f"a log does not become {to}", file=source, remedy=remedy)
    if to == "session" and not log:
        raise InputError("only a .mcap log becomes a session", file=source, remedy="give a log")
    if source.suffix.lower() == ".csv" and to not in ("trc", "c3d"):
        remedy = "give the calibration.toml, or write the trajectory with --to trc or --to c3d"
        raise InputError(f"{to} is of calibrations, and this is a table", file=source, remedy=remedy)
    warnings: tuple[str, ...] = ()
    if log:
        check_folder(out)
        cameras, rows, warnings = exports.export_log(source, out)
        files = [out / "rig.toml", out / "observations.csv"]
        summary = f"{cameras} cameras, {rows} observations"
    else:
        assert to is not None
        if to in exports.IN_FOLDERS or session is not None:
            check_folder(out)
        else:
            check_file(out, "a file", source)
        texts: dict[Path, str] = {}
        if to in ("c3d", "trc"):
            has, warnings = exports.trajectory_units(source, units)
            if to == "c3d":
                begin = write_c3d(source, out, has)
            else:
                text, begin = trc_text(source, out.name, has)
                texts = {out: text}
            warnings += (f"{to} files begin at time 0: that is {begin:.6f} s of the reference clock",) if begin else ()
        elif session is not None:
            texts, warnings = exports.caliscope_volume(source, session, out)
        else:
            texts, warnings = exports.calibration_files(source, to, out)
        write_together(texts)
        files, summary = list(texts) or [out], ""
    document = {"files": [str(file) for file in files], "warnings": list(warnings)}
    return answer(document, [*([summary] if summary else []), *closing_lines(warnings, files)], json)
