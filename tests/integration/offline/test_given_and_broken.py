"""What is given stays, what is broken is named and costs the others nothing, and what is stated holds where it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hub.bundle import model_comparison
from hub.bundle.preprocessing import prepare
from hub.bundle.problem import AdjustmentState, CameraState, Problem, TrackObservations
from hub.calibration.incremental import update_calibration
from hub.calibration.notes import rejected_rows
from hub.calibration.pairs import pair_network
from hub.calibration.pairs.pair_network import solve_pairs
from hub.calibration.pipeline import calibrate
from hub.calibration.resection import scan as resection_scan
from hub.calibration.resection.scan import find_time_map
from hub.calibration.solvers import solve_network
from hub.calibration.triangulation import triangulate
from hub.sync import pair_solver
from hub.sync.pair_solver import _PairSearch
from protocols.core.clocks import CameraTime, ReferenceTime
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.session.calibration import Calibration, FixedCalibration
from protocols.session.folder import read_folder
from protocols.session.observations import Observations, gather_tracks
from protocols.session.result import result_document
from protocols.session.rig import Rig, RigCamera
from tests.bench import broken_cameras, clock_models, lasting_errors
from tests.bench.clock_steps import Put, stepped
from tests.bench.pose_worlds import FOCAL, cube, errors, joint_optimum, observe, section_4
from tests.bench.simulated_rigs import make_rallies
from tests.support import rigs
from tests.support.rigs import random_poses

DRONE2 = Path(__file__).parents[4] / "shared" / "data" / "drone2"
DRONE1 = DRONE2.with_name("drone1")


@pytest.fixture(scope="module")
def four() -> tuple[rigs.Session, Calibration]:
    session = rigs.simulate(1, 4, 30.0)
    return session, calibrate(session.rig, session.observations())


def with_focal(session: rigs.Session, name: str, factor: float) -> rigs.Session:
    camera = session.rig.cameras[name]
    assert camera.intrinsics is not None
    matrix = camera.intrinsics.matrix.copy()
    matrix[:2, :2] *= factor
    changed = replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))
    return replace(session, rig=replace(session.rig, cameras=session.rig.cameras | {name: changed}))


def test_a_wrong_lens_is_kept_and_named_and_right_ones_are_not(four: tuple[rigs.Session, Calibration]) -> None:
    session, found = four
    assert not [text for text in found.warnings if "refuted" in text]
    wrong = with_focal(session, "cam1", 1.03)
    again = calibrate(wrong.rig, wrong.observations())
    assert [text.split(":")[0] for text in again.warnings if "refuted" in text] == ["cam1"]
    for name, camera in again.cameras.items():
        given = wrong.rig.cameras[name].intrinsics
        assert given is not None
        assert np.array_equal(camera.intrinsics.matrix, given.matrix)
        assert np.array_equal(camera.intrinsics.distortions, given.distortions)


@pytest.mark.parametrize("solver", ["joint", "distributed"])
def test_a_focal_length_with_a_std_is_an_observation_of_that_weight(solver: str) -> None:
    session = rigs.simulate(3, 4, 30.0)
    given = {name: replace(camera, focal_std=0.01) for name, camera in session.rig.cameras.items()}
    wrong = replace(session, rig=replace(session.rig, cameras=given))
    for name, factor in (("cam1", 1.012), ("cam2", 0.99)):
        wrong = with_focal(wrong, name, factor)
    found = calibrate(wrong.rig, wrong.observations(), solver=solver)
    for name, camera in found.cameras.items():
        lens = session.lens(name)
        assert abs(camera.intrinsics.focal / lens.focal - 1.0) < 4.0 * camera.focal_std < 0.02
        assert np.array_equal(camera.intrinsics.distortions, lens.distortions)
        assert [one.std for one in camera.sensitivities] == [0.01]
        assert any(text.startswith(f"{name}: its lens was refined: focal length from") for text in found.warnings)


def test_refined_lenses_are_told_with_their_stds(four: tuple[rigs.Session, Calibration]) -> None:
    wrong = with_focal(four[0], "cam1", 1.012)
    found = calibrate(wrong.rig, wrong.observations(), refine_lenses=True)
    for name, camera in found.cameras.items():
        told = f"{camera.intrinsics.focal:.1f} px ± {100 * camera.focal_std:.2g} % (std)"
        assert any(text.startswith(f"{name}: its lens was refined") and told in text for text in found.warnings)
        assert next(t.value for t in found.acceptance[name] if t.name == "std of the focal length") > 0.0


@pytest.mark.parametrize("solver", ["joint", "distributed"])
def test_separate_points_reach_the_optimum(solver: str) -> None:
    """Two of these 4,000 rows lie beyond four stds: they are noise, no outliers, and two points near an epipole."""
    rng = np.random.default_rng(0)
    world = section_4(rng)
    seen = observe(world, rng, cube(rng, 2000), 1.0, np.inf)
    lens = Intrinsics(1280, 960, np.array([[FOCAL, 0.0, 639.5], [0.0, FOCAL, 479.5], [0.0, 0.0, 1.0]]))
    cameras = {f"cam{i}": RigCamera(f"cam{i}", (1280, 960), 30.0, lens) for i in range(5)}
    first, second = world.poses[:2]
    cameras["cam0"] = replace(cameras["cam0"], position=first.position, rotation=first.rotation)
    cameras["cam1"] = replace(cameras["cam1"], position=second.position)
    frame = np.repeat(np.arange(len(seen.cameras)), 2)
    pixels = seen.seen[:, :, :2].reshape(-1, 2) * FOCAL + [639.5, 479.5]
    names = [f"cam{i}" for i in seen.cameras.ravel()]
    rows = gather_tracks(
        names, ["p"] * len(names), frame, frame / 30.0, pixels, np.full(len(names), np.nan), order=cameras
    )
    found = calibrate(Rig(cameras, clock="shared"), rows, solver=solver).cameras
    best = errors(world, joint_optimum(world, seen).poses)
    ours = errors(world, [found[name].pose for name in cameras])
    assert ours[0] < 1.02 * best[0]
    assert ours[1] < 1.02 * best[1]
    assert np.abs(found["cam1"].pose.position - second.position).max() < 1e-9


@pytest.mark.parametrize("kind", ["other numbering", "wrong lens", "crop"])
def test_a_broken_camera_is_named_and_the_others_stay(kind: str) -> None:
    session = rigs.simulate(0, 5, 30.0)
    before, _ = broken_cameras.timed(broken_cameras.without(session, "cam4"))
    broken = broken_cameras.BREAKAGES[kind](session, "cam4", session.of_camera("cam4"), np.random.default_rng(0))
    found, _ = broken_cameras.timed(broken)
    said = {"wrong lens": "lens is refuted", "crop": "principal point"}
    assert said.get(kind, "") in found.refused["cam4"]
    assert broken_cameras.change(before, found) < 1.0


def test_a_picture_upside_down_whose_centre_is_elsewhere_is_named() -> None:
    session = rigs.simulate(101, 6, 40.0)
    turned = broken_cameras.turned(session, "cam4", session.of_camera("cam4"), np.random.default_rng(0))
    named = [text.split(":")[0] for text in calibrate(turned.rig, turned.observations()).warnings if "refuted" in text]
    assert named == ["cam4"]


def test_the_pairs_of_a_camera_with_a_wrong_lens_are_searched_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its starts end in one minimum of the essential matrix, far above the fundamental matrix's."""
    session = rigs.simulate(103, 8, 40.0)
    half = broken_cameras.BREAKAGES["half size"](session, "cam7", session.of_camera("cam7"), np.random.default_rng(0))
    solve, refine, searched, starts = pair_network._solve, pair_solver.refine, list[tuple[str, str]](), list[int]()
    monkeypatch.setattr(pair_network, "_solve", lambda *of, **how: (searched.append(of[1]), solve(*of, **how))[1])
    monkeypatch.setattr(pair_solver, "refine", lambda *of, **how: (starts.append(1), refine(*of, **how))[1])
    solve_pairs(prepare(half.rig, half.observations()), lambda text, share: None, thorough="first pair")
    assert len(searched) == len(set(searched))
    assert len(starts) < 220


