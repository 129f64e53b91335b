"""Gauge and scale: each kind of control point fixes what it determines, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.datum.gauge import fix_gauge
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats
from protocols.session.rig import Rig, RigCamera
from tests.support.rigs import random_poses

NAMES = ["cam0", "cam1", "cam2", "cam3"]


def simulated_world(seed: int, count: int = 4) -> tuple[list[Pose], list[Pose], Similarity]:
    """True poses, the same poses in the internal frame, and the similarity between them."""
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, count)
    turn, shift, scale = so3.exp(rng.normal(0, 1.5, 3)), rng.normal(0, 3, 3), float(rng.uniform(0.1, 10))
    inward = Similarity(1 / scale, turn, shift)
    back = Similarity(scale, turn.T, -scale * turn.T @ shift)
    return truth, [inward.pose(pose) for pose in truth], back


def rig(cameras: dict[str, dict[str, Floats]], count: int = 4, **metadata: object) -> Rig:
    table = {name: RigCamera(name, (1280, 720), **cameras.get(name, {})) for name in NAMES[:count]}  # type: ignore[arg-type]
    return replace(Rig(table), **metadata)  # type: ignore[arg-type]


def assert_same_similarity(found: Similarity, truth: Similarity, tolerance: float = 1e-6) -> None:
    assert found.scale == pytest.approx(truth.scale, rel=tolerance)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=tolerance)
    np.testing.assert_allclose(found.shift, truth.shift, atol=tolerance * 30 * max(1.0, truth.scale))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [3, 4])
def test_known_positions_recover_any_similarity(seed: int, count: int) -> None:
    truth, internal, similarity = simulated_world(seed)
    known = {name: {"position": pose.position} for name, pose in zip(NAMES[:count], truth, strict=False)}
    gauge = fix_gauge(rig(known), NAMES, internal)
    assert_same_similarity(gauge.similarity, similarity)
    assert gauge.scale == "metric"
    assert not gauge.warnings


@pytest.mark.parametrize("seed", range(6))
def test_two_positions_and_a_rotation_are_enough(seed: int) -> None:
    truth, internal, similarity = simulated_world(seed)
    known = {"cam1": {"position": truth[1].position, "rotation": truth[1].rotation}}
    known["cam3"] = {"position": truth[3].position}
    gauge = fix_gauge(rig(known), NAMES, internal)
    assert_same_similarity(gauge.similarity, similarity)
    assert gauge.scale == "metric"


@pytest.mark.parametrize("seed", range(6))
def test_one_pose_and_a_distance_are_enough(seed: int) -> None:
    truth, internal, similarity = simulated_world(seed)
    known = {"cam2": {"position": truth[2].position, "rotation": truth[2].rotation}}
    apart = float(np.linalg.norm(truth[0].position - truth[3].position))
    gauge = fix_gauge(rig(known, distances=(("cam0", "cam3", apart),)), NAMES, internal)
    assert_same_similarity(gauge.similarity, similarity)
    assert gauge.scale == "metric"


@pytest.mark.parametrize("seed", range(4))
def test_one_pose_alone_fixes_no_scale_so_the_first_camera_is_the_world_frame(seed: int) -> None:
    """DESIGN: with an arbitrary scale the first camera is the world and the first baseline is 1."""
    truth, internal, _ = simulated_world(seed)
    known = {"cam2": {"position": truth[2].position, "rotation": truth[2].rotation}}
    gauge = fix_gauge(rig(known), NAMES, internal)
    moved = [gauge.similarity.pose(pose) for pose in internal]
    assert gauge.scale == "arbitrary"
    assert any("no scale" in text for text in gauge.warnings)
    np.testing.assert_allclose(moved[0].position, 0.0, atol=1e-9)
    np.testing.assert_allclose(moved[0].rotation, np.eye(3), atol=1e-9)
    assert np.linalg.norm(moved[1].position - moved[0].position) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(4))
def test_one_pose_and_a_distance_fix_everything(seed: int) -> None:
    truth, internal, similarity = simulated_world(seed)
    known = {"cam2": {"position": truth[2].position, "rotation": truth[2].rotation}}
    apart = float(np.linalg.norm(truth[0].position - truth[1].position))
    gauge = fix_gauge(rig(known, distances=(("cam0", "cam1", apart),)), NAMES, internal)
    assert gauge.scale == "metric"
    assert_same_similarity(gauge.similarity, similarity, 1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_distance_alone_gives_the_scale_in_the_first_cameras_frame(seed: int) -> None:
    truth, internal, similarity = simulated_world(seed)
    apart = float(np.linalg.norm(truth[1].position - truth[2].position))
    gauge = fix_gauge(rig({}, distances=(("cam1", "cam2", apart),)), NAMES, internal)
    assert gauge.scale == "metric"
    assert gauge.similarity.scale == pytest.approx(similarity.scale)
    first = gauge.similarity.pose(internal[0])
    np.testing.assert_allclose(first.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(first.position, 0, atol=1e-9)


def test_several_distances_are_averaged() -> None:
    truth, internal, similarity = simulated_world(1)
    pairs = [(0, 1), (1, 2), (0, 2)]
    lengths = [
        (NAMES[a], NAMES[b], float(np.linalg.norm(truth[a].position - truth[b].position)) * factor)
        for (a, b), factor in zip(pairs, (1.001, 1.0, 0.999), strict=True)
    ]
    gauge = fix_gauge(rig({}, distances=tuple(lengths)), NAMES, internal)
    assert gauge.similarity.scale == pytest.approx(similarity.scale, rel=8e-4)


@pytest.mark.parametrize("seed", range(4))
def test_without_control_points_the_first_camera_is_the_world_frame_and_the_first_baseline_is_one(seed: int) -> None:
    _, internal, _ = simulated_world(seed)
    gauge = fix_gauge(rig({}), NAMES, internal)
    moved = [gauge.similarity.pose(pose) for pose in internal]
    np.testing.assert_allclose(moved[0].rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(moved[0].position, 0, atol=1e-9)
    assert np.linalg.norm(moved[1].position) == pytest.approx(1.0)
    assert gauge.scale == "arbitrary"
    assert not gauge.information.dense().any()
    assert not gauge.warnings


@pytest.mark.parametrize("name", ["cam0", "cam2"])
def test_a_levelled_camera_determines_up(name: str) -> None:
    _, internal, _ = simulated_world(2)
    gauge = fix_gauge(rig({}, up=name), NAMES, internal)
    pose = gauge.similarity.pose(internal[NAMES.index(name)])
    np.testing.assert_allclose(pose.rotation.T @ [0, -1, 0], [0, 0, 1], atol=1e-9)
    first = gauge.similarity.pose(internal[0])
    np.testing.assert_allclose(first.position, 0, atol=1e-9)
    assert np.linalg.det(gauge.similarity.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("surveyed", [False, True])
def test_a_camera_with_an_up_vector_need_not_be_levelled(surveyed: bool) -> None:
    """Two positions leave the rotation about their line free; the vertical in cam1's axes fixes it."""
    truth, internal, similarity = simulated_world(6)
    up_in_camera = truth[1].rotation @ [0.0, 0.0, 1.0]
    known: dict[str, dict[str, Floats]] = {"cam1": {"up": up_in_camera}}
    if surveyed:
        known["cam0"] = {"position": truth[0].position}
        known["cam1"]["position"] = truth[1].position
    gauge = fix_gauge(rig(known, up="cam1"), NAMES, internal)
    pose = gauge.similarity.pose(internal[1])
    np.testing.assert_allclose(pose.rotation.T @ up_in_camera, [0, 0, 1], atol=1e-6)
    if surveyed:
        np.testing.assert_allclose(gauge.similarity.rotation, similarity.rotation, atol=1e-5)


