"""`demo --scene town`: runs UAV agent and recorder, selects a car from a ground station, compares with ground truth."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deploy.agents.processes import START_TIMEOUT_S, AgentProcesses, free_udp_port, interrupt_on_signals
from deploy.config.uav import SimulatedFlightConfig
from deploy.demo.flight_outcome import (
    LOG,
    REPORT,
    FlightOutcome,
    compare_geo_positions,
    compare_log_with_world,
    write_report,
)
from deploy.demo.marker import ProgressDisplay
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import Refused
from protocols.core.files import write_atomically
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TARGET

if TYPE_CHECKING:
    from edge.mavlink.roles.station import GroundStation
    from edge.uav.world.flight_world import FlightWorld

RESULT = "result.json"
AGENT = "drone"
_SELECT_TIMEOUT_S = 60.0  # five periods of the path, in each of which the car is in view
_EXTRA_WORLD_S = 150.0  # world time beyond the shown duration, for starting and selecting
_GEO = "CAMERA_TRACKING_GEO_STATUS"


def run_town(
    out: Path,
    seconds: float,
    seed: int,
    display: ProgressDisplay,
    view_port: int | None = None,
) -> FlightOutcome:
    """Run the flight demo and compare. Raises Refused if an agent exits or does not start, InputError for a bad --out.

    view_port: port of a live view; None = no view, 0 = any free port.
    """
    from edge.mavlink.roles.station import GroundStation
    from edge.uav.world.patrol import patrol_world

    out = out.resolve()
    processes = AgentProcesses(out, (LOG, RESULT, REPORT), interrupt_on_signals())
    endpoint, port = free_endpoint(), free_udp_port()
    display.show(0.0, "starting")
    world = patrol_world(seed, seconds + _EXTRA_WORLD_S)
    epoch = time.time()
    tables = _tables(out, endpoint, port, seconds, seed, epoch)
    with Router(endpoint), open_bus("demo", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        targets = bus.subscribe(TARGET)
        station = GroundStation(f"udpout:127.0.0.1:{port}")
        try:
            if view_port is not None:
                display.announce(processes.open_view(endpoint, view_port))
            processes.start("recorder", "record", tables["recorder"])
            processes.start(AGENT, "uav", tables[AGENT])
            _wait_for_camera(station, processes, display)
            # Starting may take long on a busy machine; world time continues meanwhile.
            _select(station, processes, world, epoch, display)
            began = time.monotonic()
            states: Counter[str] = Counter()
            reported_geo: list[tuple[float, float, float, float]] = []
            while (elapsed := time.monotonic() - began) < seconds:
                geo_count = station.counts.get(_GEO, 0)
                station.poll(0.05)
                if (
                    station.report is not None
                    and station.report.geo is not None
                    and station.counts.get(_GEO, 0) > geo_count
                ):
                    reported_geo.append((time.time() - epoch, *station.report.geo))
                for received in targets.drain():
                    assert isinstance(received.message, pb.TargetState)
                    states[received.message.state] += 1
                processes.check()
                counts = "  ".join(f"{name} {states[name]}" for name in ("visible", "coasting", "lost"))
                display.show(elapsed, f"camera status: {_line(station)}", f"frames: {counts}")
            station.stop()
            station.poll(0.2)
            display.show(seconds, "stopping")
            statuses = sum(count for kind, count in station.counts.items() if "TRACKING" in kind)
            processes.stop(AGENT, "recorder")
        finally:
            station.close()
            processes.kill()
    near, median = compare_geo_positions(reported_geo, world)
    outcome = replace(
        compare_log_with_world(out / LOG, world, SimulatedFlightConfig().boot_s, statuses),
        geo_near=near,
        geo_median_m=median,
    )
    write_atomically(out / RESULT, outcome.as_json() + "\n")
    write_report(out / REPORT, out / LOG, outcome, world)
    return outcome


def _wait_for_camera(station: GroundStation, processes: AgentProcesses, display: ProgressDisplay) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while station.information is None:
        station.poll(0.1)
        processes.check()
        display.show(0.0, "asking what it can do" if station.camera_seen else "waiting for the camera's heartbeat")
        if time.monotonic() > deadline:
            raise Refused(f"no heartbeat of the camera within {START_TIMEOUT_S:.0f} s; see {processes.logs}")


def _select(
    station: GroundStation,
    processes: AgentProcesses,
    world: FlightWorld,
    epoch: float,
    display: ProgressDisplay,
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
        display.show(0.0, "waiting until the car is in view")
        if time.monotonic() > deadline:
            raise Refused(f"no selection was accepted within {_SELECT_TIMEOUT_S:.0f} s; see {processes.logs}")


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


def _tables(out: Path, endpoint: str, port: int, seconds: float, seed: int, epoch: float) -> dict[str, dict[str, Any]]:
    """Configuration of each agent."""
    bus = {"mode": "client", "connect": [endpoint]}
    return {
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
