"""The default tracker on the picture in an image: without black bars, and without a reticle drawn over the target."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from edge.uav.adaptive_tracker import AdaptiveTracker
from edge.uav.base import Box, Estimate, Telemetry, TrackState
from edge.uav.image_motion.black_bars import picture_area
from edge.uav.image_motion.on_screen_display import OnScreenDisplay
from edge.uav.target.box import check_target_box, has_frame_format
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

_TRIAL_S = 2.0  # both trackers are kept


class PictureTracker:
    """``AdaptiveTracker`` of the picture in an image; its arguments, and all pixels in and out, are of the image.

    others: body_from_camera, fps and seed.
    """

    def __init__(
        self, size: tuple[int, int], lens: Intrinsics | None, others: tuple[Floats | None, float, int]
    ) -> None:
        self._size, self._lens, self._others = size, lens, others
        self._samples: list[Telemetry] = []
        self._area = (0, 0, *size)
        self._tracker = self._new_tracker()

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Initialise the target from its first frame. Raises InputError for an invalid box."""
        check_target_box(image, self._size, target)
        before = self._area[2:]
        self._area = x, y, width, height = picture_area(image)
        self._target = replace(target, x=target.x - x, y=target.y - y)
        try:
            check_target_box(self._cut(image), (width, height), self._target)
        except InputError:  # there is something to see where it was marked: these are no bars
            self._area, self._target = (0, 0, *self._size), target
        if self._area[2:] != before:
            self._tracker = self._new_tracker()
        picture = self._cut(image)
        self._display = OnScreenDisplay(picture, time, self._target)
        self._rival: tuple[AdaptiveTracker, float] | None = None
        self._last = self._tracker.begin(picture, time, self._target)
        return self._in_image(self._last)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Add one sample."""
        self._samples = [*self._samples[-199:], sample]
        self._tracker.handle_telemetry(sample)

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Track the target into the next frame; ``None`` for a frame that could not be decoded."""
        picture = None
        if image is not None and has_frame_format(image, self._size):
            picture = self._cut(image)
            if self._display.find(picture, time):
                self._begin_again(time)
        without = None if picture is None else self._display.without(picture)
        self._last = self._tracker.handle_frame(picture if self._display.images else without, time)
        if self._rival is not None and self._display.images:
            self._compare(*self._rival, without, time)
        return self._in_image(self._last)

    def road_outline(self) -> tuple[Floats, Floats | None]:
        """The observed road near the target, see ``GroundTracker``."""
        pixels, ground = self._tracker.road_outline()
        return pixels + self._area[:2], ground

    def _new_tracker(self) -> AdaptiveTracker:
        x, y, *size = self._area
        lens = self._lens
        if lens is not None:
            matrix = lens.matrix - [[0.0, 0.0, x], [0.0, 0.0, y], [0.0, 0.0, 0.0]]
            lens = replace(lens, width=size[0], height=size[1], matrix=matrix)
        tracker = AdaptiveTracker((size[0], size[1]), lens, *self._others)
        for sample in self._samples:
            tracker.handle_telemetry(sample)
        return tracker

    def _begin_again(self, now: float) -> None:
        """Track the target from its first image to now without what was drawn over it, beside the other for a while."""
        (first, at), *later = ((image, time) for image, time in self._display.images if time < now)
        tracker, self._rival = self._new_tracker(), None
        with suppress(InputError):  # nothing of the target is left
            tracker.begin(self._display.without(first), at, self._target)
            for image, time in later:
                tracker.handle_frame(self._display.without(image), time)
            self._rival = tracker, now + _TRIAL_S

    def _compare(self, rival: AdaptiveTracker, until: float, without: Image | None, time: float) -> None:
        """Go on with the tracker without the display where that finds the target elsewhere.

        A target that stays where it is in the picture, as a display does, is followed there as before.
        """
        found = rival.handle_frame(without, time)
        is_seen = self._last.state is TrackState.VISIBLE
        reach = 0.5 * max(self._target.width, self._target.height)
        away = not is_seen or np.hypot(found.x - self._last.x, found.y - self._last.y) > reach
        if found.state is TrackState.VISIBLE and away:
            self._tracker, self._last = rival, found
            self._display.accept()
        elif time > until or found.state is TrackState.LOST:
            self._rival = None

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
