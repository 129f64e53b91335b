"""Simulation of the asynchronous calibration paper, section 3.1: two cameras, a marker on four trajectories, a lag.

Eq. (23) fixes the convention: it reproduces only with phi and theta swapped against the text,
``X_cam = Rz(phi) Ry(theta) X + d e_x``, optical axis = camera x, u = 700 y/x, v = 700 z/x, origin of the pixels
at the image's centre. Lengths are in the paper's unit (cm), times in seconds, distances in pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hub.baselines.alternating_lag import estimate_alternately
from hub.two_view.relative_pose import epipolar_lines, line_distances, maximum_likelihood_fundamental
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.types import Floats

Trajectory: TypeAlias = Callable[[Floats], Floats]
"""Marker positions (n, 3) [cm] at times (n,) [s]."""

FOCAL, PERIOD, DURATION = 700.0, 1.0 / 30.0, 11.0
CAMERA_1, CAMERA_2 = (30.0, 40.0, 600.0), (60.0, 20.0, 700.0)
PRINTED_F = np.array(
    [[0.000166, 0.000069, 0.205062], [-0.000439, -0.000299, -0.617640], [-0.414374, 0.636211, 0.000007]]
)
"""Eq. (23)."""
LAGS: tuple[float, ...] = tuple(round(0.01 * k, 2) for k in range(1, 40))
"""The paper's sweep: 0.01 to 0.39 s by 0.01 s."""
MAX_LAG_ERROR, MAX_F_ERROR = 5e-3, 2.0
"""Errors of the lag [s] and of F [px] up to which a result is correct; failures are far beyond both."""


def project(camera: tuple[float, float, float], points: Floats) -> Floats:
    """Pixels (n, 2), origin at the image's centre, of world points (n, 3) [cm]. camera: phi, theta [deg], d [cm]."""
    phi, theta, distance = camera
    turn = so3.exp(np.array([0.0, 0.0, np.radians(phi)])) @ so3.exp(np.array([0.0, np.radians(theta), 0.0]))
    local = points @ turn.T + np.array([distance, 0.0, 0.0])
    return np.asarray(FOCAL * local[:, 1:] / local[:, :1])


def trajectory_1(time: Floats) -> Floats:
    """Eq. (24)."""
    envelope = np.sin(np.pi / 11.0 * time)
    y = 120.0 * np.sin(np.pi * time) * envelope
    return np.column_stack([10.0 * (time - 5.5), y, 100.0 * np.cos(1.5 * np.pi * time) * envelope])


def trajectory_a(time: Floats) -> Floats:
    """(a) of section 3.1.2: uniform rotation, y and z at one frequency."""
    envelope = np.sin(np.pi / 11.0 * time)
    y = 140.0 * np.sin(np.pi * time) * envelope
    return np.column_stack([18.0 * (time - 5.5), y, 100.0 * np.cos(np.pi * time) * envelope])


def trajectory_b(time: Floats) -> Floats:
    """(b) of section 3.1.2: close to a plane, y within ±20 cm."""
    envelope = np.sin(np.pi / 11.0 * time)
    y = 20.0 * np.sin(np.pi * time) * envelope
    return np.column_stack([18.0 * (time - 5.5), y, 100.0 * np.cos(1.5 * np.pi * time) * envelope])


def trajectory_c(time: Floats) -> Floats:
    """(c) of section 3.1.2: isotropic, and several times as fast."""
    turn = np.cos(3.9 * time)
    return 120.0 * np.column_stack(
        [np.sin(3.9 * time), turn * np.sin(3.1 * time), turn * np.cos(3.1 * time) * np.cos(4.7 * time)]
    )


TRAJECTORIES: dict[str, Trajectory] = {"1": trajectory_1, "a": trajectory_a, "b": trajectory_b, "c": trajectory_c}
"""By the paper's names; "1" is eq. (24)."""


@dataclass(frozen=True, slots=True, eq=False)
class Filmed:
    """Tracks of the two cameras. time: (n,) of the frames on either clock [s]; a, b: (n, 2) [px].

    Camera 2's frame of time t shows the marker at t + tau.
    """

    tau: float
    time: Floats
    a: Floats
    b: Floats


