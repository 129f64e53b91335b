"""A reticle over the target when it is marked is not followed in its place."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.uav.adaptive_tracker import AdaptiveTracker
from edge.uav.base import Box, TrackState
from edge.uav.image_motion.on_screen_display import OnScreenDisplay
from edge.uav.tracker_factory import make_tracker
from protocols.geometry.types import Image

SIZE, FPS, FRAMES = (480, 270), 15.0, 75
SIDES = (40, 24)


def video(drift: float, reticle: tuple[int, int, int] | None, opacity: float = 1.0) -> tuple[list[Image], list[Box]]:
    """Images of a camera that pans over soft ground, and a car in them that drifts by so much a frame [px]."""
    rng = np.random.default_rng(3)
    soft = cv2.GaussianBlur(rng.uniform(0, 255, (400, 1400, 3)).astype(np.float32), (0, 0), 3.0)
    ground = np.clip(110.0 + (soft - soft.mean()) * 5.0, 0, 255).astype(np.uint8)
    images, boxes = [], []
    for k in range(FRAMES):
        image = ground[60 : 60 + SIZE[1], 6 * k : 6 * k + SIZE[0]].copy()
        x, y = round(220 - drift * k), 120
        cv2.rectangle(image, (x, y), (x + SIDES[0] - 1, y + SIDES[1] - 1), (30, 40, 200), -1)
        cv2.rectangle(image, (x + 8, y + 4), (x + 16, y + SIDES[1] - 5), (20, 20, 20), -1)
        cv2.rectangle(image, (x + 30, y + 2), (x + 34, y + SIDES[1] - 3), (235, 235, 235), -1)
        if reticle is not None:
            drawn = image.copy()
            for colour, width in (((0, 0, 0), 3), (reticle, 1)):
                cv2.line(drawn, (226, 132), (254, 132), colour, width)
                cv2.line(drawn, (240, 118), (240, 146), colour, width)
            image = np.asarray(cv2.addWeighted(drawn, opacity, image, 1.0 - opacity, 0.0), np.uint8)
        images.append(image)
        boxes.append(Box(float(x), float(y), *(float(side) for side in SIDES)))
    return images, boxes


@pytest.mark.parametrize(("colour", "opacity"), [((255, 255, 255), 1.0), ((0, 255, 0), 0.7)])
def test_a_target_is_followed_out_from_beneath_a_reticle(colour: tuple[int, int, int], opacity: float) -> None:
    images, boxes = video(2.0, colour, opacity)
    tracker = make_tracker("ground", SIZE, fps=FPS)
    tracker.begin(images[0], 0.0, boxes[0])
    last = [tracker.handle_frame(image, k / FPS) for k, image in enumerate(images[1:], 1)][-10:]
    assert all(found.state is TrackState.VISIBLE for found in last)
    off = [found.x - (box.x + 0.5 * (box.width - 1.0)) for found, box in zip(last, boxes[-10:], strict=True)]
    assert np.abs(off).max() < 4.0


def test_without_a_reticle_nothing_is_taken_from_the_picture() -> None:
    images, boxes = video(2.0, None)
    display = OnScreenDisplay(images[0], 0.0, boxes[0])
    first = images[0].copy()
    for k, image in enumerate(images[1:], 1):
        display.find(image, k / FPS)
    assert display.images == []
    assert display.without(images[-1]) is images[-1]
    np.testing.assert_array_equal(images[0], first)


@pytest.mark.parametrize("drift", [0.0, 0.5, 2.0])
def test_a_target_without_a_reticle_is_followed_as_before(drift: float) -> None:
    """Also one that the picture follows to the pixel, which does not change."""
    images, boxes = video(drift, None)
    trackers = make_tracker("ground", SIZE, fps=FPS), AdaptiveTracker(SIZE, fps=FPS)
    for tracker in trackers:
        tracker.begin(images[0], 0.0, boxes[0])
    for k, image in enumerate(images[1:], 1):
        found, same = (tracker.handle_frame(image, k / FPS) for tracker in trackers)
        assert (found.state, found.x, found.y) == (same.state, same.x, same.y)
