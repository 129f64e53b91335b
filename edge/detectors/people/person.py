"""Detection of people before a fixed camera, with head, foot point, representative point and clothing colour.

After sections 2 and 3.1.1 of the paper on distributed human tracking: silhouettes from a background model, the maximum
of their distance transform as representative point, the top of the head, the foot point, the torso's colour, and the
distance from head to foot as size. Silhouettes of several people are segmented by the heights of people at that place
and by the predictions of tracklets (``segmentation``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edge.detectors.base import Detection, Prediction
from edge.detectors.moving.camera_motion import CameraTravel
from edge.detectors.moving.foreground import BackgroundSubtractor, ForegroundMasks, SubtractorName
from edge.detectors.moving.shadows import is_ghost
from edge.detectors.moving.silhouette_detector import SilhouetteDetector
from edge.detectors.moving.tracklets import ImageTracklet, match_predictions
from edge.detectors.people.height_model import HeightModel
from edge.detectors.people.segmentation import segment_people
from edge.detectors.people.silhouettes import BULK, IsolatedPeople, PersonSilhouette
from protocols.geometry.types import Floats, Image

_MAX_PIXELS = 700_000  # larger images are downscaled to this
_GHOST_AFTER_S = 0.5  # s: age; sooner, people whom the test mistakes go too, and later, ghosts stay longer
_GHOST_CHECK_HITS = 3  # detections after which a tracklet that has not moved is tested again for being a ghost
_U_STD, _V_STD = 0.024, 0.105  # std of the representative point over the size, measured on rendered rooms
_FLOOR_STD = 0.6  # px
_MIN_PREDICTED_PX = 12.0  # px: smaller predictions do not update the height model
_MAX_PREDICTED_STD = 0.12  # over the size: largest std of a predicted place that updates the height model
_FRAGMENT_HEIGHT = 0.5  # over the tallest silhouette's: lower ones may be fragments
_GAP_WIDTH = 0.12  # over the height: width of gaps that are closed where they seem a shadow
_FOOT_BELOW = 0.62  # over the height: distance of the foot point below the predicted representative point


@dataclass(frozen=True, slots=True)
class _TrackedSilhouette:
    body: PersonSilhouette
    tracklet: ImageTracklet
    colour: Floats | None


class PersonDetector(SilhouetteDetector):
    """Detects people before one fixed camera.

    model: of the background, mog2 or knn. fps: frame rate where images have no times. confirmed_only: report only
    people who have been detected several times and have moved; otherwise all, with a lower score (see
    ``is_confirmed``). prefix: of the labels; those of several cameras must differ, because cameras do not know each
    other's people.
    """

    def __init__(
        self,
        model: SubtractorName = "mog2",
        fps: float = 25.0,
        *,
        confirmed_only: bool = True,
        prefix: str = "p",
    ) -> None:
        super().__init__(model, fps, prefix, 0.35, confirmed_only, _MAX_PIXELS)
        self._travel = CameraTravel()
        self._moving = False
        self._height_model: HeightModel | None = None
        self._learns_heights = True  # whether the height model is updated

    @property
    def moving_share(self) -> float:
        """Share (0..1) of the time in which the camera moved; people are not detected then."""
        return self._travel.share

    def initialise(self, images: Sequence[Image]) -> None:
        """Learn the background from images spread over a longer time, before the first detection."""
        if images:
            self._set_size(images[0])
            self._foreground.initialise([self._downscaled(image) for image in images])

    def rewind(self) -> None:
        """Restart at an earlier time with the learnt background and heights, and without tracks."""
        self._tracker.clear()
        self._travel = CameraTravel()
        self._time = -1.0
        if self._height_model is not None:
            self._height_model.refit()
            self._learns_heights = not self._height_model.is_fitted

    def detect(
        self, image: Image, time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """People in an image (H, W, 3) BGR taken at ``time_s`` on the camera's clock; highest score first.

        predictions: of tracked targets in this image; detections that match one carry its id.
        """
        self._set_size(image)
        now = self._advance(time_s)
        small = self._downscaled(image)
        if self._travel.moves(small, now):
            self._tracker.clear()
            self._moving = True
            return []
        if self._moving:
            self._moving = False
            self._foreground = BackgroundSubtractor(self._model, self._fps)
        tracked_boxes = [one.box for one in self._tracker.tracklets if one.confirmed and one.moved]
        masks = self._foreground.segment(small, tracked_boxes, now)
        if masks.initialising:
            self._tracker.clear()
            return []
        foreground = clean_silhouettes(masks.foreground, masks.shadow, self._median_height())
        self._learn_heights(predictions)
        found = self._segment_people(small, masks, foreground, now)
        detections = [self._report(small, foreground, one) for one in found if self._is_reportable(one)]
        detections.sort(key=lambda one: -one.score)
        return match_predictions(detections, predictions)

    def _is_reportable(self, one: _TrackedSilhouette) -> bool:
        """Whether it has been confirmed, or else has been detected several times with the height of people here."""
        assert self._height_model is not None
        if one.tracklet.confirmed and one.tracklet.moved:
            self._confirmed.add(one.tracklet.name)
            return True
        fits = self._height_model.is_fitted and not one.body.truncated and not one.tracklet.ghost
        return not self._confirmed_only or (one.tracklet.confirmed and fits)

    def _set_size(self, image: Image) -> None:
        if self._resize(image):
            self._height_model = HeightModel(*(round(side * self._scale) for side in self._size))

    def _learn_heights(self, predictions: Sequence[Prediction]) -> None:
        """Update the height model from targets tracked by calibrated cameras: this camera need not have seen isolated
        people.

        Predictions are not used for segmentation: a false track would confirm itself by any person at that place.
        """
        assert self._height_model is not None
        for one in predictions if self._learns_heights else ():
            height = one.size * self._scale
            a, _, c = one.covariance
            if height < _MIN_PREDICTED_PX or not math.sqrt(max(a, c)) < _MAX_PREDICTED_STD * one.size:
                continue
            foot = (one.v + 0.5) * self._scale + _FOOT_BELOW * height
            self._height_model.add_predicted((one.u + 0.5) * self._scale, foot, height, one.target)

    def _median_height(self) -> float:
        heights = [one.box[3] for one in self._tracker.tracklets if one.confirmed]
        return float(np.median(heights)) if heights else 0.25 * self._size[1] * self._scale

    def _segment_people(
        self, image: Image, masks: ForegroundMasks, foreground: Image, now: float
    ) -> list[_TrackedSilhouette]:
        assert self._height_model is not None
        tracker = self._tracker
        tracklets = list(tracker.tracklets)
        boxes = [one.predicted_box(now) for one in tracklets]
        moving = [(box, one.name) for box, one in zip(boxes, tracklets, strict=True) if one.confirmed and one.moved]
        fitted = self._height_model.is_fitted
        for u, v, height in IsolatedPeople(foreground).find() if self._learns_heights else ():
            # A static silhouette may be a ghost.
            who = next((name for box, name in moving if _matches_box(box, u, v, height)), None)
            if who is not None:
                self._height_model.add(u, v, height, who)
        bodies = segment_people(
            foreground,
            masks.shadow,
            self._height_model,
            boxes,
            image,
            [one.colour for one in tracklets],
            [one.relative_height for one in tracklets],
        )
        colours = [_torso_colour(image, foreground, body) for body in bodies]
        preassigned = [tracklets[body.expected] if body.expected >= 0 else None for body in bodies]
        assigned = tracker.assign([body.box for body in bodies], colours, now, preassigned)
        found = []
        tallest = max((body.box[3] for body in bodies), default=0.0)
        for body, tracklet, colour in zip(bodies, assigned, colours, strict=True):
            x, y, w, h = body.box
            if body.isolated and not body.truncated and self._height_model.is_fitted:
                model_height = float(self._height_model.heights_at(np.array(x + 0.5 * w), np.array(y + h)))
                tracklet.update_height(h / model_height)
            # While the background is learnt, a person and the ghost of the starting place are one broader silhouette.
            moves = tracklet.moved and body.fill * w < BULK * h
            learns = self._foreground.bootstrapping or (moves and not fitted)
            if learns and h > _FRAGMENT_HEIGHT * tallest and not body.truncated:
                self._height_model.add_tentative(x + 0.5 * w, y + h, h)
            if tracklet.time < now or tracklet.hits == 1:
                if tracklet.time < now:
                    gain = 0.9 if body.isolated and not body.truncated else 0.6 if body.visible > 0.6 else 0.35
                    tracklet.update(body.box, now, colour if body.visible > 0.6 else None, gain)
                found.append(_TrackedSilhouette(body, tracklet, colour))
            if not tracklet.moved and tracklet.hits % _GHOST_CHECK_HITS == 0:
                tracklet.ghost = is_ghost(image, masks.background, body.box, foreground)
                if tracklet.ghost and now - tracklet.born > _GHOST_AFTER_S:
                    self._foreground.absorb_ghost(image, body.box)
        tracker.prune(now, (image.shape[1], image.shape[0]))
        return found

    def _report(self, image: Image, foreground: Image, one: _TrackedSilhouette) -> Detection:
        body, tracklet = one.body, one.tracklet
        box = body.box
        features = silhouette_features(foreground, box)
        scale = 1.0 / self._scale
        head, foot = (features.head, features.foot)
        size = math.hypot(head[0] - foot[0], head[1] - foot[1]) * scale
        u_std = math.hypot(_U_STD * size, _FLOOR_STD)
        v_std = math.hypot(_V_STD * size, _FLOOR_STD)
        if not body.isolated:
            u_std, v_std = 1.5 * u_std, 1.4 * v_std
        colour = one.colour  # of this image: after an identity switch the colour is right at once
        score = 0.95 if body.isolated else 0.4 + 0.5 * min(body.fill, 1.0) * body.visible
        if not (tracklet.confirmed and tracklet.moved):
            score *= 0.5

        def back(place: tuple[float, float]) -> tuple[float, float]:
            return (place[0] + 0.5) * scale - 0.5, (place[1] + 0.5) * scale - 0.5

        u, v = back(features.middle)
        return Detection(
            u=u,
            v=v,
            size=size,
            score=float(np.clip(score, 0.0, 1.0)),
            label=tracklet.name,
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
class SilhouetteFeatures:
    """Features of one silhouette, pixels (u, v): the representative point, the top of the head, the foot point."""

    middle: tuple[float, float]
    head: tuple[float, float]
    foot: tuple[float, float]


def silhouette_features(foreground: Image, box: tuple[float, float, float, float]) -> SilhouetteFeatures:
    """The paper's features of the silhouette (H, W) 0/255 in a box x, y, w, h [px] (section 3.1.1, fig. 4 and 5).

    Where a part of the box contains no silhouette, the feature is taken from the box.
    """
    x, y, w, h = box
    left, top = max(math.floor(x), 0), max(math.floor(y), 0)
    part = foreground[top : max(math.ceil(y + h), 0), left : max(math.ceil(x + w), 0)]
    whole = SilhouetteFeatures(
        (x + 0.5 * w - 0.5, y + 0.35 * h), (x + 0.5 * w - 0.5, y - 0.5), (x + 0.5 * w - 0.5, y + h - 0.5)
    )
    if part.size == 0 or not part.any():
        return whole
    # A border of zeros, so that the image border and a neighbour's part count as background.
    framed = cv2.copyMakeBorder(part, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    distance = cv2.distanceTransform(framed, cv2.DIST_L2, 5)[1:-1, 1:-1]
    peak = float(distance.max())
    rows, columns = np.nonzero(distance >= peak - 0.25)
    middle = left + float(columns.mean()), top + float(rows.mean())
    upper, lower = math.floor(y + 0.1 * h) + 1 - top, math.ceil(y + 0.7 * h) - top
    head_u, foot_u = _middle(part[: max(upper, 0)]), _middle(part[max(lower, 0) :])
    head_u = middle[0] if head_u is None else left + head_u
    foot_u = middle[0] if foot_u is None else left + foot_u
    return SilhouetteFeatures(middle, (head_u, y - 0.5), (foot_u, y + h - 0.5))


def _middle(part: Image) -> float | None:
    """Mean column of a silhouette (h, w); None where it is empty."""
    counts = np.count_nonzero(part, axis=0)
    total = int(counts.sum())
    return float(counts @ np.arange(len(counts))) / total if total else None


def _matches_box(box: tuple[float, float, float, float], u: float, v: float, height: float) -> bool:
    """Whether a foot point and height [px] agree with a box x, y, w, h."""
    x, y, w, h = box
    near = abs(u - x - 0.5 * w) < 0.3 * h and abs(v - y - h) < 0.3 * h
    return near and 0.6 * h < height < 1.6 * h


def clean_silhouettes(foreground: Image, shadow: Image, typical: float) -> Image:
    """A foreground mask (H, W) 0/255 without specks, and with the parts of a body joined.

    typical: height [px] of people. A belt of the wall's colour must not split a person. Shadow pixels between two parts
    of a body side by side belong to the body.
    """
    calm = cv2.medianBlur(foreground, 3)
    wide = int(np.clip(_GAP_WIDTH * typical, 3, 41)) | 1
    across = cv2.morphologyEx(calm, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, (wide, 1)))
    calm = cv2.bitwise_or(calm, cv2.bitwise_and(across, shadow))
    height = int(np.clip(0.1 * typical, 3, 15)) | 1
    joined = cv2.morphologyEx(calm, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, (3, height)))
    return np.asarray(joined, dtype=np.uint8)


def _torso_colour(image: Image, foreground: Image, body: PersonSilhouette) -> Floats | None:
    """Mean colour (3,) BGR of the clothes between shoulders and hips; None where they are not visible."""
    x, y, w, h = body.box
    rows = slice(max(int(y + 0.2 * h), 0), max(int(y + 0.5 * h) + 1, 0))
    columns = slice(max(int(x + 0.25 * w), 0), max(int(x + 0.75 * w) + 1, 0))
    mask = foreground[rows, columns]
    if mask.size == 0 or cv2.countNonZero(mask) < 4:
        return None
    return np.array(cv2.mean(np.ascontiguousarray(image[rows, columns]), np.ascontiguousarray(mask))[:3])
