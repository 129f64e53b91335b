"""How the camera turns, seen in its pictures alone: its pose over the ground plane, followed from picture to picture.

A pose and not a bare rotation: over a plane, a camera that moves sideways looks much like one that tilts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np

from edge.uav.ground.ego_motion import EgoMotion
from edge.uav.ground.image_plane import ImagePlane
from edge.uav.ground.plane_motion import PosePlane
from edge.uav.timing.telemetry_offset import Turning
from edge.uav.tracker import Image, Telemetry
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_HEIGHT = 50.0  # the unit of length is free
_LONGEST_S = 0.25  # between two pictures
_LOST = 5  # pictures without a pose after which it begins anew


class SeenTurning:
    """Fed with every picture in order. size: (width, height) [px]; lens: of the camera. keep: of how many turns."""

    def __init__(self, size: tuple[int, int], lens: Intrinsics, keep: int | None = None) -> None:
        self._plane = ImagePlane(size, lens)
        self._size = size
        self._ego: EgoMotion | None = None
        self._last: tuple[float, Floats] | None = None
        self._turns: deque[tuple[float, float, Floats]] = deque(maxlen=keep)

    def update(self, image: Image | None, time: float, camera_from_ned: Floats) -> None:
        """Take a picture of camera time ``time`` [s]; None: one that could not be decoded.

        camera_from_ned: (3, 3) about how the camera was tilted then; only needed where the pose begins anew.
        """
        usable = image is not None and image.shape[:2] == (self._size[1], self._size[0])
        ego = self._ego
        if ego is None or not usable or image is None or self._last is None or time - self._last[0] > _LONGEST_S:
            self._ego = self._last = None
            if usable and image is not None:
                self._begin(image, time, camera_from_ned)
            return
        before_s, before = self._last
        if time <= before_s:
            return
        small = cv2.cvtColor(ego.shrink(image), cv2.COLOR_BGR2GRAY)
        report = ego.update(np.asarray(small, np.uint8), time - before_s, keep_out=None)
        motion = ego.motion
        assert isinstance(motion, PosePlane)
        if report.trusted:
            self.add(before_s, time, motion.rotation @ before.T)
        self._last = time, motion.rotation
        if ego.blind > _LOST or not motion.centre[2] < 0.0:
            self._ego = None

    def add(self, begin: float, end: float, turned: Floats) -> None:
        """Take a rotation (3, 3) of the camera between two camera times, seen by somebody else."""
        self._turns.append((begin, end, so3.log(turned)))

    def clear(self) -> None:
        """What was seen belongs to another time."""
        self._turns.clear()
        self._ego = self._last = None

    def turning(self) -> Turning:
        """All that was kept."""
        table = np.array([(begin, end, *turn) for begin, end, turn in self._turns]).reshape(-1, 5)
        return Turning(table[:, 0], table[:, 1], table[:, 2:])

    def _begin(self, image: Image, time: float, camera_from_ned: Floats) -> None:
        ego = EgoMotion(self._plane)
        small = cv2.cvtColor(ego.shrink(image), cv2.COLOR_BGR2GRAY)
        ego.begin(np.asarray(small, np.uint8), PosePlane(camera_from_ned, np.array([0.0, 0.0, -_HEIGHT])), None)
        self._ego, self._last = ego, (time, camera_from_ned)


def usual_tilt(telemetry: Sequence[Telemetry], body_from_camera: Floats) -> Floats:
    """camera_from_ned (3, 3) of the sample whose camera looks down as the middle one does."""
    down = np.array([float((sample.ned_from_body @ body_from_camera[:, 2])[2]) for sample in telemetry])
    middle = telemetry[int(np.argsort(down)[len(down) // 2])]
    return np.asarray(body_from_camera).T @ middle.ned_from_body.T
