"""Motion of what stands outside the image: that of a camera which turns."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.uav.base import Box
from edge.uav.correlation.appearance_tracker import AppearanceTracker
from edge.uav.image_motion.scene_motion import Motion, SceneMotion
from protocols.geometry.types import Floats, Image

SIZE = (400, 226)
CENTRE = 0.5 * (np.array(SIZE) - 1.0)
RATE_DEG, FPS = 90.0, 30.0


def turns(most_deg: float, tilt_deg: float) -> list[Floats]:
    """Rotations of a camera that pans and tilts to the side and back."""
    steps = np.linspace(0.0, 1.0, round(most_deg / RATE_DEG * FPS) + 1)
    shares = np.concatenate([steps, steps[-2::-1]])
    return [Rotation.from_euler("yx", [most_deg * s, tilt_deg * s], degrees=True).as_matrix() for s in shares]


def pixel(ray: Floats, rotation: Floats, focal: float) -> Floats:
    """Of a direction (3,), also outside the image."""
    x, y, z = ray @ rotation
    return np.asarray(np.array([x, y]) / z * focal + CENTRE)


def beyond(place: Floats) -> float:
    """Distance of a place (2,) from the image [px]."""
    return float(np.hypot(*(place - np.clip(place, 0.0, 2.0 * CENTRE))))


def measured(scene: SceneMotion, before: Floats, after: Floats, focal: float, rng: np.random.Generator) -> Motion:
    """The motion fitted to a hundred corners at infinity that both images show, with noise."""
    places = rng.uniform(-60.0, np.array(SIZE) + 60.0, (4000, 2))
    rays = np.column_stack([(places - CENTRE) / focal, np.ones(len(places))]) @ before.T @ after
    moved = rays[:, :2] / rays[:, 2:] * focal + CENTRE
    seen = (np.abs(places - CENTRE) < CENTRE).all(axis=1) & (np.abs(moved - CENTRE) < CENTRE).all(axis=1)
    noisy = moved[seen][:100] + rng.normal(0.0, 0.3, (100, 2))
    return scene._fit(places[seen][:100], noisy)


@pytest.mark.parametrize("widths", [0.8, 1.0, 2.0])
@pytest.mark.parametrize(("most_deg", "tilt_deg"), [(30.0, 20.0), (50.0, 0.0), (110.0, 20.0)])
def test_a_place_that_a_pan_leaves_behind_moves_as_the_camera_turns(
    widths: float, most_deg: float, tilt_deg: float
) -> None:
    """A similarity has it off by up to its distance from the image; past 90, it must stay finite and come back."""
    focal, rng, scene = widths * SIZE[0], np.random.default_rng(1), SceneMotion(SIZE)
    rotations, ray = turns(most_deg, tilt_deg), np.array([-0.35 / widths, 0.1, 1.0])
    place = pixel(ray, rotations[0], focal)
    for k, (before, after) in enumerate(pairwise(rotations), start=1):
        place = measured(scene, before, after, focal, rng).at(place, scene.reach)
        if k == len(rotations) // 2 and most_deg < 90.0:
            true = pixel(ray, after, focal)
            assert beyond(true) > 100.0
            assert np.hypot(*(place - true)) < 0.1 * beyond(true)
    assert np.isfinite(place).all()
    assert np.hypot(*(place - pixel(ray, rotations[-1], focal))) < 0.3 * SIZE[0]


def test_a_camera_that_shifts_bends_nothing() -> None:
    rng, scene = np.random.default_rng(2), SceneMotion(SIZE)
    old = rng.uniform(0.0, SIZE, (100, 2))
    found = scene._fit(old, old + [12.0, 3.0] + rng.normal(0.0, 0.3, old.shape))
    far = np.array([-300.0, 80.0])
    assert found.at(far, scene.reach) == pytest.approx(far + [12.0, 3.0], abs=1.5)


def texture() -> Image:
    noise = np.random.default_rng(3).integers(0, 255, (60, 300, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(noise, (3000, 600), interpolation=cv2.INTER_CUBIC), np.uint8)


def test_a_target_that_a_pan_leaves_behind_is_expected_where_it_is() -> None:
    """The camera turns by 30 degrees past a far wall, within a second, and stays."""
    wall, focal, target = texture(), float(SIZE[0]), np.array([-60.0, 10.0])
    tracker = AppearanceTracker(SIZE, FPS)
    for k in range(60):
        turn = Rotation.from_euler("y", 30.0 * min(k / FPS, 1.0), degrees=True).as_matrix()
        camera = np.array([[focal, 0.0, CENTRE[0]], [0.0, focal, CENTRE[1]], [0.0, 0.0, 1.0]])
        wall_ray = np.array([[1.0, 0.0, -1000.0], [0.0, 1.0, -300.0], [0.0, 0.0, focal]])
        image = np.asarray(cv2.warpPerspective(wall, camera @ turn.T @ wall_ray, SIZE), np.uint8)
        place = pixel(np.append(target / focal, 1.0), turn, focal)
        x, y = (int(v) for v in np.round(place) - [20, 12])
        cv2.rectangle(image, (x, y), (x + 39, y + 23), (40, 40, 220), -1)
        if k == 0:
            tracker.begin(image, 0.0, Box(x, y, 40.0, 24.0))
        else:
            tracker.handle_frame(image, k / FPS)
    assert not tracker.sees
    assert beyond(place) > 100.0
    assert np.hypot(*(tracker.box.centre - place)) < 20.0
