"""Renderer of people scenes: bodies of limbs with textured clothes before a room, with cast shadows.

Bodies are drawn from the farthest to the nearest, so that they occlude each other. There is no motion blur: at 8 ms a
walking leg moves by a pixel.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from edge.scenes.common.background import LIGHT_WORLD, PEDESTAL, SensorNoise, static_background, subtract_pedestal
from edge.scenes.common.base import Renderer
from edge.scenes.people.scene import RADII, PeopleScene, Person, joint_radii
from edge.scenes.people.walking import JOINTS
from protocols.geometry.types import Floats, Image

_NOISE_STD = 3.0  # 8-bit steps, of a small sensor indoors
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
_SHADE = 0.62  # share of light left in a shadow
_SHRINK = 4  # downscaling of the shadow mask
_CLOTH = (96, 48)  # px of a body's texture
_J = {name: index for index, name in enumerate(JOINTS)}
_LIMBS = ("hip", "knee", "ankle", "toe"), ("shoulder", "elbow", "hand")


class PeopleRenderer(Renderer):
    """Images of a people scene from one camera.

    noise_rng: sensor noise. noise_std: its std [8-bit steps]. background: (H, W, 3) BGR in place of the scene's room.
    """

    def __init__(
        self,
        scene: PeopleScene,
        camera: str,
        noise_rng: np.random.Generator,
        noise_std: float = _NOISE_STD,
        background: Image | None = None,
    ) -> None:
        self._scene = scene
        self._name = camera
        self._camera = scene.camera(camera)
        lens = self._camera.intrinsics
        if background is None:
            background = static_background(self._camera, scene.seed, scene.room)
        self.replace_background(background)
        self._noise = SensorNoise(lens.width, lens.height, noise_std, noise_rng)
        self._cloth = [_cloth(scene.seed, index, person.pattern) for index, person in enumerate(scene.people)]
        self._reach = joint_radii(scene.heights)

    def replace_background(self, image: Image) -> None:
        """Draw people before another background (H, W, 3) BGR from now on."""
        self._dimmed = subtract_pedestal(image)

    def render(self, true_time: float) -> Image:
        return self._noise.add(self._draw(true_time, None))

    def render_with_owners(self, true_time: float) -> tuple[Image, Image]:
        """The image, and the instance mask (H, W): 0 background, else the person's index + 1."""
        owners = np.zeros(self._dimmed.shape[:2], np.uint8)
        return self._noise.add(self._draw(true_time, owners)), owners

    def _draw(self, true_time: float, owners: Image | None) -> Image:
        joints = self._scene.joints(np.array([true_time]))[0]
        pixels = self._scene.seen_by(self._name, joints)
        depth = self._camera.pose.camera_from_world(joints.reshape(-1, 3))[:, 2].reshape(joints.shape[:2])
        image = self._shaded(joints)
        for index in np.argsort(-depth[:, _J["pelvis"]]):
            if np.isfinite(pixels[index]).all():
                scale = self._camera.intrinsics.focal / depth[index]
                self._draw_person(image, owners, int(index), pixels[index], depth[index], scale)
        return image

    def _shaded(self, joints: Floats) -> Image:
        """The room with soft shadows of the bodies on its floor."""
        lens = self._camera.intrinsics
        light = LIGHT_WORLD
        ground = joints - joints[..., 2:] / light[2] * light
        near = np.concatenate([ground[..., :2], np.zeros((*ground.shape[:-1], 1))], axis=-1)
        pixels = self._scene.seen_by(self._name, near)
        depth = self._camera.pose.camera_from_world(near.reshape(-1, 3))[:, 2].reshape(near.shape[:2])
        mask = np.zeros((lens.height // _SHRINK, lens.width // _SHRINK), np.uint8)
        for index in range(len(joints)):
            if not np.isfinite(pixels[index]).all():
                continue
            width = self._reach[index] * lens.focal / np.maximum(depth[index], 0.3) / _SHRINK
            place = pixels[index] / _SHRINK
            for one, other, thick in _bones():
                _line(mask, place[one], place[other], 2.0 * thick * max(width[one], width[other]), 255)
        if not mask.any():
            return self._dimmed.copy()
        soft = cv2.GaussianBlur(mask, (0, 0), 1.2)
        share = 255 - cv2.resize(soft, (lens.width, lens.height), interpolation=cv2.INTER_LINEAR) * (1.0 - _SHADE)
        rows = np.flatnonzero(soft.any(axis=1))
        top, bottom = int(rows[0]) * _SHRINK, min((int(rows[-1]) + 2) * _SHRINK, lens.height)
        image = self._dimmed.copy()
        part = image[top:bottom]
        lit = cv2.multiply(part, cv2.merge([share[top:bottom].astype(np.uint8)] * 3), scale=1.0 / 255.0)
        # The pedestal has been subtracted already, and must not be attenuated.
        image[top:bottom] = cv2.subtract(lit, _pedestal_correction(share[top:bottom].astype(np.uint8)))
        return image

    def _draw_person(
        self, image: Image, owners: Image | None, index: int, pixels: Floats, depth: Floats, scale: Floats
    ) -> None:
        person = self._scene.people[index]
        reach = self._reach[index] * scale
        low = np.floor((pixels - reach[:, None]).min(axis=0) - 2).astype(int)
        high = np.ceil((pixels + reach[:, None]).max(axis=0) + 3).astype(int)
        left, top = max(int(low[0]), 0), max(int(low[1]), 0)
        right, bottom = min(int(high[0]), image.shape[1]), min(int(high[1]), image.shape[0])
        if right - left < 2 or bottom - top < 2:
            return
        crop = image[top:bottom, left:right]
        colour, mask = crop.copy(), np.zeros(crop.shape[:2], np.uint8)
        _body((colour, mask), pixels - (left, top), depth, scale, person)
        size = int(high[0] - low[0]), int(high[1] - low[1])
        cloth = cv2.resize(self._cloth[index], size, interpolation=cv2.INTER_LINEAR)
        cloth = cloth[top - low[1] : bottom - low[1], left - low[0] : right - low[0]]
        worn = cv2.multiply(colour, cloth, scale=1.0 / 128.0)
        # Edges were anti-aliased when drawn; inside them the texture is applied.
        np.copyto(colour, worn, where=(mask > 250)[..., None])
        crop[:] = colour
        if owners is not None:
            owners[top:bottom, left:right][mask > 127] = index + 1


def _pedestal_correction(share: npt.NDArray[np.uint8]) -> Image:
    """Correction of the pedestal, which was attenuated together with the light."""
    lost = np.rint(PEDESTAL * (1.0 - share.astype(np.float32) / 255.0)).astype(np.uint8)
    return np.asarray(cv2.merge([lost] * 3), dtype=np.uint8)


def _bones() -> list[tuple[int, int, float]]:
    bones = [(_J["pelvis"], _J["neck"], 1.3), (_J["head"], _J["head"], 1.0)]
    for side in "lr":
        for chain in _LIMBS:
            bones += [(_J[f"{a}_{side}"], _J[f"{b}_{side}"], 1.0) for a, b in pairwise(chain)]
    return bones


def _body(canvas: tuple[Image, Image], pixels: Floats, depth: Floats, scale: Floats, person: Person) -> None:
    """Draw a body's parts, the farther arm and leg first."""
    size = person.height * scale

    def limb(one: str, other: str, share: float, colour: tuple[float, float, float]) -> None:
        a, b = _J[one], _J[other]
        width = 2.0 * share * 0.5 * (size[a] + size[b])
        _line(canvas[0], pixels[a], pixels[b], width, _less_pedestal(colour))
        _line(canvas[1], pixels[a], pixels[b], width, 255)

    sides = sorted("lr", key=lambda side: -depth[_J[f"hip_{side}"]])
    for side in sides:
        far = 0.85 if side == sides[0] else 1.0
        trousers, shoes = _scaled_colour(person.trousers, far), _scaled_colour(person.shoes, far)
        if side == sides[0]:
            _arm(limb, person, side, far)
        limb(f"ankle_{side}", f"toe_{side}", 0.022, shoes)
        limb(f"hip_{side}", f"knee_{side}", RADII["thigh"], trousers)
        limb(f"knee_{side}", f"ankle_{side}", RADII["shank"], trousers)
    hull = []
    for name, share in (("shoulder_l", 0.045), ("shoulder_r", 0.045), ("pelvis", RADII["pelvis"])):
        at, radius = pixels[_J[name]], share * size[_J[name]]
        hull.append(at + radius * _CIRCLE)
    points = np.concatenate(hull).astype(np.float32)
    outline = np.rint(cv2.convexHull(points)[:, 0] * (1 << _SHIFT)).astype(np.int32)
    for target, colour in ((canvas[0], _less_pedestal(person.top)), (canvas[1], 255)):
        cv2.fillConvexPoly(target, outline, colour, cv2.LINE_AA, _SHIFT)
    limb("neck", "head", RADII["neck"], person.skin)
    limb("head", "head", RADII["head"], person.hair)
    face = pixels[_J["head"]] + 0.015 * size[_J["head"]] * np.array([0.0, 1.0])
    _line(canvas[0], face, face, 2.0 * 0.048 * size[_J["head"]], _less_pedestal(person.skin))
    _arm(limb, person, sides[1], 1.0)


def _arm(limb: object, person: Person, side: str, far: float) -> None:
    assert callable(limb)
    limb(f"shoulder_{side}", f"elbow_{side}", RADII["arm"] * 1.15, _scaled_colour(person.top, 0.92 * far))
    limb(f"elbow_{side}", f"hand_{side}", RADII["arm"], _scaled_colour(person.top, 0.92 * far))
    limb(f"hand_{side}", f"hand_{side}", RADII["arm"], person.skin)


_CIRCLE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 12)), np.sin(np.linspace(0, 2 * np.pi, 12))], axis=-1)


