"""Follows what a detector sees from picture to picture for a short time: expectations, and who is new."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from protocols.geometry.types import Floats

Box = tuple[float, float, float, float]
_SURE = 3  # sightings after which somebody is believed
_FORGET_S = 1.2
_GETS_ON = 0.35  # of the way that is gone, as the crow flies
_TENTATIVE_S = 0.25
_MEASURED, _DOUBT = 20, 2.0  # sightings of a height that count; what is usual counts as so many


@dataclass(slots=True)
class Follower:
    """One thing that is followed.

    box: x, y, w, h [px]. velocity: of its foot [px/s]. must_move: by how much of its lesser side before it counts as
    something that moves. ghost: whether it seemed to be only the place of something that has gone.
    """

    name: str
    box: Box
    time: float
    velocity: Floats = field(default_factory=lambda: np.zeros(2))
    hits: int = 1
    born: float = 0.0
    birthplace: tuple[float, float] = (0.0, 0.0)
    must_move: float = 0.35
    moved: bool = False
    ghost: bool = False
    way: float = 0.0
    missed_since: float | None = None
    colour: Floats | None = None
    measured: int = 0
    stature: float = 1.0

    @property
    def sure(self) -> bool:
        """Seen often enough to be believed."""
        return self.hits >= _SURE

    def measure(self, stature: float) -> None:
        """Its height, of the usual one where it stands, seen once more."""
        self.measured += 1
        share = 1.0 / (min(self.measured, _MEASURED) + _DOUBT)
        self.stature *= float(np.clip(stature / self.stature, 0.7, 1.4)) ** share

    def expected(self, time: float) -> Box:
        """Its box [px] at a time [s]."""
        x, y, w, h = self.box
        ahead = min(max(time - self.time, 0.0), 1.0)
        return x + ahead * float(self.velocity[0]), y + ahead * float(self.velocity[1]), w, h

    def see(self, box: Box, time: float, colour: Floats | None, trust: float = 0.6) -> None:
        """Seen again. trust: 0..1 of the box against what was expected."""
        expected = self.expected(time)
        before = self.box[0] + 0.5 * self.box[2], self.box[1] + 0.5 * self.box[3]
        span = max(time - self.time, 1e-3)
        foot = np.array([box[0] + 0.5 * box[2], box[1] + box[3]])
        thought = np.array([expected[0] + 0.5 * expected[2], expected[1] + expected[3]])
        share = 0.5 if self.hits < 3 else 0.25
        limit = 3.0 * box[3]  # nobody runs three heights a second
        self.velocity = np.clip(self.velocity + share * trust * (foot - thought) / max(span, 0.08), -limit, limit)
        self.box = tuple(float(a + trust * (b - a)) for a, b in zip(expected, box, strict=True))  # type: ignore[assignment]
        self.time = time
        self.hits += 1
        self.missed_since = None
        if colour is not None:
            self.colour = colour if self.colour is None else 0.9 * self.colour + 0.1 * colour
        self.way += float(
            np.hypot(self.box[0] + 0.5 * self.box[2] - before[0], self.box[1] + 0.5 * self.box[3] - before[1])
        )
        middle = self.box[0] + 0.5 * self.box[2], self.box[1] + 0.5 * self.box[3]
        away = float(np.hypot(middle[0] - self.birthplace[0], middle[1] - self.birthplace[1]))
        # A branch that sways goes a long way and gets nowhere.
        if away > self.must_move * min(self.box[2:]) + 1.0 and away > _GETS_ON * self.way:
            self.moved = True


class Following:
    """All that are followed in one picture. prefix: of their names, p0, p1, …; must_move: see ``Follower``."""

    def __init__(self, prefix: str, must_move: float) -> None:
        self._prefix = prefix
        self._must_move = must_move
        self._next = 0
        self.all: list[Follower] = []

    def clear(self) -> None:
        """Forget everybody; names are not used again."""
        self.all = []

    def assign(
        self, boxes: list[Box], colours: list[Floats | None], time: float, given: list[Follower | None]
    ) -> list[Follower]:
        """Whose each box is; new ones are begun. given: follower that a box was placed for, if any."""
        owners: list[Follower | None] = list(given)
        taken = {id(one) for one in owners if one is not None}
        free = [one for one in self.all if id(one) not in taken]
        open_boxes = [index for index, owner in enumerate(owners) if owner is None]
        if free and open_boxes:
            cost = np.array(
                [[_distance(one, boxes[index], colours[index], time) for one in free] for index in open_boxes]
            )
            for row, column in zip(*linear_sum_assignment(cost), strict=True):
                if cost[row, column] < 1.0:
                    owners[open_boxes[row]] = free[column]
        result = []
        for index, (box, owner) in enumerate(zip(boxes, owners, strict=True)):
            if owner is None:
                middle = box[0] + 0.5 * box[2], box[1] + 0.5 * box[3]
                owner = Follower(
                    f"{self._prefix}{self._next}", box, time, born=time, birthplace=middle, must_move=self._must_move
                )
                owner.colour = colours[index]
                self._next += 1
                self.all.append(owner)
            result.append(owner)
        return result

    def forget(self, time: float, size: tuple[int, int]) -> None:
        """Let go of those who have not been seen for a while, or have left the picture (width, height)."""
        kept = []
        for one in self.all:
            x, y, w, h = one.expected(time)
            gone = x + w < 0 or y + h < 0 or x > size[0] or y > size[1]
            silent = time - one.time
            if not gone and silent <= (_FORGET_S if one.sure else _TENTATIVE_S):
                kept.append(one)
        self.all = kept


def _distance(one: Follower, box: Box, colour: Floats | None, time: float) -> float:
    """How little a box fits a follower: below 1 it may be."""
    x, y, w, h = one.expected(time)
    scale = max(h, box[3], 8.0)
    away = np.hypot(x + 0.5 * w - box[0] - 0.5 * box[2], y + 0.5 * h - box[1] - 0.5 * box[3]) / scale
    # Where it may be by now grows with the time that it has not been seen.
    reach = 0.35 + 0.6 * min(time - one.time, 1.0)
    taller = abs(np.log(max(h, 1.0) / max(box[3], 1.0)))
    looks = 0.0
    if colour is not None and one.colour is not None:
        looks = float(np.linalg.norm(colour - one.colour)) / 150.0
    return float(away / reach + 0.5 * taller + 0.5 * looks)
