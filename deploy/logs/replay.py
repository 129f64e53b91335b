"""Publishes the messages of a log on the bus, at the recorded rate or a multiple of it."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from google.protobuf.message import Message

from protocols.bus.base import Bus, Publisher
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.log.read.reader import LogMessage, LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import Topic

_FLUSH_S = 0.5
"""Time for which publishers stay open after the last message [s]."""
_BOOT_LENGTH = 50
"""Characters of a boot id that are kept when a round number is appended, so that the id stays valid."""


def replay(
    path: Path | str,
    bus: Bus,
    *,
    rate: float = 1.0,
    start_s: float = 0.0,
    loop: bool = False,
    topics: Iterable[Topic | str] | None = None,
    site: str | None = None,
    stop: threading.Event | None = None,
    wait_s: float = 1.0,
    progress: Callable[[int, float], None] | None = None,
) -> int:
    """Publish a log's messages on ``bus`` in file order; returns how many.

    rate: 2 = twice as fast as recorded, 0 = as fast as the receivers can take the messages.
    start_s: seconds of the log to skip at its beginning.
    loop: start again at the end until stopped. Clocks and sequence numbers then restart too, so every round has boot
    ids of its own, like restarted agents.
    topics: only these; site: only messages recorded on this site. All are published on the site of the bus.
    stop: ends it early. wait_s: longest time to wait at the start for subscribers of all publishers.
    progress: called after each message with the count and the time since the start of the log [s].
    Raises InputError for a file that is not a log, an unknown topic, or a rate or start out of range.
    """
    if not 0.0 <= rate <= 1e6:
        raise InputError(f"rate {rate} is out of range", remedy="give 1, 0.5, 10 or 0 (as fast as possible)")
    if not 0.0 <= start_s < 1e9:
        raise InputError(f"start {start_s} s is out of range", remedy="give seconds from the log's beginning")
    stop = stop or threading.Event()
    reader = LogReader(path)
    summary = reader.summary()
    first_ns = summary.first_ns + round(start_s * NANOSECONDS)
    # Checks the topic names before publishers are declared.
    wanted = None if topics is None else list(topics)
    reader.messages(wanted)
    addresses = [entry.address for entry in summary.topics]
    publishers: dict[tuple[str, str], Publisher] = {}
    try:
        for address in addresses:
            name = (address.topic.name, address.agent) if address else None
            if address is None or name is None or name in publishers or site not in (None, address.site):
                continue
            publishers[name] = bus.publisher(address.topic, address.agent, block=rate == 0.0)
        deadline = time.monotonic() + wait_s
        for publisher in publishers.values():
            publisher.wait_matched(max(0.0, deadline - time.monotonic()))
        count = 0
        for round_number in itertools.count():
            before = count
            for message in _in_real_time(reader.messages(wanted, start_ns=first_ns), first_ns, rate, stop):
                if site not in (None, message.site):
                    continue
                if round_number:
                    _set_round_boot_id(message.message, round_number)
                publishers[message.topic.name, message.agent].put(message.message)
                count += 1
                if progress is not None:
                    progress(count, (message.log_time_ns - summary.first_ns) / NANOSECONDS)
            if not loop or stop.is_set() or count == before:
                break
        # Publishers stay open a little longer, for messages in transit and retransmissions.
        stop.wait(_FLUSH_S if count and wait_s else 0.0)
        return count
    finally:
        for publisher in publishers.values():
            publisher.close()


def _set_round_boot_id(message: Message, round_number: int) -> None:
    """Set the boot ids of a message, and of the cameras in it, to those of one round of a loop."""
    for part in (message, *(message.cameras if isinstance(message, pb.Calibration) else ())):
        boot = getattr(part, "boot_id", "")
        if boot:
            part.boot_id = f"{boot[:_BOOT_LENGTH]}-{round_number}"


def _in_real_time(
    logged: Iterable[LogMessage], first_ns: int, rate: float, stop: threading.Event
) -> Iterable[LogMessage]:
    """The messages, each yielded at its scheduled time; ends when ``stop`` is set."""
    began = time.monotonic()
    for message in logged:
        if rate:
            due = began + (message.log_time_ns - first_ns) / NANOSECONDS / rate
            wait = due - time.monotonic()
            if wait > 0.0:
                stop.wait(wait)
        if stop.is_set():
            return
        yield message
