"""The background from pictures of the first time: people pass, shadows fall, and some stand."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from edge.detectors.moving.bootstrap import Album, comparisons

Image = npt.NDArray[np.uint8]
WIDTH, HEIGHT = 320, 96
PERIOD_S = 0.1
NOISE = 3.0


def room(rng: np.random.Generator) -> Image:
    """Something with texture, (H, W, 3)."""
    coarse = rng.uniform(60.0, 200.0, (12, 40, 3)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).clip(20, 230), dtype=np.uint8)


def noisy(picture: Image, rng: np.random.Generator) -> Image:
    return np.clip(np.rint(picture + rng.normal(0.0, NOISE, picture.shape)), 0, 255).astype(np.uint8)


def with_block(picture: Image, left: int, wide: int, shade: float = 0.0) -> Image:
    """A body with folds in rows 30 to 80, or, with a shade, its shadow."""
    shown = picture.copy()
    part = shown[30:80, max(left, 0) : max(left + wide, 0)]
    folds = np.arange(part.shape[1])[None, :, None] // 4 % 2 * 14
    part[:] = np.rint(shade * part) if shade else folds + (40, 90, 160)
    return shown


def wrong(found: Image, true: Image) -> float:
    """Share of the pixels that differ much."""
    return float((cv2.absdiff(found, true).max(axis=2) > 22).mean())


def test_who_covers_a_place_for_most_of_the_time_is_not_background() -> None:
    """A broad body that passes slowly: in its middle columns it is seen in more than half of the pictures."""
    rng = np.random.default_rng(1)
    true = room(rng)
    pictures = [noisy(with_block(true, 5 * i + 10, 80), rng) for i in range(30)]
    album = Album()
    for picture in pictures:
        album.add(picture, PERIOD_S)
    assert wrong(album.background(), true) < 0.01


def test_where_shadows_mostly_lie_the_lit_floor_is_background() -> None:
    rng = np.random.default_rng(2)
    true = room(rng)
    album = Album()
    for i in range(30):
        dark = with_block(true, 100, 60, 0.6) if i % 5 else true  # 24 of 30
        album.add(noisy(dark, rng), PERIOD_S)
        album.add(noisy(dark, rng), PERIOD_S)
    covered = wrong(album.background(), true)
    assert covered > 0.05  # four of five are too many
    album = Album()
    for i in range(30):
        dark = with_block(true, 100, 60, 0.6) if i // 3 % 2 else true  # half of them
        album.add(noisy(dark, rng), PERIOD_S)
    assert wrong(album.background(), true) < 0.01


@pytest.mark.parametrize("period", [0.1, 0.04, 0.01])
def test_motion_is_looked_for_over_a_tenth_of_a_second_at_any_rate(period: float) -> None:
    rng = np.random.default_rng(3)
    true = room(rng)
    album = Album()
    for i in range(round(3.0 / period)):
        album.add(noisy(with_block(true, round(50.0 * i * period) + 10, 80), rng), period)
    assert len(album) <= 32
    assert wrong(album.background(), true) < 0.01


def test_what_is_painted_is_in_every_picture() -> None:
    rng = np.random.default_rng(4)
    true = room(rng)
    album = Album()
    for _ in range(10):
        album.add(noisy(with_block(true, 100, 60), rng), PERIOD_S)
    assert wrong(album.background(), true) > 0.05
    album.paint(true, np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert wrong(album.background(), true) < 0.001


def test_one_picture_is_its_own_background() -> None:
    rng = np.random.default_rng(5)
    true = room(rng)[:91, :315]  # no whole number of cells
    album = Album()
    album.add(true, PERIOD_S)
    assert np.array_equal(album.background(), true)


@pytest.mark.parametrize("count", range(1, 20))
def test_comparisons_sort(count: int) -> None:
    values = np.random.default_rng(count).integers(0, 9, count).tolist()
    expected = sorted(values)
    for low, high in comparisons(count):
        values[low], values[high] = min(values[low], values[high]), max(values[low], values[high])
    assert values == expected
