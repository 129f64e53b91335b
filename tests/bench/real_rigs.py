"""Figures on real recordings: two drone flights filmed by four cameras each, and four webcams.

`python -m tests.bench.real_rigs --data FOLDER`: every session folder in it that has a truth_trajectory.csv (RTK),
and webcams/session. The recordings are not part of the project; where FOLDER is
absent this is reported, with exit status 0.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hub.calibration.pipeline import calibrate
from protocols.core.clocks import TimeMap
from protocols.geometry.types import Floats
from protocols.session.calibration import (
    CameraCalibration,
    FixedCalibration,
    read_calibration,
)
from protocols.session.observations import Observations, read_observations
from protocols.session.rig import read_rig
from tests.bench import board_rotation, scoring
from tests.bench.resection import Resection, resect

REPOSITORY = Path(__file__).resolve().parents[2]
DEFAULT_DATA = REPOSITORY.parent / "shared" / "data"

# CPU seconds; 3-D error mean, median, RMSE, p95 [cm] that mvus reached with good initial offsets
MVUS = {
    ("drone1", "observations.csv"): (53, 3.9, 2.8, 4.9, 9.4),
    ("drone2", "observations.csv"): (104, 10.5, 7.9, 12.8, 28.9),
    ("drone1", "observations_auto.csv"): (41, 7.6, 6.3, 8.8, 16.5),
    ("drone2", "observations_auto.csv"): (40, 14.1, 12.0, 16.6, 32.5),
}
# mean 3-D error [cm] and coverage [%] that the project demands of itself
LIMITS = {
    ("drone1", "observations.csv"): (5.0, 97.0),
    ("drone2", "observations.csv"): (8.0, 97.0),
    ("drone1", "observations_auto.csv"): (10.0, 92.0),
    ("drone2", "observations_auto.csv"): (11.0, 92.0),
}
_WORST_LAG_MS, _MOST_CPU = 10.0, 5.0
_SHIFTS_SEED = 20240517
_MS = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One run of calibrate: what it wrote, its CPU and wall seconds (whole command), and times of clock steps [s]."""

    cameras: dict[str, CameraCalibration]
    path_time: dict[str, Floats]
    path: dict[str, Floats]
    cpu: float
    wall: float
    steps: dict[str, list[float]]


class CommandFailed(Exception):
    """calibrate left with a status other than 0."""


