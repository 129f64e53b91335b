"""The demo of the scene ``people``: cameras that find people, a hub that follows them, and how well it did."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tomli_w

from deploy.demo.marker import LOG, DemoSettings, Fleet, Live
from deploy.evaluation.clear_mot import Moment, Scores, clear_mot
from deploy.simulation.session import camera_tables
from edge import scenes
from edge.scenes.people.scene import PeopleScene
from protocols.bus.base import Bus
from protocols.core.clocks import NANOSECONDS
from protocols.core.files import write_atomically
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION, TRACK

KNOWN = "known.toml"
REACH_M = 0.5
"""A track farther than this from everybody, on the floor, follows nobody."""
MOTA, SWITCHES, ERROR_M = 0.9, 2, 0.10
"""What the demo promises."""
_STEP_S = 0.1
_BEGUN_S = 5.0
"""What is also scored without: the time in which cameras learn the place and how tall people are."""
_HELD_S = 0.25
"""A track counts for so long after it was told."""


class PeopleFleet(Fleet):
    """The demo's processes with person detectors, and a hub that is given the calibration."""

    _world_s = 6.0  # people walk when the cameras are switched on; at 0 all of them set out at once

    def __init__(self, settings: DemoSettings) -> None:
        super().__init__(settings)
        self.scene = scenes.get_people(settings.seed, settings.cameras)

    def _write_configs(self) -> dict[str, Path]:
        files = super()._write_configs()
        _, tables = camera_tables(self.scene, self.scene.name)
        # The scene's world is the room's: z is up.
        tables["metadata"]["up"] = [0.0, 0.0, 1.0]
        known = self.out / "config" / KNOWN
        known.write_text(tomli_w.dumps(tables), encoding="utf-8")
        for name in self.names:
            text = files[name].read_text(encoding="utf-8")
            files[name].write_text('detector = "person"\n' + text, encoding="utf-8")
        hub = files["hub"].read_text(encoding="utf-8")
        files["hub"].write_text(f'known = "{known.name}"\n' + hub, encoding="utf-8")
        return files

    def _watch(self, bus: Bus) -> Callable[[Live], None]:
        tracks = bus.subscribe(TRACK)
        told: dict[str, pb.Track] = {}

        def look(live: Live) -> None:
            for received in tracks.drain():
                assert isinstance(received.message, pb.Track)
                told[received.message.label] = received.message
            newest = max((track.reference_time_ns for track in told.values()), default=0)
            now = [track for track in told.values() if newest - track.reference_time_ns < NANOSECONDS]
            states = [track.state for track in now]
            walking = ", ".join(
                f"{track.label} ({track.position[0]:.1f}, {track.position[1]:.1f})"
                for track in sorted(now, key=lambda track: track.label)
                if track.state != "lost"
            )
            live.status = f"{states.count('confirmed')} followed, {states.count('coasting')} coasting: {walking}"

        return look


@dataclass(frozen=True, slots=True)
class PeopleComparison:
    """How the tracks in a log agree with the scene.

    on_floor, in_space: scores of places on the floor and of the bodies' middles [m], from the first frame on. begun:
    on the floor, without the first 5 s; nothing is promised of it. frames: by camera.
    """

    on_floor: Scores
    in_space: Scores
    begun: Scores
    seconds: float
    people: int
    frames: dict[str, int]

    @property
    def good(self) -> bool:
        """Whether it is what the demo promises."""
        s = self.on_floor
        return s.mota >= MOTA and s.switches <= SWITCHES and s.error <= ERROR_M

    def as_json(self) -> str:
        """One JSON object."""
        document = {"good": self.good, **asdict(self)}
        for part in ("on_floor", "in_space", "begun"):
            document[part] = {key: value if np.isfinite(value) else None for key, value in document[part].items()}
        return json.dumps(document)

    def print(self, out: Path) -> None:
        """A table for a person."""
        from rich.table import Table

        from deploy.offline.outputs import wide_console

        console = wide_console()
        table = Table(title="followed against true", title_justify="left")
        for column in ("", "promised", "on the floor", "in space", f"floor, {_BEGUN_S:.0f} s on"):
            table.add_column(column, justify="left" if not column else "right")
        scores = (self.on_floor, self.in_space, self.begun)
        table.add_row("MOTA", f">= {MOTA}", *(f"{s.mota:.3f}" for s in scores))
        table.add_row("IDF1", "", *(f"{s.idf1:.3f}" for s in scores))
        table.add_row("identity switches", f"<= {SWITCHES}", *(str(s.switches) for s in scores))
        table.add_row("mean error [cm]", f"<= {100 * ERROR_M:.0f}", *(f"{100 * s.error:.1f}" for s in scores))
        table.add_row("95 % within [cm]", "", *(f"{100 * s.error_p95:.1f}" for s in scores))
        table.add_row("missed", "", *(str(s.misses) for s in scores))
        table.add_row("false", "", *(str(s.false) for s in scores))
        console.print(table)
        console.print(
            f"{self.people} people for {self.seconds:.0f} s, {self.on_floor.truths} places to tell, "
            f"{self.on_floor.labels} names given"
        )
        console.print("as promised" if self.good else "NOT as promised")
        console.print(f"log {out / LOG}, tracks {out / 'tracks.csv'}", soft_wrap=True)
        again = f"syncline replay {out / LOG} --through hub --calibration {out / 'config' / KNOWN} --out again.mcap"
        console.print(f"again from the log: {again}", soft_wrap=True)


