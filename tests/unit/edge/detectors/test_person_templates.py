"""Fast evaluation (cached, pruned or batched sums) equals the definition."""

from __future__ import annotations

import numpy as np
import pytest

from edge.detectors.people import occupancy
from edge.detectors.people.height_model import HeightModel
from edge.detectors.people.person import silhouette_features
from edge.detectors.people.segmentation import segment_people
from edge.detectors.people.silhouettes import IsolatedPeople, _touching_all_sides
from edge.detectors.people.templates import BARS, SilhouetteRegion, Template
from protocols.geometry.types import Floats, Image

WIDTH, HEIGHT = 320, 240


def flat_ground() -> HeightModel:
    height_model = HeightModel(WIDTH, HEIGHT)
    for index in range(60):
        height_model.add(20.0 + 4 * index, 100.0 + index, 60.0)
    return height_model


def region_of(rng: np.random.Generator) -> SilhouetteRegion:
    """A region of 90x110 px at the left border of the image, with a body before an empty wall."""
    filled = np.zeros((110, 90), np.float32)
    filled[20:95, 25:55] = rng.random((75, 30)) > 0.15
    weight = (filled - 0.45 * (1.0 - filled)).astype(np.float32)
    region = SilhouetteRegion(weight, filled, (0, 60), (1.0, 1.0), flat_ground())
    region.set_clothing(rng.integers(0, 255, (110, 90, 3), dtype=np.uint8), {0: np.array([120.0, 130.0, 140.0])})
    return region


def plain_gain(region: SilhouetteRegion, one: Template, free: Floats) -> float:
    """Gain by the definition: bars, less the overshoot above and below; ``free``: uncovered weight."""

    def held(half: float, high: float, low: float, base: float) -> float:
        total = 0.0
        for row in range(round(base + high * one.height), round(base + low * one.height)):
            for column in range(round(one.u - half * one.height), round(one.u + half * one.height)):
                inside = 0 <= row < free.shape[0] and 0 <= column < free.shape[1]
                # Beyond the region is empty wall, beyond the image nothing is known.
                seen = 0 <= column + region.origin[0] < WIDTH and 0 <= row + region.origin[1] < HEIGHT
                total += free[row, column] if inside else -0.45 if seen else 0.0
        return total

    bars = [held(*bar, one.top) for bar in BARS]
    beyond = max(held(0.07, -0.1, -0.02, one.top), 0.0) + max(held(0.1, 0.02, 0.12, one.foot), 0.0)
    return 2.5 * bars[0] + bars[1] + bars[2] - beyond


def test_gains_equal_the_definition_also_beyond_the_region_and_the_image() -> None:
    region = region_of(np.random.default_rng(0))
    tried = [
        Template(40.0, 96.0, 70.0),
        Template(3.3, 99.2, 61.0),
        Template(86.0, 60.7, 80.0),
        Template(50.4, 178.0, 66.0),
    ]
    for one in tried:
        placements = region.placements(np.array([one.u]), np.array([one.foot]), np.array([one.height]))
        assert region.gains(placements)[0] == pytest.approx(
            plain_gain(region, one, region.weight.astype(np.float64)), rel=1e-5, abs=1e-3
        )


def test_marginal_gains_equal_the_gains_after_removing_the_template() -> None:
    region = region_of(np.random.default_rng(1))
    placed = [Template(35.0, 95.0, 72.0, expected=0), Template(46.0, 97.0, 76.0), Template(30.0, 92.0, 60.0)]
    for one in placed:
        region.cover(one)
    own = region.marginal_gains(placed)
    for one, gain in zip(placed, own, strict=True):
        region.uncover(one)
        placements = region.placements(np.array([one.u]), np.array([one.foot]), np.array([one.height]))
        assert gain == pytest.approx(region.gains(placements, one.expected)[0], abs=1e-3)
        region.cover(one)
    for one in placed:
        region.uncover(one)
    np.testing.assert_array_equal(region.unexplained(), np.maximum(region.weight, 0.0))


def test_pruning_does_not_change_the_best_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    region = region_of(np.random.default_rng(2))
    first = Template(30.0, 95.0, 72.0)
    for covered in (False, True):
        if covered:
            region.cover(first)
        grid = occupancy._CandidateGrid(region)
        found = grid.best_candidate()
        with monkeypatch.context() as patch:
            patch.setattr(occupancy, "_MIN_NEW_BOUND", -np.inf)  # no candidate is pruned
            best = grid.best_candidate()
        assert found is not None
        assert found == best


