"""Poses by pose nodes on a recorded session: `--solver distributed`.

Every camera has its node; all of them run in this process and get their observations in the order of the log, on the
clocks that the timing estimator found. The path is fitted to the poses afterwards, and moves none of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hub.bundle.adjustment import adjust
from hub.calibration.clock_graph import ClockGraph
from hub.calibration.initialisation import Scaffold, place_known
from hub.calibration.preprocessing import Prepared
from hub.datum.control_outliers import trusted
from hub.datum.gauge import fix_gauge
from hub.distributed.network.association import GAP
from hub.distributed.network.host import NodeHost
from hub.distributed.network.in_process_bus import LocalNetwork
from hub.distributed.network.marginals import each_once, joined, position_stds
from hub.distributed.network.messages import Reference, SharedObservation
from hub.distributed.network.node import PoseNode
from hub.trajectory.image_tracks import SmoothTrack, Track
from protocols.core.clocks import TimeMap
from protocols.core.errors import Refused
from protocols.core.version import VERSION
from protocols.geometry.pose import Pose, Similarity
from protocols.geometry.types import Bools, Floats
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_EVERY_S = 0.1
"""Time between two updates of each node [s]."""
_SETTLE = 600
_RAW = 4096
"""Observations that a node keeps of each neighbour: a recording has room for them, a camera board has not."""
_LEAST_SIZE_STD = 0.03
"""Least relative std of a size: detectors err by more than their scatter tells."""
_LEAST_SIZED = 0.9
"""Share of a track's rows with a size from which its sizes are used."""
_ROUNDS = 2
"""The path tells the clocks better than pairs do; with those clocks the nodes run once more."""

Tell = Callable[[str, float], None]


class PlacedByNodes:
    """Places the cameras of a graph by pose nodes. warnings: what the nodes had to tell the last time."""

    def __init__(self, rig: Rig, prepared: Prepared, observations: Observations, tell: Tell, seed: int = 0) -> None:
        self._rig, self._prepared, self._observations = rig, prepared, observations
        self._tell, self._seed = tell, seed
        self.warnings: tuple[str, ...] = ()

    def __call__(self, graph: ClockGraph) -> tuple[Scaffold, dict[str, str]]:
        """Poses of the cameras of ``graph``, then the path between them; and the refused, with reasons.

        Raises Refused where fewer than two cameras come into one frame.
        """
        prepared, free = self._prepared, not self._prepared.shared_clock
        rounds = _ROUNDS if free else 1
        for turn in range(rounds):
            self._tell("pose nodes", 0.6 + 0.15 * turn)
            poses, told = _run(self._rig, prepared, self._observations, graph, self._seed)
            refused = {
                name: "its pose node could join no other: too little seen together with the others at one time"
                for name in graph.clocks
                if name not in poses
            }
            if len(poses) < 2:
                raise Refused("no two cameras came into one frame", prepared.refused | refused)
            inside = replace(graph, clocks={name: graph.clocks[name] for name in poses})
            scaffold = place_known(prepared.cameras, inside, prepared.rows, prepared.labels, poses, free)
            problem, state, _ = adjust(scaffold.problem, scaffold.state)
            found = dict(zip(scaffold.names, state.cameras, strict=True))
            clocks = {
                name: replace(clock, rate=found[name].rate, offset=found[name].offset) if name in found else clock
                for name, clock in graph.clocks.items()
            }
            graph = replace(graph, clocks=clocks)
        self.warnings = tuple(told)
        # What the covariance is asked for later is of poses too, which this adjustment left alone.
        problem = replace(problem, freedom=replace(problem.freedom, pose=True))
        return Scaffold(scaffold.names, scaffold.labels, problem, state), refused


def _run(
    rig: Rig, prepared: Prepared, observations: Observations, graph: ClockGraph, seed: int
) -> tuple[dict[str, Pose], list[str]]:
    """Poses by name in one frame, the first two cameras 1 apart; and what the nodes had to tell."""
    names = [name for name in prepared.order if name in graph.clocks]
    number = {name: i for i, name in enumerate(names)}
    rows = shared_observations(prepared, observations, graph, names)
    watching: dict[int, set[int]] = {}
    for row in rows:
        watching.setdefault(row.label, set()).add(row.camera)
    gap = 0.0 if prepared.shared_clock else GAP
    nodes = {
        i: PoseNode(i, reference=Reference.of(rig.cameras[name]), seed=seed, raw=_RAW, gap=gap)
        for name, i in number.items()
    }
    network = LocalNetwork(nodes, {label: sorted(cameras) for label, cameras in watching.items()})
    due = rows[0].time + _EVERY_S if rows else 0.0
    for row in rows:
        while row.time >= due:
            network.tick()
            due = max(due + _EVERY_S, row.time - 1.0)  # across a gap there is nothing to update
        network.observe(row)
    network.settle(_SETTLE)
    poses, _ = network.poses()
    placed = sorted(poses)
    if len(placed) < 2:
        return {}, []
    apart = float(np.linalg.norm(poses[placed[1]].position - poses[placed[0]].position))
    unit = Similarity(1.0 / max(apart, 1e-12), np.eye(3), np.zeros(3))
    worth = ("bumped", "reference set aside")
    told = [f"{names[n.camera]}: {n.kind}: {n.detail}" for _, n in network.notices if n.kind in worth]
    return {names[i]: unit.pose(poses[i]) for i in placed}, told


