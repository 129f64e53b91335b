"""The two ends of a link as processes of their own, because a namespace and a kill -9 belong to a process.

    python -m tests.faults.endpoints publish ENDPOINT CAMERA HZ OUTAGE_S
    python -m tests.faults.endpoints receive ENDPOINT

publish: observations whose device time is CLOCK_MONOTONIC, until standard input says "stop"; then one line of JSON
with how many were put, and stays until the input ends. receive: one line of JSON for each line of input.
"""

from __future__ import annotations

import json
import select
import sys
import time
from collections import defaultdict
from typing import Any

from protocols.bus.base import Bus
from protocols.bus.security.sender_identity import SenderCheckedBus
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION


def _asked(timeout_s: float) -> str | None:
    """A line of standard input; None if there is none within the time, "" at its end."""
    return sys.stdin.readline() if select.select([sys.stdin], [], [], timeout_s)[0] else None


def publish(bus: Bus, camera: str, hz: float) -> None:
    """One camera at a steady rate."""
    boot = f"boot-{time.monotonic_ns()}"
    with bus.announce("camera", camera, boot):
        publisher = bus.publisher(OBSERVATION, camera, rate_hz=hz)
        matched = publisher.wait_matched(10.0)
        print(json.dumps({"ready": matched, "boot": boot}), flush=True)
        count, due = 0, time.monotonic()
        while _asked(max(0.0, due - time.monotonic())) is None:
            message = pb.Observation(
                schema_version=1, camera=camera, boot_id=boot, sequence=count, frame=count,
                device_time_ns=time.monotonic_ns(), detections=[pb.Detection(u=1.0, v=2.0)],
            )  # fmt: skip
            publisher.put(message)
            count += 1
            due += 1.0 / hz
        print(json.dumps({"put": count}), flush=True)
        sys.stdin.read()


def receive(bus: Bus) -> None:
    """All cameras; answers each line of input with what came since the last one."""
    subscription = bus.subscribe(OBSERVATION)
    watch = bus.watch_agents()
    print(json.dumps({"ready": True}), flush=True)
    sequences: dict[str, list[int]] = defaultdict(list)
    arrivals: dict[str, list[float]] = defaultdict(list)
    latencies: list[float] = []
    events: list[tuple[float, str, str, bool]] = []
    while True:
        for received in subscription.drain():
            message = received.message
            assert isinstance(message, pb.Observation)
            arrival = time.monotonic() - (time.time_ns() - received.arrival_ns) * 1e-9
            sequences[message.boot_id].append(message.sequence)
            arrivals[message.boot_id].append(arrival)
            latencies.append(arrival - message.device_time_ns * 1e-9)
        events += [(time.monotonic(), e.agent, e.boot_id, e.alive) for e in watch.drain()]
        line = _asked(0.005)
        if line == "":
            return
        if line is not None:
            answer: dict[str, Any] = {
                "sequences": sequences, "arrivals": arrivals, "latencies": latencies, "events": events,
                "counters": dict(subscription.counters),
            }  # fmt: skip
            print(json.dumps(answer), flush=True)


def main() -> None:
    """See the module."""
    role, endpoint, *rest = sys.argv[1:]
    outage = float(rest[2]) if role == "publish" and len(rest) > 2 else 60.0
    config = BusConfig(mode="client", connect=(endpoint,), outage_s=outage)
    with open_bus("local", config, timeout_s=20.0) as bus:
        if role == "publish":
            publish(bus, rest[0], float(rest[1]))
        else:
            receive(SenderCheckedBus(bus, time.monotonic))


if __name__ == "__main__":
    main()
