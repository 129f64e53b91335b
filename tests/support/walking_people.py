"""People who walk about in a room, as keypoints that each camera's own tracker has numbered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.scenes.common.base import look_at_pose
from protocols.geometry.types import Floats
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig
from tests.support.board_session import BoardCamera, board_world, rig_cameras

JOINTS = (
    "nose", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
THIGH, SHANK, HIP = 0.245, 0.246, 0.53  # over the height (Winter)


@dataclass(frozen=True)
class PeopleWorld:
    """Cameras around people of some heights [m]. path: amplitude, frequency, phase (people, 2, 3) of their walks."""

    cameras: dict[str, BoardCamera]
    heights: Floats
    path: tuple[Floats, Floats, Floats]

    def people(self, time: float) -> Floats:
        """The joints (people, joints, 3) [m] at a reference time."""
        amplitude, frequency, phase = self.path
        turn = 2 * np.pi * frequency * time + phase
        place = (amplitude * np.sin(turn)).sum(axis=2)
        speed = (amplitude * 2 * np.pi * frequency * np.cos(turn)).sum(axis=2)
        return np.array(
            [
                _walker(height, *pair, 5.5 * time + 2.0 * number + 0.8 * np.sin(0.9 * time + number))
                for number, (height, pair) in enumerate(zip(self.heights, zip(place, speed, strict=True), strict=True))
            ]
        )

    def rig(self, lenses: bool = True) -> Rig:
        """The rig with independent clocks."""
        return Rig(rig_cameras(self.cameras, lenses))

    def observations(
        self, seconds: float, *, noise: float = 2.0, seed: int = 0, renumbered_every: float = 5.0, missed: float = 0.05
    ) -> Observations:
        """Keypoints with noise [px], under numbers that differ by camera and change every so many seconds."""
        rng = np.random.default_rng(seed)
        columns: list[tuple[str, str, int, float, float, float]] = []
        for name, camera in self.cameras.items():
            count = len(self.heights)
            numbers, change = rng.permutation(count), rng.uniform(0.3, 1.0) * renumbered_every
            for frame in range(int(seconds * camera.fps)):
                time = frame / camera.fps
                if time > change:
                    numbers, change = rng.permutation(count), change + rng.uniform(0.6, 1.4) * renumbered_every
                for number, joints in zip(numbers, self.people(time * camera.rate + camera.offset), strict=True):
                    pixels = camera.lens.project(camera.pose.camera_from_world(joints))
                    pixels = pixels + rng.normal(0.0, noise, pixels.shape)
                    inside = (pixels > 0).all(axis=1) & (pixels < [camera.lens.width, camera.lens.height]).all(axis=1)
                    for joint in np.flatnonzero(inside & (rng.random(len(joints)) > missed)):
                        u, v = pixels[joint].tolist()
                        columns.append((name, f"p{number}.{JOINTS[joint]}", frame, time, u, v))
        cameras, labels, frames, times, u, v = (list(column) for column in zip(*columns, strict=True))
        size = np.full(len(columns), np.nan)
        return gather_tracks(
            cameras, labels, np.array(frames), np.array(times), np.column_stack([u, v]), size, order=self.cameras
        )


def people_world(seed: int, people: int = 3, fps: tuple[float, ...] = (25.0, 30.0, 25.0)) -> PeopleWorld:
    """A world with a camera for each rate, 4 to 6 m from the middle, 1 to 2.8 m high; clocks as of `board_world`."""
    rng = np.random.default_rng(seed)
    cameras = {}
    for number, (name, one) in enumerate(board_world(seed, fps).cameras.items()):
        angle = 2.4 * number / len(fps) + rng.uniform(-0.15, 0.15)
        place = rng.uniform(4.5, 6.0) * np.array([np.cos(angle), np.sin(angle), 0.0]) + [0, 0, rng.uniform(1.0, 2.8)]
        cameras[name] = BoardCamera(one.lens, look_at_pose(place, np.array([0, 0, 0.9])), one.offset, one.rate, one.fps)
    frequency = rng.uniform(0.03, 0.16, (people, 2, 3))
    amplitude = rng.uniform(0.5, 1.0, (people, 2, 3)) * np.minimum(1.0, 0.1 / frequency)
    path = amplitude, frequency, rng.uniform(0, 2 * np.pi, (people, 2, 3))
    return PeopleWorld(cameras, rng.uniform(1.6, 1.9, people), path)


def _walker(height: float, place: Floats, speed: Floats, gait: float) -> Floats:
    """Joints (13, 3) of an upright walker: thighs, shanks and arms swing with the gait's phase."""
    ahead = np.array([*speed, 0.0]) / max(float(np.linalg.norm(speed)), 1e-6)
    across, up = np.array([-ahead[1], ahead[0], 0.0]), np.array([0.0, 0.0, 1.0])
    stride = min(float(np.linalg.norm(speed)), 1.2) / 1.2
    middle = np.array([*place, 0.0]) + (HIP * height + 0.02 * np.cos(2 * gait)) * up

    def limb(start: Floats, swing: float, bend: float, upper: float, lower: float) -> tuple[Floats, Floats]:
        first = start + upper * height * (np.sin(swing) * ahead - np.cos(swing) * up)
        return first, first + lower * height * (np.sin(swing + bend) * ahead - np.cos(swing + bend) * up)

    joints = {"nose": middle + 0.40 * height * up + 0.06 * ahead}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        phase = gait + (0.0 if sign > 0 else np.pi)
        hip = middle + 0.06 * height * sign * across
        knee, ankle = limb(hip, 0.5 * stride * np.sin(phase), -0.6 * stride * max(np.cos(phase), 0.0), THIGH, SHANK)
        shoulder = middle + 0.29 * height * up + 0.11 * height * sign * across
        elbow, wrist = limb(shoulder, -0.45 * stride * np.sin(phase), 0.3 + 0.2 * np.sin(0.7 * gait + sign), 0.17, 0.16)
        joints |= {f"{side}_hip": hip, f"{side}_knee": knee, f"{side}_ankle": ankle}
        joints |= {f"{side}_shoulder": shoulder, f"{side}_elbow": elbow, f"{side}_wrist": wrist}
    return np.array([joints[name] for name in JOINTS])