def _line(target: Image, a: Floats, b: Floats, width: float, colour: object) -> None:
    """A bar with round ends, to a sixteenth of a pixel (its width to whole pixels)."""
    ends = [tuple(int(value) for value in np.rint(np.clip(at, -2e4, 2e4) * (1 << _SHIFT))) for at in (a, b)]
    cv2.line(target, ends[0], ends[1], colour, max(round(width), 1), cv2.LINE_AA, _SHIFT)  # type: ignore[call-overload]


def _scaled_colour(colour: tuple[float, float, float], share: float) -> tuple[float, float, float]:
    return colour[0] * share, colour[1] * share, colour[2] * share


def _less_pedestal(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    return max(colour[0] - PEDESTAL, 0.0), max(colour[1] - PEDESTAL, 0.0), max(colour[2] - PEDESTAL, 0.0)


def _cloth(seed: int, index: int, pattern: str) -> Image:
    """Texture of folds, patterns and side light, (96, 48, 3) about 128."""
    rng = np.random.default_rng([seed, 7, index])
    height, width = _CLOTH
    folds = cv2.GaussianBlur(rng.normal(0.0, 1.0, _CLOTH), (0, 0), 2.5)
    light = 1.0 + 0.12 * folds / folds.std()
    light *= np.linspace(1.12, 0.82, width)[None]
    down, across = np.mgrid[:height, :width]
    upper = down < 0.5 * height
    if pattern == "stripes":
        light = np.where(upper & (down // 4 % 2 == 0), 0.72 * light, light)
    elif pattern == "checks":
        light = np.where(upper & ((down // 5 + across // 5) % 2 == 0), 0.78 * light, light)
    grey = np.clip(np.rint(128.0 * light), 0, 255).astype(np.uint8)
    return np.asarray(grey[..., None].repeat(3, axis=2), dtype=np.uint8)
