"""Gauge and scale of the published world, from the rig's control points (positions, attitudes, distances) and ``up``.

Without control points the first camera is the world frame and the first baseline is 1. ``up`` alone rotates the world
so that z points up: ``up = [x, y, z]`` is a direction in the first camera's axes unless poses are known; a camera name
refers to the vertical of that camera: ``up`` of its own table, else the camera is levelled (-y points up).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.block_matrix import BlockSum
from hub.bundle.covariance import gauge_generators
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity, fit_similarity
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

_EXACT_STD = 1e-4
"""Std of a control point given without one, relative to the size of the rig, where the similarity is chosen among exact
ones that contradict each other; the adjustment then holds them exactly."""
_UP_STD = 0.01  # rad
CONTRADICTION_SIGMA = 8.0  # RMS residual in sigma from which contradicting control points are reported
_COINCIDENT = 1e-9  # of the coordinates, or rig units: known positions that differ by no more are one
_MAX_TURN_STD = 0.05  # rad: of the world's orientation, as of a camera's
_MET = 1e-6  # of the rig's size, or rad: how nearly exact control points are met that do not contradict each other
_MAX_CONTRADICTION = 0.1  # … and refused if they are off by more than this share of the rig's size, or rad


@dataclass(frozen=True, slots=True, eq=False)
class Gauge:
    """The similarity to the published world, and the information of the control points.

    scale: "metric" or "arbitrary". information: (18 n, 18 n) of the control points in the published world. exact:
    (q, 18 n) directions that control points without std fix. warnings: control points that contradict each other.
    """

    similarity: Similarity
    scale: str
    information: BlockSum
    exact: Floats
    warnings: tuple[str, ...]


def fix_gauge(rig: Rig, names: list[str], poses: list[Pose]) -> Gauge:
    """Find the published world for solved cameras ``names`` with ``poses`` in the internal one."""
    control = control_points_of(rig, names)
    if not control.fixes_scale:
        width = CAMERA_PARAMETERS * len(names)
        warnings: tuple[str, ...] = ()
        if control.positions or control.rotations:
            known = ", ".join(names[i] for i, _ in control.positions)
            one_point = f": the known positions of {known} are one point" if len(control.positions) > 1 else ""
            told = f"the control points fix no scale{one_point}, so the first camera is the world"
            warnings = (f"{told}: give two positions or a distance",)
        none = BlockSum(np.zeros(width))
        return Gauge(_default_datum(rig, names, poses), "arbitrary", none, np.zeros((0, width)), warnings)
    best, final = fit_to_control_points(rig, names, poses)
    found = []
    if len(final) and float(np.sqrt(np.mean(final**2))) > CONTRADICTION_SIGMA:
        worst, share = _worst_control_point(names, poses, control, best)
        if share > _MAX_CONTRADICTION:
            refusal = Refused(f"the rig's control points contradict each other or the observations: worst is {worst}")
            refusal.permanent = True
            raise refusal
        found.append(f"the rig's control points disagree with each other or the observations: worst is {worst}")
    if control.extent > 0.0 and _turn_std(best, control_point_residuals(rig, names, poses)) > _MAX_TURN_STD:
        line = ", ".join(names[i] for i, _ in control.positions)
        found.append(
            f"the rotation of the world about the line through the known positions of {line} is not determined by the "
            "references, and arbitrary: give a position off the line, a rotation or a levelled camera (up)"
        )
    published = [best.pose(pose) for pose in poses]
    terms, exact = control_point_terms(rig, names, published), exact_constraints(rig, names, published)[0]
    return Gauge(best, "metric", terms.information, exact, tuple(found))


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoints:
    """Control points of the solved cameras, with camera indices: positions (3,), attitudes (3, 3), distances."""

    positions: list[tuple[int, Floats]]
    rotations: list[tuple[int, Floats]]
    distances: list[tuple[int, int, float]]

    @property
    def extent(self) -> float:
        """Extent of the known positions; 0 of those that rounding cannot tell apart."""
        known = [position for _, position in self.positions]
        extent = float(np.linalg.norm(np.ptp(known, axis=0))) if len(known) >= 2 else 0.0
        return extent if extent > _COINCIDENT * max(1.0, float(np.abs(known).max(initial=0.0))) else 0.0

    @property
    def fixes_scale(self) -> bool:
        """Whether they determine the scale."""
        return self.extent > 0.0 or bool(self.distances)


def control_points_of(rig: Rig, names: list[str]) -> ControlPoints:
    """The rig's control points of the cameras ``names``."""
    known = [(i, rig.cameras[name]) for i, name in enumerate(names)]
    return ControlPoints(
        [(i, camera.position) for i, camera in known if camera.position is not None],
        [(i, camera.rotation) for i, camera in known if camera.rotation is not None],
        [(names.index(a), names.index(b), d) for a, b, d in rig.distances if a in names and b in names],
    )


