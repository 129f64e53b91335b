"""Writes a live MCAP log that survives the death of its writer."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, cast

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from protocols.catalogue import Topic
from protocols.errors import InputError
from protocols.gate import encode, message_class
from protocols.messages import syncline_pb2 as pb

PROFILE = "syncline"
LIBRARY = "syncline"
CHUNK_SIZE = 64 * 1024
"""Bytes. A chunk that was not finished is lost with its writer; 1 MiB of small messages is 12 s."""


class LogWriter:
    """Writes messages of the catalogue to a new MCAP file. For use by one thread.

    path: the file; its folders are made. An existing file is never overwritten (InputError).
    metadata: written at the start, by name; readers get it back as it is.
    Any failure of the disk is InputError; what was written until then stays readable.
    """

    def __init__(self, path: Path | str, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        self.path = Path(path)
        self._sequences: dict[int, int] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        with self._disk():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _DirectFile(self.path)
        self._open = True
        self._writer: Any = Writer(  # Any: half of its methods have no types
            cast(IO[Any], self._file),
            chunk_size=CHUNK_SIZE,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        with self._disk():
            self._writer.start(profile=PROFILE, library=LIBRARY)
            for name, values in (metadata or {}).items():
                self._writer.add_metadata(name, dict(values))

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._file.tell()

    def write(self, topic: Topic, agent: str, site: str, message: Message, log_time_ns: int) -> None:
        """Append one message under the key it has on the bus.

        log_time_ns: the recorder's clock (Unix, ns); the devices' own times stay in the message.
        """
        if message.DESCRIPTOR.name != topic.message:
            raise TypeError(f"{message.DESCRIPTOR.name} on a topic of {topic.message}")
        payload = encode(message)
        with self._disk():
            channel = self._channel(topic, topic.key_for(site, agent))
            sequence = self._sequences.get(channel, 0)
            self._sequences[channel] = sequence + 1
            self._writer.add_message(
                channel_id=channel,
                log_time=log_time_ns,
                publish_time=log_time_ns,
                sequence=sequence & 0xFFFFFFFF,
                data=payload,
            )

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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _channel(self, topic: Topic, key: str) -> int:
        channel = self._channels.get(key)
        if channel is None:
            channel = self._writer.register_channel(
                topic=key,
                message_encoding=MessageEncoding.Protobuf,
                schema_id=self._schema(topic),
                metadata={"topic": topic.name},
            )
            self._channels[key] = channel
        return channel

    def _schema(self, topic: Topic) -> int:
        schema = self._schemas.get(topic.message)
        if schema is None:
            schema = self._writer.register_schema(
                name=message_class(topic).DESCRIPTOR.full_name,
                encoding=SchemaEncoding.Protobuf,
                data=_FILE_DESCRIPTORS,
            )
            self._schemas[topic.message] = schema
        return schema

    def _shut(self) -> None:
        self._open = False
        self._file.close()

    @contextmanager
    def _disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if isinstance(error, FileExistsError) and self.path.exists():
                raise InputError(
                    "exists already", file=self.path, remedy="choose another name, or move it away"
                ) from None
            # After a failed write the file may end in half a record, so nothing more is appended.
            if getattr(self, "_open", False):
                self._shut()
            raise InputError(
                f"cannot write: {error.strerror or error}",
                file=self.path,
                remedy="make room, or choose a place that can be written",
            ) from None


class _DirectFile:
    """A new file without a buffer of its own, so that every finished chunk reaches the kernel.

    Not an io.RawIOBase on purpose: the MCAP writer would put a buffer before one.
    """

    def __init__(self, path: Path) -> None:
        self._raw = path.open("xb", buffering=0)
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
        """Nothing is held back."""

    def sync(self) -> None:
        os.fsync(self._raw.fileno())

    def close(self) -> None:
        self._raw.close()


def _file_descriptors() -> bytes:
    files = FileDescriptorSet()
    pb.DESCRIPTOR.CopyToProto(files.file.add())
    return files.SerializeToString(deterministic=True)


_FILE_DESCRIPTORS = _file_descriptors()
