"""Which schema a channel of ours has, told from its name alone."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message

from protocols.validation.codec import message_class, parse_key

VIEW_PREFIX = "foxglove/"
"""Channels below it repeat what ours say in schemas that viewers know; readers of ours pass over them."""
VIEW_KINDS = {
    "calibration": "CameraCalibration",
    "transforms": "FrameTransforms",
    "scene": "SceneUpdate",
    "annotations": "ImageAnnotations",
    "expected": "ImageAnnotations",
    "image": "CompressedImage",
    "points": "PointCloud",
}


class ChannelSchema(NamedTuple):
    """A protobuf schema as MCAP wants it: full name, and a serialised FileDescriptorSet."""

    name: str
    data: bytes


def is_view(key: str) -> bool:
    """Whether a channel only repeats others for viewers."""
    return key.startswith(VIEW_PREFIX)


def schema_of(key: str) -> ChannelSchema | None:
    """The schema of a channel of ours; None for other channels."""
    if is_view(key):
        kind = VIEW_KINDS.get(key.rpartition("/")[2])
        return None if kind is None else _schema(view_class(kind).DESCRIPTOR)
    address = parse_key(key)
    return None if address is None else _schema(message_class(address.topic).DESCRIPTOR)


@cache
def view_class(kind: str) -> type[Message]:
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
    """Every file after those that it needs, as readers add them one by one."""
    if file.name in seen:
        return
    seen.add(file.name)
    for needed in file.dependencies:
        _add(needed, files, seen)
    file.CopyToProto(files.file.add())
