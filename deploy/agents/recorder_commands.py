"""A recorder that is told to stop and start from a view: each start is a log of its own."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable
from pathlib import Path

import msgspec

from deploy.agents.recorder import ROLE, RecorderResult, run_recorder
from deploy.config.agents import RecorderConfig
from protocols.bus.base import Bus
from protocols.core.commands import Orders
from protocols.core.errors import InputError
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb
from protocols.topics import STATUS
from protocols.validation.codec import SCHEMA_VERSION

_STATUS_S = 1.0
_START, _STOP = "start_recording", "stop_recording"


def record_as_asked(
    config: RecorderConfig,
    bus: Bus,
    stop: threading.Event,
    *,
    beat: Callable[[], None] = lambda: None,
    tell: Callable[[str], None] = lambda text: None,
) -> RecorderResult:
    """Record until ``stop`` is set, with pauses where a view asks for them; returns the last log's result.

    tell: hears a line for each log that ended. Raises InputError as ``run_recorder`` does for the first log; a later
    one that cannot be begun is told, and the recorder waits on.
    """
    boot = uuid.uuid4().hex
    orders = Orders(bus, config.id, boot, (_START, _STOP))
    paused = False

    def asked(messages: int) -> bool:
        nonlocal paused
        for action in orders.take():
            paused = action == _STOP
        return paused

    try:
        result = run_recorder(config, bus, stop, stop_when=asked, boot_id=boot, beat=beat)
        while paused and not stop.is_set() and not result.stopped:
            tell(f"recorded {result.messages} messages to {result.path}; paused, as a view asked")
            _wait(config.id, bus, boot, orders, stop, beat, f"paused after {result.path.name}")
            if stop.is_set():
                break
            paused = False
            again = replace_out(config)
            try:
                result = run_recorder(again, bus, stop, stop_when=asked, boot_id=boot, beat=beat)
            except InputError as error:
                tell(f"not recorded: {error}")
                paused = True
    finally:
        orders.close()
    return result


def replace_out(config: RecorderConfig) -> RecorderConfig:
    """The same recorder with a log that is not there yet: demo.mcap, demo-2.mcap, demo-3.mcap, …"""
    out = config.out
    if out.suffix != ".mcap":
        return config  # a folder: its files are named by time
    number = 2
    while _taken(out.with_stem(f"{out.stem}-{number}")):
        number += 1
    return msgspec.structs.replace(config, out=out.with_stem(f"{out.stem}-{number}"))


def _taken(path: Path) -> bool:
    return path.exists() or any(path.parent.glob(f"{path.stem}-[0-9][0-9][0-9].mcap"))


def _wait(
    agent: str, bus: Bus, boot: str, orders: Orders, stop: threading.Event, beat: Callable[[], None], text: str
) -> None:
    """Be seen, and record nothing, until asked to start or to end."""
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
            while not stop.is_set() and _START not in orders.take():
                if rounds % 10 == 0:
                    status.sequence += 1
                    publisher.put(status)
                rounds += 1
                beat()
                stop.wait(_STATUS_S / 10)
    finally:
        publisher.close()
