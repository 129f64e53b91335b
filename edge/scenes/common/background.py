"""What renderers share: viewing rays, sensor noise, and the background, a furnished room or an open field, ray-cast.

Everything consists of boxes, spheres and value noise from the scene's seed, so that all cameras of a scene see the same
room. The furniture includes distractors similar to the marker on purpose: balls of nearby hues, cardboard, a wooden
floor.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.scenes.common.base import SimulatedCamera
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_CELLS = 256  # of the texture, each way
_LIGHT = np.array([0.25, -0.35, 0.9]) / np.linalg.norm([0.25, -0.35, 0.9])
LIGHT_WORLD: Floats = _LIGHT
"""Unit vector (3,) towards the lamp, in world axes."""

_WALL_BGR = np.array([[196, 206, 208], [186, 190, 178], [205, 200, 192], [176, 192, 200]], dtype=np.float64)
_BALL_BGR = ((38, 36, 205), (40, 205, 228), (170, 70, 40), (140, 60, 205))  # red, yellow, blue, pink
_BOX_BGR = ((96, 140, 178), (150, 120, 70), (70, 78, 90), (88, 150, 92), (60, 60, 150))  # cardboard first
# No two poster colours mix to the marker's: a truly orange patch would be a second marker.
_POSTER_BGR = ((60, 60, 190), (150, 140, 60), (150, 110, 60), (90, 130, 90), (120, 80, 140))

PEDESTAL = 20
"""Offset of the stored noise, so that one saturating 8-bit addition applies it."""
_BACKGROUND_STREAM = 2  # of a scene's random numbers, beside those of cameras (0) and of what moves (1)
_BACKGROUND_WIDTH = 960  # px; wider images get a background of this width, enlarged
_BANK_MARGIN = 96  # px by which the noise image exceeds the image: 9216 different crops


def room(rays: Floats, eye: Floats, half: float, height: float, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """A furnished room (H, W, 3) BGR.

    rays: (H, W, 3) directions in world axes, one per pixel. eye: (3,) camera centre. half, height: half the side and
    the height of the room [m].
    """
    directions = rays.reshape(-1, 3)
    texture = _Texture(rng)
    depth, colour = _shell(directions, eye, half, height, texture, rng)
    safe = np.ascontiguousarray(_without_zeros(directions).T)
    for _ in range(7):  # boxes on the floor
        bgr = np.array(_BOX_BGR[int(rng.integers(len(_BOX_BGR)))], dtype=np.float64)
        size = np.array([rng.uniform(0.2, 0.35), rng.uniform(0.2, 0.35), rng.uniform(0.2, 0.9)])
        centre = np.array([*_by_the_wall(rng, half, 0.4), 0.5 * size[2]])
        a, b = (centre - 0.5 * size - eye)[:, None] / safe, (centre + 0.5 * size - eye)[:, None] / safe
        entry, leave = np.minimum(a, b), np.maximum(a, b)
        near = entry.max(axis=0)
        hit = (near < leave.min(axis=0)) & (near > 0.05) & (near < depth)
        point = eye + near[hit, None] * directions[hit]
        light = np.array([0.75, 0.62, 1.05])[entry[:, hit].argmax(axis=0)]
        marks = texture.at(point[:, 0] * 5.0 + point[:, 1] * 3.0, point[:, 2] * 5.0)
        colour[hit] = bgr * (light * (1.0 + 0.05 * marks))[:, None]
        depth[hit] = near[hit]
    for ball_bgr in _BALL_BGR:  # that are not the marker
        radius = rng.uniform(0.07, 0.14)
        centre = np.array([*_by_the_wall(rng, half, 0.4), radius])
        closest = directions @ (centre - eye)
        miss2 = (centre - eye) @ (centre - eye) - closest * closest
        near = closest - np.sqrt(np.maximum(radius * radius - miss2, 0.0))
        hit = (miss2 < radius * radius) & (near > 0.05) & (near < depth)
        normal = (eye + near[hit, None] * directions[hit] - centre) / radius
        colour[hit] = np.array(ball_bgr, np.float64) * (0.55 + 0.5 * np.clip(normal @ _LIGHT, 0.0, 1.0))[:, None]
        depth[hit] = near[hit]
    return _finish(colour, rays.shape[:2])


def field(rays: Floats, eye: Floats, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Grass, a tree line and a sky (H, W, 3) BGR; arguments as for ``room``."""
    directions = rays.reshape(-1, 3)
    texture = _Texture(rng)
    down = directions[:, 2]
    # The horizon as a circle: noise over an azimuth would have a seam at ±180°.
    east, north = (directions[:, :2] / np.maximum(np.linalg.norm(directions[:, :2], axis=1), 1e-9)[:, None]).T
    sky = np.array([225, 195, 160.0]) + np.clip(down, 0, 1)[:, None] * np.array([10, -45, -70.0])
    clouds = texture.at(east * 2.0 + np.clip(down, 0, 1) * 6.0, north * 2.0)
    sky += np.clip(clouds - 0.2, 0, 1)[:, None] * np.array([35, 50, 80.0])
    ground = np.where(down < -1e-3, -eye[2] / np.minimum(down, -1e-3), 1e4)
    x, y = eye[0] + ground * directions[:, 0], eye[1] + ground * directions[:, 1]
    far = np.clip(ground / 300.0, 0, 1)
    blades = texture.at(x * 1.7, y * 1.7) * (1.0 - far) + texture.at(x * 0.08, y * 0.08)
    grass = np.array([58, 118, 104.0]) * (1.0 + 0.22 * blades)[:, None]
    grass += far[:, None] * np.array([50, 20, 10.0])
    trees = 0.05 + 0.03 * texture.at(east * 14.0, north * 14.0)
    wood = (
        np.array([52, 74, 62.0])
        * (1.0 + 0.3 * texture.at(east * 60.0 + down * 40.0, north * 60.0 + down * 40.0))[:, None]
    )
    colour = np.where(down[:, None] > 0, sky, grass)
    colour = np.where(((down > -0.004) & (down < trees))[:, None], wood, colour)
    return _finish(colour, rays.shape[:2])


