"""Damage-tolerant reading of the records of an MCAP file in file order.

The library's readers stop at the first error with a misleading exception, ignore a truncated record, and do not check
attachments. Here each record is read completely or not at all, and every error is described in a sentence.

Time is linear in the file, and memory is bounded, whatever the file says of itself: a record is read only once its
length is confirmed by what it leads to or by a few of its bytes, and a chunk is unpacked no further than it says.

A file that was closed has a summary index, by which reading starts at a time without what is before.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk

from protocols.core.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
MALFORMED = (McapError, ValueError, OverflowError, struct.error)
"""What the library raises for records that are cut off or say what cannot be; lengths of 2⁶⁴ overflow its reads."""
MAX_CHUNK = 64 * 1024 * 1024
"""Bytes, uncompressed. Writers make chunks of 60 kB (this one) to some megabytes."""
_MAX_RATIO, _MIN_UNPACKED = 256, 1 << 16
"""Uncompressed bytes for one of a chunk, where it has more than these: telemetry that repeats itself has up to 50."""
_MAX_CONTENT = MAX_CHUNK + (1 << 20)
"""Bytes of a record that is read into memory; a longer one is left out."""

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
"""Start time, end time, unpacked size, checksum, length of the compression's name; then that name, u64 size, data."""
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_FIRST_PRIVATE_OPCODE = 0x80  # MCAP leaves these to applications
_MAX_RECORD = 1 << 40
"""Bytes. A longer record is a damaged length."""
_MIN_ATTACHMENT = 36  # bytes: of one with empty texts and no data
_FOOTER_LENGTH = 20  # bytes: two offsets and a checksum
_FIRST_WINDOW, _MAX_WINDOW = 1 << 8, 1 << 20
"""Bytes that are searched at once for the next record: more as the search goes on, so that it costs what it passes."""
# Chunk, attachment, metadata, message index, end of data or footer, shorter than 4 GiB: a prefilter for headers.
_CANDIDATE = re.compile(rb"(?=[\x06\x09\x0c\x07\x0f\x02][\x00-\xff]{4}\x00{4})")

_FOOTER = struct.Struct("<BQQQI")
_CHUNK_INDEX = struct.Struct("<QQQ")
_MAX_SUMMARY = 64 * 1024 * 1024
"""Bytes: of some hundred thousand chunks. A file with more is read from its beginning."""


class McapRecord(NamedTuple):
    """One MCAP record: offset, opcode, content."""

    offset: int
    opcode: int
    content: bytes


class RawMessage(NamedTuple):
    """One message record, not yet decoded."""

    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


@dataclass(slots=True)
class Damage:
    """Damage of a file: description of the first error, number of errors, bytes skipped."""

    text: str = ""
    flaws: int = 0
    skipped: int = 0
    cut: bool = False
    """Whether a file is truncated."""
    place: str = ""
    """The file, where there are several."""

    def record(self, text: str) -> None:
        """Record one error."""
        self.text = self.text or f"{self.place}{text}"
        self.flaws += 1


def open_log(path: Path) -> BinaryIO:
    """Open an MCAP file and check its magic; raises InputError."""
    try:
        if path.exists() and not path.is_file():
            raise InputError("is not a regular file", file=path, remedy="give a .mcap file that syncline recorded")
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


def read_records(stream: BinaryIO, damage: Damage, begin: int = len(MAGIC)) -> Iterator[McapRecord]:
    """Every complete record from ``begin`` (default: after the magic) up to the footer; errors go to ``damage``.

    After an error reading resumes at the next self-consistent record. The checksum of the data section is
    verified where the file has one.
    """
    size = stream.seek(0, 2)
    offset = stream.seek(begin)
    head = stream.read(_HEAD.size)
    crc = zlib.crc32(MAGIC)
    unbroken = begin == len(MAGIC)
    while True:
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        end = offset + _HEAD.size + length
        whole = _is_head(opcode, length) and end <= size
        following = b""
        if whole:
            stream.seek(end)
            following = stream.read(_HEAD.size)
            # A length that does not lead to another record is wrong, unless the content confirms it.
            inside = partial(_read_at, stream)
            whole = _is_next(following) or _is_self_consistent(inside, offset + _HEAD.size, opcode, length)
        if not whole:
            found = resync(stream, offset + 1, size) if offset < size else None
            damage.record(_flaw(offset, head, opcode, length, found))
            if found is None:
                damage.cut = True
                return
            damage.skipped += found - offset
            offset, unbroken = stream.seek(found), False
            head = stream.read(_HEAD.size)
            continue
        stream.seek(offset + _HEAD.size)
        if length > _MAX_CONTENT:
            damage.record(f"the record at byte {offset} has {length} bytes, at most {_MAX_CONTENT} are read")
            unbroken, offset, head = False, end, following
            stream.seek(end + len(following))
            continue
        content = stream.read(length)
        stream.seek(end + len(following))
        if opcode == Opcode.DATA_END and length >= 4:
            (expected,) = struct.unpack_from("<I", content)
            if unbroken and expected not in (0, crc):
                damage.record("the checksum of the data does not match: some bytes have changed")
        if opcode == Opcode.FOOTER and length == _FOOTER_LENGTH:
            (expected,) = struct.unpack_from("<I", content, length - 4)
            if unbroken and expected not in (0, zlib.crc32(head + content[:-4], crc)):
                damage.record("the checksum of the index does not match: some bytes have changed")
        crc = 0 if opcode == Opcode.DATA_END else zlib.crc32(content, zlib.crc32(head, crc))
        yield McapRecord(offset, opcode, content)
        if opcode == Opcode.FOOTER:
            if following[: len(MAGIC)] != MAGIC:
                damage.record("the end mark is missing")
            return
        offset, head = end, following


