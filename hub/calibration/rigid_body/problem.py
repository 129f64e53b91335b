"""The adjustment of cameras around rigid bodies: its fixed quantities and its estimated ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.bundle.problem import CameraState, Column
from hub.calibration.rigid_body.motion import BodyMotion
from hub.calibration.rigid_body.views import CameraViews
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats
from protocols.session.calibration import AdjustmentStep

_SHAPE_START = 2e-3  # of the distance of neighbouring points: of a print on paper
_JITTER_START = 0.1  # of a frame interval


@dataclass(frozen=True, slots=True, eq=False)
class BodyProblem:
    """Fixed quantities of the adjustment, by camera.

    views: what was seen. nominal: prior means of the lenses. free_lens: whether it is estimated. fixed: whether the
    camera's pose is given. reference: the camera that fixes clock and, where no pose is given, the world. clock:
    whether clocks are estimated. free_readout: whether the readout of its rows is estimated. use: rows that fit.
    free_shape: whether the body's points are estimated, with the described ones as prior means.
    """

    views: tuple[CameraViews, ...]
    nominal: tuple[Intrinsics, ...]
    free_lens: tuple[bool, ...]
    fixed: tuple[bool, ...]
    reference: int
    clock: bool
    free_readout: tuple[bool, ...]
    use: tuple[Bools, ...]
    free_shape: bool = False

    def columns(self, camera: int) -> list[int]:
        """The free parameters of a camera, as in ``hub.bundle.problem``."""
        out: list[int] = []
        if not self.fixed[camera] and (camera != self.reference or any(self.fixed)):
            out += range(6)
        if self.clock and camera != self.reference:
            out += [Column.OFFSET, Column.RATE]
        if self.clock and self.free_readout[camera]:
            out.append(Column.READOUT)
        if self.free_lens[camera]:
            out += Column.LENS[: 7 if self.nominal[camera].fisheye else None]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """All estimated quantities. shift: by camera, time error (V,) of each view [s]. sigma: (cameras,) noise [px].
    jitter: (cameras,) std of the time errors [s], 0 = none. shape: (labels, 3) true points of the bodies less the
    described ones; shape_std: (3,) their prior stds by axis. scatter: by body, stds (7,) of the path's third
    differences; None on a shared clock."""

    cameras: tuple[CameraState, ...]
    bodies: tuple[BodyMotion, ...]
    shift: tuple[Floats, ...]
    sigma: Floats
    jitter: Floats
    shape: Floats
    shape_std: Floats
    scatter: tuple[Floats | None, ...] = ()
    steps: tuple[AdjustmentStep, ...] = ()


def initial_jitter(problem: BodyProblem) -> Floats:
    """Prior stds (cameras,) of the time errors [s] before they are estimated."""
    return np.array(
        [_JITTER_START * frame_interval(views) if problem.clock else 0.0 for views in problem.views], dtype=np.float64
    )


def frame_interval(views: CameraViews) -> float:
    """Median time between the views of a body [s]."""
    steps = np.diff(views.time)[np.diff(views.body) == 0]
    return float(np.median(steps)) if len(steps) else 1.0


def pitch(problem: BodyProblem) -> float:
    """Median distance of a body's described points from the nearest other one."""
    points = np.unique(np.concatenate([views.points for views in problem.views]), axis=0)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def initial_shape(problem: BodyProblem, labels: int) -> tuple[Floats, Floats]:
    """No errors (labels, 3) of the points, and their prior stds (3,) before they are estimated."""
    return np.zeros((labels, 3)), np.full(3, _SHAPE_START * pitch(problem))
