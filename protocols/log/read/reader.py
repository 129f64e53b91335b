"""Reader of logs, which also reads the undamaged part of a damaged log and describes the damage.

A log in several files is name-000.mcap, name-001.mcap, …; each part is a complete MCAP file.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

from google.protobuf.message import Message
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel, Metadata

from protocols.core.errors import InputError
from protocols.log.layout import (
    CHANNEL_RECORD,
    FORMAT_RECORD,
    channel_record,
    is_foxglove,
    part_path,
    upgrades_for,
    with_checksum,
)
from protocols.log.read.mcap_records import (
    MALFORMED,
    Damage,
    McapRecord,
    RawMessage,
    attachment_checksum_matches,
    chunk_records,
    message_record,
    open_log,
    read_index,
    read_records,
)
from protocols.topics import TOPICS_BY_NAME, Topic
from protocols.validation.codec import Address, admit, parse_key
from protocols.validation.rules import Rejected

_Record = TypeVar("_Record", AttachmentRecord, Channel, Metadata)
_PART = re.compile(r"(?P<stem>.+)-(?P<number>\d{3,6})\Z")


class LogMessage(NamedTuple):
    """One validated message of a log. log_time_ns: the recorder's clock (Unix, ns)."""

    topic: Topic
    agent: str
    site: str
    message: Message
    log_time_ns: int


@dataclass(frozen=True, slots=True)
class Attachment:
    """One file stored in a log."""

    name: str
    media_type: str
    data: bytes
    log_time_ns: int


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """Message count and time span of one key. address is None for a channel outside the catalogue."""

    key: str
    address: Address | None
    count: int
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class LogSummary:
    """Content of a whole log, by key in the order of first appearance; times as in Logged, 0 if empty.

    What only repeats it for viewers is left out.

    damaged, reason: whether something is wrong with the file, and what comes first.
    """

    topics: tuple[TopicSummary, ...]
    messages: int
    first_ns: int
    last_ns: int
    damaged: bool
    reason: str


class RawLogMessage(NamedTuple):
    """One message as stored: undecoded, with its channel's name; times in ns (Unix)."""

    part: Path
    key: str
    raw: RawMessage


