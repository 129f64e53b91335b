"""In-process bus for pose nodes: messages are delivered at once and in a fixed order, so runs are reproducible."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hub.distributed.network.messages import Notice, SharedObservation, StateMessage
from hub.distributed.network.node import PoseNode
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_MAX_JOINING_UPDATES = 150
"""Updates within which cameras must join a common frame."""


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

    def run_until_converged(self, max_updates: int) -> int:
        """Update until no camera moves by more than 1e-7 in ten updates, at most ``max_updates`` times.

        1e-7 rad relative to the first camera, and as a share of the largest distance from it. Returns the number of
        updates.
        """
        for node in self.nodes.values():
            node.relinearise_all()
        before = self._normalised_poses()
        for count in range(1, max_updates + 1):
            self.tick()
            if count % 10 == 0:
                now = self._normalised_poses()
                complete = len(now) == len(self.nodes) or count >= _MAX_JOINING_UPDATES
                if complete and before.shape == now.shape and float(np.abs(now - before).max(initial=0.0)) < 1e-7:
                    return count
                before = now
        return max_updates

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
