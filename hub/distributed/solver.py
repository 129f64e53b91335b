"""Distributed pose estimation on a recorded session: `--solver distributed`.

Every camera has its pose node; all of them run in this process and receive their observations in the order of the log,
on the estimated clocks; messages are delivered at once and in a fixed order, so runs are reproducible. The trajectory
is fitted afterwards with fixed poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from hub.bundle.adjustment import adjust
from hub.bundle.datum.control_outliers import reject_outliers
from hub.bundle.datum.gauge import fix_gauge
from hub.bundle.initialisation import Reconstruction, reconstruct_with_known_poses
from hub.bundle.preprocessing import PreparedSession
from hub.clocks.clock_graph import ClockGraph
from hub.distributed.network.association import MAX_GAP_S
from hub.distributed.network.block_solver import connected_cameras, merge_duplicate_factors, position_stds
from hub.distributed.network.host import UPDATE_PERIOD_S, NodeHost
from hub.distributed.network.messages import ControlPoint, Notice, SharedObservation, StateMessage
from hub.distributed.network.node import PoseNode
from hub.trajectory.image_tracks import ImageTrack, SmoothTrack
from protocols.core.clocks import TimeMap
from protocols.core.errors import Refused
from protocols.core.version import VERSION
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Bools, Floats
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_MAX_UPDATES = 600  # of each node: a bound, a minute of them
_RAW_OBSERVATIONS = 4096
"""Raw observations that a node keeps per neighbour; offline there is more memory than on a camera board."""
_MIN_SIZE_STD = 0.03
"""Smallest relative std of a size: detectors' errors are larger than their scatter."""
_MIN_SIZED_SHARE = 0.9
"""Share of a track's rows with a size above which its sizes are used."""
_ROUNDS = 2
"""Rounds of nodes and trajectory fit: the fit gives better clocks than the pairs, so the nodes run again."""

ProgressCallback = Callable[[str, float], None]


_MAX_JOINING_UPDATES = 150
"""Updates within which cameras must join a common frame."""


class DistributedPoseSolver:
    """Estimates the poses of a clock graph's cameras by pose nodes. warnings: notices of the last run."""

    def __init__(
        self,
        rig: Rig,
        prepared: PreparedSession,
        observations: Observations,
        report_progress: ProgressCallback,
        seed: int = 0,
    ) -> None:
        self._rig, self._prepared, self._observations = rig, prepared, observations
        self._report_progress, self._seed = report_progress, seed
        self.warnings: tuple[str, ...] = ()

    def __call__(self, graph: ClockGraph) -> tuple[Reconstruction, dict[str, str]]:
        """Reconstruction (poses, then trajectory) of the cameras of ``graph``, and the refused cameras with reasons.

        Raises Refused where fewer than two cameras are localised in one frame.
        """
        prepared, free = self._prepared, not self._prepared.shared_clock
        rounds = _ROUNDS if free else 1
        for round_index in range(rounds):
            self._report_progress("pose nodes", 0.6 + 0.15 * round_index)
            poses, notices = _run(self._rig, prepared, self._observations, graph, self._seed)
            refused = {
                name: "its pose node could not be localised: too few simultaneous observations shared with the others"
                for name in graph.clocks
                if name not in poses
            }
            if len(poses) < 2:
                raise Refused("no two cameras were localised in one frame", prepared.refused | refused)
            inside = replace(graph, clocks={name: graph.clocks[name] for name in poses})
            reconstruction = reconstruct_with_known_poses(
                prepared.cameras, inside, prepared.rows, prepared.labels, poses, free
            )
            problem, state, _ = adjust(reconstruction.problem, reconstruction.state)
            found = dict(zip(reconstruction.names, state.cameras, strict=True))
            clocks = {
                name: replace(clock, rate=found[name].rate, offset=found[name].offset) if name in found else clock
                for name, clock in graph.clocks.items()
            }
            graph = replace(graph, clocks=clocks)
        self.warnings = tuple(notices)
        # Later covariances include the poses, which this adjustment kept fixed.
        problem = replace(problem, free_parameters=replace(problem.free_parameters, pose=True))
        if any(problem.lens_priors):  # the nodes keep lenses, and the poses follow from what is estimated of them
            problem, state, _ = adjust(problem, state)
        return Reconstruction(reconstruction.names, reconstruction.labels, problem, state), refused


