"""Short clips of people who walk in a rendered street, with their true boxes: views, sizes, rates and light vary."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from edge import scenes
from edge.devices.playback.video_reader import VideoReader
from edge.scenes.common.background import pixel_rays
from edge.scenes.common.base import SimulatedCamera, look_at_pose
from edge.scenes.people.renderer import PeopleRenderer
from edge.scenes.people.scene import PeopleScene
from edge.scenes.people.walking import WalkingPaths
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Image
from tests.support.people_boxes import truth
from tests.support.videos import write_video

_SIZES = ((320, 240), (480, 270), (640, 480), (768, 432), (960, 540), (1280, 720))
_RATES = (12.0, 15.0, 25.0, 30.0, 50.0, 60.0)
_FACADE = 6.0  # m: distance of the houses behind the place where people walk
_MARGIN = 0.08  # of the image: rendered beyond its border for a camera that shakes


@dataclass(frozen=True, slots=True)
class StreetKind:
    """One kind of clip. people: how many. heading: of the walk from straight across [rad], ±. offset: from the middle
    of the view at mid-clip [m], ±. contrast: of clothes to the street, 0..1. noise: std [8-bit steps]. crf: of H.264;
    None = uncompressed. wind, shake: amplitude [px at 640 px width] of the trees' and of the camera's motion. pan:
    [image widths/s]. light: relative change within the clip.
    """

    people: int = 1
    heading: float = 0.5
    offset: float = 0.6
    contrast: float = 1.0
    noise: float = 2.5
    crf: int | None = 23
    wind: float = 0.0
    shake: float = 0.0
    pan: float = 0.0
    light: float = 0.0


KINDS = {
    "across the street": StreetKind(),
    "towards the camera": StreetKind(heading=1.5),
    "clothes like the street": StreetKind(contrast=0.3),
    "wind in trees": StreetKind(wind=3.0),
    "changing light": StreetKind(light=0.35),
    "strong compression": StreetKind(crf=33),
    "noise": StreetKind(noise=7.0, crf=None),
    "hand-held": StreetKind(shake=2.0),
    "panning": StreetKind(pan=0.15),
    "two people": StreetKind(people=2),
    "nobody, wind and light": StreetKind(people=0, wind=3.0, light=0.35),
}


@dataclass(frozen=True, slots=True, eq=False)
class StreetClip:
    """A clip: images (H, W, 3) BGR; of each the true boxes (n, 4) and which of them count (n,); fps: rate [Hz]."""

    images: list[Image]
    boxes: list[tuple[Floats, Bools]]
    fps: float


def street_clip(
    kind: StreetKind,
    seed: int,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    seconds: float | None = None,
) -> StreetClip:
    """Render a clip of a seed; size (width, height), rate and duration are drawn where not given."""
    rng = np.random.default_rng([seed, 31])
    size = size or _SIZES[int(rng.integers(len(_SIZES)))]
    fps = fps or _RATES[int(rng.integers(len(_RATES)))]
    seconds = seconds or float(rng.uniform(1.0, 3.0))
    margin = round(_MARGIN * size[0]) if kind.shake or kind.pan else 0
    scene = _scene(kind, seed, size, margin, seconds, rng)
    camera = scene.cameras[0]
    background, trees = _street(camera, rng)
    if kind.contrast < 1.0:
        near = np.asarray(background[background.shape[0] // 3 :].reshape(-1, 3)[::997], dtype=np.float64)
        scene = replace(scene, people=tuple(_faded(one, near, kind.contrast, rng) for one in scene.people))
    renderer = PeopleRenderer(scene, camera.name, np.random.default_rng([seed, 1]), kind.noise, background=background)
    count, scale = max(round(seconds * fps), 6), size[0] / 640.0
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    rates = rng.uniform(0.6, 2.5, 12)
    images: list[Image] = []
    boxes = []
    for index in range(count):
        time = index / fps
        swing = np.sin(2.0 * np.pi * rates * time + phases)
        if kind.wind:
            renderer.replace_background(_blown(background, trees, scale * kind.wind, swing))
        image, owners = renderer.render_with_owners(time)
        found, counts = truth(scene, camera.name, time, owners)
        if margin:
            shift = kind.shake * scale * (swing[:2] + 0.5 * swing[2:4])
            shift[0] += kind.pan * size[0] * (time - 0.5 * seconds)
            shift = np.clip(shift, -margin, margin)
            warp = np.array([[1.0, 0.0, -margin - shift[0]], [0.0, 1.0, -margin - shift[1]]])
            image = np.asarray(cv2.warpAffine(image, warp, size), dtype=np.uint8)
            found = found - np.r_[margin + shift, 0.0, 0.0]
            x, y, w, h = found.T
            counts = counts & (x > 0) & (y > 0) & (x + w < size[0] - 1) & (y + h < size[1] - 1)
        if kind.light:
            gain = 1.0 + kind.light * (
                0.5 * (1.0 + math.sin(phases[5])) - (time / seconds if seed % 2 else swing[4] / 4.0)
            )
            image = np.asarray(cv2.convertScaleAbs(image, alpha=max(gain, 0.3)), dtype=np.uint8)
        images.append(image)
        boxes.append((found, counts))
    if kind.crf is not None:
        images = _compressed(images, fps, kind.crf)
    return StreetClip(images, boxes, fps)


def _compressed(images: list[Image], fps: float, crf: int) -> list[Image]:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "clip.mp4"
        write_video(file, images, np.arange(len(images)) / fps, crf=str(crf))
        return [frame.image() for frame in VideoReader(file)]


def _scene(
    kind: StreetKind, seed: int, size: tuple[int, int], margin: int, seconds: float, rng: np.random.Generator
) -> PeopleScene:
    """Walkers who are in view in the middle of the clip."""
    drawn: PeopleScene = scenes.get_people_scene(seed, 2, max(kind.people, 1))
    focal = float(rng.uniform(0.7, 1.4)) * size[0]
    share = float(rng.uniform(0.25, 0.65))  # of a person's height over the image's
    distance = 1.72 * focal / (share * size[1])
    eye = np.array([float(rng.uniform(-2.0, 2.0)), -distance, float(rng.uniform(1.4, 1.6 + 0.3 * distance))])
    pose = look_at_pose(eye, np.array([0.0, 0.0, 1.0]), float(rng.uniform(-0.04, 0.04)))
    matrix = np.array([[focal, 0, size[0] / 2 + margin], [0, focal, size[1] / 2 + margin], [0, 0, 1.0]])
    lens = Intrinsics(size[0] + 2 * margin, size[1] + 2 * margin, matrix)
    steps = np.arange(-2, int(seconds / 0.2) + 8) * 0.2
    places, lengths, headings = [], [], []
    for one in range(max(kind.people, 1)):
        speed = float(rng.uniform(0.9, 1.6))
        heading = float(rng.choice([0.0, np.pi]) + rng.choice([-1.0, 1.0]) * kind.heading * rng.uniform(0.3, 1.0))
        middle = np.array([rng.uniform(-kind.offset, kind.offset) + 1.3 * one, 0.9 * one])
        if not kind.people:
            middle = middle + (0.0, -1e3)  # behind the camera
        along = speed * (steps - 0.5 * seconds)
        places.append(middle + along[:, None] * np.array([np.cos(heading), np.sin(heading)]))
        lengths.append(speed * steps)
        headings.append(np.full(len(steps), heading))
    # The spline is offset by a step.
    paths = WalkingPaths(np.stack(places, 1), np.stack(lengths, 1), np.stack(headings, 1))
    camera = replace(drawn.cameras[0], intrinsics=lens, pose=pose)
    return replace(drawn, cameras=(camera,), paths=_Straight(paths.points, paths.travelled, paths.heading))


class _Straight(WalkingPaths):
    """Walked from one end to the other at constant speed."""

    __slots__ = ()

    def at(self, true_time: Floats) -> tuple[Floats, Floats, Floats]:
        place = np.clip(np.asarray(true_time, dtype=np.float64) / 0.2 + 2.0, 0.0, len(self.points) - 1.001)
        first = place.astype(np.int64)
        u = (place - first)[:, None]
        points = self.points[first] * (1 - u[..., None]) + self.points[first + 1] * u[..., None]
        lengths = self.travelled[first] * (1 - u) + self.travelled[first + 1] * u
        return points, lengths, self.heading[first]


def _faded(person: object, near: Floats, contrast: float, rng: np.random.Generator) -> object:
    """A person in clothes of the street's colours."""

    def near_street(colour: tuple[float, float, float]) -> tuple[float, float, float]:
        other = near[int(rng.integers(len(near)))]
        blue, green, red = (contrast * a + (1.0 - contrast) * b for a, b in zip(colour, other, strict=True))
        return float(blue), float(green), float(red)

    return replace(person, top=near_street(person.top), trousers=near_street(person.trousers))  # type: ignore


