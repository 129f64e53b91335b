"""Who stands where in one silhouette of several people: the templates whose union explains it.

Those who are expected are sought near where they should be; whoever else is worth a place is put there greedily, and
all settle by coordinate descent. After the occupancy by ground plane templates of Fleuret et al. (2008), in place of
its mean field.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from edge.detectors.people.templates import AREA, BARS, Box, Scene, Template
from protocols.geometry.types import Floats, Ints

_NEW, _KEPT = 0.45, 0.28  # gain of a template, of its area, that makes it worth its place
_ROUNDS = 3  # of seeking those whom nobody expected
_REACH = 0.14  # of the height: how far somebody may be from where it is expected
_STEPS = np.linspace(0.0, 2.0, 9)  # tried over that reach, to both sides
_PULL, _FREE_PULL = 3.0, 0.3  # of its area, by the square of that distance over the height; of who was not expected
_SHORT, _LONG = 0.8, 1.2  # of the usual height at a place, that somebody may have
_STRETCHED = np.array([0.95, 1.0, 1.05])  # tried of the height that somebody has
_COMING = np.array([0.88, 1.0, 1.1])  # tried of somebody whom nobody expected
_STIFF = 8.0  # of its area, by the square of the logarithm of the height over what is expected
_MOST = 12  # people in one silhouette
_MERGE, _SPLIT = 0.45, 0.26  # distance of two who may be one, of the height; what one may explain less, of its area
_DOUBTED, _BESIDE = 0.7, 0.6  # gain, of its area, up to which it is asked whether he is needed; of the height: how near
_BETWEEN = np.linspace(0.0, 1.0, 7)
_STATURES = np.array([0.92, 1.0, 1.08, 1.16, 1.25, 1.35])
_HEAD_COUNTS = 1.5  # pixels of a head count more than others by so much
_UNLIKELY = _STIFF * np.log(_COMING) ** 2
_LEAST = float(((_NEW + _UNLIKELY) * AREA * _COMING**2).min())  # gain of who comes, of the usual height squared


def place(scene: Scene, expected: list[tuple[int, Box, float]]) -> list[Template]:
    """The templates that explain a scene. expected: index, box [px of the picture], stature; the nearest go first."""
    placed: list[Template] = []
    for index, (x, y, w, h), stature in sorted(expected, key=lambda one: -(one[1][1] + one[1][3])):
        u, foot, _ = scene.inward(x + 0.5 * w, y + h, h)
        usual = float(scene.heights(np.array([u]), np.array([foot]))[0])
        one = Template(u, foot, stature * usual, stature, index, (u, foot), of=stature)
        _settle(scene, one)
        scene.cover(one)
        placed.append(one)
    if len(placed) > 1:
        _descend(scene, placed, 2)
    grid = _Grid(scene)
    # Who is expected and not there must not keep others out; of those who come some are not worth their place once
    # all have settled, and what they covered is free again.
    for turn in range(_ROUNDS):
        before = len(placed)
        placed = _merged(scene, _worthy(scene, placed))
        if turn == 0:
            placed = _needed(scene, placed)
        gone = before - len(placed)
        came = 0
        while len(placed) < _MOST:
            new = grid.best_new()
            if new is None:
                break
            scene.cover(new)
            placed.append(new)
            came += 1
            _descend(scene, placed, 1)
        if not came and not gone:
            return placed
    return _worthy(scene, placed)


def _worthy(scene: Scene, placed: list[Template]) -> list[Template]:
    """Those who explain enough that no other does, the least sure asked first; the others' pixels are free."""
    if not placed:
        return placed
    kept = placed
    for one, gain in zip(placed, scene.own_gains(placed), strict=True):
        one.gain = float(gain) / (AREA * one.tall**2)
    for one in sorted(placed, key=lambda each: each.gain):
        if len(kept) < len(placed):
            one.gain = float(scene.own_gains([one])[0]) / (AREA * one.tall**2)
        if one.gain < (_KEPT if one.expected >= 0 else 0.7 * _NEW):
            scene.uncover(one)
            kept = [each for each in kept if each is not one]
    return kept


