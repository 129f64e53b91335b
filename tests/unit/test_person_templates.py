"""Sums that are kept, skipped or batched for speed are those that plain arithmetic gives."""

from __future__ import annotations

import numpy as np
import pytest

from edge.detectors.people import occupancy
from edge.detectors.people.height_model import Stature
from edge.detectors.people.person import silhouette_features
from edge.detectors.people.segmentation import explain
from edge.detectors.people.silhouettes import Image, LonePeople, _alone
from edge.detectors.people.templates import BARS, Scene, Template
from protocols.geometry.types import Floats

WIDTH, HEIGHT = 320, 240


def place() -> Stature:
    stature = Stature(WIDTH, HEIGHT)
    for index in range(60):
        stature.learn(20.0 + 4 * index, 100.0 + index, 60.0)
    return stature


def scene_of(rng: np.random.Generator) -> Scene:
    """A part of 90x110 px at the left border of the picture, of which a body stands before an empty wall."""
    filled = np.zeros((110, 90), np.float32)
    filled[20:95, 25:55] = rng.random((75, 30)) > 0.15
    weight = (filled - 0.45 * (1.0 - filled)).astype(np.float32)
    scene = Scene(weight, filled, (0, 60), (1.0, 1.0), place())
    scene.dress(rng.integers(0, 255, (110, 90, 3), dtype=np.uint8), {0: np.array([120.0, 130.0, 140.0])})
    return scene


def plain_gain(scene: Scene, one: Template, free: Floats) -> float:
    """By the definition: bars, less what goes on above and below; ``free``: weight that nobody covers."""

    def held(half: float, high: float, low: float, base: float) -> float:
        total = 0.0
        for row in range(round(base + high * one.tall), round(base + low * one.tall)):
            for column in range(round(one.u - half * one.tall), round(one.u + half * one.tall)):
                inside = 0 <= row < free.shape[0] and 0 <= column < free.shape[1]
                # Beyond the part is empty wall, beyond the picture nothing.
                seen = 0 <= column + scene.origin[0] < WIDTH and 0 <= row + scene.origin[1] < HEIGHT
                total += free[row, column] if inside else -0.45 if seen else 0.0
        return total

    bars = [held(*bar, one.top) for bar in BARS]
    beyond = max(held(0.07, -0.1, -0.02, one.top), 0.0) + max(held(0.1, 0.02, 0.12, one.foot), 0.0)
    return 2.5 * bars[0] + bars[1] + bars[2] - beyond


def test_gains_are_those_of_the_definition_also_beyond_the_part_and_the_picture() -> None:
    scene = scene_of(np.random.default_rng(0))
    tried = [
        Template(40.0, 96.0, 70.0),
        Template(3.3, 99.2, 61.0),
        Template(86.0, 60.7, 80.0),
        Template(50.4, 178.0, 66.0),
    ]
    for one in tried:
        places = scene.places(np.array([one.u]), np.array([one.foot]), np.array([one.tall]))
        assert scene.gains(places)[0] == pytest.approx(
            plain_gain(scene, one, scene.weight.astype(np.float64)), rel=1e-5, abs=1e-3
        )


def test_what_each_explains_alone_is_what_it_explains_when_it_is_taken_away() -> None:
    scene = scene_of(np.random.default_rng(1))
    placed = [Template(35.0, 95.0, 72.0, expected=0), Template(46.0, 97.0, 76.0), Template(30.0, 92.0, 60.0)]
    for one in placed:
        scene.cover(one)
    own = scene.own_gains(placed)
    for one, gain in zip(placed, own, strict=True):
        scene.uncover(one)
        places = scene.places(np.array([one.u]), np.array([one.foot]), np.array([one.tall]))
        assert gain == pytest.approx(scene.gains(places, one.expected)[0], abs=1e-3)
        scene.cover(one)
    for one in placed:
        scene.uncover(one)
    np.testing.assert_array_equal(scene.unexplained(), np.maximum(scene.weight, 0.0))


