"""Distributed pose paper: its equations against closed forms, and section 4 within the printed errors."""

from __future__ import annotations

import numpy as np

from hub.baselines import recursive_poses
from protocols.geometry import so3
from tests.papers.poses_paper import PRINTED, node_run, paper_run


def _two_views(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    points = rng.uniform(-1, 1, (40, 3)) + [0.0, 0.0, 6.0]
    turn, shift = so3.exp(rng.normal(0, 0.4, 3)), rng.normal(0, 1, 3)
    return points, (points - shift) @ turn.T, turn, shift, np.eye(3)


def test_the_correlation_holds_r_k_times_r_l_transposed() -> None:
    points_k, points_l, l_from_k, shift, _ = _two_views(np.random.default_rng(0))
    mean_k, mean_l = points_k.mean(0), points_l.mean(0)
    found = so3.nearest(
        recursive_poses.correlation(
            recursive_poses.centred_directions(points_k, mean_k), recursive_poses.centred_directions(points_l, mean_l)
        )
    )
    np.testing.assert_allclose(found, l_from_k.T, atol=1e-9)
    np.testing.assert_allclose(recursive_poses.direction(mean_k, mean_l, found), shift, atol=1e-9)


def test_the_size_gives_the_depth() -> None:
    point = np.array([0.4, -0.3, 5.0])
    row = np.array([[*(point[:2] / point[2]), np.log(1.0 / point[2])]])
    np.testing.assert_allclose(recursive_poses.point_in_camera(row)[0], point)


def test_the_reference_keeps_its_attitude() -> None:
    known = so3.exp(np.array([0.1, 0.2, 0.3]))
    away = so3.exp(np.array([0.0, 0.5, 0.0]))
    matrix = recursive_poses.attitude_matrix(1e6 * known, [(10.0 * away, np.eye(3))])
    assert so3.angle_between(so3.nearest(matrix), known) < 1e-4


def test_the_forgetting_factor_u_forgets_only_above_1() -> None:
    np.testing.assert_allclose(recursive_poses.discounted_sum(np.eye(3), np.eye(3), 1.0), 2 * np.eye(3))
    np.testing.assert_allclose(recursive_poses.discounted_sum(np.eye(3), np.eye(3), 2.0), 1.5 * np.eye(3))


def test_a_bearing_corrects_a_camera_only_across_the_ray() -> None:
    rotation = so3.exp(np.array([0.2, -0.1, 0.4]))
    position, other = np.array([1.0, 2.0, 3.0]), np.array([4.0, 0.0, 9.0])
    truth = position + np.array([0.3, -0.2, 0.1])
    y = rotation @ (other - truth)
    h = recursive_poses.direction_jacobian(y, rotation)
    moved, covariance = recursive_poses.kalman_position(
        position,
        np.eye(3),
        other,
        np.zeros((3, 3)),
        h,
        recursive_poses.RecursivePoseSettings(bearing_std=1e-6, drift=0.0),
    )
    along = (other - truth) / np.linalg.norm(other - truth)
    np.testing.assert_allclose(np.cross(moved - truth, along), 0.0, atol=1e-6)
    assert abs((moved - position) @ along) < 1e-9
    np.testing.assert_allclose(along @ covariance @ along, 1.0, atol=1e-9)


def test_section_4_is_reproduced_and_the_nodes_are_more_accurate() -> None:
    cm, degrees = paper_run(7, 0.02, 1.0, 10, (10_000,))[0]
    assert cm < PRINTED[0]
    assert degrees < PRINTED[1]
    ours = node_run(7, 0.02, 20, (2000,))[0]
    assert ours[0] < 0.2 * PRINTED[0]
    assert ours[1] < 0.2 * PRINTED[1]
