"""Simulated detections of people, without rendering: head tops and foot points as labelled points.

The identities are given by the labels, as for the marker: data association is the task of tracking, not of a recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.scenes.people.scene import PeopleScene
from protocols.geometry.types import Bools, Floats, Ints

HIDDEN_PX = 3.0
"""A head top or foot point at least this far inside a nearer body's box is occluded."""


@dataclass(frozen=True, slots=True, eq=False)
class PeopleTrack:
    """Detections of one camera, rows in order of time.

    frame: (n,). time: (n,) [s] on the camera's own clock. pixels: (n, 2). size: (n,) [px] from head to foot. label: n
    names, person0-head, person0-foot, …; ground truth: true_time (n,) [s].
    """

    camera: str
    frame: Ints
    time: Floats
    pixels: Floats
    size: Floats
    label: tuple[str, ...]
    true_time: Floats

    def __len__(self) -> int:
        return len(self.time)


def simulate_people_tracks(
    scene: PeopleScene, duration_s: float, seed: int, *, pixel_noise: float, drop_fraction: float | None = None
) -> dict[str, PeopleTrack]:
    """Simulate detections for ``duration_s`` from true time 0, one track per camera; reproducible.

    pixel_noise: std of each coordinate [px]. drop_fraction: share of dropped frames, in place of the cameras' own.
    """
    tracks = {}
    names = [(f"{one.name}-head", f"{one.name}-foot") for one in scene.people]
    for index, camera in enumerate(scene.cameras):
        rng = np.random.default_rng([seed, index])
        count = max(int((duration_s - camera.start_s) * camera.fps * camera.clock.rate), 0)
        true_time = camera.capture_times(camera.start_s, 0, count, rng)
        kept = rng.random(count) >= (camera.drop_fraction if drop_fraction is None else drop_fraction)
        seconds = camera.clock.stamps(true_time, rng)
        pixels, visible = visible_points(scene, camera.name, true_time)
        visible &= kept[:, None, None]
        size = np.linalg.norm(pixels[:, :, 0] - pixels[:, :, 1], axis=-1)
        noisy = pixels + rng.normal(0.0, pixel_noise, pixels.shape)
        frame, person, end = np.nonzero(visible)
        tracks[camera.name] = PeopleTrack(
            camera=camera.name,
            frame=frame.astype(np.int64),
            time=seconds[frame],
            pixels=noisy[frame, person, end],
            size=size[frame, person],
            label=tuple(names[who][which_end] for who, which_end in zip(person, end, strict=True)),
            true_time=true_time[frame],
        )
    return tracks


def visible_points(scene: PeopleScene, camera: str, true_time: Floats) -> tuple[Floats, Bools]:
    """Pixels (t, n, 2, 2) of head tops and foot points, and whether each is visible (t, n, 2).

    Points outside the image or behind a nearer person are not visible.
    """
    simulated = scene.camera(camera)
    lens = simulated.intrinsics
    points = np.stack([scene.heads(true_time), scene.feet(true_time)], axis=2)
    pixels = scene.seen_by(camera, points)
    depth = simulated.pose.camera_from_world(points.reshape(-1, 3))[:, 2].reshape(points.shape[:3])
    limit = np.array([lens.width, lens.height]) - 0.5
    with np.errstate(invalid="ignore"):
        visible = np.asarray(((pixels > -0.5) & (pixels < limit)).all(axis=-1), dtype=np.bool_)
        for index, moment in enumerate(true_time):
            boxes = scene.boxes(camera, float(moment))
            low, high = boxes[:, :2] + HIDDEN_PX, boxes[:, :2] + boxes[:, 2:] - HIDDEN_PX
            inside = ((pixels[index][:, :, None] > low) & (pixels[index][:, :, None] < high)).all(axis=-1)
            nearer = depth[index].mean(axis=-1)[None, None] < depth[index].mean(axis=-1)[:, None, None]
            visible[index] &= ~(inside & nearer).any(axis=-1)
    return pixels, visible
