"""Estimation of the vertical direction from upright people."""

from __future__ import annotations

import numpy as np

from hub.tracking.detections import FrameDetections
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

_MIN_PEOPLE = 60
"""Detections with head and foot before an estimate is given."""
_MAX_COUNT = 20_000.0  # detections of a camera, eleven minutes of one person at 30 fps: older ones fade
_MAX_EIGENVALUE_RATIO = 0.15
"""Largest ratio of the smallest to the middle eigenvalue: people tilt, but all views must agree on one direction."""


class VerticalEstimator:
    """Accumulates, in each camera's axes, the planes through the camera centre and a person's head and foot.

    The normals of these planes are perpendicular to the vertical, for any person, position and capture time: up is the
    eigenvector of their second moments with the smallest eigenvalue. The planes must differ: one camera that sees
    people in different places, or several cameras.
    """

    def __init__(self) -> None:
        self._moments: dict[str, Floats] = {}
        self._head_directions: dict[str, Floats] = {}
        self._count: dict[str, float] = {}

    def handle(self, frame: FrameDetections) -> None:
        """Add the people of one frame whose head and foot are both detected."""
        complete = np.isfinite(frame.head).all(axis=1) & np.isfinite(frame.foot).all(axis=1)
        if not complete.any():
            return
        one = np.ones((int(complete.sum()), 1))
        head, foot = np.hstack([frame.head[complete], one]), np.hstack([frame.foot[complete], one])
        normal = np.cross(head, foot)
        # Tall silhouettes are more informative: the normal keeps the body's length, not its distance from the axis.
        normal /= np.linalg.norm(head, axis=1, keepdims=True) * np.linalg.norm(foot, axis=1, keepdims=True)
        name = frame.camera.name
        count = self._count.get(name, 0.0)
        fade = min(1.0, _MAX_COUNT / max(count, 1.0))
        self._moments[name] = fade * self._moments.get(name, np.zeros((3, 3))) + normal.T @ normal
        self._head_directions[name] = fade * self._head_directions.get(name, np.zeros(3)) + (head - foot).sum(axis=0)
        self._count[name] = fade * count + len(normal)

    def estimate(self, poses: dict[str, Pose]) -> Floats | None:
        """Up as a unit vector (3,) in the world frame of ``poses``; None while it is not well determined."""
        names = [name for name in self._moments if name in poses]
        if sum(self._count[name] for name in names) < _MIN_PEOPLE:
            return None
        moment = sum(
            (poses[name].rotation.T @ self._moments[name] @ poses[name].rotation for name in names), np.zeros((3, 3))
        )
        values, vectors = np.linalg.eigh(moment)
        if not values[0] < _MAX_EIGENVALUE_RATIO * values[1]:
            return None
        head_direction = sum((poses[name].rotation.T @ self._head_directions[name] for name in names), np.zeros(3))
        return np.asarray(vectors[:, 0] * (1.0 if vectors[:, 0] @ head_direction > 0.0 else -1.0))
