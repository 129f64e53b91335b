"""Data of the bundle adjustment: observations, parameters, priors and state. No algorithm."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hub.bundle.noise.clock_wander import Wander
from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SplineBasis
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import AdjustmentStep
from protocols.session.rig import MAX_READOUT_S

CAMERA_PARAMETERS = 18
"""Columns of one camera: rotation 0..2, position 3..5, and those of `Column`."""
CRYSTAL_RATE_STD = 1.4e-4
"""Prior std of one crystal's rate against another's: each is within 100 ppm."""
LARGE_NETWORK = 24
"""Cameras above which a network is a chain rather than a room: up to there all pairs take less than the adjustment.
Rooms of 26 and 32 cameras come out the same to a micrometre either way, in 2 to 12 % less CPU."""


class Column:
    """Columns of one camera after its pose. FOCAL: log focal length. CENTRE: principal point, two. ASPECT: log fy/fx.

    From CENTRE on they are for a lens that was not measured; P1, two, for a pinhole lens.
    """

    OFFSET, RATE, FOCAL, K1, READOUT = 6, 7, 8, 9, 10
    CENTRE, K2, K3, ASPECT, P1 = 11, 13, 14, 15, 16
    LENS = (FOCAL, K1, CENTRE, CENTRE + 1, K2, K3, ASPECT, P1, P1 + 1)
    """Of a lens that is estimated; a fisheye lens has no P1, P1 + 1."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """One camera's estimate: pose, intrinsics and time map.

    The time map is parametrised about ``centre``, the middle of the camera's observed span, so that offset and
    rate are nearly uncorrelated: ``t = rate * (t_camera - centre) + offset`` with t the internal
    reference time [s] and t_camera relative to the camera's epoch. readout: rolling-shutter readout time [s] from the
    sensor's first row to its last, negative where the last row is read first; camera times are those of the middle row.
    """

    intrinsics: Intrinsics
    pose: Pose
    rate: float
    offset: float
    centre: float
    readout: float = 0.0

    def row_offset(self, pixels: Floats) -> Floats:
        """The sensor's row (n,) of pixels (n, 2): `Intrinsics.row_offset`."""
        return self.intrinsics.row_offset(pixels)

    def row_time(self, time: Floats, pixels: Floats) -> Floats:
        """Camera times (n,) at which the rows of pixels (n, 2) were read, in frames with times ``time`` (n,)."""
        return time + self.readout * self.row_offset(pixels) if self.readout else time

    def reference_time(self, time: Floats) -> Floats:
        """Internal reference times (n,) of camera times (n,) relative to the epoch."""
        return np.asarray(self.rate * (time - self.centre) + self.offset)

    def camera_time(self, reference: Floats) -> Floats:
        """Camera times (n,), relative to the epoch, of internal reference times (n,)."""
        return np.asarray((reference - self.offset) / self.rate + self.centre)


@dataclass(frozen=True, slots=True, eq=False)
class TrackObservations:
    """Observations of one label by one camera.

    camera, label: indices. time: (n,) on the camera's clock relative to its epoch [s]. pixels: (n, 2) distorted.
    use: (n,) inliers. stamp: (n,) the frames' original timestamps where ``time`` differs from them, because it is
    corrected for a given readout or by an estimated frame time (`timestamp_jitter`). relative_std: (n,) std of each
    row's noise relative to the camera's typical row, by the detector's covariances; None = all alike. along_std: (n,)
    std along the row's motion relative to that across it, by jitter of the stamps; None = alike.
    """

    camera: int
    label: int
    time: Floats
    pixels: Floats
    use: Bools
    stamp: Floats | None = None
    relative_std: Floats | None = None
    along_std: Floats | None = None

    @property
    def stamps(self) -> Floats:
        """Timestamps (n,) of the rows' frames [s]: the same for all rows of a frame."""
        return self.time if self.stamp is None else self.stamp

    def every(self, step: int) -> TrackObservations:
        """Every ``step``-th row."""
        part = slice(None, None, step)
        return replace(
            self,
            time=self.time[part],
            pixels=self.pixels[part],
            use=self.use[part],
            stamp=None if self.stamp is None else self.stamp[part],
            relative_std=None if self.relative_std is None else self.relative_std[part],
            along_std=None if self.along_std is None else self.along_std[part],
        )

    def renumbered(self, camera: int, label: int) -> TrackObservations:
        """The same rows with other indices, in half of the time of `replace`: networks grow camera by camera."""
        return TrackObservations(
            camera, label, self.time, self.pixels, self.use, self.stamp, self.relative_std, self.along_std
        )

    def using(self, use: Bools) -> TrackObservations:
        """The same rows with another inlier mask."""
        return replace(self, use=use)