class _Texture:
    """Value noise of several octaves, roughly within ±1, without visible repetition."""

    def __init__(self, rng: np.random.Generator) -> None:
        cells = np.tile(rng.normal(0.0, 1.0, (_CELLS, _CELLS)).astype(np.float32), (3, 3))
        smooth = cv2.GaussianBlur(cells, (0, 0), 1.0)[_CELLS : 2 * _CELLS + 1, _CELLS : 2 * _CELLS + 1]
        self._table = np.ascontiguousarray(smooth / (2.0 * smooth.std()))  # its last row is its first: no seam

    def at(self, x: Floats, y: Floats, octaves: int = 3) -> Floats:
        """Noise (n,) at points (n,), (n,); one cell is about one unit."""
        total = np.zeros(len(x))
        for octave in range(octaves):
            scale, shift = 2.3**octave * 2.0, 37.7 * octave
            u = np.mod(x * scale + shift, _CELLS).astype(np.float32)
            v = np.mod(y * scale + 1.7 * shift, _CELLS).astype(np.float32)
            rows = len(u) // 1024 + 1  # cv2.remap takes images, not rows longer than 32767
            padded = np.zeros((2, rows * 1024), np.float32)
            padded[0, : len(u)], padded[1, : len(v)] = u, v
            sample = cv2.remap(
                self._table, padded[0].reshape(rows, 1024), padded[1].reshape(rows, 1024), cv2.INTER_LINEAR
            )
            total += np.asarray(sample, dtype=np.float64).ravel()[: len(u)] / 2.0**octave
        return total


