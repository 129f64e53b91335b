"""Accuracy against duration and speed of the marker's motion: four webcams in the shipped room.

python -m tests.bench.waving      seeds from 7000 on, not used for tuning
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from deploy.simulation.session import simulated_observations
from edge import scenes
from edge.scenes.marker.scene import simulate_tracks
from hub.calibration.pipeline import calibrate
from protocols.core.clocks import CameraTime
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from tests.support.written import rig_of_scene

FIRST_SEED = 7000
CAMERAS = 4


@dataclass(frozen=True)
class Paced:
    """A path traversed at another speed."""

    path: Any
    rate: float

    def position(self, times: Floats) -> Floats:
        """(n, 3) [m]."""
        return np.asarray(self.path.position(self.rate * times))


def one(seed: int, seconds: float, rate: float) -> tuple[float, int, float]:
    """Mean speed [m/s], cameras solved, largest error of an offset [ms] (NaN where fewer than two are solved)."""
    scene = scenes.get_marker_scene("marker", seed, CAMERAS)
    scene = replace(scene, path=Paced(scene.path, rate))
    filmed = simulate_tracks(scene, seconds, seed, pixel_noise=0.5, outlier_fraction=0.02, drop_fraction=None)
    times = np.linspace(0.0, seconds, 200)
    positions = scene.marker_position(times)
    speed = float(np.mean(np.linalg.norm(np.diff(positions, axis=0), axis=1)) / (times[1] - times[0]))
    try:
        found = calibrate(rig_of_scene(scene), simulated_observations(scene, filmed))
    except Refused:
        return speed, 0, float("nan")
    reference = found.reference
    errors = []
    for name, camera in found.cameras.items():
        truth = scene.true_time_map(name, reference)
        middle = float(np.median(filmed[name].time))
        moment = CameraTime(middle)
        off = camera.time_map.reference_from_camera(moment) - truth.reference_from_camera(moment)
        errors.append(1e3 * abs(off))
    return speed, len(found.cameras), max(errors)


def main() -> None:
    """Prints one row a length and speed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    arguments = parser.parse_args()
    print("seconds  speed m/s  rigs with all 4 cameras  worst offset ms: median, largest")
    for seconds, rate in ((5, 1.0), (10, 1.0), (20, 1.0), (40, 1.0), (20, 0.5), (20, 0.25)):
        rows = [one(FIRST_SEED + k, seconds, rate) for k in range(arguments.seeds)]
        speed = np.mean([row[0] for row in rows])
        whole = [row[2] for row in rows if row[1] == CAMERAS]
        error_text = f"{np.median(whole):.3f}, {max(whole):.3f}" if whole else "-"
        print(f"{seconds:7d}  {speed:9.2f}  {len(whole)} of {len(rows)}  {error_text}", flush=True)


if __name__ == "__main__":
    main()
