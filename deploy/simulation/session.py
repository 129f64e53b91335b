"""Writes a session of a simulated marker scene: a session folder with its ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from edge import scenes
from edge.scenes.common.base import SimulatedScene
from edge.scenes.marker.session import SimulatedTrack, SimulatedTracks, simulate_tracks
from edge.scenes.people.session import PeopleTrack
from protocols.core.errors import InputError
from protocols.core.files import write_atomically
from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, write_observations, write_rig
from protocols.session.observations import DEFAULT_LABEL, Observations, gather_tracks

TRUTH_CALIBRATION, TRUTH_TRAJECTORY = "truth_calibration.toml", "truth_trajectory.csv"
_TRUTH_HZ = 50.0  # above every camera's frame rate


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
    simulated = simulate_tracks(
        scene, seconds, seed, pixel_noise=noise_px, outlier_fraction=outliers, drop_fraction=drops
    )
    rows = sum(len(track) for track in simulated.tracks.values())
    if not rows:
        raise InputError("no camera saw the marker", remedy="simulate a longer time or use another seed")
    write_scene(out, scene, scene_name, simulated.tracks)
    _write_truth_trajectory(out / TRUTH_TRAJECTORY, simulated)
    return {"scene": scene_name, "seed": seed, "cameras": len(scene.cameras), "rows": rows, "seconds": seconds}


def write_scene(
    out: Path,
    scene: SimulatedScene,
    name: str,
    tracks: Mapping[str, SimulatedTrack | PeopleTrack],
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


def simulated_observations(scene: SimulatedScene, tracks: Mapping[str, SimulatedTrack | PeopleTrack]) -> Observations:
    """The simulated detections as a session's observations; of people with two labels each."""
    found = list(tracks.values())
    return gather_tracks(
        [track.camera for track in found for _ in range(len(track))],
        [label for track in found for label in getattr(track, "label", (DEFAULT_LABEL,) * len(track))],
        np.concatenate([track.frame for track in found]),
        np.concatenate([track.time for track in found]),
        np.concatenate([track.pixels for track in found]),
        np.concatenate([track.size for track in found]),
        order=[camera.name for camera in scene.cameras],
    )


def _write_truth_trajectory(file: Path, simulated: SimulatedTracks) -> None:
    """Write time,x,y,z of the marker, with times on the first camera's clock."""
    first = simulated.cameras[0]
    true_time = np.arange(simulated.start, simulated.end, 1.0 / _TRUTH_HZ)
    epoch = first.clock.epoch_ns / 1e9
    camera_time = epoch + first.clock.rate * true_time
    position = simulated.scene.marker_position(true_time)
    lines = ["time,x,y,z"]
    lines += [f"{t:.17g},{x:.17g},{y:.17g},{z:.17g}" for t, (x, y, z) in zip(camera_time, position, strict=True)]
    write_atomically(file, "\n".join(lines) + "\n")
