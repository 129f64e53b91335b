"""Export as ROS camera_info YAML, which camera_info_manager reads; ``yaml_rigs`` reads it. Intrinsics only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from protocols.formats.cameras import ExportedFiles
from protocols.session.calibration import CameraCalibration


def write(cameras: Mapping[str, CameraCalibration]) -> ExportedFiles:
    """One CAMERA.yaml a camera."""
    files = {}
    for name, camera in cameras.items():
        lens = camera.intrinsics
        projection = np.column_stack([lens.matrix, np.zeros(3)])
        document = {
            "image_width": lens.width,
            "image_height": lens.height,
            "camera_name": name,
            "camera_matrix": _matrix(lens.matrix),
            "distortion_model": "equidistant" if lens.fisheye else "plumb_bob",
            "distortion_coefficients": _matrix(lens.distortions[None]),
            "rectification_matrix": _matrix(np.eye(3)),
            "projection_matrix": _matrix(projection),
        }
        files[f"{name}.yaml"] = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    return ExportedFiles(files, ("a camera_info holds no poses and no clocks: intrinsics only",))


def _matrix(values: Any) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}
