"""A recorder that pauses on command and waits for space on the disk; each start writes a new log."""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import msgspec

from deploy.agents.recorder import ROLE, RecorderResult, run_recorder
from deploy.agents.retention import RESUME_MARGIN, Retention, Space, free_bytes
from deploy.config.agents import RecorderConfig
from protocols.bus.base import Bus, agent_status
from protocols.bus.commands import CommandSubscription
from protocols.core.errors import EXIT_DONE, InputError
from protocols.topics import STATUS

_STATUS_S = 1.0  # as all agents: health counts 5 s without a status as dead
_START, _STOP = "start_recording", "stop_recording"


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
