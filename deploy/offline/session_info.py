"""Summary of a session folder, as a table or JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from deploy.offline.follow.objects import read_objects
from protocols.session.folder import BOXES_FILE, OBSERVATIONS_FILE, RIG_FILE, read_folder
from protocols.session.observations import Observations
from protocols.session.rig import read_rig


def describe_session(folder: Path) -> dict[str, Any]:
    """Cameras and tracks of a session folder. Raises InputError."""
    if (folder / BOXES_FILE).exists() and not (folder / OBSERVATIONS_FILE).exists():
        rig, observations = read_rig(folder / RIG_FILE), Observations({})
        boxes = read_objects(folder / BOXES_FILE, {name: camera.size for name, camera in rig.cameras.items()})
    else:
        boxes, (rig, observations) = None, read_folder(folder)
    cameras = {}
    for name, camera in rig.cameras.items():
        tracks = observations.of_camera(name)
        times = np.concatenate([np.zeros(0), *(track.time for track in tracks)])
        if boxes is not None:
            times = boxes.time[np.array(boxes.camera) == name]
        cameras[name] = {
            "size": list(camera.size),
            "fps": camera.fps,
            "calibrated": camera.intrinsics is not None,
            "rows": len(times),
            "labels": [track.label for track in tracks],
            "begin": float(times.min()) if len(times) else None,
            "end": float(times.max()) if len(times) else None,
        }
    return {
        "session": str(folder),
        "units": rig.units,
        "clock": rig.clock,
        "cameras": cameras,
        "warnings": list(observations.warnings),
    }


def print_session(folder: Path, as_json: bool) -> None:
    """Print the description."""
    description = describe_session(folder)
    if as_json:
        print(json.dumps(description, allow_nan=False))
        return
    from rich.table import Table

    from deploy.offline.outputs import wide_console

    columns = ("camera", "image", "fps", "lens", "rows", "labels", "from [s]", "to [s]")
    table = Table(*columns, title=f"{description['session']}: clocks {description['clock']}", title_justify="left")
    for name, camera in description["cameras"].items():
        begin, end = camera["begin"], camera["end"]
        table.add_row(
            name,
            "×".join(str(pixels) for pixels in camera["size"]),
            f"{camera['fps']:g}",
            "known" if camera["calibrated"] else "not known",
            str(camera["rows"]),
            str(len(camera["labels"])),
            "" if begin is None else f"{begin:.3f}",
            "" if end is None else f"{end:.3f}",
        )
    console = wide_console()
    console.print(table)
    for warning in description["warnings"]:
        console.print(f"warning: {warning}", soft_wrap=True)