def test_up_as_a_vector_of_the_first_camera_makes_the_world_upright() -> None:
    _, internal, _ = simulated_world(3)
    up = np.array([0.1, -0.9, 0.2]) / np.linalg.norm([0.1, -0.9, 0.2])
    gauge = fix_gauge(rig({}, up=up), NAMES, internal)
    pose = gauge.similarity.pose(internal[0])
    np.testing.assert_allclose(pose.rotation.T @ up, [0, 0, 1], atol=1e-9)


def test_up_and_a_distance_make_a_metric_upright_world() -> None:
    truth, internal, similarity = simulated_world(4)
    apart = float(np.linalg.norm(truth[0].position - truth[1].position))
    gauge = fix_gauge(rig({}, up="cam1", distances=(("cam0", "cam1", apart),)), NAMES, internal)
    assert gauge.similarity.scale == pytest.approx(similarity.scale)
    level = gauge.similarity.pose(internal[1]).rotation.T @ [0, -1, 0]
    np.testing.assert_allclose(level, [0, 0, 1], atol=1e-6)


def levelled(pose: Pose) -> Pose:
    """The same camera with its right axis horizontal and its down axis straight down."""
    right = np.array([pose.rotation[0, 0], pose.rotation[0, 1], 0.0])
    right, down = right / np.linalg.norm(right), np.array([0.0, 0.0, -1.0])
    return Pose(np.stack([right, down, np.cross(right, down)]), pose.position)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("same_height", [False, True])
