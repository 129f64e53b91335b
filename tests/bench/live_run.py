"""A hub's process, a process that plays a log to it, and a listener that keeps what the hub publishes.

`python -m tests.bench.live_run ENDPOINT LOG STAMPS SECONDS` is the player: `replay` of a log at its own pace, with the
moment at which each message was published.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tomli_w

from deploy.logs.replay import replay
from protocols.bus.base import Bus, Subscription
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, STATUS, TRACK, TRACK_SMOOTHED

REPOSITORY = Path(__file__).resolve().parents[2]
_SITE, _HUB = "bench", "hub"
_START_S, _STOP_S, _LATE_S = 60.0, 10.0, 60.0
_CPU_EVERY_S = 0.5
_AFTERWARDS_S = 1.0  # listened to after the last frame


class RunFailed(Exception):
    """A process ended, or did not start in time."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Frames in the order in which they were published: camera (n,), camera time (n,) [s], arrival (n,) [s]."""

    camera: list[str] = field(default_factory=list)
    time: Floats = field(default_factory=lambda: np.zeros(0))
    arrival: Floats = field(default_factory=lambda: np.zeros(0))


@dataclass(slots=True, eq=False)
class Heard:
    """What the hub published while the log was played; seconds since the first frame was published, unless said.

    calibrations, tracks, smoothed: with the moment of their arrival. statuses: arrivals. cpu: CPU seconds of the hub
    and its children since their start, with the moment. ended: when listening ended.
    """

    rows: Rows = field(default_factory=Rows)
    calibrations: list[tuple[float, pb.Calibration]] = field(default_factory=list)
    tracks: list[tuple[float, pb.Track]] = field(default_factory=list)
    smoothed: list[tuple[float, pb.Track]] = field(default_factory=list)
    statuses: list[float] = field(default_factory=list)
    cpu: list[tuple[float, float]] = field(default_factory=list)
    ended: float = 0.0