def test_the_step_of_one_of_three_clocks_is_not_blamed_on_the_two_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock_models, "CAMERAS", 3)
    world = clock_models.World(12.0, 0.5, (10.0, 30.0, 15.0), 0.7, 0.0, 1)
    rig, observations, clocks = clock_models.session(7102, "step60", world)
    found = calibrate(rig, observations)
    assert [name for name, one in found.cameras.items() if one.clock_steps] == ["cam1"]
    assert found.cameras["cam1"].clock_steps[0][1] == pytest.approx(clocks["cam1"].steps[0][1], rel=0.1)


@pytest.mark.parametrize(("seed", "seconds", "noise"), [(2003, 12.0, 0.3), (2061, 20.0, 0.7)])
def test_two_cameras_do_not_refute_right_lenses(seed: int, seconds: float, noise: float) -> None:
    """The linear model gave focal lengths 10 to 43 % off; the observations cost more there."""
    session = rigs.simulate(seed, 2, seconds, noise=noise, fps=(6.0, 15.0, 50.0), late=1.0, fastest=1.0)
    assert not [text for text in calibrate(session.rig, session.observations()).warnings if "refuted" in text]


def test_resection_tells_a_wrong_lens_and_a_mirrored_image_from_a_camera_that_saw_something_else() -> None:
    session = rigs.simulate(2, 4, 30.0)
    good = broken_cameras.without(session, "cam3")
    prepared, pairs = solve_pairs(prepare(good.rig, good.observations()), lambda text, share: None)
    path = solve_network(prepared, pairs, lambda text, share: None).reconstruction
    mine, rng = session.of_camera("cam3"), np.random.default_rng(0)
    for broken, words in (
        (with_focal(session, "cam3", 0.6), "focal length 1.6"),
        (broken_cameras.mirrored(session, "cam3", mine, rng), "mirrored"),
        (broken_cameras.shuffled(session, "cam3", mine, rng), "fits at no lag"),
    ):
        found, reason = find_time_map(prepare(broken.rig, broken.observations()).cameras["cam3"], path, (1.0,))
        assert found is None
        assert words in reason


