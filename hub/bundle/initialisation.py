"""Incremental reconstruction: seed pair, triangulation, resection of the next camera, and so on.

Asynchronous calibration paper, step 6. Each step is followed by a short bundle adjustment, so that the next camera is
resected against a consistent reconstruction.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hub.bundle.adjustment import adjust, mark_inliers
from hub.bundle.problem import (
    LARGE_NETWORK,
    AdjustmentState,
    CameraState,
    FreeParameters,
    LensPrior,
    Problem,
    TrackObservations,
    Trajectory,
)
from hub.bundle.residuals import residual_norms
from hub.clocks.clock_graph import ClockGraph
from hub.sync.hypothesis import PairSolution, evidence
from hub.trajectory.discrete import PointBasis, SampledTrack, merged_instants
from hub.trajectory.image_tracks import MAX_PAUSE_S, ImageTrack
from hub.trajectory.splines import SplineBasis, fit_spline, split_at_gaps, weighted_sums
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats

_MIN_PARALLAX = 0.02  # rad between rays; less does not triangulate
_MIN_POINT_PARALLAX = 2e-3  # rad: the same for separate points, no part of a path; two pixels of a bearing
_MIN_BEARING_ANGLE = 0.05  # rad between two directions that intersect
_MAX_PNP_POINTS = 400  # evenly spread: bounds the time of RANSAC
_PNP_THRESHOLD_PX = 8.0  # generous: the first trajectory is rough
_MIN_PNP_POINTS = 12  # twice the six unknowns of a pose
MIN_KNOT_SPACING, _MAX_KNOT_SPACING = 0.05, 0.3  # s
_FEW_FRAMES_PER_KNOT, _MANY_ROWS = 4.5, 3.0  # of a track's choice; of all cameras, to each of twice as many knots
_LEAST_ROWS = 1.9
"""Rows of all cameras to each knot, three unknowns: of 1.5 or hardly more the prior says where the path is, and two
cameras at 5 frames a second turned by up to 3 degrees, at 57 stds. Not 2: two of one frame rate would see one phase of
all knot intervals, and what a cubic spline does not follow would move their clocks (by 0.6 ms, at 20 stds)."""
_MANY_TRACKS = 2.0**4.5
"""Tracks at once, of all labels and cameras, whose best spacing is nearer to half of one track's: what a cubic spline
does not follow goes with the fourth power of its spacing, squared, against a variance that goes with 1 / (spacing times
tracks), so that the best goes with tracks^(-1/9)."""
_MAX_INITIAL_ROWS, _MIN_ROWS_PER_KNOT = 5_000, 2.0  # of more rows, early adjustments use a share
_SMALL_NETWORK, _ADJUST_GROWTH = 6, 1.33  # cameras; growth
_TOGETHER = 0.5
"""Of the best one's score: a large network grows by all such cameras at once, and only what is new is adjusted."""
_TRIANGULATION_STEP = 0.05  # s between triangulated points
SEEN_WITHIN_S = 0.2  # a camera observes a point at a time if it has an observation this near
_MAX_GAP = 1.0  # s: the trajectory is split where no camera saw the point for longer


@dataclass(frozen=True, slots=True, eq=False)
class CameraInput:
    """Input of the reconstruction for one camera. tracks: by label. lens_prior: prior of a lens that was not measured,
    or whose focal length has a std. readout_given: whether its readout was given, so that its times are already
    corrected. stated_std: the geometric mean of the stds [px] that the detector states for its rows; 0 without any.
    least_spacing: of the knots of paths [s]."""

    name: str
    intrinsics: Intrinsics
    tracks: Mapping[str, ImageTrack]
    lens_prior: LensPrior | None = None
    readout_given: bool = False
    stated_std: float = 0.0
    least_spacing: float = MIN_KNOT_SPACING


@dataclass(slots=True, eq=False)
class Reconstruction:
    """Placed cameras and labels with a trajectory, by name, and the adjustment problem and state over them."""

    names: list[str]
    labels: list[str]
    problem: Problem
    state: AdjustmentState


