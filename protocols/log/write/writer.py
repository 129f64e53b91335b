"""Crash-safe writer of MCAP logs: what was synced stays readable if the process dies.

Its chunks take the place of the chunk builder of mcap's own writer, whose interface they have: that takes 4 us for a
message in ten calls, this 1 us in one; the same bytes. Where a later mcap has none to replace, `faster` says so, and
the writer is used as it is.
"""

from __future__ import annotations

import fcntl
import os
import struct
from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NoReturn, cast

from google.protobuf.message import Message
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from protocols.core.closing import Closing
from protocols.core.errors import InputError
from protocols.core.version import VERSION
from protocols.log.layout import CHANNEL_RECORD, FORMAT_RECORD, LOG_VERSION, channel_record, schema_of, with_checksum
from protocols.topics import Topic
from protocols.validation.codec import encode, message_class, parse_key
from protocols.validation.rules import SCHEMA_VERSION

if TYPE_CHECKING:
    from protocols.log.write.foxglove import FoxgloveConverter

PROFILE = "syncline"
LIBRARY = "syncline"
CHUNK_SIZE = 60 * 1024
"""Bytes after which a chunk is finished, so that one of small messages stays below 64 KiB.

An unfinished chunk is lost if the process dies; 1 MiB of small messages is 12 s.
"""
MAX_CHANNELS = 16_384
"""Keys in one file: 1,000 cameras have 12,000, with those for viewers. The format numbers them with 16 bits."""
_BUILDER, _STATISTICS = "_Writer__chunk_builder", "_Writer__statistics"
_MESSAGE = struct.Struct("<BQHIQQ")
_HEAD = 2 + 4 + 8 + 8  # bytes: channel, sequence, two times


