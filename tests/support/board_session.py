"""Sessions of a moving board: exact corners of unsynchronised cameras, or rendered videos of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge.scenes.common.base import look_at_pose
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera
from tests.support import boards
from tests.support.videos import write_video


@dataclass(frozen=True)
class BoardCamera:
    """A true camera. t_reference = rate * t_camera + offset [s]; pose in metres."""

    lens: Intrinsics
    pose: Pose
    offset: float
    rate: float
    fps: float


def rig_cameras(cameras: dict[str, BoardCamera], lenses: bool) -> dict[str, RigCamera]:
    """The cameras of a rig, with or without their lenses."""
    return {
        name: RigCamera(name, (one.lens.width, one.lens.height), one.fps, one.lens if lenses else None)
        for name, one in cameras.items()
    }


@dataclass(frozen=True)
class BoardWorld:
    """Cameras on an arc around a board that is moved and turned by hand. points: of the board [m], by label."""

    cameras: dict[str, BoardCamera]
    points: dict[str, Floats]
    motion: tuple[Floats, Floats, Floats]
    facing: Floats

    def board(self, time: float) -> tuple[Floats, Floats]:
        """Rotation (3, 3), world from board, and position (3,) of the board's middle at a reference time."""
        amplitude, frequency, phase = self.motion
        value = (amplitude * np.sin(2 * np.pi * frequency * time + phase)).sum(axis=1)
        return so3.exp(value[3:]) @ self.facing, np.array([0.0, 0.0, 1.2]) + value[:3]

    def rig(self, lenses: bool = True, scale: float = 1.0) -> Rig:
        """The rig, with or without its lenses; the board's points times ``scale``."""
        return Rig(
            rig_cameras(self.cameras, lenses),
            bodies={"board": {label: scale * point for label, point in self.points.items()}},
        )

    def views(
        self, seconds: float, seed: int, jitter: float = 0.0, readout: float = 0.0
    ) -> Iterator[tuple[str, int, float, Floats]]:
        """Camera, frame, camera time and the corners' pixels (n, 2) of every frame that faces the board.

        readout: seconds from the first row of an image to its last.
        """
        rng = np.random.default_rng(seed)
        points = np.array(list(self.points.values()))
        centred = points - points.mean(axis=0)
        for name, camera in self.cameras.items():
            for frame in range(int(seconds * camera.fps)):
                time = frame / camera.fps
                true = (time + rng.normal(0.0, jitter)) * camera.rate + camera.offset
                turn, place = self.board(true)
                away = camera.pose.position - place
                if -turn[:, 2] @ away < 0.35 * np.linalg.norm(away):
                    continue
                pixels = camera.lens.project(camera.pose.camera_from_world(centred @ turn.T + place))
                for row, late in enumerate(
                    readout * (pixels[:, 1] / (camera.lens.height - 1) - 0.5) if readout else ()
                ):
                    turn, place = self.board(true + float(late) * camera.rate)
                    point = camera.pose.camera_from_world(centred[row : row + 1] @ turn.T + place)
                    pixels[row] = camera.lens.project(point)[0]
                yield name, frame, time, pixels

    def observations(
        self, seconds: float = 10.0, noise: float = 0.15, seed: int = 0, jitter: float = 0.0, readout: float = 0.0
    ) -> Observations:
        """The corners inside the images, with noise [px]."""
        rng = np.random.default_rng(seed + 1000)
        cameras, labels, frames, times, seen = [], [], [], [], []
        for name, frame, time, pixels in self.views(seconds, seed, jitter, readout):
            lens = self.cameras[name].lens
            inside = np.isfinite(pixels).all(axis=1) & (pixels > 4).all(axis=1)
            inside &= (pixels < [lens.width - 5, lens.height - 5]).all(axis=1)
            for label, pixel in zip(np.array(list(self.points))[inside].tolist(), pixels[inside], strict=True):
                cameras.append(name)
                labels.append(label)
                frames.append(frame)
                times.append(time)
                seen.append(pixel + rng.normal(0.0, noise, 2))
        size = np.full(len(times), np.nan)
        return gather_tracks(
            cameras, labels, np.array(frames), np.array(times), np.array(seen), size, order=self.cameras
        )