class _Triangulated:
    """Trajectories by linear triangulation, and when they are observed; kept while their cameras do not move."""

    def __init__(self, cameras: dict[str, CameraInput], labels: list[str]) -> None:
        self._cameras = cameras
        self._seeing = {label: [name for name, camera in cameras.items() if label in camera.tracks] for label in labels}
        self._paths: dict[str, tuple[list[CameraState], Trajectory | None]] = {}
        self._times: dict[str, tuple[Trajectory, list[Floats]]] = {}

    def path(self, label: str, placed: dict[str, CameraState]) -> Trajectory | None:
        """The trajectory of a label from the placed cameras."""
        names = [name for name in self._seeing[label] if name in placed]
        states = [placed[name] for name in names]
        if label not in self._paths or self._paths[label][0] != states:  # the same objects
            self._paths[label] = states, triangulate_label(names, states, self._cameras, label)
        return self._paths[label][1]

    def times(self, reconstruction: Reconstruction, number: int) -> list[Floats]:
        """`observation_times` of a label of the reconstruction."""
        label, path = reconstruction.labels[number], reconstruction.state.trajectories[number]
        if label not in self._times or self._times[label][0] is not path:
            self._times[label] = path, observation_times(reconstruction.problem, reconstruction.state, number)
        return self._times[label][1]


def reconstruct_incrementally(
    cameras: dict[str, CameraInput],
    graph: ClockGraph,
    rows: dict[str, list[TrackObservations]],
    labels: list[str],
    progress: Callable[[str], None] | None = None,
    free_parameters: FreeParameters | None = FreeParameters(),  # noqa: B008 - frozen
) -> tuple[Reconstruction, dict[str, str]]:
    """Place all cameras of one connected graph; returns the reconstruction and the refused cameras with reasons.

    rows: raw observations by camera, label indices into ``labels``. free_parameters: of the adjustment
    after each step; None = no adjustment (solver "paper").
    """
    seed = max(graph.inlier_pairs, key=_seed_score)
    placed = _seed_cameras(cameras, graph, seed)
    return place_cameras(cameras, graph, rows, labels, placed, free_parameters, (seed.a, seed.b), progress)


