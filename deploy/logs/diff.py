"""Comparison of two logs: message counts, order, and every field that differs by more than its tolerance."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from protocols.core.errors import InputError
from protocols.log.read.reader import LogMessage, LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TOPICS
from protocols.validation.codec import message_class

if TYPE_CHECKING:
    from rich.console import RenderableType


@dataclass(slots=True)
class FieldDifference:
    """Differences of one field of one message type.

    count: messages that differ. largest: the largest |a - b| in the field's unit, inf for values that are not numbers.
    first: the first message that differs, with both values.
    """

    field: str
    tolerance: float
    count: int = 0
    largest: float = 0.0
    first: str = ""

    def add(self, where: str, a: object, b: object, by: float) -> None:
        """Count one more message in which this field differs; by: |a - b|."""
        if not self.count:
            self.first = f"{where}: {a} against {b}"
        self.count += 1
        self.largest = max(self.largest, by)


@dataclass(slots=True)
class LogComparison:
    """Result of a comparison of two logs.

    missing, extra: number of messages by key that only the first or only the second log has. order: where the order
    first differs, or "". compared: messages in both; damage: descriptions of damage in either file.
    """

    first: str
    second: str
    compared: int = 0
    missing: dict[str, int] = field(default_factory=dict)
    extra: dict[str, int] = field(default_factory=dict)
    order: str = ""
    fields: list[FieldDifference] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        """Whether nothing differs by more than the tolerances."""
        return not (self.missing or self.extra or self.order or self.fields)


def parse_tolerances(texts: list[str]) -> dict[str, float]:
    """``field=value`` pairs, e.g. "observation.detections.u=1e-6"; raises InputError."""
    known = {f"{topic.name}.{name}" for topic in TOPICS for name in _field_names(message_class(topic).DESCRIPTOR)}
    tolerances: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if not 0.0 <= number < math.inf:
            raise InputError(f"--tolerance {text!r} is not field=number", remedy="e.g. track.position=1e-6")
        if name not in known:
            raise InputError(
                f"--tolerance: there is no number {name!r} in any message",
                remedy="write topic.field, e.g. observation.detections.u or track.position",
            )
        tolerances[name] = number
    return tolerances


def compare_logs(first: Path, second: Path, tolerances: Mapping[str, float], topics: list[str] | None) -> LogComparison:
    """Compare two logs message by message. tolerances: largest |a - b| by ``topic.field``, in that field's unit.

    Messages are identified by key, boot id and sequence number (by their index if they have none); log times are not
    compared, nor what a hub says while it waits for an answer. Raises InputError.
    """
    readers = [LogReader(first), LogReader(second)]
    sides = [_identified(reader.messages(topics)) for reader in readers]
    result = LogComparison(str(first), str(second))
    a, b = sides
    result.missing = dict(Counter(identity[0] for identity in a if identity not in b))
    result.extra = dict(Counter(identity[0] for identity in b if identity not in a))
    result.order = _order([name for name in a if name in b], [name for name in b if name in a])
    found: dict[str, FieldDifference] = {}
    for identity, logged in a.items():
        other = b.get(identity)
        if other is None:
            continue
        result.compared += 1
        where = f"{identity[0]} {identity[2]}"
        reported: set[str] = set()
        for name, left, right, by in _differences(logged.message, other.message, logged.topic.name):
            tolerance = tolerances.get(name, 0.0)
            if by > tolerance and name not in reported:
                reported.add(name)
                found.setdefault(name, FieldDifference(name, tolerance)).add(where, left, right, by)
            elif by > tolerance:
                found[name].largest = max(found[name].largest, by)
    result.fields = sorted(found.values(), key=lambda entry: entry.field)
    result.damage = [f"{reader.path}: {reader.damage}" for reader in readers if reader.damage]
    return result


def as_table(comparison: LogComparison) -> RenderableType:
    """The comparison as a rich renderable."""
    from rich.console import Group
    from rich.markup import escape
    from rich.table import Table

    lines: list[RenderableType] = [f"[red]damaged: {escape(text)}[/red]" for text in comparison.damage]
    lines += [f"only in {escape(comparison.first)}: {n} × {key}" for key, n in comparison.missing.items()]
    lines += [f"only in {escape(comparison.second)}: {n} × {key}" for key, n in comparison.extra.items()]
    if comparison.order:
        lines.append(f"order: {escape(comparison.order)}")
    if comparison.fields:
        table = Table("field", "messages", "largest", "tolerance", "first", box=None, header_style="bold")
        for entry in comparison.fields:
            largest = f"{entry.largest:.3g}" if math.isfinite(entry.largest) else "-"
            table.add_row(entry.field, str(entry.count), largest, f"{entry.tolerance:g}", escape(entry.first))
        lines.append(table)
    outcome = "equal" if comparison.equal else "different"
    lines.append(f"{outcome}: {comparison.compared} messages compared")
    return Group(*lines)


def as_json(comparison: LogComparison) -> dict[str, Any]:
    """The comparison as a JSON object; a difference that is not a number is null."""
    return {
        "equal": comparison.equal,
        "compared": comparison.compared,
        "missing": comparison.missing,
        "extra": comparison.extra,
        "order": comparison.order,
        "fields": [
            {
                "field": entry.field,
                "messages": entry.count,
                "largest": entry.largest if math.isfinite(entry.largest) else None,
                "tolerance": entry.tolerance,
                "first": entry.first,
            }
            for entry in comparison.fields
        ],
        "damage": comparison.damage,
    }


def _identified(messages: Iterator[LogMessage]) -> dict[tuple[str, str, int, int], LogMessage]:
    """Messages by (key, boot id, sequence number or index, number of earlier duplicates), in file order."""
    found: dict[tuple[str, str, int, int], LogMessage] = {}
    places: Counter[str] = Counter()
    times: Counter[tuple[str, str, int]] = Counter()
    for logged in messages:
        if isinstance(logged.message, pb.Calibration):
            # What a hub waits for is of that moment; a replay publishes answers alone, and counts fewer revisions.
            if logged.message.status in ("collecting", "searching"):
                continue
            logged.message.ClearField("revision")
            logged.message.ClearField("progress")
        key = logged.topic.key.format(id=logged.agent)  # a replay may be on another site
        names = logged.message.DESCRIPTOR.fields_by_name
        boot = str(getattr(logged.message, "boot_id", ""))
        number = int(getattr(logged.message, "sequence", 0)) if "sequence" in names else places[key]
        places[key] += 1
        found[key, boot, number, times[key, boot, number]] = logged
        times[key, boot, number] += 1
    return found


def _order(a: list[tuple[str, str, int, int]], b: list[tuple[str, str, int, int]]) -> str:
    """Where the order of the common messages first differs."""
    for place, (left, right) in enumerate(zip(a, b, strict=True)):
        if left != right:
            return f"differs from message {place} on: {left[0]} {left[2]} against {right[0]} {right[2]}"
    return ""


def _differences(a: Message, b: Message, prefix: str) -> Iterator[tuple[str, object, object, float]]:
    """(field, value in a, value in b, |a - b|) of every field that differs; inf for values that are not numbers."""
    for entry in a.DESCRIPTOR.fields:
        left, right = getattr(a, entry.name), getattr(b, entry.name)
        name = f"{prefix}.{entry.name}"
        if left == right:
            continue
        if entry.message_type is not None and entry.message_type.GetOptions().map_entry:
            for key in sorted(set(left) | set(right), key=str):
                if key not in left or key not in right:
                    yield name, left.get(key), right.get(key), math.inf
                elif left[key] != right[key]:
                    yield name, left[key], right[key], _distance(left[key], right[key])
        elif entry.is_repeated:
            if len(left) != len(right):
                yield name, f"{len(left)} entries", f"{len(right)} entries", math.inf
                continue
            for one, other in zip(left, right, strict=True):
                yield from _values(name, one, other)
        else:
            yield from _values(name, left, right)


def _values(name: str, left: Any, right: Any) -> Iterator[tuple[str, object, object, float]]:
    if isinstance(left, Message):
        yield from _differences(left, right, name)
    elif left != right:
        yield name, left, right, _distance(left, right)


def _distance(left: Any, right: Any) -> float:
    if isinstance(left, (int, float)) and not isinstance(left, bool) and isinstance(right, (int, float)):
        difference = float(abs(left - right))
        return difference if math.isfinite(difference) else math.inf
    return math.inf


def _field_names(descriptor: Any) -> Iterator[str]:
    """Names of all numeric fields, nested ones as ``outer.inner``."""
    for entry in descriptor.fields:
        if entry.message_type is None:
            if entry.cpp_type not in (FieldDescriptor.CPPTYPE_STRING, FieldDescriptor.CPPTYPE_BOOL):
                yield entry.name
        elif entry.message_type.GetOptions().map_entry:
            yield entry.name
        else:
            for inner in _field_names(entry.message_type):
                yield f"{entry.name}.{inner}"
