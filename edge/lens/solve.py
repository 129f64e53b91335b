"""Intrinsic calibration from views of a board: pinhole or fisheye through OpenCV, its uncertainty, acceptance tests.

The estimate is accepted only where the views could reveal an error: they must cover the image, the board must be tilted
(otherwise focal length and distance are not separable, which shows in the focal length's std), the corners must fit.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.special import chdtri, fdtri

from edge.lens.board import MIN_CORNERS, BoardView
from edge.lens.coverage import COVERAGE_GRID, corner_counts, uncovered_sides
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints

MIN_VIEWS = 8
"""From so many views on a lens counts as measured; fewer give one with a wide std, if they fix it at all."""
_LEAST_VIEWS = 3  # of which a focal length follows at all
_FEW_FOCAL_STD = {False: 0.05, True: 0.02}
"""Relative, for few views, of a fisheye lens: views face on gave such focal lengths 35 % off at a std of 4 %."""
_NO_SHAPE = "no board, flat or bowed, fits these views: are its squares the ones given, is the zoom fixed?"
_CHECK_BOARD = "check its kind, squares (not the corners between them) and dictionary"
_MAX_VIEWS = 40  # bounds the solution's time
_MIN_COVERAGE = 0.5  # of the image's cells: distortion is extrapolated beyond
_MAX_RMS = 1.0  # px, at a width of up to 1280
_MAX_FOCAL_STD = 0.004  # relative
_PRINCIPAL_POINT_STD = 0.012  # of the larger image side, of usual cameras about the middle
_USUAL = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_WIDER = cv2.CALIB_FIX_K3, 0
"""What a few views leave as of usual lenses; and less, where these do not fit."""
_REACHES = (np.inf, 85.0, 75.0, 65.0)
"""Degrees from the middle of a picture, were it 180 wide, within which corners count: 85 are 90 of one of 190, 65 of
one of 250."""
_OUTLIER_RATIO = 2.5  # times the median view's rms
_SHAPE = 4  # parameters of a board's shape: of a quadratic surface, and the rows' distance over the columns', less 1
_BY_CHANCE = 1e-3  # share of true boards that are taken for misshapen, of usual lenses for others
_CONVERGED, _MAX_ROUNDS = 1e-6, 20
"""Share of the cost by which the last round of an adjustment of a board's shape lowers it, and the most rounds."""
_MAX_CHANGE, _CHANGED = 2.0 * _MAX_FOCAL_STD, 4.2
"""Change of the focal length between two views, of which half is an error as large as the std allowed, and the ratio to
its std from which it is one: by chance at any of 39 places in 0.1 % of the lenses."""
_RIDGE = 1e-12  # relative, of normal equations: of what no view determines a std follows that is refused


