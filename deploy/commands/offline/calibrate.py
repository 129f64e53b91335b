"""`syncline calibrate`: timing and poses offline."""

from __future__ import annotations

import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from deploy.agents.malloc_tuning import keep_heap
from deploy.offline.outputs import write_outputs, write_refusal
from deploy.offline.progress import progress_bar
from deploy.offline.sessions import load_session
from protocols.core.errors import EXIT_DONE, InputError, Refused
from protocols.core.files import check_folder
from protocols.session.calibration import Known, read_calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig


def calibrate(
    session: Path,
    /,
    *,
    out: Path,
    observations: Path | None = None,
    solver: Literal["joint", "distributed", "paper"] = "joint",
    from_known: Path | None = None,
    marker: Path | None = None,
    detector: Literal["marker", "person", "vehicle"] = "marker",
    json: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
) -> int:
    """Find when each camera of a session really fired, where it stands, and the path of what moved.

    Writes calibration.toml, trajectory.csv, result.json and report.html to --out. Exit status 0 if at least
    two cameras are solved, 3 if the data hold no trustworthy answer (then only result.json and report.html).

    Of a folder of videos, one a camera and named after it, each is looked through for the marker first; the session
    that comes of it is kept in --out as session/, and videos that have not changed are not looked through again.
    A rig.toml among the videos tells their lenses (`syncline intrinsics`).

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
        joint: everything in one adjustment. distributed: poses by pose nodes that talk with their
        neighbours, in one process. paper: the paper's alternating method.
    from_known
        A calibration.toml whose intrinsics and poses are kept; only timing and path are found.
    marker
        Of videos: what the marker looks like, as `syncline detect --teach` wrote it. Default: marker.toml among
        the videos, or else the orange ball of the demo.
    detector
        Of videos: what moves in them. person, vehicle: one at a time, before fixed cameras.
    json
        Print the result as JSON on standard output.
    seed
        Of the pose nodes' random samples (--solver distributed); the other solvers draw nothing at random.
    """
    check_folder(out)
    if from_known is not None and solver != "joint":
        raise InputError("--from-known goes with --solver joint", remedy="leave one of the two out")
    rig, seen, warnings = _load(session, observations, out, marker, detector, json)
    known = None
    if from_known is not None:
        known, rig = _known(from_known, rig)
    command = shlex.join(["syncline", *sys.argv[1:]])
    keep_heap()
    from hub.calibration.pipeline import calibrate as solve

    began = time.process_time()
    try:
        with progress_bar(f"calibrating {session.name}", quiet=json) as tell:
            result = solve(rig, seen, tell, solver=solver, known=known, thorough=True, seed=seed)
    except Refused as refusal:
        spent = time.process_time() - began
        write_refusal(
            out, refusal, rig, seen, command, solver=solver, cpu_seconds=spent, warnings=warnings, echo_json=json
        )
        raise
    result = replace(result, cpu_seconds=time.process_time() - began, warnings=warnings + result.warnings)
    write_outputs(out, result, rig, seen, command, echo_json=json)
    return EXIT_DONE


def _load(
    session: Path,
    observations: Path | None,
    out: Path,
    marker: Path | None,
    detector: Literal["marker", "person", "vehicle"],
    quiet: bool,
) -> tuple[Rig, Observations, tuple[str, ...]]:
    """A session as it is, or one made of a folder of videos. Raises InputError."""
    if observations is None and session.is_dir() and not (session / "observations.csv").exists():
        from deploy.offline.video_folder import SESSION, gather_session, holds_videos

        if holds_videos(session):
            if marker is not None and detector != "marker":
                raise InputError(f"--marker means nothing with --detector {detector}", remedy="leave one of them out")
            with progress_bar(f"looking for the {detector}", quiet=quiet) as tell:
                gathered = gather_session(session, out / SESSION, tell, marker, detector)
            for line in () if quiet else gathered.told:
                print(line)
            return gathered.rig, gathered.observations, gathered.warnings
        if not (session / "rig.toml").exists():
            remedy = "put one video a camera in it, or rig.toml and observations.csv"
            raise InputError("this folder holds neither videos nor a session", file=session, remedy=remedy)
    if marker is not None:
        raise InputError("--marker goes with a folder of videos", remedy="leave it out for a session")
    if detector != "marker":
        raise InputError("--detector goes with a folder of videos", remedy="leave it out for a session")
    return load_session(session, observations)


def _known(file: Path, rig: Rig) -> tuple[Known, Rig]:
    """The given poses, and the rig in their units: the answer's world is theirs."""
    given, cameras = read_calibration(file)
    both = {name: camera for name, camera in cameras.items() if name in rig.cameras}
    if len(both) < 2:
        raise InputError(
            f"knows only {len(both)} of the session's cameras ({', '.join(rig.cameras)})",
            file=file,
            remedy="use a calibration of this rig",
        )
    scale = str(given.metadata.get("scale", "metric"))
    return Known(both, scale), replace(rig, units=given.units)
