"""Static background behind a marker: learnt from images, used where it still holds."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from edge.detectors.marker.ball import MarkerDetector
from edge.detectors.marker.static_background import StaticBackground, is_known
from protocols.geometry.types import Bools, Floats

_SIZE = (96, 128)
_BALL = np.array((22.0, 112.0, 246.0))
_RADIUS = 9.0


def wall(shift: int = 0) -> Floats:
    """A light wall with a dark picture frame whose rim is 3 px broad."""
    image = np.full((*_SIZE, 3), (176.0, 182.0, 184.0))
    image[48:, 40 + shift :] = (60.0, 60.0, 62.0)
    image[51:, 43 + shift :] = (150.0, 120.0, 60.0)
    return image


def with_ball(image: Floats, centre: tuple[float, float], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """The image with an orange ball, lit from above, its rim anti-aliased, and noise of 3 steps."""
    y, x = np.mgrid[: _SIZE[0] * 8, : _SIZE[1] * 8] / 8.0 - 7.0 / 16.0
    cover = (np.hypot(x - centre[0], y - centre[1]) < _RADIUS).reshape(_SIZE[0], 8, _SIZE[1], 8).mean(axis=(1, 3))
    rows = np.mgrid[: _SIZE[0], : _SIZE[1]][0]
    lit = _BALL * np.clip(0.85 - 0.25 * (rows - centre[1]) / _RADIUS, 0.5, 1.1)[..., None]
    drawn = image * (1.0 - cover[..., None]) + cover[..., None] * lit
    return empty(drawn, rng)


def empty(image: Floats, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(image + rng.normal(0.0, 3.0, image.shape)), 0, 255), dtype=np.uint8)


def error(detector: MarkerDetector, image: npt.NDArray[np.uint8], centre: tuple[float, float]) -> float:
    (found,) = detector.detect(image)
    return float(np.hypot(found.u - centre[0], found.v - centre[1]))


def test_an_edge_behind_the_rim_biases_the_centre_less_once_the_background_is_known() -> None:
    rng = np.random.default_rng(1)
    with_background, scene = MarkerDetector(), wall()
    for _ in range(150):
        with_background.detect(empty(scene, rng))
    places = [(58.3 + 0.4 * step, 55.1 + 0.3 * step) for step in range(12)]
    images = [with_ball(scene, place, rng) for place in places]
    known = [error(with_background, image, place) for image, place in zip(images, places, strict=True)]
    plain = [error(MarkerDetector(), image, place) for image, place in zip(images, places, strict=True)]
    assert np.mean(known) < 0.6 * np.mean(plain)
    assert max(known) < 0.25


def test_a_background_from_before_the_camera_was_turned_is_not_used() -> None:
    rng = np.random.default_rng(2)
    with_old_background = MarkerDetector()
    for _ in range(150):
        with_old_background.detect(empty(wall(), rng))
    turned = np.full((*_SIZE, 3), (70.0, 120.0, 90.0))
    image = with_ball(turned, (60.4, 47.7), rng)
    assert error(with_old_background, image, (60.4, 47.7)) == error(MarkerDetector(), image, (60.4, 47.7))


def test_a_static_ball_is_not_learnt_as_background() -> None:
    rng = np.random.default_rng(3)
    detector = MarkerDetector()
    images = [with_ball(wall(), (60.4, 47.7), rng) for _ in range(200)]
    for image in images:
        (found,) = detector.detect(image)
        assert np.hypot(found.u - 60.4, found.v - 47.7) < 0.25


def free(image: npt.NDArray[np.uint8], background: StaticBackground) -> Bools:
    first, end = background.next_rows(image)
    return np.ones((end - first, image.shape[1]), np.bool_)


def test_the_background_follows_the_median_and_ignores_passing_people() -> None:
    rng = np.random.default_rng(4)
    background, scene = StaticBackground(), wall()
    assert background.lookup(empty(scene, rng)) is None
    for frame in range(1200):
        image = empty(scene, rng)
        if 600 <= frame < 720:
            image[20:60, 30:70] = 20  # a person stands there for a tenth of the time
        background.update(image, free(image, background))
    known = background.lookup(image)
    assert known is not None
    assert is_known(known[1]).all()
    assert np.abs(known[0] - scene).mean() < 1.5
    assert np.abs(known[0].astype(float) - scene).max() < 10.0


def test_masked_pixels_are_not_learnt_and_another_size_resets_the_background() -> None:
    background, image = StaticBackground(), np.full((*_SIZE, 3), 200, np.uint8)
    for _ in range(100):
        background.update(image, ~free(image, background))
    known = background.lookup(image)
    assert known is not None
    assert not is_known(known[1]).any()
    assert background.lookup(image[:50]) is None
    background.update(image[:50], free(image[:50], background))
    assert background.image.shape == (50, 128, 3)
