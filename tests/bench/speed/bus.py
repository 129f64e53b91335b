"""Edge to hub: observations from one process to another, beside raw Zenoh with the same bytes.

Ours: a message is stamped, serialised and put by an advanced publisher; the hub's process takes it through gate and
guard and has it as a checked message. Raw: the bytes are there already, a plain blocking publisher puts them, a
callback looks at the clock. Both directly from peer to peer over loopback TCP. Latency at 1,000 messages a second;
throughput of a publisher that waits for nobody but a full queue. The gate alone is the CPU of ``admit_all``: bytes to
checked messages, every rule on, as many at once as one drain has in a flood, in one process.
"""

from __future__ import annotations

import argparse
import json
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from hub.live.agent import freeze_garbage_collector
from protocols.bus.router.zenoh_router import free_endpoint
from protocols.bus.security.sender_identity import SenderCheckedBus
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION
from protocols.validation.codec import admit_all, encode
from tests.bench.logs import KEY, messages
from tests.bench.real_rigs import REPOSITORY
from tests.bench.speed.rows import Limit, Row, Section, interleaved

_RATE = 1000.0
_QUIET_S = 1.0


def _hear_ours(endpoint: str, count: int) -> dict[str, object]:
    latencies: list[float] = []
    with open_bus("local", BusConfig(listen=(endpoint,)), timeout_s=10.0) as bus:
        guarded = SenderCheckedBus(bus, time.monotonic)
        subscription = guarded.subscribe(OBSERVATION)
        freeze_garbage_collector()  # as the hub does
        print("ready", flush=True)
        first = last = 0
        began = time.process_time()
        while len(latencies) < count:
            if not subscription.wait(_QUIET_S) and latencies:
                break
            for received in subscription.drain():
                now = time.time_ns()
                assert isinstance(received.message, pb.Observation)
                first = first or now
                last = now
                latencies.append((now - received.message.device_time_ns) * 1e-6)
        lost = dict(subscription.counters)
        cpu_us = 1e6 * (time.process_time() - began) / max(1, len(latencies))
    return {"latencies": latencies, "seconds": (last - first) * 1e-9, "counters": lost, "cpu_us": cpu_us}


def _hear_raw(endpoint: str, count: int) -> dict[str, object]:
    import zenoh

    latencies: list[float] = []
    moments: list[int] = []
    all_there = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        now = time.time_ns()
        latencies.append((now - struct.unpack_from("<q", sample.payload.to_bytes())[0]) * 1e-6)
        moments.append(now)
        if len(moments) >= count:
            all_there.set()

    with zenoh.open(_config(listen=endpoint)) as session, session.declare_subscriber(KEY, take):
        print("ready", flush=True)
        last_count, began = -1, time.process_time()
        while not all_there.wait(_QUIET_S):
            if len(moments) == last_count and last_count > 0:
                break
            last_count = len(moments)
        cpu_us = 1e6 * (time.process_time() - began) / len(moments)
    return {"latencies": latencies, "seconds": (moments[-1] - moments[0]) * 1e-9, "counters": {}, "cpu_us": cpu_us}


def _config(listen: str = "", connect: str = "") -> object:
    import zenoh

    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([listen] if listen else []))
    config.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return config


def _paced(send: Callable[[int], None], count: int, rate: float) -> None:
    began = time.monotonic()
    for number in range(count):
        if rate:
            time.sleep(max(0.0, began + number / rate - time.monotonic()))
        send(number)


def _say_ours(endpoint: str, count: int, rate: float) -> None:
    items = messages(500)
    with open_bus("local", BusConfig(connect=(endpoint,)), timeout_s=10.0) as bus:
        publisher = bus.publisher(OBSERVATION, "cam0", rate_hz=rate or _RATE, block=True)
        publisher.wait_matched(10.0)
        time.sleep(0.3)

        def send(number: int) -> None:
            item = items[number % len(items)]
            item.sequence = item.frame = number
            item.device_time_ns = time.time_ns()
            publisher.put(item)

        _paced(send, count, rate)
        sys.stdin.read()


def _say_raw(endpoint: str, count: int, rate: float) -> None:
    import zenoh

    payloads = [encode(item)[8:] for item in messages(500)]
    with (
        zenoh.open(_config(connect=endpoint)) as session,
        session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK) as publisher,
    ):
        while not publisher.matching_status.matching:
            time.sleep(0.005)
        time.sleep(0.3)
        _paced(lambda k: publisher.put(struct.pack("<q", time.time_ns()) + payloads[k % 500]), count, rate)
        sys.stdin.read()


