"""Which way is up, from people: every one of them stands along it."""

from __future__ import annotations

import numpy as np

from hub.tracking.camera_frame import Frame
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_LEAST = 60
"""People seen from head to foot before it is told."""
_MEMORY = 20_000.0
_RATIO = 0.15
"""Largest least eigenvalue over the middle one: people lean, but all views agree on one direction."""


class UpFinder:
    """Gathers, in each camera's own axes, the planes that hold a camera and a person's head and foot.

    The normals of all such planes are at right angles to up, whoever the people are, wherever they stand and whenever
    cameras fire: up is the direction in which the normals have least. Needs views whose planes differ: one
    camera with people in different places, or several cameras.
    """

    def __init__(self) -> None:
        self._moments: dict[str, Floats] = {}
        self._towards: dict[str, Floats] = {}
        self._count: dict[str, float] = {}

    def handle(self, frame: Frame) -> None:
        """Take the people of one frame that are seen from head to foot."""
        whole = np.isfinite(frame.head).all(axis=1) & np.isfinite(frame.foot).all(axis=1)
        if not whole.any():
            return
        one = np.ones((int(whole.sum()), 1))
        head, foot = np.hstack([frame.head[whole], one]), np.hstack([frame.foot[whole], one])
        normal = np.cross(head, foot)
        # Long bodies tell more than short ones: left with their length, unlike the distance off the axis.
        normal /= np.linalg.norm(head, axis=1, keepdims=True) * np.linalg.norm(foot, axis=1, keepdims=True)
        name = frame.camera.name
        count = self._count.get(name, 0.0)
        fade = min(1.0, _MEMORY / max(count, 1.0))
        self._moments[name] = fade * self._moments.get(name, np.zeros((3, 3))) + normal.T @ normal
        self._towards[name] = fade * self._towards.get(name, np.zeros(3)) + (head - foot).sum(axis=0)
        self._count[name] = fade * count + len(normal)

    def find(self, poses: dict[str, Pose]) -> Floats | None:
        """Up, a unit vector (3,) of the world that ``poses`` speak of; None while it is not told."""
        names = [name for name in self._moments if name in poses]
        if sum(self._count[name] for name in names) < _LEAST:
            return None
        moment = sum(
            (poses[name].rotation.T @ self._moments[name] @ poses[name].rotation for name in names), np.zeros((3, 3))
        )
        values, vectors = np.linalg.eigh(moment)
        if not values[0] < _RATIO * values[1]:
            return None
        towards = sum((poses[name].rotation.T @ self._towards[name] for name in names), np.zeros(3))
        return np.asarray(vectors[:, 0] * (1.0 if vectors[:, 0] @ towards > 0.0 else -1.0))