def _by_the_wall(rng: np.random.Generator, half: float, depth: float) -> Floats:
    """A place (2,) on the floor within ``depth`` of a random wall: behind the cameras, never in front of them."""
    along, inset = rng.uniform(-0.85 * half, 0.85 * half), half - rng.uniform(0.5, 1.0) * depth
    return np.array([(inset, along), (-inset, along), (along, inset), (along, -inset)][int(rng.integers(4))])


def _shell(
    directions: Floats, eye: Floats, half: float, height: float, texture: _Texture, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Distances (n,) and colours (n, 3) of floor, ceiling and walls."""
    low, high = np.array([-half, -half, 0.0]), np.array([half, half, height])
    safe = _without_zeros(directions)
    distance = np.where(safe > 0, high - eye, low - eye) / safe
    axis = np.argmin(distance, axis=1)
    depth = distance[np.arange(len(axis)), axis]
    hit = eye + depth[:, None] * directions
    positive = directions[np.arange(len(axis)), axis] > 0
    side = np.where(axis == 2, 4 + positive, 2 * axis + positive)
    along = np.where(axis == 0, hit[:, 1], hit[:, 0])
    wall = _WALL_BGR[np.minimum(side, 3)] * (1.0 + 0.035 * texture.at(along * 3.0, hit[:, 2] * 3.0 + side))[:, None]
    skirting = hit[:, 2] < 0.1
    wall[skirting] = np.array([205, 212, 215.0])
    for _ in range(6):  # posters
        which, centre = int(rng.integers(4)), rng.uniform(-0.75, 0.75) * half
        middle, w, h = rng.uniform(0.5, 0.75) * height, rng.uniform(0.2, 0.45), rng.uniform(0.2, 0.4)
        base = np.array(_POSTER_BGR[int(rng.integers(len(_POSTER_BGR)))], dtype=np.float64)
        other = np.array(_POSTER_BGR[int(rng.integers(len(_POSTER_BGR)))], dtype=np.float64)
        x, y = np.abs(along - centre) / w, np.abs(hit[:, 2] - middle) / h
        inside = (side == which) & (x < 1.0) & (y < 1.0)
        wall[(side == which) & (x < 1.06) & (y < 1.06)] = np.array([60, 62, 64.0])
        blend = np.clip(0.5 + texture.at(along[inside] * 2.5 + 9.0 * which, hit[inside, 2] * 2.5), 0, 1)[:, None]
        wall[inside] = blend * base + (1.0 - blend) * other
    _paint_window(wall, side, along, hit[:, 2], int(rng.integers(4)), rng.uniform(-0.5, 0.5) * half)
    colour = np.where((side == 4)[:, None], _planks(hit, texture), wall)
    colour[side == 5] = np.array([222, 226, 226.0])
    # Ambient occlusion: corners are darker.
    to_corner = np.minimum.reduce([half - np.abs(along), hit[:, 2] + 0.15, height - hit[:, 2] + 0.3])
    on_flat = np.minimum(half - np.abs(hit[:, 0]), half - np.abs(hit[:, 1]))
    nook = np.where(axis == 2, on_flat, to_corner)
    colour *= (0.74 + 0.26 * np.clip(nook / 0.9, 0.0, 1.0))[:, None]
    lamp = np.linalg.norm(hit - np.array([0.4, -0.5, height]), axis=1)
    colour *= (1.08 - 0.05 * np.minimum(lamp, 6.0))[:, None]
    return depth, colour


def _planks(hit: Floats, texture: _Texture) -> Floats:
    """A floor of wooden boards: the marker's hue at a third of its saturation."""
    board = np.floor(hit[:, 0] / 0.14)
    tone = texture.at(board * 3.3, np.zeros_like(board), octaves=1)
    grain = texture.at(hit[:, 0] * 22.0 + board * 5.1, hit[:, 1] * 1.3)
    colour = np.array([104, 141, 170.0]) * (1.0 + 0.07 * tone + 0.07 * grain)[:, None]
    seam = np.abs(hit[:, 0] / 0.14 - board) < 0.03
    colour[seam] *= 0.72
    return np.asarray(colour)


def _paint_window(
    wall: Floats, side: npt.NDArray[np.int64], along: Floats, up: Floats, which: int, centre: float
) -> None:
    x, y = np.abs(along - centre) / 0.7, np.abs(up - 1.55) / 0.6
    wall[(side == which) & (x < 1.1) & (y < 1.1)] = np.array([225, 228, 230.0])
    pane = (side == which) & (x < 1.0) & (y < 1.0) & (x > 0.05)
    wall[pane] = np.array([250, 240, 225.0]) - 40.0 * np.clip(1.55 - up[pane], 0, 1)[:, None] * np.array([1, 0.5, 0.6])


def _without_zeros(directions: Floats) -> Floats:
    """The directions (n, 3) as divisors."""
    return np.asarray(np.where(np.abs(directions) < 1e-9, 1e-9, directions))


def _finish(colour: Floats, shape: tuple[int, ...]) -> npt.NDArray[np.uint8]:
    """Round to 8 bits, blurred as by a lens."""
    image = np.clip(colour, 0.0, 255.0).reshape(shape[0], shape[1], 3).astype(np.float32)
    return np.asarray(np.rint(cv2.GaussianBlur(image, (0, 0), 0.6)), dtype=np.uint8)


def pixel_rays(lens: Intrinsics, u: Floats, v: Floats) -> Floats:
    """Unit vectors (h, w, 3) in camera axes of pixels (h, w), (h, w)."""
    flat = lens.unproject(np.column_stack([u.ravel(), v.ravel()]))
    rays = np.column_stack([flat, np.ones(len(flat))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(rays.reshape(*u.shape, 3))


def static_background(camera: SimulatedCamera, seed: int, walls: tuple[float, float] | None) -> npt.NDArray[np.uint8]:
    """The image (H, W, 3) BGR of an empty scene, whose ``seed`` it comes from, so that all cameras see the same.

    walls: half the side and the height [m] of a furnished room; None = an open field.
    """
    lens, pose = camera.intrinsics, camera.pose
    rng = np.random.default_rng([seed, _BACKGROUND_STREAM])
    shrink = max(1.0, lens.width / _BACKGROUND_WIDTH)
    width, height = round(lens.width / shrink), round(lens.height / shrink)
    u = (np.arange(width) + 0.5) * lens.width / width - 0.5
    v = (np.arange(height) + 0.5) * lens.height / height - 0.5
    rays = pixel_rays(lens, *np.meshgrid(u, v)) @ pose.rotation
    image = field(rays, pose.position, rng) if walls is None else room(rays, pose.position, *walls, rng)
    if shrink > 1.0:
        image = np.asarray(cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    return image


class SensorNoise:
    """Gaussian noise of a sensor of (width, height) px; std in 8-bit steps."""

    def __init__(self, width: int, height: int, std: float, rng: np.random.Generator) -> None:
        self._size = width, height
        self._rng = rng
        shape = (height + _BANK_MARGIN, width + _BANK_MARGIN, 3)
        noise = rng.standard_normal(shape, dtype=np.float32) * std + PEDESTAL
        self._bank = np.clip(np.rint(noise), 0, 255).astype(np.uint8)

    def add(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """The noisy image of one from which PEDESTAL has been subtracted; it saturates as a sensor does."""
        dy, dx = self._rng.integers(0, _BANK_MARGIN, 2)
        width, height = self._size
        return np.asarray(cv2.add(image, self._bank[dy : dy + height, dx : dx + width]), dtype=np.uint8)


def subtract_pedestal(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """An image less PEDESTAL, for ``SensorNoise.add``."""
    return np.asarray(np.maximum(image, PEDESTAL) - np.uint8(PEDESTAL), dtype=np.uint8)
