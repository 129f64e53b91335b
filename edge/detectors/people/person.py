"""The observation node's eye: people before a fixed camera, with head, foot, representative point and clothes.

After section 2 and 3.1.1 of the paper on distributed human tracking: silhouettes against a model of the background,
the maximum of their distance transform as representative point, the head's top, the foot point, the torso's colour,
and the distance from head to foot as size. Silhouettes of several people are taken apart by what height people have
at that place and by where those who are followed were expected (``bodies``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from edge.detectors.moving.foreground import Foreground, Layers, ModelName, is_ghost
from edge.detectors.moving.gating import match_predictions
from edge.detectors.moving.tracklets import Follower, Following
from edge.detectors.people.height_model import Stature
from edge.detectors.people.segmentation import explain
from edge.detectors.people.silhouettes import Body, LonePeople
from protocols.geometry.types import Floats

Image = npt.NDArray[np.uint8]
_MOST_PIXELS = 700_000  # a larger picture is looked at smaller
_GHOST_AFTER_S = 0.5
_ASKED = 3  # sightings after which it is asked again whether somebody who has not moved is a ghost
_U_STD, _V_STD = 0.024, 0.105  # of the representative point, of the size, as rendered rooms have it
_FLOOR_STD = 0.6  # px
_LEAST_TOLD = 12.0  # px: who is expected smaller tells no height
_VAGUE = 0.12  # of the size: std of a place that is expected, above which it tells nothing
_BETWEEN = 0.12  # of the height: gaps across that are closed where they seem a shadow
_BELOW = 0.62  # of the height: the foot below the representative point that is expected
_COMES_S, _COMES, _ALIKE = (0.2, 1.0), (0.12, 1.0), 0.15
"""Who walks: seconds, way in heights, logarithm of the height between two sightings of him alone."""


@dataclass(frozen=True, slots=True)
class _Found:
    body: Body
    follower: Follower
    colour: Floats | None


class PersonDetector:
    """People before one fixed camera.

    model: of the background, mog2 or knn. fps: of the pictures, where their times are not told. sure_only: report
    only who has been seen several times and has moved; else everybody, with a lower score (see ``is_sure``).
    prefix: of the labels; those of several cameras must differ, as they do not know each other's people.
    """

    def __init__(
        self,
        model: ModelName = "mog2",
        fps: float = 25.0,
        *,
        sure_only: bool = True,
        prefix: str = "p",
        most_pixels: int = _MOST_PIXELS,
    ) -> None:
        self._fps = fps if fps > 0 and math.isfinite(fps) else 25.0
        self._foreground = Foreground(model, self._fps)
        self._following = Following(prefix, must_move=0.35)
        self._sure_only = sure_only
        self._most_pixels = most_pixels
        self._stature: Stature | None = None
        self._size = (0, 0)
        self._shrink = 1.0
        self._time = -1.0
        self._sure: set[str] = set()
        self._learns = True  # how tall people are
        self._lone: list[tuple[float, float, float, float]] = []  # time, foot and height of those alone lately

    @property
    def jolts(self) -> int:
        """How often the camera was pushed or the light changed at once, and everything was learnt anew."""
        return self._foreground.jolts

    def is_sure(self, label: str) -> bool:
        """Whether somebody who was reported under this label turned out to be one: seen again, and moving."""
        return label in self._sure

    def prime(self, pictures: Sequence[Image]) -> None:
        """Learn the background from pictures of a longer time, before the first one is looked at."""
        if pictures:
            self._fit_to(pictures[0])
            self._foreground.prime([self._smaller(picture) for picture in pictures])

    def rewind(self) -> None:
        """Begin again at an earlier time with what was learnt of the place, and nobody in the picture."""
        self._following.clear()
        self._lone = []
        self._time = -1.0
        if self._stature is not None:
            self._stature.settle()
            self._learns = not self._stature.known

    def detect(
        self, image: Image, time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """People in an image (H, W, 3) BGR taken at ``time_s`` on the camera's clock; the surest first.

        predictions: where the tracking expects its targets in this picture; whoever is found there carries its id.
        """
        self._fit_to(image)
        now = self._time + 1.0 / self._fps if time_s is None else time_s
        if not now > self._time:
            now = self._time + 1.0 / self._fps
        self._time = now
        small = self._smaller(image)
        followed = [one.box for one in self._following.all if one.sure and one.moved]
        layers = self._foreground.look(small, followed, now)
        if layers.fresh:
            self._following.clear()
            return []
        figure = clean(layers.figure, layers.shadow, self._typical())
        self._learn_from(predictions)
        found = self._explain(small, layers, figure, now)
        detections = [self._report(small, figure, one) for one in found if self._worth_telling(one)]
        detections.sort(key=lambda one: -one.score)
        return match_predictions(detections, predictions)

    def _worth_telling(self, one: _Found) -> bool:
        """Seen several times, and moving, or else of the height that people have here."""
        assert self._stature is not None
        if one.follower.sure and one.follower.moved:
            self._sure.add(one.follower.name)
            return True
        fits = self._stature.known and not one.body.cut and not one.follower.ghost
        return not self._sure_only or (one.follower.sure and fits)

    def _fit_to(self, image: Image) -> None:
        size = image.shape[1], image.shape[0]
        if size == self._size:
            return
        self._size = size
        self._shrink = min(1.0, math.sqrt(self._most_pixels / (size[0] * size[1])))
        small = round(size[0] * self._shrink), round(size[1] * self._shrink)
        self._stature = Stature(*small)
        self._following.clear()

    def _smaller(self, image: Image) -> Image:
        if self._shrink == 1.0:
            return image
        size = round(image.shape[1] * self._shrink), round(image.shape[0] * self._shrink)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _learn_from(self, predictions: Sequence[Prediction]) -> None:
        """How tall people are here, by those whom calibrated cameras follow: this one need not have seen anybody alone.

        Nobody is sought where he is predicted: a target that is none would find itself in whoever stands there.
        """
        assert self._stature is not None
        for one in predictions if self._learns else ():
            tall = one.size * self._shrink
            a, _, c = one.covariance
            if tall < _LEAST_TOLD or not math.sqrt(max(a, c)) < _VAGUE * one.size:
                continue
            foot = (one.v + 0.5) * self._shrink + _BELOW * tall
            self._stature.told((one.u + 0.5) * self._shrink, foot, tall, one.target)

    def _typical(self) -> float:
        heights = [one.box[3] for one in self._following.all if one.sure]
        return float(np.median(heights)) if heights else 0.25 * self._size[1] * self._shrink

    def _explain(self, image: Image, layers: Layers, figure: Image, now: float) -> list[_Found]:
        assert self._stature is not None
        following = self._following
        followers = list(following.all)
        boxes = [one.expected(now) for one in followers]
        moving = [(box, one.name) for box, one in zip(boxes, followers, strict=True) if one.sure and one.moved]
        alone = LonePeople(figure) if self._learns else None
        lone = [(now, *one) for one in alone.find()] if alone else []
        for _, u, v, tall in lone:
            # What has not moved may be the place that somebody has left.
            who = [name for box, name in moving if _stands(box, u, v, tall)]
            if who or self._comes(now, u, v, tall):
                self._stature.learn(u, v, tall, who[0] if who else "")
        if alone and self._foreground.young:
            guesses = alone.find(strict=False)
            tallest = max((one[2] for one in guesses), default=0.0)
            for u, v, tall in guesses:
                if tall > 0.5 * tallest:  # others may be pieces
                    self._stature.guess(u, v, tall)
        self._lone = [one for one in self._lone if now - one[0] < _COMES_S[1]] + lone
        bodies = explain(
            figure,
            layers.shadow,
            self._stature,
            boxes,
            image,
            [one.colour for one in followers],
            [one.stature for one in followers],
        )
        colours = [_torso(image, figure, body) for body in bodies]
        given = [followers[body.expected] if body.expected >= 0 else None for body in bodies]
        owners = following.assign([body.box for body in bodies], colours, now, given)
        found = []
        for body, owner, colour in zip(bodies, owners, colours, strict=True):
            if body.alone and not body.cut and self._stature.known:
                x, y, w, h = body.box
                usual = float(self._stature.at(np.array(x + 0.5 * w), np.array(y + h)))
                owner.measure(h / usual)
            if owner.time < now or owner.hits == 1:
                if owner.time < now:
                    trust = 0.9 if body.alone and not body.cut else 0.6 if body.seen > 0.6 else 0.35
                    owner.see(body.box, now, colour if body.seen > 0.6 else None, trust)
                found.append(_Found(body, owner, colour))
            if not owner.moved and owner.hits % _ASKED == 0:
                owner.ghost = is_ghost(image, layers.background, body.box, figure)
                if owner.ghost and now - owner.born > _GHOST_AFTER_S:
                    self._foreground.haunt(image, body.box)
        following.forget(now, (image.shape[1], image.shape[0]))
        return found

    def _comes(self, now: float, u: float, v: float, tall: float) -> bool:
        """Whether somebody alone whose foot is here stood somewhere else a moment ago, as tall."""
        for when, u2, v2, tall2 in self._lone:
            away = math.hypot(u - u2, v - v2) / tall
            if now - when >= _COMES_S[0] and _COMES[0] < away < _COMES[1] and abs(math.log(tall / tall2)) < _ALIKE:
                return True
        return False

    def _report(self, image: Image, figure: Image, one: _Found) -> Detection:
        body, follower = one.body, one.follower
        box = body.box
        features = silhouette_features(figure, box)
        scale = 1.0 / self._shrink
        head, foot = (features.head, features.foot)
        size = math.hypot(head[0] - foot[0], head[1] - foot[1]) * scale
        u_std = math.hypot(_U_STD * size, _FLOOR_STD)
        v_std = math.hypot(_V_STD * size, _FLOOR_STD)
        if not body.alone:
            u_std, v_std = 1.5 * u_std, 1.4 * v_std
        colour = one.colour  # this picture's: who was taken for another must not wear his clothes from then on
        score = 0.95 if body.alone else 0.4 + 0.5 * min(body.fill, 1.0) * body.seen
        if not (follower.sure and follower.moved):
            score *= 0.5

        def back(place: tuple[float, float]) -> tuple[float, float]:
            return (place[0] + 0.5) * scale - 0.5, (place[1] + 0.5) * scale - 0.5

        u, v = back(features.middle)
        return Detection(
            u=u,
            v=v,
            size=size,
            score=float(np.clip(score, 0.0, 1.0)),
            label=follower.name,
            colour=None
            if colour is None
            else (round(float(colour[2])), round(float(colour[1])), round(float(colour[0]))),
            covariance=(u_std**2, 0.0, v_std**2),
            kind="person",
            head=back(head),
            foot=back(foot),
            box=(box[0] * scale, box[1] * scale, box[2] * scale, box[3] * scale),
        )


@dataclass(frozen=True, slots=True)
class Features:
    """Of one silhouette, pixels (u, v): the representative point, the head's top, the foot point."""

    middle: tuple[float, float]
    head: tuple[float, float]
    foot: tuple[float, float]