def board_world(
    seed: int,
    fps: tuple[float, ...] = (6.0, 6.0, 6.0, 6.0),
    lag: float = 3.0,
    squares: tuple[int, int] = (5, 4),
    size: float = 0.05,
) -> BoardWorld:
    """A world with a camera for each rate of ``fps``, whose clocks differ by up to ``lag`` [s]."""
    rng = np.random.default_rng(seed)
    base, target = rng.uniform(0, 2 * np.pi), np.array([0.0, 0.0, 1.2])
    cameras = {}
    for i, rate in enumerate(fps):
        angle = base + rng.uniform(-0.2, 0.2) + 1.8 * i / len(fps)
        place = target + rng.uniform(1.0, 1.8) * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.15, 0.5)])
        focal = rng.uniform(600, 950)
        matrix = np.array([[focal, 0, 639.5 + rng.normal(0, 10)], [0, focal, 359.5 + rng.normal(0, 10)], [0, 0, 1]])
        lens = Intrinsics(1280, 720, matrix, np.array([rng.uniform(-0.3, 0.15), rng.uniform(-0.1, 0.1), 0, 0, 0]))
        clock = 0.0 if i == 0 else rng.uniform(-lag, lag)
        drift = 1.0 if i == 0 else 1.0 + rng.normal(0, 3e-5)
        cameras[f"cam{i}"] = BoardCamera(lens, look_at_pose(place, target + rng.normal(0, 0.04, 3)), clock, drift, rate)
    frequency = rng.uniform(0.1, 0.7, (6, 3))
    amplitude = rng.normal(0, 1, (6, 3)) * np.minimum(1.0, 0.35 / frequency) / np.sqrt(3)
    amplitude[:3] *= 0.22
    amplitude[3:] *= 0.6
    out = np.array([np.cos(base + 0.9), np.sin(base + 0.9), 0.15])
    out /= np.linalg.norm(out)
    across = np.cross(out, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    facing = np.stack([across, np.cross(-out, across), -out], axis=1)
    points = {
        str(row * (squares[0] - 1) + column): size * np.array([column + 1.0, row + 1.0, 0.0])
        for row in range(squares[1] - 1)
        for column in range(squares[0] - 1)
    }
    return BoardWorld(cameras, points, (amplitude, frequency, rng.uniform(0, 2 * np.pi, (6, 3))), facing)


def render_videos(
    world: BoardWorld, folder: Path, seconds: float, *, inverted: bool = False, scale: float = 0.5
) -> None:
    """Write a video a camera of the ChArUco board of ``tests.support.boards``, at a share of the lens's resolution."""
    drawing = boards.charuco_image()
    square = float(np.diff([point[0] for point in list(world.points.values())[:2]])[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, camera in world.cameras.items():
        lens = camera.lens
        matrix = np.diag([scale, scale, 1.0]) @ lens.matrix
        matrix[:2, 2] += 0.5 * (scale - 1.0)
        size = round(lens.width * scale), round(lens.height * scale)
        renderer = boards.BoardRenderer(Intrinsics(*size, matrix, lens.distortions), seed=len(name))
        times = np.arange(int(seconds * camera.fps)) / camera.fps
        images = []
        for time in times:
            turn, place = world.board(float(time) * camera.rate + camera.offset)
            rotation = camera.pose.rotation @ turn
            centre = camera.pose.camera_from_world(place[None])[0] / square
            faces = rotation[:, 2] @ centre > 0.3 * np.linalg.norm(centre)
            image = renderer.draw(drawing, rotation, centre) if faces else renderer.draw(drawing, rotation, 50 * centre)
            images.append(255 - image if inverted else image)
        write_video(folder / f"{name}.mp4", images, times)
