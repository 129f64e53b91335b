"""Black bars beside the picture are no part of the view."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.uav.base import Box, Estimate, Telemetry
from edge.uav.image_motion.black_bars import picture_area
from edge.uav.tracker_factory import make_tracker
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image
from tests.support.oblique.world import ObliqueWorld

BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
NED_FROM_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRAMES, FPS = 24, 10.0


def barred(image: Image, x: int, y: int) -> Image:
    return np.asarray(cv2.copyMakeBorder(image, y, y, x, x, cv2.BORDER_CONSTANT), np.uint8)


def follow(x: int, y: int) -> list[Estimate]:
    """A flight that leaves its target behind, between bars x and y px wide, with lens and telemetry."""
    world = ObliqueWorld("car", "away", seed=3, size=(480, 270), fps=FPS, frames=60, away_s=1.0)
    size = (world.size[0] + 2 * x, world.size[1] + 2 * y)
    focal = world.truth(0).focal
    matrix = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    tracker = make_tracker("ground", size, Intrinsics(*size, matrix), BODY_FROM_CAMERA, FPS)
    out = []
    for k, i in enumerate(range(15, 15 + FRAMES)):
        image, truth = world.rendered(i)
        attitude = NED_FROM_WORLD @ truth.rotation.T @ BODY_FROM_CAMERA.T
        tracker.handle_telemetry(Telemetry(k / FPS, attitude, NED_FROM_WORLD @ truth.centre))
        box = type(truth.box)(truth.box.x + x, truth.box.y + y, truth.box.width, truth.box.height)
        image = barred(image, x, y)
        out.append(tracker.begin(image, 0.0, box) if k == 0 else tracker.handle_frame(image, k / FPS))
    return out


def test_bars_beside_the_picture_change_nothing() -> None:
    """Behind a bar the target was in the image but not to be seen, so that something else was taken for it."""
    plain = follow(0, 0)
    assert {e.state.value for e in plain} == {"visible", "coasting"}
    for x, y in ((0, 40), (56, 0)):
        for bars, e in zip(follow(x, y), plain, strict=True):
            assert (bars.state, bars.basis, bars.std) == (e.state, e.basis, pytest.approx(e.std))
            assert (bars.x - x, bars.y - y) == pytest.approx((e.x, e.y))
            assert (bars.north, bars.east) == pytest.approx((e.north, e.east), nan_ok=True)
            for own, other in zip(bars.hypotheses, e.hypotheses, strict=True):
                assert (own.x - x, own.y - y) == pytest.approx((other.x, other.y))
            if e.particles is not None and bars.particles is not None:
                assert bars.particles - [x, y] == pytest.approx(e.particles, nan_ok=True)


def test_another_begin_is_of_its_own_image() -> None:
    """Begun anew on an image without bars, all its images were of another size than the first one's picture."""
    picture = np.random.default_rng(1).integers(40, 200, (240, 320, 3)).astype(np.uint8)
    tracker = make_tracker("ground", (320, 300), fps=FPS)
    for image in (barred(picture, 0, 30), cv2.resize(picture, (320, 300))):
        assert tracker.begin(np.asarray(image, np.uint8), 0.0, Box(140, 130, 40, 30)).state.value == "visible"


def test_what_is_shown_and_where_the_target_may_be_are_of_the_image() -> None:
    """A car that drives out of the picture along a street seen from above: particles, corners, paths and the road."""
    rng = np.random.default_rng(7)
    ground = cv2.GaussianBlur(rng.uniform(-1, 1, (240, 900, 3)).astype(np.float32), (0, 0), 2.0)
    ground = np.clip(np.array([60.0, 120.0, 80.0]) + 160.0 * ground, 0, 255).astype(np.uint8)
    ground[90:150] = ground[90:150] // 3 + 60

    def drive(y: int) -> tuple[Estimate, Floats]:
        tracker = make_tracker("ground", (320, 240 + 2 * y), fps=FPS)
        for i in range(44):
            image, left = ground.copy(), 40 + i
            cv2.rectangle(image, (100 + 8 * i, 112), (136 + 8 * i, 128), (40, 40, 210), -1)
            image = barred(image[:, left : left + 320], 0, y)
            box = Box(60.0, 112.0 + y, 37.0, 17.0)
            found = tracker.begin(image, 0.0, box) if i == 0 else tracker.handle_frame(image, i / 15.0)
        return found, tracker.road_outline()[0]  # type: ignore[attr-defined]

    (plain, road), (bars, barred_road) = drive(0), drive(30)
    assert plain.basis.value == bars.basis.value == "plane"
    assert plain.particles is not None
    assert bars.particles is not None
    assert len(plain.layers) >= 3
    assert len(road)
    np.testing.assert_allclose(bars.particles - [0, 30], plain.particles)
    for name, points in plain.layers.items():
        np.testing.assert_allclose(bars.layers[name] - [0, 30], points)
    np.testing.assert_allclose(barred_road - [0, 30], road)


def test_dark_parts_of_a_picture_are_no_bars() -> None:
    picture = np.random.default_rng(1).integers(40, 200, (240, 320, 3)).astype(np.uint8)
    assert picture_area(picture) == (0, 0, 320, 240)
    letterbox = barred(picture, 0, 30)
    assert picture_area(letterbox) == (0, 30, 320, 240)
    cv2.putText(letterbox, "ALT 47 m", (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
    assert picture_area(letterbox) == (0, 30, 320, 240)
    night = picture.copy()
    night[:90] = 3  # the sky
    assert picture_area(night) == (0, 0, 320, 240)
    assert picture_area(np.zeros_like(night)) == (0, 0, 320, 240)


def test_a_hot_target_and_dark_ends_of_the_ground_are_no_picture_between_bars() -> None:
    """A hot target in the middle of cold ground was cut out of it; so was the ground between two dark ends."""
    rng = np.random.default_rng(2)
    cold = rng.normal(12, 3, (240, 320, 3)).clip(0, 30).astype(np.uint8)
    hot = cv2.ellipse(cold.copy(), (160, 120), (14, 30), 0, 0, 360, (230, 230, 230), -1)
    assert picture_area(hot) == (0, 0, 320, 240)
    flat = cv2.ellipse(np.zeros_like(cold), (160, 120), (14, 30), 0, 0, 360, (230, 230, 230), -1)
    assert picture_area(flat) == (0, 0, 320, 240)
    road = cold.copy()
    road[60:180] = rng.integers(40, 200, (120, 320, 3))
    assert picture_area(road) == (0, 0, 320, 240)
    upright = barred(road[60:180, :68], 74, 0)
    assert picture_area(upright) == (74, 0, 68, 120)


def test_what_is_marked_is_in_the_picture() -> None:
    """A target in a dark end was refused with numbers that nobody gave; so was one that fills half of what is lit."""
    image = barred(np.random.default_rng(1).integers(40, 200, (120, 320, 3)).astype(np.uint8), 0, 60)
    cv2.rectangle(image, (30, 20), (60, 40), (28, 28, 28), -1)
    for box in (Box(30.0, 20.0, 30.0, 20.0), Box(0.0, 50.0, 250.0, 100.0)):
        e = make_tracker("ground", (320, 240)).begin(image, 0.0, box)
        assert (e.x, e.y) == pytest.approx((box.x + 0.5 * box.width, box.y + 0.5 * box.height), abs=1.0)
