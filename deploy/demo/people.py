"""The demo of the scene ``people``: person detection, tracking in the hub, and evaluation against ground truth."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tomli_w

from deploy.demo.marker import LOG, DemoProcesses, DemoProgress, DemoSettings
from deploy.evaluation.clear_mot import EvaluationFrame, MotScores, clear_mot
from deploy.simulation.session import camera_tables
from edge import scenes
from edge.scenes.people.scene import PeopleScene
from protocols.bus.base import Bus
from protocols.core.clocks import NANOSECONDS
from protocols.core.files import write_atomically
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION, TRACK

KNOWN_CALIBRATION = "known.toml"
MAX_MATCH_DISTANCE_M = 0.5
"""Largest distance on the floor at which a track matches a person [m]."""
MIN_MOTA, MAX_SWITCHES, MAX_MEAN_ERROR_M = 0.9, 2, 0.10
"""Limits within which the demo counts as passed: MOTA, identity switches, mean position error [m]."""
_STEP_S = 0.1
"""Time between evaluated instants [s]."""
_WARM_UP_S = 5.0
"""Time in which cameras learn the background and the height model [s]; also scored without it."""
_KEPT_UP = 0.7  # of a camera's frames: beside this a walk has gaps of more than two frames
_MAX_EXTRAPOLATION_S = 0.25
"""Time after publication for which a track is extrapolated and counts [s]."""


class PeopleDemoProcesses(DemoProcesses):
    """The demo's processes with person detectors, and a hub with a given calibration."""

    _world_start_s = 6.0  # people are walking when the cameras start; at 0 all of them start to walk at once

    def __init__(self, settings: DemoSettings) -> None:
        super().__init__(settings)
        self.scene = scenes.get_people_scene(settings.seed, settings.cameras)

    def _tables(self) -> dict[str, dict[str, object]]:
        _, tables = camera_tables(self.scene, self.scene.name)
        # The world frame is that of the room: z is up.
        tables["metadata"]["up"] = [0.0, 0.0, 1.0]
        (self.out / "config" / KNOWN_CALIBRATION).write_text(tomli_w.dumps(tables), encoding="utf-8")
        agents = super()._tables()
        agents["hub"]["known"] = KNOWN_CALIBRATION
        for name in self.names:
            agents[name]["detector"] = "person"
        return agents

    def _make_listener(self, bus: Bus) -> Callable[[DemoProgress], None]:
        tracks = bus.subscribe(TRACK)
        latest: dict[str, pb.Track] = {}

        def poll_topics(live: DemoProgress) -> None:
            for received in tracks.drain():
                assert isinstance(received.message, pb.Track)
                latest[received.message.label] = received.message
            newest = max((track.reference_time_ns for track in latest.values()), default=0)
            now = [track for track in latest.values() if newest - track.reference_time_ns < NANOSECONDS]
            states = [track.state for track in now]
            walking = ", ".join(
                f"{track.label} ({track.position[0]:.1f}, {track.position[1]:.1f})"
                for track in sorted(now, key=lambda track: track.label)
                if track.state != "lost"
            )
            live.status = f"{states.count('confirmed')} followed, {states.count('coasting')} coasting: {walking}"

        return poll_topics


