"""Exposure: light that changes from image to image, dusk and haze."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.uav.base import Box
from edge.uav.correlation.filter import CorrelationFilter
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.ground.photometric import Contrast
from edge.uav.image_motion.scene_motion import SceneMotion
from edge.uav.tracker_factory import make_tracker
from protocols.core.errors import InputError
from protocols.geometry.types import Image
from tests.bench.uav_any_view import in_light
from tests.support.oblique.world import ObliqueWorld


def test_the_scenes_motion_is_measured_while_the_exposure_changes() -> None:
    rng = np.random.default_rng(3)
    ground = cv2.GaussianBlur(rng.normal(120, 160, (300, 500, 3)).astype(np.float32), (0, 0), 2.5)
    scene = np.asarray(np.clip(ground, 0, 255), np.uint8)
    motion = SceneMotion((320, 240))
    for k in range(12):
        found = motion.update(
            in_light(np.ascontiguousarray(scene[20:260, 20 + 3 * k : 340 + 3 * k]), "flicker", k), None
        )
        if k:
            assert found.trusted
            assert found.matrix == pytest.approx(np.array([[1.0, 0.0, -3.0], [0.0, 1.0, 0.0]]), abs=0.25)
    assert motion.photometric.gain[0] == pytest.approx(1.0 + 0.25 * np.sin(1.3 * 11), rel=0.08)


def faded(image: Image, k: int) -> Image:
    """Image ``k`` of a video that fades in from black within 15 images."""
    return np.asarray(min((k + 1.0) / 15.0, 1.0) * image, np.uint8)


@pytest.mark.parametrize("light", ["flicker", "dusk", "fade"])
def test_a_target_is_followed_in_any_light(light: str) -> None:
    world = ObliqueWorld("bicycle", "follow", seed=2, frames=45, fps=15.0)
    tracker = make_tracker("ground", world.size, fps=world.fps)
    near = 0
    for k in range(45):
        image, truth = world.rendered(k)
        image, box = faded(image, k) if light == "fade" else in_light(image, light, k), truth.box
        e = tracker.begin(image, 0.0, box) if k == 0 else tracker.handle_frame(image, k / world.fps)
        near += bool(np.hypot(e.x - box.x - 0.5 * box.width, e.y - box.y - 0.5 * box.height) < max(box.width, 12.0))
    assert near >= 42


@pytest.mark.parametrize("low", [0, 20, 170])
def test_contrast_is_never_reduced_and_levels_keep_their_order(low: int) -> None:
    image = np.full((40, 40, 3), low, np.uint8)
    image[:, 20:] = low + 30
    table = Contrast(image, 0.0).table
    assert table is not None
    levels = table.ravel().astype(int)
    assert (np.diff(levels) >= 0).all()
    assert levels[low + 30] - levels[low] >= 100
    assert Contrast(cv2.merge([np.tile(np.arange(256, dtype=np.uint8), (40, 1))] * 3), 0.0).table is None
    assert Contrast(np.zeros((40, 40, 3), np.uint8), 0.0).table is not None  # nothing to see, and no division by zero


def test_a_target_with_contrast_is_not_stretched_with_a_faint_picture() -> None:
    """White cars on asphalt were white all over: two fifths of their pixels had the greatest level."""
    image = np.full((40, 160, 3), 70, np.uint8)
    image[:, ::2] = 120
    image[10:20, 10:14] = 220
    assert Contrast(image, 0.0).table is not None
    assert Contrast(image, 0.0, (9.0, 9.0, 10.0, 12.0)).table is None


@pytest.mark.parametrize("model", ["ground", "plain", "paper"])
def test_a_target_on_a_black_image_is_refused(model: str) -> None:
    black = np.zeros((240, 320, 3), np.uint8)
    with pytest.raises(InputError, match=r"one colour.*--start"):
        make_tracker(model, (320, 240)).begin(black, 0.0, Box(100.0, 100.0, 30.0, 20.0))


@pytest.mark.filterwarnings("error")
def test_a_filter_of_a_black_image_is_finite() -> None:
    learnt, box = CorrelationFilter(40.0, 20.0), OrientedBox.upright(Box(100.0, 100.0, 40.0, 20.0))
    black = np.zeros((240, 320, 3), np.uint8)
    learnt.learn(black, box)
    assert np.isfinite(learnt.respond(black, box).log_ratio)
