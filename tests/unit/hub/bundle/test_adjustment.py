"""Algebra of the bundle adjustment: Jacobians against finite differences, sparse against dense, fixed gauge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space

from hub.bundle.adjustment import adjust, apply_step, gauge, mark_inliers, minimise
from hub.bundle.block_matrix import BlockSum, SparseCovariance
from hub.bundle.bordered_system import BAND, BorderedSystem, PathByCameras, border_block, eliminate, solve
from hub.bundle.covariance import constrained_step, inverse_blocks
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import (
    CAMERA_PARAMETERS,
    AdjustmentState,
    CameraState,
    Column,
    FreeParameters,
    LensPrior,
    Problem,
    TrackObservations,
    Trajectory,
)
from hub.bundle.residuals import predict, residual_norms
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from hub.trajectory.splines import SplineBasis
from protocols.geometry.types import Floats
from protocols.session.calibration import AdjustmentStep
from tests.support.bundles import linearise, pixels_of, spline_of
from tests.support.rigs import random_lens, random_path, random_poses


def simulated_problem(
    seed: int = 0, labels: int = 2, lens: bool = True, perturbation: float = 0.0
) -> tuple[Problem, AdjustmentState, SmoothnessPrior]:
    """Three cameras (the last a fisheye) observing two paths of 6 s with 0.5 px of noise; the true state, perturbed."""
    rng = np.random.default_rng(seed)
    lenses = [random_lens(rng), random_lens(rng), random_lens(rng, fisheye=True)]
    cameras = [
        CameraState(lens_, pose, 1.0 + rng.normal(0, 1e-4), 3.0 + rng.normal(0, 0.3), 3.0)
        for lens_, pose in zip(lenses, random_poses(rng, 3), strict=True)
    ]
    paths, rows = [], []
    for label in range(labels):
        paths.append(spline_of(random_path(rng), -1.0, 7.0, 0.4))
        for camera, eye in enumerate(cameras):
            time = np.sort(rng.uniform(0.8, 5.2, 60))
            seen = pixels_of(eye, paths[label], time)
            use = rng.random(60) > 0.1
            rows.append(TrackObservations(camera, label, time, seen + rng.normal(0, 0.5, seen.shape), use))
    problem = Problem(tuple(rows), tuple(lenses), 0, (0, 1), FreeParameters(lens=lens))
    state = AdjustmentState(tuple(cameras), tuple(paths), np.full(3, 0.5))
    size = sum(3 * path.basis.size for path in paths)
    step = rng.normal(0, perturbation, size), rng.normal(0, perturbation, len(problem.free_columns))
    prior = SmoothnessPrior(tuple(np.full(len(path.basis.interval_starts()), 30.0) for path in paths))
    return problem, apply_step(problem, state, *step), prior


def perturbed(camera: CameraState, column: int, by: float) -> CameraState:
    """The camera with one parameter changed, by the function that the solver uses."""
    guess = LensPrior(500.0, 0.1, (0.0, 0.0), 9.0, 0.0, 0.1, 0.0, 0.1)
    problem = Problem((), (camera.intrinsics,) * 2, 1, (0, 1), FreeParameters(lens=True, readout=True), (guess, guess))
    both = AdjustmentState((camera, camera), (), np.ones(2))
    columns = problem.free_columns.tolist()
    step = np.zeros(len(columns))
    step[columns.index(column)] = by
    return apply_step(problem, both, np.zeros(0), step).cameras[0]


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
@pytest.mark.parametrize("column", range(CAMERA_PARAMETERS))
def test_every_camera_jacobian_column_matches_finite_differences(lens: str, column: int) -> None:
    problem, state, _ = simulated_problem(1, perturbation=0.01)
    which = 2 if lens == "fisheye" else 1
    rows, camera = next(r for r in problem.rows if r.camera == which), state.cameras[which]
    path = state.trajectories[rows.label]
    line = linearise(rows, camera, path)
    assert line.valid.all()
    if lens == "fisheye" and column >= Column.P1:
        assert not line.camera_jacobian[:, :, column].any()  # never free
        return
    step = 1e-6
    ahead, behind = (linearise(rows, perturbed(camera, column, sign * step), path).residual for sign in (1, -1))
    expected = (ahead - behind) / (2 * step)
    largest = float(np.abs(expected).max())
    assert largest > 1e-4
    np.testing.assert_allclose(line.camera_jacobian[:, :, column], expected, rtol=2e-5, atol=min(2e-3, 0.01 * largest))


@pytest.mark.parametrize("which", [0, 2])
def test_the_point_jacobian_matches_finite_differences(which: int) -> None:
    problem, state, _ = simulated_problem(2)
    rows, camera = next(r for r in problem.rows if r.camera == which), state.cameras[which]
    path = state.trajectories[rows.label]
    line = linearise(rows, camera, path)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        ahead, behind = (linearise(rows, camera, replace(path, control=path.control + s * step)) for s in (1, -1))
        difference = (ahead.residual - behind.residual) / 2e-6
        np.testing.assert_allclose(line.point_jacobian[:, :, axis], difference, rtol=1e-5, atol=1e-3)


def test_a_fisheye_point_on_the_axis_has_finite_jacobians() -> None:
    _, state, _ = simulated_problem(3)
    camera = state.cameras[2]
    basis = SplineBasis.covering(np.array([0.0]), np.array([6.0]), 1.0)
    ahead = camera.pose.world_from_camera(np.array([[0.0, 0.0, 4.0]]))
    path = Trajectory(basis, np.repeat(ahead, basis.size, axis=0))
    rows = TrackObservations(2, 0, np.array([2.5, 3.0]), np.zeros((2, 2)), np.ones(2, dtype=bool))
    line = linearise(rows, camera, path)
    assert np.isfinite(line.camera_jacobian).all()
    assert np.isfinite(line.residual).all()


def test_a_point_behind_the_camera_is_not_valid_and_not_nan() -> None:
    problem, state, prior = simulated_problem(3)
    camera = state.cameras[1]
    behind = replace(camera, pose=replace(camera.pose, position=camera.pose.position * -1.0))
    cameras = (state.cameras[0], behind, state.cameras[2])
    line = linearise(problem.rows[1], behind, state.trajectories[0])
    assert not line.valid.any()
    system, cost = build_system(problem, replace(state, cameras=cameras), prior, robust=True)
    assert np.isfinite(cost)
    for part in (dense(system), system.gradient_path, system.gradient_cameras):
        assert np.isfinite(part).all()


@pytest.mark.parametrize("robust", [True, False])
def test_the_gradient_is_half_the_derivative_of_the_cost(robust: bool) -> None:
    problem, state, prior = simulated_problem(4, perturbation=2e-3)
    system, _ = build_system(problem, state, prior, robust)
    rng = np.random.default_rng(0)
    path_size, width = len(system.gradient_path), len(system.gradient_cameras)
    directions = [(rng.normal(0, 1, path_size), np.zeros(width))]
    directions += [(np.zeros(path_size), row) for row in np.eye(width)]
    for path_step, camera_step in directions:
        size = 1e-6
        ahead, behind = (
            build_system(
                problem, apply_step(problem, state, s * size * path_step, s * size * camera_step), prior, robust
            )[1]
            for s in (1, -1)
        )
        slope = 0.5 * (ahead - behind) / (2 * size)
        ours = float(system.gradient_path @ path_step + system.gradient_cameras @ camera_step)
        assert ours == pytest.approx(slope, rel=2e-4, abs=1e-2 + 1e-4 * abs(ours))


def dense(system: BorderedSystem) -> Floats:
    size = system.band.shape[1]
    full = np.zeros((size, size))
    for distance in range(BAND):
        rows = np.arange(size - distance)
        values = system.band[BAND - 1 - distance, distance:]
        full[rows, rows + distance] = full[rows + distance, rows] = values
    border = np.zeros((size, system.corner.size))
    for part, columns, block in system.border.parts:
        border[part, columns] = block
    return np.block([[full, border], [border.T, system.corner.dense()]])


def test_the_banded_normal_matrix_equals_the_dense_one() -> None:
    problem, state, prior = simulated_problem(5)
    system, _ = build_system(problem, state, SmoothnessPrior(tuple(0 * w for w in prior.weights)), robust=False)
    columns = problem.free_columns
    sizes = [3 * path.basis.size for path in state.trajectories]
    blocks = []
    for rows in problem.rows:
        line = linearise(rows, state.cameras[rows.camera], state.trajectories[rows.label])
        jacobian = np.zeros((len(line.index), 2, sum(sizes) + 3 * CAMERA_PARAMETERS))
        for n, first in enumerate(line.index):
            for k in range(4):
                at = sum(sizes[: rows.label]) + 3 * (first + k)
                jacobian[n, :, at : at + 3] = line.weights[n, k] * line.point_jacobian[n]
        at = sum(sizes) + rows.camera * CAMERA_PARAMETERS
        jacobian[:, :, at : at + CAMERA_PARAMETERS] = line.camera_jacobian
        blocks.append(jacobian.reshape(-1, jacobian.shape[2]) / 0.5)
    full = np.concatenate(blocks)[:, np.r_[np.arange(sum(sizes)), sum(sizes) + columns]]
    normal = full.T @ full
    ours = dense(system)
    for column, _ in enumerate(columns):  # the priors add to the diagonal only
        at = sum(sizes) + column
        normal[at, at] = ours[at, at]
    np.testing.assert_allclose(ours, normal, rtol=1e-8, atol=1e-6 * np.abs(normal).max())


def test_the_priors_add_their_information() -> None:
    problem, state, prior = simulated_problem(5)
    loose = replace(problem, free_parameters=FreeParameters(lens=True, rate_std=1e9, focal_std=1e9, k1_std=1e9))
    with_priors, _ = build_system(problem, state, prior, robust=False)
    without, _ = build_system(loose, state, prior, robust=False)
    gained = with_priors.corner.diagonal() - without.corner.diagonal()
    free_parameters = problem.free_parameters
    for value, column in zip(gained, problem.free_columns, strict=True):
        std = {
            Column.RATE: free_parameters.rate_std,
            Column.FOCAL: free_parameters.focal_std,
            Column.K1: free_parameters.k1_std,
        }.get(column % CAMERA_PARAMETERS)
        assert value == pytest.approx(0.0 if std is None else std**-2, rel=1e-3, abs=1e-3)


def test_an_unmeasured_lens_is_free_under_its_own_prior_and_the_others_are_not() -> None:
    problem, state, prior = simulated_problem(5, lens=False)
    lens = state.cameras[1].intrinsics
    guess = LensPrior(1.1 * lens.focal, 0.2, (300.0, 250.0), 5.0, 0.05, 0.1, -0.02, 0.04)
    one = replace(problem, lens_priors=(None, guess, None))
    added = set(one.free_columns.tolist()) - set(problem.free_columns.tolist())
    assert added == {
        CAMERA_PARAMETERS + column for column in (Column.FOCAL, Column.K1, *range(Column.CENTRE, CAMERA_PARAMETERS))
    }
    loose = replace(
        one, lens_priors=(None, LensPrior(lens.focal, 1e9, (0.0, 0.0), 1e9, 0.0, 1e9, 0.0, 1e9, 1e9, 1e9, 1e9), None)
    )
    (with_prior, cost), (without, bare) = (build_system(p, state, prior, robust=False) for p in (one, loose))
    gained = dict(zip(one.free_columns.tolist(), with_prior.corner.diagonal() - without.corner.diagonal(), strict=True))
    stds = {
        Column.FOCAL: 0.2,
        Column.CENTRE: 5.0,
        Column.CENTRE + 1: 5.0,
        Column.K1: 0.1,
        Column.K2: 0.04,
        Column.K3: 0.01,
        Column.ASPECT: 2e-3,
        Column.P1: 2e-3,
        Column.P1 + 1: 2e-3,
    }
    for column, value in gained.items():
        std = stds.get(column - CAMERA_PARAMETERS)
        assert value == pytest.approx(0.0 if std is None else std**-2, rel=1e-3, abs=1e-3)
    off = (lens.matrix[0, 2] - 300.0, lens.matrix[1, 2] - 250.0)
    expected = (np.log(1.1) / 0.2) ** 2 + (off[0] ** 2 + off[1] ** 2) / 25.0
    expected += ((lens.distortions[0] - 0.05) / 0.1) ** 2 + ((lens.distortions[1] + 0.02) / 0.04) ** 2
    assert cost - bare == pytest.approx(expected, rel=1e-6)


def test_lens_priors_that_are_all_none_change_nothing() -> None:
    problem, state, _ = simulated_problem(6, lens=False, perturbation=1e-3)
    (_, plain, _), (_, with_priors_given, _) = (
        adjust(p, state) for p in (problem, replace(problem, lens_priors=(None, None, None)))
    )
    for one, other in zip(plain.cameras, with_priors_given.cameras, strict=True):
        np.testing.assert_array_equal(one.pose.rotation, other.pose.rotation)
        np.testing.assert_array_equal(one.pose.position, other.pose.position)
        assert (one.offset, one.rate) == (other.offset, other.rate)
        np.testing.assert_array_equal(one.intrinsics.matrix, other.intrinsics.matrix)


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_the_bordered_solution_equals_the_dense_one(damping: float) -> None:
    problem, state, prior = simulated_problem(6, perturbation=1e-3)
    system, _ = build_system(problem, state, prior, robust=True)
    tangent = null_space(gauge(problem, state))
    path, cameras = solve(system, damping, gauge(problem, state))
    full, size = dense(system), system.band.shape[1]
    full += damping * np.diag(np.diag(full))
    lift = np.block([[np.eye(size), np.zeros((size, tangent.shape[1]))], [np.zeros((len(tangent), size)), tangent]])
    right = -np.r_[system.gradient_path, system.gradient_cameras]
    expected = lift @ np.linalg.solve(lift.T @ full @ lift, lift.T @ right)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(np.r_[path, cameras], expected, rtol=1e-4, atol=1e-5 * scale)


def test_without_free_cameras_only_the_path_moves() -> None:
    problem, state, prior = simulated_problem(6, perturbation=1e-3)
    fixed = replace(problem, free_parameters=FreeParameters(pose=False, clock=False, lens=False))
    assert gauge(fixed, state).shape == (0, 0)
    system, before = build_system(fixed, state, prior, robust=False)
    path, cameras = solve(system, 0.0, np.zeros((0, 0)))
    assert len(cameras) == 0
    assert build_system(fixed, apply_step(fixed, state, path, cameras), prior, robust=False)[1] < before


def testinverse_blocks_equal_those_of_the_dense_inverse() -> None:
    problem, state, prior = simulated_problem(7)
    system, _ = build_system(problem, state, prior, robust=False)
    size = system.band.shape[1]
    inverse = np.linalg.inv(dense(system)[:size, :size])
    blocks = inverse_blocks(system.band)
    padded = np.zeros((BAND * (len(blocks) + 1),) * 2)
    padded[:size, :size] = inverse
    for i, block in enumerate(blocks):
        part = slice(BAND * i, BAND * i + 2 * BAND)
        inside = np.arange(BAND * i, BAND * i + 2 * BAND) < size
        mask = np.outer(inside, inside)
        np.testing.assert_allclose(block[mask], padded[part, part][mask], rtol=1e-3, atol=1e-4 * np.abs(inverse).max())


def test_a_path_past_a_cameras_centre_leaves_the_stds_and_steps_of_others_as_they_are() -> None:
    problem, state, prior = simulated_problem(7)
    system, _ = build_system(problem, state, prior, robust=False)
    before, step = inverse_blocks(system.band), solve(system, 0.0, gauge(problem, state))[0]
    system.band[-1, -1] = 1e25 * system.band[-1].max()
    after, held = inverse_blocks(system.band), solve(system, 0.0, gauge(problem, state))[0]
    np.testing.assert_allclose(after[0, :BAND, :BAND], before[0, :BAND, :BAND], rtol=0.1)
    assert np.linalg.norm(held[:BAND]) > 0.1 * np.linalg.norm(step[:BAND])


def test_the_schur_complement_equals_the_dense_one() -> None:
    problem, state, prior = simulated_problem(8)
    system, _ = build_system(problem, state, prior, robust=False)
    parts = eliminate(system)
    size = system.band.shape[1]
    full = dense(system)
    expected = full[size:, size:] - full[size:, :size] @ np.linalg.solve(full[:size, :size], full[:size, size:])
    np.testing.assert_allclose(parts.reduced.dense(), expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_border_blocks_take_rows_in_any_order() -> None:
    rng = np.random.default_rng(0)
    index, weights = rng.integers(0, 20, 50), rng.random((50, 4))
    blocks = rng.normal(size=(50, 3, 5))
    out = border_block(index, weights, blocks.transpose(1, 2, 0), 3 * 24)
    expected = np.zeros((24, 3, 5))
    for n in range(50):
        for k in range(4):
            expected[index[n] + k] += weights[n, k] * blocks[n]
    np.testing.assert_allclose(out, expected.reshape(-1, 5), atol=1e-12)


def test_steps_perpendicular_to_the_gauge_keep_it() -> None:
    problem, state, _ = simulated_problem(9)
    tangent = null_space(gauge(problem, state))
    np.testing.assert_allclose(tangent.T @ tangent, np.eye(tangent.shape[1]), atol=1e-12)
    assert tangent.shape == (len(problem.free_columns), len(problem.free_columns) - 7)
    rng = np.random.default_rng(0)
    step = tangent @ rng.normal(0, 1e-5, tangent.shape[1])
    size = sum(3 * path.basis.size for path in state.trajectories)
    after = apply_step(problem, state, np.zeros(size), step)
    first, second = problem.anchors
    np.testing.assert_array_equal(after.cameras[first].pose.rotation, state.cameras[first].pose.rotation)
    np.testing.assert_allclose(after.cameras[first].pose.position, state.cameras[first].pose.position, atol=1e-18)
    apart = [np.linalg.norm(s.cameras[second].pose.position - s.cameras[first].pose.position) for s in (state, after)]
    assert apart[1] == pytest.approx(apart[0], abs=1e-9)
    assert after.cameras[0].offset == state.cameras[0].offset


def test_the_adjustment_holds_the_scale_over_many_steps() -> None:
    """The fixed distance must not drift, although the motion prior favours a small scale."""
    problem, state, _ = simulated_problem(10, lens=False, perturbation=3e-3)
    first, second = problem.anchors
    before = np.linalg.norm(state.cameras[second].pose.position - state.cameras[first].pose.position)
    _, after, _ = adjust(problem, state)
    now = np.linalg.norm(after.cameras[second].pose.position - after.cameras[first].pose.position)
    assert now == pytest.approx(before, rel=1e-3)


def test_the_adjustment_converges_to_the_truth_from_a_perturbed_state() -> None:
    problem, start, _ = simulated_problem(11, lens=False, perturbation=5e-3)
    _, truth, _ = simulated_problem(11, lens=False)
    solved, state, _ = adjust(problem, start)
    for rows in solved.rows:
        norms = residual_norms(rows, state.cameras[rows.camera], state.trajectories[rows.label])
        assert np.median(norms) < 1.0
    gap = [c.offset - t.offset for c, t in zip(state.cameras, truth.cameras, strict=True)]
    assert np.abs(gap).max() < 5e-3
    np.testing.assert_allclose(state.sigma, 0.5, rtol=0.25)


def test_outlier_rows_are_rejected_and_inliers_used() -> None:
    problem, start, _ = simulated_problem(12, labels=1, lens=False, perturbation=1e-3)
    rng = np.random.default_rng(1)
    corrupted, outlier_masks = [], []
    for rows in problem.rows:
        is_outlier = rng.random(len(rows.time)) < 0.1
        pixels = rows.pixels + np.where(is_outlier[:, None], rng.uniform(40, 200, rows.pixels.shape), 0.0)
        corrupted.append(replace(rows, pixels=pixels, use=np.ones(len(is_outlier), dtype=bool)))
        outlier_masks.append(is_outlier)
    solved, _, _ = adjust(replace(problem, rows=tuple(corrupted)), start)
    for rows, is_outlier in zip(solved.rows, outlier_masks, strict=True):
        assert not rows.use[is_outlier].any()
        assert rows.use[~is_outlier].mean() > 0.95


def test_a_row_at_which_the_path_has_collapsed_onto_its_camera_is_not_used() -> None:
    """It fits at any pose: of a rig of walkers it told a camera's place to 5e-9 baselines, and its lag to 0 s."""
    problem, state, _ = simulated_problem(12, labels=1, lens=False)
    rows, camera = problem.rows[0], state.cameras[0]
    point = state.trajectories[0].at(camera.reference_time(rows.time[7:8]))[0]
    pose = replace(camera.pose, position=point - 1e-9 * camera.pose.rotation[2])
    state = replace(state, cameras=(replace(camera, pose=pose), *state.cameras[1:]))
    pixels = rows.pixels.copy()
    pixels[7] = predict(rows, state.cameras[0], state.trajectories[0])[7]
    problem = replace(problem, rows=(replace(rows, pixels=pixels), *problem.rows[1:]))
    assert residual_norms(problem.rows[0], state.cameras[0], state.trajectories[0])[7] == 0.0
    marked = mark_inliers(problem, state)
    assert not marked.rows[0].use[7]
    assert all(part.use.mean() > 0.95 for part in marked.rows[1:])


