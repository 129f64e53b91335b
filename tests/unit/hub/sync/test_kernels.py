"""The compiled kernels do what numpy does without them; they are compiled for this test where there is a compiler."""

from __future__ import annotations

import shutil
import struct
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge.uav.base import Box
from edge.uav.correlation.features import cell_features
from edge.uav.ground import colour_table
from edge.uav.ground.ego_motion import EgoMotion, _solve_pose
from edge.uav.ground.image_plane import ImagePlane
from edge.uav.ground.photometric import _blurred_colours
from edge.uav.ground.plane_pose import PlaneHomography, PlanePose
from edge.uav.ground.road_map import RoadMap
from edge.uav.ground_tracker import GroundTracker
from edge.uav.prediction import paths
from edge.uav.prediction.detection_probability import open_road
from edge.uav.prediction.particle_filter import densest_cluster
from edge.uav.target.motion_history import MotionHistory
from hatch_build import FLAGS
from hub.bundle.bordered_system import PathBlocks, add_rows
from hub.bundle.problem import CameraState, Column, TrackObservations, Trajectory, UsedRows
from hub.bundle.residuals import SplineSupport, StackedTrajectories, evaluate_points, jacobians
from hub.sync.lag_scan import smallest_eigenvalues
from hub.sync.pair_solver import solve_pair
from hub.tracking.marker_filter import MarkerState, process_row, smooth_states
from hub.trajectory.image_tracks import neighbour_test
from hub.trajectory.splines import SplineBasis, fit_spline, weighted_sums
from hub.two_view.relative_pose import homography_residual
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import kernels, so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.validation.layouts import Layouts
from tests.bench.pair_trials import MATRIX, Regime, make_trial
from tests.unit.hub.tracking.test_marker_filter import cameras, row_of
from tests.unit.protocols.test_layouts import NASTY_NUMBERS as NASTY
from tests.unit.protocols.test_layouts import whole

_SOURCE = Path(kernels.__file__).with_name("kernels.c")
Both = Callable[[Callable[[], npt.NDArray[Any]]], tuple[npt.NDArray[Any], npt.NDArray[Any]]]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here: numpy is what runs")
    out = tmp_path_factory.mktemp("kernels") / "libkernels.so"
    subprocess.run([compiler, *FLAGS, "-Wall", "-Wextra", "-Werror", "-o", out, _SOURCE, "-lm"], check=True)
    return out


