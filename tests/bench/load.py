"""A thousand cameras on one hub: 5,000 observations a second through a router, latency and memory.

    python -m tests.bench.load [--cameras 1000] [--rate 5000] [--seconds 30] [--quick]

The cameras are spread over ten processes' worth of sessions in one feeding process; the hub is the guarded bus and
the live hub's estimator (gathering, clocks, no solving, which depends on the rig and not on the load) in a process of
its own. Latency: from put to the moment at which the hub's process has it, on one machine's clock. Memory: resident
size of the hub's process, and a straight line through it after a third of the time as warm-up, with its standard
error from the scatter of ten pieces.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.security.sender_identity import SenderCheckedBus
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, OBSERVATION

_SESSIONS = 10
_QUIET_S = 10  # without an arrival, in lines of one a second: nothing more is on its way


def resident_mb(pid: int | str = "self") -> float:
    """Resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def hub(endpoint: str, site: str = "local") -> None:
    """The hub's process: counts, latencies and memory as lines of JSON, one a second, until its input ends."""
    from hub.live.agent import freeze_garbage_collector
    from hub.live.live_hub import LiveHub, LiveSettings

    estimator = LiveHub(LiveSettings(window_s=10.0, interval_s=1e9))
    with open_bus(site, BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        guarded = SenderCheckedBus(bus, time.monotonic)
        subscriptions = [guarded.subscribe(topic) for topic in (CAMERA_INFO, OBSERVATION)]
        ended = threading.Event()
        threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
        freeze_garbage_collector()
        print(json.dumps({"ready": True}), flush=True)
        next_line, latencies, loop = time.monotonic() + 1.0, [], [0.0]
        while not ended.is_set():
            subscriptions[1].wait(0.05)
            began = time.monotonic()
            for subscription in subscriptions:
                for received in subscription.drain():
                    if isinstance(received.message, pb.Observation):
                        latencies.append((received.arrival_ns - received.message.device_time_ns) * 1e-6)
                    estimator.handle(received.message, received.arrival_ns * 1e-9)
            loop.append(time.monotonic() - began)
            if time.monotonic() >= next_line:
                next_line += 1.0
                line: dict[str, Any] = {
                    "latencies": latencies, "mb": resident_mb(), "cpu_s": time.process_time(),
                    "loop_ms": max(loop) * 1e3, "counters": dict(subscriptions[1].counters),
                }  # fmt: skip
                print(json.dumps(line), flush=True)
                latencies, loop = [], [0.0]


def feed(endpoint: str, cameras: int, rate: float, seconds: float, site: str = "local") -> None:
    """All cameras, in the order of their turn, each over one of ten sessions."""
    config = BusConfig(mode="client", connect=(endpoint,), outage_s=10.0)
    buses = [open_bus(site, config, timeout_s=10.0) for _ in range(_SESSIONS)]
    names = [f"cam{index:04d}" for index in range(cameras)]
    hz = rate / cameras
    publishers = [buses[i % _SESSIONS].publisher(OBSERVATION, name, rate_hz=hz) for i, name in enumerate(names)]
    publishers[0].wait_matched(10.0)
    print("ready", flush=True)
    messages = [
        pb.Observation(
            schema_version=1, camera=name, boot_id=f"boot-{name}",
            detections=[pb.Detection(u=1.0, v=2.0, size=12.0) for _ in range(4)],
        )
        for name in names
    ]  # fmt: skip
    began, sent = time.monotonic(), 0
    while time.monotonic() - began < seconds:
        due = int((time.monotonic() - began) * rate)
        for number in range(sent, due):
            message = messages[number % cameras]
            message.sequence = message.frame = number // cameras
            message.device_time_ns = time.time_ns()
            publishers[number % cameras].put(message)
        sent = due
        time.sleep(0.002)
    print(sent, flush=True)
    sys.stdin.read()
    os._exit(0)


def measure(cameras: int, rate: float, seconds: float) -> dict[str, float]:
    """Run it and return the figures."""
    endpoint = free_endpoint()

    def start(*words: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.bench.load", *words]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    with Router(endpoint):
        hearing = start("--role", "hub", "--endpoint", endpoint)
        feeding = None
        try:
            assert hearing.stdout is not None
            hearing.stdout.readline()
            feeding = start(
                "--role", "feed", "--endpoint", endpoint, "--cameras", str(cameras), "--rate", str(rate),
                "--seconds", str(seconds),
            )  # fmt: skip
            assert feeding.stdout is not None
            feeding.stdout.readline()
            lines: list[dict[str, Any]] = []
            deadline = time.monotonic() + seconds + 2.0
            while time.monotonic() < deadline:
                lines.append(json.loads(hearing.stdout.readline()))
            sent = int(feeding.stdout.readline())
            # What is still on its way, for as long as anything arrives: a slow machine loses nothing by being late.
            last, waits = lines[-1]["counters"], 0
            while last["received"] + last["lost"] + last["dropped"] < sent and waits < _QUIET_S:
                before, last = last, json.loads(hearing.stdout.readline())["counters"]
                waits = waits + 1 if last["received"] == before["received"] else 0
        finally:
            for process in (feeding, hearing):
                if process is not None:
                    process.kill()
                    process.wait()
    warm = lines[len(lines) // 3 : -2]
    latencies = sorted(value for line in warm for value in line["latencies"])
    slope, slope_std = growth([line["mb"] for line in warm])
    marks = [lines[round(share * (len(lines) - 3))]["mb"] for share in (0.0, 1 / 3, 2 / 3, 1.0)]
    return {
        "cameras": cameras,
        "rate": len(latencies) / max(len(warm), 1),
        "sent": sent,
        "received": last["received"],
        "lost": last["lost"] + last["dropped"],
        "p50_ms": latencies[len(latencies) // 2],
        "p99_ms": latencies[int(0.99 * len(latencies))],
        "loop_max_ms": max(line["loop_ms"] for line in warm),
        "hub_cpu_us": 1e6 * (warm[-1]["cpu_s"] - warm[0]["cpu_s"]) / sum(len(line["latencies"]) for line in warm[1:]),
        "hub_cpu": (warm[-1]["cpu_s"] - warm[0]["cpu_s"]) / (len(warm) - 1),
        "hub_mb": warm[-1]["mb"],
        **{f"hub_mb_at_{third}_thirds": mb for third, mb in enumerate(marks)},
        "growth_mb_per_h": slope,
        "growth_mb_per_h_std": slope_std,
    }


def growth(megabytes: list[float]) -> tuple[float, float]:
    """Slope of sizes taken once a second [MB/h] and its standard error, from the means of ten pieces."""
    pieces = [float(piece.mean()) for piece in np.array_split(np.array(megabytes), 10) if len(piece)]
    if len(pieces) < 4:
        return float("nan"), float("nan")
    at = (np.arange(len(pieces)) + 0.5) * len(megabytes) / len(pieces) / 3600.0
    line, covariance = np.polyfit(at, pieces, 1, cov=True)
    return float(line[0]), float(np.sqrt(covariance[0, 0]))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description="Many cameras on one hub.")
    parser.add_argument("--cameras", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=5000.0)
    parser.add_argument("--seconds", type=float, default=45.0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data")
    parser.add_argument("--role", choices=["hub", "feed"])
    parser.add_argument("--endpoint", default="")
    parser.add_argument("--site", default="local")
    words = parser.parse_args()
    if words.role == "hub":
        hub(words.endpoint, words.site)
    elif words.role == "feed":
        feed(words.endpoint, words.cameras, words.rate, words.seconds, words.site)
    else:
        found = measure(words.cameras, words.rate, 15.0 if words.quick else words.seconds)
        for name, value in found.items():
            print(f"{name}: {value:.2f}" if isinstance(value, float) else f"{name}: {value}")


if __name__ == "__main__":
    main()