def test_the_time_offset_column_is_the_velocity() -> None:
    """A clock offset moves the point along its path: the unit is pixels per second."""
    problem, state, _ = simulated_problem(13)
    rows, camera = problem.rows[0], state.cameras[0]
    line = linearise(rows, camera, state.trajectories[0])
    lever = (rows.time[rows.use] - camera.centre)[:, None]
    np.testing.assert_allclose(
        line.camera_jacobian[:, :, Column.RATE], line.camera_jacobian[:, :, Column.OFFSET] * lever, atol=1e-9
    )


def test_a_row_that_a_clock_moves_past_the_end_of_the_path_still_has_a_gradient() -> None:
    problem, state, _ = simulated_problem(6)
    rows = problem.rows[0]
    camera, path = state.cameras[rows.camera], state.trajectories[rows.label]
    first = float(np.min(rows.time[rows.use]))
    # The camera's clock is shifted until its first row lies a fifth of a knot interval before the path.
    late = float(camera.reference_time(np.array([first]))[0]) - path.basis.begin + 0.2 * path.basis.spacing
    early = replace(camera, offset=camera.offset - late)
    assert np.isnan(path.at(early.reference_time(np.array([first])))).all()
    line = linearise(rows, early, path)
    assert line.valid.all()
    assert np.isfinite(line.residual).all()
    far = linearise(rows, replace(early, offset=early.offset - path.basis.spacing), path)
    assert not far.valid.all()


