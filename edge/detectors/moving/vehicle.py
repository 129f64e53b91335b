"""Moving vehicles, from a fixed or a moving camera.

Fixed: silhouettes from a background model (``foreground``). Moving: the background is warped from frame to frame by the
homography of image corners, and differences from it are independent motion. The ground is assumed to be planar, so that
tall objects near a low-flying camera show at their edges.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import CUT_VEHICLE_STD, Detection, Prediction
from edge.detectors.moving.camera_motion import ImageMotion
from edge.detectors.moving.foreground import BackgroundSubtractor, SubtractorName
from edge.detectors.moving.silhouette_detector import SilhouetteDetector
from edge.detectors.moving.tracklets import Box, ImageTracklet, match_predictions
from protocols.geometry.types import Floats, Image

_MAX_PIXELS = 500_000  # larger images are downscaled to this
_MIN_AREA_SHARE = 0.00025  # over the image area: smaller silhouettes are ignored
_MOVING_SHIFT_PX = 0.35  # per frame: above it for a while, the camera moves
_MOVING_TRAVEL_PX = 3.0  # between images seconds apart
_DECISION_FRAMES = 8  # frames
_MAX_GROWTH = 2.5  # factor: a silhouette this much larger than a vehicle contains more than that
_DIFFERENCE_STEP = 26  # 8-bit steps
_STALE_FRAMES = 20  # after which what differs becomes background again
_LEARNING_RATE = 0.12  # smallest weight of a frame in the compensated background
_REFERENCE_FRAMES = 2  # frames, up to twice as many, without change after which something is static
# px beside a static region, and the share of moving ones among them that makes it part of a vehicle
_FLANK_PX, _FLANK_MOVING_SHARE = 5, 0.25
_POSITION_STD, _FLOOR_STD = 0.1, 1.0  # over the size, measured on a rendered town seen from above with shadows; px


class VehicleDetector(SilhouetteDetector):
    """Detects moving vehicles.

    model, fps: as for ``PersonDetector``. moving: whether the camera moves; None = to be decided. confirmed_only:
    report only what has been detected several times and has moved. prefix: of the labels.
    """

    def __init__(
        self,
        model: SubtractorName = "mog2",
        fps: float = 25.0,
        *,
        confirmed_only: bool = True,
        prefix: str = "t",
        moving: bool | None = None,
    ) -> None:
        super().__init__(model, fps, prefix, 1.0, confirmed_only, _MAX_PIXELS)
        self._motion_given = moving
        self._shifts: deque[float] = deque(maxlen=_DECISION_FRAMES)
        self.moving = bool(moving)
        self._compensated = _CompensatedBackground()

    def initialise(self, images: Sequence[Image]) -> None:
        """Learn a fixed camera's background from images over a longer time; no effect for a moving camera."""
        if not images or self._motion_given:
            return
        self._set_size(images[0])
        small = [self._downscaled(image) for image in images]
        if self._motion_given is None:
            travel = _camera_shift(small)
            if travel is None:
                return  # decided at the first frames
            self._motion_given = self.moving = travel > _MOVING_TRAVEL_PX
        if self.moving:
            return
        self._foreground.initialise(small)

    def rewind(self) -> None:
        """Restart at an earlier time with the learnt background, and without tracks."""
        self._tracker.clear()
        self._compensated = _CompensatedBackground()
        self._time = -1.0

    def detect(
        self, image: Image, time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """Vehicles in an image (H, W, 3) BGR taken at ``time_s``; highest score first."""
        self._set_size(image)
        now = self._advance(time_s)
        small = self._downscaled(image)
        if self._motion_given is None or self.moving:
            self._decide_camera_motion(small)
        foreground = self._foreground_mask(small, now)
        if foreground is None:
            self._tracker.clear()
            return []
        found = self._boxes(foreground, now)
        owners = self._tracker.assign([box for box, _ in found], [None] * len(found), now, [one for _, one in found])
        result = []
        for (box, _), owner in zip(found, owners, strict=True):
            if owner.time < now:
                owner.update(box, now, None, 0.7)
            if owner.confirmed and owner.moved:
                self._confirmed.add(owner.name)
            elif self._confirmed_only:
                continue
            result.append(self._report(small, foreground, owner))
        self._tracker.prune(now, (small.shape[1], small.shape[0]))
        result.sort(key=lambda one: -one.score)
        return match_predictions(result, predictions)

    def _set_size(self, image: Image) -> None:
        if self._resize(image):
            self._compensated = _CompensatedBackground()

    def _decide_camera_motion(self, image: Image) -> None:
        self._compensated.image_motion.estimate(image)
        if math.isfinite(self._compensated.image_motion.shift):
            self._shifts.append(self._compensated.image_motion.shift)
        if self._motion_given is not None or len(self._shifts) < _DECISION_FRAMES:
            return
        typical = float(np.median(self._shifts))
        if not self.moving and typical > _MOVING_SHIFT_PX:
            self.moving = True
        elif self.moving and typical < 0.3 * _MOVING_SHIFT_PX and max(self._shifts) < _MOVING_SHIFT_PX:
            self.moving = False
            self._foreground = BackgroundSubtractor(self._model, self._fps)

    def _foreground_mask(self, image: Image, now: float) -> Image | None:
        """Silhouettes (H, W) 0/255; None while the background is unknown."""
        if self.moving:
            raw = self._compensated.moving_pixels(image)
        else:
            if self._motion_given is None and len(self._shifts) < _DECISION_FRAMES:
                self._compensated.moving_pixels(image)  # in case the camera turns out to move
            else:
                self._compensated.forget()
            tracked_boxes = [one.box for one in self._tracker.tracklets if one.confirmed and one.moved]
            masks = self._foreground.segment(image, tracked_boxes, now)
            raw = None if masks.initialising else masks.foreground
        if raw is None:
            return None
        calm = cv2.medianBlur(raw, 5)
        reach = max(int(0.012 * max(image.shape[:2])), 3) | 1
        joined = cv2.morphologyEx(calm, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
        return np.asarray(joined, dtype=np.uint8)

    def _boxes(self, foreground: Image, now: float) -> list[tuple[Box, ImageTracklet | None]]:
        """Boxes and their tracklets: fragments inside the predicted box of one vehicle are joined."""
        count, _, stats, centres = cv2.connectedComponentsWithStats(foreground, connectivity=8)
        least = _MIN_AREA_SHARE * foreground.size
        pieces = [index for index in range(1, count) if stats[index, cv2.CC_STAT_AREA] >= 0.4 * least]
        groups: dict[int, list[int]] = {}
        tracklets = sorted(self._tracker.tracklets, key=lambda one: -one.hits)
        for index in pieces:
            u, v = centres[index]
            for which, one in enumerate(tracklets):
                x, y, w, h = one.predicted_box(now)
                near = x - 0.1 * w <= u <= x + 1.1 * w and y - 0.1 * h <= v <= y + 1.1 * h
                if near and _growth(one.box, stats[index]) < _MAX_GROWTH:
                    groups.setdefault(which, []).append(index)
                    break
            else:
                groups.setdefault(-index, []).append(index)
        found: list[tuple[Box, ImageTracklet | None]] = []
        for which, members in groups.items():
            if sum(int(stats[index, cv2.CC_STAT_AREA]) for index in members) < least:
                continue
            low = stats[members, :2].min(axis=0)
            high = (stats[members, :2] + stats[members, 2:4]).max(axis=0)
            box = float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])
            found.append((box, tracklets[which] if which >= 0 else None))
        return found

    def _report(self, image: Image, foreground: Image, one: ImageTracklet) -> Detection:
        x, y, w, h = one.box
        scale = 1.0 / self._scale
        size = math.sqrt(max(w * h, 1.0)) * scale
        std = math.hypot(_POSITION_STD * size, _FLOOR_STD)
        u_std = max(std, CUT_VEHICLE_STD * h * scale) if x <= 0 or x + w >= image.shape[1] else std
        v_std = max(std, CUT_VEHICLE_STD * w * scale) if y <= 0 or y + h >= image.shape[0] else std
        rows = slice(max(int(y), 0), max(int(y + h) + 1, 0))
        columns = slice(max(int(x), 0), max(int(x + w) + 1, 0))
        part, mask = image[rows, columns], foreground[rows, columns]
        colour = None
        if mask.size and cv2.countNonZero(mask):
            blue, green, red, _ = cv2.mean(np.ascontiguousarray(part), np.ascontiguousarray(mask))
            colour = round(red), round(green), round(blue)
        return Detection(
            u=(x + 0.5 * w) * scale - 0.5,
            v=(y + 0.5 * h) * scale - 0.5,
            size=size,
            score=0.9 if one.confirmed and one.moved else 0.4,
            label=one.name,
            colour=colour,
            covariance=(u_std**2, 0.0, v_std**2),
            kind="vehicle",
            box=(x * scale, y * scale, w * scale, h * scale),
        )