def test_two_positions_and_a_levelled_camera_fix_the_gauge(seed: int, same_height: bool) -> None:
    """The levelled camera fixes the rotation about the line between the two: upright, not upside down."""
    truth, _, similarity = simulated_world(seed)
    truth[2] = levelled(truth[2])
    if same_height:
        truth = [Pose(pose.rotation, pose.position * [1.0, 1.0, 0.0]) for pose in truth]
    turn = similarity.rotation.T
    inward = Similarity(1 / similarity.scale, turn, -turn @ similarity.shift / similarity.scale)
    known = {"cam0": {"position": truth[0].position}, "cam1": {"position": truth[1].position}}
    gauge = fix_gauge(rig(known, up="cam2"), NAMES, [inward.pose(pose) for pose in truth])
    assert_same_similarity(gauge.similarity, similarity, 1e-4)


def test_an_up_vector_does_not_disturb_surveyed_positions() -> None:
    """up = [0, 0, 1] with surveyed positions is the z axis of the survey."""
    truth, internal, _ = simulated_world(5)
    known = {"cam0": {"position": truth[0].position}, "cam1": {"position": truth[1].position}}
    gauge = fix_gauge(rig(known, up=np.array([0.0, 0.0, 1.0])), NAMES, internal)
    moved = [gauge.similarity.pose(pose) for pose in internal]
    for i in (0, 1):
        np.testing.assert_allclose(moved[i].position, truth[i].position, atol=1e-6)


def test_a_levelled_camera_that_was_not_solved_is_refused() -> None:
    _, internal, _ = simulated_world(2)
    with pytest.raises(Refused, match="cam3"):
        fix_gauge(rig({}, up="cam3"), NAMES[:3], internal[:3])


def test_control_points_of_cameras_that_were_not_solved_are_ignored() -> None:
    truth, internal, similarity = simulated_world(6)
    known = {name: {"position": pose.position} for name, pose in zip(NAMES, truth, strict=True)}
    known["cam3"] = {"position": np.array([99.0, 0, 0])}
    gauge = fix_gauge(rig(known, distances=(("cam0", "cam3", 5.0),)), NAMES[:3], internal[:3])
    assert_same_similarity(gauge.similarity, similarity)


def test_positions_that_contradict_each_other_are_reported() -> None:
    truth, internal, _ = simulated_world(7)
    known = {name: {"position": pose.position} for name, pose in zip(NAMES, truth, strict=True)}
    known["cam2"] = {"position": truth[2].position + [0.5, 0, 0]}
    gauge = fix_gauge(rig(known), NAMES, internal)
    assert gauge.warnings


def test_a_contradicting_distance_is_reported() -> None:
    truth, internal, _ = simulated_world(8)
    known = {name: {"position": pose.position} for name, pose in zip(NAMES, truth, strict=True)}
    apart = float(np.linalg.norm(truth[0].position - truth[1].position))
    gauge = fix_gauge(rig(known, distances=(("cam0", "cam1", 1.2 * apart),)), NAMES, internal)
    assert gauge.warnings


def test_two_positions_whose_distance_is_contradicted_are_reported() -> None:
    truth, internal, _ = simulated_world(8)
    known = {name: {"position": pose.position} for name, pose in zip(NAMES[:2], truth, strict=False)}
    apart = float(np.linalg.norm(truth[0].position - truth[1].position))
    gauge = fix_gauge(rig(known, distances=(("cam0", "cam1", 1.2 * apart),)), NAMES, internal)
    assert gauge.warnings