def silhouette_features(figure: Image, box: tuple[float, float, float, float]) -> Features:
    """The paper's features of the silhouette (H, W) 0/255 in a box x, y, w, h [px] (section 3.1.1, fig. 4 and 5).

    Where a part of the box holds no silhouette, the box itself tells.
    """
    x, y, w, h = box
    left, top = max(math.floor(x), 0), max(math.floor(y), 0)
    part = figure[top : max(math.ceil(y + h), 0), left : max(math.ceil(x + w), 0)]
    whole = Features((x + 0.5 * w - 0.5, y + 0.35 * h), (x + 0.5 * w - 0.5, y - 0.5), (x + 0.5 * w - 0.5, y + h - 0.5))
    if part.size == 0 or not part.any():
        return whole
    # A frame of zeros, so that the picture's border and a neighbour's part are borders too.
    framed = cv2.copyMakeBorder(part, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    distance = cv2.distanceTransform(framed, cv2.DIST_L2, 5)[1:-1, 1:-1]
    peak = float(distance.max())
    rows, columns = np.nonzero(distance >= peak - 0.25)
    middle = left + float(columns.mean()), top + float(rows.mean())
    upper, lower = math.floor(y + 0.1 * h) + 1 - top, math.ceil(y + 0.7 * h) - top
    head_u, foot_u = _middle(part[: max(upper, 0)]), _middle(part[max(lower, 0) :])
    head_u = middle[0] if head_u is None else left + head_u
    foot_u = middle[0] if foot_u is None else left + foot_u
    return Features(middle, (head_u, y - 0.5), (foot_u, y + h - 0.5))


def _middle(part: Image) -> float | None:
    """The mean column of a silhouette (h, w); None of none."""
    counts = np.count_nonzero(part, axis=0)
    total = int(counts.sum())
    return float(counts @ np.arange(len(counts))) / total if total else None


def _stands(box: tuple[float, float, float, float], u: float, v: float, tall: float) -> bool:
    """Whether a foot point and height [px] are about those of a box x, y, w, h."""
    x, y, w, h = box
    near = abs(u - x - 0.5 * w) < 0.3 * h and abs(v - y - h) < 0.3 * h
    return near and 0.6 * h < tall < 1.6 * h


def clean(figure: Image, shadow: Image, typical: float) -> Image:
    """A silhouette picture (H, W) 0/255 without specks, and with a body's parts joined.

    typical: height [px] of people. A belt of the wall's colour cuts nobody in two.

    What seems a shadow between two parts of a body side by side is of the body.
    """
    calm = cv2.medianBlur(figure, 3)
    wide = int(np.clip(_BETWEEN * typical, 3, 41)) | 1
    across = cv2.morphologyEx(calm, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, (wide, 1)))
    calm = cv2.bitwise_or(calm, cv2.bitwise_and(across, shadow))
    tall = int(np.clip(0.1 * typical, 3, 15)) | 1
    joined = cv2.morphologyEx(calm, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, (3, tall)))
    return np.asarray(joined, dtype=np.uint8)


def _torso(image: Image, figure: Image, body: Body) -> Floats | None:
    """Mean colour (3,) BGR of the clothes between shoulders and hips; None where none of it is seen."""
    x, y, w, h = body.box
    rows = slice(max(int(y + 0.2 * h), 0), max(int(y + 0.5 * h) + 1, 0))
    columns = slice(max(int(x + 0.25 * w), 0), max(int(x + 0.75 * w) + 1, 0))
    mask = figure[rows, columns]
    if mask.size == 0 or cv2.countNonZero(mask) < 4:
        return None
    return np.array(cv2.mean(np.ascontiguousarray(image[rows, columns]), np.ascontiguousarray(mask))[:3])
