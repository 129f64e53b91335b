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
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from deploy.uav_config import FlightConfig
from protocols.bus.router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.zenoh_bus import open_bus
from protocols.catalogue import STATUS, TARGET
from protocols.clocks import NANOSECONDS
from protocols.errors import InputError, Refused
from protocols.files import check_folder, write_atomically
from protocols.log.reader import LogReader
from protocols.messages import syncline_pb2 as pb

if TYPE_CHECKING:
    from edge.mavlink.station import Station
    from edge.uav.world.world import World

LOG = "demo.mcap"
RESULT = "result.json"
AGENT = "drone"
_MINE = ("config", "logs", LOG, RESULT)
_STARTING_S, _SELECTING_S, _STOPPING_S = 60.0, 60.0, 40.0
_SPARE_S = 150.0  # of the world's time beyond what is shown: for starting and selecting
_NEAR_PX = 20.0
_GEO, _GEO_NEAR_M = "CAMERA_TRACKING_GEO_STATUS", 5.0


@dataclass(slots=True)
class Progress:
    """What is shown while it runs."""

    elapsed: float = 0.0
    line: str = "starting"
    states: Counter[str] = field(default_factory=Counter)
    frames: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """Recovered against true. Shares are of frames, 0 … 1, None where there were none of that kind.

    in_frame, in_near: frames that show a part of the car, and those of them within 20 px. out_frames, out_length: that
    show nothing of it, and within one car length. claims_out: says visible from the third frame out on. median_m: of
    the place on the ground, in and out. offset_error_s: of the map between the vehicle's clock and the camera's.
    geo_near: share of the CAMERA_TRACKING_GEO_STATUS that came within three times their accuracy, or 5 m, of where the
    car was when they came; geo_median_m: how far off they were.
    """

    frames: int
    in_frames: int
    in_near: float | None
    out_frames: int
    out_length: float | None
    claims_out: float | None
    states: dict[str, int]
    median_in_m: float | None
    median_out_m: float | None
    offset_error_s: float | None
    latency_p99_s: float | None
    statuses: int
    geo_near: float | None = None
    geo_median_m: float | None = None

    @property
    def good(self) -> bool:
        """Whether the demo shows what it promises."""
        enough = self.in_frames >= 15 and (self.in_near or 0.0) >= 0.8
        honest = self.claims_out is None or self.claims_out <= 0.1
        told = self.geo_near is not None and self.geo_near >= 0.8
        return enough and honest and told and (self.out_length is None or self.out_frames < 5 or self.out_length >= 0.5)


