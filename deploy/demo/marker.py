"""Processes of the marker demo: simulated cameras, a hub and a recorder, connected by a loopback router.

The progress display of all demos: a live bar on a terminal, otherwise a line every few seconds.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Self

from deploy.agents.processes import START_TIMEOUT_S, AgentProcesses, interrupt_on_signals, last_line
from protocols.bus.base import Bus
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import Refused
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, OBSERVATION

if TYPE_CHECKING:
    from rich.live import Live

LOG = "demo.mcap"
_OUTPUTS = (LOG, "calibration.toml", "trajectory.csv", "tracks.csv", "result.json", "report.html")
_PRINT_INTERVAL_S = 5.0  # between two lines where there is no terminal to redraw


class ProgressDisplay:
    """Shows how far a demo of ``seconds`` has got. title: what it does. quiet: only the view's address is printed."""

    def __init__(self, title: str, seconds: float, *, quiet: bool) -> None:
        self._title, self._seconds, self._quiet = title, seconds, quiet
        self._printed, self._status = -_PRINT_INTERVAL_S, ""
        self._live: Live | None = None

    def __enter__(self) -> Self:
        if not self._quiet and sys.stdout.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(), refresh_per_second=4, transient=True)
            self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def announce(self, address: str) -> None:
        """Print where the live view is."""
        print(f"live view: open {address}", file=sys.stderr if self._quiet else sys.stdout, flush=True)

    def show(self, elapsed: float, status: str, counts: str = "") -> None:
        """Show the time [s] since the first frame, what happens now, and the counts so far."""
        if self._quiet:
            return
        if self._live is None:
            if elapsed - self._printed >= _PRINT_INTERVAL_S or (elapsed == 0.0 and status != self._status):
                self._printed, self._status = elapsed, status
                print(f"{elapsed:5.1f} s", *filter(None, (counts, status)), sep="  ", flush=True)
            return
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.text import Text

        bar = ProgressBar(total=self._seconds, completed=min(elapsed, self._seconds), width=60)
        title = Text(f"{self._title} {elapsed:4.0f} of {self._seconds:.0f} s")
        self._live.update(Group(title, bar, Text(counts), Text(status)))


@dataclass(slots=True)
class DemoProgress:
    """Progress of the running demo. observations, detections: counts by camera."""

    elapsed: float = 0.0
    observations: dict[str, int] = field(default_factory=dict)
    detections: dict[str, int] = field(default_factory=dict)
    status: str = "starting"
    first_calibration_s: float | None = None
    calibration: pb.Calibration | None = None

    def show(self, display: ProgressDisplay, names: list[str]) -> None:
        """Show the frames of each camera, and how many of them had a detection."""
        counts = (f"{name} {self.detections.get(name, 0)}/{self.observations.get(name, 0)}" for name in names)
        display.show(self.elapsed, self.status, f"seen / frames: {'  '.join(counts)}")


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
        self._endpoint = free_endpoint()

    def run(self, display: ProgressDisplay) -> DemoProgress:
        """Record for the set time. Raises Refused if an agent exits."""
        live = DemoProgress()
        # When the demo is terminated it must also stop its agents: as after Ctrl-C, ``finally`` does that.
        processes = AgentProcesses(self.out, _OUTPUTS, interrupt_on_signals())
        bus_config = BusConfig(mode="client", connect=(self._endpoint,))
        with Router(self._endpoint), open_bus("demo", bus_config, timeout_s=10.0) as bus:
            observations, calibrations = bus.subscribe(OBSERVATION), bus.subscribe(CALIBRATION)
            try:
                # Recorder and hub first, so that they receive all messages from the first frame on.
                for name, table in self._tables().items():
                    processes.start(name, {"recorder": "record", "hub": "hub"}.get(name, "camera"), table)
                if self.settings.view_port is not None:
                    display.announce(processes.open_view(self._endpoint, self.settings.view_port))
                poll_topics = self._make_listener(bus)
                began = time.monotonic()
                first: float | None = None
                while first is None or time.monotonic() - first < self.settings.seconds:
                    observations.wait(0.2)
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
                    processes.check()
                    if first is None and time.monotonic() - began > START_TIMEOUT_S:
                        missing = [name for name in self.names if name not in live.observations]
                        raise Refused(
                            f"no frame from {', '.join(missing)} within {START_TIMEOUT_S:.0f} s; see {self.out}/logs"
                        )
                    live.show(display, self.names)
                if self.settings.view_port is not None:
                    processes.stop("view")
                live.status = "stopping the cameras"
                live.show(display, self.names)
                processes.stop(*self.names)
                live.status = "final calibration with all observations"
                live.show(display, self.names)
                processes.stop("hub", "recorder")
            finally:
                processes.kill()
        return live

    def check_calibrated(self) -> None:
        """Raise Refused with the hub's last words if it ended without a calibration."""
        if not (self.out / "calibration.toml").exists():
            last = last_line(self.out / "logs" / "hub.txt")
            raise Refused(f"no calibration from {self.settings.seconds:g} s ({last}): give more --seconds")

    def _make_listener(self, bus: Bus) -> Callable[[DemoProgress], None]:
        """A function that polls further topics of a scene's demo; called in every cycle."""
        return lambda live: None

    def _tables(self) -> dict[str, dict[str, object]]:
        """Configuration of each agent, in the order in which they start."""
        common = {"site": "demo", "bus": {"mode": "client", "connect": [self._endpoint]}}
        world = {
            "scene": self.settings.scene,
            "seed": self.settings.seed,
            "cameras": self.settings.cameras,
            "start_unix_s": time.time() - self._world_start_s,
        }
        window = {"window_s": self.settings.seconds + 60.0, "interval_s": 3.0}
        return {
            "recorder": {"id": "recorder", "out": str(self.out / LOG), **common},
            "hub": {"id": "hub", "out": str(self.out), **window, **common},
            **{name: {"id": name, "driver": "simulated", "simulated": world, **common} for name in self.names},
        }


def _status(message: pb.Calibration) -> str:
    if message.status == "solved":
        offsets = [camera.time_offset_std for camera in message.cameras]
        return f"{len(message.cameras)} cameras calibrated, offsets ± {1e3 * max(offsets, default=0.0):.2f} ms"
    return f"{message.status}: {message.reason}"
