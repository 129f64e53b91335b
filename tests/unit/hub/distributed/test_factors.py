"""Two-camera factors: linearisation against central differences, initialisation, streaming, datum."""

from __future__ import annotations

import numpy as np
import pytest

from hub.distributed.factors.factor import Edge, QuadraticFactor, stream_pending
from hub.distributed.factors.initialise import estimate_relative_pose
from hub.distributed.factors.two_view_model import (
    RelativeTransform,
    linearise_observations,
    stack_transforms,
    triangulate,
)
from hub.distributed.network.block_solver import (
    FactorTerm,
    linearise_term,
    local_coordinates,
    normal_equations,
    relative_transform,
    retract,
)
from hub.distributed.network.datum import world_from_network
from hub.distributed.network.messages import Anchor, ControlPoint
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity

TRUE = RelativeTransform(so3.exp(np.array([0.1, 0.6, 0.2])), np.array([5.0, 0.5, 1.5]))


def _rows(rng: np.random.Generator, n: int, noise: float = 1.0, sized: bool = True) -> tuple[np.ndarray, np.ndarray]:
    points = rng.uniform(-2, 2, (n, 3)) + [0.0, 0.0, 9.0]
    weights = np.tile([600.0, 50.0, 600.0, 50.0], (n, 1))
    rows = np.empty((n, 6))
    for at, local in ((0, points), (3, (points - TRUE.centre) @ TRUE.rotation.T)):
        rows[:, at : at + 2] = local[:, :2] / local[:, 2:] + noise * rng.standard_normal((n, 2)) / 600.0
        rows[:, at + 2] = -np.log(local[:, 2]) + noise * rng.standard_normal(n) / 50.0
    if not sized:
        rows[:, [2, 5]], weights[:, [1, 3]] = 0.0, 0.0
    return rows, weights


@pytest.mark.parametrize("sized", [True, False])
def test_the_gradient_is_that_of_chi2_with_the_point_eliminated(sized: bool) -> None:
    rows, weights = _rows(np.random.default_rng(1), 20, 1.0, sized)
    pose = TRUE.retract(np.full(6, 0.002))
    terms = linearise_observations(pose, rows, weights)
    for i, axis in enumerate(np.eye(6)):
        ahead = linearise_observations(pose.retract(1e-5 * axis), rows, weights).chi2
        behind = linearise_observations(pose.retract(-1e-5 * axis), rows, weights).chi2
        np.testing.assert_allclose(terms.gradient[:, i], 0.5 * (ahead - behind) / 2e-5, rtol=2e-3, atol=0.5)


def test_exact_observations_have_zero_residuals() -> None:
    rows, weights = _rows(np.random.default_rng(2), 30, 0.0)
    terms = linearise_observations(TRUE, rows, weights)
    assert terms.in_front.all()
    assert terms.chi2.max() < 1e-12
    depth = triangulate(TRUE, rows, weights)[:, 2]
    np.testing.assert_allclose(depth, np.exp(-rows[:, 2]), rtol=1e-9)


def test_one_pose_per_row_gives_the_same_terms() -> None:
    rows, weights = _rows(np.random.default_rng(3), 10)
    other = TRUE.retract(np.full(6, 0.01))
    both = linearise_observations(stack_transforms([TRUE, other], [4, 6]), rows, weights)
    np.testing.assert_allclose(both.hessian[:4], linearise_observations(TRUE, rows[:4], weights[:4]).hessian)
    np.testing.assert_allclose(both.gradient[4:], linearise_observations(other, rows[4:], weights[4:]).gradient)


def test_chi2_has_three_degrees_of_freedom_with_sizes_and_one_without() -> None:
    rng = np.random.default_rng(4)
    for sized, dof in ((True, 3.0), (False, 1.0)):
        rows, weights = _rows(rng, 4000, 1.0, sized)
        assert linearise_observations(TRUE, rows, weights).chi2.mean() == pytest.approx(dof, rel=0.06)


@pytest.mark.parametrize(("sized", "n"), [(True, 16), (False, 60)])
def test_the_initialisation_is_robust_to_outliers(sized: bool, n: int) -> None:
    rng = np.random.default_rng(5)
    rows, weights = _rows(rng, n, 1.0, sized)
    wrong = np.arange(n) % 5 == 0
    rows[wrong, 3:5] = rng.uniform(-0.5, 0.5, (wrong.sum(), 2))
    found = estimate_relative_pose(rows, weights, rng)
    assert found is not None
    pose, inlier = found
    assert not inlier[wrong].any()
    assert so3.angle_between(pose.rotation, TRUE.rotation) < 0.03
    way = pose.centre / np.linalg.norm(pose.centre)
    assert np.linalg.norm(way - TRUE.centre / np.linalg.norm(TRUE.centre)) < 0.06


def test_the_initialisation_fails_on_unrelated_observations() -> None:
    rng = np.random.default_rng(6)
    rows, weights = _rows(rng, 40)
    rows[:, 3:6] = rows[rng.permutation(40), 3:6]
    assert estimate_relative_pose(rows, weights, rng) is None


