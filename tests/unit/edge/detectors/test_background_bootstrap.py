"""Bootstrap of the background from the first images: people pass, shadows fall, and some people stand still."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.detectors.moving.bootstrap import BackgroundBootstrap, sorting_network
from protocols.geometry.types import Image

WIDTH, HEIGHT = 320, 96
PERIOD_S = 0.1
NOISE = 3.0


def room(rng: np.random.Generator) -> Image:
    """A textured background (H, W, 3)."""
    coarse = rng.uniform(60.0, 200.0, (12, 40, 3)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).clip(20, 230), dtype=np.uint8)


def noisy(image: Image, rng: np.random.Generator) -> Image:
    return np.clip(np.rint(image + rng.normal(0.0, NOISE, image.shape)), 0, 255).astype(np.uint8)


def with_block(image: Image, left: int, wide: int, shade: float = 0.0) -> Image:
    """A body with folds in rows 30 to 80, or, with a shade, its shadow."""
    image = image.copy()
    part = image[30:80, max(left, 0) : max(left + wide, 0)]
    folds = np.arange(part.shape[1])[None, :, None] // 4 % 2 * 14
    part[:] = np.rint(shade * part) if shade else folds + (40, 90, 160)
    return image


def wrong_share(found: Image, true: Image) -> float:
    """Share of pixels that differ by more than noise."""
    return float((cv2.absdiff(found, true).max(axis=2) > 22).mean())


def test_a_person_who_covers_a_place_most_of_the_time_is_not_background() -> None:
    """A broad body that passes slowly: its middle columns are covered in more than half of the images."""
    rng = np.random.default_rng(1)
    true = room(rng)
    images = [noisy(with_block(true, 5 * i + 10, 80), rng) for i in range(30)]
    bootstrap = BackgroundBootstrap()
    for image in images:
        bootstrap.add(image, PERIOD_S)
    assert wrong_share(bootstrap.background(), true) < 0.01


def test_the_lit_floor_is_background_where_there_is_shadow_half_of_the_time() -> None:
    rng = np.random.default_rng(2)
    true = room(rng)
    bootstrap = BackgroundBootstrap()
    for i in range(30):
        dark = with_block(true, 100, 60, 0.6) if i % 5 else true  # 24 of 30
        bootstrap.add(noisy(dark, rng), PERIOD_S)
        bootstrap.add(noisy(dark, rng), PERIOD_S)
    covered = wrong_share(bootstrap.background(), true)
    assert covered > 0.05  # four of five are too many
    bootstrap = BackgroundBootstrap()
    for i in range(30):
        dark = with_block(true, 100, 60, 0.6) if i // 3 % 2 else true  # half of them
        bootstrap.add(noisy(dark, rng), PERIOD_S)
    assert wrong_share(bootstrap.background(), true) < 0.01


@pytest.mark.parametrize("period", [0.1, 0.04, 0.01])
def test_motion_is_measured_over_a_tenth_of_a_second_at_any_frame_rate(period: float) -> None:
    rng = np.random.default_rng(3)
    true = room(rng)
    bootstrap = BackgroundBootstrap()
    for i in range(round(3.0 / period)):
        bootstrap.add(noisy(with_block(true, round(50.0 * i * period) + 10, 80), rng), period)
    assert len(bootstrap) <= 32
    assert wrong_share(bootstrap.background(), true) < 0.01


def test_overwritten_pixels_are_in_every_image() -> None:
    rng = np.random.default_rng(4)
    true = room(rng)
    bootstrap = BackgroundBootstrap()
    for _ in range(10):
        bootstrap.add(noisy(with_block(true, 100, 60), rng), PERIOD_S)
    assert wrong_share(bootstrap.background(), true) > 0.05
    bootstrap.overwrite(true, np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert wrong_share(bootstrap.background(), true) < 0.001


def test_a_single_image_is_its_own_background() -> None:
    rng = np.random.default_rng(5)
    true = room(rng)[:91, :315]  # no whole number of cells
    bootstrap = BackgroundBootstrap()
    bootstrap.add(true, PERIOD_S)
    assert np.array_equal(bootstrap.background(), true)


@pytest.mark.parametrize("count", range(1, 20))
def test_the_sorting_network_sorts(count: int) -> None:
    values = np.random.default_rng(count).integers(0, 9, count).tolist()
    expected = sorted(values)
    for low, high in sorting_network(count):
        values[low], values[high] = min(values[low], values[high]), max(values[low], values[high])
    assert values == expected