def run_live(log: Path, folder: Path, seconds: float, refine_lenses: bool) -> Heard:
    """Play at most ``seconds`` of a log to a new hub and listen. Raises RunFailed.

    folder: for the configuration and what the processes print. refine_lenses: the hub's setting.
    """
    endpoint = free_endpoint()
    bus_table = {"mode": "client", "connect": [endpoint]}
    config, stamps = folder / "hub.toml", folder / "stamps.npy"
    table = {"id": _HUB, "site": _SITE, "state": "state", "refine_lenses": refine_lenses, "bus": bus_table}
    config.write_text(tomli_w.dumps(table), encoding="utf-8")
    with Router(endpoint), open_bus(_SITE, BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        listener = _Listener(bus)
        with _process(["deploy", "hub", str(config)], folder / "hub.txt") as hub:
            listener.listen(hub.pid, lambda: bool(listener.heard.statuses), _START_S, (hub, folder / "hub.txt"))
            words = ["tests.bench.live_run", endpoint, str(log), str(stamps), repr(seconds)]
            with _process(words, folder / "player.txt") as player:
                summary = LogReader(log).summary()
                limit = _START_S + _LATE_S + min(seconds, (summary.last_ns - summary.first_ns) / NANOSECONDS)
                done = lambda: player.poll() is not None  # noqa: E731
                listener.listen(hub.pid, done, limit, (hub, folder / "hub.txt"))
                if player.returncode:
                    raise RunFailed(f"the player: {_last_line(folder / 'player.txt')}")
            until = time.monotonic() + _AFTERWARDS_S
            listener.listen(hub.pid, lambda: time.monotonic() > until, 2.0 * _AFTERWARDS_S, (hub, folder / "hub.txt"))
    return _since_first_frame(listener.heard, log, np.load(stamps))


class _Listener:
    """Keeps the hub's messages with their arrival on the monotonic clock [s], and samples its CPU time."""

    def __init__(self, bus: Bus) -> None:
        self.heard = Heard()
        self._calibrations = bus.subscribe(CALIBRATION)
        self._tracks, self._smoothed = bus.subscribe(TRACK), bus.subscribe(TRACK_SMOOTHED)
        self._statuses = bus.subscribe(STATUS, _HUB)
        self._next_cpu = 0.0

    def listen(
        self, pid: int, done: Callable[[], bool], limit_s: float, watched: tuple[subprocess.Popen[bytes], Path]
    ) -> None:
        """Listen until ``done``. Raises RunFailed after ``limit_s``, or if the hub ends."""
        deadline = time.monotonic() + limit_s
        while not done():
            if watched[0].poll() is not None:
                raise RunFailed(f"the hub ended with status {watched[0].returncode}: {_last_line(watched[1])}")
            if time.monotonic() > deadline:
                raise RunFailed(f"not done after {limit_s:.0f} s")
            self._tracks.wait(0.05)
            self._drain()
            if time.monotonic() >= self._next_cpu:
                self._next_cpu = time.monotonic() + _CPU_EVERY_S
                self.heard.cpu.append((time.monotonic(), session_cpu_s(pid)))
        self.heard.ended = time.monotonic()

    def _drain(self) -> None:
        unix = time.time() - time.monotonic()

        def arrived(subscription: Subscription) -> Iterator[tuple[float, object]]:
            for received in subscription.drain():
                yield received.arrival_ns / NANOSECONDS - unix, received.message

        self.heard.statuses += [at for at, _ in arrived(self._statuses)]
        for at, message in arrived(self._calibrations):
            assert isinstance(message, pb.Calibration)
            self.heard.calibrations.append((at, message))
        for source, kept in ((self._tracks, self.heard.tracks), (self._smoothed, self.heard.smoothed)):
            for at, message in arrived(source):
                assert isinstance(message, pb.Track)
                kept.append((at, message))


def session_cpu_s(session: int) -> float:
    """CPU seconds of all processes of a session (a process that began one and its descendants), also of those ended."""
    ticks = 0
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = file.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except OSError:
            continue  # it has just ended
        if int(fields[3]) == session:
            ticks += sum(int(value) for value in fields[11:15])
    return ticks / os.sysconf("SC_CLK_TCK")


@contextmanager
def _process(module: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A Python module in a session of its own, which ends with all its children when the block does."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *module],
            stdout=output,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=environment,
            cwd=REPOSITORY,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            with suppress(subprocess.TimeoutExpired):
                process.wait(_STOP_S)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _last_line(file: Path) -> str:
    lines = file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "no output"


def _since_first_frame(heard: Heard, log: Path, stamps: Floats) -> Heard:
    """The same with times since the first frame was published, and with the frames."""
    cameras, times, arrivals = list[str](), list[float](), list[float]()
    for logged, at in zip(LogReader(log).messages(), stamps.tolist(), strict=False):
        if isinstance(logged.message, pb.Observation):
            cameras.append(logged.message.camera)
            times.append(logged.message.device_time_ns / NANOSECONDS)
            arrivals.append(at)
    if not arrivals:
        raise RunFailed("no frame was played")
    zero = arrivals[0]
    return Heard(
        Rows(cameras, np.array(times), np.array(arrivals) - zero),
        [(at - zero, message) for at, message in heard.calibrations],
        [(at - zero, message) for at, message in heard.tracks],
        [(at - zero, message) for at, message in heard.smoothed],
        [at - zero for at in heard.statuses],
        [(at - zero, spent) for at, spent in heard.cpu],
        heard.ended - zero,
    )


def play(endpoint: str, log: Path, stamps: Path, seconds: float) -> None:
    """Publish a log at its own pace; write when each message was published, on the monotonic clock [s]."""
    published: list[float] = []
    stop = threading.Event()

    def stamp(count: int, at: float) -> None:
        published.append(time.monotonic())
        if at >= seconds:
            stop.set()

    with open_bus(_SITE, BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        replay(log, bus, stop=stop, wait_s=2.0, progress=stamp)
    np.save(stamps, np.array(published))


if __name__ == "__main__":
    play(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]))
