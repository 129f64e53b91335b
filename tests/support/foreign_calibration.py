"""A calibration.toml of given lenses and poses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import tomli_w

from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose


def calibration_file(file: Path, cameras: Mapping[str, tuple[Intrinsics, Pose]]) -> Path:
    """Write a calibration.toml; returns its path."""
    tables = {
        name: {
            "name": name,
            **lens.table(),
            "rotation": pose.rodrigues.tolist(),
            "translation": pose.translation.tolist(),
        }
        for name, (lens, pose) in cameras.items()
    }
    file.write_text(tomli_w.dumps({"metadata": {"units": "m", "scale": "metric"}, **tables}))
    return file
