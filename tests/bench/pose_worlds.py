"""Simulated camera rigs for the pose node benchmark, and the joint optimum over the same observations.

Lengths in cm, as in the paper. Each point is seen by two cameras; ``Sightings`` holds one row a point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg

from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats, Ints

FOCAL = 600.0
"""[px]; the image is 1280 x 960."""
HALF = (640.0 / FOCAL, 480.0 / FOCAL)
TARGET = 30.0
"""True size of the target [cm]; the estimators don't know it."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRig:
    """True poses of all cameras."""

    poses: list[Pose]
    reach: float = 600.0
    """Depth [cm] up to which a target is visible."""

    def visible(self, points: Floats) -> Floats:
        """(cameras, n) whether each point lies in each image, and its depths (cameras, n)."""
        out = []
        for pose in self.poses:
            local = pose.camera_from_world(points)
            z = local[:, 2]
            safe = np.where((z > 30.0) & (z < self.reach), z, np.nan)
            with np.errstate(invalid="ignore"):
                out.append((np.abs(local[:, 0] / safe) < HALF[0]) & (np.abs(local[:, 1] / safe) < HALF[1]))
        return np.array(out)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Measurements of each point by its two cameras.

    cameras: (n, 2). seen: (n, 2, 3) x, y (normalised) and log size (normalised; with bearings only, nan).
    sigma: std of x and y. size_sigma: std of the log size, inf for bearings only. wrong: (n,) simulated outliers.
    """

    cameras: Ints
    seen: Floats
    sigma: float
    size_sigma: float
    wrong: Floats

    def first(self, n: int) -> Sightings:
        """The first n points only."""
        return Sightings(self.cameras[:n], self.seen[:n], self.sigma, self.size_sigma, self.wrong[:n])

    def without(self, bad: Floats) -> Sightings:
        """All but those points."""
        keep = ~bad.astype(bool)
        return Sightings(self.cameras[keep], self.seen[keep], self.sigma, self.size_sigma, self.wrong[keep])


def look_at(position: Floats, target: Floats, roll: float = 0.0) -> Pose:
    """A camera at ``position`` whose axis meets ``target``; y down, turned by ``roll`` [rad] about its axis."""
    z = (target - position) / np.linalg.norm(target - position)
    down = np.array([0.0, 0.0, -1.0]) if abs(z[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    return Pose(so3.exp(np.array([0.0, 0.0, roll])) @ np.stack([x, np.cross(z, x), z]), position)


def section_4(rng: np.random.Generator, cameras: int = 5) -> SimulatedRig:
    """Cameras about a cube of 150 cm (its centre is the origin), 250 to 350 cm away, spread in azimuth."""
    poses = []
    turn = rng.uniform(0, 2 * np.pi)
    for k in range(cameras):
        azimuth = turn + 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / cameras
        elevation = rng.uniform(0.0, 0.6)
        distance = rng.uniform(250.0, 350.0)
        flat = np.cos(elevation)
        position = distance * np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        poses.append(look_at(position, rng.uniform(-20, 20, 3), rng.uniform(-0.2, 0.2)))
    return SimulatedRig(poses)


def hall(rng: np.random.Generator, cameras: int, spacing: float = 250.0) -> SimulatedRig:
    """Cameras on a jittered square grid below a ceiling, looking obliquely down: only neighbours share views."""
    side = int(np.ceil(np.sqrt(cameras)))
    cells = [(i, j) for i in range(side) for j in range(side)][:cameras]
    poses = []
    for i, j in cells:
        position = np.array([i * spacing, j * spacing, 300.0]) + rng.uniform(-60, 60, 3)
        aim = np.clip(position + rng.uniform(-120, 120, 3), 0.0, [max(side - 1, 1) * spacing] * 3)
        aim[2] = 60.0
        poses.append(look_at(position, aim, rng.uniform(-0.3, 0.3)))
    return SimulatedRig(poses)


def observe(
    world: SimulatedRig,
    rng: np.random.Generator,
    points: Floats,
    pixels: float = 1.0,
    size: float = 0.02,
    outliers: float = 0.0,
) -> Sightings:
    """Each point in two randomly chosen cameras in which it is visible; points visible in fewer are left out.

    pixels: std [px]. size: relative std, inf = bearings only. outliers: share of points of which one camera
    reports a random place in its image.
    """
    visible = world.visible(points)
    draw = np.where(visible, rng.random(visible.shape), -1.0)
    order = np.argsort(-draw, axis=0)[:2]
    enough = visible.sum(axis=0) >= 2
    points, pairs = points[enough], order[:, enough].T.copy()
    n = len(points)
    seen = np.empty((n, 2, 3))
    for c, pose in enumerate(world.poses):
        for side in (0, 1):
            mine = pairs[:, side] == c
            local = pose.camera_from_world(points[mine])
            seen[mine, side, :2] = local[:, :2] / local[:, 2:]
            seen[mine, side, 2] = np.log(TARGET / local[:, 2])
    sigma = pixels / FOCAL
    seen[:, :, :2] += sigma * rng.standard_normal((n, 2, 2))
    if np.isfinite(size):
        seen[:, :, 2] += size * rng.standard_normal((n, 2))
    else:
        seen[:, :, 2] = np.nan
    wrong = rng.random(n) < outliers
    side = rng.integers(0, 2, n)
    for i in np.flatnonzero(wrong):
        seen[i, side[i], 0] = rng.uniform(-HALF[0], HALF[0])
        seen[i, side[i], 1] = rng.uniform(-HALF[1], HALF[1])
    return Sightings(pairs.astype(np.int64), seen, sigma, size, wrong)


def cube(rng: np.random.Generator, n: int) -> Floats:
    """Points (n, 3) uniform in the cube of 150 cm."""
    return rng.uniform(-75.0, 75.0, (n, 3))


def floor(rng: np.random.Generator, world: SimulatedRig, n: int) -> Floats:
    """Points (n, 3) where people are: under the cameras, up to 180 cm high."""
    centres = np.array([pose.position for pose in world.poses])
    low, high = centres.min(axis=0) - 150.0, centres.max(axis=0) + 150.0
    out = rng.uniform(low, high, (n, 3))
    out[:, 2] = rng.uniform(0.0, 180.0, n)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class JointOptimum:
    """The optimum over all observations. poses: in the frame of the control points. cost: half of chi2."""

    poses: list[Pose]
    cost: float
    iterations: int
    covariance: Floats | None = None


def joint_optimum(
    world: SimulatedRig, sightings: Sightings, start: list[Pose] | None = None, spread: bool = False
) -> JointOptimum:
    """Gauss-Newton over every pose and point; camera 1's pose and camera 2's position are exact (section 4).

    start: initial poses in the true world; by default the true ones, so that the optimum nearest to the truth is found.
    The target's size is an unknown too. spread: also the covariance of the camera parameters.
    """
    poses = list(start or world.poses)
    with_sizes = bool(np.isfinite(sightings.size_sigma))
    n_cameras, n = len(poses), len(sightings.cameras)
    width = 6 * n_cameras + 1  # the last: log of the target's size
    fixed = np.zeros(width, dtype=bool)
    fixed[:6] = True
    fixed[9:12] = True
    fixed[-1] = not with_sizes
    log_size = np.log(TARGET)
    free = np.flatnonzero(~fixed)
    points = _first_points(poses, sightings)
    last = np.inf
    rotations = np.array([pose.rotation for pose in poses])
    centres = np.array([pose.position for pose in poses])
    damping = 1e-6
    state = (rotations, centres, points, log_size)
    system = _system(state, sightings, with_sizes)
    for iteration in range(60):  # noqa: B007
        step, point_step = _solve(system, sightings, free, width, damping)
        trial = _moved(state, step, point_step)
        trial_system = _system(trial, sightings, with_sizes)
        if trial_system[-1] <= system[-1]:
            gain = system[-1] - trial_system[-1]
            state, system = trial, trial_system
            damping = max(damping / 10, 1e-9)
            if gain < 1e-7 * max(1.0, 1e-3 * n):
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    covariance = None
    if spread:
        covariance = np.zeros((width, width))
        covariance[np.ix_(free, free)] = np.linalg.inv(
            _reduced(system, sightings, width)[0].toarray()[np.ix_(free, free)]
        )
    del last
    return JointOptimum(
        [Pose(r, t) for r, t in zip(state[0], state[1], strict=True)], float(system[-1]), iteration, covariance
    )


def _first_points(poses: list[Pose], s: Sightings) -> Floats:
    rotations = np.array([pose.rotation for pose in poses])
    centres = np.array([pose.position for pose in poses])
    normal, right = np.zeros((len(s.cameras), 3, 3)), np.zeros((len(s.cameras), 3))
    for side in (0, 1):
        c = s.cameras[:, side]
        ray = np.concatenate([s.seen[:, side, :2], np.ones((len(c), 1))], axis=1)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        ray = np.einsum("nji,nj->ni", rotations[c], ray)
        flat = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        normal += flat
        right += np.einsum("nij,nj->ni", flat, centres[c])
    return np.linalg.solve(normal + 1e-9 * np.eye(3), right[:, :, None])[:, :, 0]


def _system(state, s: Sightings, with_sizes: bool):  # type: ignore[no-untyped-def]
    rotations, centres, points, log_size = state
    n = len(points)
    by_camera, by_point = np.zeros((n, 2, 3, 6)), np.zeros((n, 2, 3, 3))
    residual = np.zeros((n, 2, 3))
    for side in (0, 1):
        c = s.cameras[:, side]
        local = np.einsum("nij,nj->ni", rotations[c], points - centres[c])
        z = np.maximum(local[:, 2], 1.0)
        flat = local[:, :2] / z[:, None]
        project = np.zeros((n, 3, 3))
        project[:, 0, 0] = project[:, 1, 1] = 1.0 / (z * s.sigma)
        project[:, :2, 2] = -flat / (z * s.sigma)[:, None]
        residual[:, side, :2] = (flat - s.seen[:, side, :2]) / s.sigma
        if with_sizes:
            project[:, 2, 2] = -1.0 / (z * s.size_sigma)
            residual[:, side, 2] = (log_size - np.log(z) - s.seen[:, side, 2]) / s.size_sigma
        by_point[:, side] = project @ rotations[c]
        by_camera[:, side, :, :3] = -project @ so3.hat(local)
        by_camera[:, side, :, 3:] = -by_point[:, side]
    return by_camera, by_point, residual, (1.0 / s.size_sigma if with_sizes else 0.0), 0.5 * float((residual**2).sum())


def _reduced(system, s: Sightings, width: int, damping: float = 0.0):  # type: ignore[no-untyped-def]
    by_camera, by_point, residual, size_weight, _ = system
    n = len(residual)
    # Columns of one point: camera a (6), camera b (6), size (1).
    jac = np.zeros((n, 6, 13))
    jac[:, :3, :6], jac[:, 3:, 6:12] = by_camera[:, 0], by_camera[:, 1]
    jac[:, 2, 12] = jac[:, 5, 12] = size_weight
    bp = by_point.reshape(n, 6, 3)
    r = residual.reshape(n, 6)
    hx = bp.transpose(0, 2, 1) @ bp
    hx = hx + damping * np.eye(3) * np.trace(hx, axis1=1, axis2=2)[:, None, None]
    cross = jac.transpose(0, 2, 1) @ bp
    hx_inverse = np.linalg.inv(hx)
    gain = cross @ hx_inverse
    h = jac.transpose(0, 2, 1) @ jac - gain @ cross.transpose(0, 2, 1)
    gp = np.einsum("nij,ni->nj", bp, r)
    g = np.einsum("nij,ni->nj", jac, r) - np.einsum("nij,nj->ni", gain, gp)
    pair = s.cameras[:, 0] * 100_000 + s.cameras[:, 1]
    kinds, which = np.unique(pair, return_inverse=True)
    blocks, pulls = np.zeros((len(kinds), 13, 13)), np.zeros((len(kinds), 13))
    np.add.at(blocks, which, h)
    np.add.at(pulls, which, g)
    a, b = kinds // 100_000, kinds % 100_000
    columns = np.concatenate(
        [6 * a[:, None] + np.arange(6), 6 * b[:, None] + np.arange(6), np.full((len(a), 1), width - 1)], axis=1
    )
    i = np.broadcast_to(columns[:, :, None], blocks.shape).ravel()
    j = np.broadcast_to(columns[:, None, :], blocks.shape).ravel()
    hessian = sparse.csr_matrix((blocks.ravel(), (i, j)), shape=(width, width))
    gradient = np.zeros(width)
    np.add.at(gradient, columns.ravel(), pulls.ravel())
    return hessian, gradient, hx_inverse, cross, gp, columns, which


def _solve(system, s: Sightings, free: Ints, width: int, damping: float):  # type: ignore[no-untyped-def]
    hessian, gradient, hx_inverse, cross, gp, columns, which = _reduced(system, s, width, damping)
    h = hessian[free][:, free]
    h = h + damping * sparse.diags(h.diagonal())
    step = np.zeros(width)
    step[free] = -sparse_linalg.spsolve(h.tocsc(), gradient[free])
    local = step[columns[which]]
    point_step = -np.einsum("nij,nj->ni", hx_inverse, gp + np.einsum("nij,ni->nj", cross, local))
    return step, point_step


def _moved(state, step: Floats, point_step: Floats):  # type: ignore[no-untyped-def]
    rotations, centres, points, log_size = state
    cameras = step[:-1].reshape(-1, 6)
    return so3.exp(cameras[:, :3]) @ rotations, centres + cameras[:, 3:], points + point_step, log_size + step[-1]


def errors(world: SimulatedRig, poses: list[Pose | None]) -> tuple[float, float]:
    """Mean error of position [cm] and attitude [deg] over cameras without control points; nan if one is missing."""
    far, turn = [], []
    for truth, found in zip(world.poses, poses, strict=True):
        if found is None:
            return float("nan"), float("nan")
        far.append(float(np.linalg.norm(found.position - truth.position)))
        turn.append(float(np.degrees(so3.angle_between(found.rotation, truth.rotation))))
    return float(np.mean(far[2:])), float(np.mean(turn[1:]))
