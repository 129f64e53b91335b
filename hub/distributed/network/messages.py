"""Messages between pose nodes, and their protobuf form. All are immutable; arrays must not be modified."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hub.distributed.factors.factor import QuadraticFactor
from hub.distributed.factors.two_view_model import RelativeTransform
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import RigCamera
from protocols.validation.rules import SCHEMA_VERSION

_UPPER = np.triu_indices(6)
_LONGEST = 63
"""Maximum length of a camera's id."""


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


def number_of(camera: str) -> int:
    """A number for a camera's name: in the same order as the names, and the same on every host."""
    return int.from_bytes(camera.encode("ascii").ljust(_LONGEST, b"\0"), "big")


def name_of(number: int) -> str:
    """The camera's name of a number; "" for a negative one."""
    return "" if number < 0 else number.to_bytes(_LONGEST, "big").rstrip(b"\0").decode("ascii")


def state_to_wire(state: StateMessage, host: str, takeover: int) -> pb.NodeState:
    """The state as a message, without factors."""
    message = pb.NodeState(
        schema_version=SCHEMA_VERSION,
        camera=name_of(state.camera),
        host=host,
        takeover=takeover,
        sequence=state.sequence,
        epoch=state.epoch,
        frame=name_of(state.frame),
        hops=state.hops,
        depth=state.depth,
        settled=state.frame_age,
        partner=name_of(state.partner),
        leaving=state.leaving,
    )
    if state.pose is not None:
        message.rotation.extend(so3.log(state.pose.rotation).tolist())
        message.position.extend(state.pose.position.tolist())
    message.anchors.extend(_anchor_to_wire(anchor) for anchor in state.anchors)
    return message


def state_from_wire(message: pb.NodeState) -> StateMessage:
    """The state of a message. Sequence numbers of a later host are above all of an earlier one's."""
    pose = None
    if len(message.rotation) == 3:
        pose = Pose(so3.exp(np.array(message.rotation)), np.array(message.position))
    return StateMessage(
        camera=number_of(message.camera),
        boot=0,
        epoch=message.epoch,
        sequence=(message.takeover << 40) + message.sequence,
        frame=number_of(message.frame),
        hops=message.hops,
        pose=pose,
        frame_age=message.settled,
        depth=message.depth,
        leaving=message.leaving,
        partner=number_of(message.partner) if message.partner else -1,
        anchors=tuple(_anchor_from_wire(anchor, number_of(message.frame)) for anchor in message.anchors),
    )


def _anchor_to_wire(anchor: Anchor) -> pb.NodeAnchor:
    known = anchor.control_point
    return pb.NodeAnchor(
        camera=name_of(anchor.camera),
        epoch=anchor.epoch,
        sequence=anchor.sequence,
        rotation=so3.log(anchor.pose.rotation).tolist(),
        position=anchor.pose.position.tolist(),
        world_rotation=[] if known.rotation is None else so3.log(known.rotation).tolist(),
        world_position=[] if known.position is None else known.position.tolist(),
        rotation_std=known.rotation_std,
        position_std=known.position_std,
        aside=anchor.rejected,
    )


def _anchor_from_wire(message: pb.NodeAnchor, frame: int) -> Anchor:
    known = ControlPoint(
        np.array(message.world_position) if message.world_position else None,
        so3.exp(np.array(message.world_rotation)) if message.world_rotation else None,
        message.position_std,
        message.rotation_std,
    )
    pose = Pose(so3.exp(np.array(message.rotation)), np.array(message.position))
    return Anchor(number_of(message.camera), message.epoch, message.sequence, frame, pose, known, message.aside)


def edges_to_wire(factors: Mapping[int, QuadraticFactor]) -> list[pb.NodeEdge]:
    """A node's factors by neighbour, as messages."""
    return [
        pb.NodeEdge(
            neighbour=name_of(neighbour),
            rotation=so3.log(factor.anchor.rotation).tolist(),
            centre=factor.anchor.centre.tolist(),
            hessian=factor.hessian[_UPPER].tolist(),
            gradient=factor.gradient.tolist(),
            count=factor.count,
            bearings=factor.bearings,
            chi2=factor.chi2,
        )
        for neighbour, factor in factors.items()
    ]


def edges_from_wire(edges: list[pb.NodeEdge]) -> dict[int, QuadraticFactor]:
    """Factors by neighbour from messages; ones with a negative diagonal are left out."""
    out = {}
    for edge in edges:
        hessian = np.zeros((6, 6))
        hessian[_UPPER] = np.array(edge.hessian)
        hessian = hessian + np.triu(hessian, 1).T
        anchor = RelativeTransform(so3.exp(np.array(edge.rotation)), np.array(edge.centre))
        if (hessian.diagonal() >= 0.0).all():
            out[number_of(edge.neighbour)] = QuadraticFactor(
                anchor, hessian, np.array(edge.gradient), edge.count, edge.bearings, edge.chi2
            )
    return out
