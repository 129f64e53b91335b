"""The layout of a log that writer and readers share: version, metadata records, names of its parts, channels' schemas.

Migration of logs of earlier schema versions: one declared function from each version to the next.

A small log of each released version is kept in tests/replay/logs, and a test reads it. When SCHEMA_VERSION is raised,
UPGRADES gets a function under the old number.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message

from protocols.core.errors import InputError
from protocols.topics import Topic
from protocols.validation.codec import message_class, parse_key
from protocols.validation.rules import SCHEMA_VERSION

LOG_VERSION = 1
"""Version of the log layout; raised for changes that an old reader cannot handle."""
FORMAT_RECORD = "syncline.format"
CHANNEL_RECORD = "syncline.channel"
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


def channel_record(channel: int, key: str) -> dict[str, str]:
    """The metadata record of a channel, a copy outside its chunk."""
    return with_checksum({"id": str(channel), "key": key})


def with_checksum(values: Mapping[str, str]) -> dict[str, str]:
    """Metadata with a checksum, which MCAP does not provide; idempotent."""
    plain = {name: value for name, value in values.items() if name != "crc"}
    return {**plain, "crc": str(zlib.crc32(repr(sorted(plain.items())).encode()))}


def part_path(path: Path, number: int) -> Path:
    """The name of one part of the log ``path``."""
    return path.with_name(f"{path.stem}-{number:03d}{path.suffix}")


Upgrade = Callable[[Topic, bytes], bytes]
"""Converts a payload of one version to the next, including its schema_version."""

UPGRADES: Mapping[int, Upgrade] = {}
"""By the version that they start from."""


def upgrades_for(path: Path, form: Mapping[str, str]) -> tuple[Upgrade, ...]:
    """The upgrades from this log's schema to the current one, in order. form: the log's format record.

    Raises InputError for a log of a newer Syncline, which cannot be read.
    """
    schema, layout = _number(form.get("schema")), _number(form.get("log"))
    if schema > SCHEMA_VERSION or layout > LOG_VERSION:
        raise InputError(
            f"was written by Syncline {form.get('syncline', '?')} (log {layout}, schema {schema}); this one reads "
            f"up to log {LOG_VERSION}, schema {SCHEMA_VERSION}",
            file=path,
            remedy="update Syncline",
        )
    return tuple(UPGRADES[version] for version in range(schema, SCHEMA_VERSION))


def _number(text: str | None) -> int:
    # Logs before this record existed are of version 1; a garbled figure is damage, which the messages themselves show.
    return int(text) if text is not None and text.isdecimal() and text.isascii() and int(text) >= 1 else 1


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