def run_calibrate(session: Path, observations: str, refine_lenses: bool = False) -> Run:
    """Run the real command line and read what it wrote."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        before, began = cpu_seconds(), time.perf_counter()
        _run_command(session, observations, out, refine_lenses)
        cpu, wall = cpu_seconds() - before, time.perf_counter() - began
        _, cameras = read_calibration(out / "calibration.toml")
        times, paths = _read_paths(out / "trajectory.csv")
        tables = json.loads((out / "result.json").read_text(encoding="utf-8"))["cameras"]
        steps = {name: [step["time_s"] for step in table["clock_steps"]] for name, table in tables.items()}
    return Run(cameras, times, paths, cpu, wall, steps)


def cpu_seconds() -> float:
    """Seconds of processor time of this process and of its finished children."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def _run_command(session: Path, observations: str, out: Path, refine_lenses: bool) -> None:
    arguments = ["calibrate", str(session), "--out", str(out), "--observations", str(session / observations)]
    arguments += ["--refine-lenses"] if refine_lenses else []
    cached = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(
        [sys.executable, "-c", "from deploy.cli import main; main()", *arguments],
        cwd=REPOSITORY,
        env=cached,  # as after an installation, where modules are compiled
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise CommandFailed(f"status {done.returncode}: {done.stderr.strip()[-500:]}")


def _read_paths(file: Path) -> tuple[dict[str, Floats], dict[str, Floats]]:
    rows: dict[str, list[list[float]]] = {}
    with file.open(encoding="utf-8", newline="") as text:
        for row in csv.DictReader(text):
            rows.setdefault(row.get("label") or "", []).append([float(row[key]) for key in ("time", "x", "y", "z")])
    tables = {label: np.array(values) for label, values in rows.items()}
    return {k: v[:, 0] for k, v in tables.items()}, {k: v[:, 1:] for k, v in tables.items()}


def drone(session: Path, observations: str, refine_lenses: bool) -> bool:
    """Score one flight and print it; whether the demanded figures are met.

    refine_lenses: the lens data that come with the flights are off by up to 2 %.
    """
    name = f"{session.name}, {'by hand' if observations == 'observations.csv' else 'automatic'} ({observations})"
    name += ", lenses refined" if refine_lenses else ", lenses as given"
    try:
        run = run_calibrate(session, observations, refine_lenses)
    except CommandFailed as error:
        print(f"{name}: {error}")
        return False
    rig = read_rig(session / "rig.toml")
    seen = read_observations(session / observations, rig.cameras)
    table = np.loadtxt(session / "truth_trajectory.csv", delimiter=",", skiprows=1)
    label = next(iter(run.path))
    fit = scoring.align(run.path_time[label], run.path[label], table[:, 0], table[:, 1:])
    covered = 100 * scoring.coverage(run.path_time[label], _seen_times(run, seen))
    figures = [100 * value for value in fit.figures()]
    limit, least = LIMITS.get((session.name, observations), (float("inf"), 0.0))
    lags = _lags(run, seen, fit, table)
    missed = [
        text
        for text, bad in (
            (f"mean > {limit:g} cm", figures[0] > limit),
            (f"coverage < {least:g} %", covered < least),
            (f"a lag off by > {_WORST_LAG_MS:g} ms", lags.worst > _WORST_LAG_MS),
            (f"CPU > {_MOST_CPU:g} s", run.cpu > _MOST_CPU),
        )
        if bad
    ]
    print(f"\n{name}: {'NOT MET: ' + ', '.join(missed) if missed else 'met'}")
    print("            mean  median  RMSE   p95 cm   coverage    CPU s   wall s")
    columns = " ".join(f"{value:6.2f}" for value in figures)
    print(f"  syncline {columns}    {covered:6.1f} %   {run.cpu:6.2f}   {run.wall:6.2f}")
    if (session.name, observations) in MVUS:
        theirs = MVUS[session.name, observations]
        columns = " ".join(f"{value:6.1f}" for value in theirs[1:])
        print(f"  mvus     {columns}         – %   {theirs[0]:6.0f}        –")
    print(
        f"  {len(fit.error)} moving rows of the truth; rate {1e6 * (fit.rate - 1):+.0f} ppm, offset {fit.offset:+.3f} s"
    )
    for line in lags.lines:
        print(f"  {line}")
    return not missed


@dataclass(frozen=True, slots=True)
class Lags:
    """Lags against the resections: what to print, and the worst [ms]."""

    lines: tuple[str, ...]
    worst: float


def _seen_times(run: Run, seen: Observations) -> list[Floats]:
    out = []
    for name, camera in run.cameras.items():
        parts = [track.time for track in seen.of_camera(name)]
        times = np.sort(np.concatenate(parts)) if parts else np.zeros(0)
        out.append(np.asarray(camera.time_map.clock_rate * times + camera.time_map.time_offset))
    return out


def _lags(run: Run, seen: Observations, fit: scoring.Alignment, table: Floats) -> Lags:
    """Lags against each camera's own resection on the truth, which uses nothing of the others."""
    found: dict[str, Resection] = {}
    lines = []
    for name, camera in run.cameras.items():
        clock = camera.time_map
        start = TimeMap(fit.rate * clock.clock_rate, fit.rate * clock.time_offset + fit.offset)
        track = seen.of_camera(name)[0]
        lens = camera.intrinsics
        whole = np.ones(len(track.time), dtype=np.bool_)
        for step in run.steps[name]:  # the resection has one clock: that of the longer side, as the map
            middle = 0.5 * (track.time[0] + track.time[-1])
            whole &= (track.time < step) == (middle < step)
        try:
            found[name] = resect(lens, track.time[whole], track.pixels[whole], start, table[:, 0], table[:, 1:])
        except ValueError as error:
            lines.append(f"{name}: {error}")
    spans = dict(zip(run.cameras, _seen_times(run, seen), strict=True))
    differences = {}
    for a, b in itertools.combinations(found, 2):
        begin, end = max(spans[a][0], spans[b][0]), min(spans[a][-1], spans[b][-1])
        maps = run.cameras[a].time_map, run.cameras[b].time_map, found[a].time_map, found[b].time_map
        differences[a, b] = _MS * scoring.lag_difference(*maps, 0.5 * (begin + end))
    if not differences:
        return Lags((*lines, "no two cameras could be resected on the truth"), float("inf"))
    sizes = np.abs(list(differences.values()))
    median, worst = float(np.median(sizes)), float(sizes.max())
    texts = ", ".join(f"{a}–{b} {value:+.1f}" for (a, b), value in differences.items())
    lines.append(f"lags against resection on the truth: median {median:.1f} ms, worst {worst:.1f} ms ({texts})")
    texts = "; ".join(
        f"{name} {part.median_px:.2f} px, focal × {part.focal_scale:.4f}, time ± {_MS * part.time_std:.1f} ms, errors "
        f"{part.errors.white_px:.2f} px white, {part.errors.correlated_px:.2f} px correlated over "
        f"{part.errors.time_constant:.1f} s"
        for name, part in found.items()
    )
    return Lags((*lines, f"resection: {texts}"), worst)


def webcams(session: Path) -> bool:
    """Shift each clock by random seconds, and compare offsets and poses; whether the figures are met."""
    random = np.random.default_rng(_SHIFTS_SEED)
    rig = read_rig(session / "rig.toml")
    shifts = {name: float(random.uniform(-60, 60)) for name in rig.cameras}
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        shutil.copy(session / "rig.toml", copy / "rig.toml")
        with (session / "observations.csv").open(encoding="utf-8", newline="") as text:
            reader = csv.DictReader(text)
            columns, rows = list(reader.fieldnames or []), list(reader)
        with (copy / "observations.csv").open("w", encoding="utf-8", newline="") as text:
            writer = csv.DictWriter(text, columns)
            writer.writeheader()
            writer.writerows({**row, "time": repr(float(row["time"]) + shifts[row["camera"]])} for row in rows)
        try:
            run = run_calibrate(copy, "observations.csv")
        except CommandFailed as error:
            print(f"\nwebcams: {error}")
            return False
        seen = read_observations(copy / "observations.csv", rig.cameras)
    _, truth = read_calibration(session / "truth_calibration.toml")
    missing = [name for name in truth if name not in run.cameras]
    reference = next(iter(run.cameras))
    offsets = {}
    for name, camera in run.cameras.items():
        middle = float(np.median(np.concatenate([track.time for track in seen.of_camera(name)])))
        mapped = camera.time_map.clock_rate * middle + camera.time_map.time_offset
        offsets[name] = _MS * (mapped - (middle + shifts[reference] - shifts[name]))
    apart = scoring.pose_differences(
        {name: camera.pose for name, camera in run.cameras.items()},
        {name: camera.pose for name, camera in truth.items()},
    )
    worst_ms = max(abs(value) for value in offsets.values())
    worst_cm = max(100 * distance for distance, _ in apart.values())
    worst_degrees = max(float(np.degrees(angle)) for _, angle in apart.values())
    good = not missing and worst_ms <= 15 and worst_cm <= 1 and worst_degrees <= 0.5
    print(f"\nwebcams, clocks shifted: {'met' if good else 'NOT MET'} (15 ms, 1 cm, 0.5°)")
    print(f"  worst: {worst_ms:.1f} ms, {worst_cm:.2f} cm, {worst_degrees:.2f}°; CPU {run.cpu:.2f} s")
    for name, (distance, angle) in apart.items():
        camera = run.cameras[name]
        print(
            f"  {name}: {offsets[name]:+8.1f} ms ± {_MS * camera.time_offset_std:.1f}, "
            f"rate {1e6 * (camera.time_map.clock_rate - 1):+.0f} ppm, "
            f"{100 * distance:.2f} cm, {np.degrees(angle):.2f}°, {camera.rms_px:.2f} px"
        )
    if missing:
        print(f"  refused: {', '.join(missing)}")
    for line in (_with_given_poses(session), *_board_lags(session, offsets)):
        print(f"  {line}")
    return good


def _with_given_poses(session: Path) -> str:
    """Offsets [ms] estimated from the images with the given poses fixed."""
    rig = read_rig(session / "rig.toml")
    seen = read_observations(session / "observations.csv", rig.cameras)
    _, given = read_calibration(session / "truth_calibration.toml")
    found = calibrate(rig, seen, known=FixedCalibration(given, "metric"))
    texts = []
    for name, camera in found.cameras.items():
        middle = float(np.median(np.concatenate([track.time for track in seen.of_camera(name)])))
        offset = camera.time_map.clock_rate * middle + camera.time_map.time_offset - middle
        texts.append(f"{name} {_MS * offset:+.1f} ms, {camera.rms_px:.2f} px")
    return f"with the given poses held: {'; '.join(texts)}"


def _board_lags(session: Path, offsets: dict[str, float]) -> list[str]:
    """Offset of each camera's images against its stamps from the board's attitude alone, beside the offsets [ms]."""
    rig = read_rig(session / "rig.toml")
    seen = read_observations(session / "observations.csv", rig.cameras)
    turns = {
        name: board_rotation.attitudes(seen, name, camera.intrinsics)
        for name, camera in rig.cameras.items()
        if name in offsets and camera.intrinsics is not None
    }
    lines = []
    for a, b in itertools.combinations(turns, 2):
        found = board_rotation.lag(turns[a], turns[b])
        if found is not None:
            texts = f"{-_MS * found[0]:+.0f} ± {_MS * found[1]:.0f} ms"
            lines.append(
                f"{b} against {a}: {texts} by the board's attitude alone, {offsets[b] - offsets[a]:+.0f} ms here"
            )
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Print all figures. Status 0 where they are met or there is no data, else 1."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.real_rigs", description=__doc__)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder with drone1, drone2 and webcams")
    parser.add_argument("--only", default="", help="run only what contains this, e.g. drone2 or webcams")
    options = parser.parse_args(arguments)
    if not options.data.is_dir():
        print(f"no real recordings in {options.data}: nothing measured (give --data FOLDER)")
        return 0
    met = []
    for truth in sorted(options.data.glob("*/truth_trajectory.csv")):
        session = truth.parent
        if options.only in session.name:
            files = sorted(session.glob("observations*.csv"))
            met += [drone(session, file.name, refined) for file in files for refined in (True, False)]
    session = options.data / "webcams" / "session"
    if options.only in "webcams" and session.is_dir():
        met.append(webcams(session))
    print(f"\n{sum(met)} of {len(met)} met")
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
