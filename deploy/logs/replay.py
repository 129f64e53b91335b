"""Publishes a log onto the bus, at the pace at which it was recorded or any other."""

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
from protocols.log.read.reader import Logged, LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import Topic

_LINGER_S = 0.5
_BOOT_LENGTH = 50
"""Characters of a boot id that are kept where a number is added, so that it stays a valid id."""


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

    rate: 2 = twice as fast as recorded, 0 = as fast as the receivers' links take it.
    start_s: seconds of the log to leave out at its beginning.
    loop: begin again at the end until stopped. Clocks and sequence numbers then begin again too, so every round has
    boot ids of its own, as agents that were restarted.
    topics: only these; site: only what was recorded on this site. Everything goes out on the bus's own.
    stop: ends it early. wait_s: how long to wait at the beginning for all publishers to be listened to.
    progress: called after each message with the count and the seconds into the log.
    Raises InputError for a file that is no log, an unknown topic, or a rate or start out of range.
    """
    if not 0.0 <= rate <= 1e6:
        raise InputError(f"rate {rate} is out of range", remedy="give 1, 0.5, 10 or 0 (as fast as possible)")
    if not 0.0 <= start_s < 1e9:
        raise InputError(f"start {start_s} s is out of range", remedy="give seconds from the log's beginning")
    stop = stop or threading.Event()
    reader = LogReader(path)
    summary = reader.summary()
    first_ns = summary.first_ns + round(start_s * NANOSECONDS)
    # Checks the names of the topics before anything is declared.
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
            for message in _paced(reader.messages(wanted, start_ns=first_ns), first_ns, rate, stop):
                if site not in (None, message.site):
                    continue
                if round_number:
                    _as_restarted(message.message, round_number)
                publishers[message.topic.name, message.agent].put(message.message)
                count += 1
                if progress is not None:
                    progress(count, (message.log_time_ns - summary.first_ns) / NANOSECONDS)
            if not loop or stop.is_set() or count == before:
                break
        # What is still on its way, or has to be sent again, needs its publisher a little longer.
        stop.wait(_LINGER_S if count and wait_s else 0.0)
        return count
    finally:
        for publisher in publishers.values():
            publisher.close()


def _as_restarted(message: Message, round_number: int) -> None:
    """Give a message, and the cameras in it, the boot ids of one round of a loop."""
    for part in (message, *(message.cameras if isinstance(message, pb.Calibration) else ())):
        boot = getattr(part, "boot_id", "")
        if boot:
            part.boot_id = f"{boot[:_BOOT_LENGTH]}-{round_number}"


def _paced(logged: Iterable[Logged], first_ns: int, rate: float, stop: threading.Event) -> Iterable[Logged]:
    """The messages, each when its time has come; ends when ``stop`` is set."""
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
