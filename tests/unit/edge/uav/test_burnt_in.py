"""What is burnt into the picture is not the ground, and one of the target's kind beside it is not the target."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.uav.base import Box
from edge.uav.correlation.filter import CorrelationFilter
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.image_motion.scene_motion import SceneMotion
from protocols.geometry.types import Floats, Image

SIZE, CONTRAST = (640, 360), 1.0


def ground(contrast: float = 6.0) -> Image:
    """A texture (900, 1400, 3) of soft blobs, as fields and bushes are."""
    noise = np.random.default_rng(3).uniform(0, 255, (900, 1400)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 4.0)
    gray = np.clip(110.0 + (soft - soft.mean()) * contrast, 0, 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)


def with_display(image: Image) -> Image:
    """The image under white lines of text, as a pilot's display shows."""
    out = image.copy()
    for k, text in enumerate(("ALT 120.4 m", "SPD 11.2 m/s", "HDG 273", "BAT 15.6 V")):
        for x in (8, SIZE[0] - 130):
            cv2.putText(out, text, (x, 24 + 20 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
    cv2.putText(out, "MODE AUTO   LINK 98 %   GPS 14", (150, 348), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
    return out


def motions(display: bool, shifts: list[float], noise: float = 0.0) -> tuple[list[Floats], SceneMotion]:
    """Motions (2,) [px] of the picture's middle over images each shifted by so much [px], and who measured them."""
    texture, scene, x = ground(CONTRAST), SceneMotion(SIZE), 0.0
    rng, found = np.random.default_rng(1), []
    for shift in (0.0, *shifts):
        x += shift
        image = texture[200:560, 100 + round(x) : 740 + round(x)]
        image = np.clip(image + rng.normal(0.0, noise, image.shape), 0, 255).astype(np.uint8)
        motion = scene.update(with_display(image) if display else image, None)
        found.append(motion.at(np.array([320.0, 180.0]), scene.reach) - [320.0, 180.0])
    return found[1:], scene


def test_a_display_that_stands_still_in_the_picture_is_not_the_ground_of_a_camera_that_pans() -> None:
    shifts = [0.0, 0.0, 12.0, 50.0, 90.0, 90.0, 50.0, 12.0, 4.0]
    found, _ = motions(True, shifts)
    for step, shift in zip(found, shifts, strict=True):
        assert step == pytest.approx([-shift, 0.0], abs=1.5)


def test_of_a_camera_that_stands_nothing_is_burnt_in() -> None:
    for display in (False, True):
        found, scene = motions(display, [0.0] * 12, noise=8.0)
        assert np.abs(found).max() < 0.5
        assert scene.update(ground()[200:560, 100:740], None) is not None
        assert cv2.countNonZero(scene._burnt_in.mask) == scene._burnt_in.mask.size


def test_beside_the_target_one_that_looks_more_like_it_is_not_taken_for_it() -> None:
    texture, car = ground()[:360, :640], np.full((16, 34, 3), 235, np.uint8)
    car[4:12, 8:14], car[4:12, 24:28] = 40, 40
    first, now = texture.copy(), texture.copy()
    first[150:166, 300:334] = car
    now[150:166, 300:334] = np.asarray(0.12 * car + 0.88 * texture[150:166, 300:334], np.uint8)  # dimmed
    now[138:154, 322:356] = car
    box = OrientedBox.upright(Box(300.0, 150.0, 34.0, 16.0))
    filtered = CorrelationFilter(34.0, 16.0)
    filtered.learn(first, box)
    anywhere, near = filtered.respond(now, box), filtered.respond(now, box, 12.0)
    assert np.hypot(anywhere.x, anywhere.y) > 8.0
    assert np.hypot(near.x, near.y) < 3.0
