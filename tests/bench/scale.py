"""Past one machine: how many hubs and routers 10,000 cameras need, from measured costs, and a run that checks them.

    python -m tests.bench.scale [--hubs 4] [--cameras 250] [--hz 5] [--seconds 12] [--quick]

Each hub is a process of its own with a site of its own (``syncline/<site>/…``), each with light agents that put real
observations over ten sessions; one router, a process too, carries them all. Two runs with one hub, a quarter of its
cameras and all, give what a hub and a router cost when nothing comes and for each observation; the run with all hubs
shows whether what that says of it holds. One machine stands in for many: feeders, hubs and router share its cores.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocols.bus.router.zenoh_router import Router, free_endpoint
from tests.bench.load import resident_mb
from tests.bench.options import bench_parser
from tests.bench.real_rigs import REPOSITORY

_ASKED = 10_000
_SHARE = 0.5
"""Of a core that may be used: the rest is for solving, and for when much happens at once."""
_ROUTER_CORES = 2.0
_SESSIONS = 1000
"""Others connected to one router: ``max_sessions`` of its configuration."""


@dataclass(frozen=True, slots=True)
class Load:
    """A run. hub_us, router_us: CPU an observation. hub_share, router_share: of a core, the busiest hub's."""

    hubs: int
    cameras: int
    rate: float
    received: int
    lost: int
    p50_ms: float
    p99_ms: float
    hub_us: float
    router_us: float
    hub_share: float
    router_share: float
    hub_mb: float
    router_mb: float


