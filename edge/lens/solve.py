"""A lens from views of a board: pinhole or fisheye through OpenCV, its uncertainty, and reasons to refuse.

The estimate is trusted only where the views would show that it is wrong: they must cover the picture, the board
must be tilted (else focal length and distance look alike, which the focal length's std tells), the corners must fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from edge.lens.board import View
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Ints

CELLS = (8, 6)
"""Into how many columns and rows the picture is divided to see what is covered."""
LEAST_VIEWS = 8
_MOST_VIEWS = 40
_LEAST_COVERAGE = 0.5
_LARGEST_RMS = 1.0  # px, at a width of up to 1280
_LARGEST_FOCAL_STD = 0.004  # relative
_OUTLYING = 2.5  # times the median view's rms


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens and what it is worth.

    rms_px: root mean square distance of corners. focal_std: relative std of the focal length. views: that were used.
    cells: (6, 8) corners a cell of the picture. coverage: share of cells with any.
    """

    lens: Intrinsics
    rms_px: float
    focal_std: float
    views: int
    cells: Ints
    coverage: float


def solve_lens(views: list[View], size: tuple[int, int], fisheye: bool = False) -> LensFit:
    """The lens that explains the views. size: (width, height) [px].

    Raises Refused where the views are too few, too alike or do not fit, with what to film instead.
    """
    if not views:
        raise Refused("the board is in no frame: check its kind, squares and dictionary, and that it is sharp and lit")
    if len(views) < LEAST_VIEWS:
        raise Refused(f"the board is seen in {len(views)} different views, {LEAST_VIEWS} are needed: film it longer")
    pick = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MOST_VIEWS)).round().astype(int))
    used = [views[i] for i in pick]
    cells = _cells(used, size)
    coverage = float((cells > 0).mean())
    if coverage < _LEAST_COVERAGE:
        empty = _where_empty(cells)
        raise Refused(
            f"the board covers {100 * coverage:.0f} % of the picture, {100 * _LEAST_COVERAGE:.0f} % are needed: "
            f"move it into {empty} too"
        )
    try:
        fit = _solve(used, size, fisheye)
        bad = fit[2] > _OUTLYING * float(np.median(fit[2]))
        if bad.any() and (~bad).sum() >= LEAST_VIEWS:  # blurred, or a corner taken for another
            used = [view for view, out in zip(used, bad, strict=True) if not out]
            fit = _solve(used, size, fisheye)
    except cv2.error as error:
        told = " ".join(str(error.err).split())
        raise Refused(f"no lens explains these views ({told}): tilt the board in different directions") from None
    lens, std, per_view = fit
    rms = float(np.sqrt(np.mean(per_view**2)))
    limit = _LARGEST_RMS * max(1.0, size[0] / 1280)
    if not np.isfinite(rms) or rms > limit:
        other = "without" if fisheye else "with"
        raise Refused(
            f"the corners miss the best lens by {rms:.2f} px, {limit:.2f} px are allowed: is the board flat, are its "
            f"squares the ones given, is the picture sharp and the zoom fixed? Or try {other} --fisheye"
        )
    if not std < _LARGEST_FOCAL_STD:
        raise Refused(
            f"the focal length is known only to {100 * std:.2g} % (std), {100 * _LARGEST_FOCAL_STD:.1f} % are needed: "
            "tilt the board by 20 to 45 degrees in different directions, near and far"
        )
    return LensFit(lens, rms, std, len(used), _cells(used, size), coverage)


