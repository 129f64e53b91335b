"""The layout of a log that writer and readers share: version, metadata records, names of its parts.

Migration of logs of earlier schema versions: one declared function from each version to the next.

A small log of each released version is kept in tests/replay/logs, and a test reads it. When SCHEMA_VERSION is raised,
UPGRADES gets a function under the old number.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

from protocols.core.errors import InputError
from protocols.topics import Topic
from protocols.validation.rules import SCHEMA_VERSION

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
