"""The calibration pipeline on simulated sessions: clocks, poses, trajectories, and refusals by camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path as File

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.core.errors import EXIT_REFUSED, Refused
from protocols.geometry import so3
from protocols.geometry.pose import Pose, fit_similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, read_calibration
from protocols.session.observations import read_observations
from tests.support.rigs import Path, Session, random_path, simulate
from tests.support.written import write_calibration, write_trajectory


@dataclass(frozen=True)
class Solved:
    session: Session
    found: Calibration

    def clock_errors(self) -> dict[str, float]:
        """[s] by camera."""
        return {
            name: self.session.clock_error(name, self.found.reference, camera.time_map)
            for name, camera in self.found.cameras.items()
        }

    def turn_error(self) -> float:
        """Degrees."""
        return float(np.rad2deg(self.session.turn_error(poses(self.found))))


def poses(found: Calibration) -> dict[str, Pose]:
    return {name: camera.pose for name, camera in found.cameras.items()}


def run(session: Session) -> Solved:
    return Solved(session, calibrate(session.rig, session.observations()))


@pytest.fixture(scope="module")
def five() -> Solved:
    """Five cameras with different time origins, mixed frame rates and one fisheye lens."""
    return run(simulate(0, 5, 20, fisheye=(3,), fps=(30.0, 15.0, 29.97, 50.0)))


def test_every_camera_is_solved(five: Solved) -> None:
    assert list(five.found.cameras) == [f"cam{i}" for i in range(5)]
    assert not five.found.refused
    assert five.found.reference == "cam0"
    assert five.found.scale == "arbitrary"


def test_clocks_are_estimated_within_a_millisecond(five: Solved) -> None:
    errors = five.clock_errors()
    assert errors["cam0"] == 0.0
    assert max(map(abs, errors.values())) < 1e-3, errors


def test_rates_are_estimated_within_fifty_ppm(five: Solved) -> None:
    reference = five.session.clocks["cam0"].clock_rate
    for name, camera in five.found.cameras.items():
        truth = five.session.clocks[name].clock_rate / reference
        assert camera.time_map.clock_rate == pytest.approx(truth, abs=5e-5)


def test_rotations_are_estimated_within_a_third_of_a_degree(five: Solved) -> None:
    assert five.turn_error() < 0.3


def test_positions_are_estimated_up_to_scale(five: Solved) -> None:
    truth = np.array([five.session.poses[name].position for name in five.found.cameras])
    found = np.array([camera.pose.position for camera in five.found.cameras.values()])
    similarity = fit_similarity(found, truth)
    assert np.abs(similarity.points(found) - truth).max() < 0.03  # of cameras about 5 m away


def test_the_first_camera_is_the_world_and_the_first_baseline_one(five: Solved) -> None:
    first, second = list(five.found.cameras.values())[:2]
    np.testing.assert_allclose(first.pose.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(first.pose.position, 0, atol=1e-9)
    assert np.linalg.norm(second.pose.position) == pytest.approx(1.0)


def test_residuals_equal_the_noise(five: Solved) -> None:
    for camera in five.found.cameras.values():
        assert 0.55 < camera.rms_px < 0.85  # 0.5 px a coordinate


def path_errors(solved: Solved, label: str = "marker") -> tuple[Floats, Floats]:
    """Errors (n,) [m] of the trajectory after alignment by the cameras' rotations and positions, and its stds."""
    table = next(t for t in solved.found.trajectories if t.label == label)
    truth = solved.session.truth_at(label, solved.found.reference, table.time)
    names = list(solved.found.cameras)
    found = np.array([solved.found.cameras[n].pose.position for n in names])
    there = np.array([solved.session.poses[n].position for n in names])
    similarity = fit_similarity(np.r_[found, table.position], np.r_[there, truth])
    error = np.linalg.norm(similarity.points(table.position) - truth, axis=1)
    return error, similarity.scale * table.std


def test_the_trajectory_matches_the_true_path(five: Solved) -> None:
    error, std = path_errors(five)
    assert np.median(error) < 3e-3
    assert np.quantile(error, 0.99) < 15e-3
    assert 0.4 < np.sqrt(np.mean(error**2 / 3)) / np.sqrt(np.mean(std**2)) < 2.5


