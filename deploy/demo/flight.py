"""`demo --scene town`: UAV agent and recorder as processes; a ground station selects a car; then the truth."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from deploy.agents.signals import Interruption, interrupt_on_signals
from deploy.config.uav import FlightConfig
from deploy.demo.flight_outcome import LOG, REPORT, Outcome, as_json, compare, compare_geo
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError, Refused
from protocols.core.files import check_folder, write_atomically
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TARGET

if TYPE_CHECKING:
    from edge.mavlink.roles.station import Station
    from edge.uav.world.world import World

RESULT = "result.json"
AGENT = "drone"
_MINE = ("config", "logs", LOG, RESULT, REPORT)
_STARTING_S, _SELECTING_S, _STOPPING_S = 60.0, 60.0, 40.0
_SPARE_S = 150.0  # of the world's time beyond what is shown: for starting and selecting
_GEO = "CAMERA_TRACKING_GEO_STATUS"


@dataclass(slots=True)
class Progress:
    """What is shown while it runs."""

    elapsed: float = 0.0
    line: str = "starting"
    states: Counter[str] = field(default_factory=Counter)
    frames: int = 0


def run_town(
    out: Path,
    seconds: float,
    seed: int,
    show: Callable[[Progress], None],
    *,
    view_port: int | None = None,
    viewed: Callable[[str], None] = lambda address: None,
) -> Outcome:
    """Fly, follow, compare. Raises Refused if an agent dies or does not come up, InputError for a bad --out.

    view_port: of a live view beside it; None = none, 0 = any free one. viewed: is told the address to open.
    """
    from deploy.demo.flight_report import write_report
    from edge.mavlink.roles.station import Station
    from edge.uav.world.patrol import patrol

    out = out.resolve()
    _clean(out)
    endpoint, port = free_endpoint(), _free_port()
    progress = Progress()
    show(progress)
    interrupted = interrupt_on_signals()
    world = patrol(seed, seconds + _SPARE_S)
    epoch = time.time()
    processes = _Processes(out, _configs(out, endpoint, port, seconds, seed, epoch), interrupted)
    with Router(endpoint), open_bus("demo", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        targets = bus.subscribe(TARGET)
        station = Station(f"udpout:127.0.0.1:{port}")
        try:
            if view_port is not None:
                viewed(processes.open_view(endpoint, view_port))
            processes.start("recorder", "record")
            processes.start(AGENT, "uav")
            _wait_for_camera(station, processes, progress, show)
            # A busy machine takes its time to start: the world goes on meanwhile.
            _select(station, processes, world, epoch, progress, show)
            began = time.monotonic()
            told_geo: list[tuple[float, float, float, float]] = []
            while (elapsed := time.monotonic() - began) < seconds:
                heard = station.counts.get(_GEO, 0)
                station.poll(0.05)
                if interrupted.is_set():
                    raise KeyboardInterrupt
                if station.told is not None and station.told.geo is not None and station.counts.get(_GEO, 0) > heard:
                    told_geo.append((time.time() - epoch, *station.told.geo))
                for received in targets.drain():
                    assert isinstance(received.message, pb.TargetState)
                    progress.frames += 1
                    progress.states[received.message.state] += 1
                progress.elapsed = elapsed
                progress.line = _line(station)
                processes.check()
                show(progress)
            station.stop()
            station.poll(0.2)
            progress.line = "stopping"
            show(progress)
            statuses = sum(count for kind, count in station.counts.items() if "TRACKING" in kind)
            processes.stop(AGENT)
            processes.stop("recorder")
        finally:
            station.close()
            processes.kill()
    near, median = compare_geo(told_geo, world)
    outcome = replace(compare(out / LOG, world, FlightConfig().boot_s, statuses), geo_near=near, geo_median_m=median)
    write_atomically(out / RESULT, as_json(outcome) + "\n")
    write_report(out / REPORT, out / LOG, outcome, world)
    return outcome


def _wait_for_camera(
    station: Station, processes: _Processes, progress: Progress, show: Callable[[Progress], None]
) -> None:
    deadline = time.monotonic() + _STARTING_S
    while station.information is None:
        station.poll(0.1)
        processes.check()
        progress.line = "waiting for the camera's heartbeat" if not station.camera_seen else "asking what it can do"
        show(progress)
        if time.monotonic() > deadline:
            raise Refused(f"the camera was not heard within {_STARTING_S:.0f} s; see {processes.folder}")


def _select(
    station: Station,
    processes: _Processes,
    world: World,
    epoch: float,
    progress: Progress,
    show: Callable[[Progress], None],
) -> None:
    """Draw the box round the car, as an operator would who sees it."""
    deadline = time.monotonic() + _SELECTING_S
    width, height = world.size
    while True:
        frame = round((time.time() - epoch) * world.fps)
        if frame >= world.length:
            raise Refused("the flight ended before a target was selected: the machine is too busy")
        truth = world.truth(frame)
        soon = world.truth(min(frame + 60, world.length - 1))
        if truth.visible > 0.95 and soon.visible > 0.9:
            box = truth.box
            station.select(
                (box.x + 0.5) / width,
                (box.y + 0.5) / height,
                (box.x + 0.5 + box.width) / width,
                (box.y + 0.5 + box.height) / height,
            )
            until = time.monotonic() + 4.0
            while station.selected is None and time.monotonic() < until:
                station.poll(0.05)
            if station.selected:
                return
        station.poll(0.05)
        processes.check()
        progress.line = "waiting until the car is in the picture"
        show(progress)
        if time.monotonic() > deadline:
            raise Refused(f"no selection was accepted within {_SELECTING_S:.0f} s; see {processes.folder}")


def _line(station: Station) -> str:
    told = station.told
    if told is None:
        return "no status yet"
    text = told.state
    if np.isfinite(told.box).all():
        text += "  box " + " ".join(f"{value:.3f}" for value in told.box)
    if told.geo is not None:
        text += f"  {told.geo[0]:.6f} {told.geo[1]:.6f} +-{told.geo[2]:.1f} m"
    return text


class _Processes:
    """The agents, each from its configuration file."""

    def __init__(self, out: Path, configs: dict[str, Path], interrupted: Interruption) -> None:
        self.folder = out / "logs"
        self._configs = configs
        self._interrupted = interrupted
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, role: str) -> None:
        self._run(name, [role, str(self._configs[name])])

    def open_view(self, endpoint: str, port: int) -> str:
        """Start the live view; the address to open."""
        self._run("view", ["view", "--connect", endpoint, "--site", "demo", "--port", str(port)])
        deadline = time.monotonic() + _STARTING_S
        while time.monotonic() < deadline and self._running["view"].poll() is None:
            for line in (self.folder / "view.txt").read_text(encoding="utf-8").splitlines():
                if line.startswith("open http") and len(line.split()) > 1:
                    return line.split()[1]
            time.sleep(0.05)
        raise Refused(f"the view did not start: {self._last_line('view')}")

    def _run(self, name: str, words: list[str]) -> None:
        with (self.folder / f"{name}.txt").open("wb") as log, self._interrupted.held():
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", "deploy", *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            )

    def stop(self, name: str) -> None:
        process = self._running[name]
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            status = process.wait(_STOPPING_S)
        except subprocess.TimeoutExpired:
            raise Refused(f"{name} did not stop within {_STOPPING_S:.0f} s; see {self.folder}/{name}.txt") from None
        if status != 0:
            raise Refused(f"{name} ended with status {status}: {self._last_line(name)}")

    def check(self) -> None:
        for name, process in self._running.items():
            if process.poll() is not None:
                raise Refused(f"{name} ended with status {process.returncode}: {self._last_line(name)}")

    def kill(self) -> None:
        for process in self._running.values():
            if process.poll() is None:
                process.kill()
                process.wait()

    def _last_line(self, name: str) -> str:
        lines = (self.folder / f"{name}.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


def _configs(out: Path, endpoint: str, port: int, seconds: float, seed: int, epoch: float) -> dict[str, Path]:
    """One configuration file an agent, as a user would write it."""
    bus = {"mode": "client", "connect": [endpoint]}
    tables: dict[str, dict[str, Any]] = {
        "recorder": {"id": "recorder", "site": "demo", "out": str(out / LOG), "bus": bus},
        AGENT: {
            "id": AGENT,
            "site": "demo",
            "driver": "simulated",
            "bus": bus,
            "simulated": {
                "autopilot": f"127.0.0.1:{port}",
                "seed": seed,
                "seconds": seconds + _SPARE_S,
                "start_unix_s": epoch,
            },
            "mavlink": {"url": f"udpout:127.0.0.1:{port}"},
            "video_out": {"listen": "127.0.0.1:0"},
            "images": {},
        },
    }
    files = {}
    for name, table in tables.items():
        files[name] = out / "config" / f"{name}.toml"
        files[name].write_text(tomli_w.dumps(table), encoding="utf-8")
    return files


def _clean(out: Path) -> None:
    """Make the folder, taking away only what an earlier demo wrote."""
    check_folder(out)
    try:
        for name in _MINE:
            path = out / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        (out / "config").mkdir(parents=True)
        (out / "logs").mkdir()
    except OSError as error:
        raise InputError(f"cannot be made: {error.strerror}", file=out, remedy="choose another --out") from None


def _free_port() -> int:
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
