"""What moves over the static scene: the residual of the stabilised image, for small targets.

Differences to two earlier images, stabilised on the scene; the smaller one counts, so that nothing is left where a
moving thing was before. A pixel may be any value that its neighbours in the earlier image span: errors of a pixel in
the stabilisation leave nothing either.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.ground.ego_motion import reduced
from edge.uav.image_motion.scene_motion import Motion
from protocols.geometry.types import Floats, Image, Singles

_APART_S = 0.35  # between the images that are compared
_KEEP_S = 0.08  # between two that are kept
_SIDE_PX = 14.0  # geometric mean of the target's sides in the reduced image, at least
_MAX_PX = 140  # side of the region that is searched [px, reduced]
# Of the log ratio in rendered flights: what moves by 2 px or more (mean, std of what is below), what stands; bounds
# of the share of the places beside a target where something else moves, which is counted.
_MOVING, _STANDING_STD, _OTHERS = (2.0, 0.7), 0.25, (0.03, 0.3)
SURELY = 2.2  # ratio of what moves
_BOUNDS = (0.1, 0.9)  # of the probability that the target moves
_LEARNING, _FIRST_LEARNING = 0.1, 0.4  # share of a new observation of whether the target moves
_FLOOR = 1.5  # grey levels of difference that noise and compression leave


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """ratio: (h, w) of the mean difference in boxes about each pixel to the median one; 0 where it is not known.

    scale, low: of its pixels. moves: probability that the target moves over the scene; others:
    share of the places where something moves.
    """

    ratio: Singles
    scale: float
    low: Floats
    moves: float
    others: float = 0.0

    def densities(self, place: Floats) -> tuple[float, float]:
        """Densities of the log ratio at a place (2,), for what moves and for what stands; equal where not known."""
        x, y = np.rint((place - self.low) / self.scale).astype(int)
        inside = 1 <= y < len(self.ratio) - 1 and 1 <= x < self.ratio.shape[1] - 1
        ratio = float(self.ratio[y - 1 : y + 2, x - 1 : x + 2].max()) if inside else 0.0
        if ratio == 0.0:
            return 1.0, 1.0
        moving, standing = densities(np.array(ratio), self.others)
        return float(moving), float(standing)

    def log_ratio(self, place: Floats) -> float:
        """log p(residual | target) - log p(residual | anything else) at a place (2,) [px], natural."""
        moving, standing = self.densities(place)
        return float(np.log(self.moves * moving + (1.0 - self.moves) * standing) - np.log(standing))

    def peaks(self, apart: Floats, most: int) -> list[Floats]:
        """Places (2,) of what surely moves, ``apart`` (2,) from each other [px], the highest ratio first."""
        left, out = self.ratio.copy(), []
        for _ in range(most):
            y, x = divmod(int(left.argmax()), left.shape[1])
            if left[y, x] < SURELY:
                break
            out.append(self.low + self.scale * np.array([x, y]))
            dx, dy = np.maximum(apart / self.scale, 1.0).astype(int)
            left[max(y - dy, 0) : y + dy + 1, max(x - dx, 0) : x + dx + 1] = 0.0
        return out


def difference(new: Image, before: Image) -> Image:
    """Difference (h, w) of the values of an image to those that its neighbours span in an earlier one."""
    kernel = np.ones((3, 3), np.uint8)
    above, below = cv2.subtract(new, cv2.dilate(before, kernel)), cv2.subtract(cv2.erode(before, kernel), new)
    return np.asarray(np.maximum(above, below).max(axis=2), np.uint8)


def ratio_to_median(differs: Image, side: tuple[int, int]) -> Singles:
    """Ratio (h, w) of the mean difference in boxes (width, height) about each pixel to the median one."""
    mean = cv2.boxFilter(differs, cv2.CV_32F, side)
    return np.asarray((mean + _FLOOR) / (float(np.median(mean)) + _FLOOR), np.float32)


def share_moving(ratio: Singles) -> float:
    """Share of the places where something moves, within bounds."""
    return float(np.clip((ratio > SURELY).mean(), *_OTHERS))


def densities(ratio: Singles, others: float) -> tuple[Floats, Floats]:
    """Densities of the logs of positive ratios, for what moves and for what stands among ``others`` that move."""
    value = np.maximum(np.log(ratio), 0.0)
    moving = np.exp(-0.5 * (np.minimum(value - _MOVING[0], 0.0) / _MOVING[1]) ** 2) / (2.5 * _MOVING[1])
    standing = 2.0 * np.exp(-0.5 * (value / _STANDING_STD) ** 2) / (2.5 * _STANDING_STD)
    return moving, (1.0 - others) * standing + others * moving + 1e-3


UNKNOWN = Residual(np.zeros((1, 1), np.float32), 1.0, np.zeros(2), 0.0)


class MovingParts:
    """Reduced images of the last second, each with the map of the scene from it to the newest one.

    box: of the target in the first ``image``, at ``time`` [s].
    """

    def __init__(self, image: Image, time: float, box: OrientedBox) -> None:
        self._moves = 0.5
        self._begun: float = time
        self._first: Floats | None = box.centre  # where the scene is now at which the target was at first
        self._reduction = _reduction(box)
        self._past: list[tuple[float, Image, Floats]] = []
        self._keep(image, time)

    def _keep(self, image: Image, time: float) -> None:
        # At least a pixel: the box of a target that is away grows beyond the image with a view that zooms in.
        self._now = reduced(image, min(self._reduction, *image.shape[:2]))
        if not self._past or time - self._past[-1][0] > _KEEP_S:
            self._past.append((time, self._now, np.eye(3)))

    def update(
        self, image: Image, time: float, box: OrientedBox, motion: Motion, place: Floats, origin: Floats
    ) -> None:
        """Add an image. box: of the target; the scene at ``place`` (2,) is now at ``origin`` (2,)."""
        linear = motion.matrix[:, :2]
        if self._first is not None:
            self._first = origin + linear @ (self._first - place)
        if not motion.trusted or not 0.5 < _reduction(box) / self._reduction < 2.0:
            self._past, self._first, self._reduction = [], None, _reduction(box)
        step = np.eye(3)
        step[:2, :2], step[:2, 2] = linear, self._reduced(origin) - linear @ self._reduced(place)
        self._past = [(t, old, step @ since) for t, old, since in self._past if time - t < 2.0 * _APART_S + _KEEP_S]
        self._keep(image, time)

    def _reduced(self, place: Floats) -> Floats:
        """A place (2,) in the reduced images."""
        return (place + 0.5) / self._reduction - 0.5

    def residual(self, time: float, box: OrientedBox, reach: float) -> Residual:
        """About a box, for centres within ``reach`` [px]; unknown before there are images to compare with."""
        known_s = time - self._past[0][0] if self._past else 0.0
        half = np.minimum((reach + 0.5 * box.extent) / self._reduction, 0.5 * _MAX_PX)
        size, centre = np.array(self._now.shape[1::-1]), self._reduced(box.centre)
        low = np.clip(np.floor(centre - half), 0, size - 1).astype(int)
        high = np.clip(np.ceil(centre + half) + 1, 0, size).astype(int)
        if known_s < 0.8 * _APART_S or (high - low).min() < 8:
            return UNKNOWN
        new, window = self._now[low[1] : high[1], low[0] : high[0]], (int(high[0] - low[0]), int(high[1] - low[1]))
        least, seen = np.full(window[::-1], 255, np.uint8), np.full(window[::-1], 255, np.uint8)
        for age in (_APART_S, 2.0 * _APART_S) if known_s > 1.5 * _APART_S else (known_s,):
            _, old, since = min(self._past, key=lambda kept: abs(time - kept[0] - age))
            inverse = np.linalg.inv(since)[:2]
            inverse[:, 2] += inverse[:, :2] @ low
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            before = np.asarray(
                cv2.warpAffine(old, inverse, window, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8
            )
            known = cv2.warpAffine(np.full(old.shape[:2], 255, np.uint8), inverse, window, flags=flags)
            least, seen = np.minimum(least, difference(new, before)), np.minimum(seen, known)
        side = np.maximum(np.rint(0.8 * box.extent / self._reduction), 3).astype(int)
        ratio = ratio_to_median(least, (int(side[0]), int(side[1])))
        ratio[cv2.erode(seen, np.ones((int(side[1]), int(side[0])), np.uint8)) < 255] = 0.0
        others = share_moving(ratio)
        scale = float(self._reduction)
        found = Residual(ratio, scale, scale * (low + 0.5) - 0.5, self._moves, others)
        if known_s > 1.5 * _APART_S:
            return found
        # Where it was at first, which is sure, something else is seen now: it moves, wherever the tracker has it.
        if self._first is not None and time - self._begun < 1.5 * _APART_S:
            self.confirm(found, self._first, _FIRST_LEARNING)
        return UNKNOWN

    def confirm(self, residual: Residual, place: Floats, share: float = _LEARNING) -> None:
        """Learn whether the target, which is surely at ``place`` (2,), moves."""
        moving, standing = residual.densities(place)
        if moving != standing:
            found = self._moves * moving / (self._moves * moving + (1.0 - self._moves) * standing)
            self._moves = float(np.clip(self._moves + share * (found - self._moves), *_BOUNDS))


def _reduction(box: OrientedBox) -> int:
    return max(int(np.sqrt(box.width * box.height) / _SIDE_PX), 1)