def test_a_camera_many_of_whose_rows_are_left_out_is_named() -> None:
    session = rigs.simulate(2, 3, 20.0)
    prepared, pairs = solve_pairs(prepare(session.rig, session.observations()), lambda text, share: None)
    solved = solve_network(prepared, pairs, lambda text, share: None).reconstruction
    assert rejected_rows(solved.names, solved.problem, solved.state) == ()
    rows = [part.using(part.use & (np.arange(len(part.use)) % 10 > 2 * part.camera)) for part in solved.problem.rows]
    said = rejected_rows(solved.names, replace(solved.problem, rows=tuple(rows)), solved.state)
    assert [text[:4] for text in said] == solved.names[1:]


def test_candidates_at_other_frame_rates_do_not_displace_those_at_the_nominal_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = rigs.simulate(2, 4, 30.0)
    good = broken_cameras.without(session, "cam3")
    prepared, pairs = solve_pairs(prepare(good.rig, good.observations()), lambda text, share: None)
    path = solve_network(prepared, pairs, lambda text, share: None).reconstruction
    scan = resection_scan.moment_scan
    crowd = [resection_scan.TimeMapCandidate(2.0, float(lag), 0.0) for lag in range(20)]
    monkeypatch.setattr(resection_scan, "moment_scan", lambda *of: scan(*of) if of[2] == 1.0 else crowd)
    camera = prepare(session.rig, session.observations()).cameras["cam3"]
    assert find_time_map(camera, path, (1.0, 2.0))[0] == find_time_map(camera, path, (1.0,))[0]


@pytest.mark.parametrize(("wrong", "place"), [(12, (0.4, -0.3)), (4, (-0.1, 0.15))])
def test_a_false_detection_that_stays_in_one_place_does_not_displace_a_resected_pose(
    wrong: int, place: tuple[float, float]
) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (80, 3)) + [0.0, 0.0, 4.0]
    seen = points[:, :2] / points[:, 2:]
    seen[:wrong] = place
    residual = resection_scan.resected_residuals(points, seen, points, seen, 500.0)
    assert np.median(residual[wrong:]) < 1.0


