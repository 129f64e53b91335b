"""The session folder: rig.toml and observations.csv, read and written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from protocols.errors import InputError
from protocols.files import write_atomically
from protocols.session.calibration import csv_cell
from protocols.session.observations import Observations, read_observations
from protocols.session.rig import Rig, read_rig

RIG_FILE = "rig.toml"
OBSERVATIONS_FILE = "observations.csv"


def read_folder(folder: Path, observations: Path | None = None) -> tuple[Rig, Observations]:
    """Read a session folder; ``observations`` instead of its own observations.csv. Raises InputError."""
    if not folder.exists():
        raise InputError("this session does not exist", file=folder, remedy="give a session folder or a .mcap log")
    if not folder.is_dir():
        raise InputError("not a session", file=folder, remedy=f"give the folder that holds {RIG_FILE}, or a .mcap log")
    if not (folder / RIG_FILE).exists():
        raise InputError(
            f"no {RIG_FILE} in this folder",
            file=folder,
            remedy="write one: a table per camera, see `syncline simulate`",
        )
    rig = read_rig(folder / RIG_FILE)
    return rig, read_observations(observations or folder / OBSERVATIONS_FILE, rig.cameras)


def write_rig(file: Path, tables: dict[str, Any]) -> None:
    """Write rig.toml from its tables."""
    write_atomically(file, tomli_w.dumps(tables))


def write_observations(file: Path, observations: Observations) -> None:
    """Write observations.csv, by camera, label and time; floats with 17 significant digits."""
    sized = any(bool(np.isfinite(track.size).any()) for track in observations.tracks.values())
    labelled = len(observations.labels) > 1
    header = ["camera", "frame", "time", "u", "v", *(["size"] if sized else []), *(["label"] if labelled else [])]
    lines = [",".join(header)]
    for track in observations.tracks.values():
        for frame, time, (u, v), size in zip(track.frame, track.time, track.pixels, track.size, strict=True):
            cells = [track.camera, str(int(frame)), f"{time:.17g}", f"{u:.17g}", f"{v:.17g}"]
            if sized:
                cells.append(f"{size:.17g}" if np.isfinite(size) else "")
            if labelled:
                cells.append(csv_cell(track.label))
            lines.append(",".join(cells))
    write_atomically(file, "\n".join(lines) + "\n")