def _cpu_s(pid: int) -> float:
    """CPU seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _start(stack: ExitStack, *words: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY
    )

    def end() -> None:
        process.kill()
        process.communicate()

    stack.callback(end)
    return process


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


def run(hubs: int, cameras: int, hz: float, seconds: float) -> Load:
    """cameras: of each hub."""
    endpoint = free_endpoint()
    sites = [f"site{number}" for number in range(hubs)]
    with ExitStack() as stack:
        router = _start(stack, "tests.bench.scale", "--role", "router", "--endpoint", endpoint)
        _line(router)
        hearing = [
            _start(stack, "tests.bench.load", "--role", "hub", "--endpoint", endpoint, "--site", site) for site in sites
        ]
        for process in hearing:
            _line(process)
        words = ["--cameras", str(cameras), "--rate", str(cameras * hz), "--seconds", str(seconds + 4.0)]
        feeding = [
            _start(stack, "tests.bench.load", "--role", "feed", "--endpoint", endpoint, "--site", site, *words)
            for site in sites
        ]
        for process in feeding:
            _line(process)
        lines: dict[int, list[dict[str, Any]]] = {number: [] for number in range(hubs)}

        def read(number: int, process: subprocess.Popen[str]) -> None:
            while text := _line(process):
                lines[number].append(json.loads(text))

        for number, process in enumerate(hearing):
            threading.Thread(target=read, args=(number, process), daemon=True).start()
        time.sleep(2.0)  # joining is no part of the steady cost
        pids = [process.pid for process in hearing]
        begun = {number: len(lines[number]) for number in lines}
        before, router_before, began = [_cpu_s(pid) for pid in pids], _cpu_s(router.pid), time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - began
        spent = [_cpu_s(pid) - cpu for pid, cpu in zip(pids, before, strict=True)]
        router_spent = _cpu_s(router.pid) - router_before
        sizes = [resident_mb(pid) for pid in pids]
        router_mb = resident_mb(router.pid)
        parts = [list(lines[number])[begun[number] :] for number in lines]
    latencies = sorted(value for part in parts for line in part for value in line["latencies"])
    counts = [part[-1]["counters"] for part in parts if part]
    each = cameras * hz * took
    return Load(
        hubs, hubs * cameras, len(latencies) / took, sum(c["received"] for c in counts),
        sum(c["lost"] + c["dropped"] for c in counts),
        latencies[len(latencies) // 2], latencies[int(0.99 * len(latencies))],
        1e6 * sum(spent) / (hubs * each), 1e6 * router_spent / (hubs * each), max(spent) / took, router_spent / took,
        max(sizes), router_mb,
    )  # fmt: skip


def summary(load: Load) -> str:
    """One line of the table."""
    return (
        f"| {load.hubs} | {load.cameras:,} | {load.rate:,.0f} | {load.lost} | {load.p50_ms:.1f} / {load.p99_ms:.0f} | "
        f"{load.hub_us:.0f} | {100 * load.hub_share:.0f} % | {load.hub_mb:.0f} | {load.router_us:.0f} | "
        f"{100 * load.router_share:.0f} % | {load.router_mb:.0f} |"
    )


@dataclass(frozen=True, slots=True)
class Cost:
    """Of a process: share of a core when nothing comes, and CPU seconds an observation."""

    idle: float
    each_s: float

    @staticmethod
    def through(rate_a: float, share_a: float, rate_b: float, share_b: float) -> Cost:
        """The straight line through two runs; where the second shows no more than the first, all is per observation."""
        each = (share_b - share_a) / (rate_b - rate_a)
        if each <= 0.0:
            return Cost(0.0, share_b / rate_b)
        return Cost(max(share_a - each * rate_a, 0.0), each)

    def share(self, rate: float) -> float:
        """Of a core at so many observations a second."""
        return self.idle + self.each_s * rate

    def most(self, share: float) -> float:
        """Observations a second within a share of a core."""
        return (share - self.idle) / self.each_s

    def __str__(self) -> str:
        return f"{100 * self.idle:.1f} % of a core and {1e6 * self.each_s:.0f} µs an observation"


def needed(hub: Cost, router: Cost, hz: float, cameras: int = _ASKED) -> tuple[int, int, str]:
    """Hubs, routers, and what limits the routers: their CPU, or sessions (one a camera)."""
    hubs = math.ceil(cameras * hz / hub.most(_SHARE))
    by_cpu = math.ceil(cameras * hz / router.most(_SHARE * _ROUTER_CORES))
    by_sessions = math.ceil((cameras + hubs) / _SESSIONS)
    return hubs, max(by_cpu, by_sessions), "CPU" if by_cpu > by_sessions else "sessions"


def main() -> None:
    """Measure, report, check."""
    parser = bench_parser(__doc__, hubs=4, cameras=(250, "of each hub"), hz=5.0, seconds=12.0, quick=False, endpoint="")
    parser.add_argument("--role", choices=("router",))
    words = parser.parse_args()
    if words.role == "router":
        with Router(words.endpoint):
            print("ready", flush=True)
            sys.stdin.read()
        return
    seconds = 5.0 if words.quick else words.seconds
    small = run(1, words.cameras // 4, words.hz, seconds)
    head = "hubs | cameras | obs/s | lost | p50 / p99 ms | hub µs/obs | busiest hub | MB | router µs/obs | router | MB"
    print(f"| {head} |\n|{'---|' * 11}")
    print(summary(small), flush=True)
    one = run(1, words.cameras, words.hz, seconds)
    print(summary(one), flush=True)
    large = run(words.hubs, words.cameras, words.hz, seconds)
    print(summary(large))
    hub = Cost.through(small.cameras * words.hz, small.hub_share, one.cameras * words.hz, one.hub_share)
    router = Cost.through(small.cameras * words.hz, small.router_share, one.cameras * words.hz, one.router_share)
    print(f"a hub: {hub}; a router: {router}")
    each, every = words.cameras * words.hz, large.cameras * words.hz
    print(
        f"said of the last run: a hub {100 * hub.share(each):.0f} % of a core, the router "
        f"{100 * router.share(every):.0f} %; measured {100 * large.hub_us * each * 1e-6:.0f} % and "
        f"{100 * large.router_share:.0f} %"
    )
    print(f"\n{_ASKED:,} cameras; a hub may use half of a core, a router half of {_ROUTER_CORES:.0f}:")
    for hz in (words.hz, 30.0):
        hubs, routers, why = needed(hub, router, hz)
        print(
            f"  {hz:g} observations/s each: {_ASKED * hz:,.0f} messages/s, {hubs} hubs of {math.ceil(_ASKED / hubs):,} "
            f"cameras, {routers} routers ({why})"
        )


if __name__ == "__main__":
    main()