def fit_to_control_points(rig: Rig, names: list[str], poses: list[Pose]) -> tuple[Similarity, Floats]:
    """The similarity that fits the control points, weighted by their stds, and their residuals in sigma.

    Needs control points that determine the scale.
    """
    control, base = control_points_of(rig, names), _default_datum(rig, names, poses)
    scale = base.scale
    if control.extent > 0.0:
        scale = _scale_ratio([p for _, p in control.positions], [poses[i].position for i, _ in control.positions])
    elif control.distances:
        lengths = [float(np.linalg.norm(poses[a].position - poses[b].position)) for a, b, _ in control.distances]
        scale = float(np.median([d / length for (_, _, d), length in zip(control.distances, lengths, strict=True)]))
    initial = _initial_similarities(control.rotations, control.positions, poses, scale, base)
    residual = control_point_residuals(rig, names, poses)
    best = min((_gauss_newton(start, residual) for start in initial), key=lambda item: item[1])[0]
    return best, residual(best)


def _worst_control_point(
    names: list[str],
    poses: list[Pose],
    control: ControlPoints,
    s: Similarity,
) -> tuple[str, float]:
    """Description of the control point with the largest error, and that error as a share of the rig's size (or rad)."""
    size = s.scale * _extent(poses)
    found: list[tuple[float, str]] = []
    for i, known in control.positions:
        off = float(np.linalg.norm(s.points(poses[i].position[None])[0] - known))
        found.append((off / size, f"the position of {names[i]}, {off:.3g} off"))
    for i, known in control.rotations:
        turn = so3.angle_between(poses[i].rotation @ s.rotation.T, known)
        found.append((turn, f"the rotation of {names[i]}, {np.degrees(turn):.3g} degrees off"))
    for a, b, length in control.distances:
        off = abs(s.scale * float(np.linalg.norm(poses[a].position - poses[b].position)) - length)
        found.append((off / length, f"the distance {names[a]}–{names[b]}, {off:.3g} off"))
    share, text = max(found, default=(0.0, "up"))
    return text, share


def identity_gauge(cameras: int, scale: str) -> Gauge:
    """The gauge of given poses: the identity."""
    width = CAMERA_PARAMETERS * cameras
    none = BlockSum(np.zeros(width))
    return Gauge(Similarity(1.0, np.eye(3), np.zeros(3)), scale, none, np.zeros((0, width)), ())


def _default_datum(rig: Rig, names: list[str], poses: list[Pose]) -> Similarity:
    """First camera = world, first baseline = 1; z points up where ``up`` is known."""
    first = poses[0]
    rotation = first.rotation
    up = rig.up
    if up is not None:
        if isinstance(up, str):
            if up not in names:
                raise Refused(f"up names {up}, which could not be solved")
            upward = poses[names.index(up)].rotation.T @ rig.up_in_camera(up)
        else:
            upward = first.rotation.T @ up
        ahead = first.rotation[2] - upward * (first.rotation[2] @ upward)
        if np.linalg.norm(ahead) < 1e-6:
            ahead = first.rotation[1] - upward * (first.rotation[1] @ upward)
        ahead = ahead / np.linalg.norm(ahead)
        rotation = np.stack([np.cross(ahead, upward), ahead, upward])  # x right, y ahead, z up
    scale = 1.0 / float(np.linalg.norm(poses[1].position - first.position)) if len(poses) > 1 else 1.0
    return Similarity(scale, rotation, -scale * rotation @ first.position)


