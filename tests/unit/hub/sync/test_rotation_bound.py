"""Bound of the angle to any other rotation that fits a pair's motion equally well."""

from __future__ import annotations

import numpy as np
import pytest

from hub.sync.final_refinement import LIKELIHOOD_MARGIN, rotation_bound
from hub.two_view.refinement import NoiseModel, PointPairs
from hub.two_view.relative_pose import RelativePose, sampson
from protocols.geometry import so3
from protocols.geometry.types import Floats

SIGMA = 0.5 / 700.0


def motion(size: float, seed: int) -> tuple[PointPairs, RelativePose]:
    """300 noisy points in a cube of half-width ``size`` at distance 5, seen by cameras 60° apart; and the true pose."""
    rng = np.random.default_rng(seed)
    turn = so3.exp(np.array([0.0, np.pi / 3.0, 0.0]))
    centre = np.array([0.0, 0.0, 5.0])
    points = rng.uniform(-size, size, (300, 3))
    seen = [points + centre, points @ turn.T + centre]
    velocity = rng.normal(0.0, size, (300, 3)) @ turn.T
    a, b = (one[:, :2] / one[:, 2:] + rng.normal(0.0, SIGMA, (300, 2)) for one in seen)
    velocity_b = (velocity[:, :2] - b * velocity[:, 2:]) / seen[1][:, 2:]
    baseline = centre - turn @ centre
    return PointPairs(a, b, velocity_b, np.zeros(300)), RelativePose(turn, baseline / np.linalg.norm(baseline))


def lowest_cost(pairs: PointPairs, rotation: Floats, near: Floats) -> float:
    """Mean squared Sampson distance of a rotation, with the direction that suits it best by reweighting."""
    a, b = (np.column_stack([points, np.ones(len(points))]) for points in (pairs.a, pairs.b))
    normals, direction = np.cross(a @ rotation.T, b), near
    for _ in range(5):
        pose = RelativePose(rotation, direction)
        over = sampson(pose.essential, pairs.a, pairs.b, SIGMA, SIGMA) / (normals @ direction)
        direction = np.linalg.eigh((normals * over[:, None] ** 2).T @ normals)[1][:, 0]
    return float(np.mean(sampson(RelativePose(rotation, direction).essential, pairs.a, pairs.b, SIGMA, SIGMA) ** 2))


@pytest.mark.parametrize(("size", "clear"), [(2.0, True), (0.2, False)])
def test_no_equally_likely_rotation_is_beyond_the_bound(size: float, clear: bool) -> None:
    """Rotations about many axes: some others are equally likely, none of them beyond the bound."""
    for seed in range(3):
        pairs, pose = motion(size, seed)
        bound = rotation_bound(pairs, pose.matrix, NoiseModel(SIGMA, SIGMA, 2e-4))
        assert (bound < 0.25) is clear
        limit = lowest_cost(pairs, pose.rotation, pose.direction) + LIKELIHOOD_MARGIN / len(pairs.a)
        axes = np.random.default_rng([seed, 1]).normal(size=(24, 3))
        likely = [
            angle
            for axis in axes / np.linalg.norm(axes, axis=1, keepdims=True)
            for angle in min(bound, 1.0) * np.geomspace(0.01, 1.5, 16)
            if lowest_cost(pairs, so3.exp(angle * axis) @ pose.rotation, pose.direction) < limit
        ]
        assert 0.0 < max(likely) <= bound
