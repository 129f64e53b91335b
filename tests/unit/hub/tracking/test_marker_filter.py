"""The filter of labelled markers against batch solutions, and its parts against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from edge.scenes.common.base import look_at_pose
from hub.tracking.association.triangulation import initial_motion
from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.jerk_model import STATE_DIM, jerk_model, rts_smooth
from hub.tracking.filter.marker_rows import MarkerRow, marker_row, undistort
from hub.tracking.marker_filter import MarkerState, process_row
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from tests.support.rigs import SIZE, random_lens, random_poses

PSD = 3e-4
COAST_NS = 10 * NANOSECONDS


def cameras(count: int = 3, seed: int = 0) -> list[TrackingCamera]:
    rng = np.random.default_rng(seed)
    return [
        TrackingCamera(f"cam{i}", random_lens(rng, i == 1), pose, TimeMap())
        for i, pose in enumerate(random_poses(rng, count))
    ]


def row_of(camera: TrackingCamera, time: float, place: Floats, sequence: int = 0) -> MarkerRow:
    (pixel,) = camera.intrinsics.project(camera.pose.camera_from_world(place[None]))
    row = marker_row(camera, round(time * NANOSECONDS), "b", sequence, pb.Detection(u=pixel[0], v=pixel[1]))
    assert row is not None
    return row


def test_the_jerk_model_is_the_integral_of_its_definition() -> None:
    elapsed = 0.3
    step, noise = jerk_model(elapsed)
    times = (np.arange(2000) + 0.5) * elapsed / 2000
    columns = np.stack([0.5 * times**2, times, np.ones(2000)])  # of a jerk that is this old
    np.testing.assert_allclose(noise, np.kron(columns @ columns.T * elapsed / 2000, np.eye(3)), rtol=1e-4)
    half, half_noise = jerk_model(0.5 * elapsed)
    np.testing.assert_allclose(step, half @ half, rtol=1e-12)
    np.testing.assert_allclose(noise, half @ half_noise @ half.T + half_noise, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("fisheye", [False, True])
def test_one_pixel_is_undistorted_as_many_are(fisheye: bool) -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        lens = random_lens(rng, fisheye)
        pixels = rng.uniform((0, 0), SIZE, (20, 2))
        many = lens.unproject(pixels)
        slopes = lens.pixel_jacobian(many)
        for pixel, point, slope in zip(pixels, many, slopes, strict=True):
            found = undistort(lens, *pixel.tolist())
            assert found is not None
            np.testing.assert_allclose(found[:2], point, atol=1e-9)
            np.testing.assert_allclose(found[2], slope, rtol=1e-4, atol=1e-3)
        for u, v in ((np.nan, 1.0), (np.inf, 0.0), (1e9, -1e9)):
            assert undistort(lens, u, v) is None


def test_filter_and_smoother_equal_the_batch_least_squares_solution() -> None:
    """A marker that moves so little that the cameras are linear: all states as unknowns of one dense problem."""
    rng, views = np.random.default_rng(1), cameras()
    size = 1e-4
    times = np.cumsum(rng.uniform(0.05, 0.2, 24))
    true = size * np.stack([np.sin(3 * times), np.cos(4 * times), times], axis=1)
    prior = size * np.concatenate([rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)])
    spread = (size * np.diag(np.repeat([3.0, 8.0, 20.0], 3))) ** 2
    psd = PSD * size**2 / 1e-4
    state = MarkerState(0, np.tile(prior, (3, 1)), np.tile(spread, (3, 1, 1)), psd=(psd / 10, psd, psd * 10), serial=1)
    rows = [row_of(views[k % 3], time, true[k]) for k, time in enumerate(times)]
    states = []
    for row in rows:
        state = process_row(state, row, COAST_NS)
        assert (state.time_ns, state.psd[1]) == (row.reference_ns, psd)
        assert all(factor == 1.0 for factor, _ in state.noise.values())
        states.append(state)

    count = len(times) + 1
    hessian, gradient = np.zeros((count * STATE_DIM,) * 2), np.zeros(count * STATE_DIM)
    first = slice(0, STATE_DIM)
    hessian[first, first], gradient[first] = np.linalg.inv(spread), np.linalg.inv(spread) @ prior
    before = 0.0
    for k, (row, time) in enumerate(zip(rows, np.array([row.reference_ns for row in rows]) / NANOSECONDS, strict=True)):
        here, then = (slice(i * STATE_DIM, (i + 1) * STATE_DIM) for i in (k, k + 1))
        step, drift = jerk_model(time - before)
        before = time
        weight = np.linalg.inv(psd * drift)
        rotation, centre = row.camera.pose.rotation, row.camera.pose.position
        x, y, z = -rotation @ centre
        jacobian = np.zeros((2, STATE_DIM))
        jacobian[:, :3] = np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]]) @ rotation
        trust = np.linalg.inv(np.array([row.noise[:2], row.noise[1:]]))
        hessian[then, then] += weight + jacobian.T @ trust @ jacobian
        hessian[here, here] += step.T @ weight @ step
        hessian[then, here] -= weight @ step
        hessian[here, then] -= step.T @ weight
        gradient[then] += jacobian.T @ trust @ (np.array(row.point) - (x / z, y / z))
    covariance = np.linalg.inv(hessian)
    batch = (covariance @ gradient).reshape(count, STATE_DIM)
    stds = np.sqrt(np.diag(covariance)).reshape(count, STATE_DIM)
    assert np.abs((states[-1].mean[1] - batch[-1]) / stds[-1]).max() < 2e-3
    last = covariance[-STATE_DIM:, -STATE_DIM:]
    np.testing.assert_allclose(
        states[-1].covariance[1] / np.outer(stds[-1], stds[-1]), last / np.outer(stds[-1], stds[-1]), atol=2e-3
    )
    for wanted in (1, 7, 24):
        smoothed, covariances = rts_smooth(
            np.array([one.time_ns for one in states]) / NANOSECONDS,
            np.array([one.mean[1] for one in states]),
            np.array([one.covariance[1] for one in states]),
            np.full(len(states), psd),
            wanted,
        )
        assert len(smoothed) == wanted
        assert np.abs((smoothed - batch[1 : wanted + 1]) / stds[1 : wanted + 1]).max() < 2e-3
        found = np.sqrt(np.einsum("nii->ni", covariances))
        np.testing.assert_allclose(found, stds[1 : wanted + 1], rtol=2e-3)


def test_three_rows_of_two_cameras_begin_a_track_and_mismatched_ones_do_not() -> None:
    one, other = cameras(2)
    place, speed, pull = np.array([0.2, -0.1, 0.3]), np.array([1.0, -2.0, 0.5]), np.array([3.0, 1.0, -2.0])

    def at(time: float) -> Floats:
        return np.asarray(place + speed * time + 0.5 * pull * time**2)

    rows = [row_of(one, t, at(t)) for t in (-0.09, -0.06, -0.03)] + [row_of(other, t, at(t)) for t in (-0.08, -0.04, 0)]
    found = initial_motion(rows)
    assert found is not None
    mean, covariance, factor = found
    assert factor == 1.0
    assert np.abs((mean - np.concatenate([place, speed, pull])) / np.sqrt(np.diag(covariance))).max() < 0.1
    wrong = row_of(other, 0.0, at(0.0) + 0.5)
    assert initial_motion([*rows[:-1], wrong]) is None
    assert initial_motion([row_of(one, t, at(t)) for t in (-0.09, -0.06, -0.03)] * 2) is None, "one camera has no depth"


def test_a_depth_that_was_lost_is_found_again() -> None:
    """After metres of drift along one camera's ray, the second camera's rows need more than one linearisation."""
    pose = look_at_pose(np.array([0.0, -50.0, 0.0]), np.zeros(3))
    lens = random_lens(np.random.default_rng(3))
    far = TrackingCamera("far", lens, pose, TimeMap())
    near = TrackingCamera("near", lens, look_at_pose(np.array([13.0, 3.0, 0.0]), np.zeros(3)), TimeMap())
    ray = np.array([0.0, 1.0, 0.0])
    spread = 1e-4 * np.eye(STATE_DIM)
    spread[:3, :3] += 36.0 * np.outer(ray, ray)
    mean = np.zeros(STATE_DIM)
    mean[:3] = 5.5 * ray
    state = MarkerState(0, np.tile(mean, (3, 1)), np.tile(spread, (3, 1, 1)), psd=(1e-6, 1e-5, 1e-4), serial=1)
    for k in range(1, 7):
        state = process_row(state, row_of((near, far)[k % 2], 0.02 * k, np.zeros(3), k), COAST_NS)
        assert state.time_ns == k * 20_000_000, "accepted"
    off = state.mean[state.best, :3]
    assert off @ np.linalg.solve(state.covariance[state.best, :3, :3], off) < 3.0