@pytest.fixture
def both(library: Path, monkeypatch: pytest.MonkeyPatch) -> Both:
    """What a function gives by the kernels, and by numpy."""
    monkeypatch.setattr(kernels, "_library", kernels.load(library))

    def run(function: Callable[[], npt.NDArray[Any]]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        found = []
        for available in (True, False):
            monkeypatch.setattr(kernels, "AVAILABLE", available)
            found.append(np.asarray(function()))
        return found[0], found[1]

    return run


@pytest.fixture
def basis() -> SplineBasis:
    return SplineBasis.spanning(np.array([0.0, 3.0, 5.5]), np.array([2.0, 5.5, 9.0]), 0.3)


def times(rng: np.random.Generator) -> Floats:
    """In no order, some outside the stretches or unknown."""
    return np.concatenate([rng.uniform(-1.0, 10.0, 300), [np.nan, 0.0, 2.0, 5.5, 9.0, np.inf]])


@pytest.mark.parametrize("extrapolation", [0.0, 0.5])
def test_splines_are_evaluated_alike(both: Both, basis: SplineBasis, extrapolation: float) -> None:
    rng = np.random.default_rng(1)
    time, control = times(rng), rng.normal(size=(basis.size, 2))
    inside = basis.weights_and_derivatives(time, extrapolation)[3]
    assert 0 < inside.sum() < len(time)
    for function in (
        lambda: basis.weights_and_derivatives(time, extrapolation)[3],
        lambda: basis.weights_and_derivatives(time, extrapolation)[0][inside],
        lambda: basis.weights_and_derivatives(time, extrapolation)[1][inside],
        lambda: basis.weights_and_derivatives(time, extrapolation)[2][inside],
        lambda: basis.evaluate(control, time, 1),
        lambda: weighted_sums(control, *basis.weights(time)[:2])[inside],
        lambda: np.stack(basis.evaluate_with_derivatives(basis.polynomials(control), time)),
    ):
        np.testing.assert_allclose(*both(function), rtol=1e-12, atol=1e-12)


def test_splines_are_fitted_alike(both: Both, basis: SplineBasis) -> None:
    rng = np.random.default_rng(2)
    time = times(rng)
    values, weight = rng.normal(size=(len(time), 3)), rng.uniform(0.0, 1.0, len(time)).round(1)
    np.testing.assert_allclose(*both(lambda: fit_spline(basis, basis.weights(time), values, weight, 1e-2)), rtol=1e-9)


def test_eigenvalues_are_those_of_numpy(both: Both) -> None:
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 37, 2, 60))
    monomials = np.stack([x * x, x * y, x, y * y, y, np.ones_like(x)])  # of both cameras at 60 times of 37 lags
    moments = np.einsum("imt,jmt->ijm", monomials[:, :, 0], monomials[:, :, 1])
    np.testing.assert_allclose(*both(lambda: smallest_eigenvalues(moments, 0.02, 0.03)), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("count", [8, 9, 301])
def test_planes_leave_the_same_residual(both: Both, count: int) -> None:
    rng = np.random.default_rng(count)
    a = rng.normal(0.0, 100.0, (count, 2))
    b = a @ np.array([[0.9, 0.2], [-0.1, 1.1]]) + rng.normal(0.0, 2.0, (count, 2)) + 50.0
    np.testing.assert_allclose(*both(lambda: np.asarray(homography_residual(a, b))), rtol=1e-6)


def test_neighbours_are_judged_alike(both: Both) -> None:
    rng = np.random.default_rng(5)
    time = np.sort(rng.uniform(0.0, 4.0, 120))
    points = np.stack([np.sin(time), np.cos(time)], axis=1)
    points[rng.random(120) < 0.2] += 1.0
    by_kernels, by_numpy = both(lambda: neighbour_test(time, points, 1e-3))
    assert 0 < by_numpy.sum() < 120
    np.testing.assert_array_equal(by_kernels, by_numpy)


def test_rows_of_several_labels_are_on_their_paths_alike(both: Both) -> None:
    rng = np.random.default_rng(9)
    bases = [SplineBasis.covering(np.array([0.0, 3.0]), np.array([2.0, 4.0 + k]), 0.3) for k in range(3)]
    paths = {4 + k: Trajectory(basis, rng.normal(size=(basis.size, 3))) for k, basis in enumerate(bases)}
    parts = [
        TrackObservations(0, label, np.sort(rng.uniform(-1.0, 7.0, count)), np.zeros((count, 2)), np.full(count, True))
        for label, count in ((6, 30), (4, 1), (5, 20))
    ]
    rows, stacked = UsedRows.of(parts), StackedTrajectories.of(paths)
    times = np.where(np.arange(len(rows.time)) == 7, np.nan, rows.time)
    for part in range(4):
        by_kernels, by_numpy = both(lambda part=part: np.asarray(stacked.support(rows, times)[part]))  # type: ignore[misc]
        np.testing.assert_allclose(by_kernels, by_numpy, rtol=1e-12, atol=1e-12)
    index, weights, _, inside = stacked.support(rows, rows.time)
    at = slice(31, 51)  # of label 5
    expected = paths[5].at(rows.time[at])
    used = inside[at] & np.isfinite(expected[:, 0])
    assert 5 < used.sum() < 20
    found = weighted_sums(stacked.control, index, weights)[at]
    np.testing.assert_allclose(found[used], expected[used], atol=1e-12)


@pytest.mark.parametrize("others", [1, 12, 22])
def test_rows_of_the_adjustment_add_up_alike(both: Both, others: int) -> None:
    rng = np.random.default_rng(6)
    index, weights, terms = rng.integers(0, 20, 90), rng.random((90, 4)), rng.normal(size=(2, 3 + others, 90))
    ends = np.array([40, 40, 90])

    def sums() -> Floats:
        blocks = [PathBlocks(24) for _ in range(3)]
        to = [(7 * k, one) for k, one in enumerate(blocks)]
        crossed, gram = add_rows(to, ends, index + np.repeat([0, 7, 14], np.diff(ends, prepend=0)), weights, terms)
        every = [*(one.band() for one in blocks), *(one for _, one in crossed), gram]
        return np.concatenate([one.ravel() for one in every])

    np.testing.assert_allclose(*both(sums), rtol=1e-10, atol=1e-10)


def test_lenses_bend_alike(both: Both) -> None:
    lens = Intrinsics(800, 600, MATRIX, np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01]))
    normalised = np.random.default_rng(7).uniform(-0.5, 0.5, (50, 2))
    for part in (0, 1):
        np.testing.assert_allclose(*both(lambda part=part: lens.distort(normalised)[part]), rtol=1e-13, atol=1e-13)  # type: ignore[misc]


