"""`--solver distributed`: pose nodes on recorded sessions, against the truth and the joint solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.core.errors import Refused
from protocols.geometry.pose import fit_similarity
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from tests.integration.offline.test_shared_clock import errors as shared_errors
from tests.integration.offline.test_shared_clock import scattered
from tests.support.rigs import Session, simulate


def _error(session: Session, found: Calibration) -> tuple[float, float]:
    """Mean position error [m] after a similarity, and the largest rotation error [rad]."""
    names = list(found.cameras)
    source = np.array([found.cameras[name].pose.position for name in names])
    target = np.array([session.poses[name].position for name in names])
    off = fit_similarity(source, target).points(source) - target
    turn = session.turn_error({name: camera.pose for name, camera in found.cameras.items()})
    return float(np.linalg.norm(off, axis=1).mean()), turn


def test_cameras_without_a_shared_clock_are_placed_as_accurately_as_by_the_joint_solver() -> None:
    session = simulate(4, 3, 12.0, outliers=0.05)
    nodes = calibrate(session.rig, session.observations(), solver="distributed")
    assert nodes.solver == "distributed"
    assert not nodes.refused
    joint = calibrate(session.rig, session.observations())
    far, turn = _error(session, nodes)
    best, best_turn = _error(session, joint)
    assert far < 0.005 + best
    assert turn < 2.0 * best_turn + np.deg2rad(0.05)
    for name, camera in nodes.cameras.items():
        assert abs(session.clock_error(name, nodes.reference, camera.time_map)) < 1e-3
    assert len(nodes.trajectories[0].time) > 250


def test_the_result_does_not_depend_on_the_order_of_rows() -> None:
    session = simulate(5, 3, 10.0)
    shuffled = np.random.default_rng(0).permutation(len(session.time))
    one = calibrate(session.rig, session.observations(), solver="distributed")
    other = calibrate(session.rig, session.observations(shuffled), solver="distributed")
    for name, camera in one.cameras.items():
        np.testing.assert_array_equal(camera.pose.position, other.cameras[name].pose.position)
        assert camera.time_map == other.cameras[name].time_map


def test_a_camera_that_observes_another_target_is_refused() -> None:
    session = simulate(6, 4, 10.0, unrelated=[2])
    found = calibrate(session.rig, session.observations(), solver="distributed")
    assert list(found.refused) == ["cam2"]
    assert _error(session, found)[1] < np.deg2rad(0.5)


def test_a_shared_clock_and_separate_points() -> None:
    from edge import scenes

    scene = scenes.get_marker_scene("marker", 3, 5)
    rig, observations = scattered(scene, 500, 2, 0.5, 0.03)
    found = calibrate(rig, observations, solver="distributed")
    assert all(camera.time_map.time_offset == 0.0 for camera in found.cameras.values())
    turn, far = shared_errors(scene, found)
    assert turn < 0.3
    assert far < 0.03


def test_the_nodes_and_the_papers_method_use_sizes() -> None:
    from edge import scenes

    scene = scenes.get_marker_scene("marker", 3, 5)
    rig, bare = scattered(scene, 600, 2, 0.5, 0.0)
    points = np.array([0.0, 0.0, 1.3]) + np.random.default_rng(0).uniform(-0.75, 0.75, (600, 3))
    rng, tracks = np.random.default_rng(1), {}
    for key, track in bare.tracks.items():
        camera = scene.camera(key[0])
        depth = camera.pose.camera_from_world(points[track.frame])[:, 2]
        size = camera.intrinsics.focal * 0.1 / depth * np.exp(0.02 * rng.normal(size=len(depth)))
        tracks[key] = replace(track, size=size)
    sized = Observations(tracks)
    turn, far = shared_errors(scene, calibrate(rig, sized, solver="distributed"))
    assert turn < 0.3
    assert far < 0.03
    paper = calibrate(rig, sized, solver="paper")
    assert paper.solver == "paper"
    turn, far = shared_errors(scene, paper)
    assert turn < 3.0
    assert far < 0.25
    with pytest.raises(Refused, match="paper's method finds lags"):
        calibrate(rig, bare, solver="paper")


def test_two_cameras_without_common_targets_are_refused() -> None:
    session = simulate(7, 2, 6.0, unrelated=[1])
    with pytest.raises(Refused):
        calibrate(session.rig, session.observations(), solver="distributed")
