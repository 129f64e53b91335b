"""`syncline calibrate`: offline estimation of clock offsets and poses."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

from deploy.agents.malloc_tuning import retain_freed_memory
from deploy.commands.common import Flag, Json, Scheduler, check_seed, command_line
from deploy.offline.progress import progress_bar
from hub import api
from hub.api import CalibrationOptions, read_session
from protocols.core.errors import EXIT_DONE, InputError, Refused
from protocols.core.files import check_folder
from protocols.core.lazy import defer_modules
from protocols.session.session import Session

UNUSED_OF_NUMPY = ("f2py", "testing", "ma", "polynomial", "ctypeslib")
"""Imported by scipy: a third of its import time."""


def calibrate(
    session: Path,
    /,
    *,
    out: Path,
    observations: Path | None = None,
    solver: Literal["joint", "distributed", "paper"] = "joint",
    from_known: Path | None = None,
    refine_lenses: Flag = False,
    marker: Path | None = None,
    detector: str | None = None,
    height: float | None = None,
    limb: str | None = None,
    json: Json = False,
    scheduler: Scheduler = None,
    seed: int = 0,
) -> int:
    """Estimate clock offset and pose of each camera of a session, and the trajectory of the moving target.

    Writes calibration.toml, trajectory.csv, result.json and report.html to --out. Exit status 0 if at least
    two cameras are solved, 3 if the data allow no reliable result (then only result.json and report.html).

    In a folder of videos, one per camera and named after it, what moves is first detected in each video. The resulting
    session is stored in --out as session/, and the detections of unchanged videos are reused. A rig.toml in the folder
    gives the cameras' intrinsics (`syncline intrinsics`); a board.toml describes a board, which gives the scale and
    unknown intrinsics too.

    Example: syncline calibrate my-session --out out

    Example: syncline calibrate my-videos --out out

    Example: syncline calibrate my-videos --detector charuco --out out

    Parameters
    ----------
    session
        A folder with rig.toml and observations.csv, a .mcap log that Syncline recorded, or a folder of videos.
    out
        Folder for the results.
    observations
        Another observations file to use instead of the session's own.
    solver
        joint: one bundle adjustment over all parameters. distributed: poses by pose nodes that exchange messages with
        their neighbours, in one process. paper: the alternating method of the paper.
    from_known
        A calibration.toml whose intrinsics and poses are kept fixed; only timing and trajectory are estimated.
    refine_lenses
        Let measured lenses change where the observations support it. Without it they are kept exactly as given, and a
        warning names those that the observations refute.
    marker
        For videos: appearance of the ball, as written by `syncline detect marker --teach`. Default: marker.toml in the
        folder of videos, otherwise the orange ball of the demo.
    detector
        For videos: what moves in them. charuco, chessboard: the board that board.toml describes. tag: ArUco or AprilTag
        tags. bright: a point of light. marker: a coloured ball. person, with fixed cameras: one, or with measured
        lenses several. vehicle: only one at a time in view, with fixed cameras. auto (default): looks at some frames
        with all of them. Or the .toml file of an ONNX network, or a detector that another package registers: people,
        or only one target at a time in view.
    height
        For keypoints and people without labels: their (mean) height [rig units], which gives the scale; of keypoints
        by thighs and shanks (about 3 %).
    limb
        The distance between two labels, as left_knee-left_ankle=0.41 [rig units]: gives the scale. Of several people
        it is the mean.
    seed
        Seed of the pose nodes' random samples (--solver distributed), and of those by which unlabelled people are
        registered; nothing else uses random numbers.
    """
    retain_freed_memory()
    check_folder(out)
    check_seed(seed)
    options = CalibrationOptions(solver, from_known, seed=seed, refine_lenses=refine_lenses)
    read = _load(session, observations, out, marker, detector, json)
    read = _with_scale(read, height, limb)
    command = command_line()
    defer_modules("numpy", UNUSED_OF_NUMPY)
    from deploy.offline.outputs import report_refusal, report_result

    try:
        refusal = getattr(read, "refusal", None)
        if refusal is not None:
            raise refusal
        with progress_bar(f"calibrating {session.name}", quiet=json) as progress:
            result = api.calibrate(read, options, progress)
        if hasattr(read, "summaries"):  # of videos, whose clock priors are by their sounds
            from hub.clocks.sound import sound_check

            noted = (*result.calibration.warnings, *sound_check(getattr(read, "clock_priors", {}), result.calibration))
            result = replace(result, calibration=replace(result.calibration, warnings=noted))
    except Refused as refusal:
        report_refusal(refusal, read, out, command, solver, echo_json=json)
        raise
    report_result(result, out, command, echo_json=json)
    return EXIT_DONE


def _load(
    session: Path,
    observations: Path | None,
    out: Path,
    marker: Path | None,
    detector: str | None,
    quiet: bool,
) -> Session:
    """Read a session, or make one from a folder of videos. Raises InputError."""
    if observations is None and session.is_dir() and not (session / "observations.csv").exists():
        from deploy.offline.video_folder import SESSION, is_video_folder, session_from_videos
        from protocols.log.read.session import is_log

        if is_video_folder(session):
            if marker is not None and detector not in (None, "marker"):
                raise InputError(f"--marker cannot be used with --detector {detector}", remedy="leave one of them out")
            wanted = detector or ("auto" if marker is None else "marker")
            with progress_bar(f"looking for what moves in {session.name}", quiet=quiet) as progress:
                gathered = session_from_videos(session, out / SESSION, progress, marker, wanted)
            for line in () if quiet else gathered.summaries:
                print(line)
            return gathered
        if not (session / "rig.toml").exists() and not is_log(session):
            remedy = "put one video a camera in it, or rig.toml and observations.csv"
            raise InputError("this folder holds neither videos nor a session", file=session, remedy=remedy)
    if marker is not None:
        raise InputError("--marker goes with a folder of videos", remedy="leave it out for a session")
    if detector is not None:
        raise InputError("--detector goes with a folder of videos", remedy="leave it out for a session")
    from deploy.offline.people_session import people_session

    people = people_session(session, observations) if session.is_dir() else None
    return people or read_session(session, observations)


def _with_scale(read: Session, height: float | None, limb: str | None) -> Session:
    """The session with scale bars of a person's height, or of one limb. Raises InputError."""
    if height is None and limb is None:
        return read
    from protocols.formats.keypoints import limbs_of_height

    labels, bars = read.observations.labels, list(read.rig.scale_bars)
    # A joint without a name before it is that of each of several people.
    labels = [*labels, *dict.fromkeys(label.rpartition(".")[2] for label in labels if "." in label)]
    if limb is not None:
        found = re.fullmatch(r"\s*(.+?)\s*[-–]\s*(.+?)\s*=\s*([0-9.eE+]+)\s*", limb)
        if found is None or not {found[1], found[2]} <= set(labels):
            known = ", ".join(labels[:12])
            raise InputError(f"--limb {limb}: no two labels and a length", remedy=f"give a-b=0.4; labels are {known}")
        bars.append((found[1], found[2], float(found[3])))
    if height is not None:
        if not 0.0 < height < 1e6:
            raise InputError(f"--height {height:g} is out of range", remedy="give the person's height in rig units")
        of_people = bool(getattr(read, "people", ()))
        limbs = [("head", "foot", height)] if of_people else limbs_of_height(height, labels)
        if not limbs:
            remedy = "it needs joints named left_hip, left_knee, left_ankle; or give --limb a-b=LENGTH"
            raise InputError("--height: no thigh or shank among the labels", remedy=remedy)
        bars += limbs
    return read if bars == list(read.rig.scale_bars) else replace(read, rig=replace(read.rig, scale_bars=tuple(bars)))
