"""Oblique flights: a target, what stands and moves around it, a camera that follows, orbits, zooms or looks away."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from edge.uav.base import Box
from edge.uav.world.noise import smoothed_noise, value_noise
from protocols.core.errors import InputError
from protocols.geometry.types import Floats, Image
from tests.support.oblique import bodies
from tests.support.oblique.bodies import Body, View

TARGETS = ("car", "bicycle", "person", "boat")
FLIGHTS = ("follow", "orbit", "zoom", "away")
_TEXTURE_M, _TEXEL = 1024, 0.25  # side of the ground texture [px]; metres per pixel, repeated beyond
_COARSE = 8  # reduction of the texture for distant ground, against aliasing
_FAR_M = 90.0  # distance from which the coarse texture is used, at a focal length of 600 px
_SPEEDS = {"car": 9.0, "bicycle": 4.0, "person": 1.4, "boat": 5.0}  # [m/s]
_RANGES = {"car": 55.0, "bicycle": 30.0, "person": 22.0, "boat": 60.0}  # of the camera from the target [m]
_READOUT_S = 0.02  # of the rolling shutter, top to bottom


@dataclass(frozen=True, slots=True)
class ObliqueTruth:
    """Truth of one frame. box: of the target [px]; visible: share of it in the image and not occluded.

    rotation: (3, 3) camera from world; centre: (3,) [m]; focal: [px].
    """

    box: Box
    visible: float
    rotation: Floats
    centre: Floats
    focal: float


@dataclass(frozen=True, eq=False)
class ObliqueWorld:
    """A pure function of its arguments.

    target: of ``TARGETS``; flight: of ``FLIGHTS``; frames: number; away_s: how long ``away`` looks elsewhere.
    quality: of the JPEG compression. range_factor: of the camera's distance; 5 makes a car some 12 px long.
    screens: number of trees and poles that stand between the camera and the target's path. speed_factor: of its speed.
    group: the other traffic goes along with the target, within 2.3 m of it along each axis.
    """

    target: str
    flight: str
    seed: int
    size: tuple[int, int] = (640, 360)
    fps: float = 10.0
    frames: int = 150
    away_s: float = 2.0
    quality: int = 75
    range_factor: float = 1.0
    screens: int = 0
    speed_factor: float = 1.0
    group: bool = False

    def __post_init__(self) -> None:
        if self.target not in TARGETS or self.flight not in FLIGHTS:
            known = f"{', '.join(TARGETS)}; {', '.join(FLIGHTS)}"
            raise InputError(f"there is no flight {self.flight} over a {self.target}", remedy=f"use {known}")

    @cached_property
    def _times(self) -> Floats:
        return np.arange(self.frames) / self.fps

    @cached_property
    def _path(self) -> tuple[Floats, Floats]:
        """Places (n, 2) and courses (n,) of the target."""
        rng = np.random.default_rng([self.seed, 1])
        speed = self.speed_factor * _SPEEDS[self.target] * rng.uniform(0.7, 1.3)
        rate = smoothed_noise(rng, self.frames, 1.0 / self.fps, 0.12, 2.0)
        course = rng.uniform(-np.pi, np.pi) + np.cumsum(rate) / self.fps
        step = speed / self.fps * np.column_stack([np.cos(course), np.sin(course)])
        return np.cumsum(step, axis=0), course

    @cached_property
    def _camera(self) -> tuple[Floats, Floats, Floats]:
        """camera_from_world (n, 3, 3), centres (n, 3) [m], focal lengths (n,) [px]."""
        rng = np.random.default_rng([self.seed, 2])
        place, _ = self._path
        n, t = self.frames, self._times
        distance = self.range_factor * _RANGES[self.target] * rng.uniform(0.7, 1.4)
        depression = np.deg2rad(rng.uniform(12.0, 40.0))
        bearing = rng.uniform(-np.pi, np.pi) + np.zeros(n)
        if self.flight == "orbit":
            bearing = bearing + rng.choice([-1.0, 1.0]) * 0.25 * t
        smooth = np.column_stack(
            [np.convolve(np.pad(place[:, k], 15, mode="edge"), np.full(31, 1 / 31), "valid") for k in (0, 1)]
        )
        reach = distance * np.cos(depression)
        centre = np.column_stack(
            [
                smooth[:, 0] - reach * np.cos(bearing) + smoothed_noise(rng, n, 1 / self.fps, 0.5, 1.5),
                smooth[:, 1] - reach * np.sin(bearing) + smoothed_noise(rng, n, 1 / self.fps, 0.5, 1.5),
                np.full(n, distance * np.sin(depression)) + smoothed_noise(rng, n, 1 / self.fps, 0.3, 1.5),
            ]
        )
        wobble = 0.02 * distance
        aim = np.column_stack([smooth[:, k] + smoothed_noise(rng, n, 1 / self.fps, wobble, 1.5) for k in (0, 1)])
        look = np.column_stack([aim, np.full(n, 0.8)]) - centre
        yaw = np.arctan2(look[:, 1], look[:, 0]) + np.deg2rad(smoothed_noise(rng, n, 1 / self.fps, 0.08, 0.05))
        pitch = np.arctan2(-look[:, 2], np.hypot(look[:, 0], look[:, 1]))
        roll = np.deg2rad(smoothed_noise(rng, n, 1 / self.fps, 1.0, 1.0))
        focal = np.full(n, self.size[0] * rng.uniform(0.8, 1.4))
        if self.flight == "zoom":
            focal = focal * np.exp(0.5 * np.sin(0.5 * t + rng.uniform(0, 6)))
        if self.flight == "away":
            share = self._away_share()
            yaw = yaw + share * rng.choice([-1.0, 1.0]) * (1.5 * np.arctan(0.5 * self.size[0] / focal[0]) + 0.1)
        return _rotations(yaw, pitch, roll), centre, focal

    def _away_share(self) -> Floats:
        """How far (n,) the camera has turned away, 0 to 1."""
        first, pan = 2.5, 0.6
        t = self._times
        up = np.clip((t - first) / pan, 0, 1)
        down = np.clip((t - first - pan - self.away_s) / pan, 0, 1)
        return np.asarray(0.5 * (np.cos(np.pi * down) - np.cos(np.pi * up)))

    @cached_property
    def _ground(self) -> tuple[Image, Image]:
        """Fine and coarse texture of the ground: earth, grass, streets, or water."""
        rng = np.random.default_rng([self.seed, 3])
        side = _TEXTURE_M
        shade = value_noise(rng, side, side, 60.0, 3)
        detail = value_noise(rng, side, side, 6.0, 2)
        if self.target == "boat":
            base = np.stack([130 + 14 * shade, 105 + 12 * shade, 50 + 10 * shade], axis=-1) + 9.0 * detail[..., None]
        else:
            earth, grass = np.array([110.0, 140.0, 165.0]), np.array([55.0, 105.0, 85.0])
            part = np.clip(0.5 + shade, 0, 1)[..., None]
            base = earth * part + grass * (1 - part) + 16.0 * detail[..., None]
        image = np.clip(base + rng.normal(0, 4, (side, side, 3)), 0, 255).astype(np.uint8)
        if self.target != "boat":
            for k in range(3):
                at = int(rng.integers(0, side))
                width = int(rng.integers(26, 40))
                stripe = (slice(at, at + width), slice(None)) if k % 2 else (slice(None), slice(at, at + width))
                image[stripe] = (image[stripe] * 0.15 + 82).astype(np.uint8)
            for _ in range(90):
                x, y = rng.integers(0, side, 2)
                cv2.circle(
                    image,
                    (int(x), int(y)),
                    int(rng.integers(2, 7)),
                    tuple(int(v) for v in rng.integers(40, 120, 3)),
                    -1,
                )
        coarse = cv2.resize(image, None, fx=1 / _COARSE, fy=1 / _COARSE, interpolation=cv2.INTER_AREA)
        return image, np.asarray(coarse, np.uint8)

    @cached_property
    def _surroundings(self) -> list[tuple[Body, Floats, float]]:
        """What stands: body, place, course."""
        rng = np.random.default_rng([self.seed, 4])
        place, _ = self._path
        out: list[tuple[Body, Floats, float]] = []
        for _ in range(70):
            tall = rng.random() < 0.45
            anchor = place[int(rng.integers(self.frames))]
            angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(14.0, 170.0)
            spot = anchor + far * np.array([np.cos(angle), np.sin(angle)])
            gap = 14.0 if tall else 5.0
            if self.target == "boat":
                gap, far = 25.0, 2 * far
            if np.hypot(*(place - spot).T).min() < gap or np.hypot(*(self._camera[1][:, :2] - spot).T).min() < gap + 10:
                continue
            body = bodies.building(rng) if tall else bodies.tree(rng)
            out.append((body, spot, float(rng.uniform(-np.pi, np.pi))))
        return [*out, *self._screens()]

    def _screens(self) -> list[tuple[Body, Floats, float]]:
        """Trees and poles that the target passes behind, each at the height at which the line of sight meets it."""
        rng = np.random.default_rng([self.seed, 8])
        place, _ = self._path
        _, centre, _ = self._camera
        out: list[tuple[Body, Floats, float]] = []
        for k in range(self.screens):
            at = int(rng.integers(round(0.8 * self.fps), self.frames))
            height = 3.0 if k % 3 == 2 else float(rng.uniform(4, 9))
            body = bodies.pole(rng) if k % 3 == 2 else bodies.tree(rng, height)
            share = height / centre[at, 2]
            out.append((body, place[at] + share * (centre[at, :2] - place[at]), 0.0))
        return out

    @cached_property
    def _traffic(self) -> list[tuple[int, Floats, float, tuple[int, int, int]]]:
        """What moves besides the target: seed, start place, course, colour; of the target's kind."""
        rng = np.random.default_rng([self.seed, 5])
        place, course = self._path
        out = []
        for k in range(6):
            side = rng.choice([-1.0, 1.0]) * rng.uniform(2.5, 12.0) * _SPEEDS[self.target] ** 0.5
            along = rng.uniform(-3.0, 12.0) * _SPEEDS[self.target]
            c = float(course[0])
            start = place[0] + along * np.array([np.cos(c), np.sin(c)]) + side * np.array([-np.sin(c), np.cos(c)])
            turned = c + rng.choice([0.0, np.pi]) + rng.normal(0, 0.1)
            out.append((k, start, float(turned), _colour(rng)))
        return out

    def _body(self, colour: tuple[int, int, int], time: float, course: float, view: View) -> Body:
        if self.target == "car":
            return bodies.car(colour)
        if self.target == "boat":
            return bodies.boat(colour)
        if self.target == "person":
            return bodies.person(colour, (70, 60, 50), 9.0 * time)
        right = view.matrix[0, :2] @ np.array([np.cos(course), np.sin(course)])
        return bodies.bicycle(colour, 8.0 * time, 1.0 if right > 0 else -1.0)

    def _view(self, i: int) -> View:
        rotation, centre, focal = (part[i] for part in self._camera)
        k = np.array([[focal, 0, (self.size[0] - 1) / 2], [0, focal, (self.size[1] - 1) / 2], [0, 0, 1.0]])
        return View(k @ np.column_stack([rotation, -rotation @ centre]), centre)

    def frame(self, i: int) -> Image:
        """The image (h, w, 3) BGR of frame ``i``."""
        return self.rendered(i)[0]

    def truth(self, i: int) -> ObliqueTruth:
        """Truth of frame ``i``."""
        return self.rendered(i)[1]

    def rendered(self, i: int) -> tuple[Image, ObliqueTruth]:
        """Image and truth of frame ``i``."""
        view = self._view(i)
        rotation, centre, focal = (part[i] for part in self._camera)
        image = self._backdrop(i, view)
        place, course = self._path
        t = float(self._times[i])
        colour = _colour(np.random.default_rng([self.seed, 6]))
        own = self._body(colour, t, float(course[i]), view)
        things = [(body, spot, turned, 0) for body, spot, turned in self._surroundings]
        for k, start, turned, other in self._traffic:
            at = start + 0.8 * _SPEEDS[self.target] * t * np.array([np.cos(turned), np.sin(turned)])
            if self.group:
                beside = np.random.default_rng([self.seed, 9, k]).uniform(-1.6, 1.6, 2)
                at = place[i] + beside + 0.7 * np.array([np.sin(0.7 * t + k), np.cos(0.5 * t + 2.0 * k)])
                turned = float(course[i])
            things.append((self._body(other, t + k, turned, view), at, turned, 0))
        things.append((own, place[i], float(course[i]), 255))
        depth = [float(view.matrix[2, :2] @ spot + view.matrix[2, 3]) for _, spot, _, _ in things]
        mask = np.zeros(image.shape[:2], np.uint8)
        silhouette = 0.0
        for k in np.argsort(depth)[::-1]:
            body, spot, turned, mark = things[int(k)]
            if depth[int(k)] < 4.0 or depth[int(k)] > 600.0:
                continue
            bodies.draw(image, mask, body, spot, turned, view, mark)
            if mark:
                silhouette = float(np.count_nonzero(mask))
        pixels, _ = bodies.outline(own, place[i], float(course[i]), view)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        limit = np.array(self.size) - 1.0
        part = np.clip(np.minimum(high, limit) - np.maximum(low, 0.0), 0.0, None)
        inside = float(np.prod(part) / np.prod(high - low)) if np.isfinite(low).all() else 0.0
        shown = float(np.count_nonzero(mask)) / silhouette if silhouette else 0.0
        box = Box(float(low[0]), float(low[1]), float(high[0] - low[0] + 1), float(high[1] - low[1] + 1))
        return self._exposed(i, image), ObliqueTruth(box, inside * shown, rotation, centre, float(focal))

    def _backdrop(self, i: int, view: View) -> Image:
        """Ground and sky."""
        rotation, centre, focal = (part[i] for part in self._camera)
        fine, coarse = self._ground
        flat = view.matrix[:, [0, 1, 3]]
        layers = []
        for texture, texel in ((fine, _TEXEL), (coarse, _TEXEL * _COARSE)):
            pixel = np.array([[texel, 0, 0], [0, texel, 0], [0, 0, 1.0]])
            layers.append(
                cv2.warpPerspective(
                    texture, flat @ pixel, self.size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
                )
            )
        v, u = np.mgrid[: self.size[1], : self.size[0]].astype(np.float32)
        ray = np.stack(
            [(u - (self.size[0] - 1) / 2) / focal, (v - (self.size[1] - 1) / 2) / focal, np.ones_like(u)], -1
        )
        down = -(ray @ rotation[:, 2].astype(np.float32))
        distance = centre[2] / np.maximum(down, 1e-4)
        haze = np.clip(distance / 1500.0, 0.0, 1.0)[..., None]
        far = np.clip((distance / (_FAR_M * focal / 600.0) - 0.7) / 0.6, 0.0, 1.0)[..., None]
        ground = layers[0] * (1 - far) + layers[1] * far
        sky = np.array([215.0, 205.0, 195.0]) - 60.0 * np.clip(-down, 0, 1)[..., None] * np.array([0.2, 0.6, 1.0])
        ground = ground * (1 - haze) + np.array([215.0, 205.0, 195.0]) * haze
        return np.asarray(np.where(down[..., None] > 2e-4, ground, sky), np.uint8)

    def _exposed(self, i: int, image: Image) -> Image:
        """Rolling shutter, motion blur, noise and compression."""
        rotation = self._camera[0]
        before = max(i - 1, 0)
        step = rotation[i] @ rotation[before].T
        focal = float(self._camera[2][i])
        speed = focal * np.array([step[0, 2], step[1, 2]]) * self.fps  # [px/s]
        lean = float(np.clip(-speed[0] * _READOUT_S / self.size[1], -0.2, 0.2))
        matrix = np.array([[1.0, lean, -0.5 * lean * self.size[1]], [0.0, 1.0, 0.0]])
        image = np.asarray(cv2.warpAffine(image, matrix, self.size, borderMode=cv2.BORDER_REPLICATE), np.uint8)
        smear = int(min(np.hypot(*speed) * 0.004, 9))
        if smear > 1:
            kernel = np.zeros((smear, smear), np.float32)
            angle = np.arctan2(speed[1], speed[0])
            half = 0.5 * (smear - 1)
            a = np.array([half - half * np.cos(angle), half - half * np.sin(angle)])
            b = np.array([half + half * np.cos(angle), half + half * np.sin(angle)])
            cv2.line(kernel, tuple(round(v) for v in a), tuple(round(v) for v in b), 1.0)
            image = np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.uint8)
        rng = np.random.default_rng([self.seed, 7, i])
        noise = rng.normal(0, 2.5, image.shape[:2]).astype(np.float32)[..., None]
        noisy = np.clip(cv2.GaussianBlur(image, (3, 3), 0.6) + noise, 0, 255).astype(np.uint8)
        _, code = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, self.quality])
        return np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR), np.uint8)


def _rotations(yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """camera_from_world (n, 3, 3): optical axis towards yaw (from x, anticlockwise), pitch below the horizon."""
    forward = np.column_stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    right = np.column_stack([np.sin(yaw), -np.cos(yaw), np.zeros(len(yaw))])
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * right + s * down, c * down - s * right, forward], axis=1)


def _colour(rng: np.random.Generator) -> tuple[int, int, int]:
    b, g, r = (int(v) for v in rng.integers(20, 236, 3))
    return b, g, r
