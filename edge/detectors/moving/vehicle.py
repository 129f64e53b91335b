"""Moving vehicles, from a fixed camera and from one that moves itself.

Fixed: silhouettes against a model of the background (``foreground``). Moving: the background is carried along by the
homography of its corners from frame to frame, and what differs from it has moved by itself; the ground is taken for
flat, so that tall things near a low-flying camera show at their edges.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from edge.detectors.moving.foreground import Foreground, ModelName
from edge.detectors.moving.gating import match_predictions
from edge.detectors.moving.tracklets import Follower, Following
from protocols.geometry.types import Floats

Image = npt.NDArray[np.uint8]
Box = tuple[float, float, float, float]
_MOST_PIXELS = 500_000
_LEAST_SHARE = 0.00025  # of the picture: below it is nothing to count
_MOVES_PX = 0.35  # a frame: above it for a while, the camera moves
_TRAVELS_PX = 3.0  # between pictures seconds apart
_DECIDE = 8  # frames
_SPREAD = 4  # cells a side of the picture over which corners must be spread to speak of the camera
_CORNERS = 400
_GROWS = 2.5  # times: a silhouette this much larger than a vehicle is more than it
_DIFFERENT = 26  # 8-bit steps
_STALE_FRAMES = 20
_CARRY = 0.12  # share of a frame in the carried background
_PAST_FRAMES = 2  # what did not change for so long, and up to twice that, stands
_FLANK, _FLANKED = (
    5,
    0.25,
)  # px beside a thing that stands, and the share of it that moves, by which it is no ground yet
_POSITION_STD, _FLOOR_STD = 0.1, 1.0  # of the size, as a rendered town seen from above has it, shadows and all; px


class VehicleDetector:
    """Vehicles that move.

    model, fps: as for ``PersonDetector``. camera: whether it is fixed, moves, or is to be found out.
    sure_only: report only what has been seen several times and has moved. prefix: of the labels.
    """

    def __init__(
        self,
        model: ModelName = "mog2",
        fps: float = 25.0,
        *,
        sure_only: bool = True,
        prefix: str = "t",
        moving: bool | None = None,
    ) -> None:
        self._fps = fps if fps > 0 and math.isfinite(fps) else 25.0
        self._model: ModelName = model
        self._foreground = Foreground(model, self._fps)
        self._following = Following(prefix, must_move=1.0)
        self._sure_only = sure_only
        self._given = moving
        self._moves: deque[float] = deque(maxlen=_DECIDE)
        self._moving = bool(moving)
        self._carried = _Carried()
        self._size = (0, 0)
        self._shrink = 1.0
        self._time = -1.0
        self._sure: set[str] = set()

    @property
    def moving(self) -> bool:
        """Whether the camera is taken to move."""
        return self._moving

    @property
    def jolts(self) -> int:
        """How often everything had to be learnt anew."""
        return self._foreground.jolts

    def is_sure(self, label: str) -> bool:
        """Whether what was reported under this label turned out to be a vehicle that moves."""
        return label in self._sure

    def prime(self, pictures: Sequence[Image]) -> None:
        """Learn a fixed camera's background from pictures of a longer time; a moving one's can't be learnt so."""
        if not pictures or self._given:
            return
        self._fit_to(pictures[0])
        small = [self._smaller(picture) for picture in pictures]
        if self._given is None:
            travel = _travel(small)
            if travel is None:
                return  # the first frames will tell
            self._given = self._moving = travel > _TRAVELS_PX
        if self._moving:
            return
        self._foreground.prime(small)

    def rewind(self) -> None:
        """Begin again at an earlier time with what was learnt of the place, and nothing in the picture."""
        self._following.clear()
        self._carried = _Carried()
        self._time = -1.0

    def detect(
        self, image: Image, time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """Vehicles in an image (H, W, 3) BGR taken at ``time_s``; the surest first."""
        self._fit_to(image)
        now = self._time + 1.0 / self._fps if time_s is None else time_s
        if not now > self._time:
            now = self._time + 1.0 / self._fps
        self._time = now
        small = self._smaller(image)
        if self._given is None or self._moving:
            self._look_for_motion(small)
        figure = self._figure(small, now)
        if figure is None:
            self._following.clear()
            return []
        found = self._boxes(figure, now)
        owners = self._following.assign([box for box, _ in found], [None] * len(found), now, [one for _, one in found])
        result = []
        for (box, _), owner in zip(found, owners, strict=True):
            if owner.time < now:
                owner.see(box, now, None, 0.7)
            if owner.sure and owner.moved:
                self._sure.add(owner.name)
            elif self._sure_only:
                continue
            result.append(self._report(small, figure, owner))
        self._following.forget(now, (small.shape[1], small.shape[0]))
        result.sort(key=lambda one: -one.score)
        return match_predictions(result, predictions)

    def _fit_to(self, image: Image) -> None:
        size = image.shape[1], image.shape[0]
        if size != self._size:
            self._size = size
            self._shrink = min(1.0, math.sqrt(_MOST_PIXELS / (size[0] * size[1])))
            self._following.clear()
            self._carried = _Carried()

    def _smaller(self, image: Image) -> Image:
        if self._shrink == 1.0:
            return image
        size = round(image.shape[1] * self._shrink), round(image.shape[0] * self._shrink)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _look_for_motion(self, image: Image) -> None:
        self._carried.follow(image)
        if math.isfinite(self._carried.shift):
            self._moves.append(self._carried.shift)
        if self._given is not None or len(self._moves) < _DECIDE:
            return
        typical = float(np.median(self._moves))
        if not self._moving and typical > _MOVES_PX:
            self._moving = True
        elif self._moving and typical < 0.3 * _MOVES_PX and max(self._moves) < _MOVES_PX:
            self._moving = False
            self._foreground = Foreground(self._model, self._fps)

    def _figure(self, image: Image, now: float) -> Image | None:
        """Silhouettes (H, W) 0/255; None while nothing can be told."""
        if self._moving:
            raw = self._carried.residual(image)
        else:
            if self._given is None and len(self._moves) < _DECIDE:
                self._carried.residual(image)  # in case the camera turns out to move
            else:
                self._carried.forget()
            followed = [one.box for one in self._following.all if one.sure and one.moved]
            layers = self._foreground.look(image, followed, now)
            raw = None if layers.fresh else layers.figure
        if raw is None:
            return None
        calm = cv2.medianBlur(raw, 5)
        reach = max(int(0.012 * max(image.shape[:2])), 3) | 1
        joined = cv2.morphologyEx(calm, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
        return np.asarray(joined, dtype=np.uint8)

    def _boxes(self, figure: Image, now: float) -> list[tuple[Box, Follower | None]]:
        """Boxes and whose they are: pieces that lie where one vehicle is expected are one."""
        count, _, stats, centres = cv2.connectedComponentsWithStats(figure, connectivity=8)
        least = _LEAST_SHARE * figure.size
        pieces = [index for index in range(1, count) if stats[index, cv2.CC_STAT_AREA] >= 0.4 * least]
        groups: dict[int, list[int]] = {}
        followers = sorted(self._following.all, key=lambda one: -one.hits)
        for index in pieces:
            u, v = centres[index]
            for which, one in enumerate(followers):
                x, y, w, h = one.expected(now)
                near = x - 0.1 * w <= u <= x + 1.1 * w and y - 0.1 * h <= v <= y + 1.1 * h
                if near and _grown(one.box, stats[index]) < _GROWS:
                    groups.setdefault(which, []).append(index)
                    break
            else:
                groups.setdefault(-index, []).append(index)
        found: list[tuple[Box, Follower | None]] = []
        for which, members in groups.items():
            if sum(int(stats[index, cv2.CC_STAT_AREA]) for index in members) < least:
                continue
            low = stats[members, :2].min(axis=0)
            high = (stats[members, :2] + stats[members, 2:4]).max(axis=0)
            box = float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])
            found.append((box, followers[which] if which >= 0 else None))
        return found

    def _report(self, image: Image, figure: Image, one: Follower) -> Detection:
        x, y, w, h = one.box
        scale = 1.0 / self._shrink
        size = math.sqrt(max(w * h, 1.0)) * scale
        std = math.hypot(_POSITION_STD * size, _FLOOR_STD)
        rows = slice(max(int(y), 0), max(int(y + h) + 1, 0))
        columns = slice(max(int(x), 0), max(int(x + w) + 1, 0))
        part, mask = image[rows, columns], figure[rows, columns]
        colour = None
        if mask.size and cv2.countNonZero(mask):
            blue, green, red, _ = cv2.mean(np.ascontiguousarray(part), np.ascontiguousarray(mask))
            colour = round(red), round(green), round(blue)
        return Detection(
            u=(x + 0.5 * w) * scale - 0.5,
            v=(y + 0.5 * h) * scale - 0.5,
            size=size,
            score=0.9 if one.sure and one.moved else 0.4,
            label=one.name,
            colour=colour,
            covariance=(std**2, 0.0, std**2),
            kind="vehicle",
            box=(x * scale, y * scale, w * scale, h * scale),
        )