@dataclass(frozen=True, slots=True, eq=False)
class LensCalibration:
    """Calibrated intrinsics and their quality.

    rms_px: root mean square reprojection error of the corners. focal_std: relative std of the focal length. views:
    number used. cells: (6, 8) number of corners per grid cell. coverage: fraction of cells with any. bow: how far the
    board departs from a plane [squares], 0 = not measurably. stretch: by how much its squares are longer down than
    across, relative. border_std_px: std of a ray at the picture's border, where it is largest [px], infinite where the
    lens has none there. border_limit_px: above which the border is not measured: an rms as large would be refused.
    """

    intrinsics: Intrinsics
    rms_px: float
    focal_std: float
    border_std_px: float
    border_limit_px: float
    views: int
    cells: Ints
    coverage: float
    bow: float
    stretch: float


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A lens and the board's poses in it.

    parameters: fx, fy, cx, cy, the distortions, and the board's shape (`_by_shape`). poses:
    (views, 6) rotation vectors and translations [squares].
    """

    parameters: Floats
    poses: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """Residuals of a fit [px], and what parameters and poses change.

    information, gradient: of all parameters, with the poses eliminated. residuals, jacobians: of each view, by the
    parameters and by its pose.
    """

    information: Floats
    gradient: Floats
    residuals: list[Floats]
    jacobians: list[tuple[Floats, Floats]]

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(sum(one @ one for one in self.residuals))


def calibrate_lens(views: list[BoardView], size: tuple[int, int], fisheye: bool = False) -> LensCalibration:
    """Estimate the intrinsics from the views. size: (width, height) [px].

    Raises Refused where the views are too few, too similar or do not fit, with advice on what to record instead.
    """
    if not views:
        raise Refused(f"the board is in no frame: {_CHECK_BOARD}, and that it is sharp and lit")
    few = len(views) < MIN_VIEWS
    if len(views) < _LEAST_VIEWS:
        found = f"the board is seen in {len(views)} different views"
        need = f"{_LEAST_VIEWS} give an approximate lens, {MIN_VIEWS} a good one"
        raise Refused(f"{found}, {need}: film it longer, or {_CHECK_BOARD}")
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MAX_VIEWS)).round().astype(int))
    # About the board's middle: elsewhere the slope of a bow would be a stretch.
    corners = np.concatenate([view.points for view in views])
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    accepted = [replace(views[i], points=views[i].points - middle) for i in chosen]
    limit = _MAX_RMS * max(1.0, size[0] / 1280)
    accepted = _ahead(accepted, size, limit) if fisheye else accepted
    cells = corner_counts(accepted, size)
    coverage = float((cells > 0).mean())
    if coverage < _MIN_COVERAGE and not few:
        empty = uncovered_sides(cells)
        raise Refused(
            f"the board covers {100 * coverage:.0f} % of the picture, {100 * _MIN_COVERAGE:.0f} % are needed: "
            f"move it into {empty} too"
        )
    try:
        fit, at, free = _usual(accepted, size) if few and not fisheye else _with_board(accepted, size, fisheye, 0)
        view_rms = _view_rms(at)
        outlier = view_rms > _OUTLIER_RATIO * float(np.median(view_rms))
        if outlier.any() and (~outlier).sum() >= MIN_VIEWS:  # blurred, or with mismatched corners
            accepted = [view for view, out in zip(accepted, outlier, strict=True) if not out]
            fit, at, free = _with_board(accepted, size, fisheye, 0)
    except (cv2.error, np.linalg.LinAlgError) as error:
        reason = " ".join(str(getattr(error, "err", error)).split())
        raise Refused(f"no camera model fits these views ({reason}): tilt the board in different directions") from None
    rms = float(np.sqrt(np.mean(_view_rms(at) ** 2)))
    if not np.isfinite(rms) or rms > limit:
        other = "without" if fisheye else "with"
        raise Refused(
            f"the reprojection error is {rms:.2f} px, {limit:.2f} px are allowed: is the board flat, are its "
            f"squares the ones given, is the picture sharp and the zoom fixed? Or try {other} --fisheye"
        )
    std = _focal_std(fit, at, free, size)
    limit_std = _FEW_FOCAL_STD[fisheye] if few else _MAX_FOCAL_STD
    if not std < limit_std:
        raise Refused(
            f"the focal length is known only to {100 * std:.2g} % (std), {100 * limit_std:.1f} % are needed: "
            "tilt the board by 20 to 45 degrees in different directions, near and far"
        )
    change, change_std = _focal_change(fit, at, free)
    if not few and abs(change) > max(_MAX_CHANGE, _CHANGED * change_std):
        raise Refused(
            f"the focal length changes by {100 * change:+.1f} % ± {100 * change_std:.1f} % within these views: film "
            "with the zoom and the focus fixed, autofocus and stabilisation off"
        )
    points = np.concatenate([view.points for view in accepted])
    heights = (_by_shape(points) @ fit.parameters[-_SHAPE:])[:, 2]
    plane = np.column_stack([points[:, :2], np.ones(len(points))])
    bow = float(np.ptp(heights - plane @ np.linalg.lstsq(plane, heights)[0]))
    counts = corner_counts(accepted, size)
    stretch = float(fit.parameters[-1])
    lens, border = _lens(fit, size, fisheye), _border_std(_lens(fit, size, fisheye), at, free)
    return LensCalibration(lens, rms, std, border, limit, len(accepted), counts, coverage, bow, stretch)


def intrinsics_from_field_of_view(size: tuple[int, int], degrees: float, fisheye: bool) -> Intrinsics:
    """Intrinsics without distortion for a horizontal field of view [degrees]: a first guess without a board."""
    half = np.deg2rad(0.5 * degrees)
    focal = 0.5 * size[0] / (half if fisheye else np.tan(half))
    matrix = np.array([[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
    return Intrinsics(size[0], size[1], matrix, np.zeros(4 if fisheye else 5), fisheye)


def _usual(views: list[BoardView], size: tuple[int, int]) -> tuple[_Fit, _Linearised, Floats]:
    """The fit of few views with the fewest parameters that they do not refute (F test), as `_with_board` gives it.

    Of pixels that are 2 % wider than high focal lengths were 13 stds off.
    """
    best: tuple[_Fit, _Linearised, Floats] | None = None
    for fixed in (_USUAL, *_WIDER):
        with suppress(Refused, cv2.error, np.linalg.LinAlgError):  # of the wider ones
            now = _with_board(views, size, False, fixed)
            if best is None or _better(now, best):
                best = now
    if best is None:
        raise Refused(_NO_SHAPE)
    return best


def _better(now: tuple[_Fit, _Linearised, Floats], before: tuple[_Fit, _Linearised, Floats]) -> bool:
    """Whether a fit's further parameters, if any, lower the cost by more than they do by chance."""
    (_, at, free), more = now, now[2].shape[1] - before[2].shape[1]
    least = more * float(fdtri(more, _redundancy(at, free), 1.0 - _BY_CHANCE)) if more > 0 else 0.0
    return before[1].cost - at.cost > least * _noise(at, free)