def test_the_best_new_one_is_the_best_of_all_places(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(np.random.default_rng(2))
    first = Template(30.0, 95.0, 72.0)
    for covered in (False, True):
        if covered:
            scene.cover(first)
        grid = occupancy._Grid(scene)
        found = grid.best_new()
        with monkeypatch.context() as patch:
            patch.setattr(occupancy, "_LEAST", -np.inf)  # nothing is left out
            best = grid.best_new()
        assert found is not None
        assert found == best


def test_who_stood_still_is_sought_again_once_a_neighbour_has_moved() -> None:
    scene = scene_of(np.random.default_rng(3))
    one = Template(40.0, 95.0, 74.0)
    for _ in range(20):
        occupancy._settle(scene, one)
        if one.still is not None:
            break
    assert one.still is not None
    rests = one.u, one.foot
    occupancy._settle(scene, one)
    assert (one.u, one.foot) == rests
    other = Template(one.u + 4.0, one.foot, one.tall)
    scene.cover(other)
    occupancy._settle(scene, one)
    assert (one.u, one.foot) != rests


def test_who_stands_in_a_frame_or_beside_specks_is_still_alone() -> None:
    figure = np.zeros((HEIGHT, WIDTH), np.uint8)
    for half, high, low in BARS:
        figure[100 + round(60 * high) : 100 + round(60 * low), 160 - round(60 * half) : 160 + round(60 * half)] = 255
    alone = LonePeople(figure).find()
    assert alone == [(160.0, 160.0, 60.0)]
    figure[90:91, 100:220] = figure[170:171, 100:220] = figure[90:171, 100] = figure[90:171, 219] = 255
    figure[102, 153] = 255  # in his box, not of him
    assert alone[0] in LonePeople(figure).find()
    assert LonePeople(np.zeros_like(figure)).find() == []


def test_another_silhouette_in_the_box_of_one_is_not_of_it() -> None:
    part = np.zeros((9, 7), np.uint8)
    part[:, 0] = part[8] = 255
    corner = part.copy()
    corner[:5, 4:] = 255
    np.testing.assert_array_equal(_alone(corner), part > 0)


def test_head_and_foot_are_the_middles_of_the_upper_and_lower_part() -> None:
    figure = np.zeros((HEIGHT, WIDTH), np.uint8)
    figure[100:112, 150:158] = 255
    figure[112:160, 145:165] = 255
    figure[140:160, 150:170] = 255
    found = silhouette_features(figure, (145.0, 100.0, 25.0, 60.0))
    rows, columns = np.nonzero(figure)
    assert found.head == pytest.approx((columns[rows <= 106].mean(), 99.5))
    assert found.foot == pytest.approx((columns[rows >= 142].mean(), 159.5))


def test_nobody_in_an_empty_picture() -> None:
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    assert explain(nothing, nothing, place(), [(100.0, 50.0, 20.0, 60.0)], statures=[1.0]) == []


def drawn(*bodies: tuple[int, float]) -> Image:
    """Silhouettes 60 px tall of people at the middles u whose feet are at 160, so many times as broad as templates."""
    figure = np.zeros((HEIGHT, WIDTH), np.uint8)
    for u, broad in bodies:
        for half, high, low in BARS:
            wide = round(60 * broad * half)
            figure[100 + round(60 * high) : 100 + round(60 * low), u - wide : u + wide] = 255
    return figure


@pytest.mark.parametrize("expected", [[], [(152.0, 100.0, 16.0, 60.0)], [(130.0, 100.0, 20.0, 60.0)] * 2])
def test_tape_that_sways_and_specks_of_a_shadow_make_nobody_broader(expected: list[tuple[float, ...]]) -> None:
    figure = drawn((160, 1.0))
    figure[118:120, 145:177] = 255
    figure[156:160, 172:176] = figure[150:153, 145:149] = 255
    found = explain(figure, np.zeros_like(figure), place(), expected, statures=[1.0] * len(expected))  # type: ignore[arg-type]
    assert [one.box for one in found] == [pytest.approx((152.0, 100.0, 16.0, 60.0), abs=1.5)]


def test_two_broad_ones_side_by_side_are_two_though_a_third_was_expected_between() -> None:
    figure = drawn((149, 1.4), (171, 1.4))
    boxes = [(u - 8.0, 100.0, 16.0, 60.0) for u in (146.0, 160.0, 174.0)]
    found = explain(figure, np.zeros_like(figure), place(), boxes, statures=[1.0] * 3)
    middles = sorted(one.box[0] + 0.5 * one.box[2] for one in found)
    assert middles == pytest.approx([149.0, 171.0], abs=2.5)
