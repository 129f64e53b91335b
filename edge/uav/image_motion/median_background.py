"""Where a target has gone that crept out of its first box, while what is tracked there is the ground that it left.

A target that moves by a fraction of its length a second changes its box from image to image by less than templates
adapt to. Over seconds it comes apart: the median over time of the stabilised surroundings is the background; what was
in the first box differs from it, and what is there now does not. The way out of the first box is found by
track-before-detect (dynamic programming: Barniv, IEEE Transactions on Aerospace and Electronic Systems 21, 1985): the
log likelihood ratios of what differs are added up along the best way of bounded speed.
"""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.correlation.oriented_box import OrientedBox, crop
from edge.uav.image_motion.residual import SURELY, densities, difference, ratio_to_median, share_moving
from protocols.geometry.types import Floats, Image

_EVERY_S, _UNTIL_S, _IMAGES = 0.2, 3.2, 6  # between two images, and of the last look; least number of images
_SIDE_PX, _BOX_PX, _REGION = 12, 9, 5  # of a box side in the resampled region, of 0.8; sides of the region, in sides
_LEAST_PX = 6.0  # side of a box: half a pixel of stabilisation error is then one sample, which differences allow for
_FASTEST = 1.0  # in box sides a second: what is faster comes apart at once
_BOUNDS = (-2.0, 3.0)  # of the log likelihood ratio in one image: it may be covered in some
# Mean log likelihood ratio of a way, and of its first and its last place. In real windows the mean is -2.0 to 0.1 for
# what stands and 1.6 to 2.9 for what creeps; on rendered water ends of 1.3 are something else that passes.
_LEAST = 1.5
_STAYED = 0.35  # distance of a box from its first place up to which it stands, in sides: slipped ones 0.05 to 0.3


class MedianBackground:
    """Of the surroundings of the target that the first ``image`` shows in ``box``."""

    def __init__(self, image: Image, box: OrientedBox) -> None:
        self._times: list[float] = []
        self._images: list[Image] = []
        self._ended = not self._keep(image, box, 0.0) or bool(box.sides.min() < _LEAST_PX)

    def _keep(self, image: Image, scene: OrientedBox, seconds: float) -> bool:
        """Keep the region about the first place; whether all of it is in the image."""
        region = scene.sized(scene.sides * _REGION)
        self._times.append(seconds)
        self._images.append(crop(image, region, (_SIDE_PX * _REGION,) * 2))
        return region.share_inside(image.shape[1::-1]) > 0.999

    def look(
        self, image: Image, seconds: float, scene: OrientedBox, box: OrientedBox | None
    ) -> tuple[OrientedBox, Floats] | None:
        """Where the target is, ``seconds`` after the first image, and its velocity (2,) over the scene [px/s].

        scene: where the scene is now that the first box showed. box: in which the target is seen, if it is. None where
        no way out of the first box is clear, or ``box`` has moved, too, or shows at least half of what moves.
        """
        if self._ended or seconds < self._times[-1] + _EVERY_S - 1e-6:
            return None
        self._ended = not self._keep(image, scene, seconds) or seconds > _UNTIL_S + 1e-6
        if self._ended or box is None or len(self._images) < _IMAGES:
            return None
        tracked = scene.axes.T @ (box.centre - scene.centre) / scene.sides
        place = self._place() if np.abs(tracked).max() < _STAYED else None
        if place is None or np.abs(place).max() < _STAYED or self._at(tracked) > max(SURELY, 0.5 * self._at(place)):
            return None
        step = scene.axes @ (scene.sides * place)
        return box.sized(scene.sides).at(scene.centre + step), step / seconds

    def _at(self, place: Floats) -> float:
        """Ratio of what differs in the newest image at a place (2,), in sides from the first one."""
        x, y = (_SIDE_PX * (place + 0.5 * _REGION)).astype(int)
        return float(self._ratio[y, x])

    def _place(self) -> Floats | None:
        """Where the best way from the first place ends (2,), in sides from there."""
        background = np.median(np.array(self._images), axis=0).astype(np.uint8)
        middle, total, first = _SIDE_PX * _REGION // 2, np.zeros(0, np.float32), 0.0
        for k, image in enumerate(self._images):
            differs = difference(image, background)
            self._ratio = ratio_to_median(differs, (_BOX_PX, _BOX_PX))
            moving, standing = densities(self._ratio, share_moving(self._ratio))
            evidence = np.clip(np.log(moving + 1e-3) - np.log(standing), *_BOUNDS).astype(np.float32)
            if k == 0:
                start = slice(middle - 2, middle + 2)
                total = np.full_like(evidence, -np.inf)
                total[start, start], first = evidence[start, start], float(evidence[start, start].max())
                continue
            reach = int(np.ceil(_FASTEST * (self._times[k] - self._times[k - 1]) * _SIDE_PX))
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
            total = cv2.dilate(total, disc) + evidence
        # Of the places that are about as likely, the one that differs most, and then the middle of what differs there.
        likely = np.where(total > total.max() - 0.2 * len(self._images), self._ratio, 0.0)
        y, x = divmod(int(likely.argmax()), likely.shape[1])
        if total.max() < _LEAST * len(self._images) or min(first, float(evidence[y, x])) < _LEAST:
            return None
        window = (x - _SIDE_PX // 2, y - _SIDE_PX // 2, _SIDE_PX, _SIDE_PX)
        _, (x, y, _, _) = cv2.meanShift(differs, window, (cv2.TERM_CRITERIA_COUNT, 5, 0.0))
        return (np.array([x, y]) + 0.5 * _SIDE_PX) / _SIDE_PX - 0.5 * _REGION