@dataclass(frozen=True, slots=True)
class PeopleComparison:
    """Tracking scores of a log against the scene.

    on_floor, in_space: scores of floor positions and of 3-D body centres [m], from the first frame on. begun: on the
    floor, without the first 5 s; no limits apply to it. frames: number by camera. fps: that a camera films.
    """

    on_floor: MotScores
    in_space: MotScores
    begun: MotScores
    seconds: float
    people: int
    frames: dict[str, int]
    fps: float

    @property
    def good(self) -> bool:
        """Whether the scores are within the limits of the demo."""
        s = self.on_floor
        return s.mota >= MIN_MOTA and s.switches <= MAX_SWITCHES and s.error <= MAX_MEAN_ERROR_M

    def as_json(self) -> str:
        """The comparison as one JSON object."""
        document = {"good": self.good, **asdict(self)}
        for part in ("on_floor", "in_space", "begun"):
            document[part] = {key: value if np.isfinite(value) else None for key, value in document[part].items()}
        return json.dumps(document)

    def print(self, out: Path) -> None:
        """Print the comparison as a table."""
        from rich.table import Table

        from deploy.offline.outputs import wide_console

        console = wide_console()
        table = Table(title="tracks against ground truth", title_justify="left")
        for column in ("", "limit", "on the floor", "in space", f"floor, {_WARM_UP_S:.0f} s on"):
            table.add_column(column, justify="left" if not column else "right")
        scores = (self.on_floor, self.in_space, self.begun)
        table.add_row("MOTA", f">= {MIN_MOTA}", *(f"{s.mota:.3f}" for s in scores))
        table.add_row("IDF1", "", *(f"{s.idf1:.3f}" for s in scores))
        table.add_row("identity switches", f"<= {MAX_SWITCHES}", *(str(s.switches) for s in scores))
        table.add_row("mean error [cm]", f"<= {100 * MAX_MEAN_ERROR_M:.0f}", *(f"{100 * s.error:.1f}" for s in scores))
        table.add_row("95 % within [cm]", "", *(f"{100 * s.error_p95:.1f}" for s in scores))
        table.add_row("missed", "", *(str(s.misses) for s in scores))
        table.add_row("false", "", *(str(s.false) for s in scores))
        console.print(table)
        console.print(
            f"{self.people} people for {self.seconds:.0f} s, {self.on_floor.truths} true positions,  "
            f"{self.on_floor.labels} track labels"
        )
        console.print("within the limits" if self.good else "NOT within the limits")
        rate = min(self.frames.values(), default=0) / max(self.seconds, 1e-9)
        if not self.good and rate < _KEPT_UP * self.fps:
            share = f"{rate:.1f} of {self.fps:g} frames a second"
            console.print(f"this machine searched {share}: close other programs, or give fewer --cameras")
        console.print(f"log {out / LOG}, tracks {out / 'tracks.csv'}", soft_wrap=True)
        known = out / "config" / KNOWN_CALIBRATION
        again = f"syncline replay {out / LOG} --through hub --calibration {known} --out again.mcap"
        console.print(f"again from the log: {again}", soft_wrap=True)


def compare_with_people(folder: Path, seed: int, cameras: int) -> PeopleComparison:
    """Score the tracks in a demo's log against the scene, and write them to tracks.csv."""
    scene = scenes.get_people_scene(seed, cameras)
    comparison, rows = score_log(folder / LOG, scene)
    header = "time,label,state,x,y,z,vx,vy,vz,heading,height"
    write_atomically(folder / "tracks.csv", "\n".join([header, *rows]) + "\n")
    return comparison


def score_log(log: Path, scene: PeopleScene) -> tuple[PeopleComparison, list[str]]:
    """Evaluate one log; returns the comparison, and its tracks as CSV rows."""
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
        _evaluation_frame(scene, float(time), reference.clock.device_time_ns(float(time)), tracks)
        for time in np.arange(begin, end, _STEP_S)
    ]
    flat = [EvaluationFrame(m.truth_names, m.truth[:, :2], m.estimate_labels, m.found[:, :2]) for m in moments]
    return PeopleComparison(
        on_floor=clear_mot(flat, MAX_MATCH_DISTANCE_M),
        in_space=clear_mot(moments, MAX_MATCH_DISTANCE_M),
        begun=clear_mot(flat[round(_WARM_UP_S / _STEP_S) :], MAX_MATCH_DISTANCE_M),
        seconds=max(end - begin, 0.0),
        people=len(scene.people),
        frames=dict(frames),
        fps=reference.fps,
    ), rows


def _evaluation_frame(
    scene: PeopleScene, time: float, reference_ns: int, tracks: dict[str, list[pb.Track]]
) -> EvaluationFrame:
    """True positions, and the estimates for that moment: the last published one, extrapolated by its own velocity."""
    names, places = [], []
    for label, published in tracks.items():
        times = [track.reference_time_ns for track in published]
        index = int(np.searchsorted(times, reference_ns, side="right")) - 1
        if index < 0 or published[index].state == "lost":
            continue
        elapsed = (reference_ns - times[index]) / NANOSECONDS
        if elapsed <= _MAX_EXTRAPOLATION_S:
            names.append(label)
            places.append(np.array(published[index].position) + elapsed * np.array(published[index].velocity))
    truth = scene.centres(np.array([time]))[0]
    found = np.array(places).reshape(-1, 3)
    return EvaluationFrame(tuple(person.name for person in scene.people), truth, tuple(names), found)


def _row(track: pb.Track) -> str:
    numbers = [*track.position, *track.velocity]
    angle = f"{track.heading:.17g}" if track.HasField("heading") else ""
    cells = ",".join(f"{number:.17g}" for number in numbers)
    return (
        f"{track.reference_time_ns / NANOSECONDS:.9f},{track.label},{track.state},{cells},{angle},{track.height:.17g}"
    )
