"""Converts messages to Foxglove's well-known schemas, so that viewers show a log without configuration.

Lengths are converted to metres, as viewers expect; frames are "world" and the cameras' names; time stamps are the
recorder's clock, the only one that all cameras of a log share.

Thumbnails are smaller than the images to whose pixels observations refer. Viewers use one pixel frame for image, lens
and annotations of a camera, so from the first thumbnail on all three are converted to the thumbnail's pixels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose as FoxglovePose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from protocols.core.clocks import NANOSECONDS
from protocols.core.jpeg import ThumbnailScale, thumbnail_scale
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.log.layout import FOXGLOVE_PREFIX
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import METRES_PER_UNIT

WORLD = "world"
_MARKER_DIAMETER_M = 0.05
"""Diameter of a tracked point in a viewer [m]; with arbitrary scale, in baselines."""
_SMALLEST_CIRCLE_PX = 6.0  # diameter that is still seen in a viewer
_ORANGE = Color(r=1.0, g=0.55, b=0.0, a=1.0)
_POINT_FIELDS = [
    PackedElementField(name=name, offset=4 * place, type=PackedElementField.FLOAT32) for place, name in enumerate("xyz")
]
_MAX_POINTS = 1024
"""Of a cloud, the newest: who invents labels would have every message written with all of them."""
_TRACK_LIFETIME_S = 2
"""A track without further messages disappears from the scene after this time."""


_FLIGHT_IMAGE_PERIOD_NS = NANOSECONDS // 2
"""Images of a flight are large and come at 30 Hz: viewers get two per second."""
_STATE_COLOURS = {"visible": Color(r=0.3, g=0.85, b=0.3, a=1.0), "coasting": _ORANGE}


class FoxgloveMessage(NamedTuple):
    """One message for viewers and its channel."""

    key: str
    message: Message


class FoxgloveConverter:
    """Converts the messages of one log; keeps the rig's unit and the images' sizes between messages."""

    def __init__(self) -> None:
        self._metres = 1.0
        self._sizes: dict[str, tuple[int, int]] = {}
        self._own_lens: set[str] = set()
        self._scales: dict[str, ThumbnailScale] = {}
        self._last_flight_ns: dict[str, int] = {}
        self._points: dict[str, dict[str, tuple[int, Floats]]] = {}  # of a site, by label: log time, position [m]

    def of(self, site: str, message: Message, log_time_ns: int) -> list[FoxgloveMessage]:
        """The messages for viewers of one validated message; log_time_ns: Unix, ns."""
        stamp = Timestamp(seconds=log_time_ns // NANOSECONDS, nanos=log_time_ns % NANOSECONDS)
        where = f"{FOXGLOVE_PREFIX}{site}"
        if isinstance(message, pb.Observation):
            scale = self._scales.get(message.camera)
            return [FoxgloveMessage(f"{where}/{message.camera}/annotations", _annotations(message, stamp, scale))]
        if isinstance(message, pb.Picture):
            return self._picture(where, message, stamp)
        if isinstance(message, pb.CameraInfo):
            size = message.width, message.height
            if self._sizes.get(message.camera, size) != size:
                self._scales.pop(message.camera, None)  # that of its former images
            self._sizes[message.camera] = size
            if not message.matrix:
                return []
            self._own_lens.add(message.camera)
            return [self._lens(where, message.camera, message, stamp)]
        if isinstance(message, pb.RigInfo):
            self._metres = METRES_PER_UNIT.get(message.units, 1.0)
        elif isinstance(message, pb.Calibration) and message.cameras:
            self._metres = METRES_PER_UNIT.get(message.units, 1.0) if message.scale == "metric" else 1.0
            return self._calibration(where, message, stamp)
        elif isinstance(message, pb.Track):
            # rerun's loader supports point clouds, but not scenes.
            points = self._cloud(site, message, stamp, log_time_ns)
            return [
                FoxgloveMessage(f"{where}/scene", self._scene(message, stamp)),
                FoxgloveMessage(f"{where}/points", points),
            ]
        elif isinstance(message, pb.Prediction):
            return [
                FoxgloveMessage(
                    f"{where}/{part.camera}/expected", _expected(part, stamp, self._scales.get(part.camera))
                )
                for part in message.cameras
            ]
        elif isinstance(message, pb.FlightImage):
            return self._flight(where, message, stamp, log_time_ns)
        elif isinstance(message, pb.UavInfo) and message.matrix:
            self._sizes[message.agent] = (message.width, message.height)
            return [self._lens(where, message.agent, message, stamp)]
        elif isinstance(message, pb.TargetState):
            return [FoxgloveMessage(f"{where}/{message.agent}/annotations", _target(message, stamp))]
        return []

    def _picture(self, where: str, picture: pb.Picture, stamp: Timestamp) -> list[FoxgloveMessage]:
        scale = thumbnail_scale(picture)
        if scale is None:
            return []  # viewers cannot decode it
        self._sizes.setdefault(picture.camera, (picture.width, picture.height))
        self._scales[picture.camera] = scale
        image = CompressedImage(timestamp=stamp, frame_id=picture.camera, data=picture.jpeg, format="jpeg")
        return [FoxgloveMessage(f"{where}/{picture.camera}/image", image)]

    def _flight(self, where: str, flight: pb.FlightImage, stamp: Timestamp, log_time_ns: int) -> list[FoxgloveMessage]:
        last = self._last_flight_ns.get(flight.agent)
        if not flight.jpeg or (last is not None and 0 <= log_time_ns - last < _FLIGHT_IMAGE_PERIOD_NS):
            return []
        self._last_flight_ns[flight.agent] = log_time_ns
        image = CompressedImage(timestamp=stamp, frame_id=flight.agent, data=flight.jpeg, format="jpeg")
        return [FoxgloveMessage(f"{where}/{flight.agent}/image", image)]

    def _lens(self, where: str, camera: str, lens: Any, stamp: Timestamp) -> FoxgloveMessage:
        matrix, scale = np.array(lens.matrix).reshape(3, 3), self._scales.get(camera)
        if scale is None:
            unknown = (round(2 * matrix[0, 2] + 1), round(2 * matrix[1, 2] + 1))
            width, height = self._sizes.get(camera, unknown)
        else:
            matrix, width, height = scale.matrix() @ matrix, scale.width, scale.height
        message = CameraCalibration(
            timestamp=stamp,
            frame_id=camera,
            width=width,
            height=height,
            distortion_model="kannala_brandt" if lens.fisheye else "plumb_bob",
            D=lens.distortions,
            K=matrix.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
        )
        return FoxgloveMessage(f"{where}/{camera}/calibration", message)

    def _calibration(self, where: str, message: pb.Calibration, stamp: Timestamp) -> list[FoxgloveMessage]:
        transforms = FrameTransforms()
        views = [FoxgloveMessage(f"{where}/transforms", transforms)]
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

    def _cloud(self, site: str, track: pb.Track, stamp: Timestamp, now_ns: int) -> PointCloud:
        """All points of a site that were updated within _TRACK_LIFETIME_S."""
        points = self._points.setdefault(site, {})
        points.pop(track.label, None)
        if track.state != "lost" and len(track.position) == 3:
            points[track.label] = (now_ns, self._metres * np.array(track.position))
        for label in [label for label, (at, _) in points.items() if abs(now_ns - at) > _TRACK_LIFETIME_S * NANOSECONDS]:
            del points[label]
        if len(points) > _MAX_POINTS:
            del points[next(iter(points))]
        places = np.array([place for _, place in points.values()], dtype="<f4")
        return PointCloud(
            timestamp=stamp,
            frame_id=WORLD,
            pose=FoxglovePose(position=Vector3(), orientation=Quaternion(w=1.0)),
            point_stride=12,
            fields=_POINT_FIELDS,
            data=places.tobytes(),
        )

    def _scene(self, track: pb.Track, stamp: Timestamp) -> SceneUpdate:
        if track.state == "lost" or len(track.position) != 3:
            gone = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.MATCHING_ID, id=track.label)
            return SceneUpdate(deletions=[gone])
        x, y, z = (value * self._metres for value in track.position)
        solid = track.state == "confirmed"
        paint = track.colour
        rgb = (paint.red / 255, paint.green / 255, paint.blue / 255) if track.HasField("colour") else (1.0, 0.55, 0.0)
        sphere = SpherePrimitive(
            pose=FoxglovePose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0)),
            size=Vector3(x=_MARKER_DIAMETER_M, y=_MARKER_DIAMETER_M, z=_MARKER_DIAMETER_M),
            color=Color(r=rgb[0], g=rgb[1], b=rgb[2], a=1.0 if solid else 0.4),
        )
        entity = SceneEntity(timestamp=stamp, frame_id=WORLD, id=track.label, spheres=[sphere])
        entity.lifetime.seconds = _TRACK_LIFETIME_S
        return SceneUpdate(entities=[entity])


def _annotations(observation: pb.Observation, stamp: Timestamp, scale: ThumbnailScale | None) -> ImageAnnotations:
    """The detections as circles with their labels, in the distorted image as they were detected."""
    annotations = ImageAnnotations()
    for detection in observation.detections:
        u, v, size = detection.u, detection.v, detection.size
        if scale is not None:
            (u, v), size = scale.place(u, v), size * scale.scale_x
        circle = annotations.circles.add()  # built in place: a copy takes twice as long
        circle.timestamp.CopyFrom(stamp)
        circle.position.x, circle.position.y = u, v
        circle.diameter = max(size, _SMALLEST_CIRCLE_PX)
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


def _expected(part: pb.CameraPrediction, stamp: Timestamp, scale: ThumbnailScale | None) -> ImageAnnotations:
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
                x_there, y_there = corner if scale is None else scale.place(*corner)
                box.points.add(x=x_there, y=y_there)
            box.outline_color.CopyFrom(_ORANGE)
            box.thickness = 1.0
        text = annotations.texts.add()
        text.timestamp.CopyFrom(stamp)
        text.position.x, text.position.y = (u, v) if scale is None else scale.place(u, v)
        text.text = f"{target.target} {target.view}".strip()
        text.font_size = 12.0
        text.text_color.CopyFrom(_ORANGE)
    return annotations


def _target(target: pb.TargetState, stamp: Timestamp) -> ImageAnnotations:
    """The followed car: its box, a circle of two stds, and its state; also outside the image."""
    annotations = ImageAnnotations()
    if len(target.centre) != 2:
        return annotations
    colour = _STATE_COLOURS.get(target.state, _ORANGE)
    x, y = target.centre
    circle = annotations.circles.add(diameter=4.0 * target.std_px, thickness=2.0, outline_color=colour)
    circle.timestamp.CopyFrom(stamp)
    circle.position.x, circle.position.y = x, y
    if len(target.size) == 2:
        half_width, half_height = 0.5 * target.size[0], 0.5 * target.size[1]
        box = annotations.points.add(type=PointsAnnotation.LINE_LOOP, outline_color=colour, thickness=2.0)
        box.timestamp.CopyFrom(stamp)
        for right, scale_y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            box.points.add(x=x + right * half_width, y=y + scale_y * half_height)
    text = annotations.texts.add(text=target.state, font_size=12.0, text_color=colour)
    text.timestamp.CopyFrom(stamp)
    text.position.x, text.position.y = x, y
    return annotations


def quaternion(rotation: Floats) -> Quaternion:
    """The unit quaternion, w >= 0, of a 3x3 rotation matrix."""
    w, x, y, z = so3.quaternion(rotation).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
