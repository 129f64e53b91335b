"""Simulated detections of people, without rendering: head tops and foot points as labelled points.

The identities are given by the labels, as for the marker: data association is the task of tracking, not of a recording.
"""

from __future__ import annotations

import numpy as np

from edge.scenes.common.base import SimulatedTrack
from edge.scenes.people.scene import PeopleScene
from protocols.geometry.types import Bools, Floats

HIDDEN_PX = 3.0
"""A head top or foot point at least this far inside a nearer body's box is occluded."""


def simulate_people_tracks(
    scene: PeopleScene, duration_s: float, seed: int, *, pixel_noise: float, drop_fraction: float | None = None
) -> dict[str, SimulatedTrack]:
    """Simulate detections by camera, labelled person0-head, person0-foot, …; size: [px] from head to foot.

    pixel_noise: std of each coordinate [px]. For the others see ``SimulatedScene.exposures``.
    """
    tracks = {}
    names = [(f"{one.name}-head", f"{one.name}-foot") for one in scene.people]
    for camera, rng, true_time, kept in scene.exposures(duration_s, seed, drop_fraction):
        seconds = camera.clock.stamps(true_time, rng)
        pixels, visible = visible_points(scene, camera.name, true_time)
        visible &= kept[:, None, None]
        size = np.linalg.norm(pixels[:, :, 0] - pixels[:, :, 1], axis=-1)
        noisy = pixels + rng.normal(0.0, pixel_noise, pixels.shape)
        frame, person, end = np.nonzero(visible)
        tracks[camera.name] = SimulatedTrack(
            camera=camera.name,
            frame=frame.astype(np.int64),
            time=seconds[frame],
            pixels=noisy[frame, person, end],
            size=size[frame, person],
            label=tuple(names[who][which_end] for who, which_end in zip(person, end, strict=True)),
            true_time=true_time[frame],
            is_outlier=np.zeros(len(frame), dtype=np.bool_),
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
