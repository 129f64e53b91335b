"""The protobuf schema of each log channel, by the channel's name."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message

from protocols.validation.codec import message_class, parse_key

FOXGLOVE_PREFIX = "foxglove/"
"""Prefix of channels that repeat messages in Foxglove's schemas for viewers; this project's readers skip them."""
FOXGLOVE_SCHEMAS = {
    "calibration": "CameraCalibration",
    "transforms": "FrameTransforms",
    "scene": "SceneUpdate",
    "annotations": "ImageAnnotations",
    "expected": "ImageAnnotations",
    "image": "CompressedImage",
    "points": "PointCloud",
}


class ChannelSchema(NamedTuple):
    """A protobuf schema in MCAP's form: full name, and a serialised FileDescriptorSet."""

    name: str
    data: bytes


def is_foxglove(key: str) -> bool:
    """Whether a channel only repeats other channels for viewers."""
    return key.startswith(FOXGLOVE_PREFIX)


def schema_of(key: str) -> ChannelSchema | None:
    """The schema of a known channel; None for foreign channels."""
    if is_foxglove(key):
        kind = FOXGLOVE_SCHEMAS.get(key.rpartition("/")[2])
        return None if kind is None else _schema(foxglove_class(kind).DESCRIPTOR)
    address = parse_key(key)
    return None if address is None else _schema(message_class(address.topic).DESCRIPTOR)


@cache
def foxglove_class(kind: str) -> type[Message]:
    """The class of one of Foxglove's schemas, imported when first asked for."""
    from importlib import import_module

    found: type[Message] = getattr(import_module(f"foxglove_schemas_protobuf.{kind}_pb2"), kind)
    return found


@cache
def _schema(descriptor: Descriptor) -> ChannelSchema:
    files = FileDescriptorSet()
    _add(descriptor.file, files, set())
    return ChannelSchema(descriptor.full_name, files.SerializeToString(deterministic=True))


def _add(file: FileDescriptor, files: FileDescriptorSet, seen: set[str]) -> None:
    """Add a file after its dependencies, as readers add them in order."""
    if file.name in seen:
        return
    seen.add(file.name)
    for needed in file.dependencies:
        _add(needed, files, seen)
    file.CopyToProto(files.file.add())
