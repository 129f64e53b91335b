"""Occluders that stand on the ground: buildings, tree canopies, a bridge; rendering and ray-based occlusion tests.

Occlusion is tested by the rays from the camera to points on a car: which of them does an occluder intersect?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from edge.uav.world.noise import value_noise
from protocols.geometry.types import Bools, Floats, Image

SUN_SHADOW = np.array([-0.62, 0.74])
"""North, east metres of shadow per metre of height."""
_SPRITE_M = 0.1  # metres per pixel of roofs and canopies
_ROOFS_BGR = ((72, 92, 148), (88, 88, 92), (70, 80, 104), (168, 172, 174), (120, 104, 88), (60, 66, 84))  # tiles, slate
_SHIFT = 4  # bits of OpenCV's fixed-point coordinates


class Occluder(Protocol):
    """An object above the ground that can occlude cars."""

    @property
    def centre(self) -> Floats:
        """North, east [m]."""

    @property
    def bounding_radius(self) -> float:
        """Radius of a bounding circle about the centre on the ground [m]."""

    def draw(self, image: Image, matrix: Floats) -> None:
        """Draw into ``image``; matrix: (3, 4) pixels from NED."""

    def occludes(self, camera: Floats, points: Floats) -> Bools:
        """Which of points (n, 3) NED this object occludes for a camera at (3,) NED."""

    def shadow(self) -> Floats:
        """Outline (k, 2) of its shadow on the ground [m]."""


@dataclass(frozen=True, eq=False)
class FlatOccluder:
    """A horizontal textured rectangle at a height: a canopy, a bridge deck, a roof.

    sprite: (h, w, 4) BGR and opacity, along x (right) its length, y its width. centre: (2,) [m]. course: of its x axis.
    height: [m]. thickness: of an opaque rim below it, 0 for none [m].
    """

    sprite: Image
    centre: Floats
    course: float
    height: float
    thickness: float = 0.0

    @property
    def bounding_radius(self) -> float:
        return 0.5 * _SPRITE_M * float(np.hypot(*self.sprite.shape[:2]))

    @property
    def _axes(self) -> Floats:
        """(2, 2): columns are the ground directions of the sprite's x and y."""
        c, s = np.cos(self.course), np.sin(self.course)
        return np.array([[c, -s], [s, c]])

    def _from_sprite(self, matrix: Floats, height: float) -> Floats:
        """Image homography (3, 3) from sprite pixels."""
        rows, columns = self.sprite.shape[:2]
        axes = _SPRITE_M * self._axes
        first = self.centre - axes @ np.array([(columns - 1) / 2, (rows - 1) / 2])
        ground = np.array(
            [[axes[0, 0], axes[0, 1], first[0]], [axes[1, 0], axes[1, 1], first[1]], [0, 0, -height], [0, 0, 1.0]]
        )
        return np.asarray(matrix @ ground)

    def outline(self, matrix: Floats, height: float) -> Floats:
        """The sprite's corners (4, 2) projected into the image as if it were at ``height``."""
        rows, columns = self.sprite.shape[:2]
        corner = np.array([[0, 0, 1], [columns, 0, 1], [columns, rows, 1], [0, rows, 1.0]]) - [0.5, 0.5, 0.0]
        seen = corner @ self._from_sprite(matrix, height).T
        return np.asarray(seen[:, :2] / seen[:, 2:])

    def draw(self, image: Image, matrix: Floats) -> None:
        corner = self.outline(matrix, self.height)
        if self.thickness:
            below = self.outline(matrix, self.height - self.thickness)
            _fill(image, _hull(np.vstack([corner, below])), (112, 114, 116))
        left, top = (max(int(np.floor(value)), 0) for value in corner.min(axis=0))
        right = min(int(np.ceil(corner[:, 0].max())) + 1, image.shape[1])
        bottom = min(int(np.ceil(corner[:, 1].max())) + 1, image.shape[0])
        if right <= left or bottom <= top:
            return
        move = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
        warp = move @ self._from_sprite(matrix, self.height)
        seen = cv2.warpPerspective(self.sprite, warp, (right - left, bottom - top), flags=cv2.INTER_LINEAR)
        cover = cv2.threshold(cv2.extractChannel(seen, 3), 127, 255, cv2.THRESH_BINARY)[1]
        view = image[top:bottom, left:right]
        cv2.copyTo(cv2.cvtColor(seen, cv2.COLOR_BGRA2BGR), cover, view)

    def occludes(self, camera: Floats, points: Floats) -> Bools:
        hidden = self._covers(_ray_at_height(camera, points, self.height))
        if self.thickness:
            hidden |= self._covers(_ray_at_height(camera, points, self.height - self.thickness))
        return hidden

    def _covers(self, ground: Floats) -> Bools:
        rows, columns = self.sprite.shape[:2]
        x, y = ((ground - self.centre) @ self._axes / _SPRITE_M + np.array([(columns - 1) / 2, (rows - 1) / 2])).T
        column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        cover = self.sprite[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1), 3] > 127
        return np.asarray(inside & cover)

    def shadow(self) -> Floats:
        rows, columns = self.sprite.shape[:2]
        half = 0.5 * _SPRITE_M * np.array([columns, rows])
        if self.thickness:
            unit = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
        else:
            angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
            unit = 0.85 * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.asarray((unit * half) @ self._axes.T + self.centre + self.height * SUN_SHADOW)


