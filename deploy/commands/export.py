"""`syncline export`: results in other tools' formats."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from protocols.errors import EXIT_DONE, InputError


def export(
    source: Path,
    /,
    *,
    to: Literal["opencv", "colmap", "trc"],
    out: Path,
    units: Literal["m", "cm", "mm"] = "m",
) -> int:
    """Write a calibration or a path in another tool's format. aniposelib reads calibration.toml as it is.

    opencv: CAMERA.yml a camera for cv2.FileStorage. colmap: cameras.txt, images.txt, points3D.txt. trc: a path for
    OpenSim, in the world's own axes.

    Example: syncline export out/calibration.toml --to colmap --out colmap

    Example: syncline export out/trajectory.csv --to trc --out path.trc

    Parameters
    ----------
    source
        calibration.toml for opencv and colmap; trajectory.csv or track.csv for trc.
    to
        The format.
    out
        The folder for opencv and colmap, the file for trc.
    units
        Of the lengths in a path, for trc.
    """
    from deploy import exporting
    from protocols.files import check_folder, write_together
    from protocols.session.calibration import read_calibration

    if to == "trc":
        if out.is_dir():
            raise InputError("a folder of this name is in the way", file=out, remedy="give --out the name of a file")
        files = {out: exporting.trc_text(source, out.name, units)}
    else:
        check_folder(out)
        rig, cameras = read_calibration(source)
        if to == "opencv":
            files = {out / f"{name}.yml": exporting.opencv_yaml(camera, rig.units) for name, camera in cameras.items()}
        else:
            files = {out / name: text for name, text in exporting.colmap_text(cameras).items()}
    write_together(files)
    print(f"written: {', '.join(str(file) for file in files)}")
    return EXIT_DONE
