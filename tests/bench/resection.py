"""Resection of one camera from a surveyed path: reference values of its clock and pose without any other camera.

Errors of detectors and lenses are correlated over seconds, so the effective sample size is smaller than the number of
frames, and a fit that assumes independence biases the clock. Here the errors of each image axis are white noise plus a
first-order Gauss-Markov process, whose three parameters are estimated by maximum likelihood. The process has a
tridiagonal inverse covariance, which makes the generalised least squares linear in the number of rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import least_squares, minimize

from protocols.core.clocks import TimeMap
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats

_MIN_ROWS = 30
_MARGIN = 2.0  # of the truth before the first row and after the last [s], as the time map still changes
_OUTLIER_SIGMA = 5.0  # robust stds
_MEDIAN_NORM = 1.1774  # of two unit normals
_ROUNDS, _STEPS = 40, 8
_CONVERGED = 0.1  # parameter change of a converged round [stds]
# rotation [rad] and translation [truth's unit] of the world, time [s], rate [1e-3], focal length [%]
_DIFFERENCES = np.array([1e-6] * 3 + [1e-4] * 3 + [1e-4, 1e-3, 1e-3])
_TIME = 6


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Noise of one image axis: white_px [px], and Gauss-Markov with correlated_px [px] and ``time_constant`` [s]."""

    white_px: float
    correlated_px: float
    time_constant: float


_FIRST_MODEL = ErrorModel(0.45, 1.0, 1.0)
_SMALLEST, _LARGEST = ErrorModel(0.1, 0.1, 0.1), ErrorModel(10.0, 30.0, 60.0)


@dataclass(frozen=True, slots=True, eq=False)
class Resection:
    """Resection of one camera from the true path.

    time_map: truth's clock from the camera's; time_std: its std [s] at the median of the camera's times.
    pose: in the truth's frame and unit. focal_scale: by which the lens's focal length is multiplied.
    median_px: median residual [px] of all rows. errors: noise model of the residuals.
    """

    time_map: TimeMap
    time_std: float
    pose: Pose
    focal_scale: float
    median_px: float
    errors: ErrorModel