@pytest.mark.parametrize("bent", [[0.0] * 5, [-0.4, 0.05, 1e-3, -2e-3, 0.01]])
def test_rows_are_projected_alike_with_all_derivatives(both: Both, bent: list[float]) -> None:
    rng = np.random.default_rng(8)
    lens = Intrinsics(800, 600, MATRIX + np.array([[0.0, 2.0, 0.0]] + [[0.0] * 3] * 2), np.array(bent))
    pose = Pose(so3.exp(np.array([0.2, -0.1, 0.3])), np.array([0.5, -0.2, -4.0]))
    points = rng.normal(size=(200, 3)) * np.array([3.0, 3.0, 4.0])  # some behind the camera or beyond the fold
    points[5] = np.nan
    control, index, weights = rng.normal(size=(24, 3)), rng.integers(0, 20, 200), rng.random((200, 4))
    camera = CameraState(lens, pose, 1.0001, 0.3, 5.0, 0.01)

    def rows() -> Floats:
        support = SplineSupport(control, index, weights, weights[::-1].copy())
        given = rng.random(200) < 2.0, np.linspace(0.0, 9.0, 200), np.full((200, 2), 300.0), support, np.ones(200)
        found = evaluate_points(camera, points, *given)
        by = jacobians(found, camera, [*range(10), Column.READOUT]), jacobians(found, camera, [4, Column.OFFSET])
        every = *by, found.residual[None], found.normalised[None], found.camera_points[None]
        return np.concatenate([found.valid, *(one[..., found.valid].ravel() for one in every)])

    np.testing.assert_allclose(*both(rows), rtol=1e-10, atol=1e-10)
    pixels = both(lambda: lens.project(points))
    assert 20 < np.isnan(pixels[0][:, 0]).sum() < 150
    np.testing.assert_allclose(*pixels, rtol=1e-12)


