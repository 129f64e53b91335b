"""Camera rotation estimated from the images alone, by tracking the camera's pose over the ground plane.

A pose and not a pure rotation: over a plane, sideways translation looks much like tilting.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np

from edge.uav.base import Telemetry
from edge.uav.ground.ego_motion import EgoMotion
from edge.uav.ground.image_plane import ImagePlane
from edge.uav.ground.plane_pose import PlanePose
from edge.uav.timing.ground_motion import RelativeRotations
from edge.uav.timing.telemetry_offset import MAX_FRAME_GAP_S
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

_NOMINAL_HEIGHT = 50.0  # the scale is not observable
_MAX_BLIND_FRAMES = 5  # without a pose, after which tracking is restarted


class VisualRotationEstimator:
    """Fed with every image in order. size: (width, height) [px]; lens: intrinsics. keep: number of rotations kept."""

    def __init__(self, size: tuple[int, int], lens: Intrinsics, keep: int | None = None) -> None:
        self._plane = ImagePlane(size, lens)
        self._size = size
        self._ego: EgoMotion | None = None
        self._last: tuple[float, PlanePose] | None = None
        self._rotations: deque[tuple[float, float, Floats, Floats]] = deque(maxlen=keep)

    def update(self, image: Image | None, time: float, camera_from_ned: Floats) -> None:
        """Add an image of camera time ``time`` [s]; None: one that could not be decoded.

        camera_from_ned: (3, 3) approximate attitude of the camera; only used where tracking is restarted.
        """
        usable = image is not None and image.shape[:2] == (self._size[1], self._size[0])
        ego = self._ego
        if ego is None or not usable or image is None or self._last is None or time - self._last[0] > MAX_FRAME_GAP_S:
            self._ego = self._last = None
            if usable and image is not None:
                self._restart(image, time, camera_from_ned)
            return
        previous_s, previous = self._last
        if time <= previous_s:
            return
        working = cv2.cvtColor(ego.working_image(image), cv2.COLOR_BGR2GRAY)
        report = ego.update(np.asarray(working, np.uint8), time - previous_s, excluded=None)
        pose = ego.pose
        assert isinstance(pose, PlanePose)
        if report.trusted:
            moved = previous.rotation @ (pose.centre - previous.centre) / -previous.centre[2]
            self.add(previous_s, time, pose.rotation @ previous.rotation.T, moved)
        self._last = time, pose
        if ego.frames_without_pose > _MAX_BLIND_FRAMES or not pose.centre[2] < 0.0:
            self._ego = None

    def add(self, start: float, end: float, rotation: Floats, moved: Floats) -> None:
        """Add a rotation (3, 3) of the camera between two camera times, and how it moved (3,), as they are kept."""
        self._rotations.append((start, end, so3.log(rotation), moved))

    def reset(self) -> None:
        """Discard all rotations, for example after a clock step."""
        self._rotations.clear()
        self._ego = self._last = None

    def relative_rotations(self) -> RelativeRotations:
        """All rotations kept."""
        table = np.array([(start, end, *vector, *moved) for start, end, vector, moved in self._rotations]).reshape(
            -1, 8
        )
        return RelativeRotations(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:])

    def _restart(self, image: Image, time: float, camera_from_ned: Floats) -> None:
        ego = EgoMotion(self._plane)
        working = cv2.cvtColor(ego.working_image(image), cv2.COLOR_BGR2GRAY)
        pose = PlanePose(camera_from_ned, np.array([0.0, 0.0, -_NOMINAL_HEIGHT]))
        ego.begin(np.asarray(working, np.uint8), pose, None)
        self._ego, self._last = ego, (time, pose)


def median_tilt_rotation(telemetry: Sequence[Telemetry], body_from_camera: Floats) -> Floats:
    """camera_from_ned (3, 3) of the telemetry sample whose optical axis has the median downward component."""
    down = np.array([float((sample.ned_from_body @ body_from_camera[:, 2])[2]) for sample in telemetry])
    centre = telemetry[int(np.argsort(down)[len(down) // 2])]
    return np.asarray(body_from_camera).T @ centre.ned_from_body.T
