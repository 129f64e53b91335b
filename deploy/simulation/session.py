"""Writes a session of a simulated scene: a session folder with its ground truth.

Of the scene ``people``: labelled head tops and foot points, and optional videos.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from edge import scenes
from edge.scenes import renderer_for
from edge.scenes.common.base import SimulatedScene, SimulatedTrack
from edge.scenes.marker.scene import simulate_tracks
from edge.scenes.people.scene import PeopleScene, simulate_people_tracks, visible_points
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.files import write_atomically
from protocols.geometry.types import Floats
from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, write_observations, write_rig
from protocols.session.observations import Observations, gather_tracks

TRUTH_CALIBRATION, TRUTH_TRAJECTORY = "truth_calibration.toml", "truth_trajectory.csv"
TRUTH_HZ = 50.0  # above every camera's frame rate
TRUTH_BOXES, TRUTH_PLACES = "truth_boxes.csv", "truth.csv"
TRUTH_VIDEO_CALIBRATION = "truth_video_calibration.toml"
_PLACES_HZ = 10.0  # a walk between two places takes seconds


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


def write_people_session(
    out: Path,
    *,
    seconds: float,
    cameras: int | None,
    people: int | None,
    seed: int,
    noise_px: float,
    drops: float | None,
    render: bool,
) -> dict[str, Any]:
    """Simulate the scene and write the session folder; returns counts. Raises InputError."""
    scene = scenes.get_people_scene(seed, cameras, people)
    tracks = simulate_people_tracks(scene, seconds, seed, pixel_noise=noise_px, drop_fraction=drops)
    rows = sum(len(track) for track in tracks.values())
    if not rows:
        raise InputError("no camera saw anybody", remedy="simulate a longer time or use another seed")
    truth = write_scene(out, scene, scene.name, tracks, {"up": [0.0, 0.0, 1.0]})
    _write_truth_trajectory(out / TRUTH_TRAJECTORY, scene, seconds)
    _write_truth_boxes(out / TRUTH_BOXES, scene, tracks)
    _write_truth_places(out / TRUTH_PLACES, scene, seconds)
    videos = [_write_video(out, scene, name, tracks[name], seed) for name in tracks] if render else []
    if render:
        # A video's times begin with 0 at its first frame: the clocks of the files are others than the cameras'.
        for name, track in tracks.items():
            rate, epoch = np.polyfit(track.frame - track.frame[0], track.time - track.time[0], 1)
            fps, clock = scene.camera(name).fps, truth[name]
            clock["time_offset"] += clock["clock_rate"] * (track.time[0] + float(epoch))
            clock["clock_rate"] *= float(rate) * fps
        write_atomically(out / TRUTH_VIDEO_CALIBRATION, tomli_w.dumps(truth))
    return {
        "scene": scene.name,
        "seed": seed,
        "cameras": len(scene.cameras),
        "people": len(scene.people),
        "rows": rows,
        "seconds": seconds,
        "videos": videos,
    }


def _write_truth_trajectory(file: Path, scene: PeopleScene, seconds: float) -> None:
    """Write time,x,y,z,label of head tops and foot points, with times on the first camera's clock."""
    true_time, camera_time = true_times(scene, seconds, TRUTH_HZ)
    lines = ["time,x,y,z,label"]
    for end, places in (("head", scene.heads(true_time)), ("foot", scene.feet(true_time))):
        for index, person in enumerate(scene.people):
            lines += [
                f"{t:.17g},{x:.17g},{y:.17g},{z:.17g},{person.name}-{end}"
                for t, (x, y, z) in zip(camera_time, places[:, index], strict=True)
            ]
    write_atomically(file, "\n".join(lines) + "\n")


def _write_truth_places(file: Path, scene: PeopleScene, seconds: float) -> None:
    """Write time,person,x,y of the foot points, with times on the first camera's clock."""
    true_time, camera_time = true_times(scene, seconds, _PLACES_HZ)
    lines = ["time,person,x,y"]
    for time, places in zip(camera_time, scene.feet(true_time), strict=True):
        for person, (x, y, _) in zip(scene.people, places, strict=True):
            lines.append(f"{time:.17g},{person.name},{x:.17g},{y:.17g}")
    write_atomically(file, "\n".join(lines) + "\n")


def _write_truth_boxes(file: Path, scene: PeopleScene, tracks: dict[str, SimulatedTrack]) -> None:
    """Write the bounding boxes of all people in every frame that shows somebody, ignoring occlusion."""
    lines = ["camera,frame,time,person,x,y,w,h,head_u,head_v,foot_u,foot_v,head_seen,foot_seen"]
    for name, track in tracks.items():
        frames, first = np.unique(track.frame, return_index=True)
        pixels, visible = visible_points(scene, name, track.true_time[first])
        for row, (frame, at) in enumerate(zip(frames, first, strict=True)):
            boxes = scene.boxes(name, float(track.true_time[at]))
            for index, person in enumerate(scene.people):
                if np.isfinite(boxes[index]).all() and np.isfinite(pixels[row, index]).all():
                    numbers = ",".join(f"{value:.3f}" for value in (*boxes[index], *pixels[row, index].ravel()))
                    visibility = ",".join(str(int(value)) for value in visible[row, index])
                    lines.append(f"{name},{frame},{track.time[at]:.17g},{person.name},{numbers},{visibility}")
    write_atomically(file, "\n".join(lines) + "\n")


def _write_video(out: Path, scene: PeopleScene, name: str, track: SimulatedTrack, seed: int) -> str:
    """Render the camera's frames into a video of constant frame rate; a lost frame repeats the one before it."""
    from edge.devices.playback.video_writer import video_writer

    renderer = renderer_for(scene, name, np.random.default_rng([seed, 9]))
    frames, first = np.unique(track.frame, return_index=True)
    with video_writer(out / f"{name}.mp4", scene.camera(name).fps, "leave out --render") as write:
        for moment, repeats in zip(track.true_time[first], np.diff(frames, append=frames[-1] + 1), strict=True):
            image = renderer.render(float(moment))
            for _ in range(int(repeats)):
                write(image)
    return str(out / f"{name}.mp4")
