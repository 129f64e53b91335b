"""The same world through smaller or slower cameras: what lets many simulated cameras share a small machine."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from edge.scenes.common.base import Scene
from protocols.geometry.camera import Intrinsics

_Scene = TypeVar("_Scene", bound=Scene)


def scaled(scene: _Scene, width: int | None = None, fps: float | None = None) -> _Scene:
    """``scene`` with all pictures ``width`` [px] wide and all cameras at ``fps`` [Hz]; None = as they are."""
    cameras = tuple(
        replace(
            camera,
            intrinsics=camera.intrinsics if width is None else scaled_lens(camera.intrinsics, width),
            fps=camera.fps if fps is None else fps,
        )
        for camera in scene.cameras
    )
    return replace(scene, cameras=cameras)


def scaled_lens(lens: Intrinsics, width: int) -> Intrinsics:
    """A lens of the same view for pictures ``width`` [px] wide; pixel centres are at whole numbers."""
    factor = width / lens.width
    height = round(lens.height * factor)
    matrix = lens.matrix.copy()
    matrix[:2] *= factor
    matrix[:2, 2] += 0.5 * factor - 0.5
    return Intrinsics(width, height, matrix, np.asarray(lens.distortions), lens.fisheye)