def run_town(out: Path, seconds: float, seed: int, show: Callable[[Progress], None]) -> Outcome:
    """Fly, follow, compare. Raises Refused if an agent dies or does not come up, InputError for a bad --out."""
    from edge.mavlink.station import Station
    from edge.uav.world.patrol import patrol

    out = out.resolve()
    _clean(out)
    endpoint, port = free_endpoint(), _free_port()
    progress = Progress()
    show(progress)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    world = patrol(seed, seconds + _SPARE_S)
    epoch = time.time()
    processes = _Processes(out, _configs(out, endpoint, port, seconds, seed, epoch))
    with Router(endpoint), open_bus("demo", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        targets = bus.subscribe(TARGET)
        station = Station(f"udpout:127.0.0.1:{port}")
        try:
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
    return outcome


def compare(log: Path, world: World, boot_s: float, statuses: int = 0) -> Outcome:
    """What a log's agent said of the target against the truth of its world."""
    states: Counter[str] = Counter()
    rows: list[tuple[float, float, float, bool, float]] = []  # inside, error px, car length px, visible, error m
    offsets: list[float] = []
    latency: float | None = None
    for logged in LogReader(log).messages([TARGET, "telemetry", STATUS]):
        message: Any = logged.message
        if isinstance(message, pb.VehicleTelemetry):
            offsets.append((message.vehicle_time_ns - message.device_time_ns) / NANOSECONDS - boot_s)
        elif isinstance(message, pb.AgentStatus):
            latency = message.gauges.get("latency_p99_s", latency)
        elif isinstance(message, pb.TargetState) and message.frame < world.length:
            truth = world.truth(message.frame)
            states[message.state] += 1
            error = np.inf
            if message.centre:
                error = float(np.hypot(message.centre[0] - truth.x, message.centre[1] - truth.y))
            metres = np.nan
            if message.ground:
                metres = float(np.hypot(message.ground[0] - truth.north, message.ground[1] - truth.east))
            rows.append((truth.inside, error, truth.length, message.state == "visible", metres))
    if not rows:
        raise Refused("the agent never said anything of a target", warnings=(f"see {log.parent}/logs",))
    table = np.array(rows, dtype=np.float64)
    inside, outside = table[:, 0] > 0.0, table[:, 0] == 0.0
    late = outside & np.r_[False, outside[:-1]] & np.r_[False, False, outside[:-2]]
    return Outcome(
        frames=len(rows),
        in_frames=int(inside.sum()),
        in_near=_share(table[inside, 1] < _NEAR_PX),
        out_frames=int(outside.sum()),
        out_length=_share(table[outside, 1] < table[outside, 2]),
        claims_out=_share(table[late, 3] > 0),
        states=dict(states),
        median_in_m=_median(table[inside, 4]),
        median_out_m=_median(table[outside, 4]),
        # The last third: once it was found.
        offset_error_s=_median(np.array(offsets[-max(len(offsets) // 3, 1) :])) if offsets else None,
        latency_p99_s=latency,
        statuses=statuses,
    )


def compare_geo(told: list[tuple[float, float, float, float]], world: World) -> tuple[float | None, float | None]:
    """Share of places that are near enough, and their median error [m]; None without any.

    told: world time [s], latitude, longitude [degrees], accuracy [m].
    """
    from edge.mavlink.autopilot import ORIGIN

    errors, accuracies = [], []
    for moment, latitude, longitude, accuracy in told:
        if 0.0 <= moment <= world.time(world.length - 1):
            place, _ = world.target_at(moment)
            errors.append(float(np.hypot(*(ORIGIN.local(latitude, longitude, 0.0)[:2] - place))))
            accuracies.append(accuracy)
    table = np.array(errors)
    return _share(table <= np.maximum(3.0 * np.array(accuracies), _GEO_NEAR_M)), _median(table)


def as_json(outcome: Outcome) -> str:
    """The outcome as one JSON object."""
    import json
    from dataclasses import asdict

    return json.dumps({**asdict(outcome), "good": outcome.good}, allow_nan=False)


def print_outcome(outcome: Outcome, out: Path) -> None:
    """The table at the end."""
    from rich.table import Table

    from deploy.outputs import wide_console

    table = Table(title="the car as recovered against the truth")
    for name in ("", "recovered", "promised"):
        table.add_column(name)

    def percent(share: float | None) -> str:
        return "-" if share is None else f"{100.0 * share:.1f} %"

    def metres(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f} m"

    table.add_row(f"in the picture ({outcome.in_frames} frames): within 20 px", percent(outcome.in_near), ">= 80 %")
    table.add_row(
        f"out of it ({outcome.out_frames} frames): within a car length", percent(outcome.out_length), ">= 50 %"
    )
    table.add_row("says visible while out", percent(outcome.claims_out), "<= 10 %")
    ground = f"{metres(outcome.median_in_m)} / {metres(outcome.median_out_m)}"
    table.add_row("place on the ground, in / out (median)", ground, "")
    geo = f"{percent(outcome.geo_near)}, median {metres(outcome.geo_median_m)}"
    table.add_row("latitude, longitude as told over MAVLink: within 3 accuracies or 5 m", geo, ">= 80 %")
    if outcome.offset_error_s is not None:
        table.add_row("vehicle clock against camera clock", f"{1e3 * outcome.offset_error_s:+.1f} ms off", "")
    if outcome.latency_p99_s is not None:
        table.add_row("frame to status, p99", f"{1e3 * outcome.latency_p99_s:.0f} ms", "")
    states = ", ".join(f"{outcome.states.get(name, 0)} {name}" for name in ("visible", "coasting", "lost"))
    table.add_row("states", states, "")
    console = wide_console()
    console.print(table)
    console.print(f"{outcome.statuses} tracking statuses came over MAVLink; the log is {out / LOG}", soft_wrap=True)
    console.print(f"replay it: syncline replay {out / LOG} --through uav --out again.mcap", soft_wrap=True)


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

    def __init__(self, out: Path, configs: dict[str, Path]) -> None:
        self.folder = out / "logs"
        self._configs = configs
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, role: str) -> None:
        with (self.folder / f"{name}.txt").open("wb") as log:
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", "deploy", role, str(self._configs[name])],
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


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _share(good: Any) -> float | None:
    return float(np.mean(good)) if len(good) else None


def _median(values: Any) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
