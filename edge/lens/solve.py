"""Intrinsic calibration from views of a board: pinhole or fisheye through OpenCV, its uncertainty, acceptance tests.

The estimate is accepted only where the views could reveal an error: they must cover the image, the board must be tilted
(otherwise focal length and distance are not separable, which shows in the focal length's std), the corners must fit.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from edge.lens.board import BoardView
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Ints

COVERAGE_GRID = (8, 6)
"""Columns and rows of the grid over the image on which coverage is counted."""
MIN_VIEWS = 8
"""From so many views on a lens counts as measured; fewer give one with a wide std, if they fix it at all."""
_LEAST_VIEWS, _FEW_FOCAL_STD = 3, 0.05  # of which a focal length follows at all; relative, for few views
_MAX_VIEWS = 40  # bounds the solution's time
_MIN_COVERAGE = 0.5  # of the image's cells: distortion is extrapolated beyond
_MAX_RMS = 1.0  # px, at a width of up to 1280
_MAX_FOCAL_STD = 0.004  # relative
_PRINCIPAL_POINT_STD = 0.012  # of the larger image side, of usual cameras about the middle
_FEW_FLAGS = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_OUTLIER_RATIO = 2.5  # times the median view's rms
_RIDGE = 1e-12  # relative, of normal equations: of what no view determines a std follows that is refused


@dataclass(frozen=True, slots=True, eq=False)
class LensCalibration:
    """Calibrated intrinsics and their quality.

    rms_px: root mean square reprojection error of the corners. focal_std: relative std of the focal length. views:
    number used. cells: (6, 8) number of corners per grid cell. coverage: fraction of cells with any.
    """

    intrinsics: Intrinsics
    rms_px: float
    focal_std: float
    views: int
    cells: Ints
    coverage: float


def calibrate_lens(views: list[BoardView], size: tuple[int, int], fisheye: bool = False) -> LensCalibration:
    """Estimate the intrinsics from the views. size: (width, height) [px].

    Raises Refused where the views are too few, too similar or do not fit, with advice on what to record instead.
    """
    if not views:
        raise Refused("the board is in no frame: check its kind, squares and dictionary, and that it is sharp and lit")
    few = len(views) < MIN_VIEWS
    if len(views) < _LEAST_VIEWS:
        raise Refused(f"the board is seen in {len(views)} different views, {MIN_VIEWS} are needed: film it longer")
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MAX_VIEWS)).round().astype(int))
    accepted = [views[i] for i in chosen]
    cells = _corner_counts(accepted, size)
    coverage = float((cells > 0).mean())
    if coverage < _MIN_COVERAGE and not few:
        empty = _uncovered_sides(cells)
        raise Refused(
            f"the board covers {100 * coverage:.0f} % of the picture, {100 * _MIN_COVERAGE:.0f} % are needed: "
            f"move it into {empty} too"
        )
    try:
        fit = _calibrate(accepted, size, fisheye, few)
        outlier = fit[2] > _OUTLIER_RATIO * float(np.median(fit[2]))
        if outlier.any() and (~outlier).sum() >= MIN_VIEWS:  # blurred, or with mismatched corners
            accepted = [view for view, out in zip(accepted, outlier, strict=True) if not out]
            fit = _calibrate(accepted, size, fisheye, few)
    except (cv2.error, np.linalg.LinAlgError) as error:
        reason = " ".join(str(getattr(error, "err", error)).split())
        raise Refused(f"no camera model fits these views ({reason}): tilt the board in different directions") from None
    intrinsics, std, view_rms = fit
    rms = float(np.sqrt(np.mean(view_rms**2)))
    limit = _MAX_RMS * max(1.0, size[0] / 1280)
    if not np.isfinite(rms) or rms > limit:
        other = "without" if fisheye else "with"
        raise Refused(
            f"the reprojection error is {rms:.2f} px, {limit:.2f} px are allowed: is the board flat, are its "
            f"squares the ones given, is the picture sharp and the zoom fixed? Or try {other} --fisheye"
        )
    limit_std = _FEW_FOCAL_STD if few else _MAX_FOCAL_STD
    if not std < limit_std:
        raise Refused(
            f"the focal length is known only to {100 * std:.2g} % (std), {100 * limit_std:.1f} % are needed: "
            "tilt the board by 20 to 45 degrees in different directions, near and far"
        )
    return LensCalibration(intrinsics, rms, std, len(accepted), _corner_counts(accepted, size), coverage)


def intrinsics_from_field_of_view(size: tuple[int, int], degrees: float, fisheye: bool) -> Intrinsics:
    """Intrinsics without distortion for a horizontal field of view [degrees]: a first guess without a board."""
    half = np.deg2rad(0.5 * degrees)
    focal = 0.5 * size[0] / (half if fisheye else np.tan(half))
    matrix = np.array([[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
    return Intrinsics(size[0], size[1], matrix, np.zeros(4 if fisheye else 5), fisheye)


def coverage_map(cells: Ints) -> list[str]:
    """The corner counts as a text grid; a dot = none."""
    return ["".join(f"{value:5d}" if value else "    ." for value in row) for row in cells.tolist()]


def _calibrate(
    views: list[BoardView], size: tuple[int, int], fisheye: bool, few: bool
) -> tuple[Intrinsics, float, Floats]:
    """The intrinsics, the relative std of the focal length, and the rms [px] of each view."""
    return _fisheye(views, size) if fisheye else _pinhole(views, size, few)


def _pinhole(views: list[BoardView], size: tuple[int, int], few: bool) -> tuple[Intrinsics, float, Floats]:
    """few: only what a few views determine is estimated, focal length, k1 and k2; the rest as of usual lenses."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    start = intrinsics_from_field_of_view(size, 65.0, False).matrix
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | (_FEW_FLAGS if few else 0)
    _, *fit = cv2.calibrateCamera(points, pixels, size, start, np.zeros(5), flags=flags)
    return _with_quality(views, size, fit, False, few)


