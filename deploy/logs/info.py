"""Summary of a log's contents, as data and as a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import printable
from protocols.log.read.reader import LogReader, TopicSummary
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION, STATUS

_AT_ONCE = 1000
"""Times a topic's usual rate: a hub publishes tracks of some hundred people, and what is faster was fetched."""
_STEP_NS = 60 * NANOSECONDS  # between two frames: more than an outage from which a camera's are fetched
_SHOWN = 100
"""Rows of a table; a file may hold 65,000 keys."""

if TYPE_CHECKING:
    from rich.console import RenderableType


@dataclass(frozen=True, slots=True)
class TopicDescription:
    """One key of the log. topic and agent are empty for a channel that is not in the catalogue.

    rate_hz: mean message rate between the first and the last message, of observations by the cameras' own times; 0 for
    fewer than two, and where a history arrived at once. first_s, last_s: arrival of these, since the start of the log.
    """

    key: str
    topic: str
    agent: str
    count: int
    rate_hz: float
    first_s: float
    last_s: float


@dataclass(frozen=True, slots=True)
class CameraDescription:
    """One boot of one camera. missing: observations absent from the log, according to the sequence numbers and to how
    many the camera's own statuses in the log say that it had published."""

    camera: str
    boot_id: str
    observations: int
    detections: int
    missing: int


@dataclass(frozen=True, slots=True)
class AttachmentDescription:
    """One attached file. bytes: its size."""

    name: str
    media_type: str
    bytes: int


@dataclass(frozen=True, slots=True)
class LogDescription:
    """Summary of a log. begin_ns: Unix time of the first message; damage: "" or a description of the damage."""

    path: str
    bytes: int
    begin_ns: int
    duration_s: float
    messages: int
    damage: str
    topics: tuple[TopicDescription, ...]
    cameras: tuple[CameraDescription, ...]
    rejected: dict[str, int]
    metadata: dict[str, dict[str, str]]
    attachments: tuple[AttachmentDescription, ...]


@dataclass(slots=True)
class _Boot:
    observations: int = 0
    detections: int = 0
    first: int = 2**64
    last: int = -1
    time_ns: int | None = None
    span_ns: int = 0
    """Last device time, and between all of them, without steps of the clock"""

    def note(self, sequence: int) -> None:
        """An observation of this number was published."""
        self.first = min(self.first, sequence)
        self.last = max(self.last, sequence)

    def missing(self) -> int:
        return max(0, self.last - self.first + 1 - self.observations)


def describe_log(path: Path | str) -> LogDescription:
    """Read a whole log and summarise it. Raises InputError for a file that is not a log."""
    reader = LogReader(path)
    summary = reader.summary()
    boots: dict[tuple[str, str], _Boot] = {}
    for logged in reader.messages([OBSERVATION, STATUS]):
        message = logged.message
        if isinstance(message, pb.Observation):
            boot = boots.setdefault((message.camera, message.boot_id), _Boot())
            boot.observations += 1
            boot.detections += len(message.detections)
            boot.note(message.sequence)
            passed = message.device_time_ns - (boot.time_ns or message.device_time_ns)
            boot.time_ns, boot.span_ns = (
                message.device_time_ns,
                boot.span_ns + (passed if abs(passed) < _STEP_NS else 0),
            )
        elif isinstance(message, pb.AgentStatus) and message.role == "camera":
            numbered = round(message.counters["published"] + message.counters["unpublished"])
            if numbered:
                boots.setdefault((message.agent, message.boot_id), _Boot()).note(numbered - 1)
    rejected = dict(reader.counters)
    return LogDescription(
        path=str(path),
        bytes=reader.size,
        begin_ns=summary.first_ns,
        duration_s=(summary.last_ns - summary.first_ns) / NANOSECONDS,
        messages=summary.messages,
        damage=summary.reason,
        topics=tuple(
            TopicDescription(
                key=entry.key,
                topic=entry.address.topic.name if entry.address else "",
                agent=entry.address.agent if entry.address else "",
                count=entry.count,
                rate_hz=_rate(entry, boots),
                first_s=(entry.first_ns - summary.first_ns) / NANOSECONDS,
                last_s=(entry.last_ns - summary.first_ns) / NANOSECONDS,
            )
            for entry in summary.topics
        ),
        cameras=tuple(
            CameraDescription(camera, boot_id, boot.observations, boot.detections, boot.missing())
            for (camera, boot_id), boot in boots.items()
        ),
        rejected=rejected,
        metadata=reader.metadata(),
        attachments=tuple(
            AttachmentDescription(item.name, item.media_type, len(item.data)) for item in reader.attachments()
        ),
    )


def as_table(description: LogDescription) -> RenderableType:
    """The description as a rich renderable."""
    from rich.console import Group
    from rich.markup import escape
    from rich.table import Table

    begin = datetime.fromtimestamp(description.begin_ns // NANOSECONDS, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    head = (
        f"{escape(printable(description.path))}: {description.messages} messages, {description.duration_s:.1f} s from "
        f"{begin}, {description.bytes / 1e6:.2f} MB"
    )
    topics = Table("key", "messages", "Hz", "from s", "to s", box=None, header_style="bold")
    for entry in description.topics[:_SHOWN]:
        topics.add_row(
            escape(printable(entry.key[:200])),
            str(entry.count),
            f"{entry.rate_hz:.1f}",
            f"{entry.first_s:.1f}",
            f"{entry.last_s:.1f}",
        )
    parts: list[RenderableType] = [head]
    if description.damage:
        parts.append(f"[red]damaged: {escape(printable(description.damage))}[/red]")
    if description.messages:
        parts.append(topics)
    if description.cameras:
        cameras = Table("camera", "boot", "observations", "detections", "missing", box=None, header_style="bold")
        for camera in description.cameras[:_SHOWN]:
            cameras.add_row(
                escape(camera.camera),
                camera.boot_id[:8],
                str(camera.observations),
                str(camera.detections),
                str(camera.missing),
            )
        parts.append(cameras)
    parts += [
        escape(printable(f"{item.name[:200]}: {item.bytes} bytes, {item.media_type[:80]}"))
        for item in description.attachments[:_SHOWN]
    ]
    for what in ("topics", "cameras", "attachments"):
        more = len(getattr(description, what)) - _SHOWN
        parts += [f"{more} more {what}: see --json"] if more > 0 else []
    parts += [f"[red]{count} messages not used: {reason}[/red]" for reason, count in description.rejected.items()]
    return Group(*parts)


def _rate(entry: TopicSummary, boots: Mapping[tuple[str, str], _Boot]) -> float:
    count, span_ns, topic = entry.count - 1, entry.last_ns - entry.first_ns, entry.address and entry.address.topic
    if entry.address is not None and topic is OBSERVATION:
        runs = [boot for (camera, _), boot in boots.items() if camera == entry.address.agent and boot.observations]
        count = sum(boot.observations - 1 for boot in runs)
        span_ns = sum(boot.span_ns for boot in runs)
    rate = count * NANOSECONDS / span_ns if count > 0 and span_ns > 0 else 0.0
    return 0.0 if topic and topic is not OBSERVATION and rate > _AT_ONCE * topic.rate_hz else rate