def test_streaming_converges_to_the_batch_estimate() -> None:
    rng = np.random.default_rng(7)
    rows, weights = _rows(rng, 600)
    edge = Edge(1, rng)
    for i in range(0, 600, 12):
        for row, weight in zip(rows[i : i + 12], weights[i : i + 12], strict=True):
            edge.add((*row, *weight))
        if edge.streaming:
            assert stream_pending([(edge, None)]) == []
        else:
            edge.flush_raw(None)
    assert edge.streaming
    assert edge.factor is not None
    assert edge.state_bytes < 1024
    streamed = edge.factor.anchor.retract(edge.factor.newton_step())
    pose = TRUE
    for _ in range(6):
        terms = linearise_observations(pose, rows, weights)
        pose = pose.retract(-np.linalg.solve(terms.hessian.sum(0), terms.gradient.sum(0)))
    apart = pose.local_coordinates(streamed)
    assert apart @ terms.hessian.sum(0) @ apart < 0.2  # a standard deviation is 1


def test_an_edge_with_a_wrong_anchor_is_reported() -> None:
    rng = np.random.default_rng(8)
    edge = Edge(1, rng)
    rows, weights = _rows(rng, 200)
    bad: list[Edge] = []
    broken = False
    for row, weight in zip(rows, weights, strict=True):
        edge.add((*row, *weight))
        if not edge.streaming:
            edge.flush_raw(None)
            continue
        assert edge.factor is not None
        if not broken:
            broken = True
            wrong = TRUE.retract(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
            edge.factor = QuadraticFactor(wrong, 1e3 * edge.factor.hessian, np.zeros(6), 97.0, False)
        bad += stream_pending([(edge, None)])
    assert bad


def _pose(rng: np.random.Generator) -> Pose:
    return Pose(so3.exp(rng.normal(0, 1, 3)), rng.normal(0, 3, 3))


@pytest.mark.parametrize("bearings", [False, True])
@pytest.mark.parametrize("reverse", [False, True])
def test_a_cameras_gradient_is_that_of_its_factors(bearings: bool, reverse: bool) -> None:
    rng = np.random.default_rng(9)
    own, other, root = _pose(rng), _pose(rng), rng.normal(0, 1, (6, 6))
    seen = relative_transform(other, own) if reverse else relative_transform(own, other)
    flat = np.eye(6)
    if bearings:
        flat[3:, 3:] -= np.outer(seen.centre, seen.centre) / (seen.centre @ seen.centre)
    factor = QuadraticFactor(
        seen.retract(1e-4 * rng.normal(0, 1, 6)), flat @ root @ root.T @ flat, flat @ np.full(6, 0.01), 1.0, bearings
    )

    def cost(pose: Pose) -> float:
        e = factor.local_coordinates(relative_transform(other, pose) if reverse else relative_transform(pose, other))
        return float(0.5 * e @ factor.hessian @ e + factor.gradient @ e)

    _, gradient = normal_equations(own, [FactorTerm(factor, other, reverse)])
    numeric = [(cost(retract(own, 1e-6 * v)) - cost(retract(own, -1e-6 * v))) / 2e-6 for v in np.eye(6)]
    np.testing.assert_allclose(gradient, numeric, atol=1e-5)


def test_a_gauge_transformation_does_not_change_the_cost() -> None:
    rng = np.random.default_rng(10)
    own, other, root = _pose(rng), _pose(rng), rng.normal(0, 1, (6, 6))
    factor = QuadraticFactor(
        relative_transform(own, other).retract(0.1 * rng.normal(0, 1, 6)), root @ root.T, np.zeros(6), 1.0, False
    )
    anywhere = Similarity(1.0, so3.exp(rng.normal(0, 1, 3)), rng.normal(0, 5, 3))
    before = linearise_term(own, FactorTerm(factor, other))
    after = linearise_term(anywhere.pose(own), FactorTerm(factor, anywhere.pose(other)))
    np.testing.assert_allclose(after[1], before[1], atol=1e-9)


def test_retract_inverts_local_coordinates() -> None:
    rng = np.random.default_rng(11)
    a = _pose(rng)
    b = retract(a, rng.normal(0, 0.2, 6))
    there = retract(a, local_coordinates(a, b))
    np.testing.assert_allclose(there.rotation, b.rotation, atol=1e-12)
    np.testing.assert_allclose(there.position, b.position, atol=1e-12)


def test_the_datum_is_found_from_a_minimal_and_a_redundant_set_of_control_points() -> None:
    rng = np.random.default_rng(12)
    truth = Similarity(30.0, so3.exp(rng.normal(0, 1, 3)), rng.normal(0, 100, 3))
    inside = [_pose(rng) for _ in range(4)]
    outside = [truth.pose(p) for p in inside]
    minimal = [ControlPoint(outside[0].position, outside[0].rotation), ControlPoint(outside[1].position)]
    more = [*minimal, ControlPoint(outside[2].position), ControlPoint(outside[3].position, outside[3].rotation)]
    for references in (minimal, more):
        anchors = [Anchor(k, 0, 1, 0, inside[k], control_point) for k, control_point in enumerate(references)]
        found = world_from_network(anchors)
        assert found is not None
        assert found.scale == pytest.approx(30.0, rel=1e-6)
        np.testing.assert_allclose(found.points(np.ones((1, 3))), truth.points(np.ones((1, 3))), rtol=1e-5)
    assert world_from_network([Anchor(0, 0, 1, 0, inside[0], minimal[0])]) is None