@dataclass(frozen=True, slots=True, eq=False)
class UsedRows:
    """The rows in use of several labels of one camera, concatenated; the same at every state.

    A calibration board gives some thirty rows a label: numpy takes as long for one label as for all at once. labels,
    ends: of each part, and where its rows end. time (n,), pixels (n, 2). relative_information: (n,). along_std: (n,),
    None = all alike.
    """

    labels: tuple[int, ...]
    ends: Ints
    time: Floats
    pixels: Floats
    relative_information: Floats
    along_std: Floats | None

    @classmethod
    def of(cls, parts: Sequence[TrackObservations]) -> UsedRows:
        """The rows in use of parts of one camera."""
        parts = [part for part in parts if part.use.any()] or parts[:1]
        used = [np.flatnonzero(part.use) for part in parts]

        def stacked(values: Iterable[Floats | None]) -> Floats:
            each = zip(values, used, strict=True)
            return np.concatenate([np.ones(len(at)) if one is None else one.take(at, axis=0) for one, at in each])

        alike = all(part.along_std is None for part in parts)
        return cls(
            tuple(part.label for part in parts),
            np.cumsum([len(rows) for rows in used], dtype=np.int64),
            stacked(part.time for part in parts),
            stacked(part.pixels for part in parts),
            1.0 / np.square(stacked(part.relative_std for part in parts)),
            None if alike else stacked(part.along_std for part in parts),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The 3-D path of one label on the internal reference time: a spline, or separate points. control: (size, 3).

    determined: the share of its third differences that observations rather than the smoothness prior determine.
    """

    basis: SplineBasis | PointBasis
    control: Floats
    determined: float = 1.0

    def at(self, time: Floats, derivative: int = 0) -> Floats:
        """Positions (n, 3) or a derivative; NaN outside the observed intervals."""
        return self.basis.evaluate(self.control, time, derivative)


@dataclass(frozen=True, slots=True, eq=False)
class CorrelatedNoise:
    """White plus Gauss-Markov noise of one image axis, by camera.

    white_std, correlated_std: (cameras,) [px]. time_constant: (cameras,) [s].
    """

    white_std: Floats
    correlated_std: Floats
    time_constant: Floats

    def select(self, cameras: list[int]) -> CorrelatedNoise:
        """The noise of these cameras, in this order."""
        return CorrelatedNoise(self.white_std[cameras], self.correlated_std[cameras], self.time_constant[cameras])


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A step of a camera's clock. camera: index. time: camera time [s] from which on it holds; size: [s] by which the
    clock is set forward there, and its std. statistic: chi-squared of the size, its noise scaled to the effective
    sample size."""

    camera: int
    time: float
    size: float
    std: float
    statistic: float


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentState:
    """All parameters that the adjustment estimates.

    sigma: (cameras,) noise of one pixel coordinate. steps: convergence history. jitter: (cameras,) std [s] of the
    cameras' timestamps where frame times were estimated (`timestamp_jitter`); None = not estimated, or no jitter found.
    correlated_noise: noise model of the re-fit by generalised least squares (`gls`); None = independent rows.
    clock_steps, wanders: for which the rows' times are corrected.
    """

    cameras: tuple[CameraState, ...]
    trajectories: tuple[Trajectory, ...]
    sigma: Floats
    steps: tuple[AdjustmentStep, ...] = ()
    jitter: Floats | None = None
    correlated_noise: CorrelatedNoise | None = None
    clock_steps: tuple[ClockStep, ...] = ()
    wanders: tuple[Wander, ...] = ()

    @property
    def by_label(self) -> dict[int, Trajectory]:
        """The path of each label."""
        return dict(enumerate(self.trajectories))


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Prior of a lens whose parameters are estimated: all, or, without the other stds, the focal length alone.

    focal: [px], focal_std: of its logarithm. centre: (u, v) of the principal point, centre_std: [px]. k1, k2: the
    first distortion coefficients, k1_std, k2_std: their stds; k3_std, tangential_std, aspect_std: of parameters with
    prior mean 0 (k3 and log fy/fx relative to their nominal values, p1 and p2).
    """

    focal: float
    focal_std: float
    centre: tuple[float, float] = (0.0, 0.0)
    centre_std: float = 0.0
    k1: float = 0.0
    k1_std: float = 0.0
    k2: float = 0.0
    k2_std: float = 0.0
    k3_std: float = 0.01
    tangential_std: float = 2e-3
    aspect_std: float = 2e-3

    @property
    def focal_only(self) -> bool:
        """Whether the lens was measured, and its focal length has a std."""
        return not self.k1_std


@dataclass(frozen=True, slots=True)
class FreeParameters:
    """Which parameters are free, and their priors.

    pose, clock, lens: whether poses, time maps, and focal length with k1 are estimated.
    readout: whether rolling-shutter readouts are. focal_std: prior std of log focal length. k1_std: prior std of k1.
    rate_std: prior std of a rate about 1 while it is not known whether the frame rate is the nominal one.
    """

    pose: bool = True
    clock: bool = True
    lens: bool = False
    readout: bool = False
    focal_std: float = 0.01
    k1_std: float = 0.02
    rate_std: float = 1e-3


@dataclass(frozen=True, eq=False)
class Problem:
    """Observations and fixed quantities of a bundle adjustment.

    rows: all observations. nominal: given intrinsics (prior means of the lens). clock_reference: index of the camera
    whose clock is the internal time. anchors: the two cameras whose pose and distance fix the gauge. lens_priors: by
    camera, priors of lenses that were not measured or whose focal length has a std, None = given; () = all are given.
    readout_given: by camera, whether its readout was given, so that the rows' times are already corrected; () = none
    was. lens_tolerances: by camera, priors for given lenses that are estimated all the same; () = they are fixed.
    crystal_rates: by camera, whether its rate differs from the reference's only as two crystals do
    (`CRYSTAL_RATE_STD`); () = not decided. held: cameras of which nothing is free; any of them fix the gauge.
    """

    rows: tuple[TrackObservations, ...]
    nominal: tuple[Intrinsics, ...]
    clock_reference: int
    anchors: tuple[int, int]
    free_parameters: FreeParameters = field(default_factory=FreeParameters)
    lens_priors: tuple[LensPrior | None, ...] = ()
    readout_given: tuple[bool, ...] = ()
    lens_tolerances: tuple[LensPrior, ...] = ()
    crystal_rates: tuple[bool, ...] = ()
    held: frozenset[int] = frozenset()

    @cached_property
    def by_camera(self) -> dict[int, tuple[TrackObservations, ...]]:
        """The observations of each camera that has any, in the order of the rows."""
        return _grouped(self.rows, lambda rows: rows.camera)

    @cached_property
    def by_label(self) -> dict[int, tuple[TrackObservations, ...]]:
        """The observations of each label that has any, in the order of the rows."""
        return _grouped(self.rows, lambda rows: rows.label)

    @cached_property
    def used(self) -> dict[int, UsedRows]:
        """The rows in use of each camera that has any observations."""
        return {camera: UsedRows.of(parts) for camera, parts in self.by_camera.items()}

    def of_camera(self, camera: int) -> tuple[TrackObservations, ...]:
        """The observations by one camera."""
        return self.by_camera.get(camera, ())

    def of_label(self, label: int) -> tuple[TrackObservations, ...]:
        """The observations of one label."""
        return self.by_label.get(label, ())

    def rate_std(self, camera: int) -> float:
        """Prior std of a camera's rate about 1."""
        crystal = bool(self.crystal_rates) and self.crystal_rates[camera]
        return min(self.free_parameters.rate_std, CRYSTAL_RATE_STD) if crystal else self.free_parameters.rate_std

    def is_readout_free(self, camera: int) -> bool:
        """Whether a camera's readout is estimated."""
        return self.free_parameters.readout and not (self.readout_given and self.readout_given[camera])

    def longest_readout(self, camera: int) -> float:
        """A sensor is read before its next frame [s]."""
        steps = [np.diff(np.unique(part.stamps)) for part in self.of_camera(camera)]
        return min([MAX_READOUT_S, *(float(np.median(step)) for step in steps if len(step))])

    def lens_prior(self, camera: int) -> LensPrior | None:
        """The prior of a lens that is estimated; None = at most focal length and k1 are."""
        prior = self.lens_priors[camera] if self.lens_priors else None
        if self.lens_tolerances and (prior is None or prior.focal_only):
            tolerance = self.lens_tolerances[camera]
            return replace(tolerance, focal_std=tolerance.focal_std if prior is None else prior.focal_std)
        return prior

    @cached_property
    def free_columns(self) -> Ints:
        """Indices of the free camera parameters in the stacked vector of CAMERA_PARAMETERS each."""
        columns: list[int] = []
        for camera in (one for one in range(len(self.nominal)) if one not in self.held):
            base = camera * CAMERA_PARAMETERS
            if self.free_parameters.pose:
                columns += range(base, base + 6)
            if self.free_parameters.clock and camera != self.clock_reference:
                columns += [base + Column.OFFSET, base + Column.RATE]
            prior = self.lens_prior(camera)
            if self.free_parameters.lens or prior is not None:
                columns += [base + Column.FOCAL, base + Column.K1][: 1 if prior is not None and prior.focal_only else 2]
            if self.is_readout_free(camera):
                columns.append(base + Column.READOUT)
            if prior is not None and not prior.focal_only:
                columns += range(
                    base + Column.CENTRE, base + (Column.P1 if self.nominal[camera].fisheye else CAMERA_PARAMETERS)
                )
        found = np.array(columns, dtype=np.int64)
        found.flags.writeable = False
        return found


def _grouped(
    rows: tuple[TrackObservations, ...], key: Callable[[TrackObservations], int]
) -> dict[int, tuple[TrackObservations, ...]]:
    groups: dict[int, list[TrackObservations]] = {}
    for part in rows:
        groups.setdefault(key(part), []).append(part)
    return {value: tuple(parts) for value, parts in groups.items()}