def test_a_broken_camera_does_not_get_the_long_search_that_a_pair_alone_gets(monkeypatch: pytest.MonkeyPatch) -> None:
    session = rigs.simulate(0, 4, 30.0)
    broken = broken_cameras.shuffled(session, "cam0", session.of_camera("cam0"), np.random.default_rng(0))
    prepared, tried = prepare(broken.rig, broken.observations()), list[float]()
    refine = _PairSearch._refine_candidate

    def counted(*arguments: Any, **options: Any) -> Any:
        tried.append(arguments[2])
        return refine(*arguments, **options)

    monkeypatch.setattr(_PairSearch, "_refine_candidate", counted)
    counts = {}
    for thorough in (False, "first pair"):
        tried.clear()
        _, pairs = solve_pairs(prepared, lambda text, share: None, thorough=thorough)  # type: ignore[arg-type]
        assert [pair.solved for pair in pairs] == [False, False, False, True, True, True]
        counts[thorough] = len(tried)
    assert counts["first pair"] < 0.5 * counts[False]


def test_a_camera_that_shares_no_moment_with_the_first_pair_is_connected() -> None:
    windows = [(0.0, 30.0), (0.0, 30.0), (0.0, 60.0), (30.0, 60.0), (28.0, 60.0)]
    session = rigs.simulate(3, 5, 60.0, windows=windows)
    found = calibrate(session.rig, session.observations(), thorough=True)
    assert not found.refused
    for name, camera in found.cameras.items():
        assert abs(session.clock_error(name, found.reference, camera.time_map)) < 2e-3


def test_a_clock_step_is_reported_with_time_and_size_and_no_other_clock_follows(
    four: tuple[rigs.Session, Calibration],
) -> None:
    session, before = four
    mine = session.of_camera("cam2")
    at = float(np.quantile(session.time[mine], 0.6))
    time = session.time + np.where(mine & (session.time >= at), 0.03, 0.0)
    found = calibrate(session.rig, replace(session, time=time).observations())
    ((when, size, std),) = found.cameras["cam2"].clock_steps
    assert when == pytest.approx(at, abs=0.7)
    assert abs(size - 0.03) < 3.0 * std
    assert [text for text in found.warnings if text.startswith("cam2: its clock steps by +30.")]
    assert found.cameras["cam2"].lag_std > 1.3 * before.cameras["cam2"].lag_std  # it holds the size's
    for name, camera in found.cameras.items():
        assert camera.readout == 0.0
        assert abs(session.clock_error(name, found.reference, camera.time_map)) <= 5.0 * camera.time_offset_std


def test_slow_errors_of_labels_and_of_lenses_are_no_clock_step() -> None:
    """Errors correlated over seconds, in a part of a flight, of lenses that are up to 2 % off."""
    one = lasting_errors.session(9102)
    found = calibrate(one.rig, one.observations)
    assert len(found.cameras) == 4
    assert not any(camera.clock_steps for camera in found.cameras.values())


@pytest.fixture(scope="module")
def flight() -> tuple[Rig, Observations, Calibration, Put]:
    """A recorded flight, its calibration, and a further step for the clock of cam1."""
    if not DRONE2.is_dir():
        pytest.skip("no recording in ../shared/data")
    rig, observations = read_folder(DRONE2)
    (track,) = observations.of_camera("cam1")
    put = Put("cam1", float(track.time[0] + 0.4 * np.ptp(track.time)), -0.06)
    return rig, observations, calibrate(rig, observations), put


def test_clock_steps_in_a_recorded_flight_are_reported_with_time_and_size(
    flight: tuple[Rig, Observations, Calibration, Put],
) -> None:
    """Of cam0 at 69 s, as recorded; a further one put into another camera's stamps is no part of the first one's."""
    rig, observations, before, put = flight
    ((at, size, std),) = before.cameras["cam0"].clock_steps
    assert at == pytest.approx(69.0, abs=1.0)
    assert abs(size + 0.0326) < 3.0 * std
    after = calibrate(rig, stepped(observations, put))
    ((at, size, std),) = after.cameras["cam1"].clock_steps
    assert at == pytest.approx(put.at, abs=1.0)
    assert abs(size - put.size) < 4.0 * std < 0.01
    assert all(camera.readout == 0.0 for camera in after.cameras.values())


