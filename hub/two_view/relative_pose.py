"""Two-view geometry: essential and fundamental matrix, Sampson distance, cheirality, five- and eight-point methods.

Convention: ``X_b = R X_a + t`` with |t| = 1, ``E = [t]x R``, ``s_bᵀ E s_a = 0`` for normalised homogeneous points.
The published fundamental matrix is the transpose, ``m_aᵀ F m_b = 0`` (asynchronous calibration paper, eq. 5); as
``F = U diag(cos a, sin a, 0) Vᵀ`` with rotations U, V (7 degrees of freedom) rank 2 and norm 1 hold at every step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from protocols.core.errors import Refused
from protocols.geometry import kernels, so3
from protocols.geometry.order_statistics import median
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats

_GENERATORS = so3.hat(np.eye(3))
_SYMMETRIC_INDEX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Index of each entry of a symmetric 3x3 matrix among its six upper ones."""
_REWEIGHTINGS = 4  # of a homography: outliers have lost their weight by then

_MIN_PAIRS = 8  # of the eight-point algorithm


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Relative pose up to scale: ``X_b = rotation @ X_a + direction * baseline`` with an unknown baseline.

    rotation: (3, 3), b from a. direction: (3,) unit vector, in b's axes.
    """

    rotation: Floats
    direction: Floats

    @property
    def essential(self) -> Floats:
        """(3, 3), ``s_bᵀ E s_a = 0``."""
        return np.asarray(so3.hat(self.direction) @ self.rotation)

    @property
    def matrix(self) -> Floats:
        """(3, 3), ``s_bᵀ M s_a = 0``: the essential matrix."""
        return self.essential

    def tangents(self) -> Floats:
        """(5, 3, 3) derivatives of ``matrix`` by the local parameters of `retract`."""
        out = np.empty((5, 3, 3))
        np.matmul(so3.hat(self.direction), _GENERATORS @ self.rotation, out=out[:3])
        for along, axis in zip(out[3:], orthogonal_axes(self.direction), strict=True):
            np.matmul(so3.hat(axis), self.rotation, out=along)
        return out

    def retract(self, step: Floats) -> RelativePose:
        """The pose after a local step (5,): rotation vector [rad], then the direction along its two tangents."""
        direction = self.direction + step[3:5] @ orthogonal_axes(self.direction)
        return RelativePose(so3.exp(step[:3]) @ self.rotation, direction / math.sqrt(direction @ direction))

    def inverse(self) -> RelativePose:
        """The relative pose of a from b."""
        return RelativePose(self.rotation.T, -self.rotation.T @ self.direction)


@dataclass(frozen=True, slots=True, eq=False)
class FundamentalMatrix:
    """Fundamental matrix ``left diag(cos a, sin a, 0) right`` of two views without intrinsics, 7 degrees of freedom.

    left, right: (3, 3) rotations. angle: a [rad]. Rank 2 and Frobenius norm 1 hold after every step.
    """

    left: Floats
    right: Floats
    angle: float

    @classmethod
    def of(cls, matrix: Floats) -> FundamentalMatrix:
        """The rank-2 matrix nearest to a matrix (3, 3), ``s_bᵀ M s_a = 0``."""
        u, d, vt = np.linalg.svd(matrix)
        u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
        return cls(u, vt, float(np.arctan2(d[1], d[0])))

    @property
    def matrix(self) -> Floats:
        """(3, 3), ``s_bᵀ M s_a = 0``, norm 1."""
        return np.asarray((self.left * np.array([np.cos(self.angle), np.sin(self.angle), 0.0])) @ self.right)

    def tangents(self) -> Floats:
        """(7, 3, 3) derivatives of ``matrix`` by the local parameters of `retract`."""
        matrix = self.matrix
        along = (self.left * np.array([-np.sin(self.angle), np.cos(self.angle), 0.0])) @ self.right
        return np.concatenate([_GENERATORS @ matrix, matrix @ _GENERATORS, along[None]])

    def retract(self, step: Floats) -> FundamentalMatrix:
        """The matrix after a local step (7,): rotation vectors of left and of right, and the angle [rad]."""
        left, right = so3.exp(step[:3]) @ self.left, self.right @ so3.exp(step[3:6])
        return FundamentalMatrix(left, right, self.angle + float(step[6]))


TwoViewGeometry: TypeAlias = RelativePose | FundamentalMatrix
"""Geometry of two views: a relative pose with intrinsics, a fundamental matrix without."""


def relative_pose_between(a: Pose, b: Pose) -> RelativePose:
    """The relative pose, b from a, of two cameras with poses. Raises ValueError for coincident centres."""
    baseline = b.rotation @ (a.position - b.position)
    length = float(np.linalg.norm(baseline))
    if length < 1e-12:
        raise ValueError("two cameras with one centre have no epipolar geometry")
    return RelativePose(b.rotation @ a.rotation.T, baseline / length)


def homogeneous(points: Floats) -> Floats:
    """Homogeneous coordinates (n, 3) of points (n, 2)."""
    out = np.ones((3, len(points)))
    out[:2] = points.T
    return out.T


def sampson(essential: Floats, a: Floats, b: Floats, sigma_a: float, sigma_b: float) -> Floats:
    """Signed Sampson distances (n,) of normalised points a, b (n, 2), over their noise std sigma_a, sigma_b.

    Hartley and Zisserman, Multiple View Geometry, sec. 11.4.3. essential: (3, 3), ``s_bᵀ E s_a = 0``.
    """
    line_b = essential[:, :2] @ a.T + essential[:, 2:]
    line_a = essential[:2, :2].T @ b.T + essential[2, :2, None]
    variance = sigma_b**2 * np.einsum("in,in->n", line_b[:2], line_b[:2])
    variance += sigma_a**2 * np.einsum("in,in->n", line_a, line_a)
    algebraic = np.einsum("in,in->n", b.T, line_b[:2]) + line_b[2]
    return np.asarray(algebraic / np.sqrt(np.maximum(variance, 1e-30)))


def triangulate_midpoint(pose: RelativePose, a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Depths (n,) along the rays of a and of b, in units of the baseline, by least squares; NaN for parallel rays."""
    ray_a, ray_b = pose.rotation @ homogeneous(a).T, homogeneous(b).T
    # baseline * direction = s_b ray_b - s_a ray_a
    aa, bb, ab = (np.einsum("in,in->n", one, other) for one, other in ((ray_a, ray_a), (ray_b, ray_b), (ray_a, ray_b)))
    at, bt = pose.direction @ ray_a, pose.direction @ ray_b
    determinant = aa * bb - ab * ab
    determinant = np.where(determinant > 1e-14 * aa * bb, determinant, np.nan)
    return (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant


def in_front(pose: TwoViewGeometry, a: Floats, b: Floats) -> Bools:
    """Cheirality: which point pairs (n,) lie in front of both cameras; all without intrinsics."""
    if isinstance(pose, FundamentalMatrix):
        return np.ones(len(a), dtype=np.bool_)
    depth_a, depth_b = triangulate_midpoint(pose, a, b)
    with np.errstate(invalid="ignore"):
        return np.asarray((depth_a > 0) & (depth_b > 0))


def parallax(pose: TwoViewGeometry, a: Floats, b: Floats) -> float:
    """Median parallax angle [rad] of normalised points a, b (n, 2); 0 without intrinsics."""
    if isinstance(pose, FundamentalMatrix) or len(a) == 0:
        return 0.0
    ray_a, ray_b = pose.rotation @ homogeneous(a).T, homogeneous(b).T
    aa, bb, ab = (np.einsum("in,in->n", one, other) for one, other in ((ray_a, ray_a), (ray_b, ray_b), (ray_a, ray_b)))
    return math.acos(max(-1.0, min(1.0, median(ab / np.sqrt(aa * bb)))))


def decompose_essential(essential: Floats, a: Floats, b: Floats) -> RelativePose:
    """Of the four relative poses of an (approximate) essential matrix (3, 3) the one with most points in front.

    a, b: normalised points (n, 2).
    """
    u, _, vt = np.linalg.svd(essential)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    options = list[tuple[int, RelativePose]]()
    for rotation in (u @ quarter @ vt, u @ quarter.T @ vt):
        depths = np.stack(triangulate_midpoint(RelativePose(rotation, u[:, 2]), a, b))
        with np.errstate(invalid="ignore"):
            for sign in (1.0, -1.0):  # the depths change their sign with the direction
                count = int(np.count_nonzero((sign * depths > 0).all(axis=0)))
                options.append((count, RelativePose(rotation, sign * u[:, 2])))
    return max(options, key=lambda option: option[0])[1]


def homography_residual(a: Floats, b: Floats) -> float:
    """Robust residual std of the best homography from a to b, per coordinate, in the common unit of a and b.

    Near the noise, all points lie in one plane or the camera centres coincide: then the essential matrix is not
    determined. Distances are weighted by their covariance under equal noise in both images (Sampson's
    e^T (1 + J J^T)^-1 e, times 2 so that it is the distance in b where J is a rotation), because a plane that is seen
    nearly edge-on magnifies the noise. a, b: (n, 2), n >= 8; nan for fewer.
    """
    if len(a) < 8:
        return float("nan")
    if kernels.AVAILABLE:
        return kernels.homography_residual(a, b, _REWEIGHTINGS) / 1.1774
    scale_a, scale_b = hartley_normalisation(a), hartley_normalisation(b)
    # Coordinates first, points last: numpy is slow along axes of length two or three.
    ha, (x, y, _) = scale_a @ homogeneous(a).T, scale_b @ homogeneous(b).T
    outer = ha[[0, 0, 0, 1, 1, 2]] * ha[[0, 1, 2, 1, 2, 2]]
    of_b = np.stack([np.ones_like(x), -x, -y, x * x + y * y], axis=1)
    weight, normal = np.ones(len(a)), np.zeros((9, 9))
    for _ in range(_REWEIGHTINGS):
        # Normal matrix of the DLT rows (ha, 0, -x ha) and (0, ha, -y ha).
        plain, by_x, by_y, by_both = (outer @ (of_b * np.square(weight)[:, None])).T[:, _SYMMETRIC_INDEX]
        normal[:3, :3] = normal[3:6, 3:6] = plain
        normal[:3, 6:] = normal[6:, :3] = by_x
        normal[3:6, 6:] = normal[6:, 3:6] = by_y
        normal[6:, 6:] = by_both
        homography = np.linalg.eigh(normal)[1][:, 0].reshape(3, 3)
        mapped = homography @ ha
        depth = np.where(np.abs(mapped[2]) > 1e-12, mapped[2], 1e-12)
        image = mapped[:2] / depth
        distance = np.hypot(image[0] - x, image[1] - y)
        # The algebraic error grows with the depth; division by it makes rows count by image distance.
        weight = 1.0 / np.abs(depth) / (1.0 + (distance / max(3.0 * median(distance), 1e-12)) ** 2)
        weight /= weight.max()
    # Jacobian (2, 2, n) of the homography at each point, in units of b over units of a.
    slope = (homography[:2, :2, None] - image[:, None] * homography[2, :2, None]) / depth
    slope *= float(scale_a[0, 0] / scale_b[0, 0])
    error = image - np.stack([x, y])
    # In closed form: for points near the vanishing line 1 + J J^T is singular to within rounding.
    area = slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]
    determinant = 1.0 + np.square(slope).sum(axis=(0, 1)) + np.square(area)
    # J^T applied to the error rotated by a right angle: the adjugate of J J^T.
    along = slope[0] * error[1] - slope[1] * error[0]
    squared = 2.0 * (np.square(error).sum(axis=0) + np.square(along).sum(axis=0)) / determinant
    return median(np.sqrt(np.maximum(squared, 0.0))) / 1.1774 / float(scale_b[0, 0])