def test_the_trajectory_has_the_fastest_cameras_rate(five: Solved) -> None:
    (table,) = five.found.trajectories
    assert np.median(np.diff(table.time)) <= 1 / 50 + 1e-9
    assert (np.diff(table.time) > 0).all()


def test_the_trajectory_is_limited_to_times_when_two_cameras_saw_the_point(five: Solved) -> None:
    (table,) = five.found.trajectories
    seen = np.zeros(len(table.time))
    for name, camera in five.found.cameras.items():
        mine = five.session.time[[n == name for n in five.session.camera]]
        mine = np.sort(camera.time_map.clock_rate * mine + camera.time_map.time_offset)
        after = np.clip(np.searchsorted(mine, table.time), 1, len(mine) - 1)
        seen += np.minimum(np.abs(mine[after] - table.time), np.abs(table.time - mine[after - 1])) <= 0.21
    assert (seen >= 2).all()


def test_the_trajectory_has_a_gap_where_only_one_camera_saw_the_point() -> None:
    """A gap of 0.9 s, shorter than what the spline bridges, is not published as measured."""
    session = simulate(56, 2, 20, late=0, epochs=(0.0,), ppm=0)
    hole = session.of_camera("cam1") & (session.time > 10) & (session.time < 10.9)
    (table,) = run(session.where(~hole)).found.trajectories
    assert not ((table.time > 10.25) & (table.time < 10.65)).any()
    assert ((table.time > 9.8) & (table.time < 10.1)).any()
    assert ((table.time > 10.8) & (table.time < 11.1)).any()


def test_pairs_report_lag_rate_and_geometry(five: Solved) -> None:
    assert len(five.found.pairs) == 10
    for pair in five.found.pairs:
        assert pair.status == "ok"
        assert pair.lag_s is not None
        assert pair.fundamental is not None
        a, b = pair.cameras
        clock_a, clock_b = five.session.clocks[a], five.session.clocks[b]
        middle = float(np.mean([five.session.true_time(name, five.session.middle(name)) for name in (a, b)]))
        truth = five.session.shown(a, middle) - five.session.shown(b, middle)
        assert pair.lag_s == pytest.approx(truth, abs=2e-3)
        assert pair.clock_rate == pytest.approx(clock_b.clock_rate / clock_a.clock_rate, abs=1e-4)
        assert np.linalg.norm(pair.fundamental) == pytest.approx(1.0)
        point = five.session.paths["marker"].at(np.linspace(3, 20, 30))
        normalised = [five.session.poses[n].camera_from_world(point) for n in (a, b)]
        lenses = [five.found.cameras[n].intrinsics.matrix for n in (a, b)]
        m_a, m_b = ((p / p[:, 2:]) @ lens.T for p, lens in zip(normalised, lenses, strict=True))
        line = m_a @ pair.fundamental
        distance = np.abs((line * m_b).sum(axis=1)) / np.linalg.norm(line[:, :2], axis=1)
        assert np.median(distance) < 1.5


def tables(found: Calibration, session: Session, folder: File) -> bytes:
    write_calibration(folder / "calibration.toml", found, session.rig)
    write_trajectory(folder / "trajectory.csv", found)
    return (folder / "calibration.toml").read_bytes() + (folder / "trajectory.csv").read_bytes()


def test_the_result_is_deterministic_and_independent_of_row_order(tmp_path: File) -> None:
    session = simulate(41, 2, 12, outliers=0.05, labels={"red": (0, 1), "blue": (0, 1)})
    texts = []
    rng = np.random.default_rng(0)
    for order in (None, None, rng.permutation(len(session.time)), np.arange(len(session.time))[::-1]):
        lines = session.csv().splitlines(keepends=True)
        rows = lines[1:] if order is None else [lines[1 + i] for i in order]
        (tmp_path / "observations.csv").write_text(lines[0] + "".join(rows))
        seen = read_observations(tmp_path / "observations.csv", session.rig.cameras)
        texts.append(tables(calibrate(session.rig, seen), session, tmp_path))
    assert texts[1] == texts[0], "two runs differ"
    assert texts[2] == texts[0], "shuffled rows give another answer"
    assert texts[3] == texts[0], "rows backwards give another answer"