def _with_board(
    views: list[BoardView], size: tuple[int, int], fisheye: bool, fixed: int
) -> tuple[_Fit, _Linearised, Floats]:
    """The fit, with the board's shape where the corners ask for one, its residuals, and the columns of the parameters
    that are estimated.

    A sheet that is bowed by a hundredth of its width made focal lengths 1.4 % wrong at a stated 0.15 %, one that was
    printed 2 % too wide 1.2 %. OpenCV's own estimate of a board's shape needs all corners in each view. fixed: OpenCV's
    flags of what is not estimated but as of usual lenses: ``_USUAL`` leaves focal length, k1 and k2.
    """
    fit = _fisheye(views, size) if fisheye else _pinhole(views, size, fixed)
    at, unit = _linearise(views, fit, fisheye), np.eye(len(fit.parameters))
    held, least = fixed == _USUAL, 8 if fixed & cv2.CALIB_FIX_K3 else len(unit) - _SHAPE
    flat = np.column_stack([unit[0] + unit[1], unit[4], unit[5]]) if held else unit[:, :least]
    # Beside a principal point that is taken for granted, its error would be a stretch.
    bowed = np.column_stack([flat, unit[:, -_SHAPE:-1] if held else unit[:, -_SHAPE:]])
    count = bowed.shape[1] - flat.shape[1]
    inverse = _inverse(bowed.T @ at.information @ bowed)
    shape = (inverse @ bowed.T @ at.gradient)[-count:]
    statistic = float(shape @ np.linalg.solve(inverse[-count:, -count:], shape)) / _noise(at, bowed)
    if not statistic > float(chdtri(count, _BY_CHANCE)):
        return fit, at, flat
    damping, before = 0.0, np.inf
    for _ in range(_MAX_ROUNDS):
        if at.cost > (1.0 - _CONVERGED) * before:
            return fit, at, bowed
        normal = bowed.T @ at.information @ bowed
        step = -bowed @ _inverse(normal + damping * np.diag(normal.diagonal())) @ bowed.T @ at.gradient
        turns = [-np.linalg.pinv(b) @ (one + a @ step) for one, (a, b) in zip(at.residuals, at.jacobians, strict=True)]
        new = _Fit(fit.parameters + step, fit.poses + np.array(turns))
        now = _linearise(views, new, fisheye)
        if now.cost < at.cost:
            fit, at, before, damping = new, now, at.cost, damping / 10.0
        else:
            damping = max(10.0 * damping, 1e-3)
    raise Refused(_NO_SHAPE)


def _pinhole(views: list[BoardView], size: tuple[int, int], fixed: int) -> _Fit:
    """From a usual field of view, and from the views' homographies (Zhang 2000), which views face on do not allow.

    Of a few corners far from the middle OpenCV may take a wrong pose, from one start and not from the other.
    """
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    guess: Any = intrinsics_from_field_of_view(size, 65.0, False).matrix
    fits: list[Any] = []
    for start, flags in ((guess, fixed | cv2.CALIB_USE_INTRINSIC_GUESS), (None, fixed)):
        with suppress(cv2.error):
            fits.append(cv2.calibrateCamera(points, pixels, size, start, np.zeros(5), flags=flags))
    return _best(fits, 5)


def _fisheye(views: list[BoardView], size: tuple[int, int]) -> _Fit:
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
    return _best(fits, 4)


def _ahead(views: list[BoardView], size: tuple[int, int], limit: float) -> list[BoardView]:
    """The views with the corners that are surely before the camera, where the fit fails with all of them.

    OpenCV finds no pose of a board with corners 90 degrees from the optical axis, or a wrong one. limit: rms of a view
    [px] above which a fit has failed.
    """
    middle, focal = 0.5 * (np.array(size) - 1.0), intrinsics_from_field_of_view(size, 180.0, True).focal
    for degrees in _REACHES:
        inside = [np.linalg.norm(view.pixels - middle, axis=1) < focal * np.deg2rad(degrees) for view in views]
        kept = [
            replace(view, points=view.points[one], pixels=view.pixels[one])
            for view, one in zip(views, inside, strict=True)
            if one.sum() >= MIN_CORNERS and np.linalg.matrix_rank(np.diff(view.points[one], axis=0)) == 2
        ]
        if len(kept) >= _LEAST_VIEWS:
            with suppress(Refused):
                if float(np.median(_view_rms(_linearise(kept, _fisheye(kept, size), True)))) <= limit:
                    return kept
    return views