class LogWriter(Closing):
    """Writes messages of the catalogue to a new MCAP file. For use by one thread.

    path: the file; its folders are made. An existing file is never overwritten (InputError).
    metadata: written at the start, by name; readers get it back as it is.
    part: of a log in several files: (session, number from 0).
    views: also write channels in Foxglove's schemas, which viewers show without configuration.
    schema: the version of the messages, where those of an old log are copied.
    A disk failure raises InputError; what was written until then stays readable.
    """

    def __init__(
        self,
        path: Path | str,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        *,
        part: tuple[str, int] | None = None,
        views: bool = False,
        schema: int = SCHEMA_VERSION,
    ) -> None:
        self.path = Path(path)
        self._sequences: dict[int, int] = {}
        self._channels: dict[str, int] = {}
        self._keys: dict[tuple[str, str, str], str] = {}
        self._schemas: dict[str, int] = {}
        self._views: FoxgloveConverter | None = None
        if views:
            from protocols.log.write.foxglove import FoxgloveConverter

            self._views = FoxgloveConverter()
        with self._disk():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _DirectFile(self.path)
            _sync_folder(self.path.parent)
        self._open = True
        self._writer: Any = Writer(  # Any: half of its methods have no types
            cast(IO[Any], self._file),
            chunk_size=CHUNK_SIZE,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._chunk = faster(self._writer)
        try:
            with self._disk():
                self._writer.start(profile=PROFILE, library=LIBRARY)
                self._writer.add_metadata(FORMAT_RECORD, _format(part, schema))
                for name, values in (metadata or {}).items():
                    self._writer.add_metadata(name, dict(values))
        except InputError:  # on a full disk a recorder that tries again would leave one empty file after the other
            self.path.unlink(missing_ok=True)
            raise

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._file.tell()

    def write(self, topic: Topic, agent: str, site: str, message: Message, log_time_ns: int) -> bool:
        """Append one message under the key it has on the bus; False if the file has too many keys for a new one.

        log_time_ns: the recorder's clock (Unix, ns); the devices' own times stay in the message.
        """
        if type(message) is not message_class(topic):
            raise TypeError(f"{message.DESCRIPTOR.name} on a topic of {topic.message}")
        payload = encode(message)
        name = (topic.name, agent, site)
        key = self._keys.get(name)
        if key is None:
            if len(self._channels) >= MAX_CHANNELS:
                return False
            key = self._keys[name] = topic.key_for(site, agent)
        try:
            self._put(key, payload, log_time_ns)
            if self._views is not None:
                for view in self._views.of(site, message, log_time_ns):
                    self._put(view.key, view.message.SerializeToString(deterministic=True), log_time_ns)
        except OSError as error:
            self._failed(error)
        return True

    def copy(self, key: str, payload: bytes, log_time_ns: int, publish_time_ns: int, sequence: int) -> None:
        """Append a message of another log unchanged. Its channel must be known. Raises InputError for too many keys."""
        if key not in self._channels and len(self._channels) >= MAX_CHANNELS:
            raise InputError(f"more than {MAX_CHANNELS} keys", file=self.path, remedy="recover its parts one by one")
        try:
            self._put(key, payload, log_time_ns, publish_time_ns, sequence)
        except OSError as error:
            self._failed(error)

    def _put(
        self,
        key: str,
        payload: bytes,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int | None = None,
    ) -> None:
        channel = self._channels.get(key) or self._new_channel(key)
        if sequence is None:
            sequence = self._sequences.get(channel, 0)
            self._sequences[channel] = sequence + 1
        publish_time_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        if self._chunk is None:
            self._writer.add_message(channel, log_time_ns, payload, publish_time_ns, sequence & 0xFFFFFFFF)
        elif self._chunk.add(channel, log_time_ns, payload, publish_time_ns, sequence & 0xFFFFFFFF) > CHUNK_SIZE:
            self._writer.flush()

    def attach(self, name: str, media_type: str, data: bytes, log_time_ns: int = 0) -> None:
        """Store a whole file, e.g. a rig.toml, beside the messages."""
        with self._disk():
            self._writer.add_attachment(
                create_time=0, log_time=log_time_ns, name=name, media_type=media_type, data=data
            )

    def sync(self) -> None:
        """Finish the current chunk and bring everything to the disk; call it each second."""
        with self._disk():
            self._writer.flush()
            self._file.sync()

    def close(self) -> None:
        """Write the index and bring everything to the disk. May be called twice."""
        if not self._open:
            return
        with self._disk():
            self._writer.finish()
            self._file.sync()
            self._shut()

    def _new_channel(self, key: str) -> int:
        schema = schema_of(key)
        if schema is None:
            raise ValueError(f"{key!r} is not a known channel")
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(
                name=schema.name, encoding=SchemaEncoding.Protobuf, data=schema.data
            )
        address = parse_key(key)
        channel: int = self._writer.register_channel(
            topic=key,
            message_encoding=MessageEncoding.Protobuf,
            schema_id=self._schemas[schema.name],
            metadata={} if address is None else {"topic": address.topic.name},
        )
        self._channels[key] = channel
        # MCAP names a channel only inside the chunk that uses it first, and at the very end: one damaged chunk
        # would leave all later messages of an unclosed log without a channel name. This copy is outside the chunks.
        self._writer.add_metadata(CHANNEL_RECORD, channel_record(channel, key))
        return channel

    def _shut(self) -> None:
        self._open = False
        self._file.close()

    @contextmanager
    def _disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> NoReturn:
        if isinstance(error, FileExistsError) and self.path.exists():
            raise InputError("exists already", file=self.path, remedy="choose another name, or move it away") from None
        # After a failed write the file may end in half a record, so nothing more is appended.
        if getattr(self, "_open", False):
            self._shut()
        raise InputError(
            f"cannot write: {error.strerror or error}",
            file=self.path,
            remedy="make room, or choose a place that can be written",
        ) from None


class _DirectFile:
    """A new unbuffered file, so that every finished chunk reaches the kernel.

    Not an io.RawIOBase on purpose: the MCAP writer would put a buffer before one.
    """

    def __init__(self, path: Path) -> None:
        self._raw = path.open("xb", buffering=0)
        with suppress(OSError):  # not every file system has locks; one marks the file as being written
            fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._position = 0

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left:
            written = self._raw.write(left)
            left = left[written:]
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing is buffered."""

    def sync(self) -> None:
        os.fsync(self._raw.fileno())

    def close(self) -> None:
        self._raw.close()


def _sync_folder(folder: Path) -> None:
    """Sync a folder after creating a file: without it a power cut may lose the file's directory entry."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        pass  # some network file systems cannot; the data are synced all the same
    finally:
        os.close(handle)


def _format(part: tuple[str, int] | None, schema: int) -> dict[str, str]:
    values = {"log": str(LOG_VERSION), "schema": str(schema), "syncline": VERSION}
    return with_checksum(values if part is None else {**values, "session": part[0], "part": str(part[1])})


class _Index(array):  # type: ignore[type-arg]
    """Times and offsets of one channel's messages, in turn."""

    channel_id: int

    def write(self, stream: Any) -> None:
        """Write the index record."""
        stream.start_record(Opcode.MESSAGE_INDEX)
        stream.write2(self.channel_id)
        stream.write4(8 * len(self))
        stream.write(struct.pack(f"<{len(self)}Q", *self))
        stream.finish_record()


class Chunk:
    """The messages of a chunk, encoded. statistics: of the whole file, which mcap's writer has."""

    def __init__(self, statistics: Any) -> None:
        self._statistics = statistics
        self._buffer = bytearray()
        self.message_indices: dict[int, _Index] = {}
        self.message_start_time = self.message_end_time = 0

    @property
    def count(self) -> int:
        """Bytes so far."""
        return len(self._buffer)

    @property
    def num_messages(self) -> int:
        """Messages so far."""
        return sum(map(len, self.message_indices.values())) // 2

    def add(self, channel: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> int:
        """Add a message; the bytes of the chunk with it."""
        index = self.message_indices.get(channel)
        if index is None:
            index = self.message_indices[channel] = _Index("Q")
            index.channel_id = channel
        buffer = self._buffer
        index.append(log_time)
        index.append(len(buffer))
        buffer += _MESSAGE.pack(Opcode.MESSAGE, _HEAD + len(data), channel, sequence, log_time, publish_time)
        buffer += data
        return len(buffer)

    def add_channel(self, channel: Any) -> None:
        """Add a channel record; also a schema's."""
        builder: Any = RecordBuilder()  # without types
        channel.write(builder)
        self._buffer += builder.end()

    add_schema = add_channel

    def end(self) -> bytearray:
        """The chunk's records; its messages are counted, its times known from then on."""
        whole, times = self._statistics, [index[::2] for index in self.message_indices.values()]
        self.message_start_time, self.message_end_time = min(map(min, times)), max(map(max, times))
        first = not whole.message_count
        whole.message_start_time = min(self.message_start_time, whole.message_start_time if not first else 2**64)
        whole.message_end_time = max(self.message_end_time, whole.message_end_time)
        for channel, index in self.message_indices.items():
            whole.channel_message_counts[channel] += len(index) // 2
            whole.message_count += len(index) // 2
        return self._buffer

    def reset(self) -> None:
        """Begin the next one."""
        self._buffer = bytearray()
        self.message_indices.clear()


def faster(writer: Any) -> Chunk | None:
    """Put a faster chunk into a new writer of mcap's; None where it has no place for it."""
    if not (hasattr(writer, _BUILDER) and hasattr(writer, _STATISTICS)):
        return None
    chunk = Chunk(getattr(writer, _STATISTICS))
    setattr(writer, _BUILDER, chunk)
    return chunk