def test_the_written_calibration_reproduces_the_poses(five: Solved, tmp_path: File) -> None:
    write_calibration(tmp_path / "calibration.toml", five.found, five.session.rig)
    _, again = read_calibration(tmp_path / "calibration.toml")
    for name, camera in five.found.cameras.items():
        np.testing.assert_allclose(again[name].pose.position, camera.pose.position, atol=1e-12)
        assert again[name].time_map == camera.time_map


def test_large_time_origins_cost_no_accuracy() -> None:
    near = run(simulate(42, 2, 20, epochs=(0.0,)))
    far = run(simulate(42, 2, 20, epochs=(1.7e9, -1.7e9)))
    for name in near.found.cameras:
        assert abs(far.clock_errors()[name]) < 6e-4
        assert near.clock_errors()[name] == pytest.approx(far.clock_errors()[name], abs=5e-5)
        assert far.found.cameras[name].time_offset_std == pytest.approx(
            near.found.cameras[name].time_offset_std, rel=0.1
        )


@pytest.mark.parametrize("seed", [17, 43])
def test_a_camera_that_sees_another_object_is_refused_by_name(seed: int) -> None:
    solved = run(simulate(seed, 4, 25, unrelated=(2,)))
    assert list(solved.found.refused) == ["cam2"], f"rms {[c.rms_px for c in solved.found.cameras.values()]}"
    assert len(solved.found.refused["cam2"]) > 20
    assert set(solved.found.cameras) == {"cam0", "cam1", "cam3"}
    assert max(map(abs, solved.clock_errors().values())) < 1e-3


def test_a_first_camera_that_sees_another_object_is_not_the_reference() -> None:
    solved = run(simulate(17, 4, 25, unrelated=(0,)))
    assert list(solved.found.refused) == ["cam0"]
    assert solved.found.reference == "cam1"
    assert max(map(abs, solved.clock_errors().values())) < 1e-3


def test_two_cameras_that_see_different_objects_are_refused() -> None:
    with pytest.raises(Refused) as caught:
        run(simulate(800, 2, 25, unrelated=(1,)))
    assert set(caught.value.cameras) == {"cam0", "cam1"}
    assert caught.value.exit_status == EXIT_REFUSED


def test_a_camera_without_observations_is_refused_by_name_and_one_without_intrinsics_is_self_calibrated() -> None:
    session = simulate(45, 4, 15)
    session = session.where(~session.of_camera("cam1"))
    rig = replace(session.rig, cameras=dict(session.rig.cameras))
    rig.cameras["cam3"] = replace(rig.cameras["cam3"], intrinsics=None)
    found = calibrate(rig, session.observations())
    assert set(found.cameras) == {"cam0", "cam2", "cam3"}
    assert "no observations" in found.refused["cam1"]
    lens = session.lens("cam3")
    assert found.cameras["cam3"].intrinsics.focal == pytest.approx(lens.focal, rel=0.03)


def test_a_camera_of_three_rows_is_refused_by_name() -> None:
    session = simulate(46, 3, 15)
    session = session.where(~session.of_camera("cam2") | (session.frame <= 2))
    found = calibrate(session.rig, session.observations())
    assert list(found.refused) == ["cam2"]
    assert "rows" in found.refused["cam2"]


def test_one_camera_alone_is_refused() -> None:
    with pytest.raises(Refused):
        run(simulate(47, 1, 10))


def test_a_session_without_intrinsics_is_refused_with_a_reason_per_camera() -> None:
    session = simulate(47, 2, 10)
    rig = session.without_lenses().rig
    with pytest.raises(Refused) as caught:
        calibrate(rig, session.observations())
    assert set(caught.value.cameras) == {"cam0", "cam1"}


def test_a_still_marker_is_refused() -> None:
    path = random_path(np.random.default_rng(0))
    with pytest.raises(Refused, match="moves"):
        run(simulate(48, 3, 15, path=Path(path.frequency, path.phase, 0 * path.amplitude)))


def test_a_frozen_camera_is_refused_and_the_others_solved() -> None:
    session = simulate(49, 3, 20)
    session.pixels[session.of_camera("cam1")] = [640.0, 360.0]
    solved = run(session)
    assert list(solved.found.refused) == ["cam1"]
    assert max(map(abs, solved.clock_errors().values())) < 1e-3


def test_noise_free_data_is_solved() -> None:
    solved = run(simulate(50, 3, 15, noise=0.0, drops=0.0))
    assert max(map(abs, solved.clock_errors().values())) < 1e-5
    assert solved.turn_error() < 1e-3