def five_point(a: Floats, b: Floats, threshold: float, seed: int, subset: int = 300) -> list[RelativePose]:
    """Relative-pose hypotheses from five-point RANSAC (Nistér; OpenCV) on a random subset; deterministic in ``seed``.

    a, b: normalised points (n, 2). threshold: inlier distance in normalised coordinates. subset: largest number of
    pairs used. Empty for fewer than 8 pairs or where no matrix is found.
    """
    poses: list[RelativePose] = []
    pick = np.random.default_rng(seed).permutation(len(a))[:subset] if len(a) > subset else np.arange(len(a))
    if len(pick) < 8:
        return poses
    cv2.setRNGSeed(seed)
    found = cv2.findEssentialMat(
        np.ascontiguousarray(a[pick]),
        np.ascontiguousarray(b[pick]),
        np.eye(3),
        method=cv2.RANSAC,
        prob=0.999,
        threshold=threshold,
        maxIters=200,
    )[0]
    if found is None:
        return poses
    for matrix in np.asarray(found, dtype=np.float64).reshape(-1, 3, 3):
        if np.isfinite(matrix).all():
            poses.append(decompose_essential(matrix, a[pick], b[pick]))
    return poses


def fundamental_from(pose: TwoViewGeometry, matrix_a: Floats, matrix_b: Floats) -> Floats:
    """Fundamental matrix (3, 3) of undistorted pixels, ``m_aᵀ F m_b = 0``, Frobenius norm 1.

    matrix_a, matrix_b: (3, 3) camera matrices. Asynchronous calibration paper, eqs. 4 and 5.
    """
    f = np.linalg.inv(matrix_a).T @ pose.matrix.T @ np.linalg.inv(matrix_b)
    f = f / np.linalg.norm(f)
    largest = np.unravel_index(int(np.argmax(np.abs(f))), f.shape)
    return np.asarray(f * np.sign(f[largest]))