def _fisheye(views: list[BoardView], size: tuple[int, int]) -> tuple[Intrinsics, float, Floats]:
    """From two fields of view to start from, of which OpenCV needs one near the lens's: 120 ends at 140, 180 begins."""
    points = [view.points[None] for view in views]
    pixels = [view.pixels[None] for view in views]
    # OpenCV 4 keeps these flags in cv2.fisheye, with other values than OpenCV 5's.
    place: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
    flags = place.CALIB_RECOMPUTE_EXTRINSIC | place.CALIB_FIX_SKEW | place.CALIB_USE_INTRINSIC_GUESS
    fits: list[Any] = []
    for degrees in (120.0, 180.0):
        start = intrinsics_from_field_of_view(size, degrees, True).matrix
        with suppress(cv2.error):  # an assertion, where a view has no pose
            fits.append(cv2.fisheye.calibrate(points, pixels, size, start, np.zeros((4, 1)), flags=flags))
    if not fits:
        raise Refused("no fisheye fits these views: tilt the board in different directions")
    _, *fit = min(fits, key=lambda fit: float(np.nan_to_num(fit[0], nan=np.inf)))
    return _with_quality(views, size, fit, True, False)


def _with_quality(
    views: list[BoardView], size: tuple[int, int], fit: list[Any], fisheye: bool, few: bool
) -> tuple[Intrinsics, float, Floats]:
    """The lens, the relative std of its focal length, the rms [px] of each view. fit: matrix, distortions, poses.

    From the normal equations with each view's pose eliminated. OpenCV's own stds are of a pseudo-inverse: a focal
    length that no view determines, all of them face on, has next to none there. few: what the estimate owes to the
    principal point that it took for granted (consider covariance).
    """
    matrix, distortions = np.array(fit[0], dtype=np.float64), np.array(fit[1], dtype=np.float64).ravel()
    lens = Intrinsics(*size, matrix, distortions[: 4 if fisheye else 5], fisheye)
    count = 4 + len(lens.distortions)
    information, residuals = np.zeros((count, count)), []
    for view, rotation, translation in zip(views, *fit[2:], strict=True):
        at = np.ravel(rotation), np.ravel(translation), lens.matrix, lens.distortions
        if fisheye:
            seen, jacobian = cv2.fisheye.projectPoints(view.points[None], *at)
            a, b = jacobian[:, :8], jacobian[:, 8:14]  # intrinsics; the view's pose
        else:
            seen, jacobian = cv2.projectPoints(view.points, *at)
            a, b = jacobian[:, 6:15], jacobian[:, :6]
        information += a.T @ a - a.T @ b @ np.linalg.pinv(b) @ a
        residuals.append(np.ravel(seen) - view.pixels.ravel())
    every = np.concatenate(residuals)
    # The columns of what is estimated, and of what was held at a value with a std.
    unit = np.eye(count)
    free = np.column_stack([unit[0] + unit[1], unit[4], unit[5]]) if few else unit
    held = unit[:, 2:4] * (_PRINCIPAL_POINT_STD * max(size) if few else 0.0)
    normal = free.T @ information @ free
    scale = np.sqrt(np.maximum(normal.diagonal(), 1e-12))
    inverse = np.linalg.inv(normal / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))) / np.outer(scale, scale)
    freedom = max(len(every) - len(scale) - 6 * len(views), 1)
    variance = every @ every / freedom * inverse.diagonal()
    variance += np.square(inverse @ free.T @ information @ held).sum(axis=1)
    view_rms = np.array([np.sqrt(2.0 * np.mean(one**2)) for one in residuals])
    return lens, float(np.sqrt(variance[: 1 if few else 2].max())) / lens.focal, view_rms


def _corner_counts(views: list[BoardView], size: tuple[int, int]) -> Ints:
    pixels = np.concatenate([view.pixels for view in views])
    across = np.clip((pixels[:, 0] + 0.5) / size[0] * COVERAGE_GRID[0], 0, COVERAGE_GRID[0] - 1).astype(np.int64)
    down = np.clip((pixels[:, 1] + 0.5) / size[1] * COVERAGE_GRID[1], 0, COVERAGE_GRID[1] - 1).astype(np.int64)
    columns, rows = COVERAGE_GRID
    return np.bincount(down * columns + across, minlength=columns * rows).reshape(rows, columns)


def _uncovered_sides(cells: Ints) -> str:
    """The sides of the image with the fewest covered cells, in words."""
    rows, columns = COVERAGE_GRID[1] // 3, COVERAGE_GRID[0] // 3
    sides = {
        "the left": cells[:, :columns],
        "the right": cells[:, -columns:],
        "the top": cells[:rows],
        "the bottom": cells[-rows:],
    }
    shares = {name: float((part > 0).mean()) for name, part in sides.items()}
    least = min(shares.values())
    return " and ".join(name for name, share in shares.items() if share <= least + 0.1)
