"""A recorder that is paused and resumed by commands on the bus; each start writes a new log."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable
from pathlib import Path

import msgspec

from deploy.agents.recorder import ROLE, RecorderResult, run_recorder
from deploy.config.agents import RecorderConfig
from protocols.bus.base import Bus
from protocols.bus.commands import CommandSubscription
from protocols.core.errors import InputError
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.topics import STATUS
from protocols.validation.codec import SCHEMA_VERSION

_STATUS_S = 1.0
_START, _STOP = "start_recording", "stop_recording"


def record_on_command(
    config: RecorderConfig,
    bus: Bus,
    stop: threading.Event,
    *,
    beat: Callable[[], None] = lambda: None,
    report: Callable[[str], None] = lambda text: None,
) -> RecorderResult:
    """Record until ``stop`` is set, with pauses that a view commands; returns the result of the last log.

    report: called with one line for each finished log. Raises InputError as ``run_recorder`` does for the first log.
    If a later one cannot be started, that is reported and the recorder stays paused.
    """
    boot = uuid.uuid4().hex
    recording_commands = CommandSubscription(bus, config.id, boot, (_START, _STOP))
    paused = False

    def is_paused(messages: int) -> bool:
        nonlocal paused
        for action in recording_commands.take():
            paused = action == _STOP
        return paused

    try:
        result = run_recorder(config, bus, stop, stop_when=is_paused, boot_id=boot, beat=beat)
        while paused and not stop.is_set() and not result.stopped:
            report(f"recorded {result.messages} messages to {result.path}; paused, as a view asked")
            _wait_for_start(config.id, bus, boot, recording_commands, stop, beat, f"paused after {result.path.name}")
            if stop.is_set():
                break
            paused = False
            again = with_unused_log_path(config)
            try:
                result = run_recorder(again, bus, stop, stop_when=is_paused, boot_id=boot, beat=beat)
            except InputError as error:
                report(f"not recorded: {error}")
                paused = True
    finally:
        recording_commands.close()
    return result


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


def _wait_for_start(
    agent: str,
    bus: Bus,
    boot: str,
    recording_commands: CommandSubscription,
    stop: threading.Event,
    beat: Callable[[], None],
    text: str,
) -> None:
    """Publish the status, and record nothing, until a start command arrives or ``stop`` is set."""
    status = pb.AgentStatus(
        schema_version=SCHEMA_VERSION,
        agent=agent,
        role=ROLE,
        boot_id=boot,
        state="running",
        message=text,
        version=VERSION,
        gauges={"recording": 0.0},
    )
    publisher = bus.publisher(STATUS, agent)
    rounds = 0
    try:
        with bus.announce(ROLE, agent, boot):
            while not stop.is_set() and _START not in recording_commands.take():
                if rounds % 10 == 0:
                    status.sequence += 1
                    publisher.put(status)
                rounds += 1
                beat()
                stop.wait(_STATUS_S / 10)
    finally:
        publisher.close()
