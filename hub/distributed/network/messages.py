"""Messages between pose nodes. All are immutable; arrays must not be modified."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.rig import RigCamera


@dataclass(frozen=True, slots=True)
class SharedObservation:
    """One observation of a target by one camera.

    camera: its number. boot: boot id, changes when its agent restarts. sequence: observation counter; with camera and
    boot it identifies duplicates. time: reference clock [s]; time_std [s]: of the clock map of that camera.
    x, y: normalised, undistorted. std: of x and of y. size: normalised (pixels over focal length), 0 = not known;
    size_std: relative. label: target id; only observations of the same label are associated.
    """

    camera: int
    boot: int
    sequence: int
    time: float
    x: float
    y: float
    std: float
    size: float = 0.0
    size_std: float = 0.0
    label: int = 0
    time_std: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoint:
    """Surveyed pose of one camera in the world, or a part of it: X_camera = rotation @ (X_world - position).

    position: (3,) with its std. rotation: (3, 3), camera from world, with its std [rad].
    """

    position: Floats | None = None
    rotation: Floats | None = None
    position_std: float = 0.0
    rotation_std: float = 0.0

    @classmethod
    def of(cls, camera: RigCamera) -> ControlPoint | None:
        """The control point of a rig camera; None without position and attitude."""
        if camera.position is None and camera.rotation is None:
            return None
        stds = [0.0 if std is None else float(np.max(std)) for std in (camera.position_std, camera.rotation_std)]
        return cls(camera.position, camera.rotation, *stds)


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A control point with its camera's pose in the network's frame; flooded through the network.

    Distributed pose paper, step 7. epoch, sequence: the later one wins. rejected: the camera was found not to be at its
    control point.
    """

    camera: int
    epoch: int
    sequence: int
    frame: int
    pose: Pose
    control_point: ControlPoint
    rejected: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class StateMessage:
    """One camera's state for its neighbours (distributed pose paper, step 6): the latest sequence wins.

    epoch: incremented when the camera has moved; factors of an earlier epoch are void. frame: the camera whose axes and
    unit ``pose`` uses; hops: graph distance to that camera. pose: None while not localised. frame_age: updates since it
    joined the frame. depth: the network's size in hops, as far as known. leaving: the camera leaves the network and its
    edges are dropped. partner: with bearings only, the camera whose distance from the frame's owner is the unit.
    anchors: known control points.
    """

    camera: int
    boot: int
    epoch: int
    sequence: int
    frame: int
    hops: int
    pose: Pose | None
    frame_age: int = 0
    depth: int = 0
    leaving: bool = False
    partner: int = -1
    anchors: tuple[Anchor, ...] = ()

    @property
    def is_valid(self) -> bool:
        """Whether the pose is finite and its rotation orthonormal."""
        if self.pose is None:
            return True
        rotation = self.pose.rotation
        if not (np.isfinite(rotation).all() and np.isfinite(self.pose.position).all()):
            return False
        return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6)


@dataclass(frozen=True, slots=True)
class Notice:
    """An event for the operator. kind: "bumped", "edge begun again", "reference set aside", "joined"."""

    camera: int
    kind: str
    detail: str


Message: TypeAlias = SharedObservation | StateMessage
Output: TypeAlias = StateMessage | Notice