def _best(fits: list[Any], count: int) -> _Fit:
    """OpenCV's solution for a plane, with ``count`` distortions, that misses the corners least."""
    if not fits:
        raise Refused("no lens fits these views: tilt the board in different directions")
    _, matrix, distortions, rotations, translations = min(
        fits, key=lambda fit: float(np.nan_to_num(fit[0], nan=np.inf))
    )
    focal_and_centre = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    poses = [np.r_[np.ravel(turn), np.ravel(place)] for turn, place in zip(rotations, translations, strict=True)]
    return _Fit(np.r_[focal_and_centre, np.ravel(distortions)[:count], np.zeros(_SHAPE)], np.array(poses))


def _lens(fit: _Fit, size: tuple[int, int], fisheye: bool) -> Intrinsics:
    fx, fy, cx, cy = fit.parameters[:4]
    return Intrinsics(
        *size, np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), fit.parameters[4:-_SHAPE], fisheye
    )


def _linearise(views: list[BoardView], fit: _Fit, fisheye: bool) -> _Linearised:
    """Residuals and normal equations with each view's pose eliminated.

    OpenCV's own stds are of a pseudo-inverse: a focal length that no view determines, all of them face on, has next to
    none there.
    """
    lens, count = _lens(fit, (1, 1), fisheye), len(fit.parameters)
    information, gradient = np.zeros((count, count)), np.zeros(count)
    residuals, jacobians = list[Floats](), list[tuple[Floats, Floats]]()
    for view, pose in zip(views, fit.poses, strict=True):
        by_shape = _by_shape(view.points)
        points = view.points + by_shape @ fit.parameters[-_SHAPE:]
        at = pose[:3], pose[3:], lens.matrix, lens.distortions
        if fisheye:
            seen, jacobian = cv2.fisheye.projectPoints(points[None], *at)
            by_lens, pose_columns = jacobian[:, :8], jacobian[:, 8:14]
        else:
            seen, jacobian = cv2.projectPoints(points, *at)
            by_lens, pose_columns = jacobian[:, 6:15], jacobian[:, :6]
        by_pose: Floats = np.asarray(pose_columns, np.float64)
        by_point = (by_pose[:, 3:] @ cv2.Rodrigues(pose[:3])[0]).reshape(-1, 2, 3)
        by_parameters = np.column_stack([by_lens, (by_point @ by_shape).reshape(len(by_lens), _SHAPE)])
        residual = np.ravel(seen) - view.pixels.ravel()
        left = _without_pose(by_parameters, by_pose)
        information += by_parameters.T @ left
        gradient += left.T @ residual
        residuals.append(residual)
        jacobians.append((by_parameters, by_pose))
    return _Linearised(information, gradient, residuals, jacobians)


def _noise(at: _Linearised, free: Floats) -> float:
    """Variance of a coordinate of a corner [px²]. free: columns of what is estimated beside the poses."""
    return at.cost / _redundancy(at, free)


def _redundancy(at: _Linearised, free: Floats) -> float:
    """Number of coordinates of corners less that of estimates, at least 1."""
    return float(max(sum(len(one) for one in at.residuals) - free.shape[1] - 6 * len(at.residuals), 1))


def _focal_std(fit: _Fit, at: _Linearised, free: Floats, size: tuple[int, int]) -> float:
    """Relative std of the focal length, with what the estimate owes to a principal point that it took for granted
    (consider covariance)."""
    held = not free[2:4].any()
    centre = np.eye(len(at.gradient))[:, 2:4] * (_PRINCIPAL_POINT_STD * max(size) if held else 0.0)
    inverse = _inverse(free.T @ at.information @ free)
    variance = _noise(at, free) * inverse.diagonal() + np.square(inverse @ free.T @ at.information @ centre).sum(axis=1)
    return float(np.sqrt(variance[: 1 if held else 2].max())) / float(np.sqrt(fit.parameters[0] * fit.parameters[1]))


