"""What the joint adjustment knows and what it looks for: plain data, no algorithm."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SplineBasis
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import AdjustmentStep

CAMERA_PARAMETERS = 18
"""Columns of one camera: rotation 0..2, position 3..5, offset 6, rate 7, log focal length 8, k1 9, readout 10; of a
lens that was not measured also the principal point 11, 12, k2 13, k3 14, log fy/fx 15 and, of a pinhole lens, p1, p2
16, 17."""
OFFSET, RATE, FOCAL, K1, READOUT, CENTRE, K2, K3, ASPECT, P1 = 6, 7, 8, 9, 10, 11, 13, 14, 15, 16
GIVEN_PARAMETERS = 11
"""Columns of a camera whose lens is given; the others are never free."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """One camera's estimate: pose, intrinsics and time map.

    The time map is kept about ``centre``, a time in the middle of what the camera saw, so that offset and
    rate hardly depend on each other: ``t = rate * (t_camera - centre) + offset`` with t the internal
    reference time [s] and t_camera less the camera's epoch. readout: seconds from the image's first row to its last,
    negative where the last is read first; the camera's time is that of the middle row.
    """

    intrinsics: Intrinsics
    pose: Pose
    rate: float
    offset: float
    centre: float
    readout: float = 0.0

    def below_middle(self, pixels: Floats) -> Floats:
        """How far (n,) pixels (n, 2) are below the image's middle: -0.5 in its first row, 0.5 in its last."""
        height = max(self.intrinsics.height - 1, 1)
        return np.asarray(np.clip(pixels[:, 1], 0, height) / height - 0.5)

    def shot(self, time: Floats, pixels: Floats) -> Floats:
        """Camera times (n,) at which pixels (n, 2) of images of ``time`` (n,) were read."""
        return time + self.readout * self.below_middle(pixels) if self.readout else time

    def reference_time(self, time: Floats) -> Floats:
        """Internal reference times (n,) of camera times (n,) less the epoch."""
        return np.asarray(self.rate * (time - self.centre) + self.offset)

    def camera_time(self, reference: Floats) -> Floats:
        """Camera times (n,) less the epoch of internal reference times (n,)."""
        return np.asarray((reference - self.offset) / self.rate + self.centre)


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Observations of one label by one camera.

    camera, label: indices. time: (n,) on the camera's clock less its epoch [s]. pixels: (n, 2) distorted.
    use: (n,) rows that count. stamp: (n,) what the frames' stamps said, where ``time`` is not that: a told readout or a
    frame's own time (`frame_times`) has moved it.
    """

    camera: int
    label: int
    time: Floats
    pixels: Floats
    use: Bools
    stamp: Floats | None = None

    @property
    def stamps(self) -> Floats:
        """Stamps (n,) of the rows' frames [s]: one a frame."""
        return self.time if self.stamp is None else self.stamp

    def using(self, use: Bools) -> Rows:
        """The same rows with other ones counting."""
        return replace(self, use=use)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The 3-D path of one label on the internal reference time: a spline, or separate points. control: (size, 3)."""

    basis: SplineBasis | PointBasis
    control: Floats

    def at(self, time: Floats, derivative: int = 0) -> Floats:
        """Positions (n, 3) or a derivative; NaN outside the stretches."""
        return self.basis.evaluate(self.control, time, derivative)


@dataclass(frozen=True, slots=True, eq=False)
class Coloured:
    """Noise of one image axis by camera. white, lasting: (cameras,) std [px]. seconds: (cameras,) time constant."""

    white: Floats
    lasting: Floats
    seconds: Floats

    def of(self, cameras: list[int]) -> Coloured:
        """The same of some cameras, in this order."""
        return Coloured(self.white[cameras], self.lasting[cameras], self.seconds[cameras])


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Everything that the adjustment moves.

    sigma: (cameras,) noise of one pixel coordinate. steps: the way here. jitter: (cameras,) std [s] of the cameras'
    stamps where the frames' own times were found (`frame_times`); None = they were not looked for, or none jitter.
    coloured: noise by which errors that last were counted (`generalised`); None = rows err by themselves.
    """

    cameras: tuple[CameraState, ...]
    trajectories: tuple[Trajectory, ...]
    sigma: Floats
    steps: tuple[AdjustmentStep, ...] = ()
    jitter: Floats | None = None
    coloured: Coloured | None = None


