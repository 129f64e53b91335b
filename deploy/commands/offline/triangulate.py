"""`syncline triangulate`: 3-D of labelled points with a calibration that is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from deploy.offline.progress import progress_bar
from protocols.core.errors import EXIT_DONE, InputError
from protocols.session.observations import Observations
from protocols.session.rig import Rig


def triangulate(
    session: Path,
    /,
    *,
    calibration: Path,
    out: Path,
    observations: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
) -> int:
    """Turn what several cameras saw into 3-D paths, with poses, lenses and clocks from a calibration.

    Writes time,x,y,z,std,label to --out: time in seconds on the calibration's reference clock, lengths in its
    units. std is that of one axis from the noise of the observations; the calibration's own errors are not in it.
    Cameras need not fire together. Exit status 3 if nothing is seen by two cameras, or the calibration does not fit.

    Example: syncline triangulate my-session --calibration out/calibration.toml --out track.csv

    Parameters
    ----------
    session
        A folder with observations.csv, such a file itself, or a .mcap log, on the clocks that were calibrated.
    calibration
        The calibration.toml that `syncline calibrate` wrote.
    out
        The CSV file to write.
    observations
        Another observations file to use instead of the session's own.
    json
        Print a summary as JSON.
    seed
        Accepted as everywhere; nothing here is drawn at random.
    """
    if out.is_dir():
        raise InputError("a folder of this name is in the way", file=out, remedy="give --out the name of a CSV file")
    from hub.trajectory.triangulation import triangulate as solve
    from protocols.core.files import write_atomically
    from protocols.session.calibration import csv_cell, read_calibration

    rig, known = read_calibration(calibration)
    seen, warnings = _read(session, observations, rig)
    with progress_bar(f"triangulating {session.name}", quiet=json) as tell:
        result = solve(rig, known, seen, tell)
    rows = [
        f"{t:.17g},{x:.17g},{y:.17g},{z:.17g},{std:.17g},{csv_cell(table.label)}"
        for table in result.tables
        for t, (x, y, z), std in zip(table.time, table.position, table.std, strict=True)
    ]
    write_atomically(out, "\n".join(["time,x,y,z,std,label", *rows]) + "\n")
    scale = str(rig.metadata.get("scale", "metric"))
    unit = rig.units if scale == "metric" else "baselines"
    warnings = (*warnings, *result.warnings)
    if json:
        import json as json_module

        document = {
            "out": str(out),
            "units": rig.units,
            "scale": scale,
            "reference": str(rig.metadata.get("reference", next(iter(rig.cameras)))),
            "rows": len(rows),
            "labels": {table.label: len(table.time) for table in result.tables},
            "sigma_px": result.sigma_px,
            "unused": result.unused,
            "unplaced": list(result.unplaced),
            "warnings": list(warnings),
        }
        print(json_module.dumps(document, allow_nan=False))
        return EXIT_DONE
    for table in result.tables:
        span = f"{table.time[0]:.3f} to {table.time[-1]:.3f} s"
        middle = sorted(table.std)[len(table.std) // 2]
        print(f"{table.label}: {len(table.time)} points, {span}, median std {middle:.2g} {unit}")
    for label in result.unplaced:
        print(f"no path: {label} (not seen by two cameras at a time)")
    for name, reason in result.unused.items():
        print(f"not used: {name}: {reason}")
    for warning in warnings:
        print(f"warning: {warning}")
    print(f"written: {out}")
    return EXIT_DONE


def _read(session: Path, observations: Path | None, rig: Rig) -> tuple[Observations, tuple[str, ...]]:
    """The rows of cameras that the calibration knows, and warnings. Raises InputError."""
    from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE
    from protocols.session.observations import read_observations
    from protocols.session.rig import read_rig

    warnings: tuple[str, ...] = ()
    if session.suffix == ".mcap":
        from deploy.offline.sessions import load_session

        _, seen, warnings = load_session(session, observations)
    elif not session.exists():
        raise InputError("this session does not exist", file=session, remedy="give a session folder or a .mcap log")
    else:
        # The calibration tells all about the cameras: a rig.toml only names those that it left out.
        names = dict.fromkeys(rig.cameras)
        if session.is_dir() and (session / RIG_FILE).exists():
            names |= dict.fromkeys(read_rig(session / RIG_FILE).cameras)
        names |= dict.fromkeys(rig.metadata.get("refused", {}))
        rows = observations or (session / OBSERVATIONS_FILE if session.is_dir() else session)
        seen = read_observations(rows, names)
        warnings = seen.warnings
    tracks = {key: track for key, track in seen.tracks.items() if key[0] in rig.cameras}
    left = [name for name in seen.cameras if name not in rig.cameras]
    if left:
        warnings = (*warnings, f"not in the calibration, left out: {', '.join(left)}")
    return Observations(tracks), warnings