def _grown(box: Box, piece: npt.NDArray[np.int32]) -> float:
    """By how much a box must grow to take in a piece (x, y, w, h, …), the greater side."""
    return max(float(piece[2]) / max(box[2], 1.0), float(piece[3]) / max(box[3], 1.0))


class _Carried:
    """A background that is carried along with the camera's motion.

    shift: median motion of its corners in the last frame [px].
    """

    def __init__(self) -> None:
        self._last: Image | None = None
        self._corners: npt.NDArray[np.float32] | None = None
        self._mean: npt.NDArray[np.float32] | None = None
        self._age: npt.NDArray[np.float32] | None = None
        self._stale: npt.NDArray[np.float32] = np.zeros((1, 1), np.float32)
        self._past: npt.NDArray[np.float32] | None = None
        self._coming: npt.NDArray[np.float32] | None = None
        self._coming_age = 0
        self._past_age = _PAST_FRAMES
        self._motion: Floats | None = np.eye(3)
        self.shift = 0.0

    def follow(self, image: Image) -> None:
        """Find how the picture moved since the last one."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if self._last is not None and self._last.shape == grey.shape:
            self._motion = self._find(grey)
        self._last = grey

    def forget(self) -> None:
        """What the ground looks like; how the picture moves stays known."""
        self._mean = self._past = self._coming = None
        self._coming_age, self._past_age = 0, _PAST_FRAMES

    def _find(self, grey: Image) -> Floats | None:
        assert self._last is not None
        corners = cv2.goodFeaturesToTrack(self._last, _CORNERS, 0.01, max(grey.shape[1] // 50, 6))
        if corners is None or len(corners) < 12:
            self.shift = 0.0
            return np.eye(3)  # nothing to hold on to: a bare wall looks still
        corners = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
        guess = corners.copy()
        moved, good, _ = cv2.calcOpticalFlowPyrLK(self._last, grey, corners, guess, winSize=(17, 17), maxLevel=3)
        kept = good.ravel() == 1
        before, after = corners[kept].reshape(-1, 2), np.asarray(moved)[kept].reshape(-1, 2)
        if len(before) < 12:
            self.shift = math.nan
            return None
        motion, inliers = cv2.findHomography(before, after, cv2.RANSAC, 1.0)
        if motion is None or inliers is None or inliers.sum() < max(10, 0.3 * len(before)):
            self.shift = math.nan
            return None
        own = inliers.ravel() == 1
        cells = np.unique((before[own] * _SPREAD / np.array(grey.shape[::-1])).astype(int) @ np.array([1, _SPREAD]))
        if len(cells) < 0.4 * _SPREAD**2:
            self.shift = 0.0  # one thing's corners are not the camera's motion
            return np.eye(3)
        self.shift = float(np.median(np.linalg.norm(after[own] - before[own], axis=1)))
        return np.asarray(motion, dtype=np.float64)

    def residual(self, image: Image) -> Image | None:
        """What does not move with the ground (H, W) 0/255; None where the motion could not be found."""
        size = image.shape[1], image.shape[0]
        soft = cv2.GaussianBlur(image, (5, 5), 0).astype(np.float32)
        if self._mean is None or self._age is None or self._motion is None:
            self._mean, self._age = np.asarray(soft, dtype=np.float32), np.ones(image.shape[:2], np.float32)
            self._stale = np.zeros(image.shape[:2], np.float32)
            return None if self._motion is None else np.zeros(image.shape[:2], np.uint8)
        mean = cv2.warpPerspective(self._mean, self._motion, size, flags=cv2.INTER_LINEAR)
        age = cv2.warpPerspective(self._age, self._motion, size, flags=cv2.INTER_NEAREST)
        # An edge may lie a pixel off: a colour of the near neighbourhood is the background's too.
        box = np.ones((3, 3), np.uint8)
        high, low = cv2.dilate(mean, box), cv2.erode(mean, box)
        beyond = np.maximum(soft - high, low - soft).max(axis=2)
        # Ground that has just come into the picture may have had something on it.
        changed, settled = beyond > _DIFFERENT, age > self._past_age + 0.5
        different = changed & settled
        age[changed & ~settled] = 0.0
        known = age > 0.5
        rate = np.where(known, np.maximum(1.0 / (age + 1.0), _CARRY), 1.0).astype(np.float32)
        # What passes is not learnt; where something stood at first and left, the ground differs for long: begin there.
        stale = cv2.warpPerspective(self._stale, self._motion, size, flags=cv2.INTER_NEAREST)
        stale = np.where(different, stale + 1.0, 0.0).astype(np.float32)
        left_behind = self._left_behind(soft, different, size)
        different &= ~left_behind
        begin = (stale > _STALE_FRAMES) | left_behind
        rate[different] = 0.0
        rate[begin] = 1.0
        self._stale = np.where(begin, np.float32(0.0), stale).astype(np.float32)
        self._mean = np.asarray(mean + rate[..., None] * (soft - mean), dtype=np.float32)
        self._age = np.where(known, age + 1.0, 1.0).astype(np.float32)
        return np.where(different, np.uint8(255), np.uint8(0)).astype(np.uint8)

    def _left_behind(
        self, soft: npt.NDArray[np.float32], different: npt.NDArray[np.bool_], size: tuple[int, int]
    ) -> npt.NDArray[np.bool_]:
        """Where ground has come to light that something stood on at first (H, W).

        It differs from the background and stands, and so does all beside it: the even paint of a vehicle stands too,
        but not its edges.
        """
        none = np.zeros(different.shape, dtype=np.bool_)
        assert self._motion is not None
        if self._coming is None:
            self._coming = soft
            return none
        self._coming = np.asarray(cv2.warpPerspective(self._coming, self._motion, size), dtype=np.float32)
        self._coming_age += 1
        if self._past is not None:
            self._past_age += 1
            self._past = np.asarray(cv2.warpPerspective(self._past, self._motion, size), dtype=np.float32)
        past = self._past
        if self._coming_age >= _PAST_FRAMES:
            self._past, self._past_age = self._coming, self._coming_age
            self._coming, self._coming_age = soft, 0
        if past is None or not different.any():
            return none
        box = np.ones((3, 3), np.uint8)
        beyond = np.maximum(soft - cv2.dilate(past, box), cv2.erode(past, box) - soft).max(axis=2)
        moves = beyond > 0.5 * _DIFFERENT
        count, labels, stats, _ = cv2.connectedComponentsWithStats(
            (different & ~moves).astype(np.uint8), connectivity=8
        )
        out = none
        for index in range(1, count):
            x, y, w, h, area = (int(value) for value in stats[index])
            if area < _FLANK * _FLANK:
                continue
            left, right = moves[y : y + h, max(x - _FLANK, 0) : x], moves[y : y + h, x + w : x + w + _FLANK]
            above, below = moves[max(y - _FLANK, 0) : y, x : x + w], moves[y + h : y + h + _FLANK, x : x + w]
            if not any(_moves(side) for side in (left, right, above, below)):
                out |= labels == index
        return out


def _moves(side: npt.NDArray[np.bool_]) -> bool:
    """Whether enough beside a thing moves; beyond the picture's border nothing is known."""
    return side.size > 0 and float(side.mean()) > _FLANKED


def _travel(pictures: Sequence[Image]) -> float | None:
    """Median motion [px] between pictures of a longer time, of a fixed camera none; None where that can't be told."""
    moved = []
    for one, other in zip(pictures[:-1:4], pictures[1::4], strict=False):
        carried = _Carried()
        carried.follow(one)
        carried.follow(other)
        if math.isfinite(carried.shift):
            moved.append(carried.shift)
    return float(np.median(moved)) if len(moved) >= 3 else None