def run(kind: str, count: int, rate: float) -> tuple[list[float], float, dict[str, int], float]:
    """Latencies [ms], messages a second, the receiver's counters, and its CPU [µs] a message."""
    endpoint = free_endpoint()

    def start(role: str) -> subprocess.Popen[str]:
        words = ["--role", role, "--kind", kind, "--endpoint", endpoint, "--count", str(count), "--rate", str(rate)]
        command = [sys.executable, "-m", "tests.bench.speed.bus", *words]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY)

    hearing, saying = start("hear"), None
    try:
        assert hearing.stdout is not None
        hearing.stdout.readline()
        saying = start("say")
        found = json.loads(hearing.stdout.readline())
    finally:
        for process in (hearing, saying):
            if process is not None:
                process.kill()
                process.communicate()
    rate = (len(found["latencies"]) - 1) / max(found["seconds"], 1e-9)
    return sorted(found["latencies"]), rate, found["counters"], found["cpu_us"]


def _gate_s() -> float:
    """CPU seconds of one message through the gate, the best of twenty passes over 500."""
    payloads = [encode(item) for item in messages(500)]
    return interleaved({"gate": lambda: admit_all([KEY] * len(payloads), payloads)}, 20)["gate"] / len(payloads)


def measure(quick: bool, data: Path) -> Section:
    """Latency and throughput, the better of two interleaved rounds."""
    del data
    paced, flood = (2000, 20_000) if quick else (10_000, 100_000)
    rounds = 2 if quick else 4
    best: dict[str, tuple[float, float]] = {}
    rates: dict[str, float] = {"ours": 0.0, "raw": 0.0}
    spent = dict.fromkeys(rates, float("inf"))
    notes = ""
    for _ in range(rounds):
        for kind in rates:
            spread, *_ = run(kind, paced, _RATE)
            warm = (spread[len(spread) // 2], spread[int(0.99 * len(spread))])
            best[kind] = min(best.get(kind, warm), warm)
            _, rate, counters, cpu_us = run(kind, flood, 0.0)
            spent[kind] = min(spent[kind], cpu_us)
            rates[kind] = max(rates[kind], rate)
            if kind == "ours" and counters.get("lost", 0) + counters.get("dropped", 0):
                notes = f"lost {counters['lost']}, dropped {counters['dropped']} of {flood}"
    beside = "raw Zenoh, the same bytes"
    work = "edge → hub, two processes"
    return Section(
        [
            Row(f"{work}, 1,000 msg/s: p50", best["ours"][0], "ms", beside, best["raw"][0],
                must=Limit("ratio", 0.5), reach=Limit("ratio", 1 / 1.2)),
            Row(f"{work}, 1,000 msg/s: p99", best["ours"][1], "ms", beside, best["raw"][1]),
            Row("gate, all rules on, four detections", 1.0 / _gate_s(), "msg/s", beside, rates["raw"], less=False,
                must=Limit("ratio", 0.3), reach=Limit("ratio", 0.7),
                note="CPU of one process; raw Zenoh's is wall clock of two"),
            Row(f"{work}: throughput", rates["ours"], "msg/s", beside, rates["raw"], less=False,
                must=Limit("ratio", 0.3), reach=Limit("ratio", 0.7), note=notes),
            Row(f"{work}: the receiver's CPU a message", spent["ours"], "µs", beside, spent["raw"]),
        ]
    )  # fmt: skip


def main() -> None:
    """One process of the bench."""
    parser = argparse.ArgumentParser(description="One side of the bench of the bus.")
    parser.add_argument("--role", choices=("hear", "say"), required=True)
    parser.add_argument("--kind", choices=("ours", "raw"), required=True)
    parser.add_argument("--endpoint", required=True)
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--rate", type=float, default=0.0)
    words = parser.parse_args()
    if words.role == "hear":
        hear = _hear_ours if words.kind == "ours" else _hear_raw
        print(json.dumps(hear(words.endpoint, words.count)), flush=True)
    else:
        (_say_ours if words.kind == "ours" else _say_raw)(words.endpoint, words.count, words.rate)


if __name__ == "__main__":
    main()
