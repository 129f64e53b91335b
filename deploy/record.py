"""The recorder: everything of a site that the catalogue calls recorded, into one log."""

from __future__ import annotations

import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from deploy.config import RecorderConfig
from protocols.bus.base import Bus, Received, Subscription
from protocols.catalogue import STATUS, TOPICS
from protocols.gate import SCHEMA_VERSION
from protocols.log.writer import LogWriter
from protocols.messages import syncline_pb2 as pb

ROLE = "record"
_TICK_S = 0.02
_SYNC_S = 1.0


@dataclass(frozen=True, slots=True)
class RecorderResult:
    """What was recorded. counters: recorded, dropped, lost, rejected.<reason>, summed over all topics."""

    path: Path
    messages: int
    counters: Mapping[str, int]


def log_path(out: Path, now: datetime) -> Path:
    """The file to write: ``out`` itself if it is named .mcap, else a new one in the folder ``out``."""
    if out.suffix == ".mcap":
        return out
    return out / now.strftime("syncline-%Y%m%dT%H%M%SZ.mcap")


def run_recorder(
    config: RecorderConfig,
    bus: Bus,
    stop: threading.Event,
    *,
    stop_when: Callable[[int], bool] | None = None,
    boot_id: str | None = None,
) -> RecorderResult:
    """Record until ``stop`` is set, or until ``stop_when(messages so far)`` is true.

    Log times are the arrival times. Each second the log is brought to the disk and the recorder's status
    is published. Raises InputError if the log exists already or cannot be written.
    """
    boot = boot_id or uuid.uuid4().hex
    path = log_path(config.out, datetime.now(UTC))
    metadata = {
        "syncline": {
            "site": bus.site,
            "recorder": config.id,
            "boot_id": boot,
            "schema_version": str(SCHEMA_VERSION),
        }
    }
    with LogWriter(path, metadata) as writer, bus.announce(ROLE, config.id, boot):
        subscriptions = [bus.subscribe(topic) for topic in TOPICS if topic.recorded]
        publisher = bus.publisher(STATUS, config.id)
        status = pb.AgentStatus(
            schema_version=SCHEMA_VERSION, agent=config.id, role=ROLE, boot_id=boot, state="running"
        )
        messages = 0
        next_sync = time.monotonic()
        try:
            while not stop.is_set() and not (stop_when is not None and stop_when(messages)):
                messages += _record(writer, bus.site, subscriptions)
                if time.monotonic() >= next_sync:
                    next_sync = time.monotonic() + _SYNC_S
                    writer.sync()
                    _report(status, subscriptions, messages, writer.size)
                    publisher.put(status)
                    status.sequence += 1
                stop.wait(_TICK_S)
            messages += _record(writer, bus.site, subscriptions)
            counters = _counters(subscriptions, messages)
        finally:
            publisher.close()
            for subscription in subscriptions:
                subscription.close()
    return RecorderResult(path, messages, counters)


def _record(writer: LogWriter, site: str, subscriptions: list[Subscription]) -> int:
    """Write what has arrived, in the order of arrival over all topics."""
    batch: list[Received] = [received for subscription in subscriptions for received in subscription.drain()]
    batch.sort(key=lambda received: received.arrival_ns)
    for received in batch:
        writer.write(received.topic, received.agent, site, received.message, received.arrival_ns)
    return len(batch)


def _counters(subscriptions: list[Subscription], messages: int) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for subscription in subscriptions:
        counts.update(subscription.counters)
    counts.pop("received", None)
    return {"recorded": messages, **counts}


def _report(status: pb.AgentStatus, subscriptions: list[Subscription], messages: int, size: int) -> None:
    counters = _counters(subscriptions, messages)
    missing = counters.get("dropped", 0) + counters.get("lost", 0)
    status.state = "degraded" if missing else "running"
    status.message = f"{missing} messages are missing from the log" if missing else f"{messages} messages"
    status.counters.clear()
    for name, count in counters.items():
        status.counters[name] = count
    status.gauges["log_bytes"] = size
