"""Pose nodes in one process: every message arrives at once and in one order, so that a run can be repeated."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hub.distributed.network.messages import Notice, SharedObservation, StateMessage
from hub.distributed.network.node import PoseNode
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_JOINING = 150
"""Updates that cameras which are in no common frame yet are given to join one."""


class LocalNetwork:
    """Nodes by their number. seen_labels: which cameras watch which label; a camera hears of no others."""

    def __init__(self, nodes: Mapping[int, PoseNode], seen_labels: Mapping[int, list[int]]) -> None:
        self.nodes = dict(nodes)
        self.notices: list[tuple[float, Notice]] = []
        self._watching = seen_labels
        self._now = 0.0

    def observe(self, seen: SharedObservation) -> None:
        """One observation: to its own node, and to those that watch the same label."""
        self._now = seen.time
        for camera in self._watching[seen.label]:
            self._note(self.nodes[camera].handle(seen))

    def tick(self) -> None:
        """One update of every node, then their states travel to their neighbours."""
        states = []
        for node in self.nodes.values():
            out = node.tick(self._now)
            self._note(out)
            states += [item for item in out if isinstance(item, StateMessage)]
        for state in states:
            for neighbour in self.nodes[state.camera].neighbours():
                self._note(self.nodes[neighbour].handle(state))

    def settle(self, most: int, tolerance: float = 1e-7) -> int:
        """Updates until no camera moves by more than ``tolerance`` in ten of them, at the most ``most``.

        tolerance: [rad] against the first camera, and as a share of the largest distance from it. Returns how many
        updates it took.
        """
        for node in self.nodes.values():
            node.revise()
        before = self._shape()
        for count in range(1, most + 1):
            self.tick()
            if count % 10 == 0:
                now = self._shape()
                complete = len(now) == len(self.nodes) or count >= _JOINING
                if complete and before.shape == now.shape and float(np.abs(now - before).max(initial=0.0)) < tolerance:
                    return count
                before = now
        return most

    def _shape(self) -> Floats:
        """The cameras (n, 12) as the first of them sees them: rotation, and position with the farthest 1 away."""
        poses = list(self.poses()[0].values())
        first = poses[0]
        centres = np.array([first.rotation @ (pose.position - first.position) for pose in poses])
        turns = np.array([(pose.rotation @ first.rotation.T).ravel() for pose in poses])
        return np.concatenate([turns, centres / max(float(np.linalg.norm(centres, axis=1).max()), 1e-12)], axis=1)

    def poses(self) -> tuple[dict[int, Pose], int]:
        """Poses of the cameras in the frame that most of them share, and whose frame it is."""
        frames = [node.frame for node in self.nodes.values() if node.pose is not None]
        frame = min(set(frames), key=lambda f: (-frames.count(f), f))
        return {k: n.pose for k, n in self.nodes.items() if n.pose is not None and n.frame == frame}, frame

    def _note(self, out: list[StateMessage | Notice]) -> None:
        self.notices += [(self._now, item) for item in out if isinstance(item, Notice)]
