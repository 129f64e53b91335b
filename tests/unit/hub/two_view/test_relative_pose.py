"""Two-view geometry: essential and fundamental matrices, decomposition, five-point hypotheses, planarity."""

from __future__ import annotations

import numpy as np
import pytest

from edge.scenes.common.base import look_at_pose
from hub.two_view import relative_pose
from hub.two_view.relative_pose import FundamentalMatrix, RelativePose, TwoViewGeometry
from protocols.geometry import so3
from protocols.geometry.types import Floats


def scene(seed: int, count: int = 60) -> tuple[RelativePose, Floats, Floats, float, Floats]:
    """Relative pose, normalised points of a and b, the baseline, and the points in a's axes."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.5, 2.6)
    a = look_at_pose(np.array([5.0, 0.0, rng.uniform(-1, 1)]), rng.normal(0, 0.1, 3))
    b = look_at_pose(np.array([4 * np.cos(angle), 4 * np.sin(angle), rng.uniform(-1, 1)]), np.zeros(3))
    points = rng.uniform(-1, 1, (count, 3))
    turn = b.rotation @ a.rotation.T
    shift = b.rotation @ (a.position - b.position)
    baseline = float(np.linalg.norm(shift))
    pa, pb = a.camera_from_world(points), b.camera_from_world(points)
    return RelativePose(turn, shift / baseline), pa[:, :2] / pa[:, 2:], pb[:, :2] / pb[:, 2:], baseline, pa


seeds = pytest.mark.parametrize("seed", range(8))


@seeds
def test_true_pairs_have_no_sampson_distance(seed: int) -> None:
    pose, a, b, _, _ = scene(seed)
    np.testing.assert_allclose(relative_pose.sampson(pose.essential, a, b, 1e-3, 1e-3), 0, atol=1e-9)


def test_the_sampson_distance_is_in_units_of_the_noise() -> None:
    pose, a, b, _, _ = scene(0, 20_000)
    rng = np.random.default_rng(1)
    noisy_a, noisy_b = a + rng.normal(0, 1e-3, a.shape), b + rng.normal(0, 2e-3, b.shape)
    distance = relative_pose.sampson(pose.essential, noisy_a, noisy_b, 1e-3, 2e-3)
    assert distance.std() == pytest.approx(1.0, rel=0.03)
    assert abs(distance.mean()) < 0.03


@seeds
def test_triangulation_finds_depth_in_baselines(seed: int) -> None:
    pose, a, b, baseline, points = scene(seed)
    depth_a, depth_b = relative_pose.triangulate_midpoint(pose, a, b)
    np.testing.assert_allclose(depth_a * baseline, points[:, 2], rtol=1e-9)
    there = depth_a[:, None] * relative_pose.homogeneous(a) @ pose.rotation.T + pose.direction
    np.testing.assert_allclose(there, depth_b[:, None] * relative_pose.homogeneous(b), atol=1e-9)


def test_parallel_rays_have_no_depth() -> None:
    pose = RelativePose(np.eye(3), np.array([1.0, 0, 0]))
    depths = relative_pose.triangulate_midpoint(pose, np.zeros((1, 2)), np.zeros((1, 2)))
    assert np.isnan(depths).all()
    assert not relative_pose.in_front(pose, np.zeros((1, 2)), np.zeros((1, 2))).any()


@seeds
def test_decompose_recovers_the_pose(seed: int) -> None:
    pose, a, b, _, _ = scene(seed)
    for sign in (1.0, -1.0):
        found = relative_pose.decompose_essential(sign * 3.7 * pose.essential, a, b)
        assert so3.angle_between(found.rotation, pose.rotation) < 1e-7
        np.testing.assert_allclose(found.direction, pose.direction, atol=1e-7)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@seeds
def test_five_points_recover_the_pose_among_hypotheses(seed: int) -> None:
    pose, a, b, _, _ = scene(seed)
    rng = np.random.default_rng(seed)
    a, b = a + rng.normal(0, 2e-4, a.shape), b + rng.normal(0, 2e-4, b.shape)
    a[:6] += 0.2  # false pairs
    poses = relative_pose.five_point(a, b, 1e-3, seed)
    assert poses
    assert min(so3.angle_between(found.rotation, pose.rotation) for found in poses) < np.deg2rad(2)
    assert min(np.linalg.norm(found.direction - pose.direction) for found in poses) < 0.05


def test_five_point_hypotheses_are_deterministic() -> None:
    _, a, b, _, _ = scene(3, 500)
    first = relative_pose.five_point(a, b, 1e-3, 7)
    relative_pose.five_point(b, a, 1e-2, 8)
    again = relative_pose.five_point(a, b, 1e-3, 7)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.rotation, other.rotation)


def test_too_few_pairs_give_no_hypothesis() -> None:
    assert relative_pose.five_point(np.zeros((7, 2)), np.zeros((7, 2)), 1e-3, 0) == []


@pytest.mark.parametrize("what", ["one point", "a line"])
def test_degenerate_pairs_give_finite_poses(what: str) -> None:
    t = np.zeros(50) if what == "one point" else np.linspace(-0.3, 0.3, 50)
    for pose in relative_pose.five_point(np.column_stack([t, t]), np.column_stack([t, 0.5 * t]), 1e-3, 0):
        assert np.isfinite(pose.rotation).all()


@seeds
def test_only_the_right_one_of_the_four_poses_is_in_front(seed: int) -> None:
    pose, a, b, _, _ = scene(seed)
    assert relative_pose.in_front(pose, a, b).all()
    assert not relative_pose.in_front(RelativePose(pose.rotation, -pose.direction), a, b).any()


@seeds
def test_the_inverse_of_the_inverse_is_the_pose(seed: int) -> None:
    pose, a, b, _, _ = scene(seed)
    np.testing.assert_allclose(relative_pose.sampson(pose.inverse().essential, b, a, 1, 1), 0, atol=1e-12)
    again = pose.inverse().inverse()
    np.testing.assert_allclose(again.rotation, pose.rotation, atol=1e-14)
    np.testing.assert_allclose(again.direction, pose.direction, atol=1e-14)


def test_the_fundamental_matrix_has_the_published_convention() -> None:
    """Row-major, norm 1, m_aᵀ F m_b = 0 (eq. 5), in pixels."""
    pose, a, b, _, _ = scene(1)
    lens_a = np.array([[900.0, 0, 640], [0, 905, 360], [0, 0, 1]])
    lens_b = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    f = relative_pose.fundamental_from(pose, lens_a, lens_b)
    assert np.linalg.norm(f) == pytest.approx(1.0)
    assert np.linalg.matrix_rank(f, tol=1e-12) == 2
    m_a, m_b = relative_pose.homogeneous(a) @ lens_a.T, relative_pose.homogeneous(b) @ lens_b.T
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", m_a, f, m_b), 0, atol=1e-9)


@seeds
def test_the_tangent_basis_is_orthonormal(seed: int) -> None:
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    basis = np.column_stack([direction, relative_pose.orthogonal_axes(direction).T])
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-14)


def uncalibrated(seed: int) -> FundamentalMatrix:
    return FundamentalMatrix.of(np.random.default_rng(seed).normal(size=(3, 3)))


@seeds
def test_a_fundamental_matrix_keeps_rank_two_and_norm_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    geometry = uncalibrated(seed)
    for _ in range(5):
        assert np.linalg.norm(geometry.matrix) == pytest.approx(1.0, abs=1e-12)
        assert np.linalg.svd(geometry.matrix, compute_uv=False)[2] < 1e-12
        geometry = geometry.retract(rng.normal(0, 1.0, 7))


@seeds
@pytest.mark.parametrize("calibrated", [True, False])
def test_tangents_are_the_derivatives_of_retract(seed: int, calibrated: bool) -> None:
    geometry: TwoViewGeometry = scene(seed)[0] if calibrated else uncalibrated(seed)
    tangents = geometry.tangents()
    assert tangents.shape == (5 if calibrated else 7, 3, 3)
    h = 1e-6
    for axis, tangent in zip(np.eye(len(tangents)), tangents, strict=True):
        slope = (geometry.retract(h * axis).matrix - geometry.retract(-h * axis).matrix) / (2 * h)
        np.testing.assert_allclose(tangent, slope, atol=1e-8)


@seeds
def test_a_fundamental_matrix_has_seven_degrees_of_freedom(seed: int) -> None:
    """The seven tangents are linearly independent."""
    assert np.linalg.matrix_rank(uncalibrated(seed).tangents().reshape(7, 9), tol=1e-3) == 7


@seeds
def test_the_nearest_rank_two_matrix_drops_the_smallest_singular_value(seed: int) -> None:
    matrix = np.random.default_rng(seed).normal(size=(3, 3))
    u, d, vt = np.linalg.svd(matrix)
    nearest = (u * [d[0], d[1], 0.0]) @ vt
    nearest /= np.linalg.norm(nearest)
    found = FundamentalMatrix.of(matrix).matrix
    np.testing.assert_allclose(found * np.sign((found * nearest).sum()), nearest, atol=1e-12)
    for rotation in (FundamentalMatrix.of(matrix).left, FundamentalMatrix.of(matrix).right):
        assert np.linalg.det(rotation) == pytest.approx(1.0)


@seeds
def test_nominal_intrinsics_drop_out_of_the_published_matrix(seed: int) -> None:
    """F in pixels does not depend on the intrinsics that the tracks were normalised with."""
    pose, a, b, _, _ = scene(seed)
    true = np.array([[900.0, 0, 640], [0, 905, 360], [0, 0, 1]])
    nominal = np.array([[1280.0, 0, 639.5], [0, 1280.0, 359.5], [0, 0, 1]])
    other = np.linalg.inv(nominal) @ true
    seen = FundamentalMatrix.of(np.linalg.inv(other).T @ pose.essential @ np.linalg.inv(other))
    f = relative_pose.fundamental_from(seen, nominal, nominal)
    np.testing.assert_allclose(f, relative_pose.fundamental_from(pose, true, true), atol=1e-12)
    m_a, m_b = relative_pose.homogeneous(a) @ true.T, relative_pose.homogeneous(b) @ true.T
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", m_a, f, m_b), 0, atol=1e-8)


def test_without_intrinsics_all_points_are_in_front_and_the_parallax_is_zero() -> None:
    _, a, b, _, _ = scene(2)
    assert relative_pose.in_front(uncalibrated(2), a, b).all()
    assert relative_pose.parallax(uncalibrated(2), a, b) == 0.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("tilt_degrees", [2.0, 5.0, 40.0])
def test_the_homography_residual_is_the_noise_for_edge_on_planes_and_more_for_solid_scenes(
    seed: int, tilt_degrees: float
) -> None:
    """Edge-on planes magnify the noise; without weighting they would look three-dimensional."""
    rng = np.random.default_rng(seed)
    focal, noise = 800.0, 0.5
    tilt = np.radians(tilt_degrees)
    across = rng.uniform(-1, 1, (400, 2))
    # Points of a plane tilted against the line of sight of both cameras, which are 1.5 apart sideways at its height.
    plane = np.stack([across[:, 0], np.sin(tilt) * across[:, 1], 6.0 + np.cos(tilt) * across[:, 1]], axis=1)
    solid = plane + np.array([0.0, 1.0, 0.0]) * rng.uniform(-0.5, 0.5, (400, 1))

    def residual(points: Floats) -> float:
        views = (points, (points - [1.5, 0.1, 0.0]) @ so3.exp(np.array([0.0, 0.25, 0.0])).T)
        a, b = (focal * seen[:, :2] / seen[:, 2:] + rng.normal(0, noise, (400, 2)) for seen in views)
        return relative_pose.homography_residual(a, b)

    assert residual(plane) < 2.0 * noise
    assert residual(solid) > 6.0 * noise


@pytest.mark.parametrize("kind", ["one point", "a line", "integers", "to infinity", "unrelated"])
def test_the_homography_residual_is_defined_for_degenerate_points(kind: str) -> None:
    rng = np.random.default_rng(8)
    a, b = rng.normal(0, 300, (60, 2)), rng.normal(0, 300, (60, 2))
    if kind == "one point":
        a = np.zeros_like(a)
    elif kind == "a line":
        a[:, 1], b[:, 0] = 2.0 * a[:, 0], 5.0
    elif kind == "integers":
        a, b = np.round(a / 300), np.round(b / 300)
    elif kind == "to infinity":
        b = a / np.where(np.abs(a[:, :1]) < 20, 1e-14, a[:, :1])
    with np.errstate(all="ignore"):
        left = relative_pose.homography_residual(a, b)
    assert np.isnan(left) or left >= 0.0
