"""Processes of the marker demo: simulated cameras, a hub and a recorder, connected by a loopback router."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from deploy.agents.signals import Interruption, interrupt_on_signals
from protocols.bus.base import Bus
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError, Refused
from protocols.core.files import check_folder
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, OBSERVATION

LOG = "demo.mcap"
_START_TIMEOUT_S = 60.0
_STOP_TIMEOUT_S = 40.0
_OUTPUTS = ("config", "logs", LOG, "calibration.toml", "trajectory.csv", "tracks.csv", "result.json", "report.html")


@dataclass(slots=True)
class DemoProgress:
    """Progress of the running demo. observations, detections: counts by camera. address: of the live view."""

    elapsed: float = 0.0
    observations: dict[str, int] = field(default_factory=dict)
    detections: dict[str, int] = field(default_factory=dict)
    status: str = "starting"
    first_calibration_s: float | None = None
    calibration: pb.Calibration | None = None
    address: str = ""


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """Settings of the demo. scene, seed, cameras: the simulated scene; seconds: length of the recording.

    view_port: port of a live view; None = no view, 0 = any free port.
    """

    scene: str
    seed: int
    cameras: int
    seconds: float
    out: Path
    view_port: int | None = None


class DemoProcesses:
    """The demo's processes, started together and stopped in order."""

    _world_start_s = 0.0
    """True time in the scene at which the cameras start [s]."""

    def __init__(self, settings: DemoSettings) -> None:
        self.settings = settings
        self.out = settings.out.resolve()
        self.names = [f"cam{i}" for i in range(settings.cameras)]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._interrupted = Interruption()
        self._endpoint = free_endpoint()
        self._site = "demo"

    def run(self, show: Callable[[DemoProgress], None]) -> DemoProgress:
        """Record for the set time; ``show`` is called several times a second. Raises Refused if an agent exits."""
        self._clean()
        configs = self._write_configs()
        live = DemoProgress()
        # When the demo is terminated it must also stop its agents: as after Ctrl-C, ``finally`` does that.
        self._interrupted = interrupt_on_signals()
        bus_config = BusConfig(mode="client", connect=(self._endpoint,))
        with Router(self._endpoint), open_bus(self._site, bus_config, timeout_s=10.0) as bus:
            observations, calibrations = bus.subscribe(OBSERVATION), bus.subscribe(CALIBRATION)
            try:
                # Recorder and hub first, so that they receive all messages from the first frame on.
                for name in ("recorder", "hub", *self.names):
                    self._start(name, configs[name])
                if self.settings.view_port is not None:
                    live.address = self._open_view(self.settings.view_port)
                    show(live)
                poll_topics = self._make_listener(bus)
                began = time.monotonic()
                first: float | None = None
                while first is None or time.monotonic() - first < self.settings.seconds:
                    observations.wait(0.2)
                    if self._interrupted.is_set():
                        raise KeyboardInterrupt
                    for received in observations.drain():
                        assert isinstance(received.message, pb.Observation)
                        name = received.message.camera
                        live.observations[name] = live.observations.get(name, 0) + 1
                        seen = len(received.message.detections) > 0
                        live.detections[name] = live.detections.get(name, 0) + seen
                    if first is None and len(live.observations) == len(self.names):
                        first = time.monotonic()
                    for received in calibrations.drain():
                        assert isinstance(received.message, pb.Calibration)
                        live.calibration = received.message
                        solved = received.message.status == "solved"
                        if solved and live.first_calibration_s is None:
                            live.first_calibration_s = time.monotonic() - (first or began)
                        live.status = _status(received.message)
                    poll_topics(live)
                    live.elapsed = 0.0 if first is None else time.monotonic() - first
                    self._check_alive()
                    if first is None and time.monotonic() - began > _START_TIMEOUT_S:
                        missing = [name for name in self.names if name not in live.observations]
                        raise Refused(
                            f"no frame from {', '.join(missing)} within {_START_TIMEOUT_S:.0f} s; see {self.out}/logs"
                        )
                    show(live)
                if self.settings.view_port is not None:
                    self._stop("view")
                live.status = "stopping the cameras"
                show(live)
                for name in self.names:
                    self._stop(name)
                live.status = "final calibration with all observations"
                show(live)
                self._stop("hub")
                self._stop("recorder")
            finally:
                for process in self._processes.values():
                    if process.poll() is None:
                        process.kill()
                        process.wait()
        return live

    def check_calibrated(self) -> None:
        """Raise Refused with the hub's last words if it ended without a calibration."""
        if not (self.out / "calibration.toml").exists():
            raise Refused(
                f"no calibration from {self.settings.seconds:g} s ({self._last_line('hub')}): give more --seconds"
            )

    def _make_listener(self, bus: Bus) -> Callable[[DemoProgress], None]:
        """A function that polls further topics of a scene's demo; called in every cycle."""
        return lambda live: None

    def _clean(self) -> None:
        """Create the folder, and remove only the files of an earlier demo."""
        check_folder(self.out)
        try:
            for name in _OUTPUTS:
                path = self.out / name
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
            (self.out / "config").mkdir(parents=True)
            (self.out / "logs").mkdir()
        except OSError as error:
            raise InputError(
                f"cannot be made: {error.strerror}", file=self.out, remedy="choose another --out"
            ) from None

    def _write_configs(self) -> dict[str, Path]:
        """Write one configuration file per agent, as a user would."""
        bus = {"mode": "client", "connect": [self._endpoint]}
        world = {
            "scene": self.settings.scene,
            "seed": self.settings.seed,
            "cameras": self.settings.cameras,
            "start_unix_s": time.time() - self._world_start_s,
        }
        tables: dict[str, dict[str, object]] = {
            "recorder": {"id": "recorder", "site": self._site, "out": str(self.out / LOG), "bus": bus},
            "hub": {
                "id": "hub",
                "site": self._site,
                "out": str(self.out),
                "window_s": self.settings.seconds + 60.0,
                "interval_s": 3.0,
                "bus": bus,
            },
        }
        for name in self.names:
            tables[name] = {"id": name, "site": self._site, "driver": "simulated", "simulated": world, "bus": bus}
        files = {}
        for name, table in tables.items():
            files[name] = self.out / "config" / f"{name}.toml"
            files[name].write_text(tomli_w.dumps(table), encoding="utf-8")
        return files

    def _start(self, name: str, config: Path) -> None:
        role = {"recorder": "record", "hub": "hub"}.get(name, "camera")
        self._run(name, [role, str(config)])

    def _open_view(self, port: int) -> str:
        """Start the live view; returns its address."""
        self._run("view", ["view", "--connect", self._endpoint, "--site", self._site, "--port", str(port)])
        deadline = time.monotonic() + 3 * _START_TIMEOUT_S
        while time.monotonic() < deadline and self._processes["view"].poll() is None:
            for line in (self.out / "logs" / "view.txt").read_text(encoding="utf-8").splitlines():
                if line.startswith("open http") and len(line.split()) > 1:
                    return line.split()[1]
            time.sleep(0.05)
        raise Refused(f"the view did not start: {self._last_line('view')}")

    def _run(self, name: str, arguments: list[str]) -> None:
        with (self.out / "logs" / f"{name}.txt").open("wb") as log, self._interrupted.deferred():
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", "deploy", *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            )

    def _stop(self, name: str) -> None:
        process = self._processes[name]
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            status = process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise Refused(
                f"{name} did not stop within {_STOP_TIMEOUT_S:.0f} s; see {self.out}/logs/{name}.txt"
            ) from None
        if status != 0:
            raise Refused(f"{name} ended with status {status}: {self._last_line(name)}")

    def _check_alive(self) -> None:
        for name, process in self._processes.items():
            if process.poll() is not None:
                raise Refused(f"{name} ended with status {process.returncode}: {self._last_line(name)}")

    def _last_line(self, name: str) -> str:
        lines = (self.out / "logs" / f"{name}.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "no output"


def _status(message: pb.Calibration) -> str:
    if message.status == "solved":
        offsets = [camera.time_offset_std for camera in message.cameras]
        return f"{len(message.cameras)} cameras calibrated, offsets ± {1e3 * max(offsets, default=0.0):.2f} ms"
    return f"{message.status}: {message.reason}"
