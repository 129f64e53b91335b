"""`syncline calibrate`: offline estimation of clock offsets and poses."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from deploy.agents.malloc_tuning import retain_freed_memory
from deploy.offline.progress import progress_bar
from protocols.core.errors import EXIT_DONE, InputError, Refused
from protocols.core.files import check_folder
from protocols.log.read.session import load_session
from protocols.session.session import Session


def calibrate(
    session: Path,
    /,
    *,
    out: Path,
    observations: Path | None = None,
    solver: Literal["joint", "distributed", "paper"] = "joint",
    from_known: Path | None = None,
    refine_lenses: Annotated[bool, Parameter(negative="")] = False,
    marker: Path | None = None,
    detector: str = "marker",
    json: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
) -> int:
    """Estimate clock offset and pose of each camera of a session, and the trajectory of the moving target.

    Writes calibration.toml, trajectory.csv, result.json and report.html to --out. Exit status 0 if at least
    two cameras are solved, 3 if the data allow no reliable result (then only result.json and report.html).

    In a folder of videos, one per camera and named after it, the marker is first detected in each video. The resulting
    session is stored in --out as session/, and the detections of unchanged videos are reused. A rig.toml in the folder
    gives the cameras' intrinsics (`syncline intrinsics`).

    Example: syncline calibrate my-session --out out

    Example: syncline calibrate my-videos --out out

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
        For videos: appearance of the marker, as written by `syncline detect --teach`. Default: marker.toml in the
        folder of videos, otherwise the orange ball of the demo.
    detector
        For videos: what moves in them. person, vehicle: only one at a time in view, with fixed cameras. Or the .toml
        file of an ONNX network, or a detector that another package registers: only one target at a time in view.
    json
        Print the result as JSON on standard output.
    seed
        Seed of the pose nodes' random samples (--solver distributed); the other solvers use no random numbers.
    """
    from hub.api import CalibrationOptions
    from hub.api import calibrate as solve

    check_folder(out)
    options = CalibrationOptions(solver, from_known, seed=seed, refine_lenses=refine_lenses)
    read = _load(session, observations, out, marker, detector, json)
    command = shlex.join(["syncline", *sys.argv[1:]])
    retain_freed_memory()
    from deploy.offline.outputs import report_refusal, report_result

    try:
        with progress_bar(f"calibrating {session.name}", quiet=json) as progress:
            result = solve(read, options, progress)
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
    detector: str,
    quiet: bool,
) -> Session:
    """Read a session, or make one from a folder of videos. Raises InputError."""
    if observations is None and session.is_dir() and not (session / "observations.csv").exists():
        from deploy.offline.video_folder import SESSION, is_video_folder, session_from_videos

        if is_video_folder(session):
            if marker is not None and detector != "marker":
                raise InputError(f"--marker cannot be used with --detector {detector}", remedy="leave one of them out")
            with progress_bar(f"looking for the {detector}", quiet=quiet) as progress:
                gathered = session_from_videos(session, out / SESSION, progress, marker, detector)
            for line in () if quiet else gathered.summaries:
                print(line)
            return gathered
        if not (session / "rig.toml").exists():
            remedy = "put one video a camera in it, or rig.toml and observations.csv"
            raise InputError("this folder holds neither videos nor a session", file=session, remedy=remedy)
    if marker is not None:
        raise InputError("--marker goes with a folder of videos", remedy="leave it out for a session")
    if detector != "marker":
        raise InputError("--detector goes with a folder of videos", remedy="leave it out for a session")
    return load_session(session, observations)