class LogReader:
    """Reads one log: a file, or the parts of one (their folder, or the first of them).

    Raises InputError if it cannot be read, is no MCAP file at all, or is of a newer Syncline.

    Every scan is in file order and verifies the checksums. A log that was not closed, is cut off or
    has changed bytes gives its complete records; ``damage`` then describes the error.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.paths, self._missing = find_parts(self.path)
        self._damage = Damage()
        self._counts: Counter[str] = Counter()
        self._part = self.paths[0]
        self.format = log_format(self._part)
        """The log's format record: log, schema, syncline (versions); session and part if it has parts."""
        self._upgrades = upgrades_for(self._part, self.format)

    @property
    def damage(self) -> str:
        """The damage found by the last scan, as far as it got; "" if none."""
        more = f" (and {self._damage.flaws - 1} more)" if self._damage.flaws > 1 else ""
        return self._damage.text + more

    @property
    def skipped_bytes(self) -> int:
        """Bytes that the last scan skipped because they contain no record."""
        return self._damage.skipped

    @property
    def cut(self) -> bool:
        """Whether the last scan found a truncated file."""
        return self._damage.cut

    @property
    def size(self) -> int:
        """Bytes in all files."""
        return sum(path.stat().st_size for path in self.paths)

    @property
    def counters(self) -> Mapping[str, int]:
        """Of the last ``messages()``: rejected.<reason>, and foreign for channels not of the catalogue."""
        return dict(self._counts)

    def messages(
        self,
        topics: Iterable[Topic | str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[LogMessage]:
        """The messages in file order.

        topics: only these, by name or entry of the catalogue; start_ns, end_ns: log times, the end
        excluded. With a start, earlier chunks of a file with a valid index are neither read nor
        verified. Raises InputError for a name that the catalogue does not have.
        """
        wanted = None if topics is None else {_topic(topic).name for topic in topics}
        return self._messages(wanted, start_ns, end_ns)

    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; the last one of a name counts."""
        found: dict[str, dict[str, str]] = {}
        for frame in self._frames():
            if frame.opcode == Opcode.METADATA:
                record = self._parse(Metadata, frame)
                if record is not None and not record.name.startswith("syncline."):
                    found[record.name] = dict(record.metadata)
        return found

    def raw(self) -> Iterator[RawLogMessage]:
        """Every complete message in file order, without validation, including those for viewers."""
        for key, raw in self._raw_messages():
            yield RawLogMessage(self._part, key, raw)

    def attachments(self) -> Iterator[Attachment]:
        """The stored files in file order; one whose checksum does not match is omitted and counts as damage."""
        found: set[bytes] = set()
        for frame in self._frames():
            if frame.opcode != Opcode.ATTACHMENT:
                continue
            if not attachment_checksum_matches(frame.content):
                self._damage.record(f"the attachment at byte {frame.offset} is damaged and was left out")
                continue
            record = self._parse(AttachmentRecord, frame)
            digest = hashlib.sha256(frame.content).digest()
            if record is not None and digest not in found:  # each part of a log repeats them
                found.add(digest)
                yield Attachment(record.name, record.media_type, record.data, record.log_time)

    def summary(self) -> LogSummary:
        """Count everything; reads the whole file, but decodes no message."""
        count: Counter[str] = Counter()
        first: dict[str, int] = {}
        last: dict[str, int] = {}
        for key, raw in self._raw_messages():
            if is_foxglove(key):
                continue
            count[key] += 1
            first[key] = min(first.get(key, raw.log_time_ns), raw.log_time_ns)
            last[key] = max(last.get(key, raw.log_time_ns), raw.log_time_ns)
        return LogSummary(
            topics=tuple(TopicSummary(key, parse_key(key), count[key], first[key], last[key]) for key in count),
            messages=count.total(),
            first_ns=min(first.values(), default=0),
            last_ns=max(last.values(), default=0),
            damaged=bool(self._damage.flaws),
            reason=self.damage,
        )

    def _messages(self, wanted: set[str] | None, start_ns: int | None, end_ns: int | None) -> Iterator[LogMessage]:
        counts: Counter[str] = Counter()
        self._counts = counts
        for key, raw in self._raw_messages(start_ns):
            if start_ns is not None and raw.log_time_ns < start_ns:
                continue
            if end_ns is not None and raw.log_time_ns >= end_ns:
                continue
            address = parse_key(key)
            if address is None and is_foxglove(key):
                continue
            if address is None:
                counts["foreign"] += 1
                continue
            if wanted is not None and address.topic.name not in wanted:
                continue
            try:
                payload = raw.payload
                for upgrade in self._upgrades:
                    payload = upgrade(address.topic, payload)
                _, message = admit(key, payload)
            except Rejected as error:
                counts[f"rejected.{error.reason.value}"] += 1
                continue
            yield LogMessage(address.topic, address.agent, address.site, message, raw.log_time_ns)

    def _raw_messages(self, start_ns: int | None = None) -> Iterator[tuple[str, RawMessage]]:
        """(key, message) of every message whose channel is known."""
        channels: dict[int, str] = {}
        part, searched = None, False
        for opcode, content, frame in self._records(start_ns):
            if self._part != part:
                channels, part, searched = {}, self._part, False
            if opcode == Opcode.CHANNEL:
                channel = self._parse(Channel, McapRecord(frame.offset, opcode, content))
                if channel is not None:
                    channels[channel.id] = channel.topic
            elif opcode == Opcode.METADATA:
                noted = _channel_of_record(content)
                if noted is not None:
                    channels.setdefault(*noted)
            elif opcode == Opcode.MESSAGE:
                raw = message_record(content)
                if raw is not None and raw.channel not in channels and not searched:
                    # The chunk that defined the channel is damaged; the index at the end repeats its definition.
                    searched = True
                    channels = self._indexed_channels() | channels
                if raw is None or raw.channel not in channels:
                    self._damage.record(f"a message near byte {frame.offset} belongs to no known channel")
                    continue
                yield channels[raw.channel], raw

    def _indexed_channels(self) -> dict[int, str]:
        channels: dict[int, str] = {}
        with open_log(self._part) as stream:
            index = read_index(stream)
            if index is not None:
                return index.channels
            for frame in read_records(stream, Damage()):
                if frame.opcode == Opcode.CHANNEL:
                    channel = self._parse(Channel, frame)
                    if channel is not None:
                        channels[channel.id] = channel.topic
        return channels

    def _records(self, start_ns: int | None = None) -> Iterator[tuple[int, bytes, McapRecord]]:
        """(opcode, content, enclosing record), with chunks decompressed."""
        for frame in self._frames(start_ns):
            if frame.opcode == Opcode.CHUNK:
                for opcode, content in chunk_records(frame, self._damage):
                    yield opcode, content, frame
            else:
                yield frame.opcode, frame.content, frame

    def _frames(self, start_ns: int | None = None) -> Iterator[McapRecord]:
        self._damage = damage = Damage()
        if self._missing:
            damage.record(self._missing)
        for path in self.paths:
            self._part = path
            damage.place = f"{path.name}: " if len(self.paths) > 1 else ""
            try:
                with open_log(path) as stream:
                    index = None if start_ns is None else read_index(stream)
                    if index is None or start_ns is None:
                        yield from read_records(stream, damage)
                        continue
                    begin = index.offset_of(start_ns)
                    if begin is not None:
                        yield from read_records(stream, damage, begin)
            except InputError as error:
                damage.record(error.what)
            except OSError as error:
                damage.record(f"the disk cannot read it to the end: {error.strerror or error}")

    def _parse(self, kind: type[_Record], frame: McapRecord) -> _Record | None:
        """Parse one record to the library's class; None, counted as damage, if it is malformed."""
        read: Callable[[ReadDataStream], _Record] = cast(Any, kind).read
        try:
            return read(ReadDataStream(BytesIO(frame.content)))
        except MALFORMED:
            self._damage.record(f"the record at byte {frame.offset} is garbled and was left out")
            return None


def _channel_of_record(content: bytes) -> tuple[int, str] | None:
    """(id, key) of a metadata record that names a channel; None for other metadata."""
    try:
        record = Metadata.read(ReadDataStream(BytesIO(content)))
        if record.name != CHANNEL_RECORD:
            return None
        number, key = int(record.metadata["id"]), record.metadata["key"]
    except (*MALFORMED, KeyError):
        return None
    return (number, key) if record.metadata == channel_record(number, key) else None


def _topic(topic: Topic | str) -> Topic:
    if isinstance(topic, Topic):
        return topic
    found = TOPICS_BY_NAME.get(topic)
    if found is None:
        raise InputError(f"there is no topic {topic!r}", remedy=f"use one of {', '.join(TOPICS_BY_NAME)}")
    return found


class Parts(NamedTuple):
    """The files of one log in order, and a description of missing parts ("" if none)."""

    paths: tuple[Path, ...]
    missing: str


def find_parts(path: Path) -> Parts:
    """The files of the log ``path``: a folder with one log, its first part, or a single file. Raises InputError."""
    if path.is_dir():
        return _in_folder(path)
    open_log(path).close()
    found = _PART.match(path.stem)
    if found is None or int(found["number"]) != 0:
        return Parts((path,), "")
    session = log_format(path).get("session")
    if not session:
        return Parts((path,), "")
    numbered: dict[int, Path] = {}
    for other in path.parent.glob("*.mcap"):
        match = _PART.match(other.stem)
        if match is not None and match["stem"] == found["stem"] and _belongs(other, session):
            numbered[int(match["number"])] = other
    absent = sorted(set(range(max(numbered) + 1)) - set(numbered))
    names = ", ".join(part_path(path.with_name(f"{found['stem']}.mcap"), number).name for number in absent[:5])
    missing = f"{len(absent)} of its parts are missing ({names})" if absent else ""
    return Parts(tuple(numbered[number] for number in sorted(numbered)), missing)


def log_format(path: Path) -> dict[str, str]:
    """The format record at a log's beginning; {} if there is none."""
    with open_log(path) as stream:
        for frame in read_records(stream, Damage()):
            if frame.opcode == Opcode.CHUNK:
                break
            if frame.opcode == Opcode.METADATA:
                try:
                    record = Metadata.read(ReadDataStream(BytesIO(frame.content)))
                except MALFORMED:
                    continue
                if record.name == FORMAT_RECORD and record.metadata == with_checksum(record.metadata):
                    return dict(record.metadata)
    return {}


def _belongs(path: Path, session: str) -> bool:
    """Whether a file with a matching name belongs to the session; assumed if its beginning is damaged."""
    try:
        return log_format(path).get("session", session) == session
    except InputError:
        return False


def _in_folder(folder: Path) -> Parts:
    files = sorted(folder.glob("*.mcap"))
    if not files:
        raise InputError("no .mcap log in this folder", file=folder, remedy="give the log itself")
    stems = {found["stem"] if (found := _PART.match(file.stem)) else file.stem for file in files}
    if len(stems) > 1:
        names = ", ".join(sorted(stems)[:5])
        raise InputError(f"{len(stems)} logs in this folder ({names})", file=folder, remedy="give one of them")
    first = find_parts(files[0])
    if len(first.paths) == len(files):
        return first
    if first.paths == (files[0],) and log_format(files[0]).get("part") not in (None, "0"):
        lost = f"its first parts are missing (it begins with {files[0].name})"
        return Parts(tuple(files), lost)
    raise InputError(f"{len(files)} logs in this folder", file=folder, remedy="give one of them")