@dataclass(frozen=True, eq=False)
class Building:
    """A box with a textured roof. wall: BGR."""

    roof: FlatOccluder
    wall: tuple[int, int, int]

    @property
    def centre(self) -> Floats:
        return self.roof.centre

    @property
    def bounding_radius(self) -> float:
        return self.roof.bounding_radius

    @property
    def half(self) -> Floats:
        """Half length and half width (2,) [m]."""
        rows, columns = self.roof.sprite.shape[:2]
        return 0.5 * _SPRITE_M * np.array([columns, rows])

    def draw(self, image: Image, matrix: Floats) -> None:
        foot, top = self.roof.outline(matrix, 0.0), self.roof.outline(matrix, self.roof.height)
        for k in range(4):
            n = (k + 1) % 4
            b, g, r = (round(value * (0.62 + 0.14 * k)) for value in self.wall)
            _fill(image, _hull(np.array([foot[k], foot[n], top[n], top[k]])), (b, g, r))
        self.roof.draw(image, matrix)

    def occludes(self, camera: Floats, points: Floats) -> Bools:
        """Ray-box slab test: the part of each ray below the roof against the footprint."""
        axes = self.roof._axes
        near = (points[:, :2] - self.centre) @ axes
        far = (_ray_at_height(camera, points, self.roof.height) - self.centre) @ axes
        step = np.where(np.abs(far - near) < 1e-9, 1e-9, far - near)
        first, second = (-self.half - near) / step, (self.half - near) / step
        enter = np.minimum(first, second).max(axis=1)
        leave = np.maximum(first, second).min(axis=1)
        return np.asarray((enter <= leave) & (leave >= 0.0) & (enter <= 1.0))

    def shadow(self) -> Floats:
        unit = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
        foot = (unit * self.half) @ self.roof._axes.T + self.centre
        return _hull(np.vstack([foot, foot + self.roof.height * SUN_SHADOW]))


