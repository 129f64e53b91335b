"""Hostile cameras against a running hub: its memory, the longest silence of its status, the others' answer.

    python -m tests.faults.floods [--seconds 30] [--only NAME]

A router, a hub and three simulated cameras run as processes; once these are calibrated, a hostile camera joins
over a session of its own. Its messages pass the gate: what is measured is what the hub does with them.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

from protocols.bus.router.zenoh_router import free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.session import open_session
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, STATUS
from tests.bench.load import resident_mb
from tests.faults.processes import Process, router
from tests.faults.soak import configurations

Messages = Iterator[tuple[float, pb.Observation | pb.CameraInfo | pb.AgentStatus]]
"""(pause before it [s], message)"""


def frame(camera: str, number: int, points: int, boot: str = "b0", period_ns: int = 33_000_000) -> pb.Observation:
    """One frame of moving, labelled points."""
    message = pb.Observation(schema_version=1, camera=camera, boot_id=boot, sequence=number, frame=number)
    message.device_time_ns = 1 + number * period_ns
    for index in range(points):
        message.detections.add(u=(7.0 * number + index) % 640, v=index % 480, score=0.5, size=9.0, label=f"p{index}")
    return message


def info(camera: str, boot: str = "b0", **fields: float) -> pb.CameraInfo:
    """An uncalibrated camera, if nothing else is said."""
    return pb.CameraInfo(schema_version=1, camera=camera, boot_id=boot, width=640, height=480, fps=30.0, **fields)  # type: ignore[arg-type]


def crawling_clock() -> Messages:
    """4,096 labelled detections a frame on a clock that advances by 1 ns."""
    yield 0.0, info("evil")
    for number in itertools.count():
        yield 1 / 30.0, frame("evil", number, 4096, period_ns=1)


def people() -> Messages:
    """1,000 people a frame."""
    yield 0.0, info("evil")
    for number in itertools.count():
        message = frame("evil", number, 1000)
        for index, detection in enumerate(message.detections):
            detection.label, detection.kind, detection.size = "", "person", 60.0
            detection.head.extend([detection.u, detection.v])
            detection.foot.extend([detection.u, detection.v + 60.0])
            detection.colour.red = index % 256
        yield 1 / 30.0, message


def labels() -> Messages:
    """Each label once: 200 new ones in every frame."""
    yield 0.0, info("evil")
    for number in itertools.count():
        message = frame("evil", number, 200)
        for index, detection in enumerate(message.detections):
            detection.label = f"n{200 * number + index}"
        yield 1 / 100.0, message


def boots() -> Messages:
    """A new run with every frame."""
    for number in itertools.count():
        yield 1 / 500.0, info("evil", f"b{number}")
        yield 0.0, frame("evil", 0, 3, f"b{number}")


def names() -> Messages:
    """A new camera with every frame."""
    for number in itertools.count():
        yield 1 / 500.0, info(f"evil{number}")
        yield 0.0, frame(f"evil{number}", 0, 3)


def as_fast_as_it_goes() -> Messages:
    """Small frames without a pause."""
    yield 0.0, info("evil")
    for number in itertools.count():
        yield 0.0, frame("evil", number, 1, period_ns=1_000_000)


def clock_steps() -> Messages:
    """A clock that is set by an hour, back and forth."""
    yield 0.0, info("evil")
    for number in itertools.count():
        message = frame("evil", number, 3)
        message.device_time_ns += 3_600 * 10**9 * (number // 20 % 2)
        yield 1 / 100.0, message


def lens() -> Messages:
    """The largest distortions and nominal rate that pass the gate."""
    matrix = [1.0, 1e7, -1e7, 0.0, 1.0, 1e7, 0.0, 0.0, 1.0]
    for number in itertools.count():
        if number % 100 == 0:
            message = info("evil", matrix=matrix, distortions=[1e9, -1e9, 1e9, -1e9, 1e9])  # type: ignore[arg-type]
            message.fps = 100_000.0
            yield 0.0, message
        yield 1 / 30.0, frame("evil", number, 1)


def several() -> Messages:
    """Twenty cameras together, 400 labelled detections a frame each."""
    for name in range(20):
        yield 0.0, info(f"evil{name}")
    for number in itertools.count():
        yield 1 / 1200.0, frame(f"evil{number % 20}", number // 20, 400)


def statuses() -> Messages:
    """Statuses of invented agents, whose clocks cannot be."""
    for number in itertools.count():
        message = pb.AgentStatus(schema_version=1, agent=f"evil{number}", role="camera", boot_id="b0", state="running")
        for name in ("clock_synchronised", "unix_minus_camera_s", "clock_error_s"):
            message.gauges[name] = 1e308
        yield 1 / 1000.0, message


_PEACE_S = 120.0
"""Longest wait for the first calibration."""
ATTACKS: dict[str, Callable[[], Messages]] = {
    one.__name__: one
    for one in (crawling_clock, people, labels, boots, names, as_fast_as_it_goes, clock_steps, lens, several, statuses)
}


def attack(endpoint: str, name: str) -> None:
    """The hostile process: until it is killed."""
    session = open_session(BusConfig(mode="client", connect=(endpoint,)))
    for pause, message in ATTACKS[name]():
        if pause:
            time.sleep(pause)
        if isinstance(message, pb.AgentStatus):
            key = STATUS.key_for("local", message.agent)
        else:
            topic = CAMERA_INFO if isinstance(message, pb.CameraInfo) else OBSERVATION
            key = topic.key_for("local", message.camera)
        session.put(key, message.SerializeToString())


def family(pid: int) -> list[int]:
    """A process and those below it."""
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [pid, *(below for child in listed.stdout.split() for below in family(int(child)))]


def measure(name: str, seconds: float) -> str:
    """A row of the table, of an attack of so many seconds."""
    with tempfile.TemporaryDirectory() as folder_name, ExitStack() as stack:
        folder, endpoint = Path(folder_name), free_endpoint()
        stack.enter_context(router(folder, endpoint))
        processes = {
            agent: stack.enter_context(Process("-m", "deploy", command, str(file), stderr=folder / f"{agent}.txt"))
            for agent, (command, file) in configurations(folder, endpoint, 3).items()
            if agent != "recorder"
        }
        bus = stack.enter_context(open_bus("local", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0))
        statuses, answers = bus.subscribe(STATUS), bus.subscribe(CALIBRATION)
        hub = processes["hub"].child
        silence = peak = solver_peak = 0.0
        calibrated: set[str] = set()
        text, last = "", time.monotonic()
        evil: Process | None = None
        end = time.monotonic() + _PEACE_S
        while time.monotonic() < end:
            if evil is None and len(calibrated) == 3:
                evil = stack.enter_context(Process("-m", "tests.faults.floods", "--attack", endpoint, name))
                last, end = time.monotonic(), time.monotonic() + seconds
                calibrated = set()
            statuses.wait(0.05)
            if hub.poll() is not None:
                return f"| {name} | ENDED with status {hub.poll()} | | | | {(folder / 'hub.txt').read_text()[-300:]} |"
            for received in statuses.drain():
                if received.agent == "hub":
                    if evil is not None:
                        silence = max(silence, time.monotonic() - last)
                    last, text = time.monotonic(), received.message.message  # type: ignore[attr-defined]
            for received in answers.drain():
                calibrated = {one.camera for one in received.message.cameras} or calibrated  # type: ignore[attr-defined]
            if evil is not None:
                own, *below = family(hub.pid)
                peak = max(peak, resident_mb(own))
                with_solver = [resident_mb(pid) for pid in below if Path(f"/proc/{pid}/statm").exists()]
                solver_peak = max([solver_peak, *with_solver])
        silence = max(silence, time.monotonic() - last)
        good = len(calibrated & {"cam0", "cam1", "cam2"})
        return f"| {name} | {peak:.0f} | {solver_peak:.0f} | {silence:.1f} | {good} of 3 | {text[:110]} |"


def main() -> None:
    """Run all and print the table."""
    parser = argparse.ArgumentParser(description="Hostile cameras against a running hub.")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--only", choices=list(ATTACKS))
    parser.add_argument("--attack", nargs=2, metavar=("ENDPOINT", "NAME"))
    words = parser.parse_args()
    if words.attack:
        attack(*words.attack)
        sys.exit()
    print(
        "| attack | hub [MB] | its solver [MB] | longest silence [s] | calibrated | status |\n|---|---|---|---|---|---|"
    )
    for name in [words.only] if words.only else ATTACKS:
        print(measure(name, words.seconds), flush=True)


if __name__ == "__main__":
    main()