def compare_with_people(folder: Path, seed: int, cameras: int) -> PeopleComparison:
    """Score the tracks in a demo's log against the scene, and write them to tracks.csv."""
    scene = scenes.get_people(seed, cameras)
    comparison, rows = score_log(folder / LOG, scene)
    header = "time,label,state,x,y,z,vx,vy,vz,heading,height"
    write_atomically(folder / "tracks.csv", "\n".join([header, *rows]) + "\n")
    return comparison


def score_log(log: Path, scene: PeopleScene) -> tuple[PeopleComparison, list[str]]:
    """The comparison of one log, and its tracks as CSV rows."""
    reference = scene.cameras[0]
    tracks: dict[str, list[pb.Track]] = defaultdict(list)
    frames: dict[str, int] = defaultdict(int)
    firsts: dict[str, float] = {}
    lasts: dict[str, float] = {}
    rows = []
    for logged in LogReader(log).messages([TRACK, OBSERVATION]):
        message = logged.message
        if isinstance(message, pb.Observation):
            true = scene.camera(message.camera).clock.true_time(message.device_time_ns)
            firsts.setdefault(message.camera, true)
            lasts[message.camera] = true
            frames[message.camera] += 1
        elif isinstance(message, pb.Track) and message.kind == "person":
            tracks[message.label].append(message)
            if message.state != "lost":
                rows.append(_row(message))
    begin, end = max(firsts.values(), default=0.0), min(lasts.values(), default=0.0)
    moments = [
        _moment(scene, float(time), reference.clock.device_time_ns(float(time)), tracks)
        for time in np.arange(begin, end, _STEP_S)
    ]
    flat = [Moment(m.truth_names, m.truth[:, :2], m.found_names, m.found[:, :2]) for m in moments]
    return PeopleComparison(
        on_floor=clear_mot(flat, REACH_M),
        in_space=clear_mot(moments, REACH_M),
        begun=clear_mot(flat[round(_BEGUN_S / _STEP_S) :], REACH_M),
        seconds=max(end - begin, 0.0),
        people=len(scene.people),
        frames=dict(frames),
    ), rows


def _moment(scene: PeopleScene, time: float, reference_ns: int, tracks: dict[str, list[pb.Track]]) -> Moment:
    """Who was where, and what was told of that moment: the last telling, moved on by its own velocity."""
    names, places = [], []
    for label, told in tracks.items():
        times = [track.reference_time_ns for track in told]
        index = int(np.searchsorted(times, reference_ns, side="right")) - 1
        if index < 0 or told[index].state == "lost":
            continue
        elapsed = (reference_ns - times[index]) / NANOSECONDS
        if elapsed <= _HELD_S:
            names.append(label)
            places.append(np.array(told[index].position) + elapsed * np.array(told[index].velocity))
    truth = scene.centres(np.array([time]))[0]
    found = np.array(places).reshape(-1, 3)
    return Moment(tuple(person.name for person in scene.people), truth, tuple(names), found)


def _row(track: pb.Track) -> str:
    numbers = [*track.position, *track.velocity]
    angle = f"{track.heading:.17g}" if track.HasField("heading") else ""
    told = ",".join(f"{number:.17g}" for number in numbers)
    return f"{track.reference_time_ns / NANOSECONDS:.9f},{track.label},{track.state},{told},{angle},{track.height:.17g}"
