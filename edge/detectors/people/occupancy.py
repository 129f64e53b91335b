"""Occupancy of one silhouette of several people: the set of templates whose union explains it best.

Predicted people are searched near their predicted places; further templates are added greedily where they gain enough,
and all are refined by coordinate descent. After the occupancy by ground-plane templates of Fleuret et al. (2008),
without its mean-field approximation.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from edge.detectors.people.templates import BARS, TEMPLATE_AREA, Box, SilhouetteRegion, Template
from protocols.geometry.types import Floats, Ints

_MIN_NEW_GAIN, _MIN_KEPT_GAIN = 0.45, 0.28  # minimum gain over the template's area, of a new and of a kept template
_MAX_ROUNDS = 3  # of the search for people who were not predicted
_SEARCH_REACH = 0.14  # over the height: largest distance from the predicted place
_SEARCH_STEPS = np.linspace(0.0, 2.0, 9)  # tried within that distance, to both sides
# over the area, times the squared distance over the height; for people who were not predicted
_PRIOR_WEIGHT, _FREE_PRIOR_WEIGHT = 3.0, 0.3
_MIN_RELATIVE_HEIGHT, _MAX_RELATIVE_HEIGHT = 0.8, 1.2  # limits of a person's height relative to the height model
_HEIGHT_STEPS = np.array([0.95, 1.0, 1.05])  # factors tried on a template's height
_NEW_HEIGHTS = np.array([0.88, 1.0, 1.1])  # relative heights tried for people who were not predicted
_HEIGHT_PRIOR_WEIGHT = 8.0  # over the area, times the squared logarithm of the height over the expected one
_MAX_PEOPLE = 12  # people in one silhouette
# largest distance of two templates to merge, over the height; largest loss of gain by it, over the area
_MERGE_DISTANCE, _MERGE_LOSS = 0.45, 0.26
# gain over the area below which a template may be redundant; distance of its neighbours over the height
_REDUNDANCY_GAIN, _NEIGHBOUR_DISTANCE = 0.7, 0.6
_MERGE_STEPS = np.linspace(0.0, 1.0, 7)
_MERGE_HEIGHTS = np.array([0.92, 1.0, 1.08, 1.16, 1.25, 1.35])
_EXTRA_HEAD_WEIGHT = 1.5  # additional weight of a head's pixels
_NEW_HEIGHT_PENALTY = _HEIGHT_PRIOR_WEIGHT * np.log(_NEW_HEIGHTS) ** 2
_MIN_NEW_BOUND = float(
    ((_MIN_NEW_GAIN + _NEW_HEIGHT_PENALTY) * TEMPLATE_AREA * _NEW_HEIGHTS**2).min()
)  # gain of a new template over the squared height of the model


def fit_templates(region: SilhouetteRegion, expected: list[tuple[int, Box, float]]) -> list[Template]:
    """The templates that explain a silhouette region.

    expected: (index, box [px of the image], relative height) of each predicted person; the nearest are placed first.
    """
    placed: list[Template] = []
    for index, (x, y, w, h), relative_height in sorted(expected, key=lambda one: -(one[1][1] + one[1][3])):
        u, foot, _ = region.from_image(x + 0.5 * w, y + h, h)
        model_height = float(region.heights(np.array([u]), np.array([foot]))[0])
        one = Template(
            u,
            foot,
            relative_height * model_height,
            relative_height,
            index,
            (u, foot),
            expected_relative_height=relative_height,
        )
        _refine(region, one)
        region.cover(one)
        placed.append(one)
    if len(placed) > 1:
        _coordinate_descent(region, placed, 2)
    grid = _CandidateGrid(region)
    # A predicted person who is absent must not displace others; some new templates lose their gain once all are
    # refined, which uncovers their pixels again.
    for turn in range(_MAX_ROUNDS):
        before = len(placed)
        placed = _merged(region, _pruned(region, placed))
        if turn == 0:
            placed = _without_redundant(region, placed)
        gone = before - len(placed)
        came = 0
        while len(placed) < _MAX_PEOPLE:
            new = grid.best_candidate()
            if new is None:
                break
            region.cover(new)
            placed.append(new)
            came += 1
            _coordinate_descent(region, placed, 1)
        if not came and not gone:
            return placed
    return _pruned(region, placed)


def _pruned(region: SilhouetteRegion, placed: list[Template]) -> list[Template]:
    """The templates whose marginal gain is sufficient, the weakest tested first; pixels of the removed ones are
    uncovered.
    """
    if not placed:
        return placed
    kept = placed
    for one, gain in zip(placed, region.marginal_gains(placed), strict=True):
        one.gain = float(gain) / (TEMPLATE_AREA * one.height**2)
    for one in sorted(placed, key=lambda each: each.gain):
        if len(kept) < len(placed):
            one.gain = float(region.marginal_gains([one])[0]) / (TEMPLATE_AREA * one.height**2)
        if one.gain < (_MIN_KEPT_GAIN if one.expected >= 0 else 0.7 * _MIN_NEW_GAIN):
            region.uncover(one)
            kept = [each for each in kept if each is not one]
    return kept


def _without_redundant(region: SilhouetteRegion, placed: list[Template]) -> list[Template]:
    """Remove a template that is only explained while its neighbours stay where it has pushed them.

    Two broad people side by side are otherwise explained by three templates.
    """
    if len(placed) < 2:
        return placed
    gains = region.marginal_gains(placed)
    for index in np.argsort(gains):
        one = placed[index]
        if gains[index] > _REDUNDANCY_GAIN * TEMPLATE_AREA * one.height**2:
            break
        beside = [each for each in placed if each is not one and _are_beside(each, one)]
        if not beside:
            continue
        before = _joint_gain(region, [*beside, one])
        moved = [replace(each) for each in beside]
        _exchange(region, [*beside, one], moved)
        _coordinate_descent(region, moved, 1)
        if before - _joint_gain(region, moved) < _MIN_KEPT_GAIN * TEMPLATE_AREA * one.height**2:
            gone = {id(one), *map(id, beside)}
            return _without_redundant(region, [each for each in placed if id(each) not in gone] + moved)
        _exchange(region, moved, [*beside, one])
    return placed


def _are_beside(one: Template, other: Template) -> bool:
    rows = min(one.foot, other.foot) > max(one.top, other.top)
    return rows and abs(one.u - other.u) < _NEIGHBOUR_DISTANCE * other.height


def _exchange(region: SilhouetteRegion, these: list[Template], those: list[Template]) -> None:
    """Let the templates ``those`` cover a region in place of ``these``."""
    for one in these:
        region.uncover(one)
    for one in those:
        region.cover(one)


def _joint_gain(region: SilhouetteRegion, some: list[Template]) -> float:
    """Joint gain of some of the templates that cover a region beyond all others, the nearest counted first."""
    for one in some:
        region.uncover(one)
    total = 0.0
    for one in sorted(some, key=lambda each: -each.foot):
        placements = region.placements(np.array([one.u]), np.array([one.foot]), np.array([one.height]))
        total += float(region.gains(placements, one.expected)[0])
        region.cover(one)
    return total


def _merged(region: SilhouetteRegion, placed: list[Template]) -> list[Template]:
    """Replace two templates near each other by one wherever it explains nearly as much.

    Any height within the limits is tried: a person taller than the height model, while that is still uncertain, is
    otherwise explained by two short ones.
    """
    own: dict[int, float] | None = None
    between: dict[frozenset[int], Template] = {}
    for one in sorted(placed, key=lambda each: -each.height):
        for other in placed:
            if other is one:
                continue
            if (
                abs(one.u - other.u) > _MERGE_DISTANCE * one.height
                or abs(one.foot - other.foot) > _MERGE_DISTANCE * one.height
            ):
                continue
            if own is None:
                own = {id(each): float(gain) for each, gain in zip(placed, region.marginal_gains(placed), strict=True)}
            region.uncover(one)
            region.uncover(other)
            pair = frozenset((id(one), id(other)))
            single = between.get(pair)
            if single is None:
                single = between[pair] = _merged_template(region, one, other)
            placements = region.placements(np.array([one.u]), np.array([one.foot]), np.array([one.height]))
            both = float(region.gains(placements, one.expected)[0]) + own[id(other)]
            if single.gain > both - _MERGE_LOSS * TEMPLATE_AREA * max(one.height, other.height) ** 2:
                region.cover(single)
                return _merged(region, [each for each in placed if each is not one and each is not other] + [single])
            region.cover(one)
            region.cover(other)
    return placed


def _merged_template(region: SilhouetteRegion, one: Template, other: Template) -> Template:
    """The best single template around two of them; it belongs to the one that was predicted."""
    low, high = min(one.top, other.top), max(one.foot, other.foot)
    u, foot, relative_height, height = _candidates(
        region, one.u + (other.u - one.u) * _MERGE_STEPS, high - 0.3 * (high - low) * _MERGE_STEPS, _MERGE_HEIGHTS
    )
    gains = region.gains(region.placements(u, foot, height))
    best = int(gains.argmax())
    owner = max((one, other), key=lambda each: (each.expected >= 0, each.height))
    return replace(
        owner,
        u=float(u[best]),
        foot=float(foot[best]),
        height=float(height[best]),
        relative_height=float(relative_height[best]),
        gain=float(gains[best]),
        unmoved_state=None,
    )


def _refine(region: SilhouetteRegion, one: Template) -> None:
    """Move a template to the best place near it, with a quadratic prior on its predicted place and height."""
    if one.unmoved_state is not None and region.coverage(one.unmoved_state[0]) == one.unmoved_state[1]:
        return
    reach = max(_SEARCH_REACH * one.height, 2.0)
    steps = _SEARCH_STEPS * reach - reach
    relative_heights = np.minimum(
        np.maximum(one.relative_height * _HEIGHT_STEPS, _MIN_RELATIVE_HEIGHT), _MAX_RELATIVE_HEIGHT
    )
    u, foot, relative_height, height = _candidates(region, one.u + steps, one.foot + steps, relative_heights)
    placements = region.placements(u, foot, height)
    gains = region.gains(placements, one.expected)
    expected_place = one.expected_place or (one.u, one.foot)
    pull = _PRIOR_WEIGHT if one.expected_place is not None else _FREE_PRIOR_WEIGHT
    area = one.height**2
    away = pull * ((u - expected_place[0]) ** 2 + (foot - expected_place[1]) ** 2) / area
    away += _HEIGHT_PRIOR_WEIGHT * np.log(relative_height / one.expected_relative_height) ** 2
    best = int((gains - away * TEMPLATE_AREA * area).argmax())
    before = one.u, one.foot, one.relative_height
    one.u, one.foot, one.height, one.gain = float(u[best]), float(foot[best]), float(height[best]), float(gains[best])
    one.relative_height = float(relative_height[best])
    moved = (one.u, one.foot, one.relative_height) != before
    one.unmoved_state = None if moved else (placements.window, region.coverage(placements.window))


def _candidates(
    region: SilhouetteRegion, u: Floats, foot: Floats, relative_heights: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """All combinations of centres (k,), feet (m,) and relative heights (n,): u, foot, relative height and height, each
    (k m n,).
    """
    shape = len(foot), len(u), len(relative_heights)
    height = relative_heights * region.heights(u, foot[:, None])[:, :, None]
    middles, feet, short = np.empty(shape), np.empty(shape), np.empty(shape)
    middles[:], feet[:], short[:] = u[:, None], foot[:, None, None], relative_heights
    return middles.ravel(), feet.ravel(), short.ravel(), height.ravel()


def _coordinate_descent(region: SilhouetteRegion, placed: list[Template], sweeps: int) -> None:
    for _ in range(sweeps):
        for one in placed:
            region.uncover(one)
            _refine(region, one)
            region.cover(one)


class _CandidateGrid:
    """Grid of possible foot points of people who were not predicted: those with a silhouette at chest height."""

    def __init__(self, region: SilhouetteRegion) -> None:
        self._region = region
        h, w = region.weight.shape
        step = 2 if h > 24 else 1
        # Feet may be below the image; elsewhere the region contains all of them.
        reach = int(0.7 * region.height_model.median_height * region.scales[1]) if region.at_bottom else 0
        columns, rows = np.arange(0.5, w, step), np.arange(4.0, h + reach, step)
        height = region.heights(columns, rows[:, None])
        chest = np.rint(rows[:, None] - 0.7 * height).astype(np.intp)
        inside = (chest >= 0) & (chest < h)
        at = columns.astype(np.intp) + w * np.minimum(np.maximum(chest, 0), h - 1)
        inside &= region.filled.ravel().take(at) > 0.3
        row, column = inside.nonzero()
        self._u, self._foot, self._tall = columns[column], rows[row], height[inside]
        self._corners = self._frames(h, w)
        half, high, low = BARS[0]
        tallest = float(_NEW_HEIGHTS.max()) * self._tall
        self._heads = (2.0 * half * tallest + 1.0) * ((low - high) * tallest + 1.0)  # upper bound of a head's pixels

    def _frames(self, h: int, w: int) -> Ints:
        """Corners (4, n) of the largest templates' bounding boxes, in the flattened integral image of the region (h,
        w).
        """
        half, height = max(bar[0] for bar in BARS), float(_NEW_HEIGHTS.max()) * self._tall
        a, b = np.rint(self._u - half * height), np.rint(self._u + half * height)
        c, d = np.rint(self._foot - height), np.rint(self._foot)
        a, b = (np.minimum(np.maximum(one, 0), w) for one in (a, b))
        c, d = (np.minimum(np.maximum(one, 0), h) * (w + 1) for one in (c, d))
        return np.stack([d + b, c + b, d + a, c + a]).astype(np.intp)

    def best_candidate(self) -> Template | None:
        """The template of largest gain, or None where no gain is sufficient."""
        if not len(self._u):
            return None
        # Upper bound: the weight within the bounding box, and the extra weight of the head. It excludes most places.
        sums = cv2.integral(self._region.unexplained()).ravel().take(self._corners)
        held = sums[0] - sums[1] - sums[2] + sums[3]
        most = held + _EXTRA_HEAD_WEIGHT * np.minimum(held, self._heads)
        may = (most >= _MIN_NEW_BOUND * self._tall**2).nonzero()[0]
        if not len(may):
            return None
        u, foot, model_height = self._u[may], self._foot[may], self._tall[may]
        height = _NEW_HEIGHTS[:, None] * model_height
        count = len(_NEW_HEIGHTS)
        gains = self._region.gains(self._region.placements(np.tile(u, count), np.tile(foot, count), height.ravel()))
        gains = gains.reshape(height.shape)
        worth = gains / (TEMPLATE_AREA * np.square(height)) - _NEW_HEIGHT_PENALTY[:, None]
        size, best = divmod(int(worth.argmax()), len(may))
        if worth[size, best] < _MIN_NEW_GAIN:
            return None
        relative_height = float(_NEW_HEIGHTS[size])
        return Template(
            float(u[best]), float(foot[best]), float(height[size, best]), relative_height, gain=float(gains[size, best])
        )