@pytest.mark.parametrize("cell", [4, 5, 6])
def test_cells_have_the_same_orientations(both: Both, cell: int) -> None:
    patch = cv2.GaussianBlur(np.random.default_rng(9).integers(0, 256, (60, 120, 3), dtype=np.uint8), (5, 5), 1.5)
    np.testing.assert_array_equal(*both(lambda: cell_features(np.asarray(patch, np.uint8), cell)))


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_pair_has_the_same_solution(both: Both, calibrated: bool) -> None:
    trial = make_trial(Regime(dropped=0.2, outliers=0.05, gaps=2), 41)

    def solution() -> Floats:
        a, b = trial.smoothed()
        fit = solve_pair({"x": a, "y": a}, {"x": b, "y": b}, ("a", "b"), calibrated=calibrated).fit
        assert fit is not None
        return np.array([fit.offset, fit.rate, fit.residual_px, fit.lag_std, *fit.geometry.matrix.ravel()])

    np.testing.assert_allclose(*both(solution), rtol=1e-6)


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_camera_over_the_plane_is_fitted_alike(both: Both, calibrated: bool) -> None:
    rng = np.random.default_rng(11)
    ground = rng.uniform(-30.0, 30.0, (90, 2))
    pose = PlanePose(so3.exp(np.array([0.3, -0.2, 1.0])), np.array([2.0, -1.0, -40.0]))
    at = ground @ pose.matrix[:, :2].T + pose.matrix[:, 2]
    seen = at[:, :2] / at[:, 2:] + rng.normal(0.0, 1e-3, (90, 2)) + 0.05 * (rng.random((90, 1)) < 0.1)
    ground[5] = 1e4  # behind the camera, or nearly
    other = PlanePose(so3.exp(np.array([0.31, -0.19, 1.01])), pose.centre + 0.3)
    none, attitude = (None, None), ((pose.rotation, np.full(3, 0.02)), (pose.centre, np.full(3, 1.0)))

    def fitted() -> Floats:
        if calibrated:
            return _solve_pose(other, ground, seen, 1e-3, other.prediction_std(0.03, 40.0), attitude).matrix
        guess = PlaneHomography(other.matrix / np.cbrt(np.linalg.det(other.matrix)))
        return _solve_pose(guess, ground, seen, 1e-3, guess.prediction_std(0.03, 1.0), none).matrix

    np.testing.assert_allclose(*both(fitted), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("bent", [None, [0.0] * 5, [-0.3, 0.12, 1e-3, -5e-4, 0.02], [-0.4, 0.0, 0.0, 0.0, 0.0]])
def test_the_ground_is_projected_alike(both: Both, bent: list[float] | None) -> None:
    matrix = np.array([[300.0, 0.0, 319.5], [0.0, 310.0, 239.5], [0.0, 0.0, 1.0]])
    plane = ImagePlane((640, 480), None if bent is None else Intrinsics(640, 480, matrix, np.array(bent)))
    pose = PlanePose(so3.exp(np.array([1.2, 0.1, 0.4])), np.array([0.0, 0.0, -30.0]))
    ground = np.random.default_rng(12).uniform(-400.0, 400.0, (300, 2))
    ground[7] = np.nan
    compiled, alone = both(lambda: plane.project(pose.matrix, ground))
    assert 20 < np.isfinite(alone).all(axis=1).sum() < 280
    np.testing.assert_allclose(compiled, alone, rtol=1e-11, atol=1e-8)


def test_colours_and_maps_are_looked_up_alike(both: Both) -> None:
    rng = np.random.default_rng(13)
    image = np.asarray(rng.integers(0, 256, (40, 60, 3)), np.uint8)
    table, weights = rng.normal(size=16**3).astype(np.float32), rng.random((40, 60))
    np.testing.assert_array_equal(*both(lambda: colour_table.values(table, image[::2], 4)))
    np.testing.assert_array_equal(*both(lambda: colour_table.histogram(image, None, 4, 0.2)))
    np.testing.assert_allclose(*both(lambda: colour_table.histogram(image, weights, 5, 0.25)), rtol=1e-12)
    road = RoadMap(np.zeros(2))
    road._log_odds[:] = rng.normal(size=road._log_odds.shape)
    road._log_ratio_table = table
    mesh = np.stack(np.meshgrid(np.linspace(-5.0, 64.0, 7), np.linspace(-9.0, 44.0, 5)), -1) + rng.random((5, 7, 2))
    compiled, alone = both(lambda: road._evidence(image, mesh, (70, 55)))
    assert np.mean(compiled != alone) < 0.2  # OpenCV interpolates in steps of 1/32: a sixth of a pixel here
    np.testing.assert_array_equal(*both(lambda: road._evidence(image, mesh, (7, 5))))
    assert 0.3 < np.mean(alone == 0.0) < 0.6
    points = np.concatenate([rng.uniform(-300.0, 300.0, (200, 2)), [[np.nan, 0.0], [np.inf, 3.0]]])
    np.testing.assert_array_equal(*both(lambda: road.log_odds(points)))


def test_a_road_is_traced_alike(both: Both) -> None:
    road, x = RoadMap(np.zeros(2)), np.arange(1024) * 0.5 - 256.0
    across = np.abs(x[:, None] - 12.0 * np.sin(x / 40.0))  # of a road along the first axis
    road._log_odds[:] = np.where(across < 4.0, 2.0, -1.5) * (x < 60.0) * (np.abs(x[:, None] - x) < 180.0)
    road.smooth_around(np.zeros(2), 90.0)
    points, headings = np.column_stack([x[300:700:7], np.zeros(58)]), np.linspace(-3.0, 3.0, 58)
    compiled, alone = both(lambda: np.array(paths.road_edges(road, points, headings)))
    assert 10 < np.isfinite(alone).sum() < 110
    np.testing.assert_array_equal(compiled, alone)
    traced = both(lambda: paths.trace_paths(road, np.zeros(2), 0.2, 0.0, 70.0, (4.0, 4.0))[0].points)
    np.testing.assert_allclose(*traced, rtol=1e-9, atol=1e-9)


def test_clusters_are_the_same(both: Both) -> None:
    rng = np.random.default_rng(17)
    for spread in (0.1, 3.0, 30.0):
        points, weights = rng.normal(0.0, spread, (300, 2)), rng.random(300)
        points[100:] += [40.0, -15.0]

        def found(points: Floats = points, weights: Floats = weights) -> Floats:
            cluster = densest_cluster(points, weights / weights.sum(), 4.0)
            return np.array([*cluster.centre, cluster.weight, *cluster.members])

        np.testing.assert_allclose(*both(found), rtol=1e-9)


@pytest.mark.parametrize("gain", [1.0, 1.2])
def test_open_road_is_counted_alike(both: Both, gain: float) -> None:
    lens = Intrinsics(640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]))
    tracker, rng = GroundTracker((640, 480), lens), np.random.default_rng(18)
    tracker.begin(np.asarray(rng.integers(90, 110, (480, 640, 3)), np.uint8), 0.0, Box(300.0, 200.0, 40.0, 20.0))
    tracker._localiser.photometric.gain = np.full(3, gain)
    working = np.asarray(rng.integers(40, 160, (240, 320, 3)), np.uint8)
    tracker._road.learn_colours(working[:60].reshape(-1, 3), working, 1.0)
    tracker._road._log_ratio_table = rng.normal(size=16**3).astype(np.float32)
    positions, headings = tracker._target.position + rng.normal(0.0, 20.0, (400, 2)), rng.normal(0.0, 2.0, 400)
    compiled, alone = both(
        lambda: open_road(working, tracker._localiser, tracker._road, positions, headings, tracker._target.length)
    )
    assert set(alone) == {0, 1, 2, 3}
    np.testing.assert_array_equal(compiled, alone)