def random_building(
    rng: np.random.Generator, centre: Floats, course: float, length: float, width: float, height: float
) -> Building:
    """A building with a ridged or flat roof, with vents and weathering."""
    rows, columns = round(width / _SPRITE_M), round(length / _SPRITE_M)
    colour = np.array(_ROOFS_BGR[int(rng.integers(len(_ROOFS_BGR)))], np.float32)
    tone = 1.0 + 0.06 * value_noise(rng, rows, columns, 24.0, 3) + 0.03 * value_noise(rng, rows, columns, 2.0)
    if rng.random() < 0.6:  # a ridged roof: one side is lit by the sun
        tone[: rows // 2] *= 1.12
        tone[rows // 2 :] *= 0.82
        tone[:, ::6] *= 0.93
    texture = tone[..., None] * colour
    texture[:3], texture[-3:], texture[:, :3], texture[:, -3:] = (0.75 * colour,) * 4
    for _ in range(int(rng.integers(2, 6))):
        y, x = int(rng.integers(6, rows - 14)), int(rng.integers(6, columns - 14))
        texture[y : y + int(rng.integers(4, 11)), x : x + int(rng.integers(4, 11))] = rng.uniform(40, 215)
    sprite = np.dstack([np.clip(texture, 0, 255), np.full((rows, columns), 255.0)]).astype(np.uint8)
    b, g, r = (int(value) for value in rng.uniform(0.9, 1.1) * np.array([168, 182, 196]))
    return Building(FlatOccluder(sprite, centre, course, height), (b, g, r))


def random_canopy(rng: np.random.Generator, centre: Floats, radius: float, height: float) -> FlatOccluder:
    """A tree canopy: leaf texture with a ragged rim and a few holes."""
    side = 2 * round(1.15 * radius / _SPRITE_M) + 1
    axis = (np.arange(side) - side // 2) * _SPRITE_M
    away = np.hypot(axis[:, None], axis[None]) / radius
    rim = value_noise(rng, side, side, 1.1 / _SPRITE_M, 2)
    cover = (away + 0.16 * rim < 1.0) & ~((rim > 1.9) & (away > 0.35))
    leaves = value_noise(rng, side, side, 0.9 / _SPRITE_M, 3, gain=0.7)
    lit = 1.0 + 0.3 * (axis[:, None] * -SUN_SHADOW[0] + axis[None] * -SUN_SHADOW[1]) / radius
    colour = np.array([34, 76, 52]) * rng.uniform(0.75, 1.25) * np.array([1.0, 1.0, rng.uniform(0.85, 1.3)])
    texture = np.clip(1.0 + 0.24 * leaves, 0.35, 1.8)[..., None] * lit[..., None] * colour
    sprite = np.dstack([np.clip(texture, 0, 255), 255.0 * cover]).astype(np.uint8)
    return FlatOccluder(sprite, centre, 0.0, height)


def random_bridge(rng: np.random.Generator, centre: Floats, course: float, length: float, width: float) -> FlatOccluder:
    """A road bridge, 6 m above the ground."""
    rows, columns = round(width / _SPRITE_M), round(length / _SPRITE_M)
    tone = 1.0 + 0.07 * value_noise(rng, rows, columns, 30.0, 4) + 0.05 * value_noise(rng, rows, columns, 2.0)
    texture = tone[..., None] * np.array([104, 102, 100], np.float32)
    rim = round(0.8 / _SPRITE_M)
    texture[:rim] = texture[-rim:] = 158.0 * tone[:rim, :, None]
    line = round(1.2 / _SPRITE_M)
    texture[line : line + 2] = texture[-line - 2 : -line] = 222.0
    dashes = (np.arange(columns) * _SPRITE_M) % 8.0 < 4.0
    texture[rows // 2 - 1 : rows // 2 + 1, dashes] = 222.0
    texture[:, :: round(15.0 / _SPRITE_M)] *= 0.6  # joints
    sprite = np.dstack([np.clip(texture, 0, 255), np.full((rows, columns), 255.0)]).astype(np.uint8)
    return FlatOccluder(sprite, centre, course, 6.0, thickness=1.2)


@dataclass(frozen=True, eq=False)
class Occluders:
    """All occluders of a town. centres: (n, 2), reaches: (n,) [m]."""

    members: tuple[Occluder, ...]
    centres: Floats
    bounding_radii: Floats

    @classmethod
    def of(cls, members: Sequence[Occluder]) -> Occluders:
        """From its members."""
        centres = np.array([occluder.centre for occluder in members]).reshape(-1, 2)
        return cls(tuple(members), centres, np.array([occluder.bounding_radius for occluder in members]))

    def occluded(self, camera: Floats, points: Floats) -> Bools:
        """Which of points (n, 3) NED, all within one car, any member occludes for the camera at (3,) NED."""
        out = np.zeros(len(points), bool)
        middle = points[:, :2].mean(axis=0)
        span = camera[:2] - middle
        along = np.clip((self.centres - middle) @ span / max(float(span @ span), 1e-9), 0.0, 1.0)
        away = np.hypot(*(middle + along[:, None] * span - self.centres).T)
        for k in np.flatnonzero(away < self.bounding_radii + 4.0):
            out |= self.members[k].occludes(camera, points)
        return out

    def draw(self, image: Image, matrix: Floats, camera: Floats) -> None:
        """Draw all members that may be visible, far to near. matrix: (3, 4) pixels from NED; camera: (3,) NED."""
        foot = self.centres @ matrix[:, :2].T + matrix[:, 3]
        scale = np.hypot(*matrix[:2, 0]) / foot[:, 2]  # pixels per metre on the ground, about
        pixels = foot[:, :2] / foot[:, 2:]
        spare = scale * (1.5 * self.bounding_radii + 3.0)  # relief displacement: tall objects project farther out
        limit = np.array([image.shape[1], image.shape[0]])
        seen = ((pixels > -spare[:, None]) & (pixels < limit + spare[:, None])).all(axis=1)
        near = np.flatnonzero(seen)
        # Painter's order: relief displacement is away from the nadir, so objects nearer to it cover farther ones.
        for k in near[np.argsort(-np.hypot(*(self.centres[near] - camera[:2]).T), kind="stable")]:
            self.members[k].draw(image, matrix)


def _ray_at_height(camera: Floats, points: Floats, height: float) -> Floats:
    """Coordinates (n, 2) [m] of the rays from points (n, 3) to the camera (3,) at ``height`` above the ground."""
    share = (-height - points[:, 2]) / (camera[2] - points[:, 2])
    return np.asarray(points[:, :2] + np.clip(share, 0.0, 1.0)[:, None] * (camera[:2] - points[:, :2]))


def _hull(points: Floats) -> Floats:
    return np.asarray(cv2.convexHull(points.astype(np.float32)), np.float64).reshape(-1, 2)


def _fill(image: Image, outline: Floats, colour: tuple[int, int, int]) -> None:
    limited = np.clip(outline, -2000.0, 6000.0)
    cv2.fillConvexPoly(image, np.rint(limited * (1 << _SHIFT)).astype(np.int32), colour, cv2.LINE_AA, _SHIFT)
