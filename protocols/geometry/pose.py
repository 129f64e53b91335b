"""Camera poses and similarity transforms: ``X_camera = rotation @ (X_world - position)``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from protocols.geometry import so3
from protocols.geometry.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose of a camera.

    rotation: (3, 3), camera from world. position: (3,), the camera's centre in the world.
    """

    rotation: Floats
    position: Floats

    @classmethod
    def from_rodrigues(cls, rotation: Floats, translation: Floats) -> Pose:
        """From a Rodrigues vector and a translation, camera from world, as OpenCV and aniposelib have them."""
        matrix = so3.exp(np.asarray(rotation, dtype=np.float64))
        return cls(matrix, -matrix.T @ np.asarray(translation, dtype=np.float64))

    @classmethod
    def identity(cls) -> Pose:
        """The pose of a camera whose axes are the world's axes."""
        return cls(np.eye(3), np.zeros(3))

    @property
    def rodrigues(self) -> Floats:
        """Rotation vector (3,) [rad], camera from world."""
        return so3.log(self.rotation)

    @property
    def translation(self) -> Floats:
        """(3,), camera from world: ``X_camera = rotation @ X_world + translation``."""
        return np.asarray(-self.rotation @ self.position)

    def camera_from_world(self, points: Floats) -> Floats:
        """World points (n, 3) in camera axes (n, 3)."""
        return np.asarray((points - self.position) @ self.rotation.T)

    def world_from_camera(self, points: Floats) -> Floats:
        """Points (n, 3) in camera axes, in the world (n, 3)."""
        return np.asarray(points @ self.rotation + self.position)


_CAMERA_AXES_UP = np.diag([1.0, -1.0, -1.0])
POSE_CONVENTIONS: dict[str, Callable[[Pose], Pose]] = {
    "translation is the camera's place in the world": lambda pose: Pose(pose.rotation, pose.translation),
    "rotation and translation are world from camera": lambda pose: Pose(pose.rotation.T, pose.translation),
    "rotation is world from camera": lambda pose: Pose(pose.rotation.T, -pose.rotation @ pose.translation),
    "cameras look along -z, with y up": lambda pose: Pose(_CAMERA_AXES_UP @ pose.rotation, pose.position),
    "rotation and translation are world from camera, and cameras look along -z, with y up": lambda pose: Pose(
        _CAMERA_AXES_UP @ pose.rotation.T, pose.translation
    ),
}
"""What other tools write where ``rotation`` and ``translation`` are expected, and the pose that is meant."""
OUR_CONVENTION = "give rotation and translation camera from world, as OpenCV and aniposelib have them"


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``X_new = scale * rotation @ X_old + shift``."""

    scale: float
    rotation: Floats
    shift: Floats

    def points(self, points: Floats) -> Floats:
        """Transform points (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)

    def pose(self, pose: Pose) -> Pose:
        """Transform a camera's pose."""
        return Pose(pose.rotation @ self.rotation.T, self.points(pose.position[None])[0])


def fit_similarity(source: Floats, target: Floats, *, weights: Floats | None = None, scale: bool = True) -> Similarity:
    """Least-squares similarity (Umeyama) that maps ``source`` (n, 3) to ``target`` (n, 3), n >= 3.

    scale: False fits a rigid motion.
    """
    w = np.ones(len(source)) if weights is None else weights
    w = w / w.sum()
    mean_s, mean_t = w @ source, w @ target
    s, t = source - mean_s, target - mean_t
    u, d, vt = np.linalg.svd((w[:, None] * t).T @ s)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    size = float((d * sign).sum() / (w @ (s * s).sum(axis=1))) if scale else 1.0
    return Similarity(size, rotation, mean_t - size * rotation @ mean_s)