def _needed(scene: Scene, placed: list[Template]) -> list[Template]:
    """Without whoever is worth his place only as long as his neighbours stay where he has pushed them.

    Two side by side who are broader than templates are else three.
    """
    if len(placed) < 2:
        return placed
    gains = scene.own_gains(placed)
    for index in np.argsort(gains):
        one = placed[index]
        if gains[index] > _DOUBTED * AREA * one.tall**2:
            break
        beside = [each for each in placed if each is not one and _are_beside(each, one)]
        if not beside:
            continue
        before = _explained(scene, [*beside, one])
        moved = [replace(each) for each in beside]
        _exchange(scene, [*beside, one], moved)
        _descend(scene, moved, 1)
        if before - _explained(scene, moved) < _KEPT * AREA * one.tall**2:
            gone = {id(one), *map(id, beside)}
            return _needed(scene, [each for each in placed if id(each) not in gone] + moved)
        _exchange(scene, moved, [*beside, one])
    return placed


def _are_beside(one: Template, other: Template) -> bool:
    rows = min(one.foot, other.foot) > max(one.top, other.top)
    return rows and abs(one.u - other.u) < _BESIDE * other.tall


def _exchange(scene: Scene, these: list[Template], those: list[Template]) -> None:
    """Let those cover a scene in place of these."""
    for one in these:
        scene.uncover(one)
    for one in those:
        scene.cover(one)


def _explained(scene: Scene, some: list[Template]) -> float:
    """What some of those who cover a scene explain together beyond the others, the nearest first."""
    for one in some:
        scene.uncover(one)
    total = 0.0
    for one in sorted(some, key=lambda each: -each.foot):
        places = scene.places(np.array([one.u]), np.array([one.foot]), np.array([one.tall]))
        total += float(scene.gains(places, one.expected)[0])
        scene.cover(one)
    return total


def _merged(scene: Scene, placed: list[Template]) -> list[Template]:
    """With one template in place of two near each other wherever it explains nearly as much as both.

    Of any height within what people may have where heights are not known well yet: somebody taller than is usual
    at a place is else taken for two short ones.
    """
    own: dict[int, float] | None = None
    between: dict[frozenset[int], Template] = {}
    for one in sorted(placed, key=lambda each: -each.tall):
        for other in placed:
            if other is one:
                continue
            if abs(one.u - other.u) > _MERGE * one.tall or abs(one.foot - other.foot) > _MERGE * one.tall:
                continue
            if own is None:
                own = {id(each): float(gain) for each, gain in zip(placed, scene.own_gains(placed), strict=True)}
            scene.uncover(one)
            scene.uncover(other)
            pair = frozenset((id(one), id(other)))
            single = between.get(pair)
            if single is None:
                single = between[pair] = _between(scene, one, other)
            places = scene.places(np.array([one.u]), np.array([one.foot]), np.array([one.tall]))
            both = float(scene.gains(places, one.expected)[0]) + own[id(other)]
            if single.gain > both - _SPLIT * AREA * max(one.tall, other.tall) ** 2:
                scene.cover(single)
                return _merged(scene, [each for each in placed if each is not one and each is not other] + [single])
            scene.cover(one)
            scene.cover(other)
    return placed


def _between(scene: Scene, one: Template, other: Template) -> Template:
    """The best single template about where two are, of whoever of them is expected."""
    low, high = min(one.top, other.top), max(one.foot, other.foot)
    u, foot, stature, tall = _tried(
        scene, one.u + (other.u - one.u) * _BETWEEN, high - 0.3 * (high - low) * _BETWEEN, _STATURES
    )
    gains = scene.gains(scene.places(u, foot, tall))
    best = int(gains.argmax())
    owner = max((one, other), key=lambda each: (each.expected >= 0, each.tall))
    return replace(
        owner,
        u=float(u[best]),
        foot=float(foot[best]),
        tall=float(tall[best]),
        stature=float(stature[best]),
        gain=float(gains[best]),
        still=None,
    )


def _settle(scene: Scene, one: Template) -> None:
    """Move a template to the best place near, drawn to where it is expected."""
    if one.still is not None and scene.others(one.still[0]) == one.still[1]:
        return
    reach = max(_REACH * one.tall, 2.0)
    steps = _STEPS * reach - reach
    statures = np.minimum(np.maximum(one.stature * _STRETCHED, _SHORT), _LONG)
    u, foot, stature, tall = _tried(scene, one.u + steps, one.foot + steps, statures)
    places = scene.places(u, foot, tall)
    gains = scene.gains(places, one.expected)
    home = one.home or (one.u, one.foot)
    pull = _PULL if one.home is not None else _FREE_PULL
    area = one.tall**2
    away = pull * ((u - home[0]) ** 2 + (foot - home[1]) ** 2) / area
    away += _STIFF * np.log(stature / one.of) ** 2
    best = int((gains - away * AREA * area).argmax())
    before = one.u, one.foot, one.stature
    one.u, one.foot, one.tall, one.gain = float(u[best]), float(foot[best]), float(tall[best]), float(gains[best])
    one.stature = float(stature[best])
    moved = (one.u, one.foot, one.stature) != before
    one.still = None if moved else (places.window, scene.others(places.window))