def _scale_ratio(target: list[Floats], source: list[Floats]) -> float:
    t, s = np.array(target), np.array(source)
    return float(np.linalg.norm(t - t.mean(0)) / max(float(np.linalg.norm(s - s.mean(0))), 1e-12))


def _initial_similarities(
    rotations: list[tuple[int, Floats]],
    positions: list[tuple[int, Floats]],
    poses: list[Pose],
    scale: float,
    base: Similarity,
) -> list[Similarity]:
    """Initial similarities: from attitudes, from positions, and from rotations about the line of the positions."""
    turns = [poses[i].rotation for i, _ in rotations]
    guesses = [known.T @ turn for (_, known), turn in zip(rotations, turns, strict=True)] or [base.rotation]
    source = np.array([poses[i].position for i, _ in positions]).reshape(-1, 3)
    target = np.array([p for _, p in positions]).reshape(-1, 3)
    if len(positions) >= 3:
        guesses.append(fit_similarity(source, target).rotation)
    if len(positions) >= 2 and np.linalg.norm(target[1] - target[0]) > 0.0 and _is_collinear(target):
        line = so3.rotation_between(source[1] - source[0], target[1] - target[0])
        axis = (target[1] - target[0]) / max(float(np.linalg.norm(target[1] - target[0])), 1e-12)
        guesses += [so3.exp(angle * axis) @ line for angle in np.linspace(0, 2 * np.pi, 6, endpoint=False)]
    out = []
    for rotation in guesses:
        if len(positions):
            shift = target.mean(0) - scale * rotation @ source.mean(0)
        else:
            shift = -scale * rotation @ poses[0].position
        out.append(Similarity(scale, rotation, shift))
    return out


