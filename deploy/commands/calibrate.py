"""`syncline calibrate`: timing and poses offline."""

from __future__ import annotations

import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from deploy.outputs import write_outputs, write_refusal
from deploy.progress import progress_bar
from deploy.sessions import load_session
from protocols.errors import EXIT_DONE, InputError, Refused
from protocols.files import check_folder
from protocols.session.calibration import Known, read_calibration
from protocols.session.rig import Rig


def calibrate(
    session: Path,
    /,
    *,
    out: Path,
    observations: Path | None = None,
    solver: Literal["joint", "distributed", "paper"] = "joint",
    from_known: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
) -> int:
    """Find when each camera of a session really fired, where it stands, and the path of what moved.

    Writes calibration.toml, trajectory.csv, result.json and report.html to --out. Exit status 0 if at least
    two cameras are solved, 3 if the data hold no trustworthy answer (then only result.json and report.html).

    Example: syncline calibrate my-session --out out

    Parameters
    ----------
    session
        A folder with rig.toml and observations.csv, or a .mcap log that Syncline recorded.
    out
        Folder for the results.
    observations
        Another observations file to use instead of the session's own.
    solver
        joint: everything in one adjustment. paper: the paper's alternating method.
    from_known
        A calibration.toml whose intrinsics and poses are kept; only timing and path are found.
    json
        Print the result as JSON on standard output.
    seed
        Recorded with the result; the solvers draw nothing at random.
    """
    check_folder(out)
    if solver == "distributed":
        raise InputError("--solver distributed is not in this version", remedy="use --solver joint")
    if from_known is not None and solver != "joint":
        raise InputError("--from-known goes with --solver joint", remedy="leave one of the two out")
    rig, seen, warnings = load_session(session, observations)
    known = None
    if from_known is not None:
        known, rig = _known(from_known, rig)
    command = shlex.join(["syncline", *sys.argv[1:]])
    from hub.calibrate import calibrate as solve

    began = time.process_time()
    try:
        with progress_bar(f"calibrating {session.name}", quiet=json) as tell:
            result = solve(rig, seen, tell, solver=solver, known=known, thorough=True)
    except Refused as refusal:
        spent = time.process_time() - began
        write_refusal(
            out, refusal, rig, seen, command, solver=solver, cpu_seconds=spent, warnings=warnings, echo_json=json
        )
        raise
    result = replace(result, cpu_seconds=time.process_time() - began, warnings=warnings + result.warnings)
    write_outputs(out, result, rig, seen, command, echo_json=json)
    return EXIT_DONE


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