def _tried(scene: Scene, u: Floats, foot: Floats, statures: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Every middle (k,) with every foot (m,) and stature (n,): middles, feet, statures and heights, (k m n,) each."""
    shape = len(foot), len(u), len(statures)
    tall = statures * scene.heights(u, foot[:, None])[:, :, None]
    middles, feet, short = np.empty(shape), np.empty(shape), np.empty(shape)
    middles[:], feet[:], short[:] = u[:, None], foot[:, None, None], statures
    return middles.ravel(), feet.ravel(), short.ravel(), tall.ravel()


def _descend(scene: Scene, placed: list[Template], sweeps: int) -> None:
    for _ in range(sweeps):
        for one in placed:
            scene.uncover(one)
            _settle(scene, one)
            scene.cover(one)


class _Grid:
    """Where somebody's foot may be who was not expected: below what may be a head."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        h, w = scene.weight.shape
        step = 2 if h > 24 else 1
        # Feet may be below the picture; elsewhere the part has all of them.
        reach = int(0.7 * scene.stature.typical * scene.scales[1]) if scene.at_bottom else 0
        columns, rows = np.arange(0.5, w, step), np.arange(4.0, h + reach, step)
        tall = scene.heights(columns, rows[:, None])
        chest = np.rint(rows[:, None] - 0.7 * tall).astype(np.intp)
        inside = (chest >= 0) & (chest < h)
        at = columns.astype(np.intp) + w * np.minimum(np.maximum(chest, 0), h - 1)
        inside &= scene.filled.ravel().take(at) > 0.3
        row, column = inside.nonzero()
        self._u, self._foot, self._tall = columns[column], rows[row], tall[inside]
        self._corners = self._frames(h, w)
        half, high, low = BARS[0]
        tallest = float(_COMING.max()) * self._tall
        self._heads = (2.0 * half * tallest + 1.0) * ((low - high) * tallest + 1.0)  # pixels, at most

    def _frames(self, h: int, w: int) -> Ints:
        """Corners (4, n) of the frames of the largest templates, in the flattened integral image of the part (h, w)."""
        half, tall = max(bar[0] for bar in BARS), float(_COMING.max()) * self._tall
        a, b = np.rint(self._u - half * tall), np.rint(self._u + half * tall)
        c, d = np.rint(self._foot - tall), np.rint(self._foot)
        a, b = (np.minimum(np.maximum(one, 0), w) for one in (a, b))
        c, d = (np.minimum(np.maximum(one, 0), h) * (w + 1) for one in (c, d))
        return np.stack([d + b, c + b, d + a, c + a]).astype(np.intp)

    def best_new(self) -> Template | None:
        """The template that explains most, if it is worth its place."""
        if not len(self._u):
            return None
        # No template explains more than its frame holds, and its head's share of that once more: most are out by that.
        sums = cv2.integral(self._scene.unexplained()).ravel().take(self._corners)
        held = sums[0] - sums[1] - sums[2] + sums[3]
        most = held + _HEAD_COUNTS * np.minimum(held, self._heads)
        may = (most >= _LEAST * self._tall**2).nonzero()[0]
        if not len(may):
            return None
        u, foot, usual = self._u[may], self._foot[may], self._tall[may]
        tall = _COMING[:, None] * usual
        count = len(_COMING)
        gains = self._scene.gains(self._scene.places(np.tile(u, count), np.tile(foot, count), tall.ravel()))
        gains = gains.reshape(tall.shape)
        worth = gains / (AREA * np.square(tall)) - _UNLIKELY[:, None]
        size, best = divmod(int(worth.argmax()), len(may))
        if worth[size, best] < _NEW:
            return None
        stature = float(_COMING[size])
        return Template(
            float(u[best]), float(foot[best]), float(tall[size, best]), stature, gain=float(gains[size, best])
        )