def resect(
    lens: Intrinsics, time: Floats, pixels: Floats, start: TimeMap, truth_time: Floats, truth: Floats
) -> Resection:
    """Pose, focal length and time map of one camera from the true path, with correlated errors.

    time: (n,) camera times [s]; pixels: (n, 2); start: initial map from camera time to truth time, accurate to about
    half a second; truth_time, truth: (m,) sorted [s], (m, 3). Nothing else of the estimate under evaluation is used.
    Raises ValueError where too few rows lie within the truth, no pose fits, or the fit does not converge.
    """
    seen = start.clock_rate * time + start.time_offset
    rows = np.argsort(time)
    rows = rows[(seen[rows] > truth_time[0] + _MARGIN) & (seen[rows] < truth_time[-1] - _MARGIN)]
    if len(rows) < _MIN_ROWS:
        raise ValueError(f"only {len(rows)} rows lie within the truth")
    view = _View(lens, CubicSpline(truth_time, truth), start, float(np.median(time)), time[rows], pixels[rows])
    parameters, std, model = _fit_alternately(view, _independent(view))
    turn = so3.exp(parameters[:3])
    return Resection(
        view.time_map(parameters),
        float(std[_TIME]),
        Pose(turn, np.asarray(-turn.T @ parameters[3:6])),
        1.0 + 0.01 * float(parameters[8]),
        float(np.median(np.linalg.norm(view.residual(parameters), axis=1))),
        model,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Observations of the path by one camera: time (n,) sorted [s], pixels (n, 2); middle: a camera time [s].

    Nine parameters: rotation vector and translation (camera from world), time at the middle [s] and rate [1e-3]
    relative to the start, focal length [%].
    """

    lens: Intrinsics
    path: CubicSpline
    start: TimeMap
    middle: float
    time: Floats
    pixels: Floats

    def time_map(self, parameters: Floats) -> TimeMap:
        rate = self.start.clock_rate + 1e-3 * float(parameters[7])
        at_middle = self.start.clock_rate * self.middle + self.start.time_offset + float(parameters[_TIME])
        return TimeMap(rate, at_middle - rate * self.middle)

    def residual(self, parameters: Floats) -> Floats:
        """Predicted minus observed (n, 2) [px]."""
        clock = self.time_map(parameters)
        points = self.path(clock.clock_rate * self.time + clock.time_offset)
        points = points @ so3.exp(parameters[:3]).T + parameters[3:6]
        points[:, 2] = np.maximum(points[:, 2], 1e-3)
        matrix = self.lens.matrix.copy()
        matrix[:2, :2] *= 1.0 + 0.01 * parameters[8]
        return np.asarray(replace(self.lens, matrix=matrix).project(points) - self.pixels)

    def derivatives(self, parameters: Floats) -> Floats:
        """Jacobian (n, 2, 9) of the residual by the parameters, by central differences."""
        columns = [
            (self.residual(parameters + step) - self.residual(parameters - step)) / (2 * step.sum())
            for step in np.diag(_DIFFERENCES)
        ]
        return np.stack(columns, axis=2)

    def only(self, keep: Bools) -> _View:
        return replace(self, time=self.time[keep], pixels=self.pixels[keep])


def _independent(view: _View) -> Floats:
    """Robust initial parameters (9,) by PnP RANSAC and least squares with independent errors."""
    points = view.path(view.start.clock_rate * view.time + view.start.time_offset)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points, view.pixels, view.lens.matrix, view.lens.distortions, reprojectionError=12.0, iterationsCount=500
    )
    if not found:
        raise ValueError("no pose fits the truth")

    def residual(parameters: Floats) -> Floats:
        return view.residual(parameters).ravel()

    first = np.r_[rotation.ravel(), translation.ravel(), 0.0, 0.0, 0.0]
    fit = least_squares(residual, first, loss="soft_l1", f_scale=5.0, x_scale="jac", max_nfev=60)
    fit = least_squares(residual, fit.x, loss="soft_l1", f_scale=1.0, x_scale="jac", max_nfev=100)
    return np.asarray(fit.x)


def _fit_alternately(view: _View, parameters: Floats) -> tuple[Floats, Floats, ErrorModel]:
    """Parameters (9,), their stds (9,) and the error model, estimated alternately."""
    model = _FIRST_MODEL
    for _ in range(_ROUNDS):
        residual = view.residual(parameters)
        norms = np.linalg.norm(residual, axis=1)
        keep = norms < _OUTLIER_SIGMA * float(np.median(norms)) / _MEDIAN_NORM
        kept = view.only(keep)
        model = _maximum_likelihood(kept.time, residual[keep], model)
        precision = _Precision(model, kept.time)
        before = parameters
        for _ in range(_STEPS):
            derivatives = kept.derivatives(parameters)
            weighted = precision.times(derivatives.reshape(len(kept.time), -1)).reshape(derivatives.shape)
            normal = np.einsum("nai,naj->ij", weighted, derivatives)
            step = -np.linalg.solve(normal, np.einsum("nai,na->i", weighted, kept.residual(parameters)))
            parameters = parameters + step
            if step @ normal @ step < (0.1 * _CONVERGED) ** 2:
                break
        moved = parameters - before
        if moved @ normal @ moved < _CONVERGED**2:
            return parameters, np.sqrt(np.diag(np.linalg.inv(normal))), model
    raise ValueError("the fit to the truth does not converge")


def _maximum_likelihood(time: Floats, residual: Floats, start: ErrorModel) -> ErrorModel:
    """Maximum-likelihood noise model of residuals (n, 2) [px] at sorted times (n,), the same for both axes."""
    low, high = _logs(_SMALLEST), _logs(_LARGEST)

    def model(logs: Floats) -> ErrorModel:
        return ErrorModel(*(float(value) for value in np.exp(np.clip(logs, low, high))))

    def cost(logs: Floats) -> float:
        precision = _Precision(model(logs), time)
        return precision.log_determinant + 0.5 * float(np.sum(residual * precision.times(residual)))

    simplex = _logs(start) + np.vstack([np.zeros(3), np.diag([0.5, 0.5, 1.0])])
    options: Any = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 0.1, "maxiter": 200}
    return model(np.asarray(minimize(cost, simplex[0], method="Nelder-Mead", options=options).x))


def _logs(model: ErrorModel) -> Floats:
    return np.log([model.white_px, model.correlated_px, model.time_constant])


class _Precision:
    """Inverse covariance (n, n) of one axis's errors at sorted times (n,), and the covariance's log determinant.

    With K the correlated part's covariance and w white variance: inv(w I + K) = (I - inv(w inv(K) + I)) / w.
    """

    def __init__(self, model: ErrorModel, time: Floats) -> None:
        white, correlated = model.white_px**2, model.correlated_px**2
        correlation = np.exp(-np.diff(time) / model.time_constant)
        innovation = np.maximum(correlated * (1.0 - correlation**2), 1e-12)  # rows at one time must not divide by 0
        band = np.zeros((2, len(time)))
        band[0, 1:] = -correlation / innovation
        band[1] = 1.0 / white
        band[1, 0] += 1.0 / correlated
        band[1, :-1] += correlation**2 / innovation
        band[1, 1:] += 1.0 / innovation
        self._white = white
        self._root = cholesky_banded(band)
        self.log_determinant = float(
            len(time) * np.log(white)
            + np.log(correlated)
            + np.log(innovation).sum()
            + 2.0 * np.log(self._root[1]).sum()
        )

    def times(self, values: Floats) -> Floats:
        """The inverse covariance times values (n, k)."""
        return np.asarray((values - cho_solve_banded((self._root, False), values / self._white)) / self._white)