def _run(
    rig: Rig, prepared: PreparedSession, observations: Observations, graph: ClockGraph, seed: int
) -> tuple[dict[str, Pose], list[str]]:
    """Poses by name in one frame, scaled to a first baseline of 1; and the nodes' notices."""
    names = [name for name in prepared.camera_order if name in graph.clocks]
    number = {name: i for i, name in enumerate(names)}
    rows = shared_observations(prepared, observations, graph, names)
    watching: dict[int, set[int]] = {}
    for row in rows:
        watching.setdefault(row.label, set()).add(row.camera)
    gap = 0.0 if prepared.shared_clock else MAX_GAP_S
    nodes = {
        i: PoseNode(i, control_point=ControlPoint.of(rig.cameras[name]), seed=seed, raw=_RAW_OBSERVATIONS, gap=gap)
        for name, i in number.items()
    }
    network = InProcessNetwork(nodes, {label: sorted(cameras) for label, cameras in watching.items()})
    due = rows[0].time + UPDATE_PERIOD_S if rows else 0.0
    for row in rows:
        while row.time >= due:
            network.tick()
            due = max(due + UPDATE_PERIOD_S, row.time - 1.0)  # no updates across a gap
        network.observe(row)
    network.run_until_converged()
    poses, _ = network.poses()
    placed = sorted(poses)
    if len(placed) < 2:
        return {}, []
    apart = float(np.linalg.norm(poses[placed[1]].position - poses[placed[0]].position))
    unit = Similarity(1.0 / max(apart, 1e-12), np.eye(3), np.zeros(3))
    reported_kinds = ("bumped", "reference set aside")
    notices = [f"{names[n.camera]}: {n.kind}: {n.detail}" for _, n in network.notices if n.kind in reported_kinds]
    return {names[i]: unit.pose(poses[i]) for i in placed}, notices


def shared_observations(
    prepared: PreparedSession, observations: Observations, graph: ClockGraph, names: list[str]
) -> list[SharedObservation]:
    """All inlier rows of the tracks on the reference clock, in its order; cameras by index in ``names``."""
    out: list[SharedObservation] = []
    for camera, name in enumerate(names):
        clock = graph.clocks[name]
        mine = []
        for label, track in prepared.cameras[name].tracks.items():
            time = clock.rate * (track.time - clock.centre) + clock.offset
            size, size_std = normalised_sizes(prepared, observations, name, label)
            std = 0.0 if prepared.shared_clock else _time_std(name, graph)
            sigma = _sigma(name, track, graph)
            number = prepared.labels.index(label)
            for t, (x, y), s in zip(time.tolist(), track.points.tolist(), size.tolist(), strict=True):
                mine.append((t, x, y, sigma, s, size_std, number, std))
        out += [SharedObservation(camera, 0, sequence, *row) for sequence, row in enumerate(sorted(mine))]
    return sorted(out, key=lambda row: (row.time, row.camera, row.sequence))


def normalised_sizes(
    prepared: PreparedSession, observations: Observations, name: str, label: str
) -> tuple[Floats, float]:
    """Normalised sizes (n,) of a track's rows, 0 where unknown, and their relative std; std 0 if sizes are unusable.

    The std is estimated from the scatter of neighbouring rows: second differences of the logarithm.
    """
    track, raw = prepared.cameras[name].tracks[label], observations.by_label(name)[label]
    time = track.time / prepared.time_scale(name) + prepared.time_origins[name]
    index = np.clip(np.searchsorted(raw.time, time), 1, max(len(raw) - 1, 1))
    index = np.where(np.abs(raw.time[index - 1] - time) < np.abs(raw.time[index] - time), index - 1, index)
    size = raw.size[index] / track.focal
    known: Bools = np.asarray(np.isfinite(size) & (size > 0.0))
    if known.mean() < _MIN_SIZED_SHARE or known.sum() < 8:
        return np.zeros(len(time)), 0.0
    second_difference = np.diff(np.log(size[known]), 2)
    std = 1.4826 * float(np.median(np.abs(second_difference))) / np.sqrt(6.0)
    return np.where(known, size, 0.0), max(std, _MIN_SIZE_STD)


def _sigma(name: str, track: ImageTrack, graph: ClockGraph) -> float:
    """Noise of one normalised coordinate. For separate points it is taken from the residuals of their pairs."""
    if isinstance(track, SmoothTrack):
        return track.sigma
    left = [p.fit.residual_px for p in graph.inlier_pairs if p.fit is not None and name in (p.a, p.b)]
    return max(float(np.median([s for s in left if np.isfinite(s)] or [0.0])) / track.focal, track.sigma)


def _time_std(name: str, graph: ClockGraph) -> float:
    """Std [s] of the camera's clock: the smallest of its pairs."""
    stds = [p.fit.lag_std for p in graph.inlier_pairs if p.fit is not None and name in (p.a, p.b)]
    return min([s for s in stds if np.isfinite(s)], default=0.0)