def _street(camera: SimulatedCamera, rng: np.random.Generator) -> tuple[Image, Floats]:
    """A paved street before houses with windows and trees (H, W, 3), and how much of each pixel is a tree (H, W)."""
    lens = camera.intrinsics
    u, v = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
    rays = (pixel_rays(lens, u, v) @ camera.pose.rotation).reshape(-1, 3)
    eye = camera.pose.position
    ground = np.where(rays[:, 2] < -1e-3, -eye[2] / np.minimum(rays[:, 2], -1e-3), 1e4)
    wall = np.where(rays[:, 1] > 1e-3, (_FACADE - eye[1]) / np.maximum(rays[:, 1], 1e-3), 1e4)
    on_ground = ground < wall
    hit = eye + np.minimum(np.minimum(ground, wall), 500.0)[:, None] * rays
    x, y, z = hit.T
    grain = cv2.GaussianBlur(rng.normal(0.0, 1.0, (512, 512)), (0, 0), 1.2)
    grain /= grain.std()

    def noise(a: Floats, b: Floats, cells: float) -> Floats:
        return grain[(a * cells).astype(int) % 512, (b * cells).astype(int) % 512]

    stone = float(rng.uniform(0.3, 0.9))
    joint = np.minimum(np.mod(x, stone), np.mod(y + 0.5 * stone * (np.floor(x / stone) % 2), stone)) < 0.03
    base = rng.uniform(90, 170) + rng.uniform(-8, 8, 3)
    pavement = base * (1.0 + 0.06 * noise(x, y, 40.0) + 0.05 * noise(x, y, 3.0) - 0.25 * joint)[:, None]
    brick = (np.mod(z, 0.09) < 0.015) | (np.mod(x + 0.12 * (np.floor(z / 0.09) % 2), 0.24) < 0.015)
    facade = np.array([rng.uniform(60, 190), rng.uniform(80, 190), rng.uniform(110, 210)])
    house = facade * (1.0 + 0.05 * noise(x, z, 30.0) + 0.12 * brick)[:, None]
    period, width = float(rng.uniform(1.8, 3.0)), float(rng.uniform(0.8, 1.2))
    window = (np.mod(x, period) < width) & (np.mod(z, 3.0) > 0.9) & (np.mod(z, 3.0) < 2.4)
    frame = window & ~((np.mod(x, period) > 0.08) & (np.mod(x, period) < width - 0.08) & (np.mod(z - 0.9, 3.0) > 0.08))
    house[window] = np.array([70.0, 60.0, 50.0]) * (1.0 + 0.3 * noise(x, z, 6.0))[window, None]
    house[frame] = 225.0
    house[z > 9.0] = np.array([225.0, 205.0, 180.0])
    colour = np.where(on_ground[:, None], pavement, house)
    trees = np.zeros(len(colour))
    for _ in range(3):
        centre = np.array([rng.uniform(-6, 6), rng.uniform(2.0, 4.0)])
        reach, across = rng.uniform(0.8, 1.6), x - centre[0]
        crown = (np.hypot(across, z - 3.0) + 0.35 * noise(x, z, 5.0) < reach) & ~on_ground
        trunk = (np.abs(across) < 0.12) & (z < 3.0) & ~on_ground
        colour[trunk] = np.array([50.0, 62.0, 74.0])
        green = np.array([40.0, 95.0, 70.0]) * (1.0 + 0.35 * noise(x, z, 25.0) + 0.2 * noise(x, z, 7.0))[:, None]
        colour[crown] = green[crown]
        trees[crown] = 1.0
    image = np.clip(colour, 0.0, 255.0).reshape(lens.height, lens.width, 3).astype(np.float32)
    soft = cv2.GaussianBlur(trees.reshape(lens.height, lens.width), (0, 0), 3.0)
    return np.asarray(np.rint(cv2.GaussianBlur(image, (0, 0), 0.7)), dtype=np.uint8), np.asarray(soft)


def _blown(image: Image, trees: Floats, reach: float, swing: Floats) -> Image:
    """The image with its trees moved by up to ``reach`` px, differently at each place."""
    height, width = trees.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    wave = 0.6 * swing[6] + 0.4 * swing[7] * np.sin(u / 23.0 + 3.0 * swing[8]) * np.cos(v / 17.0 + 2.0 * swing[9])
    move = (reach * trees * wave).astype(np.float32)
    return np.asarray(
        cv2.remap(image, u + move, v + np.float32(0.4) * move, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.uint8,
    )