def test_a_clock_step_is_reported_of_its_camera_five_seconds_later(
    flight: tuple[Rig, Observations, Calibration, Put],
) -> None:
    """An adjustment that rejects the few rows after it as outliers does not hide it; lenses are 2 % off."""
    rig, observations, whole, put = flight
    known = whole.cameras[put.camera].time_map
    until = float(known.reference_from_camera(CameraTime(put.at))) + 5.0
    tracks = {}
    for key, track in observations.tracks.items():
        last = float(whole.cameras[key[0]].time_map.camera_from_reference(ReferenceTime(until)))
        tracks[key] = track.select(track.time <= last)
    found = update_calibration(rig, stepped(replace(observations, tracks=tracks), put), None).calibration
    steps = {name: camera.clock_steps for name, camera in found.cameras.items() if camera.clock_steps}
    assert list(steps) == [put.camera]
    ((at, size, std),) = steps[put.camera]
    assert at == pytest.approx(put.at, abs=1.0)
    assert abs(size - put.size) < 3.0 * std < 0.015


@pytest.mark.skipif(not DRONE1.is_dir(), reason="no recording in ../shared/data")
def test_a_step_that_is_little_once_its_size_is_estimated_is_not_reported() -> None:
    """cam1 steps by 60 ms, which its rate takes up; in the linear model cam0 then seems to step."""
    rig, observations = read_folder(DRONE1)
    (track,) = observations.of_camera("cam1")
    put = Put("cam1", float(track.time[0] + 0.4 * np.ptp(track.time)), 0.06)
    found = calibrate(rig, stepped(observations, put))
    assert not any(camera.clock_steps for name, camera in found.cameras.items() if name != put.camera)


def test_a_readout_is_neither_negative_nor_longer_than_a_frame(four: tuple[rigs.Session, Calibration]) -> None:
    _, found = four
    rows, cameras = [], []
    for name, camera in found.cameras.items():
        time, pixels = found.residuals[name][:, 0], found.residuals[name][:, 1:3]
        rows.append(TrackObservations(len(cameras), 0, time, pixels, np.ones(len(time), dtype=np.bool_)))
        cameras.append(CameraState(camera.intrinsics, camera.pose, 1.0, 0.0, 0.0))
    problem = Problem(tuple(rows), tuple(one.intrinsics for one in cameras), 0, (0, 1))
    state = AdjustmentState(tuple(cameras), (), np.ones(4))
    interval = min(float(np.median(np.diff(rows.time))) for rows in problem.rows)
    for readout, plausible in ((0.5 * interval, True), (-0.044, False), (1.5 * interval, False)):
        read = tuple(replace(camera, readout=readout) for camera in state.cameras)
        assert model_comparison.are_readouts_plausible(problem, replace(state, cameras=read)) == plausible
    slow = replace(problem, rows=tuple(replace(part, time=10.0 * part.time) for part in rows))
    read = tuple(replace(camera, readout=0.073) for camera in state.cameras)
    assert not model_comparison.are_readouts_plausible(slow, replace(state, cameras=read))  # no rig.toml may say so


def test_rallies_of_table_tennis_keep_all_cameras_and_invent_no_readout() -> None:
    path = make_rallies(np.random.default_rng([703, 5]))
    session = rigs.simulate(703, 4, float(path.ends[-1]) + 1.0, fps=(60.0,), late=0.5, path=path)
    found = calibrate(session.rig, session.observations(), thorough=True)
    assert not found.refused
    for name, camera in found.cameras.items():
        assert 0.0 <= camera.readout <= 1.0 / 60.0
        assert abs(session.clock_error(name, found.reference, camera.time_map)) < 1e-3


def test_the_lag_is_stated_in_the_middle_of_the_shared_span(four: tuple[rigs.Session, Calibration]) -> None:
    session, found = four
    for name, table in result_document(found, session.rig)["cameras"].items():
        time = table["lag_time_s"]
        truth = session.shown(found.reference, session.true_time(name, time)) - time
        assert abs(table["lag_s"] - truth) <= 5.0 * table["lag_std_s"] + 1e-6
        assert (table["lag_std_s"] > 0.0) == (table["clock_rate_ppm_std"] > 0.0) == (name != found.reference)
        both = []
        for one in (found.reference, name):
            seen = session.time[session.of_camera(one)]
            both.append([session.true_time(one, float(seen.min())), session.true_time(one, float(seen.max()))])
        begin, end = np.array(both).T
        middle = 0.5 * (begin.max() + end.min())
        assert session.true_time(name, time) == pytest.approx(middle, abs=0.01)


