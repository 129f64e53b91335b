"""Writes a session of a simulated marker scene: a session folder with its ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from edge import scenes
from edge.scenes.common.base import SimulatedScene, SimulatedTrack
from edge.scenes.marker.scene import simulate_tracks
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.files import write_atomically
from protocols.geometry.types import Floats
from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, write_observations, write_rig
from protocols.session.observations import Observations, gather_tracks

TRUTH_CALIBRATION, TRUTH_TRAJECTORY = "truth_calibration.toml", "truth_trajectory.csv"
TRUTH_HZ = 50.0  # above every camera's frame rate


def write_simulated_session(
    scene_name: str,
    out: Path,
    *,
    seconds: float,
    cameras: int | None,
    seed: int,
    noise_px: float,
    outliers: float,
    drops: float | None,
) -> dict[str, Any]:
    """Simulate a scene and write the session folder; returns counts. Raises InputError."""
    scene = scenes.get_marker_scene(scene_name, seed, cameras)
    tracks = simulate_tracks(scene, seconds, seed, pixel_noise=noise_px, outlier_fraction=outliers, drop_fraction=drops)
    rows = sum(len(track) for track in tracks.values())
    if not rows:
        raise InputError("no camera saw the marker", remedy="simulate a longer time or use another seed")
    write_scene(out, scene, scene_name, tracks)
    time, shown = true_times(scene, seconds, TRUTH_HZ)
    position = scene.marker_position(time)
    lines = [f"{t:.17g},{x:.17g},{y:.17g},{z:.17g}" for t, (x, y, z) in zip(shown, position, strict=True)]
    write_atomically(out / TRUTH_TRAJECTORY, "\n".join(["time,x,y,z", *lines]) + "\n")
    return {"scene": scene_name, "seed": seed, "cameras": len(scene.cameras), "rows": rows, "seconds": seconds}


def write_scene(
    out: Path,
    scene: SimulatedScene,
    name: str,
    tracks: Mapping[str, SimulatedTrack],
    metadata: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write rig.toml, observations.csv and the true calibration of a scene; returns the tables of the latter.

    metadata: more for these. Raises InputError.
    """
    out.mkdir(parents=True, exist_ok=True)
    rig, truth = camera_tables(scene, name)
    truth["metadata"].update(metadata or {})
    write_rig(out / RIG_FILE, rig)
    write_observations(out / OBSERVATIONS_FILE, simulated_observations(scene, tracks))
    write_atomically(out / TRUTH_CALIBRATION, tomli_w.dumps(truth))
    return truth


def camera_tables(scene: SimulatedScene, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tables of rig.toml of a scene, and of the true calibration.toml, in the scene's world frame in metres."""
    reference = scene.cameras[0].name
    metadata = {"name": name, "units": "m"}
    rig: dict[str, Any] = {"metadata": metadata}
    truth: dict[str, Any] = {"metadata": {**metadata, "reference": reference, "scale": "metric"}}
    for camera in scene.cameras:
        rig[camera.name] = {"name": camera.name, "fps": camera.fps, **camera.intrinsics.table()}
        time_map = scene.true_time_map(camera.name, reference)
        truth[camera.name] = {
            **rig[camera.name],
            "rotation": camera.pose.rodrigues.tolist(),
            "translation": camera.pose.translation.tolist(),
            "time_offset": time_map.time_offset,
            "clock_rate": time_map.clock_rate,
        }
    return rig, truth


def simulated_observations(scene: SimulatedScene, tracks: Mapping[str, SimulatedTrack]) -> Observations:
    """The simulated detections as a session's observations; of people with two labels each."""
    found = list(tracks.values())
    return gather_tracks(
        [track.camera for track in found for _ in range(len(track))],
        [label for track in found for label in track.label],
        np.concatenate([track.frame for track in found]),
        np.concatenate([track.time for track in found]),
        np.concatenate([track.pixels for track in found]),
        np.concatenate([track.size for track in found]),
        order=[camera.name for camera in scene.cameras],
    )


def true_times(scene: SimulatedScene, seconds: float, rate_hz: float) -> tuple[Floats, Floats]:
    """True times (n,) [s] from 0 on, and what the first camera's clock shows then [s]."""
    clock, time = scene.cameras[0].clock, np.arange(0.0, seconds, 1.0 / rate_hz)
    return time, np.asarray(clock.epoch_ns / NANOSECONDS + clock.rate * time)
