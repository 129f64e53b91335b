"""What pose nodes tell each other. Everything is immutable; arrays are not to be written to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.rig import RigCamera


@dataclass(frozen=True, slots=True)
class SharedObservation:
    """One target seen by one camera.

    camera: who saw it. boot: changes when its agent restarts. sequence: counts its observations; with camera and
    boot, duplicates are dropped by it. time: reference clock [s]; time_std [s]: of the clock map of that camera.
    x, y: normalised, undistorted. std: of x and of y. size: normalised (pixels over focal length), 0 = not known;
    size_std: relative. label: which target; only observations of one label are brought together.
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
class Reference:
    """What is known of one camera in the world. Pose: X_camera = rotation @ (X_world - position).

    position: (3,) with its std. rotation: (3, 3), camera from world, with its std [rad].
    """

    position: Floats | None = None
    rotation: Floats | None = None
    position_std: float = 0.0
    rotation_std: float = 0.0

    @classmethod
    def of(cls, camera: RigCamera) -> Reference | None:
        """What the rig knows of a camera; None if nothing."""
        if camera.position is None and camera.rotation is None:
            return None
        stds = [0.0 if std is None else float(np.max(std)) for std in (camera.position_std, camera.rotation_std)]
        return cls(camera.position, camera.rotation, *stds)


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where a reference camera stands in the network's own frame; flooded through the network (METHODS C, step 7).

    epoch, sequence: later wins. aside: the camera was found to have moved from its reference.
    """

    camera: int
    epoch: int
    sequence: int
    frame: int
    pose: Pose
    reference: Reference
    aside: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class StateMessage:
    """One camera's state for its neighbours (METHODS C, step 6): the latest sequence wins.

    epoch: grows when the camera was bumped; what was learnt with an earlier epoch is void. frame: whose axes and unit
    ``pose`` is in; hops: to that camera. pose: None while not localised. settled: updates since it joined.
    depth: the network's size in hops, as far as heard.
    leaving: the camera goes; its edges are dropped. partner: with bearings only, the camera whose distance from the
    frame's owner is the unit. anchors: references heard of.
    """

    camera: int
    boot: int
    epoch: int
    sequence: int
    frame: int
    hops: int
    pose: Pose | None
    settled: int = 0
    depth: int = 0
    leaving: bool = False
    partner: int = -1
    anchors: tuple[Anchor, ...] = ()

    @property
    def sound(self) -> bool:
        """Whether the pose is finite, with a rotation in it."""
        if self.pose is None:
            return True
        rotation = self.pose.rotation
        if not (np.isfinite(rotation).all() and np.isfinite(self.pose.position).all()):
            return False
        return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6)


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that a person should know. kind: "bumped", "edge begun again", "reference set aside", "joined"."""

    camera: int
    kind: str
    detail: str


Message: TypeAlias = SharedObservation | StateMessage
Out: TypeAlias = StateMessage | Notice
