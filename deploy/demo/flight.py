"""`demo --scene town`: runs UAV agent and recorder, selects a car from a ground station, compares with ground truth."""

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
from deploy.config.uav import SimulatedFlightConfig
from deploy.demo.flight_outcome import (
    LOG,
    REPORT,
    FlightOutcome,
    as_json,
    compare_geo_positions,
    compare_log_with_world,
)
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError, Refused
from protocols.core.files import check_folder, write_atomically
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TARGET

if TYPE_CHECKING:
    from edge.mavlink.roles.station import GroundStation
    from edge.uav.world.flight_world import FlightWorld

RESULT = "result.json"
AGENT = "drone"
_OUTPUTS = ("config", "logs", LOG, RESULT, REPORT)
_START_TIMEOUT_S, _SELECT_TIMEOUT_S, _STOP_TIMEOUT_S = 60.0, 60.0, 40.0
_EXTRA_WORLD_S = 150.0  # world time beyond the shown duration, for starting and selecting
_GEO = "CAMERA_TRACKING_GEO_STATUS"


@dataclass(slots=True)
class FlightProgress:
    """Progress of the running flight demo."""

    elapsed: float = 0.0
    line: str = "starting"
    states: Counter[str] = field(default_factory=Counter)
    frames: int = 0


def run_town(
    out: Path,
    seconds: float,
    seed: int,
    show: Callable[[FlightProgress], None],
    *,
    view_port: int | None = None,
    on_view_address: Callable[[str], None] = lambda address: None,
) -> FlightOutcome:
    """Run the flight demo and compare. Raises Refused if an agent exits or does not start, InputError for a bad --out.

    view_port: port of a live view; None = no view, 0 = any free port. on_view_address: called with its address.
    """
    from deploy.demo.flight_report import write_report
    from edge.mavlink.roles.station import GroundStation
    from edge.uav.world.patrol import patrol_world

    out = out.resolve()
    _clean(out)
    endpoint, port = free_endpoint(), _free_port()
    progress = FlightProgress()
    show(progress)
    interrupted = interrupt_on_signals()
    world = patrol_world(seed, seconds + _EXTRA_WORLD_S)
    epoch = time.time()
    processes = _Processes(out, _configs(out, endpoint, port, seconds, seed, epoch), interrupted)
    with Router(endpoint), open_bus("demo", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        targets = bus.subscribe(TARGET)
        station = GroundStation(f"udpout:127.0.0.1:{port}")
        try:
            if view_port is not None:
                on_view_address(processes.open_view(endpoint, view_port))
            processes.start("recorder", "record")
            processes.start(AGENT, "uav")
            _wait_for_camera(station, processes, progress, show)
            # Starting may take long on a busy machine; world time continues meanwhile.
            _select(station, processes, world, epoch, progress, show)
            began = time.monotonic()
            reported_geo: list[tuple[float, float, float, float]] = []
            while (elapsed := time.monotonic() - began) < seconds:
                geo_count = station.counts.get(_GEO, 0)
                station.poll(0.05)
                if interrupted.is_set():
                    raise KeyboardInterrupt
                if (
                    station.report is not None
                    and station.report.geo is not None
                    and station.counts.get(_GEO, 0) > geo_count
                ):
                    reported_geo.append((time.time() - epoch, *station.report.geo))
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
    near, median = compare_geo_positions(reported_geo, world)
    outcome = replace(
        compare_log_with_world(out / LOG, world, SimulatedFlightConfig().boot_s, statuses),
        geo_near=near,
        geo_median_m=median,
    )
    write_atomically(out / RESULT, as_json(outcome) + "\n")
    write_report(out / REPORT, out / LOG, outcome, world)
    return outcome


def _wait_for_camera(
    station: GroundStation, processes: _Processes, progress: FlightProgress, show: Callable[[FlightProgress], None]
) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while station.information is None:
        station.poll(0.1)
        processes.check()
        progress.line = "waiting for the camera's heartbeat" if not station.camera_seen else "asking what it can do"
        show(progress)
        if time.monotonic() > deadline:
            raise Refused(f"no heartbeat of the camera within {_START_TIMEOUT_S:.0f} s; see {processes.folder}")


def _select(
    station: GroundStation,
    processes: _Processes,
    world: FlightWorld,
    epoch: float,
    progress: FlightProgress,
    show: Callable[[FlightProgress], None],
) -> None:
    """Select the car with its true bounding box, as an operator would, once it is in view."""
    deadline = time.monotonic() + _SELECT_TIMEOUT_S
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
        progress.line = "waiting until the car is in view"
        show(progress)
        if time.monotonic() > deadline:
            raise Refused(f"no selection was accepted within {_SELECT_TIMEOUT_S:.0f} s; see {processes.folder}")


def _line(station: GroundStation) -> str:
    report = station.report
    if report is None:
        return "no status yet"
    text = report.state
    if np.isfinite(report.box).all():
        text += "  box " + " ".join(f"{value:.3f}" for value in report.box)
    if report.geo is not None:
        text += f"  {report.geo[0]:.6f} {report.geo[1]:.6f} +-{report.geo[2]:.1f} m"
    return text


class _Processes:
    """The agent processes, each started with its configuration file."""

    def __init__(self, out: Path, configs: dict[str, Path], interrupted: Interruption) -> None:
        self.folder = out / "logs"
        self._configs = configs
        self._interrupted = interrupted
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, role: str) -> None:
        self._run(name, [role, str(self._configs[name])])

    def open_view(self, endpoint: str, port: int) -> str:
        """Start the live view; returns its address."""
        self._run("view", ["view", "--connect", endpoint, "--site", "demo", "--port", str(port)])
        deadline = time.monotonic() + _START_TIMEOUT_S
        while time.monotonic() < deadline and self._running["view"].poll() is None:
            for line in (self.folder / "view.txt").read_text(encoding="utf-8").splitlines():
                if line.startswith("open http") and len(line.split()) > 1:
                    return line.split()[1]
            time.sleep(0.05)
        raise Refused(f"the view did not start: {self._last_line('view')}")

    def _run(self, name: str, words: list[str]) -> None:
        with (self.folder / f"{name}.txt").open("wb") as log, self._interrupted.deferred():
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
            status = process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise Refused(f"{name} did not stop within {_STOP_TIMEOUT_S:.0f} s; see {self.folder}/{name}.txt") from None
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
        return lines[-1] if lines else "no output"


def _configs(out: Path, endpoint: str, port: int, seconds: float, seed: int, epoch: float) -> dict[str, Path]:
    """Write one configuration file per agent, as a user would."""
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
                "seconds": seconds + _EXTRA_WORLD_S,
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
    """Create the folder, and remove only the files of an earlier demo."""
    check_folder(out)
    try:
        for name in _OUTPUTS:
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