def _flaw(offset: int, head: bytes, opcode: int, length: int, found: int | None) -> str:
    """Description of the error at ``offset``; found: where reading resumes."""
    if found is not None:
        return f"{found - offset} bytes from byte {offset} on are damaged and were left out"
    if len(head) < _HEAD.size:
        where = "" if not head else " in the middle of a record"
        return f"ends at byte {offset}{where}, without a footer: its writer did not close it"
    if _is_head(opcode, length):
        return f"the record at byte {offset} is cut off: its writer did not close the file"
    return f"byte {offset} begins no record, nor does any after it: the rest cannot be read"


def _is_head(opcode: int, length: int) -> bool:
    return (opcode in _KNOWN or opcode >= _FIRST_PRIVATE_OPCODE) and length < _MAX_RECORD


def _is_next(head: bytes) -> bool:
    """Whether these bytes begin a record, or are the end of the file."""
    return len(head) < _HEAD.size or _is_head(*_HEAD.unpack(head))


def _read_at(stream: BinaryIO, offset: int, size: int) -> bytes:
    stream.seek(offset)
    return stream.read(size)


def _is_self_consistent(read: Callable[[int, int], bytes], start: int, opcode: int, length: int) -> bool:
    """Whether the lengths inside a record at ``start`` add up to its own: false positives are practically excluded.

    read: gives the bytes at an offset. Reads a few only: a file may consist of nothing but false headers.
    """

    def number(at: int, size: int) -> int:
        return int.from_bytes(read(start + at, size), "little") if at + size <= length else length + 1

    if opcode == Opcode.CHUNK:
        name = number(_CHUNK.size - 4, 4)
        return name <= 4 and number(_CHUNK.size + name, 8) == length - _CHUNK.size - name - 8
    if opcode == Opcode.ATTACHMENT:  # two times, name, media type, u64 size, data, checksum
        media = 16 + 4 + number(16, 4)
        data = media + 4 + number(media, 4)
        return length > _MIN_ATTACHMENT and number(data, 8) == length - data - 12
    if opcode == Opcode.METADATA:  # name, map
        name = 4 + number(0, 4)
        return length > 8 and number(name, 4) == length - name - 4
    if opcode == Opcode.MESSAGE_INDEX:
        return length >= 6 and number(2, 4) == length - 6
    return opcode in _KNOWN and length == {Opcode.FOOTER: _FOOTER_LENGTH, Opcode.DATA_END: 4}.get(Opcode(opcode), -1)


def resync(stream: BinaryIO, start: int, size: int) -> int | None:
    """The offset of the next self-consistent record at or after ``start``; None if there is none."""
    begin, length_of_window, window = start, _FIRST_WINDOW, b""

    def read(offset: int, count: int) -> bytes:
        inside = offset - begin
        return window[inside : inside + count] if inside + count <= len(window) else _read_at(stream, offset, count)

    while begin < size:
        window = _read_at(stream, begin, length_of_window + _HEAD.size)
        for match in _CANDIDATE.finditer(window):
            offset = begin + match.start()
            if match.start() + _HEAD.size > len(window):
                break
            opcode, length = _HEAD.unpack_from(window, match.start())
            content = offset + _HEAD.size
            fits = length <= size - content and _is_self_consistent(read, content, opcode, length)
            if fits and _is_next(read(content + length, _HEAD.size)):
                return offset
        begin += length_of_window
        length_of_window = min(4 * length_of_window, _MAX_WINDOW)
    return None


def chunk_records(frame: McapRecord, damage: Damage) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of each record in a chunk; none if its checksum does not match."""
    try:
        data = _unpacked(Chunk.read(ReadDataStream(BytesIO(frame.content))))
    except (
        McapError,
        ValueError,
        OverflowError,
        struct.error,
        zstandard.ZstdError,
        RuntimeError,
        MemoryError,
        EOFError,
    ):
        damage.record(f"the chunk at byte {frame.offset} is damaged and was left out")
        return
    offset = 0
    while offset + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, offset)
        offset += _HEAD.size
        if length > len(data) - offset or opcode == 0:
            damage.record(f"the chunk at byte {frame.offset} has a record that is cut off")
            return
        yield opcode, data[offset : offset + length]
        offset += length


def _unpacked(chunk: Chunk) -> bytes:
    """The records of a chunk, unpacked no further than it says. Raises ValueError and the codecs' errors."""
    size = chunk.uncompressed_size
    if size > min(MAX_CHUNK, max(_MIN_UNPACKED, _MAX_RATIO * len(chunk.data))):
        raise ValueError("too big")
    if chunk.compression == "zstd":
        unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK)
        with unpacker.stream_reader(BytesIO(chunk.data)) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        data = chunk.data
    if len(data) != size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise ValueError("not what it says")
    return data


def message_record(content: bytes) -> RawMessage | None:
    """Parse a message record; None if it is too short to be one."""
    if len(content) < _MESSAGE.size:
        return None
    channel, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(content)
    return RawMessage(channel, sequence, log_time_ns, publish_time_ns, content[_MESSAGE.size :])


def attachment_checksum_matches(content: bytes) -> bool:
    """Whether an attachment's own checksum matches (0: it has none)."""
    if len(content) < 4:
        return False
    (expected,) = struct.unpack_from("<I", content, len(content) - 4)
    return expected in (0, zlib.crc32(content[:-4]))


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
