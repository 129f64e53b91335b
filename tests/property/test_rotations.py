"""SO(3) keeps its group axioms everywhere, also next to the identity and to half a turn."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity, fit_similarity
from protocols.geometry.types import Floats

_axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: float(np.linalg.norm(a)) > 1e-3)
_angles = st.one_of(
    st.just(0.0),
    st.floats(1e-14, 1e-6),
    st.floats(0.9e-4, 1.1e-4),  # where exp changes from its series to the sine
    st.floats(0.01, 3.1),
    st.floats(1e-12, 1e-6).map(lambda gap: float(np.pi - gap)),
)


def _vector(axis: tuple[float, ...], angle: float) -> Floats:
    return np.asarray(np.array(axis) / np.linalg.norm(axis) * angle)


vectors = st.builds(_vector, _axes, _angles)
rotations = vectors.map(so3.exp)
points = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)


@given(vectors)
def test_exp_gives_rotations(w: Floats) -> None:
    r = so3.exp(w)
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-14)
    assert abs(np.linalg.det(r) - 1.0) < 1e-14


@given(vectors)
def test_exp_agrees_with_scipy(w: Floats) -> None:
    np.testing.assert_allclose(so3.exp(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-14)


@given(vectors)
def test_log_undoes_exp(w: Floats) -> None:
    np.testing.assert_allclose(so3.log(so3.exp(w)), w, atol=1e-9, rtol=1e-9)


@given(rotations)
def test_quaternions_agree_with_scipy_and_give_the_rotation_back(rotation: Floats) -> None:
    q = so3.quaternion(rotation)
    assert q[0] >= 0.0
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    assert abs(abs(q @ np.array([w, x, y, z])) - 1.0) < 1e-14
    np.testing.assert_allclose(so3.from_quaternion(3.0 * q), rotation, atol=1e-14)


@given(_axes, st.floats(1e-12, 1e-6))
def test_log_of_a_tiny_turn_keeps_its_relative_precision(axis: tuple[float, ...], angle: float) -> None:
    w = _vector(axis, angle)
    np.testing.assert_allclose(so3.log(so3.exp(w)), w, rtol=1e-6, atol=1e-18)


@given(_axes)
def test_log_of_half_a_turn_is_half_a_turn_about_that_axis(axis: tuple[float, ...]) -> None:
    w = _vector(axis, np.pi)
    found = so3.log(so3.exp(w))
    assert abs(np.linalg.norm(found) - np.pi) < 1e-9
    assert min(np.linalg.norm(found - w), np.linalg.norm(found + w)) < 1e-7


@given(rotations)
def test_exp_undoes_log(r: Floats) -> None:
    np.testing.assert_allclose(so3.exp(so3.log(r)), r, atol=1e-9)


@given(rotations)
def test_log_is_never_longer_than_half_a_turn(r: Floats) -> None:
    assert np.linalg.norm(so3.log(r)) <= np.pi + 1e-12


@given(rotations)
def test_the_inverse_has_the_opposite_log(r: Floats) -> None:
    w, back = so3.log(r), so3.log(r.T)
    if np.pi - np.linalg.norm(w) > 1e-6:
        np.testing.assert_allclose(back, -w, atol=1e-8)


@given(rotations, rotations, rotations)
def test_composition_is_associative_and_closed(a: Floats, b: Floats, c: Floats) -> None:
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-14)
    np.testing.assert_allclose(so3.nearest(a @ b @ c), a @ b @ c, atol=1e-13)


@given(vectors, rotations)
def test_a_turn_of_the_axis_turns_the_rotation(w: Floats, r: Floats) -> None:
    np.testing.assert_allclose(so3.exp(r @ w), r @ so3.exp(w) @ r.T, atol=1e-13)


@given(points, points)
def test_hat_is_the_cross_product(a: Floats, b: Floats) -> None:
    np.testing.assert_allclose(so3.hat(a) @ b, np.cross(a, b), atol=1e-12)


@given(st.lists(vectors, min_size=1, max_size=5))
def test_exp_and_hat_work_on_batches(ws: list[Floats]) -> None:
    batch = np.stack(ws)
    for one, together, skew in zip(ws, so3.exp(batch), so3.hat(batch), strict=True):
        np.testing.assert_allclose(so3.exp(one), together, atol=1e-15)
        np.testing.assert_array_equal(so3.hat(one), skew)


@given(rotations, st.lists(st.floats(-0.2, 0.2), min_size=9, max_size=9))
def test_nearest_is_a_rotation_that_nothing_beats(r: Floats, error: list[float]) -> None:
    matrix = r + np.array(error).reshape(3, 3)
    found = so3.nearest(matrix)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) > 0
    distance = np.linalg.norm(found - matrix)
    for step in 1e-3 * np.r_[np.eye(3), -np.eye(3)]:
        assert np.linalg.norm(so3.exp(step) @ found - matrix) >= distance - 1e-12


def test_nearest_of_a_reflection_is_still_a_rotation() -> None:
    assert np.linalg.det(so3.nearest(np.diag([1.0, 1.0, -1.0]))) > 0


@given(rotations, vectors)
def test_the_angle_between_rotations_is_the_length_of_the_turn(r: Floats, w: Floats) -> None:
    assert abs(so3.angle_between(r, so3.exp(w) @ r) - np.linalg.norm(w)) < 1e-8


@given(points.filter(lambda p: float(np.linalg.norm(p)) > 1e-3), vectors)
def test_taking_takes_one_direction_to_the_other(a: Floats, w: Floats) -> None:
    b = 3.0 * so3.exp(w) @ a
    turned = so3.rotation_between(a, b) @ (a / np.linalg.norm(a))
    np.testing.assert_allclose(turned, b / np.linalg.norm(b), atol=1e-9)


@given(points.filter(lambda p: float(np.linalg.norm(p)) > 1e-3))
def test_taking_a_direction_to_its_opposite_is_half_a_turn(a: Floats) -> None:
    turned = so3.rotation_between(a, -a)
    np.testing.assert_allclose(turned @ a, -a, atol=1e-9)
    assert abs(np.linalg.det(turned) - 1) < 1e-9


@given(vectors, points, points)
def test_a_pose_and_its_rodrigues_form_are_one(w: Floats, position: Floats, point: Floats) -> None:
    pose = Pose(so3.exp(w), position)
    again = Pose.from_rodrigues(pose.rodrigues, pose.translation)
    np.testing.assert_allclose(again.camera_from_world(point[None]), pose.camera_from_world(point[None]), atol=1e-7)
    np.testing.assert_allclose(
        pose.camera_from_world(point[None])[0], pose.rotation @ point + pose.translation, atol=1e-12
    )
    np.testing.assert_allclose(pose.world_from_camera(pose.camera_from_world(point[None]))[0], point, atol=1e-12)


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.floats(0.01, 100), vectors, points)
def test_a_similarity_is_recovered_from_points(seed: int, scale: float, w: Floats, shift: Floats) -> None:
    truth = Similarity(scale, so3.exp(w), shift)
    source = np.random.default_rng(seed).normal(size=(6, 3))
    found = fit_similarity(source, truth.points(source))
    assert abs(found.scale / scale - 1) < 1e-9
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.shift, shift, atol=1e-8 * (1 + scale))


@settings(max_examples=40)
@given(st.floats(0.01, 100), vectors, points, vectors, points, points)
def test_a_similarity_moves_camera_and_point_together(
    scale: float, w: Floats, shift: Floats, turn: Floats, place: Floats, point: Floats
) -> None:
    similarity, pose = Similarity(scale, so3.exp(w), shift), Pose(so3.exp(turn), place)
    before = pose.camera_from_world(point[None])
    after = similarity.pose(pose).camera_from_world(similarity.points(point[None]))
    np.testing.assert_allclose(after, scale * before, atol=1e-9 * (1 + scale) * 30)


def test_three_points_fix_a_rigid_motion_without_mirroring_it() -> None:
    source = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    found = fit_similarity(source, source @ so3.exp(np.array([0.0, 3.0, 0])).T, scale=False)
    assert np.linalg.det(found.rotation) > 0
    assert found.scale == 1.0
