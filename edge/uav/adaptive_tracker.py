"""The default tracker: any target in any view, on the best frame of reference that the evidence supports.

Two trackers share the work. ``GroundTracker`` follows on the ground plane, where it knows roads and can say what a car
does out of view; it needs a view in which that plane holds. ``AppearanceTracker`` follows in the stabilised image and
needs nothing. Telemetry that says that the camera looks down on a vehicle decides for the ground; else the two are
compared while both see the target, and the ground is used once it has held, and given up where it is contradicted.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np

from edge.uav.base import Basis, Box, Estimate, Telemetry, TrackState
from edge.uav.correlation.appearance_tracker import CENTRE_STD, AppearanceTracker
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.ground.photometric import Contrast
from edge.uav.ground_tracker import GroundTracker
from edge.uav.image_motion.black_bars import picture_area
from edge.uav.image_motion.on_screen_display import OnScreenDisplay
from edge.uav.image_motion.repeated_images import is_repeated
from edge.uav.target.box import check_target_box, has_frame_format
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

_OBLIQUE_COSINE = 0.7  # of that angle, 45 degrees, beyond which the appearance joins in
_STEEP_COSINE = 0.82  # of the angle between optical axis and vertical, 35 degrees: the ground fills the image
_LEAST_FLAT = 2.5  # length [m] of a target that is not taller than long: less than a car, more than a person
_AGREE, _CONTRADICT = 0.35, 0.7  # distance of the two estimates, in target lengths
_FRAMES_TO_TRUST, _FRAMES_TO_DROP = 20, 6  # consecutive frames of agreement, contradiction
_HIDDEN_FRAMES = 3  # frames without the target after which an untrusted ground is given up
_CHECK_EVERY = 3  # frames between two looks of the appearance tracker while the ground is trusted
_CALM = 0.5  # step in the image, in target lengths, above which the appearance tracker looks at every frame
_COMPLETE = 0.9  # share of a box in the image from which the appearance can learn it
_RETRY_S = 4.0  # after which the ground is tried again; doubles each time
_REPEATED_S = 1.0  # of one image, after which its target is not seen any more, as a camera's is then reported as frozen
_TRIAL_S = 2.0  # for which a tracker without a reticle goes on beside the other: each second of it costs two
_ATTITUDE = "the attitude says that the camera looks down"


class AdaptiveTracker:
    """Tracker of one target. size: (width, height) [px]. lens, body_from_camera: without them telemetry is unused."""

    def __init__(
        self,
        size: tuple[int, int],
        lens: Intrinsics | None = None,
        body_from_camera: Floats | None = None,
        fps: float = 30.0,
        seed: int = 0,
    ) -> None:
        self._settings = (size, lens, body_from_camera, fps, seed)
        self._size, self._fps = size, fps
        self._ground: GroundTracker | None = GroundTracker(size, lens, body_from_camera, fps, seed)
        self._appearance = AppearanceTracker(size, fps)
        self._samples: list[Telemetry] = []
        self._restarts = 0  # of the ground, each in a frame of its own
        self._trust = 0.0  # -1: contradicted, 1: held
        self._retry_s, self._retry_at = _RETRY_S, np.inf
        self._frame = 0
        self._hidden = 0  # consecutive frames in which an untrusted ground could not be compared
        self._shift = np.zeros(2)  # of the box seen by appearance from the ground's estimate [px]
        self._sides: Floats | None = None
        self._place = np.full(2, np.nan)  # of the ground's last estimate [px]

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Initialise the target from its first frame. Raises InputError for an invalid box."""
        assert self._ground is not None
        check_target_box(image, self._size, target)
        self._contrast = Contrast(image, time, (target.x, target.y, target.width, target.height))
        image = self._contrast.stretched(image, time)
        self._viewed, self._viewed_at = image, time
        first = self._ground.begin(image, time, target)
        seen = self._appearance.begin(image, time, target)
        self._steep = self._looks_down(self._ground)
        self._cut = not self._is_complete(target)
        self._last = self._on_ground(first) if self._steep else self._on_image(seen)
        return self._last

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Add one sample; without lens and mounting it is not used."""
        self._samples = [*self._samples[-199:], sample]
        if self._ground is not None:
            self._ground.handle_telemetry(sample)

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Track the target into the next frame; ``None`` for a frame that could not be decoded.

        An image that repeats one with the target has that one's estimate: it says nothing of the time since.
        """
        image = None if image is None else self._contrast.stretched(image, time)
        if image is not None and self._last.state is TrackState.VISIBLE and is_repeated(self._viewed, image):
            recent = time - self._viewed_at <= _REPEATED_S
            return replace(self._last, time=time, state=TrackState.VISIBLE if recent else TrackState.COASTING)
        if image is not None:
            self._viewed, self._viewed_at = image, time
        self._last = self._follow(image, time)
        return self._last

    def _follow(self, image: Image | None, time: float) -> Estimate:
        self._frame += 1
        if self._ground is None:
            return self._without_ground(image, time)
        ground = self._ground.handle_frame(image, time)
        if not self._steep and self._looks_down(self._ground) and self._trust >= 0.0:
            self._steep = True
        if self._steep and image is not None:
            self._leave_steep(image, ground, time)
        if self._steep:
            return self._on_ground(ground)
        if self._cut and image is not None:
            return self._complete(image, ground, time)
        trusted = self._trust >= 1.0
        agreed = ground.state is TrackState.VISIBLE and self._appearance.sees
        place, self._place = self._place, np.array([ground.x, ground.y])
        calm = bool(np.hypot(*(self._place - place)) < _CALM * max(ground.width, ground.height))
        if trusted and self._frame % _CHECK_EVERY and agreed and calm:
            return self._on_ground(self._corrected(ground))
        if trusted:
            self._appearance.expect(ground)
        seen = self._appearance.handle_frame(image, time)
        self._compare(ground, seen, time)
        alone = seen.state is TrackState.VISIBLE and ground.state is not TrackState.VISIBLE
        if self._ground is None or self._trust < 1.0 or alone:
            return self._on_image(seen)
        if ground.state is TrackState.VISIBLE and seen.state is not TrackState.VISIBLE:
            coasting = replace(ground, state=TrackState.COASTING, std=max(ground.std, seen.std))
            return self._on_ground(self._corrected(coasting))
        if seen.state is TrackState.VISIBLE and ground.state is TrackState.VISIBLE:
            self._shift = np.array([seen.x - ground.x, seen.y - ground.y])
            self._sides = np.array([seen.width / ground.width, seen.height / ground.height])
        return self._on_ground(self._corrected(ground))

    def road_outline(self) -> tuple[Floats, Floats | None]:
        """The observed road near the target, see ``GroundTracker``."""
        return (np.zeros((0, 2)), None) if self._ground is None else self._ground.road_outline()

    def _looks_down(self, ground: GroundTracker) -> bool:
        """Whether the ground alone decides: seen from above, of a target that looks alike all over the image."""
        return ground.view_cosine > _STEEP_COSINE and not _is_tall(ground)

    def _leave_steep(self, image: Image, ground: Estimate, time: float) -> None:
        """Where the camera has come up to an oblique view, the appearance joins in, with the ground trusted so far.

        Beside a target that is found to be tall, as soon as the ground is in metres, the ground is to be tried.
        """
        assert self._ground is not None
        tall = _is_tall(self._ground)
        joins = tall or self._ground.view_cosine < _OBLIQUE_COSINE
        if joins and ground.state is TrackState.VISIBLE and self._is_complete(_box(ground)):
            self._appearance = AppearanceTracker(self._size, self._fps)
            self._appearance.begin(image, time, _box(ground))
            self._steep, self._trust = False, 0.0 if tall else 1.0

    def _is_complete(self, box: Box) -> bool:
        """Whether nearly all of a box lies in the image."""
        return OrientedBox.upright(box).share_inside(self._size) > _COMPLETE

    def _complete(self, image: Image, ground: Estimate, time: float) -> Estimate:
        """A target that the border cut in the first image: the ground tracker learns all of it as it comes in."""
        if ground.state is not TrackState.VISIBLE:
            self._cut = False
            return self._on_image(self._appearance.handle_frame(image, time))
        whole = _box(ground)
        if self._is_complete(whole):
            self._cut = False
            self._appearance.begin(image, time, whole)
        return self._on_ground(ground)

    def _without_ground(self, image: Image | None, time: float) -> Estimate:
        seen = self._appearance.handle_frame(image, time)
        if image is not None and time > self._retry_at and self._appearance.certain:
            self._retry_at, self._retry_s = np.inf, 2.0 * self._retry_s
            self._restart_ground(image, time, seen)
        return self._on_image(seen)

    def _restart_ground(self, image: Image, time: float, seen: Estimate) -> None:
        ground = GroundTracker(*self._settings)
        for sample in self._samples:
            ground.handle_telemetry(sample)
        try:
            ground.begin(image, time, _box(seen))
        except InputError:
            return
        self._ground, self._trust, self._steep = ground, 0.0, False
        self._restarts += 1

    def _compare(self, ground: Estimate, seen: Estimate, time: float) -> None:
        """Evidence for and against the ground, from a frame in which the appearance is certain of the target."""
        found, sees = ground.state is TrackState.VISIBLE, seen.state is TrackState.VISIBLE
        drop = not self._appearance.follows
        if not sees and (found or self._trust < 1.0):
            # A trusted one has found what does not look like the target. Whether another would have held is not known,
            # and two searches would cost twice.
            self._hidden += 1
            drop |= self._hidden > (_HIDDEN_FRAMES if self._trust < 1.0 else _FRAMES_TO_DROP)
        else:
            self._hidden = 0
            if sees and self._appearance.certain:
                distance = float(np.hypot(seen.x - ground.x, seen.y - ground.y))
                length = max(seen.width, seen.height)
                weight = _CHECK_EVERY if self._trust >= 1.0 else 1
                if found and distance < _AGREE * length + 2.0:
                    self._trust = min(self._trust + weight / _FRAMES_TO_TRUST, 1.0)
                elif not found or distance > _CONTRADICT * length + 4.0:
                    self._trust -= weight / _FRAMES_TO_DROP
        if drop or self._trust <= -1.0 + 1e-9:
            self._ground, self._retry_at = None, time + self._retry_s

    def _corrected(self, ground: Estimate) -> Estimate:
        """The ground's estimate with the offset and the size at which the appearance last saw the target."""
        if self._sides is None:
            return ground
        sides = self._sides * [ground.width, ground.height]
        x, y = ground.x + float(self._shift[0]), ground.y + float(self._shift[1])
        std = math.hypot(ground.std, CENTRE_STD * float(np.nan_to_num(sides).max()))  # as of its box
        return replace(ground, x=x, y=y, width=float(sides[0]), height=float(sides[1]), std=std)

    def _on_ground(self, estimate: Estimate) -> Estimate:
        metric = bool(np.isfinite(estimate.north)) or (self._ground is not None and self._ground.metric)
        reason = _ATTITUDE if self._steep else "the target moves on one plane"
        frame = self._restarts, *estimate.ground_frame[-1:]
        return replace(estimate, basis=Basis.GROUND if metric else Basis.PLANE, reason=reason, ground_frame=frame)

    def _on_image(self, estimate: Estimate) -> Estimate:
        motion = self._appearance.motion
        if motion.trusted:
            reason = f"{100 * motion.share:.0f} % of the corners around move alike"
            return replace(estimate, basis=Basis.STABILISED, reason=reason)
        reason = "too few corners around move alike" if self._frame else "the first image shows no motion"
        return replace(estimate, basis=Basis.IMAGE, reason=reason)


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
        reach = 0.5 * max(self._target.width, self._target.height)
        away = np.hypot(found.x - self._last.x, found.y - self._last.y) > reach
        if away and found.state is TrackState.VISIBLE:
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


def _is_tall(ground: GroundTracker) -> bool:
    """Whether the target may be taller than long, as a person is: its outline has relief displacement."""
    return ground.metric and ground.target_length < _LEAST_FLAT


def _box(e: Estimate) -> Box:
    return Box(e.x - 0.5 * (e.width - 1.0), e.y - 0.5 * (e.height - 1.0), e.width, e.height)