def street_system(cameras: int, width: int = 8, size: int = 6) -> BorderedSystem:
    """Of labels that three neighbouring cameras observe each, the cameras in no order."""
    rng = np.random.default_rng(cameras)
    order, step = rng.permutation(cameras), 3 * size
    paths = step * (cameras - 2)
    whole, parts = np.zeros((paths + width * cameras,) * 2), []
    for label in range(cameras - 2):
        columns = np.concatenate([width * camera + np.arange(width) for camera in order[label : label + 3]])
        for camera in range(3):
            for first in np.repeat(np.arange(size - 3), 8):
                row = np.zeros((2, len(whole)))
                row[:, step * label + 3 * first + np.arange(12)] = rng.normal(size=(2, 12))
                row[:, paths + columns[width * camera : width * (camera + 1)]] = rng.normal(size=(2, width))
                whole += row.T @ row
        part = slice(step * label, step * (label + 1))
        parts.append((part, columns, whole[part, paths + columns]))
    band = np.zeros((BAND, paths))
    for distance in range(BAND):
        band[BAND - 1 - distance, distance:] = np.diagonal(whole[:paths, :paths], distance)
    border, gradient = PathByCameras(tuple(parts), width * cameras), rng.normal(size=len(whole))
    own = [np.arange(width * camera, width * (camera + 1)) for camera in range(cameras)]
    corner = tuple((columns, whole[np.ix_(paths + columns, paths + columns)]) for columns in own)
    system = BlockSum(np.zeros(width * cameras), corner)
    return BorderedSystem(band, border, system, gradient[:paths], gradient[paths:])