def film(trajectory: Trajectory, tau: float, noise: float = 0.0, seed: int = 0) -> Filmed:
    """Both tracks at 30 fps for 11 s, camera 2 late by ``tau`` [s], with Gaussian noise [px] by lag and seed."""
    time = np.arange(0.0, DURATION, PERIOD)
    a, b = project(CAMERA_1, trajectory(time)), project(CAMERA_2, trajectory(time + tau))
    rng = np.random.default_rng([23, round(1e3 * abs(tau)), seed])
    return Filmed(tau, time, a + noise * rng.standard_normal(a.shape), b + noise * rng.standard_normal(b.shape))


def evaluation_points(seed: int = 0) -> Floats:
    """281 points (n, 3) uniform in the cube of ±120 cm."""
    return np.random.default_rng(seed).uniform(-120.0, 120.0, (281, 3))


def evaluation_error(fundamental: Floats) -> float:
    """Mean distance of the evaluation points in image 2 from the lines of those in image 1 [px]."""
    points = evaluation_points()
    lines = epipolar_lines(fundamental, project(CAMERA_1, points))
    return float(np.abs(line_distances(lines, project(CAMERA_2, points))).mean())


def printed_fundamental() -> Floats:
    """F from the evaluation points, with eq. (23)'s sign."""
    points = evaluation_points()
    matrix = maximum_likelihood_fundamental(project(CAMERA_1, points), project(CAMERA_2, points))
    return np.asarray(matrix * np.sign(float((matrix * PRINTED_F).sum())))


@dataclass(frozen=True, slots=True)
class LagResult:
    """Result of a method at one lag.

    tau: the lag [s]. tau_error: found less true [s]. f_error: mean distance of the evaluation points [px].
    refused: the reason of a refusal, else "". distances: E(n) [px], n = 0 on (eq. 21), and
    tau_errors: of every iteration [s]; both empty for a method without iterations.
    """

    tau: float
    tau_error: float
    f_error: float
    refused: str = ""
    distances: tuple[float, ...] = ()
    tau_errors: tuple[float, ...] = ()

    @property
    def right(self) -> bool:
        """Whether the method gave a result, and a correct one."""
        return not self.refused and abs(self.tau_error) < MAX_LAG_ERROR and self.f_error < MAX_F_ERROR

    @property
    def converged_at(self) -> int | None:
        """The iteration n from which the lag stays within a tenth of a frame of the truth; None for never."""
        outside = [n for n, error in enumerate(self.tau_errors) if not abs(error) < 0.1 * PERIOD]
        first = outside[-1] + 1 if outside else 0
        return first if first < len(self.tau_errors) else None


Method: TypeAlias = Callable[[Filmed], LagResult]


def paper_method(filmed: Filmed) -> LagResult:
    """The alternating method (hub/baselines/alternating_lag.py) on frame indices."""
    try:
        found = estimate_alternately(filmed.a, filmed.b)
    except Refused as refusal:
        return LagResult(filmed.tau, float("nan"), float("nan"), str(refusal))
    # Camera 2's index runs tau / period behind: f = -tau / period.
    errors = tuple(-one.lag * PERIOD - filmed.tau for one in found.iterations)
    distances = tuple(one.distance for one in found.iterations)
    return LagResult(
        filmed.tau,
        -found.lag * PERIOD - filmed.tau,
        evaluation_error(found.fundamental),
        distances=distances,
        tau_errors=errors,
    )


def sweep(
    trajectory: Trajectory = trajectory_1,
    lags: Iterable[float] = LAGS,
    noise: float = 0.0,
    method: Method = paper_method,
) -> list[LagResult]:
    """One method on one trajectory at many lags [s], with noise [px]."""
    return [method(film(trajectory, tau, noise)) for tau in lags]


def bin_bias(lag_frames: float, noise: float = 0.5, seeds: int = 6) -> float:
    """Mean error of the paper's method [s] at one lag [frames] of trajectory 1 over several draws of noise [px].

    Eq. (18) takes the mean inside a fixed bin one frame wide. Values that noise moves across the bin's edge are left
    out, so that the estimate is biased towards the bin's middle.
    """
    tau = lag_frames * PERIOD
    return float(np.mean([paper_method(film(trajectory_1, tau, noise, seed)).tau_error for seed in range(seeds)]))


def first_failure(results: Iterable[LagResult]) -> float:
    """The smallest lag [s] without a correct result; infinity for none."""
    return min((result.tau for result in results if not result.right), default=float("inf"))
