"""The camera models are OpenCV's, their inverses are inverses, and where there is none they say NaN."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

W, H = 1280, 720
_focal = st.floats(600, 1600)


def _matrix(f: float, stretch: float, cx: float, cy: float) -> Floats:
    return np.array([[f, 0, cx], [0, f * stretch, cy], [0, 0, 1.0]])


matrices = st.builds(_matrix, _focal, st.floats(0.98, 1.02), st.floats(600, 680), st.floats(330, 390))
pinholes = st.builds(
    lambda m, k1, k2, p1, p2: Intrinsics(W, H, m, np.array([k1, k2, p1, p2, 0.002])),
    matrices,
    st.floats(-0.2, 0.1),
    st.floats(0.02, 0.08),
    st.floats(-2e-3, 2e-3),
    st.floats(-2e-3, 2e-3),
)
fisheyes = st.builds(
    lambda m, k1, k2, k3: Intrinsics(W, H, m, np.array([k1, k2, k3, 1e-4]), fisheye=True),
    matrices,
    st.floats(-0.03, 0.03),
    st.floats(-0.005, 0.005),
    st.floats(-1e-3, 1e-3),
)
cameras = st.one_of(pinholes, fisheyes)
pixels = st.lists(st.tuples(st.floats(0, W - 1), st.floats(0, H - 1)), min_size=1, max_size=8).map(
    lambda p: np.array(p, dtype=np.float64)
)
normals = st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.4, 0.4)), min_size=1, max_size=8).map(
    lambda p: np.array(p, dtype=np.float64)
)


def _ahead(normalised: Floats, depth: float = 2.5) -> Floats:
    return depth * np.column_stack([normalised, np.ones(len(normalised))])


@given(cameras, pixels)
def test_every_pixel_of_a_sane_lens_comes_back(lens: Intrinsics, seen: Floats) -> None:
    there = lens.unproject(seen)
    assert np.isfinite(there).all()
    np.testing.assert_allclose(lens.project_normalised(there), seen, atol=1e-6)


@given(cameras, normals)
def test_every_direction_comes_back(lens: Intrinsics, directions: Floats) -> None:
    np.testing.assert_allclose(lens.unproject(lens.project(_ahead(directions))), directions, atol=1e-8)


@given(pinholes, normals)
def test_pinhole_is_opencv(lens: Intrinsics, directions: Floats) -> None:
    points = _ahead(directions)
    oracle = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortions)[0]
    np.testing.assert_allclose(lens.project(points), oracle.reshape(-1, 2), atol=1e-8)


@given(fisheyes, normals)
def test_fisheye_is_opencv(lens: Intrinsics, directions: Floats) -> None:
    points = _ahead(directions)[:, None, :]
    oracle = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortions)[0]
    np.testing.assert_allclose(lens.project(points[:, 0]), oracle.reshape(-1, 2), atol=1e-8)


@settings(max_examples=30)
@given(pinholes, pixels)
def test_pinhole_unprojects_as_opencv_does(lens: Intrinsics, seen: Floats) -> None:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    oracle = cv2.undistortPoints(seen[:, None], lens.matrix, lens.distortions, None, None, None, criteria)
    oracle = np.asarray(oracle, dtype=np.float64).reshape(-1, 2)
    back = cv2.projectPoints(_ahead(oracle, 1.0), np.zeros(3), np.zeros(3), lens.matrix, lens.distortions)[0]
    good = np.abs(back.reshape(-1, 2) - seen).max(axis=1) < 1e-6  # OpenCV's own iteration can fail
    np.testing.assert_allclose(lens.unproject(seen)[good], oracle[good], atol=1e-7)


@given(cameras, normals)
def test_the_jacobian_is_the_derivative(lens: Intrinsics, directions: Floats) -> None:
    step = 1e-5
    for axis, column in zip(np.eye(2), np.moveaxis(lens.pixel_jacobian(directions), -1, 0), strict=True):
        ahead, behind = (lens.project_normalised(directions + sign * step * axis) for sign in (1, -1))
        np.testing.assert_allclose(column, (ahead - behind) / (2 * step), atol=2e-3, rtol=1e-6)


@given(pinholes, normals, st.floats(0.0, 10.0))
def test_a_point_behind_or_beside_a_pinhole_has_no_pixel(lens: Intrinsics, where: Floats, depth: float) -> None:
    assert np.isnan(lens.project(np.column_stack([where, np.full(len(where), -depth)]))).all()


def test_one_bad_point_spoils_no_other() -> None:
    lens = Intrinsics(W, H, _matrix(900, 1, 640, 360), np.array([-0.1, 0.02, 0, 0, 0]))
    points = np.array([[0.1, 0.1, 1.0], [0.1, 0.1, -1.0], [np.nan, 0, 1], [0.2, 0.0, 2.0]])
    seen = lens.project(points)
    assert np.isnan(seen[1:3]).all()
    np.testing.assert_allclose(lens.unproject(seen)[[0, 3]], [[0.1, 0.1], [0.1, 0.0]], atol=1e-12)
    assert np.isnan(lens.unproject(seen)[1:3]).all()


@pytest.mark.parametrize("k1", [-0.3, -0.6, -1.0])
def test_a_pixel_outside_the_fold_of_a_barrel_has_no_direction(k1: float) -> None:
    lens = Intrinsics(W, H, _matrix(900, 1, 640, 360), np.array([k1, 0, 0, 0, 0]))
    fold = np.sqrt(-1 / (3 * k1))  # d(r + k1 r³)/dr = 0
    limit = 900 * (fold + k1 * fold**3)
    inside, outside = np.array([[640 + 0.99 * limit, 360.0]]), np.array([[640 + 1.01 * limit, 360.0]])
    assert abs(lens.unproject(inside)[0, 0]) < fold
    assert np.isnan(lens.unproject(outside)).all()


@settings(max_examples=60)
@given(st.floats(-0.6, -0.2), st.floats(0.0, 0.25), st.floats(0, 2 * np.pi), st.floats(0.0, 2.0))
def test_unproject_answers_from_the_first_branch_or_not_at_all(k1: float, k2: float, turn: float, far: float) -> None:
    lens = Intrinsics(W, H, _matrix(900, 1, 640, 360), np.array([k1, k2, 0, 0, 0]))
    pixel = np.array([[640 + 900 * far * np.cos(turn), 360 + 900 * far * np.sin(turn)]])
    found = lens.unproject(pixel)
    if np.isfinite(found).all():
        radius = np.linspace(0, float(np.hypot(*found[0])), 200)
        slope = 1 + 3 * k1 * radius**2 + 5 * k2 * radius**4
        assert (slope > 0).all(), "a root behind the fold"


@pytest.mark.parametrize("k1", [-0.3, -0.6])
def test_a_direction_beyond_the_fold_of_a_barrel_has_no_pixel(k1: float) -> None:
    """Such a point would be drawn inside the image, where it never is."""
    lens = Intrinsics(W, H, _matrix(900, 1, 640, 360), np.array([k1, 0, 0, 0, 0]))
    fold = np.sqrt(-1 / (3 * k1))
    assert np.isnan(lens.project_normalised(np.array([[1.3 * fold, 0.0]]))).all()


def test_a_folded_fisheye_has_no_direction() -> None:
    lens = Intrinsics(W, H, _matrix(400, 1, 640, 360), np.array([-0.4, 0, 0, 0]), fisheye=True)
    fold = np.sqrt(1 / 1.2)  # theta at which theta - 0.4 theta³ turns back
    limit = 400 * (fold - 0.4 * fold**3)
    found = lens.unproject(np.array([[640 + 0.98 * limit, 360.0], [640 + 1.05 * limit, 360.0]]))
    assert abs(np.arctan(found[0, 0])) < fold
    assert np.isnan(found[1]).all()


def test_a_fisheye_sees_nothing_straight_behind_itself() -> None:
    lens = Intrinsics(W, H, _matrix(400, 1, 640, 360), np.zeros(4), fisheye=True)
    seen = lens.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    assert np.isnan(seen[:2]).all()
    np.testing.assert_allclose(seen[2], [640, 360])


def test_no_rows_are_no_trouble() -> None:
    for fisheye in (False, True):
        lens = Intrinsics(W, H, _matrix(900, 1, 640, 360), np.full(4 if fisheye else 5, 0.01), fisheye)
        assert lens.project(np.zeros((0, 3))).shape == (0, 2)
        assert lens.unproject(np.zeros((0, 2))).shape == (0, 2)
        assert lens.pixel_jacobian(np.zeros((0, 2))).shape == (0, 2, 2)


@pytest.mark.parametrize("fisheye", [False, True])
def test_absurd_pixels_have_no_direction_and_spoil_no_other(fisheye: bool) -> None:
    """A detector that wrote 1e300 is an outlier, not a crash."""
    lens = Intrinsics(W, H, _matrix(900, 1, 640, 360), np.array([-0.1, 0.02, 0, 0, 0][: 5 - fisheye]), fisheye)
    found = lens.unproject(np.array([[640.0, 360.0], [1e300, 0], [-1e12, 1e12]]))
    np.testing.assert_allclose(found[0], 0, atol=1e-12)
    assert np.isnan(found[1:]).all()
