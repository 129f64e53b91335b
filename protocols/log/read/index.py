"""The summary index of an MCAP file, to start reading at a time without reading what is before."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel

from protocols.log.read.mcap_records import MAGIC, MALFORMED

_HEAD = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_CHUNK_INDEX = struct.Struct("<QQQ")
_MAX_SUMMARY = 64 * 1024 * 1024
"""Bytes: of some hundred thousand chunks. A file with more is read from its beginning."""


@dataclass(frozen=True, slots=True)
class Index:
    """chunks: (first and last log time [ns], offset) in file order; channels: keys by id."""

    chunks: tuple[tuple[int, int, int], ...]
    channels: dict[int, str]

    def offset_of(self, start_ns: int) -> int | None:
        """Offset of the first chunk with a message at or after a log time; None if there is none."""
        return next((offset for _, last, offset in self.chunks if last >= start_ns), None)


def read_index(stream: BinaryIO) -> Index | None:
    """The index of a closed file whose index checksum matches; otherwise None."""
    size = stream.seek(0, 2)
    tail = _FOOTER.size + len(MAGIC)
    if size < tail + len(MAGIC):
        return None
    stream.seek(size - tail)
    footer = stream.read(_FOOTER.size)
    opcode, _, start, _, crc = _FOOTER.unpack(footer)
    if opcode != Opcode.FOOTER or stream.read(len(MAGIC)) != MAGIC or not 0 < start < size - tail or not crc:
        return None
    if size - tail - start > _MAX_SUMMARY:
        return None
    stream.seek(start)
    summary = stream.read(size - tail - start)
    if zlib.crc32(footer[:-4], zlib.crc32(summary)) != crc:
        return None
    chunks: list[tuple[int, int, int]] = []
    channels: dict[int, str] = {}
    offset = 0
    try:
        while offset < len(summary):
            opcode, length = _HEAD.unpack_from(summary, offset)
            offset += _HEAD.size
            if opcode == Opcode.CHUNK_INDEX:
                first, last, place = _CHUNK_INDEX.unpack(summary[offset : offset + min(length, _CHUNK_INDEX.size)])
                if not len(MAGIC) <= place < start:
                    return None
                chunks.append((first, last, place))
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(summary[offset : offset + length])))
                channels[channel.id] = channel.topic
            offset += length
    except MALFORMED:
        return None
    return Index(tuple(chunks), channels)