def orthogonal_axes(direction: Floats) -> Floats:
    """Two unit vectors (2, 3) orthogonal to ``direction`` (3,) and to each other."""
    x, y, z = direction.tolist()
    # Cross product with the coordinate axis least aligned with the direction.
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        p, q, r = 0.0, z, -y
    elif abs(y) <= abs(z):
        p, q, r = -z, 0.0, x
    else:
        p, q, r = y, -x, 0.0
    length = math.sqrt(p * p + q * q + r * r)
    p, q, r = p / length, q / length, r / length
    return np.array([[p, q, r], [y * r - z * q, z * p - x * r, x * q - y * p]])


def hartley_normalisation(points: Floats) -> Floats:
    """Hartley's normalising transform (3, 3): centres points (n, 2) and scales them to unit variance."""
    centre = points.mean(axis=0)
    spread = max(float(np.sqrt(((points - centre) ** 2).mean())), 1e-12)
    return np.array([[1 / spread, 0, -centre[0] / spread], [0, 1 / spread, -centre[1] / spread], [0, 0, 1.0]])


def eight_point(a: Floats, b: Floats) -> Floats:
    """Normalised eight-point algorithm: rank-2 F (3, 3), norm 1, of n >= 8 point pairs a, b (n, 2).

    Raises Refused for fewer than 8 pairs.
    """
    if len(a) < _MIN_PAIRS:
        raise Refused(f"{len(a)} point pairs; a fundamental matrix needs {_MIN_PAIRS}")
    ta, tb = hartley_normalisation(a), hartley_normalisation(b)
    ha = np.column_stack([a, np.ones(len(a))]) @ ta.T
    hb = np.column_stack([b, np.ones(len(b))]) @ tb.T
    rows = (ha[:, :, None] * hb[:, None, :]).reshape(-1, 9)
    _, _, vt = np.linalg.svd(rows, full_matrices=len(a) < 9)
    u, d, wt = np.linalg.svd(vt[-1].reshape(3, 3))
    matrix = ta.T @ ((u * np.array([d[0], d[1], 0.0])) @ wt) @ tb
    return np.asarray(matrix / np.linalg.norm(matrix))