def shared_observations(
    prepared: Prepared, observations: Observations, graph: ClockGraph, names: list[str]
) -> list[SharedObservation]:
    """All rows that their track holds for good, on the reference clock, in its order; cameras by place in ``names``."""
    out: list[SharedObservation] = []
    for camera, name in enumerate(names):
        clock = graph.clocks[name]
        mine = []
        for label, track in prepared.cameras[name].tracks.items():
            time = clock.rate * (track.time - clock.centre) + clock.offset
            size, size_std = sizes_of(prepared, observations, name, label)
            std = 0.0 if prepared.shared_clock else _time_std(name, graph)
            sigma = _sigma(name, track, graph)
            number = prepared.labels.index(label)
            for t, (x, y), s in zip(time.tolist(), track.points.tolist(), size.tolist(), strict=True):
                mine.append((t, x, y, sigma, s, size_std, number, std))
        out += [SharedObservation(camera, 0, sequence, *row) for sequence, row in enumerate(sorted(mine))]
    return sorted(out, key=lambda row: (row.time, row.camera, row.sequence))


def sizes_of(prepared: Prepared, observations: Observations, name: str, label: str) -> tuple[Floats, float]:
    """Normalised sizes (n,) of a track's rows, 0 where not known, and their relative std; 0 if not to be used.

    The scatter of neighbouring rows tells the std: second differences of the logarithm.
    """
    track, raw = prepared.cameras[name].tracks[label], observations.by_label(name)[label]
    time = track.time / prepared.pace(name) + prepared.epochs[name]
    index = np.clip(np.searchsorted(raw.time, time), 1, max(len(raw) - 1, 1))
    index = np.where(np.abs(raw.time[index - 1] - time) < np.abs(raw.time[index] - time), index - 1, index)
    size = raw.size[index] / track.focal
    known: Bools = np.asarray(np.isfinite(size) & (size > 0.0))
    if known.mean() < _LEAST_SIZED or known.sum() < 8:
        return np.zeros(len(time)), 0.0
    bend = np.diff(np.log(size[known]), 2)
    std = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0)
    return np.where(known, size, 0.0), max(std, _LEAST_SIZE_STD)


def _sigma(name: str, track: Track, graph: ClockGraph) -> float:
    """Noise of one normalised coordinate. Separate points tell none; what their pairs left over does."""
    if isinstance(track, SmoothTrack):
        return track.sigma
    left = [p.fit.sigma_px for p in graph.agreeing if p.fit is not None and name in (p.a, p.b)]
    return max(float(np.median([s for s in left if np.isfinite(s)] or [0.0])) / track.focal, track.sigma)


def _time_std(name: str, graph: ClockGraph) -> float:
    """How well the camera's clock is known [s]: the best of its pairs."""
    stds = [p.fit.lag_std for p in graph.agreeing if p.fit is not None and name in (p.a, p.b)]
    return min([s for s in stds if np.isfinite(s)], default=0.0)


def with_node_poses(found: Calibration, rig: Rig, nodes: NodeHost) -> Calibration:
    """A live calibration with the network's poses in the rig's world, once every camera of it has settled there."""
    poses = nodes.poses()
    names = [name for name in found.cameras if name in poses]
    if len(names) < len(found.cameras):
        return found
    rig, aside = trusted(rig, names, [poses[name] for name in names])
    world = fix_gauge(rig, names, [poses[name] for name in names]).similarity
    cameras = {name: replace(camera, pose=world.pose(poses[name])) for name, camera in found.cameras.items()}
    warnings = found.warnings + tuple(told for told in aside if told not in found.warnings)
    return replace(found, cameras=cameras, solver="distributed", warnings=warnings)


def node_calibration(rig: Rig, nodes: NodeHost | None) -> Calibration:
    """The network's poses as a calibration, where no timing is sought.

    Position stds are of all cameras together, from what every edge has learnt.

    Raises Refused while fewer than two cameras have settled.
    """
    poses = {} if nodes is None else nodes.poses()
    names = [name for name in rig.cameras if name in poses and rig.cameras[name].intrinsics is not None]
    refused = {name: "its pose node has not settled yet" for name in rig.cameras if name not in names}
    refused |= {} if nodes is None else nodes.refused
    if len(names) < 2:
        raise Refused("fewer than two pose nodes have settled", refused)
    assert nodes is not None
    edges = each_once(nodes.learnt())
    tied = joined(names, edges)
    refused |= {name: "what its pose node has learnt is not known here yet" for name in names if name not in tied}
    names = [name for name in names if name in tied]
    if len(names) < 2:
        raise Refused("fewer than two pose nodes have settled", refused)
    rig, aside = trusted(rig, names, [poses[name] for name in names])
    gauge = fix_gauge(rig, names, [poses[name] for name in names])
    stds = position_stds({name: poses[name] for name in names}, edges, gauge.similarity, gauge.information)
    cameras = {}
    for name in names:
        lens = rig.cameras[name].intrinsics
        assert lens is not None
        rate, offset, std = nodes.clock(name)
        pose = gauge.similarity.pose(poses[name])
        cameras[name] = CameraCalibration(name, lens, pose, TimeMap(rate, offset), std, stds[name], 0.0)
    return Calibration(
        cameras=cameras,
        reference=names[0],
        scale=gauge.scale,
        units=rig.units,
        solver="distributed",
        version=VERSION,
        refused=refused,
        warnings=aside + gauge.warnings,
    )