def node_calibration(rig: Rig, nodes: NodeHost | None) -> Calibration:
    """The network's poses as a calibration, where clocks are not estimated.

    Position stds are marginals of the joint covariance over the factors of all edges.

    Raises Refused while fewer than two cameras have converged.
    """
    poses = {} if nodes is None else nodes.poses()
    names = [name for name in rig.cameras if name in poses and rig.cameras[name].intrinsics is not None]
    refused = {name: "its pose node has not converged yet" for name in rig.cameras if name not in names}
    refused |= {} if nodes is None else nodes.refused
    if len(names) < 2:
        raise Refused("fewer than two pose nodes have converged", refused)
    assert nodes is not None
    edges = merge_duplicate_factors(nodes.factors())
    connected = connected_cameras(names, edges)
    refused |= {name: "its pose node's factors have not been received yet" for name in names if name not in connected}
    names = [name for name in names if name in connected]
    if len(names) < 2:
        raise Refused("fewer than two pose nodes have converged", refused)
    rig, rejected = reject_outliers(rig, names, [poses[name] for name in names])
    gauge = fix_gauge(rig, names, [poses[name] for name in names])
    stds = position_stds({name: poses[name] for name in names}, edges, gauge.similarity, gauge.information)
    cameras = {}
    for name in names:
        lens = rig.cameras[name].intrinsics
        assert lens is not None
        rate, offset, std = nodes.clock(name)
        pose = gauge.similarity.pose(poses[name])
        cameras[name] = CameraCalibration(name, lens, pose, TimeMap(rate, offset), std, stds[name], 0.0, lag_std=std)
    return Calibration(
        cameras=cameras,
        reference=names[0],
        scale=gauge.scale,
        units=rig.units,
        solver="distributed",
        version=VERSION,
        refused=refused,
        warnings=rejected + gauge.warnings,
    )


class InProcessNetwork:
    """Nodes by camera number. cameras_by_label: cameras that observe a label and so receive it."""

    def __init__(self, nodes: Mapping[int, PoseNode], cameras_by_label: Mapping[int, list[int]]) -> None:
        self.nodes = dict(nodes)
        self.notices: list[tuple[float, Notice]] = []
        self._cameras_by_label = cameras_by_label
        self._now = 0.0

    def observe(self, seen: SharedObservation) -> None:
        """Deliver an observation to all nodes whose cameras observe the same label."""
        self._now = seen.time
        for camera in self._cameras_by_label[seen.label]:
            self._record(self.nodes[camera].handle(seen))

    def tick(self) -> None:
        """One update of every node, then delivery of their states to their neighbours."""
        states = []
        for node in self.nodes.values():
            out = node.tick(self._now)
            self._record(out)
            states += [item for item in out if isinstance(item, StateMessage)]
        for state in states:
            for neighbour in self.nodes[state.camera].neighbours():
                self._record(self.nodes[neighbour].handle(state))

    def run_until_converged(self) -> None:
        """Update until no camera moves by more than 1e-7 in ten updates, at most ``_MAX_UPDATES`` times.

        1e-7 rad relative to the first camera, and as a share of the largest distance from it.
        """
        for node in self.nodes.values():
            node.relinearise_all()
        before = self._normalised_poses()
        for count in range(1, _MAX_UPDATES + 1):
            self.tick()
            if count % 10 == 0:
                now = self._normalised_poses()
                complete = len(now) == len(self.nodes) or count >= _MAX_JOINING_UPDATES
                if complete and before.shape == now.shape and float(np.abs(now - before).max(initial=0.0)) < 1e-7:
                    return
                before = now

    def _normalised_poses(self) -> Floats:
        """Poses (n, 12) relative to the first camera: rotations, and positions scaled to a largest distance of 1."""
        poses = list(self.poses()[0].values())
        first = poses[0]
        centres = np.array([first.rotation @ (pose.position - first.position) for pose in poses])
        turns = np.array([(pose.rotation @ first.rotation.T).ravel() for pose in poses])
        return np.concatenate([turns, centres / max(float(np.linalg.norm(centres, axis=1).max()), 1e-12)], axis=1)

    def poses(self) -> tuple[dict[int, Pose], int]:
        """Poses of the cameras in the most common frame, and the number of its owner."""
        frames = [node.frame for node in self.nodes.values() if node.pose is not None]
        frame = min(set(frames), key=lambda f: (-frames.count(f), f))
        return {k: n.pose for k, n in self.nodes.items() if n.pose is not None and n.frame == frame}, frame

    def _record(self, out: list[StateMessage | Notice]) -> None:
        self.notices += [(self._now, item) for item in out if isinstance(item, Notice)]