@dataclass(frozen=True, slots=True)
class LensPrior:
    """What is known beforehand of a lens that nobody measured: it is always estimated.

    focal: [px], focal_std: of its logarithm. centre: (u, v) of the principal point, centre_std: [px]. k1, k2: the
    first distortion coefficients, k1_std, k2_std: theirs; k3_std, tangential_std, aspect_std: of what is 0 beforehand
    (k3 less its own, p1 and p2, log fy/fx less its own).
    """

    focal: float
    focal_std: float
    centre: tuple[float, float]
    centre_std: float
    k1: float
    k1_std: float
    k2: float
    k2_std: float
    k3_std: float = 0.01
    tangential_std: float = 2e-3
    aspect_std: float = 2e-3


@dataclass(frozen=True, slots=True)
class Freedom:
    """What may move, and priors.

    pose, clock, lens: whether poses, time maps, and focal length with k1 are estimated.
    readout: whether rolling-shutter readouts are. focal_std: prior std of log focal length. k1_std: prior std of k1.
    rate_std: prior std of a rate about 1: crystals err by 50 ppm, what is told of frame rates by 1000.
    readout_std: prior std [s] of a readout about 0.
    """

    pose: bool = True
    clock: bool = True
    lens: bool = False
    readout: bool = False
    focal_std: float = 0.01
    k1_std: float = 0.02
    rate_std: float = 1e-3
    readout_std: float = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Observations and what is fixed.

    rows: all observations. nominal: intrinsics as given (priors of the lens). clock_reference: index of the camera
    whose clock is the internal time. anchors: two cameras whose pose and distance fix the gauge. freedom: what may
    move. guessed: by camera, priors of lenses that were not measured, None = given; () = all are. timed: by camera,
    whether its readout was told, so that its rows' times count it already; () = none was. loose: by camera, by how much
    lenses that are given may be off where they are estimated all the same; () = they are not.
    """

    rows: tuple[Rows, ...]
    nominal: tuple[Intrinsics, ...]
    clock_reference: int
    anchors: tuple[int, int]
    freedom: Freedom = field(default_factory=Freedom)
    guessed: tuple[LensPrior | None, ...] = ()
    timed: tuple[bool, ...] = ()
    loose: tuple[LensPrior, ...] = ()

    def lens_prior(self, camera: int) -> LensPrior | None:
        """The prior of a lens that is estimated whole; None = at most its focal length and k1 are."""
        guess = self.guessed[camera] if self.guessed else None
        return self.loose[camera] if guess is None and self.loose else guess

    def free_columns(self) -> Ints:
        """Indices of the free camera parameters in the stacked vector of CAMERA_PARAMETERS each."""
        columns: list[int] = []
        for camera in range(len(self.nominal)):
            base = camera * CAMERA_PARAMETERS
            if self.freedom.pose:
                columns += range(base, base + 6)
            if self.freedom.clock and camera != self.clock_reference:
                columns += [base + OFFSET, base + RATE]
            if self.freedom.lens or self.lens_prior(camera) is not None:
                columns += [base + FOCAL, base + K1]
            if self.freedom.readout and not (self.timed and self.timed[camera]):
                columns.append(base + READOUT)
            if self.lens_prior(camera) is not None:
                columns += range(base + CENTRE, base + (P1 if self.nominal[camera].fisheye else CAMERA_PARAMETERS))
        return np.array(columns, dtype=np.int64)
