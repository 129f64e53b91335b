"""Our messages once more in Foxglove's well-known schemas, so that viewers show a log with no set-up.

Lengths become metres as viewers expect them; frames are "world" and the cameras' names; time stamps are the
recorder's clock, the only one that all cameras of a log share.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose as ViewPose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from protocols.clocks import NANOSECONDS
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.log.schemas import VIEW_PREFIX
from protocols.messages import syncline_pb2 as pb

WORLD = "world"
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_MARK_M = 0.05
"""Diameter of a tracked point in a viewer [m]; with arbitrary scale, in baselines."""
_SMALLEST_CIRCLE_PX = 6.0
_ORANGE = Color(r=1.0, g=0.55, b=0.0, a=1.0)
_FADE_S = 2
"""A track of which nothing more is heard goes out of the picture after it."""


class View(NamedTuple):
    """One message for viewers and the channel it goes to."""

    key: str
    message: Message


class Views:
    """Makes the views of one log; remembers the rig's unit and the images' sizes between messages."""

    def __init__(self) -> None:
        self._metres = 1.0
        self._sizes: dict[str, tuple[int, int]] = {}
        self._own_lens: set[str] = set()

    def of(self, site: str, message: Message, log_time_ns: int) -> list[View]:
        """What a viewer shall see of one message that passed the gate; log_time_ns: Unix, ns."""
        stamp = Timestamp(seconds=log_time_ns // NANOSECONDS, nanos=log_time_ns % NANOSECONDS)
        where = f"{VIEW_PREFIX}{site}"
        if isinstance(message, pb.Observation):
            return [View(f"{where}/{message.camera}/annotations", _annotations(message, stamp))]
        if isinstance(message, pb.CameraInfo):
            self._sizes[message.camera] = (message.width, message.height)
            if not message.matrix:
                return []
            self._own_lens.add(message.camera)
            return [self._lens(where, message.camera, message, stamp)]
        if isinstance(message, pb.RigInfo):
            self._metres = _METRES.get(message.units, 1.0)
        elif isinstance(message, pb.Calibration) and message.cameras:
            self._metres = _METRES.get(message.units, 1.0) if message.scale == "metric" else 1.0
            return self._calibration(where, message, stamp)
        elif isinstance(message, pb.Track):
            return [View(f"{where}/scene", self._scene(message, stamp))]
        elif isinstance(message, pb.Prediction):
            return [View(f"{where}/{part.camera}/expected", _expected(part, stamp)) for part in message.cameras]
        return []

    def _lens(self, where: str, camera: str, lens: Any, stamp: Timestamp) -> View:
        fx, _, cx, _, fy, cy = lens.matrix[:6]
        width, height = self._sizes.get(camera, (round(2 * cx + 1), round(2 * cy + 1)))
        message = CameraCalibration(
            timestamp=stamp,
            frame_id=camera,
            width=width,
            height=height,
            distortion_model="kannala_brandt" if lens.fisheye else "plumb_bob",
            D=lens.distortions,
            K=lens.matrix,
            R=np.eye(3).ravel().tolist(),
            P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        )
        return View(f"{where}/{camera}/calibration", message)

    def _calibration(self, where: str, message: pb.Calibration, stamp: Timestamp) -> list[View]:
        transforms = FrameTransforms()
        views = [View(f"{where}/transforms", transforms)]
        for camera in message.cameras:
            pose = Pose.from_rodrigues(np.array(camera.rotation), np.array(camera.translation))
            x, y, z = (float(value) * self._metres for value in pose.position)
            # Foxglove's transform is the child's pose in its parent, the inverse of our camera from world.
            transforms.transforms.append(
                FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=WORLD,
                    child_frame_id=camera.camera,
                    translation=Vector3(x=x, y=y, z=z),
                    rotation=quaternion(pose.rotation.T),
                )
            )
            if camera.matrix and camera.camera not in self._own_lens:
                views.append(self._lens(where, camera.camera, camera, stamp))
        return views

    def _scene(self, track: pb.Track, stamp: Timestamp) -> SceneUpdate:
        if track.state == "lost" or len(track.position) != 3:
            gone = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.MATCHING_ID, id=track.label)
            return SceneUpdate(deletions=[gone])
        x, y, z = (value * self._metres for value in track.position)
        solid = track.state == "confirmed"
        paint = track.colour
        rgb = (paint.red / 255, paint.green / 255, paint.blue / 255) if track.HasField("colour") else (1.0, 0.55, 0.0)
        sphere = SpherePrimitive(
            pose=ViewPose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0)),
            size=Vector3(x=_MARK_M, y=_MARK_M, z=_MARK_M),
            color=Color(r=rgb[0], g=rgb[1], b=rgb[2], a=1.0 if solid else 0.4),
        )
        entity = SceneEntity(timestamp=stamp, frame_id=WORLD, id=track.label, spheres=[sphere])
        entity.lifetime.seconds = _FADE_S
        return SceneUpdate(entities=[entity])


def _annotations(observation: pb.Observation, stamp: Timestamp) -> ImageAnnotations:
    """The detections as circles with their labels, in the distorted image as they were detected."""
    annotations = ImageAnnotations()
    for detection in observation.detections:
        u, v = detection.u, detection.v
        circle = annotations.circles.add()  # in place: built apart and copied it takes twice as long
        circle.timestamp.CopyFrom(stamp)
        circle.position.x, circle.position.y = u, v
        circle.diameter = max(detection.size, _SMALLEST_CIRCLE_PX)
        circle.thickness = 2.0
        circle.outline_color.CopyFrom(_ORANGE)
        if detection.label:
            text = annotations.texts.add()
            text.timestamp.CopyFrom(stamp)
            text.position.x, text.position.y = u, v
            text.text = detection.label
            text.font_size = 12.0
            text.text_color.CopyFrom(_ORANGE)
    return annotations


def _expected(part: pb.CameraPrediction, stamp: Timestamp) -> ImageAnnotations:
    """Where targets are expected in one image: the region of head and face, and the name."""
    annotations = ImageAnnotations()
    for target in part.targets:
        u, v = target.u, target.v
        if len(target.face) == 4:
            x, y, width, height = target.face
            u, v = x, y
            box = annotations.points.add()
            box.timestamp.CopyFrom(stamp)
            box.type = PointsAnnotation.LINE_LOOP
            for corner in ((x, y), (x + width, y), (x + width, y + height), (x, y + height)):
                box.points.add(x=corner[0], y=corner[1])
            box.outline_color.CopyFrom(_ORANGE)
            box.thickness = 1.0
        text = annotations.texts.add()
        text.timestamp.CopyFrom(stamp)
        text.position.x, text.position.y = u, v
        text.text = f"{target.target} {target.view}".strip()
        text.font_size = 12.0
        text.text_color.CopyFrom(_ORANGE)
    return annotations


def quaternion(rotation: Floats) -> Quaternion:
    """The unit quaternion, w >= 0, of a 3x3 rotation matrix (Shepperd's method: divides by the largest part)."""
    m = rotation
    four = np.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    q = four[int(np.argmax(np.diag(four)))]
    q = q / np.linalg.norm(q)
    w, x, y, z = (float(value) for value in (q if q[0] >= 0.0 else -q))
    return Quaternion(x=x, y=y, z=z, w=w)