def test_rates_are_those_of_crystals_unless_refuted() -> None:
    session = rigs.simulate(8, 3, 12.0, fps=(6.0,), noise=2.0, ppm=30.0)
    found = calibrate(session.rig, session.observations())
    for camera in found.cameras.values():
        assert abs(camera.time_map.clock_rate - 1.0) < 4e-4
    assert not [text for text in found.warnings if "frame rate" in text]
    session = rigs.simulate(9, 3, 30.0, ppm=30.0)
    mine = session.of_camera("cam1")
    start = float(session.time[mine].min())
    time = np.where(mine, start + 1.002 * (session.time - start), session.time)
    found = calibrate(session.rig, replace(session, time=time).observations())
    assert [text for text in found.warnings if text.startswith("cam1: its times run -") and "frame rate" in text]


def test_known_cameras_in_one_place_are_refused_in_one_line(four: tuple[rigs.Session, Calibration]) -> None:
    session, found = four
    place = found.cameras["cam0"].pose.position
    cameras = {
        name: replace(camera, pose=replace(camera.pose, position=place)) for name, camera in found.cameras.items()
    }
    with pytest.raises(Refused, match="in one place"):
        calibrate(session.rig, session.observations(), known=FixedCalibration(cameras, "metric"))
    with pytest.raises(Refused, match="in one place"):
        triangulate(session.rig, cameras, session.observations())


@pytest.mark.parametrize(("seed", "moved"), [(2, "cam0"), (2, "cam1"), (7, "cam2")])
def test_of_three_given_cameras_the_one_that_was_moved_is_named(seed: int, moved: str) -> None:
    """Another one was, and the path was of the moved one and the third."""
    session = rigs.simulate(seed, 3, 15.0)
    cameras = session.turned(moved, 0.0, 0.05).true_cameras()
    assert triangulate(session.rig, cameras, session.observations()).contradicted == (moved,)


@pytest.mark.parametrize("seed", [8, 11])
def test_a_camera_that_was_always_noisy_is_not_the_one_that_was_moved(seed: int) -> None:
    """The others' mean residual in pixels was less without it, and it was named in place of one whose noise is new."""
    session, rng = rigs.simulate(seed, 4, 15.0), np.random.default_rng(seed)
    noise = np.select([session.of_camera("cam0"), session.of_camera("cam1")], [6.0, 4.0], 0.85)
    session = replace(session, pixels=session.pixels + noise[:, None] * rng.normal(size=session.pixels.shape))
    true = session.true_cameras()
    cameras = {name: replace(one, rms_px=6.0 if name == "cam0" else 1.0) for name, one in true.items()}
    found = triangulate(session.rig, cameras, session.observations())
    assert found.contradicted == ()
    assert not any(warning.startswith("cam0") for warning in found.warnings)


def test_with_known_poses_motion_in_a_plane_gives_the_lags() -> None:
    path = rigs.random_path(np.random.default_rng(8))
    session = rigs.simulate(7, 3, 20.0, path=path)
    known = FixedCalibration(dict(calibrate(session.rig, session.observations()).cameras), "arbitrary")
    flat = rigs.simulate(7, 3, 20.0, path=replace(path, amplitude=path.amplitude * [1.0, 1.0, 0.0]))
    found = calibrate(flat.rig, flat.observations(), known=known)
    for name in ("cam1", "cam2"):
        assert abs(flat.clock_error(name, "cam0", found.cameras[name].time_map)) < 2e-3
    with pytest.raises(Refused, match="in one plane"):
        calibrate(flat.rig, flat.observations())


@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_exact_poses_of_two_cameras_in_one_place_are_no_fault(monkeypatch: pytest.MonkeyPatch, gap: float) -> None:
    """In the datum of their baseline all else was uncertain, and true references 1 mm apart were called wrong."""

    def beside(rng: np.random.Generator, count: int) -> list[Pose]:
        first, _, *others = random_poses(rng, count)
        return [first, Pose(first.rotation, first.position + [gap, 0.0, 0.0]), *others]

    monkeypatch.setattr(rigs, "random_poses", beside)
    session = rigs.simulate(5, 3, 20.0)
    known = {
        name: replace(camera, position=session.poses[name].position, rotation=session.poses[name].rotation)
        for name, camera in session.rig.cameras.items()
    }
    found = calibrate(replace(session.rig, cameras=known), session.observations())
    assert not found.warnings
    again = calibrate(session.rig, session.observations(), known=FixedCalibration(dict(found.cameras), "metric"))
    for one in (found, again):
        assert abs(session.clock_error("cam2", "cam0", one.cameras["cam2"].time_map)) < 1e-3
        assert [pair.fundamental is None for pair in one.pairs] == [gap == 0.0, False, False]


