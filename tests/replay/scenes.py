"""The shipped scenes as logs, made anew each time, and what hub and UAV agent said of them when it was last looked at.

`python -m tests.replay.scenes` keeps the answers of today in logs/: after a change that is meant to change them, and
whose differences (`syncline replay OLD --compare NEW`) somebody has read.
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
from edge.scenes import get_people
from edge.scenes.people.scene import PeopleScene
from edge.uav.world.patrol import patrol
from edge.uav.world.world import World
from hub.live.live_hub import LiveSettings
from protocols.core.clocks import NANOSECONDS
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.topics import CAMERA_INFO, OBSERVATION, TARGET, TRACK, Topic
from tests.people_traffic import film
from tests.uav_flights import Flight

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
    """What a hub that solves every six seconds says of it."""
    replay_through_hub(log, out, LiveSettings(interval_s=6.0))
    return out


def town() -> World:
    """The world that the drone flies over."""
    return patrol(TOWN_SEED, TOWN_S + 2.0, (320, 240))


def town_log(folder: Path) -> Path:
    """The town: pictures, telemetry and orders of a drone that follows a car and loses it from its picture."""
    flight = Flight(town(), jpeg_quality=90)
    flight.run(1.5)
    assert flight.select()
    flight.run(TOWN_S)
    with LogWriter(folder / "town.mcap") as log:
        for number, message in enumerate(flight.published):
            log.write(TOPICS[message.DESCRIPTOR.name], AGENT, "local", message, 10**18 + number)
    return folder / "town.mcap"


def town_answer(log: Path, out: Path) -> Path:
    """What the UAV agent's estimator says of it: every estimate; particles and road only follow from them."""
    whole = out.with_name(f"whole-{out.name}")
    _, missing = replay_through_uav(log, whole)
    assert missing == 0
    return only(TARGET, whole, out)


def people() -> PeopleScene:
    """The room that three people walk about in."""
    return get_people(PEOPLE_SEED, PEOPLE_CAMERAS, 3)


def people_log(folder: Path) -> Path:
    """The room of people: what four cameras reported of them; beside it the calibration by which they are followed."""
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
    """Where a hub that knows the cameras says that everybody is."""
    whole = out.with_name(f"whole-{out.name}")
    replay_through_hub(log, whole, calibration=log.with_name("known.toml"))
    return only(TRACK, whole, out)


def only(topic: Topic, whole: Path, out: Path) -> Path:
    """One topic of a log, which goes."""
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
    """Keep what is said today."""
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