def test_small_survey_errors_within_their_stds_are_no_contradiction() -> None:
    truth, internal, _ = simulated_world(9)
    rng = np.random.default_rng(0)
    known = {
        name: {"position": pose.position + rng.normal(0, 0.01, 3), "position_std": np.full(3, 0.01)}
        for name, pose in zip(NAMES, truth, strict=True)
    }
    gauge = fix_gauge(rig(known), NAMES, internal)
    assert not gauge.warnings


def test_positions_are_weighted_by_their_stds() -> None:
    truth, internal, _ = simulated_world(10)
    known = {
        name: {"position": pose.position, "position_std": np.full(3, 0.001)}
        for name, pose in zip(NAMES, truth, strict=True)
    }
    known["cam1"] = {"position": truth[1].position + 0.3, "position_std": np.full(3, 1.0)}
    gauge = fix_gauge(rig(known), NAMES, internal)
    for pose, there in zip(internal, truth, strict=True):
        np.testing.assert_allclose(gauge.similarity.pose(pose).position, there.position, atol=2e-3)


def test_a_std_of_zero_is_exact_and_not_infinite() -> None:
    truth, internal, similarity = simulated_world(10)
    known = {
        name: {"position": pose.position, "position_std": np.zeros(3)} for name, pose in zip(NAMES, truth, strict=True)
    }
    gauge = fix_gauge(rig(known), NAMES, internal)
    assert_same_similarity(gauge.similarity, similarity)
    assert np.isfinite(gauge.information.dense()).all()


def test_the_unit_of_length_makes_no_difference() -> None:
    truth, internal, similarity = simulated_world(11)
    known = {name: {"position": 1000 * pose.position} for name, pose in zip(NAMES, truth, strict=True)}
    found = fix_gauge(rig(known), NAMES, internal).similarity
    assert found.scale == pytest.approx(1000 * similarity.scale, rel=1e-6)
    np.testing.assert_allclose(found.shift, 1000 * similarity.shift, rtol=1e-5, atol=1e-2)


def test_cameras_in_a_line_do_not_mirror_the_world() -> None:
    """Surveyed cameras in a line: the rotation about the line is free, the rest is fixed."""
    truth, _, _ = simulated_world(12)
    line = [Pose(pose.rotation, np.array([float(i), 0.0, 0.0])) for i, pose in enumerate(truth)]
    inward = Similarity(0.3, so3.exp(np.array([0.4, 1.0, -2.0])), np.array([1.0, 2, 3]))
    known = {name: {"position": pose.position} for name, pose in zip(NAMES, line, strict=True)}
    gauge = fix_gauge(rig(known), NAMES, [inward.pose(pose) for pose in line])
    assert np.linalg.det(gauge.similarity.rotation) == pytest.approx(1.0)
    for pose in line:
        moved = gauge.similarity.pose(inward.pose(pose))
        np.testing.assert_allclose(moved.position, pose.position, atol=1e-6)


@pytest.mark.parametrize("count", [2, 3])
def test_a_line_of_positions_leaves_a_turn_about_it_which_is_told(count: int) -> None:
    rng = np.random.default_rng(1)
    line, truth = rng.normal(size=3), random_poses(rng, 4)
    poses = [*(replace(pose, position=i * line) for i, pose in enumerate(truth[:count])), *truth[count:]]
    known: dict[str, dict[str, Floats]] = {NAMES[i]: {"position": poses[i].position} for i in range(count)}
    (told,) = fix_gauge(rig(known), NAMES, poses).warnings
    assert f"the line through the known positions of {', '.join(NAMES[:count])} is not determined" in told
    known["cam3"] = {"rotation": poses[3].rotation}
    assert not fix_gauge(rig(known), NAMES, poses).warnings


@pytest.mark.parametrize("apart", [0.0, 1e-12])
def test_positions_that_are_one_point_are_named(apart: float) -> None:
    truth, internal, _ = simulated_world(3)
    place = truth[0].position
    gauge = fix_gauge(rig({"cam0": {"position": place}, "cam1": {"position": place + apart}}), NAMES, internal)
    assert gauge.scale == "arbitrary"
    assert "the known positions of cam0, cam1 are one point" in gauge.warnings[0]
