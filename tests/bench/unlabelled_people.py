"""Cameras calibrated by unlabelled people.

    python -m tests.bench.unlabelled_people [--seeds 3] [--halls 6] [--long]

crowd: the boxes of ``../shared/data/crowd``, spoilt as by ``tests.bench.crowd``, without poses, against the
calibration that comes with them; one shared clock. hall: simulated halls (``tests.bench.hall``)
whose cameras share no clock, begin up to 15 s late, and take their frames spread over 16/60 s. --long: halls of 5 and
10 minutes instead, of which each camera films from up to 40 % to 70 % or later. Prints the cameras that
are placed, the worst position [cm] and rotation [deg] after one similarity, the worst lag [ms] and error over its std,
and CPU seconds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deploy.offline.people_session import read_people
from hub.calibration.people.unlabelled import calibrate_people
from protocols.core.errors import Refused
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration, read_calibration
from protocols.session.folder import write_rig
from protocols.session.rig import Rig, RigCamera
from tests.bench import hall
from tests.bench.crowd import spoilt_boxes
from tests.bench.real_rigs import DEFAULT_DATA
from tests.bench.scoring import pose_differences

SPREAD_S = 16.0 / hall.STEPS_HZ  # whole steps of the walk, so that every camera sees people where they are
LATEST_S = 15.0
LATEST, EARLIEST = 0.4, 0.7  # shares of a long recording between which all cameras film
LONG = ((3, 5, 30.0, 300.0, 6.0), (4, 4, 2.0, 600.0, 6.0), (3, 4, 10.0, 600.0, 6.0))
"""Cameras, people, frames a second, seconds, half the side [m] of the long halls."""


def crowd(data: Path, spoil: float, seed: int) -> str:
    """The row of the crowd's boxes with one seed of spoiling."""
    _, truth = read_calibration(data / "calibration.toml")
    tables = {
        name: {"name": name, "size": [camera.intrinsics.width, camera.intrinsics.height], "fps": 2.0}
        | {"matrix": camera.intrinsics.matrix.tolist(), "distortions": [0.0] * 5}
        for name, camera in truth.items()
    }
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        text = spoilt_boxes(data / "boxes.csv", data / "calibration.toml", spoil, seed)
        (folder / "boxes.csv").write_text(text, encoding="utf-8")
        write_rig(folder / "rig.toml", {"metadata": {"clock": "shared"}, **tables})
        rig, people, _ = read_people(folder / "boxes.csv", folder / "rig.toml")
    return row(rig, people, truth)


def simulated(seed: int, cameras: int, people: int, fps: float, seconds: float, half: float, long: bool = False) -> str:
    """The row of a hall."""
    made = hall.simulated(seed, cameras, people, fps, seconds, half, lag=SPREAD_S)
    truth = made.calibration.cameras
    rng = np.random.default_rng(seed)
    latest, earliest = (LATEST * seconds, EARLIEST * seconds) if long else (LATEST_S, seconds + SPREAD_S)
    begins = dict(zip(truth, rng.uniform(0.0, latest, len(truth)), strict=True))
    ends = dict(zip(truth, rng.uniform(earliest, seconds + SPREAD_S, len(truth)), strict=True))
    rig = Rig(
        {name: RigCamera(name=name, size=hall.SIZE, fps=fps, intrinsics=truth[name].intrinsics) for name in truth}
    )
    return row(rig, [one for moment, one in made.messages if begins[one.camera] <= moment <= ends[one.camera]], truth)


def row(rig: Rig, people: Sequence[pb.Observation], truth: dict[str, CameraCalibration]) -> str:
    """Errors of the calibration, or why there is none."""
    began = time.process_time()
    try:
        found, _ = calibrate_people(rig, people)
    except Refused as refusal:
        return f"refused: {refusal.reason[:90]}"
    cpu = time.process_time() - began
    cameras, base = found.cameras, truth[found.reference].time_map.time_offset
    poses = pose_differences({n: c.pose for n, c in cameras.items()}, {n: truth[n].pose for n in cameras})
    lags = {name: camera.lag - truth[name].time_map.time_offset + base for name, camera in cameras.items()}
    sizes = [abs(lag) / cameras[name].lag_std for name, lag in lags.items() if cameras[name].lag_std > 0.0]
    position, rotation = np.max(list(poses.values()), axis=0)
    return (
        f"{len(cameras)} of {len(rig.cameras)}  {100.0 * position:6.1f} cm  {np.rad2deg(rotation):5.2f}°  "
        f"{1e3 * max(map(abs, lags.values())):6.1f} ms {max(sizes, default=0.0):4.1f}  {cpu:5.1f} s"
    )


def main() -> int:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder of the recordings")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds of the crowd's spoiling")
    parser.add_argument("--spoil", type=float, default=1.0, help="factor of misses, noise and false boxes; 0 = none")
    parser.add_argument("--halls", type=int, default=6, help="number of halls")
    parser.add_argument("--long", action="store_true", help="long halls only")
    parser.add_argument("--first", type=int, default=0, help="first seed of both")
    options = parser.parse_args()
    for seed, kind in enumerate(LONG if options.long else (), options.first):
        words = "{} cameras, {} people, {:g} fps, {:g} s".format(*kind)
        print(f"long hall {seed}, {words}: {simulated(seed, *kind, long=True)}", flush=True)
    if options.long:
        return 0
    if (options.data / "crowd" / "boxes.csv").is_file():
        for seed in range(options.first, options.first + options.seeds):
            print(
                f"crowd {seed}, spoil {options.spoil:g}: {crowd(options.data / 'crowd', options.spoil, seed)}",
                flush=True,
            )
    for seed in range(options.first, options.first + options.halls):
        kind = (3 + seed % 4, 3 + seed % 6, (10.0, 5.0, 30.0)[seed % 3], 60.0, (6.0, 5.0, 8.0)[seed % 3])
        words = "{} cameras, {} people, {:g} fps, {:g} s".format(*kind)
        print(f"hall {seed}, {words}: {simulated(seed, *kind)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
