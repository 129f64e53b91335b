"""Real processes: the memory of an agent and of a hub with 100 cameras, `--help`, and an agent's first frame."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.topics import OBSERVATION, STATUS
from tests.bench.load import resident_mb
from tests.bench.real_rigs import REPOSITORY
from tests.bench.speed.rows import Limit, Row, Section
from tests.bench.view import help_s

_TOO_LONG_S = 60.0


def _start(stack: ExitStack, *words: str, stdin: int | None = None) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, "-m", *words], cwd=REPOSITORY, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )

    def end() -> None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    stack.callback(end)
    return process


def first_frame(endpoint: str, file: Path) -> tuple[float, subprocess.Popen[bytes], ExitStack]:
    """Seconds from the agent's start to its first observation on the bus; the agent runs on."""
    stack = ExitStack()
    bus = stack.enter_context(open_bus("local", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0))
    received = bus.subscribe(OBSERVATION, "cam0")
    began = time.monotonic()
    agent = _start(stack, "deploy", "camera", str(file))
    while not received.wait(0.5):
        if agent.poll() is not None or time.monotonic() - began > _TOO_LONG_S:
            stack.close()
            raise RuntimeError("the agent said nothing")
    return time.monotonic() - began, agent, stack


def measure(quick: bool, data: Path) -> Section:
    """Wall seconds of starts (the best of some), resident memory after some seconds of work."""
    del data
    found = Section()
    wall, cpu = help_s(3 if quick else 10)
    found.rows.append(
        Row("start: `syncline --help`, wall", wall, "s", must=Limit("ours", 0.3), note=f"{cpu:.2f} s of CPU")
    )
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, endpoint = Path(name), free_endpoint()
        bus = f'[bus]\nmode = "client"\nconnect = ["{endpoint}"]\noutage_s = 10.0\n'
        (folder / "cam0.toml").write_text(f'id = "cam0"\n{bus}[simulated]\ncameras = 2\n', encoding="utf-8")
        (folder / "hub.toml").write_text(f'id = "hub"\n{bus}', encoding="utf-8")
        stack.enter_context(Router(endpoint))
        best = float("inf")
        for last in (False, True) if quick else (False, False, False, True):
            seconds, agent, running = first_frame(endpoint, folder / "cam0.toml")
            best = min(best, seconds)
            if not last:
                running.close()
        found.rows.append(Row("start: agent to first frame on the bus, wall", best, "s", must=Limit("ours", 2.0)))
        stack.enter_context(running)
        with open_bus("local", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as observer:
            statuses = observer.subscribe(STATUS, "hub")
            hub = _start(stack, "deploy", "hub", str(folder / "hub.toml"))
            if not statuses.wait(_TOO_LONG_S):
                raise RuntimeError("the hub said nothing")
        seconds = 8.0 if quick else 60.0
        words = ["--endpoint", endpoint, "--cameras", "100", "--rate", "500", "--seconds", str(seconds)]
        feed = _start(stack, "tests.bench.load", "--role", "feed", *words, stdin=subprocess.PIPE)
        assert feed.stdout is not None
        feed.stdout.readline()
        most = {"agent": 0.0, "hub": 0.0}
        began = time.monotonic()
        while time.monotonic() - began < seconds:
            most["agent"] = max(most["agent"], resident_mb(agent.pid))
            most["hub"] = max(most["hub"], resident_mb(hub.pid))
            time.sleep(0.5)
        feed.kill()
    found.rows += [
        Row("memory: camera agent (simulated camera)", most["agent"], "MB", must=Limit("ours", 150.0),
            reach=Limit("ours", 75.0)),
        Row("memory: hub with 100 cameras at 5 obs/s", most["hub"], "MB", must=Limit("ours", 400.0),
            reach=Limit("ours", 200.0), note=f"most within {seconds:.0f} s"),
    ]  # fmt: skip
    return found