def place_cameras(
    cameras: dict[str, CameraInput],
    graph: ClockGraph,
    rows: dict[str, list[TrackObservations]],
    labels: list[str],
    placed: dict[str, CameraState],
    free_parameters: FreeParameters | None,
    anchors: tuple[str, str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Reconstruction, dict[str, str]]:
    """Place the cameras of a graph next to those that are placed already, which are adjusted first; as above.

    anchors: two placed cameras that fix the gauge; None = the first two.
    """
    refused: dict[str, str] = {}
    first, second = [name for name in cameras if name in placed][:2]
    anchors = anchors or (first, second)
    kept = _Triangulated(cameras, labels)

    def grown(current: dict[str, CameraState], moving: Collection[str], free: FreeParameters | None) -> Reconstruction:
        return triangulate_and_adjust(cameras, current, rows, labels, anchors, free, kept, moving)

    reconstruction = grown(placed, (), free_parameters)
    adjusted = placed.keys()
    unplaced = [name for name in graph.clocks if name not in placed]
    scores: dict[str, tuple[tuple[object, ...], float]] = {}  # and what each depends on
    while unplaced:
        paths = dict(zip(reconstruction.labels, reconstruction.state.trajectories, strict=True))
        reference = reconstruction.state.cameras[reconstruction.problem.clock_reference]
        for name in unplaced:
            depends = (reference, *map(paths.get, cameras[name].tracks))
            if name not in scores or scores[name][0] != depends:
                scores[name] = depends, _resection_score(cameras[name], graph, reconstruction, kept)
        current = dict(zip(reconstruction.names, reconstruction.state.cameras, strict=True))
        best = max(unplaced, key=lambda one: scores[one][1])
        together = [best]
        if len(current) > LARGE_NETWORK:
            together += [one for one in unplaced if one != best and scores[one][1] > _TOGETHER * scores[best][1]]
        for name in together:
            if progress is not None:
                progress(f"placing {name}")
            state = _resect(cameras[name], graph, reconstruction, kept) or _intersect_bearings(
                cameras[name], graph, reconstruction
            )
            if state is not None:
                current[name] = state
            elif name == best:
                refused[name] = (
                    "its view of the trajectory agrees with no position (too little seen together with the other "
                    "cameras)"
                )
        unplaced = [name for name in unplaced if name not in current and name not in refused]
        if len(current) == len(reconstruction.names):
            continue
        # The cost grows with the network: a large one is adjusted only when it has grown by a third.
        if len(current) <= _SMALL_NETWORK or len(current) >= _ADJUST_GROWTH * len(adjusted) or not unplaced:
            moving = current.keys() - adjusted if len(current) > LARGE_NETWORK else ()
            reconstruction, adjusted = grown(current, moving, free_parameters), current.keys()
        else:
            reconstruction = grown(current, (), None)
    if len(adjusted) < len(reconstruction.names):
        current = dict(zip(reconstruction.names, reconstruction.state.cameras, strict=True))
        moving = current.keys() - adjusted if len(current) > LARGE_NETWORK else ()
        reconstruction = grown(current, moving, free_parameters)
    return reconstruction, refused


def _seed_score(pair: PairSolution) -> float:
    fit = pair.fit
    return 0.0 if fit is None else evidence(fit) * min(np.sin(fit.parallax), 0.5)


def _camera_state(camera: CameraInput, graph: ClockGraph, pose: Pose) -> CameraState:
    clock = graph.clocks[camera.name]
    return CameraState(camera.intrinsics, pose, clock.rate, clock.offset, clock.centre)


def _seed_cameras(cameras: dict[str, CameraInput], graph: ClockGraph, pair: PairSolution) -> dict[str, CameraState]:
    if pair.fit is None:
        raise ValueError("the seed pair has no fit")
    relative = pair.fit.pose
    second = Pose(relative.rotation, -relative.rotation.T @ relative.direction)
    return {
        pair.a: _camera_state(cameras[pair.a], graph, Pose.identity()),
        pair.b: _camera_state(cameras[pair.b], graph, second),
    }


def reconstruct_with_known_poses(
    cameras: dict[str, CameraInput],
    graph: ClockGraph,
    rows: dict[str, list[TrackObservations]],
    labels: list[str],
    poses: dict[str, Pose],
    clock: bool = True,
) -> Reconstruction:
    """The cameras of a graph at given poses; only time maps and trajectories are adjusted."""
    placed = {name: _camera_state(cameras[name], graph, poses[name]) for name in graph.clocks}
    names = list(placed)
    return triangulate_and_adjust(
        cameras, placed, rows, labels, (names[0], names[1]), FreeParameters(pose=False, clock=clock)
    )


def triangulate_and_adjust(
    cameras: dict[str, CameraInput],
    placed: dict[str, CameraState],
    rows: dict[str, list[TrackObservations]],
    labels: list[str],
    anchors: tuple[str, str],
    free_parameters: FreeParameters | None,
    kept: _Triangulated | None = None,
    moving: Collection[str] = (),
) -> Reconstruction:
    """Triangulate trajectories from the placed cameras and adjust briefly. Raises Refused without any trajectory.

    moving: the only cameras that are adjusted, with the trajectories that they see; () = all.
    """
    kept = kept or _Triangulated(cameras, labels)
    numbers = {name: number for number, name in enumerate(name for name in cameras if name in placed)}
    names = list(numbers)
    states = [placed[name] for name in names]
    trajectories, used = [], []
    for label in range(len(labels)):
        path = kept.path(labels[label], placed)
        if path is not None:
            trajectories.append(path)
            used.append(label)
    new_label = {label: i for i, label in enumerate(used)}
    used_rows = tuple(
        part.renumbered(numbers[name], new_label[part.label])
        for name in names
        for part in rows[name]
        if part.label in new_label
    )
    problem = Problem(
        rows=used_rows,
        nominal=tuple(cameras[name].intrinsics for name in names),
        clock_reference=numbers[anchors[0]],
        anchors=(numbers[anchors[0]], numbers[anchors[1]]),
        free_parameters=free_parameters or FreeParameters(),
        lens_priors=tuple(cameras[name].lens_prior for name in names),
        readout_given=tuple(cameras[name].readout_given for name in names),
    )
    state = AdjustmentState(tuple(states), tuple(trajectories), np.full(len(names), 2.0))
    if not used:
        raise Refused("no part of the trajectory is seen by two cameras with enough parallax")
    if free_parameters is not None and moving:
        state = _adjusted_among(problem, state, {numbers[name] for name in moving})
    elif free_parameters is not None:
        subsampled = _subsampled(problem, state)
        adjusted, state, _ = adjust(subsampled, state, iterations=12, rounds=2, coarse=True)
        problem = adjusted if subsampled is problem else mark_inliers(problem, state)
    return Reconstruction(names, [labels[label] for label in used], problem, state)


def _adjusted_among(problem: Problem, state: AdjustmentState, moving: set[int]) -> AdjustmentState:
    """The state with some cameras adjusted, and the trajectories that they see, while the other cameras are held."""
    labels = sorted({rows.label for camera in moving for rows in problem.of_camera(camera)})
    rows = (part.renumbered(part.camera, new) for new, old in enumerate(labels) for part in problem.of_label(old))
    held = frozenset(range(len(state.cameras))) - moving
    inside = replace(state, trajectories=tuple(state.trajectories[label] for label in labels))
    _, found, _ = adjust(replace(problem, rows=tuple(rows), held=held), inside, iterations=12, rounds=2, coarse=True)
    trajectories = list(state.trajectories)
    for label, path in zip(labels, found.trajectories, strict=True):
        trajectories[label] = path
    return replace(found, trajectories=tuple(trajectories))


def _subsampled(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem with fewer rows: a share of very many, but some of each camera in every knot interval."""
    share = sum(len(rows.time) for rows in problem.rows) / _MAX_INITIAL_ROWS
    if share < 2.0 or any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return problem
    out = []
    for rows in problem.rows:
        interval = float(np.median(np.diff(rows.time))) * state.cameras[rows.camera].rate if len(rows.time) > 1 else 1.0
        rows_per_knot = state.trajectories[rows.label].basis.spacing / interval
        every = max(1, int(min(rows_per_knot / _MIN_ROWS_PER_KNOT, share)))
        out.append(rows.every(every))
    return replace(problem, rows=tuple(out))


def knot_spacing(cameras: list[CameraInput], label: str, large: bool = False) -> float:
    """Knot spacing [s] of a label's trajectory: the finest by the tracks' cross-validation, or half of it.

    large: of a network of many cameras.

    Of few frames a knot in each track these, not the motion, limit what it follows; the path has other cameras' too.
    What it does not follow all joints of a body do alike, which biases clocks: those of two walkers at 10 to 15 frames
    a second by up to 5000 ppm, also at true poses; by 500 with half. With six, as of drones, nothing is gained, but
    with many joints it is: clocks of four walkers at 15 to 30 frames a second were 300 ppm off, at 10 stds.
    """
    seeing = [camera for camera in cameras if label in camera.tracks]
    tracks = [camera.tracks[label] for camera in seeing]
    rates = [1.0 / float(np.median(np.diff(track.time))) for track in tracks]
    spacing = min(track.basis.spacing for track in tracks)
    most = max(track.basis.spacing * rate for track, rate in zip(tracks, rates, strict=True))
    # A large network's clocks are no more exact with them, and take a tenth more of CPU.
    many = not large and sum(map(_tracks_at_once, seeing)) > _MANY_TRACKS
    if (most < _FEW_FRAMES_PER_KNOT or many) and 0.5 * spacing * sum(rates) > _MANY_ROWS:
        spacing *= 0.5
    return float(np.clip(spacing, max(camera.least_spacing for camera in seeing), _MAX_KNOT_SPACING))


def _tracks_at_once(camera: CameraInput) -> float:
    """Labels that a camera sees at once, on average."""
    spans = [track.time[-1] - track.time[0] for track in camera.tracks.values()]
    begin, end = (edge(track.time[at] for track in camera.tracks.values()) for edge, at in ((min, 0), (max, -1)))
    return float(sum(spans) / max(end - begin, 1e-9))


def triangulate_label(
    names: list[str], states: list[CameraState], cameras: dict[str, CameraInput], label: str
) -> Trajectory | None:
    """Trajectory of one label by linear triangulation of the smoothed tracks where at least two cameras see it."""
    seeing = [
        (state, cameras[name].tracks[label])
        for name, state in zip(names, states, strict=True)
        if label in cameras[name].tracks
    ]
    if len(seeing) < 2:
        return None
    if all(isinstance(track, SampledTrack) for _, track in seeing):
        return _triangulate_instants(seeing)
    time = _times_of_two(seeing)
    points, good = linear_triangulation(seeing, time)
    if good.sum() < _MIN_PNP_POINTS:
        return None
    # Rows of a single camera far from two-camera stretches are not covered: they do not constrain the adjustment.
    begins, ends = split_at_gaps(time[good], _MAX_GAP)
    spacing = knot_spacing([cameras[name] for name in names], label, len(cameras) > LARGE_NETWORK)
    inside = [np.searchsorted(state.reference_time(track.time), [begins, ends]) for state, track in seeing]
    rows = max(1, sum(int(np.diff(one, axis=0).sum()) for one in inside))
    spacing = max(spacing, min(_LEAST_ROWS * float((ends - begins).sum()) / rows, _MAX_GAP))
    basis = SplineBasis.covering(begins - 0.5 * spacing, ends + 0.5 * spacing, spacing)
    time, points = time[good], points[good]
    weight, at = np.ones(len(time)), basis.weights(time)
    control = fit_spline(basis, at, points, weight, 1e-2)
    for _ in range(3):
        distance = np.linalg.norm(weighted_sums(control, *at[:2]) - points, axis=1)
        scale = max(1.4826 * float(np.median(distance)), 1e-9)
        weight = 1.0 / (1.0 + (distance / (3.0 * scale)) ** 2)
        control = fit_spline(basis, at, points, weight, 1e-2)
    return Trajectory(basis, control)


def _times_of_two(seeing: list[tuple[CameraState, ImageTrack]]) -> Floats:
    """Reference times (n,) of a grid from the first row on at which two cameras may see a point.

    Clocks that were set, or that are not those of the calibration, are years apart: a grid over all would not end.
    """
    spans = [split_at_gaps(state.reference_time(track.time), MAX_PAUSE_S) for state, track in seeing]
    edges, cameras = np.concatenate(spans, axis=1).ravel(), sum(len(begins) for begins, _ in spans)
    change = np.repeat([1, -1], cameras)
    order = np.lexsort((-change, edges))
    edges, shared = edges[order], np.cumsum(change[order])[:-1] >= 2
    step = edges[0] + _TRIANGULATION_STEP - edges[0]  # as np.arange(first, last, step) rounds it
    steps = (edges - edges[0]) / _TRIANGULATION_STEP
    begins, ends = np.floor(steps[:-1][shared]), np.minimum(np.ceil(steps[1:][shared]) + 1, np.ceil(steps[-1]))
    grid = [np.arange(begin, end) for begin, end in zip(begins, ends, strict=True)]
    return np.asarray(edges[0] + np.unique(np.concatenate([np.zeros(0), *grid])) * step)


def _triangulate_instants(seeing: list[tuple[CameraState, ImageTrack]]) -> Trajectory | None:
    """The trajectory of a shared clock: one point for every instant that two cameras triangulate."""
    instants = merged_instants([state.reference_time(track.time) for state, track in seeing])
    points, good = linear_triangulation(seeing, instants, _MIN_POINT_PARALLAX)
    if good.sum() < _MIN_PNP_POINTS:
        return None
    basis = PointBasis(instants[good])
    return Trajectory(
        basis, np.vstack([points[good], np.repeat(points[good][-1:], basis.size - int(good.sum()), axis=0)])
    )


def linear_triangulation(
    seeing: list[tuple[CameraState, ImageTrack]], time: Floats, min_parallax: float = _MIN_PARALLAX
) -> tuple[Floats, Bools]:
    """Points (n, 3) at reference times, and which of them are triangulated in front of all their cameras.

    Least squares over the distances to the rays, which needs no initial values.
    """
    # Sums over the cameras of P = 1 - r rᵀ, r a ray, and of P times the camera's position; coordinate by coordinate.
    sums, target = np.zeros((3, 3, len(time))), np.zeros((3, len(time)))
    count = np.zeros(len(time), dtype=np.int64)
    rays = []
    for state, track in seeing:
        seen = track.at(state.camera_time(time)).T
        visible = np.asarray(np.isfinite(seen).all(axis=0))
        ray = state.pose.rotation.T @ np.stack([*np.where(visible, seen, 0.0), np.ones(len(time))])
        ray *= visible / np.sqrt((ray**2).sum(axis=0))
        position = state.pose.position[:, None]
        sums -= ray[:, None] * ray
        sums[range(3), range(3)] += visible
        target += visible * position - ray * (ray * position).sum(axis=0)
        count += visible
        rays.append((position, ray))
    matrix, right = np.ascontiguousarray(sums.transpose(2, 0, 1)), target.T
    eigenvalues = np.linalg.eigvalsh(matrix)
    # Smallest eigenvalue of two rays at angle t: 1 - cos t.
    good = (count >= 2) & (eigenvalues[:, 0] > 1.0 - np.cos(min_parallax))
    points = np.zeros((len(time), 3))
    points[good] = np.linalg.solve(matrix[good], right[good][:, :, None])[:, :, 0]
    for position, ray in rays:  # a ray of length 0 marks a camera that does not see the point
        good &= (((points.T - position) * ray).sum(axis=0) > 0) | ~ray.any(axis=0)
    return points, good


def _resection_points(
    camera: CameraInput, clock: CameraState, reconstruction: Reconstruction, kept: _Triangulated
) -> tuple[Floats, Floats]:
    """3D-2D correspondences of a camera with the trajectories: positions (n, 3) and normalised points (n, 2)."""
    positions, seen = [], []
    for number, path in enumerate(reconstruction.state.trajectories):
        track = camera.tracks.get(reconstruction.labels[number])
        if track is None:
            continue
        time = clock.reference_time(track.time)
        where = path.at(time)
        both = np.isfinite(where).all(axis=1) & seen_by_two(kept.times(reconstruction, number), time)
        positions.append(where[both])
        seen.append(track.points[both])
    if not positions:
        return np.zeros((0, 3)), np.zeros((0, 2))
    return np.concatenate(positions), np.concatenate(seen)


def observation_times(problem: Problem, state: AdjustmentState, label: int, but: int | None = None) -> list[Floats]:
    """Sorted internal times at which a label is observed, by camera that observes it, one camera left out."""
    seen: dict[int, list[Floats]] = {}
    for rows in problem.of_label(label):
        if rows.camera != but and rows.use.any():
            seen.setdefault(rows.camera, []).append(rows.time[rows.use])
    return [np.sort(state.cameras[number].reference_time(np.concatenate(seen[number]))) for number in sorted(seen)]


def seen_by_two(
    observed: list[Floats], time: Floats, within: float = SEEN_WITHIN_S, beyond: float = SEEN_WITHIN_S
) -> Bools:
    """Times (n,) within ``within`` [s] of observations of at least two cameras. observed: of `observation_times`.

    beyond: how long [s] before its first and after its last observation a camera counts at most.
    """
    count = np.zeros(len(time), dtype=np.int64)
    for reference in observed:
        after = np.clip(np.searchsorted(reference, time), 1, len(reference) - 1)
        nearest = np.minimum(np.abs(reference[after] - time), np.abs(reference[after - 1] - time))
        count += (nearest <= within) & (time >= reference[0] - beyond) & (time <= reference[-1] + beyond)
    return count >= 2


def _resection_score(
    camera: CameraInput, graph: ClockGraph, reconstruction: Reconstruction, kept: _Triangulated
) -> float:
    """Score of a camera for resection: number of common points times their deviation from a plane."""
    clock = _camera_state(camera, graph, Pose.identity())
    moved = _on_reconstruction_clock(clock, graph, reconstruction)
    positions, _ = _resection_points(camera, moved, reconstruction, kept)
    if len(positions) < _MIN_PNP_POINTS:
        return float(len(positions))
    spread = np.linalg.svd(positions - positions.mean(0), compute_uv=False)
    return float(len(positions) * spread[2] / max(spread[0], 1e-12) + 1e-3 * len(positions))


def _on_reconstruction_clock(clock: CameraState, graph: ClockGraph, reconstruction: Reconstruction) -> CameraState:
    """A time map of the graph on the reconstruction's internal time, which the adjustments have changed slightly."""
    name = reconstruction.names[reconstruction.problem.clock_reference]
    now, then = reconstruction.state.cameras[reconstruction.problem.clock_reference], graph.clocks[name]
    rate = now.rate / then.rate
    return replace(clock, rate=clock.rate * rate, offset=(clock.offset - then.offset) * rate + now.offset)


def _resect(
    camera: CameraInput, graph: ClockGraph, reconstruction: Reconstruction, kept: _Triangulated
) -> CameraState | None:
    """Pose of one more camera by resection against the trajectories (PnP with RANSAC, OpenCV)."""
    clock = _on_reconstruction_clock(_camera_state(camera, graph, Pose.identity()), graph, reconstruction)
    positions, seen = _resection_points(camera, clock, reconstruction, kept)
    if len(positions) < _MIN_PNP_POINTS:
        return None
    sample = np.linspace(0, len(positions) - 1, min(len(positions), _MAX_PNP_POINTS)).round().astype(np.int64)
    positions, seen = positions[sample], seen[sample]
    cv2.setRNGSeed(0)
    found, inliers = False, None
    for method in (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP):
        try:
            found, rotation, translation, inliers = cv2.solvePnPRansac(
                np.ascontiguousarray(positions),
                np.ascontiguousarray(seen),
                np.eye(3),
                np.zeros(5),
                iterationsCount=500,
                reprojectionError=_PNP_THRESHOLD_PX / camera.intrinsics.focal,
                confidence=0.9999,
                flags=method,
            )
            break
        except cv2.error:  # since OpenCV 5 the first one refuses a sample in one place, of a point that hovers
            continue
    if not found or inliers is None or len(inliers) < max(_MIN_PNP_POINTS, 0.4 * len(sample)):
        return None
    rodrigues, shift = (np.asarray(vector, np.float64).ravel() for vector in (rotation, translation))
    return replace(clock, pose=Pose.from_rodrigues(rodrigues, shift))


def _intersect_bearings(camera: CameraInput, graph: ClockGraph, reconstruction: Reconstruction) -> CameraState | None:
    """Pose of one more camera from its pairs alone, where no point is seen by three cameras.

    Each pair with a placed camera gives the rotation and the bearing of the new camera; the intersection of two
    bearings gives its position, and with it the scale.
    """
    matrix, right, rotations, weights = np.zeros((3, 3)), np.zeros(3), [], []
    for pair in graph.inlier_pairs:
        if pair.fit is None or camera.name not in (pair.a, pair.b):
            continue
        other = pair.b if pair.a == camera.name else pair.a
        if other not in reconstruction.names:
            continue
        base = reconstruction.state.cameras[reconstruction.names.index(other)].pose
        relative = pair.fit.pose if pair.a == other else pair.fit.pose.inverse()
        ahead = -base.rotation.T @ relative.rotation.T @ relative.direction
        weight = evidence(pair.fit)
        projector = weight * (np.eye(3) - np.outer(ahead, ahead))
        matrix += projector
        right += projector @ base.position
        rotations.append(weight * relative.rotation @ base.rotation)
        weights.append(weight)
    if len(rotations) < 2 or np.linalg.eigvalsh(matrix)[0] < (1.0 - np.cos(_MIN_BEARING_ANGLE)) * min(weights):
        return None
    clock = _on_reconstruction_clock(_camera_state(camera, graph, Pose.identity()), graph, reconstruction)
    return replace(
        clock, pose=Pose(so3.nearest(np.sum(rotations, axis=0)), np.asarray(np.linalg.solve(matrix, right), np.float64))
    )


def sigma_limit(state: AdjustmentState, camera: int) -> float:
    """Noise of one pixel coordinate that a camera that fits has at most: thrice the others' median."""
    return 3.0 * float(np.median(np.delete(state.sigma, camera)))


def inlier_share(reconstruction: Reconstruction, name: str) -> tuple[float, int]:
    """Share of a placed camera's rows that fit the trajectories within 5 sigma or 3 px, and how many rows there are.

    The sigma of a camera that saw something else is inflated by its own residuals: it is limited by `sigma_limit`.
    """
    number = reconstruction.names.index(name)
    state = reconstruction.state
    sigma = min(float(state.sigma[number]), sigma_limit(state, number))
    norms = [
        residual_norms(rows, reconstruction.state.cameras[number], reconstruction.state.trajectories[rows.label])
        for rows in reconstruction.problem.of_camera(number)
    ]
    values = np.concatenate(norms) if norms else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 0
    return float((values < max(3.0, 5.0 * sigma)).mean()), len(values)