@pytest.mark.parametrize("positions", [0, 2])
def test_exact_distances_are_exact_and_contradicting_ones_are_named(
    four: tuple[rigs.Session, Calibration], positions: int
) -> None:
    session, _ = four
    places = {name: pose.position for name, pose in session.poses.items()}
    cameras = dict(session.rig.cameras)
    for name in list(cameras)[:positions]:
        cameras[name] = replace(cameras[name], position=places[name])
    between = [("cam0", "cam1"), ("cam0", "cam2"), ("cam1", "cam2")]
    lengths = tuple((a, b, float(np.linalg.norm(places[a] - places[b]))) for a, b in between)
    found = calibrate(replace(session.rig, cameras=cameras, distances=lengths), session.observations())
    for a, b, length in lengths:
        apart = found.cameras[a].pose.position - found.cameras[b].pose.position
        assert np.linalg.norm(apart) == pytest.approx(length, rel=1e-9)
    assert not [text for text in found.warnings if "contradict" in text or "disagree" in text]
    assert found.cameras["cam3"].position_std.max() < 0.02
    if positions:
        wrong = (("cam0", "cam1", lengths[0][2] + 0.01), *lengths[1:])
        told = calibrate(replace(session.rig, cameras=cameras, distances=wrong), session.observations()).warnings
        assert any("contradict each other, worst is the distance cam0–cam1, 0.01 off" in text for text in told)


def test_no_row_of_a_path_is_outside_the_observed_span(four: tuple[rigs.Session, Calibration]) -> None:
    session, found = four
    spans = []
    for name, camera in found.cameras.items():
        time = session.time[session.of_camera(name)]
        spans.append(camera.time_map.clock_rate * np.array([time.min(), time.max()]) + camera.time_map.time_offset)
    begin, end = sorted(span[0] for span in spans)[1], sorted(span[1] for span in spans)[-2]
    (path,) = found.trajectories
    assert begin - 1e-3 <= path.time[0] < begin + 0.1
    assert end - 0.1 < path.time[-1] <= end + 1e-3


def test_detectors_covariances_weigh_the_rows() -> None:
    """Half of the rows have six times the noise, and say so."""
    ratios = []
    for seed in (0, 1):
        session = rigs.simulate(seed, 3, 15.0, noise=0.0)
        rng = np.random.default_rng(seed)
        std = np.where(rng.random(len(session.time)) < 0.5, 0.5, 3.0)
        session = replace(session, pixels=session.pixels + std[:, None] * rng.standard_normal((len(std), 2)))
        plain = session.observations()
        weighed = gather_tracks(
            session.camera,
            session.label,
            session.frame,
            session.time,
            session.pixels,
            np.full(len(std), np.nan),
            stds=std,
            order=session.rig.cameras,
        )
        found = [calibrate(session.rig, rows) for rows in (plain, weighed)]
        ratios.append([session.turn_error({n: c.pose for n, c in one.cameras.items()}) for one in found])
    plain_error, weighed_error = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert weighed_error < 0.75 * plain_error


