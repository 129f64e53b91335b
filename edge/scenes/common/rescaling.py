"""A scene at another resolution or frame rate, so that many simulated cameras fit on a small machine."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from edge.scenes.common.base import SimulatedScene
from protocols.geometry.camera import Intrinsics

_Scene = TypeVar("_Scene", bound=SimulatedScene)


def rescale_scene(scene: _Scene, width: int | None = None, fps: float | None = None) -> _Scene:
    """``scene`` with all images ``width`` [px] wide and all cameras at ``fps`` [Hz]; None = unchanged."""
    cameras = tuple(
        replace(
            camera,
            intrinsics=camera.intrinsics if width is None else rescale_intrinsics(camera.intrinsics, width),
            fps=camera.fps if fps is None else fps,
        )
        for camera in scene.cameras
    )
    return replace(scene, cameras=cameras)


def rescale_intrinsics(lens: Intrinsics, width: int) -> Intrinsics:
    """Intrinsics of the same view for images ``width`` [px] wide; pixel centres are at integers."""
    factor = width / lens.width
    height = round(lens.height * factor)
    matrix = lens.matrix.copy()
    matrix[:2] *= factor
    matrix[:2, 2] += 0.5 * factor - 0.5
    return Intrinsics(width, height, matrix, np.asarray(lens.distortions), lens.fisheye)
