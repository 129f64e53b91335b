"""Every bench of accuracy in turn, each in a process of its own: `make benches`, `make benches QUICK=1 DATA=FOLDER`.

    python -m tests.bench.every [--quick] [--data FOLDER] [--only pair_timing,poses]

Quick: fewer trials, a few minutes. Benches that need recordings say so where FOLDER has none. Leaves with status
1 if a bench did: figures that are missed, or a bench that could not be run.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tests.bench.real_rigs import DEFAULT_DATA, REPOSITORY


@dataclass(frozen=True, slots=True)
class Bench:
    """quick, full: arguments. data: whether it takes --data."""

    what: str
    quick: tuple[str, ...] = ()
    full: tuple[str, ...] = ()
    data: bool = False


BENCHES = {
    "marker_detector": Bench("marker detector on rendered frames", ("--quick",)),
    "pair_timing": Bench(
        "two cameras over random rigs",
        ("--trials", "10", "--unrelated", "1", "--regimes", "clean,dropped,10 %,30/25,everything,overlap"),
        ("--jobs", "2"),
    ),
    "real_rigs": Bench("drone flights and webcams", data=True),
    "live": Bench("live hub, streams at their own pace", ("--only", "simulated", "--seconds", "60"), data=True),
    "board_clips": Bench("clips of a moved board, lenses from the same clips", ("--worlds", "1"), data=True),
    "simulated_rigs": Bench(
        "five cameras, twenty cameras, pairs cut short",
        ("--sessions", "4", "--seconds", "120", "--only", "five,twenty"),
        data=True,
    ),
    "unlabelled_people": Bench("cameras by unlabelled people", ("--seeds", "1", "--halls", "1"), data=True),
    "drone_pairs": Bench("two cameras that share 20 s of a drone, simulated", ("--sessions", "20")),
    "lasting_errors": Bench(
        "four cameras of a drone, labels' errors last for seconds", ("--sessions", "3"), ("--compare",)
    ),
    "real_life": Bench("sessions as people bring them, one trouble a row", ("--sessions", "1")),
    "video_folder": Bench(
        "a folder of videos, with and without measured lenses",
        ("--seconds", "15", "--cameras", "4", "--size", "640x360"),
    ),
    "waving": Bench("how long and how fast a marker is waved", ("--seeds", "1")),
    "lenses": Bench("focal lengths that nobody measured", ("--sessions", "3")),
    "shared_clock": Bench("separate points against the optimum", ("--seeds", "5")),
    "broken_cameras": Bench("what one broken camera costs", ("--seeds", "1")),
    "street": Bench("a street of cameras, calibrated whole", ("--cameras", "20")),
    "poses": Bench("distributed poses against the joint optimum", ("--quick", "--rows", "section4,bearings")),
    "crowd": Bench("a crowd before seven cameras, boxes spoilt", ("--seeds", "2"), data=True),
    "hall": Bench("a simulated hall, offline and live", ("--people", "12", "--seconds", "6")),
    "logs": Bench("logs: rates, kill -9, damage", ("--quick",)),
    "view": Bench("help, first calibration, first paint, what watching costs", ("--quick",)),
    "people_detector": Bench("people before one camera, beside MOG2 alone", ("--seeds", "1", "--seconds", "20")),
    "people_clips": Bench("people counted in clips of a second or two", ("--seeds", "1")),
    "people_tracking": Bench(
        "people followed, what clocks are worth, walkers as markers", ("--quick", "--seconds", "30")
    ),
    "uav_tracker": Bench(
        "one car from a drone, simulated",
        ("--seeds", "1", "--models", "ground", "--scenarios", "exit-bend,exit-straight"),
        ("--jobs", "2"),
    ),
    "uav_agent": Bench(
        "UAV agent: latency, clocks, closed loops", ("--only", "latency,offset", "--seeds", "1"), data=True
    ),
    "uav_any_view": Bench(
        "any target in oblique views",
        ("--kinds", "rendered,rendered away", "--models", "ground"),
        data=True,
    ),
    "uav_aerial": Bench("one car from a drone, real video", ("--models", "ground"), data=True),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA)
    parser.add_argument("--only", default=",".join(BENCHES))
    options = parser.parse_args()
    wanted = options.only.split(",")
    unknown = [name for name in wanted if name not in BENCHES]
    if unknown:
        parser.error(f"no bench named {', '.join(unknown)}; there are {', '.join(BENCHES)}")
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    failed = []
    for name in wanted:
        bench = BENCHES[name]
        arguments = [*(bench.quick if options.quick else bench.full)]
        if bench.data:
            arguments += ["--data", str(options.data.resolve())]
        shown = " ".join(["python -m", f"tests.bench.{name}", *(f'"{a}"' if " " in a else a for a in arguments)])
        print(f"\n=== {bench.what}: {shown}", flush=True)
        began = time.perf_counter()
        status = subprocess.run([sys.executable, "-m", f"tests.bench.{name}", *arguments], cwd=REPOSITORY).returncode
        if status:
            failed.append(name)
        print(f"=== {time.perf_counter() - began:.0f} s", flush=True)
    if failed:
        print(f"figures missed, or not run: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