def test_an_unmoved_template_is_refined_again_once_a_neighbour_has_moved() -> None:
    region = region_of(np.random.default_rng(3))
    one = Template(40.0, 95.0, 74.0)
    for _ in range(20):
        occupancy._refine(region, one)
        if one.unmoved_state is not None:
            break
    assert one.unmoved_state is not None
    rests = one.u, one.foot
    occupancy._refine(region, one)
    assert (one.u, one.foot) == rests
    other = Template(one.u + 4.0, one.foot, one.height)
    region.cover(other)
    occupancy._refine(region, one)
    assert (one.u, one.foot) != rests


def test_a_person_inside_a_frame_or_beside_specks_is_isolated() -> None:
    foreground = np.zeros((HEIGHT, WIDTH), np.uint8)
    for half, high, low in BARS:
        foreground[100 + round(60 * high) : 100 + round(60 * low), 160 - round(60 * half) : 160 + round(60 * half)] = (
            255
        )
    isolated = IsolatedPeople(foreground).find()
    assert isolated == [(160.0, 160.0, 60.0)]
    foreground[90:91, 100:220] = foreground[170:171, 100:220] = foreground[90:171, 100] = foreground[90:171, 219] = 255
    foreground[102, 153] = 255  # in the person's box, not part of the silhouette
    assert isolated[0] in IsolatedPeople(foreground).find()
    assert IsolatedPeople(np.zeros_like(foreground)).find() == []


def test_another_silhouette_in_the_same_box_is_excluded() -> None:
    part = np.zeros((9, 7), np.uint8)
    part[:, 0] = part[8] = 255
    corner = part.copy()
    corner[:5, 4:] = 255
    np.testing.assert_array_equal(_touching_all_sides(corner), part > 0)


def test_head_and_foot_are_the_mean_columns_of_the_upper_and_lower_part() -> None:
    foreground = np.zeros((HEIGHT, WIDTH), np.uint8)
    foreground[100:112, 150:158] = 255
    foreground[112:160, 145:165] = 255
    foreground[140:160, 150:170] = 255
    found = silhouette_features(foreground, (145.0, 100.0, 25.0, 60.0))
    rows, columns = np.nonzero(foreground)
    assert found.head == pytest.approx((columns[rows <= 106].mean(), 99.5))
    assert found.foot == pytest.approx((columns[rows >= 142].mean(), 159.5))


def test_an_empty_mask_contains_no_person() -> None:
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    assert segment_people(nothing, nothing, flat_ground(), [(100.0, 50.0, 20.0, 60.0)], relative_heights=[1.0]) == []


def drawn(*bodies: tuple[int, float]) -> Image:
    """Silhouettes 60 px tall of people centred at columns u with feet at row 160, ``broad`` times as broad as
    templates.
    """
    foreground = np.zeros((HEIGHT, WIDTH), np.uint8)
    for u, broad in bodies:
        for half, high, low in BARS:
            wide = round(60 * broad * half)
            foreground[100 + round(60 * high) : 100 + round(60 * low), u - wide : u + wide] = 255
    return foreground


@pytest.mark.parametrize("expected", [[], [(152.0, 100.0, 16.0, 60.0)], [(130.0, 100.0, 20.0, 60.0)] * 2])
def test_thin_structures_and_specks_do_not_widen_a_persons_box(expected: list[tuple[float, ...]]) -> None:
    foreground = drawn((160, 1.0))
    foreground[118:120, 145:177] = 255
    foreground[156:160, 172:176] = foreground[150:153, 145:149] = 255
    found = segment_people(
        foreground, np.zeros_like(foreground), flat_ground(), expected, relative_heights=[1.0] * len(expected)
    )  # type: ignore[arg-type]
    assert [one.box for one in found] == [pytest.approx((152.0, 100.0, 16.0, 60.0), abs=1.5)]


def test_two_broad_people_are_two_although_a_third_was_predicted_between_them() -> None:
    foreground = drawn((149, 1.4), (171, 1.4))
    boxes = [(u - 8.0, 100.0, 16.0, 60.0) for u in (146.0, 160.0, 174.0)]
    found = segment_people(foreground, np.zeros_like(foreground), flat_ground(), boxes, relative_heights=[1.0] * 3)
    middles = sorted(one.box[0] + 0.5 * one.box[2] for one in found)
    assert middles == pytest.approx([149.0, 171.0], abs=2.5)