def lens_from_angle(size: tuple[int, int], degrees: float, fisheye: bool) -> Intrinsics:
    """The lens without distortion whose picture is ``degrees`` wide: a first guess where there is no board."""
    half = np.deg2rad(0.5 * degrees)
    focal = 0.5 * size[0] / (half if fisheye else np.tan(half))
    matrix = np.array([[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
    return Intrinsics(size[0], size[1], matrix, np.zeros(4 if fisheye else 5), fisheye)


def coverage_map(cells: Ints) -> list[str]:
    """The picture as a person sees it: how many corners each cell got; a dot = none."""
    return ["".join(f"{value:5d}" if value else "    ." for value in row) for row in cells.tolist()]


def _solve(views: list[View], size: tuple[int, int], fisheye: bool) -> tuple[Intrinsics, float, Floats]:
    """The lens, the relative std of its focal length, and the rms [px] of each view."""
    return _fisheye(views, size) if fisheye else _pinhole(views, size)


def _pinhole(views: list[View], size: tuple[int, int]) -> tuple[Intrinsics, float, Floats]:
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    start = lens_from_angle(size, 65.0, False).matrix
    _, matrix, distortions, _, _, stds, _, per_view = cv2.calibrateCameraExtended(
        points, pixels, size, start, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    found: Floats = np.asarray(matrix, dtype=np.float64)
    lens = Intrinsics(size[0], size[1], found, np.asarray(distortions, dtype=np.float64).ravel()[:5])
    std = float(np.asarray(stds).ravel()[:2].max() / lens.focal)
    return lens, std, np.asarray(per_view, dtype=np.float64).ravel()


def _fisheye(views: list[View], size: tuple[int, int]) -> tuple[Intrinsics, float, Floats]:
    points = [view.points[None] for view in views]
    pixels = [view.pixels[None] for view in views]
    start = lens_from_angle(size, 120.0, True).matrix
    # OpenCV 4 keeps these flags in cv2.fisheye, with other values than OpenCV 5's.
    place: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
    flags = place.CALIB_RECOMPUTE_EXTRINSIC | place.CALIB_FIX_SKEW | place.CALIB_USE_INTRINSIC_GUESS
    _, matrix, distortions, turns, shifts = cv2.fisheye.calibrate(
        points, pixels, size, start, np.zeros((4, 1)), flags=flags
    )
    found: Floats = np.asarray(matrix, dtype=np.float64)
    distortions = np.asarray(distortions, dtype=np.float64).ravel()
    # OpenCV tells no std here: the normal equations, each view's own pose eliminated, do.
    information = np.zeros((8, 8))
    square, per_view = 0.0, []
    for view, turn, shift in zip(views, turns, shifts, strict=True):
        seen, jacobian = cv2.fisheye.projectPoints(
            view.points[None], np.asarray(turn), np.asarray(shift), found, distortions
        )
        residual = np.asarray(seen).reshape(-1, 2) - view.pixels
        lens, pose = np.asarray(jacobian)[:, :8], np.asarray(jacobian)[:, 8:14]
        information += lens.T @ lens - lens.T @ pose @ np.linalg.solve(pose.T @ pose, pose.T @ lens)
        per_view.append(float(np.sqrt((residual**2).sum(axis=1).mean())))
        square += float((residual**2).sum())
    left = 2 * sum(len(view.points) for view in views) - 8 - 6 * len(views)
    covariance = np.linalg.pinv(information) * square / max(left, 1)
    lens_found = Intrinsics(size[0], size[1], found, distortions, True)
    std = float(np.sqrt(np.diag(covariance)[:2].max())) / lens_found.focal
    return lens_found, std, np.array(per_view)


def _cells(views: list[View], size: tuple[int, int]) -> Ints:
    pixels = np.concatenate([view.pixels for view in views])
    across = np.clip((pixels[:, 0] + 0.5) / size[0] * CELLS[0], 0, CELLS[0] - 1).astype(np.int64)
    down = np.clip((pixels[:, 1] + 0.5) / size[1] * CELLS[1], 0, CELLS[1] - 1).astype(np.int64)
    return np.bincount(down * CELLS[0] + across, minlength=CELLS[0] * CELLS[1]).reshape(CELLS[1], CELLS[0])


def _where_empty(cells: Ints) -> str:
    """The sides of the picture with the fewest covered cells, in words."""
    rows, columns = CELLS[1] // 3, CELLS[0] // 3
    sides = {
        "the left": cells[:, :columns],
        "the right": cells[:, -columns:],
        "the top": cells[:rows],
        "the bottom": cells[-rows:],
    }
    shares = {name: float((part > 0).mean()) for name, part in sides.items()}
    least = min(shares.values())
    return " and ".join(name for name, share in shares.items() if share <= least + 0.1)
