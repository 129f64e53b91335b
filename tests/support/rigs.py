"""Sessions for the hub's tests without any image: random rigs, one smooth path, clocks that share nothing."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.scenes.common.base import look_at_pose
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from protocols.core.clocks import CameraTime, ReferenceTime, TimeMap
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import CameraCalibration
from protocols.session.folder import write_observations
from protocols.session.observations import DEFAULT_LABEL, Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera

SIZE = (1280, 720)
EPOCHS = (0.0, 1.7e9, -250.0, 86_400.5, 12.25, 3.2e6, 1.7e9 + 77.0, -0.5)
"""Unix time, uptime, negative: what real cameras count from."""


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A sum of sinusoids a coordinate: position = centre + sum amplitude * sin(2 pi f t + phase); (k, 3) each."""

    frequency: Floats
    phase: Floats
    amplitude: Floats

    def at(self, time: Floats) -> Floats:
        """Positions (n, 3) [m] at true times (n,) [s]."""
        angle = 2 * np.pi * self.frequency * time[:, None, None] + self.phase
        return np.asarray((self.amplitude * np.sin(angle)).sum(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A simulated session and its truth.

    camera, label: (n,) names. frame, time, pixels: (n,), (n,), (n, 2) as a camera would tell them.
    poses: true ones. clocks: true time from camera time. paths: by label.
    """

    rig: Rig
    camera: list[str]
    label: list[str]
    frame: Ints
    time: Floats
    pixels: Floats
    poses: dict[str, Pose]
    clocks: dict[str, TimeMap]
    paths: dict[str, Path]

    def observations(self, order: Ints | None = None) -> Observations:
        """The rows as a reader would hand them on, in another ``order`` (n,) of rows if given."""
        o = np.arange(len(self.time)) if order is None else order
        return gather_tracks(
            [self.camera[i] for i in o],
            [self.label[i] for i in o],
            self.frame[o],
            self.time[o],
            self.pixels[o],
            np.full(len(o), np.nan),
            order=self.rig.cameras,
        )

    def where(self, keep: Bools) -> Session:
        """The session with the rows (n,) to keep only."""
        at = np.flatnonzero(keep)
        return replace(
            self,
            camera=[self.camera[i] for i in at],
            label=[self.label[i] for i in at],
            frame=self.frame[at],
            time=self.time[at],
            pixels=self.pixels[at],
        )

    def of_camera(self, name: str) -> Bools:
        """(n,) the rows of a camera."""
        return np.array([camera == name for camera in self.camera])

    @property
    def true(self) -> Floats:
        """(n,) true times of the rows."""
        return np.array([self.true_time(name, float(t)) for name, t in zip(self.camera, self.time, strict=True)])

    def moved(self, name: str, since: float, pose: Pose) -> Session:
        """The session with a camera at another pose from a true time on; each row keeps its noise."""
        rows, lens, pixels = self.of_camera(name) & (self.true > since), self.lens(name), self.pixels.copy()
        points = self.paths[DEFAULT_LABEL].at(self.true[rows])
        pixels[rows] += lens.project(pose.camera_from_world(points))
        pixels[rows] -= lens.project(self.poses[name].camera_from_world(points))
        return replace(self, pixels=pixels, poses={**self.poses, name: pose})

    def turned(self, name: str, since: float, angle: float) -> Session:
        """The session with a camera turned by an angle [rad] about its vertical axis from a true time on."""
        pose = self.poses[name]
        return self.moved(name, since, replace(pose, rotation=so3.exp(np.array([0.0, angle, 0.0])) @ pose.rotation))

    def lens(self, name: str) -> Intrinsics:
        """The intrinsics of a camera that has some."""
        found = self.rig.cameras[name].intrinsics
        assert found is not None
        return found

    def true_cameras(self) -> dict[str, CameraCalibration]:
        """The cameras as they are, as a calibration without errors on the true clock."""
        zero = np.zeros(3)
        return {
            name: CameraCalibration(name, self.lens(name), pose, self.clocks[name], 0.0, zero, 0.0)
            for name, pose in self.poses.items()
        }

    def smoothed(self, name: str) -> dict[str, SmoothTrack]:
        """A camera's tracks by label, all with one time origin."""
        own, lens = self.observations().of_camera(name), self.lens(name)
        begin = min(float(track.time[0]) for track in own)
        found = {t.label: smooth_track(t.time, lens.unproject(t.pixels), lens.focal, begin) for t in own}
        return {label: track for label, track in found.items() if track is not None}

    def without_lenses(self, *names: str) -> Session:
        """The session without the intrinsics of ``names``, or of all; their distortion stays in the pixels."""
        cameras = {
            name: replace(camera, intrinsics=None) if name in names or not names else camera
            for name, camera in self.rig.cameras.items()
        }
        return replace(self, rig=replace(self.rig, cameras=cameras))

    def write(self, folder: pathlib.Path, metadata: str = "") -> pathlib.Path:
        """The session as a new folder. metadata: lines of that table."""
        return write_session(folder, self.rig, self.observations(), metadata)

    def csv(self) -> str:
        """The rows as observations.csv."""
        lines = ["camera,frame,time,u,v,label"]
        for c, k, f, t, (u, v) in zip(self.camera, self.label, self.frame, self.time, self.pixels, strict=True):
            lines.append(f"{c},{f},{t:.17g},{u:.17g},{v:.17g},{k}")
        return "\n".join(lines) + "\n"

    def middle(self, camera: str) -> float:
        """The middle of the camera's observed span on its own clock [s]."""
        mine = self.time[[name == camera for name in self.camera]]
        return float(0.5 * (mine.min() + mine.max()))

    def true_time(self, camera: str, shown: float) -> float:
        """The true time [s] at which the camera's clock shows ``shown``."""
        return self.clocks[camera].reference_from_camera(CameraTime(shown))

    def shown(self, camera: str, true: float) -> float:
        """What the camera's clock shows at a true time [s]."""
        return self.clocks[camera].camera_from_reference(ReferenceTime(true))

    def truth_at(self, label: str, camera: str, shown: Floats) -> Floats:
        """True positions (n, 3) of a label at times (n,) of the camera's clock."""
        return self.paths[label].at(np.array([self.true_time(camera, float(t)) for t in shown]))

    def clock_error(self, camera: str, reference: str, found: TimeMap) -> float:
        """How far off [s] a found map onto the reference camera's clock is, in the middle of the camera's span."""
        middle = self.middle(camera)
        truth = self.shown(reference, self.true_time(camera, middle))
        return float(found.clock_rate * middle + found.time_offset - truth)

    def turn_error(self, found: Mapping[str, Pose]) -> float:
        """Largest error [rad] of the rotations of all cameras against the first one."""
        names = list(found)
        first = names[0]
        errors = []
        for name in names[1:]:
            truth = self.poses[name].rotation @ self.poses[first].rotation.T
            errors.append(so3.angle_between(found[name].rotation @ found[first].rotation.T, so3.nearest(truth)))
        return max(errors)


def write_session(folder: pathlib.Path, rig: Rig, observations: Observations, metadata: str = "") -> pathlib.Path:
    """Cameras and rows as a new folder. metadata: lines of that table."""
    folder.mkdir()
    text = f"[metadata]\n{metadata}\n" if metadata else ""
    for name, camera in rig.cameras.items():
        text += f'[{name}]\nname = "{name}"\nsize = {list(camera.size)}\nfps = {camera.fps}\n'
        if (lens := camera.intrinsics) is not None:
            text += f"matrix = {lens.matrix.tolist()}\ndistortions = {lens.distortions.tolist()}\n"
    (folder / "rig.toml").write_text(text)
    write_observations(folder / "observations.csv", observations)
    return folder


def random_path(rng: np.random.Generator, fastest: float = 0.7, extent: float = 1.0) -> Path:
    """A band-limited path within about ±extent metres, nothing faster than ``fastest`` Hz."""
    frequency = rng.uniform(0.05, fastest, (5, 3))
    amplitude = rng.uniform(0.4, 1.0, (5, 3)) / np.maximum(1.0, frequency / 0.3)
    amplitude *= extent / amplitude.sum(axis=0) * 1.4
    return Path(frequency, rng.uniform(0, 2 * np.pi, (5, 3)), amplitude)


def random_lens(rng: np.random.Generator, fisheye: bool = False) -> Intrinsics:
    """A lens with distortion that still has an inverse over the whole image."""
    focal = rng.uniform(0.75, 1.0) * SIZE[0]
    centre = np.array(SIZE) / 2 + rng.normal(0, 8, 2)
    matrix = np.array([[focal, 0, centre[0]], [0, focal * 1.002, centre[1]], [0, 0, 1.0]])
    if fisheye:
        return Intrinsics(*SIZE, matrix, rng.normal(0, 1, 4) * [0.02, 0.005, 0.001, 0.0], fisheye=True)
    k1 = rng.uniform(-0.15, 0.08)
    return Intrinsics(*SIZE, matrix, np.array([k1, 0.02, *rng.normal(0, 3e-4, 2), 0.0]))


def random_poses(rng: np.random.Generator, count: int) -> list[Pose]:
    """Cameras on an arc round the volume, neighbours 30° to 110° apart."""
    steps = np.maximum(30.0, rng.uniform(0.7, 1.3, count) * min(80.0, 330.0 / count))
    azimuth = np.deg2rad(np.cumsum(steps)) + rng.uniform(0, 2 * np.pi)
    radius, height = rng.uniform(4.0, 6.0, count), rng.uniform(-0.5, 2.5, count)
    places = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    return [look_at_pose(place, rng.normal(0, 0.15, 3), rng.normal(0, 0.1)) for place in places]


def simulate(
    seed: int,
    cameras: int = 3,
    seconds: float = 30.0,
    *,
    noise: float = 0.5,
    drops: float = 0.02,
    outliers: float = 0.0,
    fps: Sequence[float] = (30.0, 25.0, 29.97, 50.0),
    epochs: Sequence[float] = EPOCHS,
    ppm: float = 200.0,
    late: float = 3.0,
    fastest: float = 0.7,
    fisheye: Sequence[int] = (),
    unrelated: Sequence[int] = (),
    windows: Sequence[tuple[float, float]] | None = None,
    labels: Mapping[str, Sequence[int]] | None = None,
    path: Path | None = None,
) -> Session:
    """One random session, a pure function of its arguments.

    noise: [px]. drops, outliers: shares of the rows. ppm: largest rate error of a clock. late: each camera
    starts within that many seconds. unrelated: cameras that watch something else. windows: true times in
    which each camera sees. labels: which cameras see which label. path: instead of a random one.
    """
    rng = np.random.default_rng(seed)
    names = [f"cam{i}" for i in range(cameras)]
    seen_by = dict(labels) if labels is not None else {DEFAULT_LABEL: range(cameras)}
    paths = {label: path or random_path(rng, fastest) for label in seen_by}
    strange = random_path(rng, fastest)
    poses = random_poses(rng, cameras)
    table: dict[str, RigCamera] = {}
    clocks: dict[str, TimeMap] = {}
    parts: list[tuple[str, str, Ints, Floats, Floats]] = []
    for i, name in enumerate(names):
        lens, rate = random_lens(rng, i in fisheye), float(fps[i % len(fps)])
        drift, epoch = 1.0 + 1e-6 * float(rng.uniform(-ppm, ppm)), epochs[i % len(epochs)]
        clocks[name] = TimeMap(1.0 / drift, -epoch / drift)
        table[name] = RigCamera(name, SIZE, rate, lens)
        begin = float(rng.uniform(0, late))
        frame = np.arange(int((seconds - begin) * rate))
        true = begin + frame / rate + np.clip(rng.normal(0, 2e-3, len(frame)), -0.3 / rate, 0.3 / rate)
        own = epoch + drift * true
        for label, viewers in seen_by.items():
            if i not in viewers:
                continue
            points = (strange if i in unrelated else paths[label]).at(true)
            pixels = lens.project(poses[i].camera_from_world(points)) + rng.normal(0, noise, (len(true), 2))
            wrong = rng.random(len(true)) < outliers
            pixels[wrong] = rng.uniform((0, 0), SIZE, (int(wrong.sum()), 2))
            with np.errstate(invalid="ignore"):
                keep = ((pixels >= 0) & (pixels < SIZE)).all(axis=1) & (rng.random(len(true)) >= drops)
            if windows is not None:
                keep &= (true >= windows[i][0]) & (true < windows[i][1])
            parts.append((name, label, frame[keep], own[keep], pixels[keep]))
    return Session(
        Rig(table),
        [name for name, _, frame, _, _ in parts for _ in frame],
        [label for _, label, frame, _, _ in parts for _ in frame],
        np.concatenate([part[2] for part in parts]),
        np.concatenate([part[3] for part in parts]),
        np.concatenate([part[4] for part in parts]),
        dict(zip(names, poses, strict=True)),
        clocks,
        paths,
    )