def test_outliers_are_tolerated() -> None:
    solved = run(simulate(51, 3, 30, outliers=0.2, drops=0.2))
    assert max(map(abs, solved.clock_errors().values())) < 1e-3
    assert solved.turn_error() < 0.3


def test_a_low_frame_rate_suffices_for_slow_motion() -> None:
    solved = run(simulate(52, 3, 40, fps=(5.0,), fastest=0.4))
    assert max(map(abs, solved.clock_errors().values())) < 2e-3


def test_cameras_that_overlap_in_a_chain_are_solved_through_the_middle_one() -> None:
    """A and C share 4 s only, too few for a pair of their own."""
    solved = run(simulate(53, 3, 70, fps=(15.0,), windows=[(0, 36), (8, 62), (32, 70)], late=0))
    assert set(solved.found.cameras) == {"cam0", "cam1", "cam2"}, solved.found.refused
    assert max(map(abs, solved.clock_errors().values())) < 2e-3


def test_a_chain_without_a_common_view_has_no_common_scale_and_is_refused() -> None:
    """A–B and B–C never overlap: the ratio of the two baselines is not observable."""
    solved = run(simulate(14, 3, 90, fps=(15.0,), windows=[(0, 35), (25, 65), (55, 90)], late=0))
    assert len(solved.found.refused) == 1
    for name, error in solved.clock_errors().items():
        assert abs(error) <= 4.5 * solved.found.cameras[name].time_offset_std


def test_labels_seen_by_different_cameras_connect_one_network() -> None:
    labels = {"red": (0, 1), "blue": (0, 1, 2), "lone": (2,)}
    solved = run(simulate(54, 3, 20, labels=labels))
    assert set(solved.found.cameras) == {"cam0", "cam1", "cam2"}
    assert {table.label for table in solved.found.trajectories} == {"red", "blue"}
    assert max(map(abs, solved.clock_errors().values())) < 1e-3
    for label in ("red", "blue"):
        assert np.median(path_errors(solved, label)[0]) < 5e-3


def test_planar_motion_is_refused_with_that_reason() -> None:
    """With planar motion the geometry of every pair is ambiguous."""
    path = random_path(np.random.default_rng(3))
    path = Path(path.frequency, path.phase, path.amplitude * [1.0, 1.0, 0.0])
    with pytest.raises(Refused, match="plane"):
        run(simulate(19, 3, 25, path=path))


def test_planar_motion_seen_by_two_cameras_is_refused_or_reported_as_degenerate() -> None:
    """F is degenerate there: that must be reported rather than a rotation that is some degrees wrong."""
    path = random_path(np.random.default_rng(3))
    path = Path(path.frequency, path.phase, path.amplitude * [1.0, 1.0, 0.0])
    try:
        solved = run(simulate(62, 2, 25, path=path))
    except Refused:
        return
    reported = " ".join([*solved.found.warnings, *(pair.status for pair in solved.found.pairs)])
    assert solved.turn_error() < 0.5 or "degenerate" in reported or "plane" in reported


def test_given_positions_make_the_result_metric() -> None:
    session = simulate(55, 3, 20)
    rig = replace(
        session.rig,
        cameras={
            name: replace(camera, position=session.poses[name].position, position_std=np.full(3, 0.01))
            for name, camera in session.rig.cameras.items()
        },
    )
    found = calibrate(rig, session.observations())
    assert found.scale == "metric"
    for name, camera in found.cameras.items():
        np.testing.assert_allclose(camera.pose.position, session.poses[name].position, atol=0.03)
        assert np.rad2deg(so3.angle_between(camera.pose.rotation, so3.nearest(session.poses[name].rotation))) < 0.5
        assert (camera.position_std < 0.02).all()
    (table,) = found.trajectories
    truth = session.truth_at("marker", "cam0", table.time)
    assert np.median(np.linalg.norm(table.position - truth, axis=1)) < 0.03


def test_eight_cameras_are_calibrated_together() -> None:
    solved = run(simulate(13, 8, 10, fps=(15.0, 12.5), fastest=0.5))
    assert len(solved.found.cameras) == 8
    assert max(map(abs, solved.clock_errors().values())) < 1e-3
    assert solved.turn_error() < 0.5
