"""The frames of an MCAP file in file order, as far as they are whole.

The library's readers stop at the first flaw with an exception that names something else, pass over a
cut-off record, and do not check attachments. Here each record is taken whole or not at all, and a
flaw is a sentence for a person.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream

from protocols.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK = 256 * 1024 * 1024
"""Bytes, unpacked. More is no chunk that anybody wrote."""

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_FIRST_PRIVATE_OPCODE = 0x80


class Frame(NamedTuple):
    """One record: where it begins, its kind, its bytes."""

    offset: int
    opcode: int
    content: bytes


class RawMessage(NamedTuple):
    """One message record, not yet decoded."""

    channel: int
    log_time_ns: int
    payload: bytes


@dataclass(slots=True)
class Damage:
    """What is wrong with a file: the first flaw as a sentence, and how many there were."""

    text: str = ""
    flaws: int = 0

    def found(self, text: str) -> None:
        """Take note of a flaw."""
        self.text = self.text or text
        self.flaws += 1


def open_log(path: Path) -> BinaryIO:
    """Open an MCAP file and read its magic; InputError if it is none."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise InputError(
            f"cannot read: {error.strerror or error}", file=path, remedy="check the name of the log"
        ) from None
    try:
        magic = stream.read(len(MAGIC))
    except OSError as error:
        stream.close()
        raise InputError(f"cannot read: {error.strerror or error}", file=path) from None
    if magic != MAGIC:
        stream.close()
        what = "is empty" if not magic else "is not an MCAP log"
        raise InputError(what, file=path, remedy="give a .mcap file that syncline recorded")
    return stream


def frames(stream: BinaryIO, damage: Damage) -> Iterator[Frame]:
    """Every whole record after the magic, up to the footer; flaws go to ``damage``.

    The checksum of the data section is verified where the file has one.
    """
    size = stream.seek(0, 2)
    offset = stream.seek(len(MAGIC))
    crc = zlib.crc32(MAGIC)
    while True:
        head = stream.read(_HEAD.size)
        if len(head) < _HEAD.size:
            where = "" if not head else " in the middle of a record"
            damage.found(f"ends at byte {offset}{where}, without a footer: its writer did not close it")
            return
        opcode, length = _HEAD.unpack(head)
        if opcode not in _KNOWN and opcode < _FIRST_PRIVATE_OPCODE:
            damage.found(f"byte {offset} begins no record: the rest cannot be read")
            return
        if length > size - offset - _HEAD.size:
            damage.found(f"the record at byte {offset} is cut off: its writer did not close the file")
            return
        content = stream.read(length)
        if opcode == Opcode.DATA_END and length >= 4:
            (expected,) = struct.unpack_from("<I", content)
            if expected not in (0, crc):
                damage.found("the checksum of the data does not match: some bytes have changed")
        crc = zlib.crc32(content, zlib.crc32(head, crc))
        yield Frame(offset, opcode, content)
        if opcode == Opcode.FOOTER:
            if stream.read(len(MAGIC)) != MAGIC:
                damage.found("the end mark is missing")
            return
        offset += _HEAD.size + length


def chunk_records(frame: Frame, damage: Damage) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of the records in a chunk; none if its checksum does not match."""
    try:
        chunk: Chunk = Chunk.read(ReadDataStream(BytesIO(frame.content)))
        if chunk.uncompressed_size > MAX_CHUNK:
            raise ValueError("too big")
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(size)
    except (McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError):
        damage.found(f"the chunk at byte {frame.offset} is damaged and was left out")
        return
    offset = 0
    while offset + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, offset)
        offset += _HEAD.size
        if length > len(data) - offset:
            damage.found(f"the chunk at byte {frame.offset} has a record that is cut off")
            return
        yield opcode, data[offset : offset + length]
        offset += length


def message_record(content: bytes) -> RawMessage | None:
    """Parse a message record; None if it is too short to be one."""
    if len(content) < _MESSAGE.size:
        return None
    channel, _sequence, log_time_ns, _publish_time_ns = _MESSAGE.unpack_from(content)
    return RawMessage(channel, log_time_ns, content[_MESSAGE.size :])


def attachment_is_whole(frame: Frame) -> bool:
    """Whether an attachment's own checksum matches (0: it has none)."""
    if len(frame.content) < 4:
        return False
    (expected,) = struct.unpack_from("<I", frame.content, len(frame.content) - 4)
    return expected in (0, zlib.crc32(frame.content[:-4]))
