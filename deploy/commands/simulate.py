"""`syncline simulate`: a session of a shipped scene, with its truth beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from protocols.errors import EXIT_DONE, InputError
from protocols.files import check_folder


def simulate(
    scene: str,
    /,
    *,
    out: Path,
    seconds: float = 60.0,
    cameras: int | None = None,
    seed: int = 0,
    noise_px: float = 0.5,
    outliers: float = 0.0,
    drops: float | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write a session of a simulated scene: rig.toml, observations.csv and the truth.

    The truth is in truth_calibration.toml and truth_trajectory.csv (true time of the first camera's clock).

    Example: syncline simulate marker --cameras 5 --seed 3 --out my-session

    Parameters
    ----------
    scene
        Name of the scene: marker (a room) or marker-outdoor (a field).
    out
        Folder to write; made if need be.
    seconds
        Length of the recording.
    cameras
        Number of cameras, at least 2; default: the scene's own.
    seed
        Same seed, same session.
    noise_px
        Detector noise, std of each coordinate.
    outliers
        Share of false detections, 0 to 1.
    drops
        Share of lost frames, 0 to 1; default: the scene's own.
    json
        Print what was written as JSON.
    """
    check_folder(out)
    if seed < 0:
        raise InputError(f"--seed {seed} is negative", remedy="give 0 or more")
    if cameras is not None and not 2 <= cameras <= 64:
        raise InputError(f"--cameras {cameras} is out of range", remedy="give 2 to 64")
    if not 1.0 <= seconds <= 7200.0:
        raise InputError(f"--seconds {seconds:g} is out of range", remedy="give 1 to 7200")
    if not 0.0 <= outliers < 1.0 or (drops is not None and not 0.0 <= drops < 1.0) or not 0.0 <= noise_px <= 50.0:
        raise InputError("--outliers and --drops are shares below 1, --noise-px is 0 to 50", remedy="correct them")
    from deploy.simulated import write_simulated_session

    written = write_simulated_session(
        scene, out, seconds=seconds, cameras=cameras, seed=seed, noise_px=noise_px, outliers=outliers, drops=drops
    )
    if json:
        import json as json_module

        print(json_module.dumps({"out": str(out), **written}))
    else:
        print(f"{written['cameras']} cameras, {written['rows']} observations in {out}")
        print(f"next: syncline calibrate {out} --out {out}-result")
    return EXIT_DONE