def maximum_likelihood_fundamental(a: Floats, b: Floats) -> Floats:
    """Maximum-likelihood F (3, 3), norm 1: minimises the Sampson distance of point pairs a, b (n, 2).

    It starts from the eight-point solution. Raises Refused for fewer than 8 pairs.
    """
    from scipy.optimize import least_squares  # slow to import, and needed by the papers' methods only

    # In normalised coordinates, with the ratio of scales kept so that the Sampson distance is in pixels of one size.
    ta, tb = hartley_normalisation(a), hartley_normalisation(b)
    inverse_scale = ta[0, 0] / tb[0, 0]
    ha = np.column_stack([a, np.ones(len(a))]) @ ta.T
    hb = np.column_stack([b, np.ones(len(b))]) @ tb.T
    u, d, vt = np.linalg.svd(np.linalg.inv(ta).T @ eight_point(a, b) @ np.linalg.inv(tb))
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    angle = np.arctan2(d[1], d[0])

    def compose(step: Floats) -> Floats:
        singular = np.array([np.cos(angle + step[6]), np.sin(angle + step[6]), 0.0])
        return np.asarray((so3.exp(step[:3]) @ u * singular) @ vt @ so3.exp(-step[3:6]))

    def residuals(step: Floats) -> Floats:
        la, lb = hb @ compose(step).T, ha @ compose(step)
        # The two images are scaled by different factors: weighted back to pixels of one size.
        variance = (la[:, :2] ** 2).sum(1) * inverse_scale**2 + (lb[:, :2] ** 2).sum(1)
        return np.asarray((ha * la).sum(1) / np.sqrt(np.maximum(variance, 1e-300)))

    found = least_squares(residuals, np.zeros(7), "3-point", xtol=1e-12, ftol=1e-12, gtol=None, max_nfev=50)
    matrix = ta.T @ compose(found.x) @ tb
    return np.asarray(matrix / np.linalg.norm(matrix))


def epipolar_lines(matrix: Floats, a: Floats) -> Floats:
    """Epipolar lines (n, 3) in image b, ``lᵀ m_b = 0``, of points a (n, 2); the first two entries are a unit normal."""
    lines = np.column_stack([a, np.ones(len(a))]) @ matrix
    return np.asarray(lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-300)[:, None])


def line_distances(lines: Floats, points: Floats) -> Floats:
    """Signed distances (n,) of points (n, 2) from unit-normal lines (n, 3) [px]."""
    return np.asarray((lines[:, :2] * points).sum(axis=1) + lines[:, 2])
