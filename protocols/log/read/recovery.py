"""Recovers a complete log from a damaged one, one that was never closed, or the parts of one."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader

from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError, Refused
from protocols.core.files import completed_file
from protocols.log.layout import is_foxglove, schema_of
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter


@dataclass(frozen=True, slots=True)
class Recovery:
    """What was recovered and what was lost.

    messages: recovered ones, without those for viewers; duration_s: between the first and the last of them.
    missing: lost messages by key, from gaps in the sequence numbers; foreign: messages of channels that are not
    Syncline's, omitted. skipped_bytes: bytes in which no record was found. damage: "" if nothing was wrong.
    cut: the end is missing too, with what its writer had not synced.
    """

    path: str
    bytes: int
    parts: int
    messages: int
    duration_s: float
    missing: Mapping[str, int]
    foreign: int
    skipped_bytes: int
    damage: str
    cut: bool


class _MessageDigest:
    """Count and checksum over all messages in order, to verify the copy."""

    def __init__(self) -> None:
        self.count = 0
        self.crc = 0

    def add(self, key: str, log_time_ns: int, payload: bytes) -> None:
        self.count += 1
        self.crc = zlib.crc32(payload, zlib.crc32(f"{key} {log_time_ns}".encode(), self.crc))


def recover(path: Path, out: Path) -> Recovery:
    """Write the undamaged content of the log ``path`` to ``out`` and verify it; ``out`` is written atomically.

    path: a log, or the folder or the first of its parts, which become one file. Every message keeps its bytes,
    times and numbers. Raises InputError (no log, ``out`` exists, disk full) and Refused (no complete message).
    """
    reader = LogReader(path)
    try:
        with completed_file(out, new=True) as temporary:
            return _copy(reader, temporary, out)
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror or error}", file=out, remedy="choose another --out"
        ) from None


def _copy(reader: LogReader, temporary: Path, out: Path) -> Recovery:
    metadata = reader.metadata()
    schema = int(reader.format.get("schema", "1"))
    numbers: dict[tuple[Path, str], int] = {}
    missing: Counter[str] = Counter()
    written, times, messages, foreign = _MessageDigest(), [0, 0], 0, 0
    try:
        with LogWriter(temporary, metadata, schema=schema) as log:
            for attachment in reader.attachments():
                log.attach(attachment.name, attachment.media_type, attachment.data, attachment.log_time_ns)
            for part, key, raw in reader.raw():
                if schema_of(key) is None:
                    foreign += 1
                    continue
                log.copy(key, raw.payload, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
                written.add(key, raw.log_time_ns, raw.payload)
                if is_foxglove(key):
                    continue
                expected = numbers.get((part, key), -1) + 1
                # A smaller number than the last: a log that was joined of parts, each of which counts from 0.
                missing[key] += raw.sequence - expected if raw.sequence >= expected else raw.sequence
                numbers[part, key] = raw.sequence
                times = (
                    [min(times[0], raw.log_time_ns), max(times[1], raw.log_time_ns)]
                    if messages
                    else [raw.log_time_ns] * 2
                )
                messages += 1
    except InputError as error:
        raise InputError(error.what, file=out, remedy=error.remedy) from None
    if not messages and reader.damage:
        raise Refused(f"{reader.path}: no whole message in it: {reader.damage}")
    _verify(temporary, out, written)
    return Recovery(
        path=str(out),
        bytes=temporary.stat().st_size,
        parts=len(reader.paths),
        messages=messages,
        duration_s=(times[1] - times[0]) / NANOSECONDS,
        missing={key: count for key, count in missing.items() if count},
        foreign=foreign,
        skipped_bytes=reader.skipped_bytes,
        damage=reader.damage,
        cut=reader.cut,
    )


def _verify(file: Path, out: Path, written: _MessageDigest) -> None:
    """Read the result through its index with every checksum; InputError if it differs from what was written."""
    read = _MessageDigest()
    try:
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            for _, channel, message in reader.iter_messages(log_time_order=False):
                read.add(channel.topic, message.log_time, message.data)
    except (McapError, ValueError, RuntimeError, struct.error, zstandard.ZstdError) as error:
        raise InputError(
            f"reads back wrong ({error})", file=out, remedy="check the disk, choose another --out"
        ) from None
    counted = summary.statistics.message_count if summary and summary.statistics else -1
    if (read.count, read.crc, counted) != (written.count, written.crc, written.count):
        raise InputError(
            f"reads back wrong ({read.count} of {written.count} messages)",
            file=out,
            remedy="check the disk, choose another --out",
        )