def _growth(box: Box, piece: npt.NDArray[np.int32]) -> float:
    """Growth of a box that includes a silhouette (x, y, w, h, …): factor of the longer side."""
    return max(float(piece[2]) / max(box[2], 1.0), float(piece[3]) / max(box[3], 1.0))


class _CompensatedBackground:
    """A background that is warped along with the camera's motion."""

    def __init__(self) -> None:
        self.image_motion = ImageMotion()
        self._mean: npt.NDArray[np.float32] | None = None
        self._age: npt.NDArray[np.float32] | None = None
        self._stale: npt.NDArray[np.float32] = np.zeros((1, 1), np.float32)
        self._reference: npt.NDArray[np.float32] | None = None
        self._next_reference: npt.NDArray[np.float32] | None = None
        self._next_reference_age = 0
        self._reference_age = _REFERENCE_FRAMES

    def forget(self) -> None:
        """Forget the background; the image motion stays known."""
        self._mean = self._reference = self._next_reference = None
        self._next_reference_age, self._reference_age = 0, _REFERENCE_FRAMES

    def moving_pixels(self, image: Image) -> Image | None:
        """Pixels (H, W) 0/255 that do not move with the ground; None where the homography could not be estimated."""
        motion = self.image_motion.motion
        size = image.shape[1], image.shape[0]
        soft = cv2.GaussianBlur(image, (5, 5), 0).astype(np.float32)
        if self._mean is None or self._age is None or motion is None:
            self._mean, self._age = np.asarray(soft, dtype=np.float32), np.ones(image.shape[:2], np.float32)
            self._stale = np.zeros(image.shape[:2], np.float32)
            return None if motion is None else np.zeros(image.shape[:2], np.uint8)
        mean = cv2.warpPerspective(self._mean, motion, size, flags=cv2.INTER_LINEAR)
        age = cv2.warpPerspective(self._age, motion, size, flags=cv2.INTER_NEAREST)
        # Edges may be a pixel off: colours of the 3x3 neighbourhood belong to the background too.
        box = np.ones((3, 3), np.uint8)
        high, low = cv2.dilate(mean, box), cv2.erode(mean, box)
        beyond = np.maximum(soft - high, low - soft).max(axis=2)
        # Ground that has just entered the image may have had an object on it.
        changed, mature = beyond > _DIFFERENCE_STEP, age > self._reference_age + 0.5
        different = changed & mature
        age[changed & ~mature] = 0.0
        known = age > 0.5
        rate = np.where(known, np.maximum(1.0 / (age + 1.0), _LEARNING_RATE), 1.0).astype(np.float32)
        # Passing objects are not learnt. Where an object of the first frame has left, the ground differs for long:
        # restart there.
        stale = cv2.warpPerspective(self._stale, motion, size, flags=cv2.INTER_NEAREST)
        stale = np.where(different, stale + 1.0, 0.0).astype(np.float32)
        uncovered = self._uncovered_ground(soft, different, size, motion)
        different &= ~uncovered
        begin = (stale > _STALE_FRAMES) | uncovered
        rate[different] = 0.0
        rate[begin] = 1.0
        self._stale = np.where(begin, np.float32(0.0), stale).astype(np.float32)
        self._mean = np.asarray(mean + rate[..., None] * (soft - mean), dtype=np.float32)
        self._age = np.where(known, age + 1.0, 1.0).astype(np.float32)
        return np.where(different, np.uint8(255), np.uint8(0)).astype(np.uint8)

    def _uncovered_ground(
        self, soft: npt.NDArray[np.float32], different: npt.NDArray[np.bool_], size: tuple[int, int], motion: Floats
    ) -> npt.NDArray[np.bool_]:
        """Ground (H, W) that was uncovered when an object of the first frame left.

        It differs from the background and is static, and so are the pixels beside it: the uniform paint of a vehicle is
        static too, but not its edges.
        """
        none = np.zeros(different.shape, dtype=np.bool_)
        if self._next_reference is None:
            self._next_reference = soft
            return none
        self._next_reference = np.asarray(cv2.warpPerspective(self._next_reference, motion, size), dtype=np.float32)
        self._next_reference_age += 1
        if self._reference is not None:
            self._reference_age += 1
            self._reference = np.asarray(cv2.warpPerspective(self._reference, motion, size), dtype=np.float32)
        reference = self._reference
        if self._next_reference_age >= _REFERENCE_FRAMES:
            self._reference, self._reference_age = self._next_reference, self._next_reference_age
            self._next_reference, self._next_reference_age = soft, 0
        if reference is None or not different.any():
            return none
        box = np.ones((3, 3), np.uint8)
        beyond = np.maximum(soft - cv2.dilate(reference, box), cv2.erode(reference, box) - soft).max(axis=2)
        moves = beyond > 0.5 * _DIFFERENCE_STEP
        count, labels, stats, _ = cv2.connectedComponentsWithStats(
            (different & ~moves).astype(np.uint8), connectivity=8
        )
        out = none
        for index in range(1, count):
            x, y, w, h, area = (int(value) for value in stats[index])
            if area < _FLANK_PX * _FLANK_PX:
                continue
            left, right = moves[y : y + h, max(x - _FLANK_PX, 0) : x], moves[y : y + h, x + w : x + w + _FLANK_PX]
            above, below = moves[max(y - _FLANK_PX, 0) : y, x : x + w], moves[y + h : y + h + _FLANK_PX, x : x + w]
            if not any(_is_moving(side) for side in (left, right, above, below)):
                out |= labels == index
        return out


def _is_moving(side: npt.NDArray[np.bool_]) -> bool:
    """Whether enough pixels beside a region move; unknown, hence False, beyond the image border."""
    return side.size > 0 and float(side.mean()) > _FLANK_MOVING_SHARE


def _camera_shift(images: Sequence[Image]) -> float | None:
    """Median motion [px] between images over a longer time, 0 for a fixed camera; None where it is not observable."""
    moved = []
    for one, other in zip(images[:-1:4], images[1::4], strict=False):
        motion = ImageMotion()
        motion.estimate(one)
        motion.estimate(other)
        if math.isfinite(motion.shift):
            moved.append(motion.shift)
    return float(np.median(moved)) if len(moved) >= 3 else None
