"""`syncline triangulate`: triangulation of labelled points with a fixed calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from deploy.commands.common import Json, UnusedSeed, answer, check_file, closing_lines
from deploy.offline.progress import progress_bar

if TYPE_CHECKING:
    from hub.api import TriangulationResult


def triangulate(
    session: Path,
    /,
    *,
    calibration: Path,
    out: Path,
    observations: Path | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Triangulate the observations of several cameras into 3-D trajectories, with poses, intrinsics and clocks given.

    Writes time,x,y,z,std,label to --out: time in seconds on the calibration's reference clock, lengths in its
    units. std is per axis and due to the observation noise only, without the calibration's own uncertainty. Exposures
    need not be simultaneous. Exit status 3 if no point is seen by two cameras, or the calibration does not fit.

    Example: syncline triangulate my-session --calibration out/calibration.toml --out track.csv

    Example: syncline triangulate my-session --calibration out/calibration.toml --out track.c3d

    Parameters
    ----------
    session
        A folder with observations.csv, an observations file, or a .mcap log, with times on the calibrated clocks.
    calibration
        The calibration.toml that `syncline calibrate` wrote.
    out
        The file to write: .csv, or .trc (OpenSim) or .c3d (motion capture), which have gaps where a label has no
        position.
    observations
        Another observations file to use instead of the session's own.
    """
    from hub.api import triangulate as solve
    from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE

    check_file(out, "a CSV file", session, observations, calibration, session / OBSERVATIONS_FILE, session / RIG_FILE)

    with progress_bar(f"triangulating {session.name}", quiet=json) as progress:
        result = solve(session, calibration, progress, observations=observations)
    _save(result, out)
    rig, warnings = result.rig, result.warnings
    scale = str(rig.metadata.get("scale", "metric"))
    unit = rig.units if scale == "metric" else "baselines"
    document = {
        "out": str(out),
        "units": rig.units,
        "scale": scale,
        "reference": str(rig.metadata.get("reference", next(iter(rig.cameras)))),
        "rows": sum(len(table.time) for table in result.tables),
        "labels": {table.label: len(table.time) for table in result.tables},
        "sigma_px": result.sigma_px,
        "unused": result.unused,
        "unplaced": list(result.unplaced),
        "warnings": list(warnings),
    }
    lines = []
    for table in result.tables:
        span = f"{table.time[0]:.3f} to {table.time[-1]:.3f} s"
        middle = sorted(table.std)[len(table.std) // 2]
        lines.append(f"{table.label}: {len(table.time)} points, {span}, median std {middle:.2g} {unit}")
    lines += [f"no path: {label} (not seen by two cameras at a time)" for label in result.unplaced]
    lines += [f"not used: {name}: {reason}" for name, reason in result.unused.items()]
    return answer(document, [*lines, *closing_lines(warnings, [out])], json)


def _save(result: TriangulationResult, out: Path) -> None:
    """Write the trajectories in the format that the file's suffix names. Raises InputError."""
    from tempfile import TemporaryDirectory

    from protocols.core.files import write_atomically
    from protocols.formats.trajectories import trc_text, write_c3d

    suffix = out.suffix.lower()
    if suffix not in (".trc", ".c3d"):
        result.save(out)
        return
    with TemporaryDirectory() as folder:
        table = Path(folder) / "track.csv"
        result.save(table)
        if suffix == ".c3d":
            write_c3d(table, out, result.rig.units)
        else:
            write_atomically(out, trc_text(table, out.name, result.rig.units)[0])