def test_the_stated_effect_of_an_error_of_a_given_value_is_what_happens() -> None:
    session = rigs.simulate(1, 4, 20.0)
    cameras = {
        name: replace(camera, position=session.poses[name].position, position_std=np.full(3, 0.02))
        for name, camera in session.rig.cameras.items()
    }
    found = calibrate(replace(session.rig, cameras=cameras), session.observations())
    stated = {one.given: one for one in found.cameras["cam1"].sensitivities}
    document = result_document(found, session.rig)["cameras"]["cam1"]["sensitivity"]
    assert document["position"] == {
        "std": 0.02,
        "position": stated["position"].position,
        "of_camera": stated["position"].camera,
        "lag_s": stated["position"].lag,
    }

    def moved(changed: RigCamera) -> float:
        again = calibrate(replace(session.rig, cameras=cameras | {"cam1": changed}), session.observations())
        return max(
            float(np.linalg.norm(again.cameras[name].pose.position - camera.pose.position))
            for name, camera in found.cameras.items()
        )

    camera = cameras["cam1"]
    assert camera.position is not None
    assert camera.intrinsics is not None
    each = [moved(replace(camera, position=camera.position + 0.02 * axis)) for axis in np.eye(3)]
    assert max(each) == pytest.approx(stated["position"].position, rel=0.05)
    matrix = camera.intrinsics.matrix.copy()
    matrix[:2, :2] *= 1.01
    lens = replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))
    assert moved(lens) == pytest.approx(stated["lens"].position, rel=0.05)


@pytest.mark.parametrize("factor", [1.0, 0.25])
def test_the_stds_that_a_detector_states_are_checked_against_its_residuals(factor: float) -> None:
    session = rigs.simulate(2, 3, 20.0, noise=0.5)
    rows = gather_tracks(
        session.camera,
        session.label,
        session.frame,
        session.time,
        session.pixels,
        np.full(len(session.time), np.nan),
        stds=np.where(session.of_camera("cam1"), factor * 0.5, np.nan),
        order=session.rig.cameras,
    )
    found = calibrate(session.rig, rows)
    document = result_document(found, session.rig)["cameras"]
    assert found.cameras["cam1"].detector_z == pytest.approx(1.0 / factor, rel=0.1)
    assert document["cam1"]["detector_z"] == found.cameras["cam1"].detector_z
    assert document["cam0"]["detector_z"] is None
    warned = [text.split(":")[0] for text in found.warnings if "z-scores" in text]
    assert warned == ([] if factor == 1.0 else ["cam1"])


def test_a_camera_whose_residuals_are_far_larger_than_the_others_is_named() -> None:
    """Detections that wander by some pixels: no lens and no clock explains them, and no test of one tells."""
    session = rigs.simulate(2, 4, 20.0, noise=0.5)
    mine = session.of_camera("cam3")
    wander = 3.0 * np.sin(np.add.outer(2.0 * np.pi * session.time[mine] / 1.3, [0.0, 1.0]))
    session.pixels[mine] += wander
    found = calibrate(session.rig, session.observations())
    named = [text.split(":")[0] for text in found.warnings if "times the others'" in text]
    assert named == ["cam3"]
    session.pixels[mine] -= wander
    assert not any("times the others'" in text for text in calibrate(session.rig, session.observations()).warnings)
    # In an image six times as large the same angles are six times the pixels.
    camera = session.rig.cameras["cam3"]
    assert camera.intrinsics is not None
    scaled = np.diag([6.0, 6.0, 1.0]) @ camera.intrinsics.matrix
    large = replace(camera.intrinsics, width=6 * camera.size[0], height=6 * camera.size[1], matrix=scaled)
    session.pixels[mine] *= 6.0
    rig = replace(session.rig, cameras=session.rig.cameras | {"cam3": replace(camera, intrinsics=large)})
    assert not any("times the others'" in text for text in calibrate(rig, session.observations()).warnings)


def test_of_two_references_that_explain_a_contradiction_alike_neither_is_blamed() -> None:
    """The reference of cam1 is 8 std off; noise makes cam2's the likelier of the two, by a factor of 80."""
    session, rng = rigs.simulate(3, 4, 20.0), np.random.default_rng(3)
    cameras = {
        name: replace(
            camera,
            position=session.poses[name].position + 0.02 * rng.standard_normal(3),
            position_std=np.full(3, 0.02),
        )
        for name, camera in session.rig.cameras.items()
    }
    off = rng.standard_normal(3)
    wrong = cameras["cam1"]
    assert wrong.position is not None
    cameras["cam1"] = replace(wrong, position=wrong.position + 0.16 * off / np.linalg.norm(off))
    found = calibrate(replace(session.rig, cameras=cameras), session.observations())
    (warning,) = [text for text in found.warnings if "reference" in text]
    assert "cannot be decided" in warning
    assert "cam1" in warning.split(" is wrong")[0]
