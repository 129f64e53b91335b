"""Outlier test of control points: an outlier is rejected only where the others identify it."""

from __future__ import annotations

import numpy as np
import pytest

from hub.bundle.datum.control_outliers import reject_outliers, reject_refuted
from hub.bundle.datum.gauge import fix_gauge
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Floats
from protocols.session.rig import Rig, RigCamera
from tests.support.rigs import random_poses


def surveyed(
    seed: int,
    count: int,
    wrong: dict[int, Floats],
    noise: float = 0.0,
    *,
    turned: bool = False,
    std: float | None = None,
) -> tuple[Rig, list[str], list[Pose], list[Pose]]:
    """A rig with all positions surveyed, some wrong; names, true poses, solved poses in an arbitrary frame."""
    rng = np.random.default_rng(seed)
    truth, names = random_poses(rng, count), [f"cam{i}" for i in range(count)]
    inward = Similarity(float(rng.uniform(0.1, 10)), so3.exp(rng.normal(0, 1.5, 3)), rng.normal(0, 3, 3))
    cameras = {}
    for i, (name, pose) in enumerate(zip(names, truth, strict=True)):
        position = pose.position + rng.normal(0.0, 1.0, 3) * noise + wrong.get(i, np.zeros(3))
        cameras[name] = RigCamera(
            name,
            (1280, 720),
            position=position,
            rotation=pose.rotation if turned else None,
            position_std=None if std is None else np.full(3, std),
        )
    return Rig(cameras), names, truth, [inward.pose(pose) for pose in truth]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("count", "noise", "std"), [(4, 0.0, None), (6, 0.01, None), (4, 0.01, 0.01), (12, 0.02, None)]
)
def test_a_camera_moved_since_the_survey_is_rejected(seed: int, count: int, noise: float, std: float | None) -> None:
    rig, names, truth, poses = surveyed(seed, count, {2: np.array([0.6, 0.0, 0.0])}, noise, std=std)
    left, reported = reject_outliers(rig, names, poses)
    assert left.cameras["cam2"].position is None
    assert [name for name in names if left.cameras[name].position is None] == ["cam2"]
    assert len(reported) == 1
    assert "cam2" in reported[0]
    world = fix_gauge(left, names, poses).similarity
    for pose, there in zip(poses, truth, strict=True):
        assert np.linalg.norm(world.pose(pose).position - there.position) < 4.0 * noise + 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_two_outliers_are_rejected_where_enough_inliers_remain(seed: int) -> None:
    wrong = {1: np.array([0.0, 0.7, 0.0]), 4: np.array([0.0, 0.0, -0.6])}
    rig, names, _, poses = surveyed(seed, 7, wrong, 0.01)
    left, reported = reject_outliers(rig, names, poses)
    assert [name for name in names if left.cameras[name].position is None] == ["cam1", "cam4"]
    assert len(reported) == 2


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("count", [3, 4, 5])
def test_an_inexact_survey_without_outliers_is_kept(seed: int, count: int) -> None:
    rig, names, _, poses = surveyed(seed, count, {}, 0.03)
    left, reported = reject_outliers(rig, names, poses)
    assert left is rig
    assert reported == ()


def test_an_outlier_among_three_positions_cannot_be_identified() -> None:
    rig, names, _, poses = surveyed(3, 3, {1: np.array([0.6, 0.0, 0.0])})
    assert reject_outliers(rig, names, poses) == (rig, ())


def test_with_attitudes_three_are_enough() -> None:
    rig, names, _, poses = surveyed(3, 3, {1: np.array([0.6, 0.0, 0.0])}, turned=True)
    left, _ = reject_outliers(rig, names, poses)
    assert left.cameras["cam1"].position is None
    assert left.cameras["cam1"].rotation is None
    assert left.cameras["cam0"].position is not None


def test_a_wrong_distance_among_correct_ones_is_rejected() -> None:
    rig, names, truth, poses = surveyed(4, 4, {})
    bare = {name: RigCamera(name, (1280, 720)) for name in names}
    far = [float(np.linalg.norm(truth[a].position - truth[b].position)) for a, b in ((0, 1), (1, 2), (2, 3), (0, 3))]
    ends = [("cam0", "cam1"), ("cam1", "cam2"), ("cam2", "cam3"), ("cam0", "cam3")]
    distances = tuple((a, b, d * (1.3 if a == "cam1" else 1.0)) for (a, b), d in zip(ends, far, strict=True))
    left, reported = reject_outliers(Rig(bare, distances=distances), names, poses)
    assert [d[:2] for d in left.distances] == [end for end in ends if end != ("cam1", "cam2")]
    assert "cam1–cam2" in reported[0]
    del rig


def test_a_reference_that_is_six_stds_off_is_doubted_or_rejected_and_correct_surveys_are_not() -> None:
    named, rejected, false = 0, 0, 0
    network = np.diag(np.tile([1e-6, 1e-6, 1e-6, 1e-8, 1e-8, 1e-8], 8))
    for seed in range(100):
        for wrong in ({}, {2: so3.exp(np.full(3, seed)) @ [0.12, 0.0, 0.0]}):
            rig, names, _, poses = surveyed(seed, 8, wrong, 0.02, std=0.02)
            left, warnings = reject_refuted(rig, names, poses, network)
            if not wrong:
                false += len(warnings)
            elif any("cam2" in text for text in warnings):
                named += 1
                rejected += left.cameras["cam2"].position is None
    assert (named >= 85, rejected < named, false <= 5) == (True, True, True), (named, rejected, false)