def _is_collinear(points: Floats) -> bool:
    """Whether the points (n, 3) are collinear, so that they leave the rotation about their line free."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return len(points) < 3 or bool(spread[1] < 0.02 * spread[0])


def control_point_residuals(rig: Rig, names: list[str], poses: list[Pose]) -> Callable[[Similarity], Floats]:
    """Residuals of all control points in sigma, as a function of the similarity."""
    control = control_points_of(rig, names)

    def residual(s: Similarity) -> Floats:
        size = s.scale * _extent(poses)
        out: list[Floats] = []
        for i, known in control.positions:
            std = rig.cameras[names[i]].position_std
            out.append((s.points(poses[i].position[None])[0] - known) / _std_or_exact(std, _EXACT_STD * size))
        for i, known in control.rotations:
            std = rig.cameras[names[i]].rotation_std
            turned = poses[i].rotation @ s.rotation.T
            out.append(so3.log(turned @ known.T) / _std_or_exact(std, _EXACT_STD))
        for a, b, length in control.distances:
            extent = s.scale * float(np.linalg.norm(poses[a].position - poses[b].position))
            out.append(np.array([(extent - length) / (_EXACT_STD * length)]))
        if isinstance(rig.up, str) and rig.up in names:
            level = s.rotation @ poses[names.index(rig.up)].rotation.T @ rig.up_in_camera(rig.up)
            # The whole difference, not the cross product: the residual must not vanish upside down.
            out.append((level - np.array([0.0, 0.0, 1.0])) / _UP_STD)
        return np.concatenate(out) if out else np.zeros(0)

    return residual


def _gauss_newton(start: Similarity, residual: Callable[[Similarity], Floats]) -> tuple[Similarity, float]:
    """Gauss-Newton over the similarity; undetermined directions keep their initial values."""
    now = start
    cost = float((residual(now) ** 2).sum())
    for _ in range(30):
        step = np.asarray(-np.linalg.lstsq(_jacobian(now, residual), residual(now), rcond=1e-9)[0], np.float64)
        trial = _retract(now, step)
        trial_cost = float((residual(trial) ** 2).sum())
        shrink = 1.0
        while trial_cost > cost and shrink > 1e-3:
            shrink *= 0.5
            trial = _retract(now, shrink * step)
            trial_cost = float((residual(trial) ** 2).sum())
        if trial_cost >= cost * (1.0 - 1e-10):
            break
        now, cost = trial, trial_cost
    return now, cost


def _jacobian(s: Similarity, residual: Callable[[Similarity], Floats]) -> Floats:
    """Derivatives (n, 7) of the residuals by shift, rotation and log scale."""
    steps = 1e-6 * np.eye(7)
    return np.column_stack([(residual(_retract(s, one)) - residual(_retract(s, -one))) / 2e-6 for one in steps])


def _turn_std(s: Similarity, residual: Callable[[Similarity], Floats]) -> float:
    """Largest std [rad] of the rotation by residuals in sigma, shift and scale free."""
    jacobian = _jacobian(s, residual)
    others, turn = jacobian[:, [0, 1, 2, 6]], jacobian[:, 3:6]
    left = turn - others @ np.linalg.lstsq(others, turn, rcond=None)[0]
    return 1.0 / max(float(np.linalg.svd(left, compute_uv=False)[-1]), 1e-12)


def _retract(s: Similarity, step: Floats) -> Similarity:
    turn = so3.exp(step[3:6])
    size = s.scale * float(np.exp(np.clip(step[6], -2.0, 2.0)))
    # Shift and rotation are scaled to the scene, so that one rank tolerance serves all.
    return Similarity(size, turn @ s.rotation, s.shift + step[:3] * s.scale)


def _std_or_exact(std: Floats | None, exact: float) -> Floats:
    """Std (3,) of a control point; a missing std, or 0, counts as exact."""
    return np.full(3, exact) if std is None else np.where(std > 0, std, exact)


def _extent(poses: list[Pose]) -> float:
    centres = np.array([pose.position for pose in poses])
    return max(float(np.linalg.norm(np.ptp(centres, axis=0))), 1e-9)


@dataclass(frozen=True, slots=True, eq=False)
class ControlPointTerms:
    """Normal equations of the control points over the cameras' parameters in the published world.

    information: (18 n, 18 n). gradient: (18 n,) of half the cost. cost: sum of squared residuals in sigma.
    """

    information: BlockSum
    gradient: Floats
    cost: float


def control_point_terms(rig: Rig, names: list[str], poses: list[Pose], exact: bool = True) -> ControlPointTerms:
    """Normal equations of the rig's positions, attitudes and distances; ``poses`` of cameras ``names`` in its world.

    exact: whether control points without std are among them, with a small one.
    """
    width = CAMERA_PARAMETERS * len(names)
    information, gradient, cost = np.zeros(width), np.zeros(width), 0.0
    between = []
    size = _extent(poses)
    for i, name in enumerate(names):
        camera, base = rig.cameras[name], i * CAMERA_PARAMETERS
        terms = []
        if camera.position is not None:
            off = poses[i].position - camera.position
            terms.append((base + 3, off, camera.position_std, _EXACT_STD * size))
        if camera.rotation is not None:
            off = so3.log(poses[i].rotation @ camera.rotation.T)
            terms.append((base, off, camera.rotation_std, _EXACT_STD))
        for begin, off, given, small in terms:
            axes = np.arange(3) if exact else np.flatnonzero(np.zeros(3) if given is None else given > 0.0)
            at, std = begin + axes, _std_or_exact(given, small)[axes]
            information[at] += 1.0 / std**2
            gradient[at] += off[axes] / std**2
            cost += float(((off[axes] / std) ** 2).sum())
    for a, b, length in rig.distances if exact else ():
        if a in names and b in names:
            row, far = _distance_row(names.index(a), names.index(b), poses)
            own = np.flatnonzero(row)
            between.append((own, np.outer(row[own], row[own]) / (_EXACT_STD * length) ** 2))
            gradient += row * (far - length) / (_EXACT_STD * length) ** 2
            cost += ((far - length) / (_EXACT_STD * length)) ** 2
    return ControlPointTerms(BlockSum(information, tuple(between)), gradient, cost)


def exact_constraints(rig: Rig, names: list[str], poses: list[Pose]) -> tuple[Floats, Floats]:
    """Control points without std: rows (q, 18 n) and values (q,) with rows @ step = -values.

    Positions and attitudes without a std, or with std 0 along an axis, and distances. poses: of cameras ``names`` in
    the rig's world.
    """
    width = CAMERA_PARAMETERS * len(names)
    rows, values = [np.zeros((0, width))], [np.zeros(0)]

    def fix(first: int, off: Floats, std: Floats | None) -> None:
        axes = np.arange(3) if std is None else np.flatnonzero(~(std > 0.0))
        rows.append(np.eye(width)[first + axes])
        values.append(off[axes])

    for i, name in enumerate(names):
        camera, base = rig.cameras[name], i * CAMERA_PARAMETERS
        if camera.position is not None:
            fix(base + 3, poses[i].position - camera.position, camera.position_std)
        if camera.rotation is not None:
            fix(base, so3.log(poses[i].rotation @ camera.rotation.T), camera.rotation_std)
    for a, b, length in rig.distances:
        if a in names and b in names:
            row, far = _distance_row(names.index(a), names.index(b), poses)
            rows.append(row[None])
            values.append(np.array([far - length]))
    return np.concatenate(rows), np.concatenate(values)


def _distance_row(i: int, j: int, poses: list[Pose]) -> tuple[Floats, float]:
    """Gradient (18 n,) of the distance of two cameras, and the distance."""
    row = np.zeros(CAMERA_PARAMETERS * len(poses))
    extent = poses[j].position - poses[i].position
    far = float(np.linalg.norm(extent))
    row[i * CAMERA_PARAMETERS + 3 : i * CAMERA_PARAMETERS + 6] = -extent / far
    row[j * CAMERA_PARAMETERS + 3 : j * CAMERA_PARAMETERS + 6] = extent / far
    return row, far


def is_overdetermined(rig: Rig, names: list[str], poses: list[Pose]) -> bool:
    """Whether the control points exceed the gauge freedoms that they fix; ``poses`` in any world."""
    control = control_points_of(rig, names)
    rows = 3 * len(control.positions) + 3 * len(control.rotations) + len(control.distances)
    exact = {n: replace(c, position_std=None, rotation_std=None) for n, c in rig.cameras.items()}
    design = exact_constraints(replace(rig, cameras=exact), names, poses)[0] @ gauge_generators(poses)
    return rows > int(np.linalg.matrix_rank(design, tol=1e-6 * float(np.abs(design).max(initial=0.0))))


def at_control_points(gauge: Gauge, rig: Rig, names: list[str], poses: list[Pose]) -> Gauge:
    """The gauge for ``poses`` adjusted to the control points, with a warning of exact ones that contradict each other.

    What they say is in directions of these poses: a distance along another would hold a rotation.
    """
    exact = {
        name: replace(
            one,
            position=None if one.position_std is not None and one.position_std.any() else one.position,
            rotation=None if one.rotation_std is not None and one.rotation_std.any() else one.rotation,
        )
        for name, one in rig.cameras.items()
    }
    control = control_points_of(replace(rig, cameras=exact), names)
    worst, share = _worst_control_point(names, poses, control, Similarity(1.0, np.eye(3), np.zeros(3)))
    unmet = (f"exact control points contradict each other, worst is {worst}: give stds",) if share > _MET else ()
    information, rows = control_point_terms(rig, names, poses).information, exact_constraints(rig, names, poses)[0]
    return replace(gauge, information=information, exact=rows, warnings=gauge.warnings + unmet)


def with_exact_poses(rig: Rig, names: list[str], state: AdjustmentState) -> AdjustmentState:
    """The state with control points without std at their given values, without what rounding has left."""
    cameras = list(state.cameras)
    for i, name in enumerate(names):
        known, pose = rig.cameras[name], cameras[i].pose
        rotation, position = pose.rotation, pose.position
        if known.rotation is not None and (known.rotation_std is None or not known.rotation_std.any()):
            rotation = so3.nearest(known.rotation)
        if known.position is not None:
            std = known.position_std
            position = known.position if std is None else np.where(std > 0.0, position, known.position)
        cameras[i] = replace(cameras[i], pose=Pose(rotation, position))
    return replace(state, cameras=tuple(cameras))


def transform_state(state: AdjustmentState, s: Similarity) -> AdjustmentState:
    """The whole state in the published world."""
    cameras = tuple(replace(camera, pose=s.pose(camera.pose)) for camera in state.cameras)
    paths = tuple(replace(path, control=s.points(path.control)) for path in state.trajectories)
    return replace(state, cameras=cameras, trajectories=paths)