def _border_std(lens: Intrinsics, at: _Linearised, free: Floats) -> float:
    """Largest std of a ray at the picture's border [px]: of what is estimated, and with the lens's next parameters,
    which the corners did not ask for but may be there.

    A rotation that all rays share is the camera's. Of a fisheye lens the border without rays is beyond its circle.
    """
    columns, rows = COVERAGE_GRID
    across, down = np.meshgrid(
        np.linspace(0, lens.width - 1.0, columns + 1), np.linspace(0, lens.height - 1.0, rows + 1)
    )
    border = np.ones(across.shape, bool)
    border[1:-1, 1:-1] = False
    rays = lens.unproject(np.column_stack([across.ravel(), down.ravel()]))
    known: Bools = np.asarray(np.isfinite(rays).all(axis=1))
    if not known.any() or not (lens.fisheye or known[border.ravel()].all()):
        return float("inf")
    points, still = np.column_stack([rays[known], np.ones(known.sum())])[None], np.zeros(3)
    if lens.fisheye:
        jacobian = cv2.fisheye.projectPoints(points, still, still, lens.matrix, lens.distortions)[1]
        by_lens, by_turn = jacobian[:, :8], jacobian[:, 8:11]
    else:
        jacobian = cv2.projectPoints(points, still, still, lens.matrix, lens.distortions)[1]
        by_lens, by_turn = jacobian[:, 6:15], jacobian[:, :3]
    by_lens = _without_pose(np.asarray(by_lens, np.float64), np.asarray(by_turn, np.float64))
    count, unit = by_lens.shape[1], np.eye(len(free))
    fuller = unit[:, : min(count, count if free[2:4].any() else 8)]
    variances = []
    for lens_columns in (free, np.column_stack([fuller, free[:, ~free[:count].any(axis=0)]])):
        by_free = by_lens @ lens_columns[:count]
        inverse = _inverse(lens_columns.T @ at.information @ lens_columns)
        variances.append(
            _noise(at, lens_columns) * ((by_free @ inverse) * by_free).sum(axis=1).reshape(-1, 2).sum(axis=1)
        )
    return float(np.sqrt(np.max(variances, axis=0)[border.ravel()[known]].max(initial=0.0)))


def _focal_change(fit: _Fit, at: _Linearised, free: Floats) -> tuple[float, float]:
    """Relative change of the focal length from one of the views on, where it is most significant, and its std.

    The score test of a lens that all views share against one whose focal length changes once.
    """
    by_focal = fit.parameters * (np.arange(len(fit.parameters)) < 2)
    lefts = [_without_pose(by_parameters, by_pose) for by_parameters, by_pose in at.jacobians]
    # Summed from the last view: of the change, with the parameters and with the residuals.
    views = list(zip(lefts, at.jacobians, at.residuals, strict=True))[::-1]
    shared = np.cumsum([by_parameters.T @ left @ by_focal for left, (by_parameters, _), _ in views], axis=0)
    slopes = np.cumsum([by_focal @ left.T @ residual for left, _, residual in views])
    crossed = shared[:-1] @ free
    solved = crossed @ _inverse(free.T @ at.information @ free)
    information = shared[:-1] @ by_focal - (solved * crossed).sum(axis=1)
    information = np.maximum(information, _RIDGE * float(shared[-1] @ by_focal))
    change = -(slopes[:-1] - solved @ free.T @ at.gradient) / information
    std = np.sqrt(_noise(at, free) / information)
    best = int(np.argmax(np.abs(change) / std))
    return float(change[best]), float(std[best])


def _without_pose(by_parameters: Floats, by_pose: Floats) -> Floats:
    """What is left of the derivatives by the parameters where the view's pose is estimated too."""
    return np.asarray(by_parameters - by_pose @ np.linalg.pinv(by_pose) @ by_parameters)


def _inverse(normal: Floats) -> Floats:
    """Of normal equations whose parameters have different units; a huge variance of what no row determines."""
    scale = np.sqrt(np.maximum(normal.diagonal(), 1e-12))
    scales = np.outer(scale, scale)
    return np.asarray(np.linalg.inv(normal / scales + _RIDGE * np.eye(len(scale))) / scales)


def _view_rms(at: _Linearised) -> Floats:
    """(views,) root mean square of the corners' distances [px]."""
    return np.array([np.sqrt(2.0 * np.mean(one**2)) for one in at.residuals])


def _by_shape(points: Floats) -> Floats:
    """(n, 3, 4): how each parameter of the board's shape moves its points (n, 3)."""
    (x, y), zero = points[:, :2].T, np.zeros(len(points))
    rows = [zero] * 4, [zero, zero, zero, y], [x * x, x * y, y * y, zero]
    return np.stack([np.column_stack(row) for row in rows], axis=1)
