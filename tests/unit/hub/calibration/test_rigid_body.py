"""Calibration by a board: clocks, poses, lenses and scale of unsynchronised cameras against exact truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from hub.calibration.rigid_body.problem import rotated
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.session.calibration import Calibration, read_calibration
from protocols.session.rig import Rig
from tests.support.board_session import BoardWorld, board_world
from tests.support.written import write_calibration


def errors(world: BoardWorld, found: Calibration) -> dict[str, tuple[float, float, float]]:
    """By camera, against the first: position [m], rotation [degrees] and lag [s, in the middle of its span]."""
    first, base = found.cameras["cam0"].pose, world.cameras["cam0"].pose
    out = {}
    for name, camera in found.cameras.items():
        truth = world.cameras[name]
        turn = camera.pose.rotation @ first.rotation.T
        true_turn = truth.pose.rotation @ base.rotation.T
        place = first.camera_from_world(camera.pose.position[None]) - base.camera_from_world(truth.pose.position[None])
        at = camera.lag_time
        lag = camera.time_map.clock_rate * at + camera.time_map.time_offset - (truth.rate * at + truth.offset)
        out[name] = float(np.linalg.norm(place)), float(np.degrees(so3.angle_between(turn, true_turn))), float(lag)
    return out


@pytest.mark.parametrize(("fps", "most_lag"), [((6.0, 6.0, 6.0, 6.0), 1e-3), ((30.0, 25.0, 10.0), 5e-4)])
def test_cameras_of_any_rate_are_placed_in_metres_and_on_one_clock(fps: tuple[float, ...], most_lag: float) -> None:
    world = board_world(3, fps)
    found = calibrate(world.rig(), world.observations())
    assert found.scale == "metric"
    assert list(found.cameras) == list(world.cameras)
    for place, turn, lag in errors(world, found).values():
        assert place < 0.003
        assert turn < 0.1
        assert abs(lag) < most_lag


def test_the_stds_of_lags_and_positions_hold() -> None:
    scores = []
    for seed in (1, 2, 20, 21):
        world = board_world(seed, (6.0, 10.0, 6.0))
        found = calibrate(world.rig(), world.observations(seed=seed))
        for name, (place, _, lag) in errors(world, found).items():
            if name != "cam0":
                camera = found.cameras[name]
                scores.append([lag / camera.time_offset_std, place / float(np.linalg.norm(camera.position_std))])
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert (rms > 0.2).all()
    assert (rms < 2.0).all()


def test_lenses_are_estimated_from_the_same_views_with_their_stds() -> None:
    world = board_world(6, (10.0, 10.0, 10.0))
    found = calibrate(world.rig(lenses=False), world.observations())
    for name, camera in found.cameras.items():
        off = abs(camera.intrinsics.focal / world.cameras[name].lens.focal - 1.0)
        assert 0.0 < camera.focal_std < 0.005
        assert off < 4.0 * camera.focal_std
        note = next(text for text in found.warnings if text.startswith(f"{name}: its lens"))
        axis = np.deg2rad(float(note.split("optical axis ± ")[1].split("°")[0])) * camera.intrinsics.focal
        centre = camera.intrinsics.matrix[:2, 2] - world.cameras[name].lens.matrix[:2, 2]
        assert 0.0 < axis < 10.0
        assert np.abs(centre).max() < 4.0 * axis


@pytest.mark.parametrize("lenses", [False, True])
def test_the_readout_of_rolling_shutters_is_estimated_and_leaves_lenses_and_lags_alone(lenses: bool) -> None:
    world = board_world(6, (10.0, 10.0))
    found = calibrate(world.rig(lenses=lenses), world.observations(8.0, readout=0.015))
    off = errors(world, found)
    for name, camera in found.cameras.items():
        assert abs(off[name][2]) <= 4.0 * camera.lag_std
        assert 0.0 < camera.readout_std < 0.001
        assert abs(camera.readout - 0.015) < 4.0 * camera.readout_std
        assert abs(camera.intrinsics.focal / world.cameras[name].lens.focal - 1.0) <= 4.0 * camera.focal_std


def test_time_errors_of_single_frames_are_estimated() -> None:
    world = board_world(7)
    found = calibrate(world.rig(), world.observations(jitter=0.02))
    assert sum("its stamps jitter" in text for text in found.warnings) == 4
    for place, turn, _ in errors(world, found).values():
        assert place < 0.005
        assert turn < 0.15


def test_a_board_of_unknown_size_gives_no_scale() -> None:
    world = board_world(8, (10.0, 10.0))
    rig = replace(world.rig(scale=20.0), metadata={"bodies_scale": "arbitrary"})
    found = calibrate(rig, world.observations())
    assert found.scale == "arbitrary"
    assert float(np.linalg.norm(found.cameras["cam1"].pose.position)) == pytest.approx(1.0, abs=1e-9)


def test_a_camera_that_saw_another_board_is_refused_with_the_reason() -> None:
    world, other = board_world(9), board_world(10)
    mine = world.observations()
    tracks = {key: track for key, track in mine.tracks.items() if key[0] != "cam3"}
    tracks |= {key: track for key, track in other.observations().tracks.items() if key[0] == "cam3"}
    found = calibrate(world.rig(), replace(mine, tracks=tracks))
    assert list(found.cameras) == ["cam0", "cam1", "cam2"]
    assert "board" in found.refused["cam3"]


def test_one_camera_with_the_board_is_refused_in_the_users_words() -> None:
    world = board_world(11)
    mine = world.observations(4.0)
    alone = replace(mine, tracks={key: track for key, track in mine.tracks.items() if key[0] == "cam1"})
    with pytest.raises(Refused, match="show the board to two cameras"):
        calibrate(world.rig(), alone)


def test_the_derivative_of_a_rotated_point_by_its_quaternion() -> None:
    rng = np.random.default_rng(0)
    turn, points = rng.normal(size=(4, 4)), rng.normal(size=(4, 3))
    jacobian = rotated(turn, points)[1]
    for k in range(4):
        step = 1e-6 * np.eye(4)[k]
        slope = (rotated(turn + step, points)[0] - rotated(turn - step, points)[0]) / 2e-6
        assert np.abs(slope - jacobian[:, :, k]).max() < 1e-8


def in_step(world: BoardWorld) -> Rig:
    rig = world.rig()
    return replace(rig, metadata={**rig.metadata, "in_step": True})


def test_clips_with_the_same_stamps_are_in_step_where_lags_are_those_of_a_recorder() -> None:
    world = board_world(12, lag=0.03)
    read = calibrate(in_step(world), world.observations(jitter=0.03))
    assert any("recorded in step" in text for text in read.warnings)
    # Cameras whose frames come evenly were not read in one loop: a lag is a lag.
    even = calibrate(in_step(world), world.observations())
    assert not any("recorded in step" in text for text in even.warnings)
    for _, _, lag in errors(world, even).values():
        assert abs(lag) < 1e-3
    apart = board_world(12, lag=3.0)
    started = calibrate(in_step(apart), apart.observations(jitter=0.03))
    assert not any("recorded in step" in text for text in started.warnings)


def test_frames_that_come_evenly_keep_no_time_errors() -> None:
    scores = []
    for seed in (100, 101, 102):
        world = board_world(seed, (30.0, 25.0))
        found = calibrate(world.rig(), world.observations(6.0, noise=0.03, seed=seed)).cameras["cam1"]
        truth = world.cameras["cam1"]
        lag = found.time_map.clock_rate * found.lag_time + found.time_map.time_offset
        scores.append((lag - truth.rate * found.lag_time - truth.offset) / found.time_offset_std)
    assert float(np.sqrt(np.mean(np.square(scores)))) < 3.0


def test_the_shape_of_an_imperfect_print_is_estimated() -> None:
    world = board_world(13, (10.0, 10.0, 10.0))
    rng = np.random.default_rng(0)
    printed = {label: point + rng.normal(0.0, 2e-4, 3) for label, point in world.points.items()}
    found = calibrate(world.rig(lenses=False), replace(world, points=printed).observations())
    for name, camera in found.cameras.items():
        off = abs(np.log(camera.intrinsics.focal / world.cameras[name].lens.focal))
        assert off < 3.5 * camera.focal_std
        assert camera.rms_px < 1.15 * 0.15 * np.sqrt(2.0)


def test_a_board_that_looks_the_same_upside_down_may_be_seen_either_way_by_each_camera() -> None:
    world = board_world(14, (10.0, 10.0, 10.0))
    mine = world.observations(8.0)
    labels = list(world.points)
    opposite = dict(zip(labels, labels[::-1], strict=True))
    tracks = {}
    for (camera, label), track in mine.tracks.items():
        name = opposite[label] if camera == "cam1" else label
        tracks[camera, name] = replace(track, label=name)
    rig = world.rig()
    rig = replace(rig, metadata={**rig.metadata, "bodies_symmetric": True})
    found = calibrate(rig, replace(mine, tracks=tracks))
    for place, turn, lag in errors(world, found).values():
        assert place < 0.005
        assert turn < 0.2
        assert abs(lag) < 1e-3


def test_an_answer_can_be_read_again_though_its_readouts_are_longer_than_a_frame(tmp_path: Path) -> None:
    # As frames doubled by a converter give: 45 ms of readout at 30 frames a second.
    world = board_world(3, (30.0, 30.0), 1.0)
    found = calibrate(world.rig(), world.observations(5.0, readout=0.045))
    write_calibration(tmp_path / "calibration.toml", found, world.rig())
    assert read_calibration(tmp_path / "calibration.toml")[1]["cam1"].readout == pytest.approx(1.25 / 30.0)