@pytest.mark.parametrize("held", [True, False])
def test_the_step_of_cameras_that_overlap_few_others_equals_the_dense_one(
    held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = street_system(24)
    fixed = np.zeros((7 if held else 0, system.corner.size))
    if held:
        fixed[np.arange(6), 40 + np.arange(6)] = 1.0
        fixed[6, 83:86] = [0.6, 0.0, -0.8]
    banded = solve(system, 1e-3, fixed)
    assert eliminate(system).reduced.factored() is not None  # else it is dense
    monkeypatch.setattr(BlockSum, "factored", lambda matrix: None)
    for ours, expected in zip(banded, solve(system, 1e-3, fixed), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    assert np.abs(fixed @ banded[1]).max(initial=0.0) < 1e-12 * np.abs(banded[1]).max()
    monkeypatch.undo()
    system.corner.on_diagonal[30] = -1e9
    with pytest.raises(np.linalg.LinAlgError):
        solve(system, 1e-3, fixed)


@pytest.mark.parametrize("kind", ["few cameras", "all cameras", "none"])
def test_the_covariance_of_cameras_that_overlap_few_others_equals_the_dense_one(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, normal = np.random.default_rng(5), eliminate(street_system(24)).reduced
    rows = np.zeros((0 if kind == "none" else 4, normal.size))
    if kind == "few cameras":
        rows[:, 40:52] = rng.normal(size=(4, 12))
    elif kind == "all cameras":
        rows = rng.normal(size=(4, normal.size))
    right, values = rng.normal(size=normal.size), np.zeros(len(rows))
    step, sparse = constrained_step(normal, right, rows, values)
    assert isinstance(sparse, SparseCovariance)
    monkeypatch.setattr(BlockSum, "factored", lambda matrix: None)
    expected, dense_one = constrained_step(normal, right, rows, values)
    every = np.arange(normal.size)
    limits = {"rtol": 1e-6, "atol": 1e-9 * np.abs(dense_one.diagonal()).max()}
    np.testing.assert_allclose(step, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(sparse.diagonal(), dense_one.diagonal(), **limits)
    for columns in (every, every[40:52], every[[3, 150]], every[:0]):
        np.testing.assert_allclose(sparse.submatrix(columns), dense_one.submatrix(columns), **limits)
    block = rng.normal(size=(normal.size, 3))
    np.testing.assert_allclose(sparse @ block, dense_one @ block, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


def test_steps_that_go_too_far_are_cut_to_the_parabola_s_minimum() -> None:
    """A strong prior, whose metric follows the path: 53 steps without."""
    problem, state, _ = simulated_problem(3, lens=False, perturbation=1e-3)
    prior = estimate_smoothness(problem, state)
    prior = replace(prior, weights=tuple(3000.0 * one for one in prior.weights))
    steps: list[AdjustmentStep] = []
    minimise(problem, state, prior, False, 100, 1e-9, steps, False)
    assert len(steps) < 30


def test_where_nothing_pulls_the_state_stays() -> None:
    """Without rows in use or a prior the step is exactly 0: no parabola goes through it."""
    problem, state, prior = simulated_problem(3, lens=False)
    problem = replace(problem, rows=tuple(rows.using(np.zeros_like(rows.use)) for rows in problem.rows))
    prior = replace(prior, weights=tuple(0.0 * one for one in prior.weights))
    kept = replace(problem, free_parameters=FreeParameters(pose=False, clock=False))
    found = minimise(kept, state, prior, False, 5, 1e-9, [], False)
    for before, after in zip(state.trajectories, found.trajectories, strict=True):
        np.testing.assert_array_equal(before.control, after.control)
