"""The layout of a log that writer and readers share: version, metadata records, names of its parts."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path

LOG_VERSION = 1
"""Version of the log layout; raised for changes that an old reader cannot handle."""
FORMAT_RECORD = "syncline.format"
CHANNEL_RECORD = "syncline.channel"


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
