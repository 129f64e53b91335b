"""The recorder: writes every topic of a site that the catalogue marks as recorded to one log, with pauses on command.

Without space on the disk it waits; each start writes a new log.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import inf
from pathlib import Path

import msgspec

from deploy.agents.retention import RESUME_MARGIN, Retention, Space, free_bytes, unused_log_path
from deploy.config.agents import RecorderConfig
from deploy.config.file import effective_toml
from protocols.bus.base import Bus, CommandSubscription, Received, Subscription, agent_status
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import EXIT_DONE, InputError
from protocols.core.version import VERSION
from protocols.log.write.rotation import RotatingWriter
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, PICTURE, STATUS, TOPICS, Topic
from protocols.validation.rules import SCHEMA_VERSION

ROLE = "record"
_TICK_S = 0.02  # between two looks at the bus: a queue holds seconds
_SYNC_S = 0.5
"""Interval of fsync: half of the second that may be lost, because writing and the disk take time too."""
_STATUS_S = 1.0  # as all agents: health counts 5 s without a status as dead
_LAST_S = 3.0
"""How long messages that had arrived by the end are written: 200,000 of them."""
_MISSING_S = 2.0
"""How long a status names messages that went missing."""
_START, _STOP = "start_recording", "stop_recording"


@dataclass(frozen=True, slots=True)
class RecorderResult:
    """Result of a recording. counters: recorded, dropped, lost, skipped, rejected.<reason>, summed over all topics.

    path: the log, or its first part. parts: number of files. stopped: why recording ended by itself; "" if it did not.
    """

    path: Path
    messages: int
    counters: Mapping[str, int]
    parts: int = 1
    stopped: str = ""


def log_path(out: Path, now: datetime) -> Path:
    """The file to write: ``out`` itself if its suffix is .mcap, else a new file in the folder ``out``."""
    if out.suffix == ".mcap":
        return out
    return unused_log_path(out, now)


def run_recorder(
    config: RecorderConfig,
    bus: Bus,
    stop: threading.Event,
    *,
    stop_when: Callable[[int], bool] | None = None,
    boot_id: str | None = None,
    free: Callable[[Path], int] = free_bytes,
    beat: Callable[[], None] = lambda: None,
) -> RecorderResult:
    """Record until ``stop`` is set, until ``stop_when(messages so far)`` is true, or until the disk is nearly full.

    Log times are arrival times. The log is flushed to disk (fsync) twice a second; the recorder's status is published
    each second. free: free bytes on a folder's disk. beat: called in every cycle. Raises
    InputError if the log exists already or cannot be opened, or if the disk is too full to start.
    """
    boot = boot_id or uuid.uuid4().hex
    path = log_path(config.out, datetime.now(UTC))
    space = Space(config, free)
    retention = Retention(config, space)
    retention.clean(None)
    full = space.lack()
    if full:
        raise InputError(f"not recorded: {full}", file=path, remedy="make room, or lower min_free_mb")
    with _writer(config, path, bus.site, boot) as writer, bus.announce(ROLE, config.id, boot):
        # Cameras publish thumbnails only while somebody subscribes to them.
        wanted = [topic for topic in TOPICS if topic.recorded and (config.pictures_hz > 0.0 or topic is not PICTURE)]
        subscriptions = [bus.subscribe(topic) for topic in wanted]
        limiter = ThumbnailRateLimiter(config.pictures_hz)
        publisher = bus.publisher(STATUS, config.id)
        status = agent_status(ROLE, config.id, boot, 0, "running", "")
        messages = 0
        missing = MissingMessages()
        next_sync = next_status = time.monotonic()
        try:
            while not stop.is_set() and not (stop_when is not None and stop_when(messages)) and not full:
                now = time.monotonic()
                try:
                    messages += _record(writer, bus.site, subscriptions, limiter)
                    if now >= next_sync:
                        writer.sync()
                        retention.clean(writer.path)
                        full = space.lack()
                except InputError as error:  # a disk that is full all at once, or gone; the log is closed
                    full = error.what
                if now >= next_sync or full:
                    next_sync = now + _SYNC_S
                    # Only directly after a sync, so that everything reported as recorded is on the disk.
                    if now >= next_status or full:
                        next_status = now + _STATUS_S - _SYNC_S / 2
                        counters = {**_counters(subscriptions, messages), "deleted_files": retention.deleted}
                        _report(status, counters, missing.news(count_missing(subscriptions, wanted), now), full)
                        status.gauges.update({"log_bytes": writer.size, "disk_free_bytes": space.free_mb * 1e6})
                        publisher.put(status)
                        status.sequence += 1
                beat()
                if not full:
                    stop.wait(_TICK_S)
            for subscription in subscriptions:
                subscription.flush()
            until = time.monotonic() + _LAST_S
            # A queue gives so much at once.
            while not full and (more := _record(writer, bus.site, subscriptions, limiter)):
                messages += more
                if time.monotonic() > until:
                    break
            counters = _counters(subscriptions, messages)
        finally:
            publisher.close()
            for subscription in subscriptions:
                subscription.close()
    return RecorderResult(
        writer.first if isinstance(writer, RotatingWriter) else path,
        messages,
        counters,
        writer.parts if isinstance(writer, RotatingWriter) else 1,
        full,
    )


def _writer(config: RecorderConfig, path: Path, site: str, boot: str) -> LogWriter | RotatingWriter:
    metadata = {
        "syncline": {
            "site": site,
            "recorder": config.id,
            "boot_id": boot,
            "schema_version": str(SCHEMA_VERSION),
            "version": VERSION,
        },
        "configuration": {"recorder.toml": effective_toml(config)},
    }
    if config.part_s is None and config.part_mb is None:
        return LogWriter(path, metadata, views=config.foxglove)
    max_bytes = None if config.part_mb is None else round(config.part_mb * 1e6)
    return RotatingWriter(path, metadata, boot, max_bytes=max_bytes, max_s=config.part_s, views=config.foxglove)


class MissingMessages:
    """Whether messages went missing just now: what was lost an hour ago is counted, and no state of today."""

    def __init__(self) -> None:
        self._total, self._until = 0, -inf

    def news(self, total: int, now: float) -> int:
        """The number that is missing from the log if it has grown in the last seconds, else 0."""
        if total > self._total:
            self._total, self._until = total, now + _MISSING_S
        return total if now < self._until else 0


class ThumbnailRateLimiter:
    """Limits the thumbnails of each camera to ``hz`` per second; messages of other topics always pass."""

    def __init__(self, hz: float) -> None:
        # 0.9: an image that arrives slightly early still counts as the one that is due.
        self._min_interval_ns = 0.9 * NANOSECONDS / hz if hz > 0.0 else inf
        self._last: dict[str, int] = {}

    def accepts(self, received: Received) -> bool:
        """Whether to record a message."""
        if received.topic is not PICTURE:
            return True
        last = self._last.get(received.agent)
        # A clock that was set back must not suppress images.
        if last is not None and 0 <= received.arrival_ns - last < self._min_interval_ns:
            return False
        self._last[received.agent] = received.arrival_ns
        return True


def _record(
    writer: LogWriter | RotatingWriter, site: str, subscriptions: list[Subscription], limiter: ThumbnailRateLimiter
) -> int:
    """Write all pending messages in order of arrival over all topics; returns their number."""
    arrived = [received for subscription in subscriptions for received in subscription.drain()]
    batch = [received for received in arrived if limiter.accepts(received)]
    batch.sort(key=lambda received: received.arrival_ns)
    return sum(
        writer.write(received.topic, received.agent, site, received.message, received.arrival_ns) for received in batch
    )


def _counters(subscriptions: list[Subscription], messages: int) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for subscription in subscriptions:
        counts.update(subscription.counters)
    counts.pop("received", None)
    return {"recorded": messages, **counts}


def count_missing(subscriptions: Sequence[Subscription], topics: Sequence[Topic]) -> int:
    """Messages that should be in the log. Where only the newest counts, as of statuses, no older one is missed."""
    return sum(
        subscription.counters.get(name, 0)
        for subscription, topic in zip(subscriptions, topics, strict=True)
        for name in ("dropped", "lost", *(["skipped"] if topic is FLIGHT_IMAGE else []))
    )


def _report(status: pb.AgentStatus, counters: Mapping[str, int], missing: int, full: str) -> None:
    status.state = "degraded" if missing else "running"
    recorded = counters["recorded"]
    status.message = f"{missing} messages are missing from the log" if missing else f"{recorded} messages"
    if full:
        status.state, status.message = "stopping", f"recording ended: {full}"
    status.counters.clear()
    for name, count in counters.items():
        status.counters[name] = count
    status.gauges["recording"] = 1.0


def start_recorder(config: RecorderConfig, bus: Bus, stop: threading.Event, beat: Callable[[], None]) -> int:
    """Run a recorder until it is stopped. beat: called in every cycle."""
    result = record_on_command(config, bus, stop, beat=beat, report=lambda line: print(line, flush=True))
    more = f" and {result.parts - 1} more parts" if result.parts > 1 else ""
    print(f"recorded {result.messages} messages to {result.path}{more}")
    return EXIT_DONE


def record_on_command(
    config: RecorderConfig,
    bus: Bus,
    stop: threading.Event,
    *,
    free: Callable[[Path], int] = free_bytes,
    beat: Callable[[], None] = lambda: None,
    report: Callable[[str], None] = lambda text: None,
) -> RecorderResult:
    """Record until ``stop`` is set, with pauses that a view commands; returns the result of the last log.

    Without space, and after a disk's failure, the recorder waits, degraded, and then begins a new log. free: as for
    ``run_recorder``. report: called with one line for each finished log. Raises InputError where the first log exists
    already or cannot be opened, or where the whole disk is smaller than what must stay free.
    """
    boot = uuid.uuid4().hex
    recording_commands = CommandSubscription(bus, config.id, boot, (_START, _STOP))
    space = Space(config, free)
    retention = Retention(config, space)
    waiting = _Waiting(config.id, bus, boot, recording_commands, stop, beat)
    paused = False

    def is_paused(messages: int) -> bool:
        nonlocal paused
        for action in recording_commands.take():
            paused = action == _STOP
        return paused

    def can_record() -> bool:
        retention.clean(None)
        return not space.lack(RESUME_MARGIN)

    result: RecorderResult | None = None
    problem = "" if can_record() or space.never_enough() else space.lack(RESUME_MARGIN)
    try:
        while True:
            if problem:
                report(f"not recording: {problem}; waiting for it to be over")
                waiting.until(can_record, "degraded", f"not recording: {problem}")
                problem = ""
            elif paused and result is not None:
                report(f"recorded {result.messages} messages to {result.path}; paused, as a view asked")
                waiting.until(lambda: False, "running", f"paused after {result.path.name}")
                paused = False
            if stop.is_set():
                break
            again = config if result is None else with_unused_log_path(config)
            try:
                result = run_recorder(again, bus, stop, stop_when=is_paused, boot_id=boot, free=free, beat=beat)
            except InputError as error:
                if result is None and (not space.lack() or space.never_enough()):
                    raise
                problem = str(error)
                continue
            problem = result.stopped
            if stop.is_set() or not (paused or problem):
                break
    finally:
        recording_commands.close()
    return result or RecorderResult(config.out, 0, {}, 0, space.lack())


def with_unused_log_path(config: RecorderConfig) -> RecorderConfig:
    """The same configuration with an unused log name: demo.mcap, demo-2.mcap, demo-3.mcap, …"""
    out = config.out
    if out.suffix != ".mcap":
        return config  # a folder: its files are named by time
    number = 2
    while _log_exists(out.with_stem(f"{out.stem}-{number}")):
        number += 1
    return msgspec.structs.replace(config, out=out.with_stem(f"{out.stem}-{number}"))


def _log_exists(path: Path) -> bool:
    return path.exists() or any(path.parent.glob(f"{path.stem}-[0-9][0-9][0-9].mcap"))


class _Waiting:
    """Publishes a recorder's status while it records nothing."""

    def __init__(
        self,
        agent: str,
        bus: Bus,
        boot: str,
        recording_commands: CommandSubscription,
        stop: threading.Event,
        beat: Callable[[], None],
    ) -> None:
        self._agent, self._bus, self._boot = agent, bus, boot
        self._commands, self._stop, self._beat = recording_commands, stop, beat
        self._sequence = 0

    def until(self, over: Callable[[], bool], state: str, text: str) -> None:
        """Wait until ``over``, a start command, or the stop event; after at least one status that says why."""
        publisher = self._bus.publisher(STATUS, self._agent)
        next_status = -math.inf
        try:
            with self._bus.announce(ROLE, self._agent, self._boot):
                while not self._stop.is_set() and _START not in self._commands.take():
                    now = time.monotonic()
                    if now >= next_status:
                        if math.isfinite(next_status) and over():  # a disk may fail again as soon as it is tried
                            return
                        next_status = now + _STATUS_S
                        self._sequence += 1
                        gauges = {"recording": 0.0}
                        status = agent_status(ROLE, self._agent, self._boot, self._sequence, state, text, {}, gauges)
                        publisher.put(status)
                    self._beat()
                    self._stop.wait(_STATUS_S / 10)
        finally:
            publisher.close()
