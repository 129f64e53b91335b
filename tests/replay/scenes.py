"""The shipped scenes as logs, generated each time, and the reference outputs of hub and UAV agent for them.

`python -m tests.replay.scenes` stores the current outputs in logs/ as references: after an intended change whose
differences (`syncline replay OLD --compare NEW`) were reviewed.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import tomli_w

from deploy.cli import run
from deploy.logs.replay_hub import replay_through_hub
from deploy.logs.replay_uav import replay_through_uav
from deploy.simulation.session import camera_tables
from edge.agents.uav import TOPICS
from edge.scenes import get_people_scene
from edge.scenes.people.scene import PeopleScene
from edge.uav.world.flight_world import FlightWorld
from edge.uav.world.patrol import patrol_world
from hub.live.live_hub import LiveSettings
from protocols.core.clocks import NANOSECONDS
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.topics import CAMERA_INFO, OBSERVATION, TARGET, TRACK, Topic
from tests.support.people_traffic import film
from tests.support.uav_flights import Flight

LOGS = Path(__file__).parent / "logs"
MARKER_SEED, MARKER_CAMERAS, MARKER_S = 11, 3, 12.0
TOWN_SEED, TOWN_S = 3, 8.0
PEOPLE_SEED, PEOPLE_CAMERAS, PEOPLE_S = 22, 4, 6.0
AGENT = "drone"


def marker_log(folder: Path) -> Path:
    """The marker room: what three cameras reported of a marker, as a log."""
    words = ["simulate", "marker", "--out", str(folder / "session"), "--seed", str(MARKER_SEED)]
    assert run([*words, "--cameras", str(MARKER_CAMERAS), "--seconds", str(MARKER_S)]) == 0
    assert run(["import", str(folder / "session"), "--out", str(folder / "marker.mcap")]) == 0
    return folder / "marker.mcap"


def marker_answer(log: Path, out: Path) -> Path:
    """Output of a hub that solves every six seconds."""
    replay_through_hub(log, out, LiveSettings(interval_s=6.0))
    return out


def town() -> FlightWorld:
    """The world that the drone flies over."""
    return patrol_world(TOWN_SEED, TOWN_S + 2.0, (320, 240))


def town_log(folder: Path) -> Path:
    """The town: images, telemetry and orders of a drone that follows a car until it leaves the field of view."""
    flight = Flight(town(), jpeg_quality=90)
    flight.run(1.5)
    assert flight.select()
    flight.run(TOWN_S)
    with LogWriter(folder / "town.mcap") as log:
        for number, message in enumerate(flight.published):
            log.write(TOPICS[message.DESCRIPTOR.name], AGENT, "local", message, 10**18 + number)
    return folder / "town.mcap"


def town_answer(log: Path, out: Path) -> Path:
    """Output of the UAV agent's estimator: every estimate; particles and road only follow from them."""
    whole = out.with_name(f"whole-{out.name}")
    _, missing = replay_through_uav(log, whole)
    assert missing == 0
    return only(TARGET, whole, out)


def people() -> PeopleScene:
    """The room that three people walk about in."""
    return get_people_scene(PEOPLE_SEED, PEOPLE_CAMERAS, 3)


def people_log(folder: Path) -> Path:
    """The room of people: what four cameras reported of them; beside it the calibration used for tracking."""
    scene = people()
    _, tables = camera_tables(scene, "people")
    tables["metadata"]["up"] = [0.0, 0.0, 1.0]
    (folder / "known.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    traffic = film(scene, PEOPLE_S, PEOPLE_SEED)
    with LogWriter(folder / "people.mcap") as log:
        for info in traffic.infos:
            log.write(CAMERA_INFO, info.camera, "local", info, 0)
        for arrival, message in traffic.arrivals:
            log.write(OBSERVATION, message.camera, "local", message, round(arrival * NANOSECONDS))
    return folder / "people.mcap"


def people_answer(log: Path, out: Path) -> Path:
    """Tracks of the people from a hub with known cameras."""
    whole = out.with_name(f"whole-{out.name}")
    replay_through_hub(log, whole, calibration=log.with_name("known.toml"))
    return only(TRACK, whole, out)


def only(topic: Topic, whole: Path, out: Path) -> Path:
    """One topic of a log, which is removed."""
    with LogWriter(out) as writer:
        for logged in LogReader(whole).messages([topic]):
            writer.write(topic, logged.agent, logged.site, logged.message, logged.log_time_ns)
    whole.unlink()
    return out


def elsewhere(kind: str, log: Path, out: Path) -> Path:
    """The same in a process of its own that has one core."""
    code = (
        "import os, sys; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); from pathlib import Path; "
        f"from tests.replay.scenes import {kind}_answer as answer; answer(Path(sys.argv[1]), Path(sys.argv[2]))"
    )
    root = Path(__file__).parents[2]
    subprocess.run([sys.executable, "-c", code, str(log), str(out)], check=True, cwd=root, timeout=300)
    return out


def main() -> int:
    """Store the current outputs as references."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, log, answer in (
            ("marker", marker_log(folder), marker_answer),
            ("town", town_log(folder), town_answer),
            ("people", people_log(folder), people_answer),
        ):
            new = answer(log, folder / f"{kind}-answer.mcap")
            kept = LOGS / f"{kind}-answer.mcap"
            if kept.exists():
                run(["replay", str(kept), "--compare", str(new)])
            kept.write_bytes(new.read_bytes())
            print(f"{kept}: {kept.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
