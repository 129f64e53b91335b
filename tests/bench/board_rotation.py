"""Lags between cameras that saw a turning board, by its attitude alone: no poses, positions or calibration go in.

What camera a sees turn, b sees turn: R_a(t) = Q R_b(t + lag) with one constant rotation Q. Labels are the numbers of
the board's inner corners, row by row.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, RotationSpline

from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.session.observations import Observations

COLUMNS = 3
_LEAST_CORNERS, _LEAST_VIEWS = 8, 15
_INSIDE = 0.25  # s from the ends of the other's track: the lags looked for are smaller
_LARGEST_GAP = 0.3  # s between two views: nothing is interpolated across a longer one
_SCALE = 1.5 / 200.0  # rad: width of the robust loss


def attitudes(observations: Observations, camera: str, lens: Intrinsics) -> tuple[Floats, Rotation]:
    """Times (n,) and the board's rotations (n) in camera axes, where enough corners were seen."""
    frames: dict[int, dict[int, Floats]] = {}
    times: dict[int, float] = {}
    for track in observations.of_camera(camera):
        for frame, time, pixel in zip(track.frame, track.time, track.pixels, strict=True):
            frames.setdefault(int(frame), {})[int(track.label)] = pixel
            times[int(frame)] = float(time)
    seen, turns = [], []
    for frame in sorted(frames):
        corners = sorted(frames[frame])
        if len(corners) < _LEAST_CORNERS:
            continue
        board = np.array([[k % COLUMNS, k // COLUMNS, 0.0] for k in corners])
        pixels = np.array([frames[frame][k] for k in corners])
        _, turn, place, _ = cv2.solvePnPGeneric(board, pixels, lens.matrix, lens.distortions, flags=cv2.SOLVEPNP_IPPE)
        fine, _ = cv2.solvePnPRefineLM(board, pixels, lens.matrix, lens.distortions, turn[0], place[0])
        seen.append(times[frame])
        turns.append(np.asarray(fine).ravel())
    return np.array(seen), Rotation.from_rotvec(np.array(turns).reshape(-1, 3))


def lag(a: tuple[Floats, Rotation], b: tuple[Floats, Rotation]) -> tuple[float, float] | None:
    """``t_b - t_a`` of one instant [s] and its std; None where the board was hardly seen by both."""
    (time_a, turn_a), (time_b, turn_b) = a, b
    after = np.clip(np.searchsorted(time_b, time_a), 1, len(time_b) - 1)
    use = (time_a > time_b[0] + _INSIDE) & (time_a < time_b[-1] - _INSIDE)
    use &= time_b[after] - time_b[after - 1] < _LARGEST_GAP
    if use.sum() < _LEAST_VIEWS:
        return None
    path, time, turn = RotationSpline(time_b, turn_b), time_a[use], turn_a[use]

    def residual(x: Floats) -> Floats:
        off = Rotation.from_rotvec(x[1:]) * path(time + x[0]) * turn.inv()
        return np.asarray(off.as_rotvec().ravel())

    start = np.r_[0.0, (turn * path(time).inv()).mean().as_rotvec()]
    fit = least_squares(residual, start, loss="soft_l1", f_scale=_SCALE)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * 2.0 * fit.cost / (3 * len(time) - 4)
    return float(fit.x[0]), float(np.sqrt(covariance[0, 0]))
