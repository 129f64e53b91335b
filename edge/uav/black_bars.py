"""Black bars above and below a picture, or beside it: of a recorder or a screen of another shape.

They are no part of the view: behind a bar a target is as much out of the picture as beyond the image's border.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.uav.adaptive_tracker import AdaptiveTracker
from edge.uav.base import Box, Estimate, Telemetry
from edge.uav.target.box import check_target_box, has_frame_format
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Image

_BLACK = 32  # grey levels: what an encoder leaves of black beside a bright edge
_LIT = 0.1  # share of a row's pixels that are lighter in a picture, but not in a bar with text
_EQUAL_PX, _LEAST_PX = 2, 4  # difference of two bars, for a dark sky has none opposite; width of one


class WithoutBars:
    """``AdaptiveTracker`` of the picture in an image; its arguments, and all pixels in and out, are of the image."""

    def __init__(
        self,
        size: tuple[int, int],
        lens: Intrinsics | None = None,
        body_from_camera: Floats | None = None,
        fps: float = 30.0,
        seed: int = 0,
    ) -> None:
        self._size, self._lens, self._others = size, lens, (body_from_camera, fps, seed)
        self._tracker = AdaptiveTracker(size, lens, *self._others)
        self._samples: list[Telemetry] = []
        self._area = (0, 0, *size)

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Initialise the target from its first frame. Raises InputError for an invalid box."""
        check_target_box(image, self._size, target)
        self._area = x, y, width, height = picture_area(image)
        if (width, height) != self._size:
            lens = self._lens
            if lens is not None:
                matrix = lens.matrix - [[0.0, 0.0, x], [0.0, 0.0, y], [0.0, 0.0, 0.0]]
                lens = replace(lens, width=width, height=height, matrix=matrix)
            self._tracker = AdaptiveTracker((width, height), lens, *self._others)
            for sample in self._samples:
                self._tracker.handle_telemetry(sample)
        inside = replace(target, x=target.x - x, y=target.y - y)
        return self._in_image(self._tracker.begin(self._cut(image), time, inside))

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Add one sample."""
        self._samples = [*self._samples[-199:], sample]
        self._tracker.handle_telemetry(sample)

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Track the target into the next frame; ``None`` for a frame that could not be decoded."""
        if image is not None:
            image = self._cut(image) if has_frame_format(image, self._size) else None
        return self._in_image(self._tracker.handle_frame(image, time))

    def road_outline(self) -> tuple[Floats, Floats | None]:
        """The observed road near the target, see ``GroundTracker``."""
        pixels, ground = self._tracker.road_outline()
        return pixels + self._area[:2], ground

    def _cut(self, image: Image) -> Image:
        x, y, width, height = self._area
        return np.ascontiguousarray(image[y : y + height, x : x + width])

    def _in_image(self, e: Estimate) -> Estimate:
        corner = np.array(self._area[:2])
        if not corner.any():
            return e
        return replace(
            e,
            x=e.x + corner[0],
            y=e.y + corner[1],
            hypotheses=tuple(replace(h, x=h.x + corner[0], y=h.y + corner[1]) for h in e.hypotheses),
            particles=None if e.particles is None else e.particles + corner,
            layers={name: points + corner for name, points in e.layers.items()},
        )


def picture_area(image: Image) -> tuple[int, int, int, int]:
    """x, y, width, height [px] of the picture in an image (H, W, 3); all of the image where it has no bars."""
    lit = image.max(axis=2) > _BLACK
    (y, height), (x, width) = (_between(lit.mean(axis=axis) > _LIT) for axis in (1, 0))
    return x, y, width, height


def _between(lit: Bools) -> tuple[int, int]:
    """Start and length of what lies between two equal dark ends; all where they are not equal."""
    rows = np.flatnonzero(lit)
    if not rows.size:
        return 0, len(lit)
    low, high = int(rows[0]), len(lit) - 1 - int(rows[-1])
    if min(low, high) < _LEAST_PX or abs(low - high) > _EQUAL_PX:
        return 0, len(lit)
    return low, len(lit) - low - high