@pytest.mark.parametrize("size", [(1290, 35), (1723, 22)])
def test_images_are_reduced_alike(both: Both, size: tuple[int, int]) -> None:
    image = np.asarray(np.random.default_rng(14).integers(0, 256, (size[1], size[0], 3)), np.uint8)
    np.testing.assert_array_equal(*both(lambda: EgoMotion(ImagePlane(size, None)).working_image(image)))


@pytest.mark.parametrize("shape", [(40, 60, 3), (40, 60), (2, 9, 3)])
def test_colours_are_blurred_alike(both: Both, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(15)
    image = np.asarray(rng.integers(0, 256, shape), np.uint8)
    points = rng.uniform(-2.0, [shape[1] + 1.0, shape[0] + 1.0], (300, 2))
    compiled, alone = both(lambda: _blurred_colours(image, points))
    np.testing.assert_allclose(compiled, alone, atol=1e-3 if min(shape[:2]) > 2 else 80.0)


def test_the_motion_of_a_target_is_fitted_alike(both: Both) -> None:
    def fitted() -> Floats:
        rng, history = np.random.default_rng(16), MotionHistory()
        for k in range(24):
            place = np.array([0.4 * k, 0.01 * k * k]) + rng.normal(0.0, 0.05 if k % 7 else 1.0, 2)
            history.add(k / 30.0, place, 0.2)
            found = history.fit()
        assert found is not None
        return np.array([*found.position, *found.velocity, *found.acceleration, found.velocity_std, found.residual])

    np.testing.assert_allclose(*both(fitted), rtol=1e-9)


def test_without_a_library_there_is_none(tmp_path: Path) -> None:
    assert kernels.load(tmp_path / "libkernels.so") is None
    foreign = tmp_path / "foreign.so"
    foreign.write_bytes(b"no library")
    assert kernels.load(foreign) is None


def test_only_contiguous_arrays_are_handed_over() -> None:
    assert kernels._at(np.zeros((3, 4)))
    with pytest.raises(AssertionError, match="beside"):
        kernels._at(np.zeros((3, 4)).T)


def test_observations_match_the_same_layouts(both: Both) -> None:
    """Of several shapes, whole and damaged in each place, with too large a message and an empty one between them."""
    layouts = Layouts()
    for points in range(4):
        layouts.learn(whole(0, points).SerializeToString())
    rng = np.random.default_rng(5)
    payloads = [whole(seed, seed % 6).SerializeToString() for seed in range(60)] + [b"", bytes(5000)]
    for at in range(len(payloads[3])):
        damaged = bytearray(payloads[3])
        damaged[at : at + 8] = struct.pack("<d", rng.choice(NASTY)) if at % 2 else rng.bytes(1)
        payloads.append(bytes(damaged))
    compiled, alone = both(lambda: np.array([*layouts.match_all(payloads)]))
    np.testing.assert_array_equal(compiled, [layouts.match(payload) for payload in payloads])
    assert 40 <= compiled.sum() < len(payloads)
    assert not alone.any(), "without kernels they are matched one by one"


@pytest.mark.parametrize(("seen_by", "speed", "noise"), [(3, 2.0, 2e-3), (1, 2.0, 2e-3), (1, 5.0, 2e-2)])
def test_marker_filter_and_smoother(both: Both, seen_by: int, speed: float, noise: float) -> None:
    """With time maps of 2 ms, outliers, and one camera alone that loses depths (three times in the last case)."""
    rng = np.random.default_rng(1)
    rig = [replace(camera, time_std=2e-3) for camera in cameras(3, 5)]
    times = np.sort(rng.uniform(0.0, 12.0, 700))
    times = times[(times < 3.0) | (times > 4.5)]
    rows = []
    for number, time in enumerate(times.tolist()):
        camera = rig[number % (3 if time < 1.5 else seen_by)]
        place = np.array([np.sin(speed * time), 0.3 * np.cos(1.5 * speed * time), 0.2 * time])
        row = row_of(camera, time, place, number)
        u, v = np.array(row.point) + rng.normal(0.0, noise, 2) + (noise < 0.01 and number % 20 == 0)
        rows.append(replace(row, point=(float(u), float(v)), noise=(noise**2, 0.02 * noise**2, noise**2)))

    def filtered() -> Floats:
        state, out, smoothed = MarkerState(), list[Floats](), list[MarkerState]()
        for row in rows:
            state = process_row(state, row, 10 * NANOSECONDS)
            if len(state.mean):
                smoothed.append(state)
                out.append(np.concatenate([state.mean.ravel(), state.covariance.ravel(), state.log_weight]))
        means, covariances = smooth_states(smoothed[-150:], 100)
        return np.concatenate([*out, means.ravel(), covariances.ravel(), [state.noise[rig[0].name][0]]])

    compiled, plain = both(filtered)
    assert len(plain) > 300 * 250
    np.testing.assert_allclose(compiled, plain, rtol=1e-5, atol=1e-7)
