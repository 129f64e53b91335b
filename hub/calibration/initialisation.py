"""First poses of all cameras: seed pair, triangulation, resection of the next camera, and so on.

METHODS A, step 6. Each step is checked by the adjustment, so that a later camera stands on what holds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hub.bundle.adjustment import adjust, mark_inliers, residual_norms
from hub.bundle.problem import CameraState, Freedom, LensPrior, Problem, Rows, State, Trajectory
from hub.calibration.clock_graph import ClockGraph
from hub.sync.pair_solver import PairSolution, evidence
from hub.trajectory.discrete import PointBasis, SampledTrack, common_instants
from hub.trajectory.image_tracks import Track
from hub.trajectory.splines import SplineBasis, fit_spline, stretches
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats

_LEAST_PARALLAX = 0.02  # rad: rays closer than that triangulate nothing
_LEAST_BEARING = 0.05  # rad between two directions that intersect
_PNP_POINTS = 400
_PNP_PX = 8.0
_LEAST_PNP = 12
_FRAMES_A_KNOT = 1.5
_MANY_ROWS, _ROWS_A_KNOT = 20_000, 2.0  # of more, a first adjustment takes a share; of one camera no fewer than …
_SMALL, _GROWN = 6, 1.33  # cameras; growth
_GRID = 0.05  # s between triangulated points
_STRETCH_GAP = 1.0  # s: the path is cut where nobody saw the point for longer


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """What initialisation knows of one camera. tracks: by label. guess: prior of a lens that was not measured.
    timed: whether its readout was told, and is in its times already."""

    name: str
    intrinsics: Intrinsics
    tracks: Mapping[str, Track]
    guess: LensPrior | None = None
    timed: bool = False


@dataclass(slots=True, eq=False)
class Scaffold:
    """The growing solution: placed cameras and labels with a path by name, the problem and state over them."""

    names: list[str]
    labels: list[str]
    problem: Problem
    state: State


def grow(
    cameras: dict[str, Camera],
    graph: ClockGraph,
    rows: dict[str, list[Rows]],
    labels: list[str],
    progress: Callable[[str], None] | None = None,
    freedom: Freedom | None = Freedom(),  # noqa: B008 - frozen
) -> tuple[Scaffold, dict[str, str]]:
    """Place all cameras of one connected graph; returns the solution and the refused, with reasons.

    rows: raw observations by camera, label indices into ``labels``. freedom: what the adjustment after each
    step may move; None = no adjustment (the paper's solver).
    """
    placed: dict[str, CameraState] = {}
    refused: dict[str, str] = {}
    seed = max(graph.agreeing, key=_seed_quality)
    placed |= _seed(cameras, graph, seed)
    anchors = (seed.a, seed.b)
    scaffold = settle(cameras, placed, rows, labels, anchors, freedom)
    adjusted = len(placed)
    waiting = [name for name in graph.clocks if name not in placed]
    while waiting:
        spreads = {name: _common_spread(cameras[name], graph, scaffold) for name in waiting}
        name = max(waiting, key=spreads.__getitem__)
        waiting.remove(name)
        if progress is not None:
            progress(f"placing {name}")
        state = _resect(cameras[name], graph, scaffold) or _intersect_bearings(cameras[name], graph, scaffold)
        if state is None:
            refused[name] = "its view of the path agrees with no position (too little seen together with the others)"
            continue
        current = dict(zip(scaffold.names, scaffold.state.cameras, strict=True))
        current[name] = state
        # Each adjustment costs as much as the network is large: a large one is adjusted when it has grown by a third.
        due = len(current) <= _SMALL or len(current) >= _GROWN * adjusted or not waiting
        scaffold = settle(cameras, current, rows, labels, anchors, freedom if due else None)
        adjusted = len(current) if due else adjusted
    if adjusted < len(scaffold.names):
        placed = dict(zip(scaffold.names, scaffold.state.cameras, strict=True))
        scaffold = settle(cameras, placed, rows, labels, anchors, freedom)
    return scaffold, refused


def _seed_quality(pair: PairSolution) -> float:
    fit = pair.fit
    return 0.0 if fit is None else evidence(fit) * min(np.sin(fit.parallax), 0.5)


def _camera_state(camera: Camera, graph: ClockGraph, pose: Pose) -> CameraState:
    clock = graph.clocks[camera.name]
    return CameraState(camera.intrinsics, pose, clock.rate, clock.offset, clock.centre)


def _seed(cameras: dict[str, Camera], graph: ClockGraph, pair: PairSolution) -> dict[str, CameraState]:
    if pair.fit is None:
        raise ValueError("the seed pair has no fit")
    relative = pair.fit.pose
    second = Pose(relative.rotation, -relative.rotation.T @ relative.direction)
    return {
        pair.a: _camera_state(cameras[pair.a], graph, Pose.identity()),
        pair.b: _camera_state(cameras[pair.b], graph, second),
    }


def place_known(
    cameras: dict[str, Camera],
    graph: ClockGraph,
    rows: dict[str, list[Rows]],
    labels: list[str],
    poses: dict[str, Pose],
    clock: bool = True,
) -> Scaffold:
    """The cameras of a graph at given poses; only time maps and paths are adjusted."""
    placed = {name: _camera_state(cameras[name], graph, poses[name]) for name in graph.clocks}
    names = list(placed)
    return settle(cameras, placed, rows, labels, (names[0], names[1]), Freedom(pose=False, clock=clock))


def settle(
    cameras: dict[str, Camera],
    placed: dict[str, CameraState],
    rows: dict[str, list[Rows]],
    labels: list[str],
    anchors: tuple[str, str],
    freedom: Freedom | None,
) -> Scaffold:
    """Triangulate the paths from the placed cameras and adjust briefly. Raises Refused without any path."""
    names = [name for name in cameras if name in placed]
    states = [placed[name] for name in names]
    trajectories, used = [], []
    for label in range(len(labels)):
        path = triangulate(names, states, cameras, labels[label])
        if path is not None:
            trajectories.append(path)
            used.append(label)
    place = {label: i for i, label in enumerate(used)}
    mine = tuple(
        replace(part, camera=names.index(name), label=place[part.label])
        for name in names
        for part in rows[name]
        if part.label in place
    )
    problem = Problem(
        rows=mine,
        nominal=tuple(cameras[name].intrinsics for name in names),
        clock_reference=names.index(anchors[0]),
        anchors=(names.index(anchors[0]), names.index(anchors[1])),
        freedom=freedom or Freedom(),
        guessed=tuple(cameras[name].guess for name in names),
        timed=tuple(cameras[name].timed for name in names),
    )
    state = State(tuple(states), tuple(trajectories), np.full(len(names), 2.0))
    if not used:
        raise Refused("no part of the path is seen by two cameras from directions that differ enough")
    if freedom is not None:
        few = _thinned(problem, state)
        adjusted, state, _ = adjust(few, state, iterations=12, rounds=2, roughly=True)
        problem = adjusted if few is problem else mark_inliers(problem, state)
    return Scaffold(names, [labels[label] for label in used], problem, state)


def _thinned(problem: Problem, state: State) -> Problem:
    """Rows enough for a start: of very many a share, but a few of a camera to every knot interval of the path."""
    share = sum(len(rows.time) for rows in problem.rows) / _MANY_ROWS
    if share < 2.0 or any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return problem
    out = []
    for rows in problem.rows:
        interval = float(np.median(np.diff(rows.time))) * state.cameras[rows.camera].rate if len(rows.time) > 1 else 1.0
        a_knot = state.trajectories[rows.label].basis.spacing / interval
        every = max(1, int(min(a_knot / _ROWS_A_KNOT, share)))
        stamp = None if rows.stamp is None else rows.stamp[::every]
        few = replace(rows, time=rows.time[::every], pixels=rows.pixels[::every], use=rows.use[::every], stamp=stamp)
        out.append(few)
    return replace(problem, rows=tuple(out))


def path_spacing(cameras: list[Camera], label: str) -> float:
    """Knot spacing [s] of a label's path: what the tracks' own cross-validation chose, the finest of them.

    But no finer than the frames of the fastest camera: the path would go through their noise.
    """
    tracks = [camera.tracks[label] for camera in cameras if label in camera.tracks]
    frames = min(float(np.median(np.diff(track.time))) for track in tracks)
    return float(np.clip(min(track.basis.spacing for track in tracks), max(0.05, _FRAMES_A_KNOT * frames), 0.3))


def triangulate(
    names: list[str], states: list[CameraState], cameras: dict[str, Camera], label: str
) -> Trajectory | None:
    """Path of one label by linear triangulation of the smoothed tracks where at least two cameras see it."""
    seeing = [
        (state, cameras[name].tracks[label])
        for name, state in zip(names, states, strict=True)
        if label in cameras[name].tracks
    ]
    if len(seeing) < 2:
        return None
    if all(isinstance(track, SampledTrack) for _, track in seeing):
        return _separate_points(seeing)
    begin = min(float(state.reference_time(track.time[:1])[0]) for state, track in seeing)
    end = max(float(state.reference_time(track.time[-1:])[0]) for state, track in seeing)
    time = np.arange(begin, end, _GRID)
    points, good = linear_triangulation(seeing, time)
    if good.sum() < _LEAST_PNP:
        return None
    # The path covers all that anybody saw near two-camera stretches; the adjustment needs no more.
    begins, ends = stretches(time[good], _STRETCH_GAP)
    spacing = path_spacing([cameras[name] for name in names], label)
    basis = SplineBasis.over(begins - 0.5 * spacing, ends + 0.5 * spacing, spacing)
    weight = np.ones(int(good.sum()))
    control = fit_spline(basis, time[good], points[good], weight, stiffness=1e-2)
    for _ in range(3):
        distance = np.linalg.norm(basis.evaluate(control, time[good]) - points[good], axis=1)
        scale = max(1.4826 * float(np.median(distance)), 1e-9)
        weight = 1.0 / (1.0 + (distance / (3.0 * scale)) ** 2)
        control = fit_spline(basis, time[good], points[good], weight, stiffness=1e-2)
    return Trajectory(basis, control)


def _separate_points(seeing: list[tuple[CameraState, Track]]) -> Trajectory | None:
    """The path of a shared clock: one point for every instant that two cameras fix."""
    instants = common_instants([state.reference_time(track.time) for state, track in seeing])
    points, good = linear_triangulation(seeing, instants)
    if good.sum() < _LEAST_PNP:
        return None
    basis = PointBasis(instants[good])
    return Trajectory(
        basis, np.vstack([points[good], np.repeat(points[good][-1:], basis.size - int(good.sum()), axis=0)])
    )


def linear_triangulation(seeing: list[tuple[CameraState, Track]], time: Floats) -> tuple[Floats, Bools]:
    """Points (n, 3) at reference times and which of them two cameras fix, in front of both.

    Least squares over the distances to the rays, which needs no start and no depth.
    """
    # Sums over the cameras of P = 1 - r rᵀ, r a ray, and of P times the camera's position; coordinate by coordinate.
    sums, target = np.zeros((3, 3, len(time))), np.zeros((3, len(time)))
    count = np.zeros(len(time), dtype=np.int64)
    rays = []
    for state, track in seeing:
        seen = track.at(state.camera_time(time)).T
        there = np.asarray(np.isfinite(seen).all(axis=0))
        ray = state.pose.rotation.T @ np.stack([*np.where(there, seen, 0.0), np.ones(len(time))])
        ray *= there / np.sqrt((ray**2).sum(axis=0))
        position = state.pose.position[:, None]
        sums -= ray[:, None] * ray
        sums[range(3), range(3)] += there
        target += there * position - ray * (ray * position).sum(axis=0)
        count += there
        rays.append((position, ray))
    matrix, right = np.ascontiguousarray(sums.transpose(2, 0, 1)), target.T
    eigenvalues = np.linalg.eigvalsh(matrix)
    # Smallest eigenvalue of two rays at angle t: 1 - cos t.
    good = (count >= 2) & (eigenvalues[:, 0] > 1.0 - np.cos(_LEAST_PARALLAX))
    points = np.zeros((len(time), 3))
    points[good] = np.linalg.solve(matrix[good], right[good][:, :, None])[:, :, 0]
    for position, ray in rays:  # a ray of length 0 is none
        good &= (((points.T - position) * ray).sum(axis=0) > 0) | ~ray.any(axis=0)
    return points, good


def _known_points(camera: Camera, clock: CameraState, scaffold: Scaffold) -> tuple[Floats, Floats]:
    """What the camera sees of the placed cameras' paths: positions (n, 3) and normalised points (n, 2)."""
    positions, seen = [], []
    for number, path in enumerate(scaffold.state.trajectories):
        track = camera.tracks.get(scaffold.labels[number])
        if track is None:
            continue
        time = clock.reference_time(track.time)
        where = path.at(time)
        both = np.isfinite(where).all(axis=1) & _supported(scaffold, number, time)
        positions.append(where[both])
        seen.append(track.points[both])
    if not positions:
        return np.zeros((0, 3)), np.zeros((0, 2))
    return np.concatenate(positions), np.concatenate(seen)


def _supported(scaffold: Scaffold, number: int, time: Floats) -> Bools:
    """Times (n,) within 0.2 s of what at least two placed cameras saw."""
    count = np.zeros(len(time), dtype=np.int64)
    for camera, state in enumerate(scaffold.state.cameras):
        seen = [r.time[r.use] for r in scaffold.problem.rows if r.camera == camera and r.label == number]
        if not seen or not len(seen[0]):
            continue
        reference = np.sort(state.reference_time(np.concatenate(seen)))
        after = np.clip(np.searchsorted(reference, time), 1, len(reference) - 1)
        nearest = np.minimum(np.abs(reference[after] - time), np.abs(reference[after - 1] - time))
        count += nearest < 0.2
    return count >= 2


def _common_spread(camera: Camera, graph: ClockGraph, scaffold: Scaffold) -> float:
    """How well the known path would fix a camera: points in common times how far from flat they are."""
    clock = _camera_state(camera, graph, Pose.identity())
    moved = _in_scaffold_time(clock, graph, scaffold)
    positions, _ = _known_points(camera, moved, scaffold)
    if len(positions) < _LEAST_PNP:
        return float(len(positions))
    spread = np.linalg.svd(positions - positions.mean(0), compute_uv=False)
    return float(len(positions) * spread[2] / max(spread[0], 1e-12) + 1e-3 * len(positions))


def _in_scaffold_time(clock: CameraState, graph: ClockGraph, scaffold: Scaffold) -> CameraState:
    """A clock of the graph on the scaffold's internal time, which the adjustments have moved a little."""
    name = scaffold.names[scaffold.problem.clock_reference]
    now, then = scaffold.state.cameras[scaffold.problem.clock_reference], graph.clocks[name]
    rate = now.rate / then.rate
    return replace(clock, rate=clock.rate * rate, offset=(clock.offset - then.offset) * rate + now.offset)


def _resect(camera: Camera, graph: ClockGraph, scaffold: Scaffold) -> CameraState | None:
    """Pose of one more camera from the path that the placed ones know (PnP with RANSAC, OpenCV)."""
    clock = _in_scaffold_time(_camera_state(camera, graph, Pose.identity()), graph, scaffold)
    positions, seen = _known_points(camera, clock, scaffold)
    if len(positions) < _LEAST_PNP:
        return None
    pick = np.linspace(0, len(positions) - 1, min(len(positions), _PNP_POINTS)).round().astype(np.int64)
    positions, seen = positions[pick], seen[pick]
    cv2.setRNGSeed(0)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(positions),
        np.ascontiguousarray(seen),
        np.eye(3),
        np.zeros(5),
        iterationsCount=500,
        reprojectionError=_PNP_PX / camera.intrinsics.focal,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < max(_LEAST_PNP, 0.4 * len(pick)):
        return None
    rodrigues, shift = (np.asarray(vector, np.float64).ravel() for vector in (rotation, translation))
    return replace(clock, pose=Pose.from_rodrigues(rodrigues, shift))


def _intersect_bearings(camera: Camera, graph: ClockGraph, scaffold: Scaffold) -> CameraState | None:
    """Pose of one more camera from its pairs alone, where no point is seen by three cameras.

    Each pair with a placed camera gives the rotation and the direction in which the new one lies; two
    directions that differ fix its position, and with it the scale of what it sees.
    """
    matrix, right, turns, weights = np.zeros((3, 3)), np.zeros(3), [], []
    for pair in graph.agreeing:
        if pair.fit is None or camera.name not in (pair.a, pair.b):
            continue
        other = pair.b if pair.a == camera.name else pair.a
        if other not in scaffold.names:
            continue
        base = scaffold.state.cameras[scaffold.names.index(other)].pose
        relative = pair.fit.pose if pair.a == other else pair.fit.pose.inverse()
        ahead = -base.rotation.T @ relative.rotation.T @ relative.direction
        weight = evidence(pair.fit)
        across = weight * (np.eye(3) - np.outer(ahead, ahead))
        matrix += across
        right += across @ base.position
        turns.append(weight * relative.rotation @ base.rotation)
        weights.append(weight)
    if len(turns) < 2 or np.linalg.eigvalsh(matrix)[0] < (1.0 - np.cos(_LEAST_BEARING)) * min(weights):
        return None
    clock = _in_scaffold_time(_camera_state(camera, graph, Pose.identity()), graph, scaffold)
    return replace(
        clock, pose=Pose(so3.nearest(np.sum(turns, axis=0)), np.asarray(np.linalg.solve(matrix, right), np.float64))
    )


def agreement(scaffold: Scaffold, name: str) -> tuple[float, int]:
    """Share of a placed camera's rows on the known path that fit within 5 sigma or 3 px, and how many.

    A camera that saw something else has a large sigma of its own making: what counts is no more than three
    times that of the other cameras.
    """
    number = scaffold.names.index(name)
    others = np.delete(scaffold.state.sigma, number)
    sigma = min(float(scaffold.state.sigma[number]), 3.0 * float(np.median(others)))
    norms = [
        residual_norms(rows, scaffold.state.cameras[number], scaffold.state.trajectories[rows.label])
        for rows in scaffold.problem.rows
        if rows.camera == number
    ]
    values = np.concatenate(norms) if norms else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 0
    return float((values < max(3.0, 5.0 * sigma)).mean()), len(values)
