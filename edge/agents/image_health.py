"""Whether a camera still sees: stalled, frozen, black, blurred. No clock: moments are passed in.

A frozen camera is worse than a dead one: the same picture with ever new times is a marker that stands still.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge.devices.base import Frame, Image

TOLD_AFTER_S = 1.0
"""How long it must last before it is told; half of what a status may take to say so."""
_DARK = 12
"""Grey levels below which a whole picture is black: sensors with a lens cap show 0 to 8."""
_STEP = 8
_PERIODS = 3.0
_LOOK_S = 0.2  # between two looks at how sharp it is
_BLURRED = 0.3  # of the sharpness that this camera has had
_LEARN = 0.02  # a look: how fast its usual sharpness falls, with a scene that has less to see; it rises at once
_EDGES = 0.15  # sharpness below which a camera has no edges that could be lost: grass, water, noise
_PLAIN = 1.5  # grey levels: a picture with less structure than that says nothing


@dataclass(slots=True)
class PictureWatch:
    """Judges every frame of one camera.

    live: False for recordings, which may hold what they like. period_s: nominal; 0 = not known.
    repeated, late: frames that must not be published: the same picture again; a time that does not increase.
    """

    live: bool
    period_s: float = 0.0
    repeated: int = 0
    late: int = 0
    _last: Image | None = None
    _last_ns: int | None = None
    _arrived: float | None = None
    _changed: float | None = None
    _light: float | None = None
    _sharp: float | None = None
    _usual: float = 0.0
    _looked: float | None = None

    def start(self, now: float) -> None:
        """The camera is open; the first frame is due."""
        self._arrived = self._changed = self._light = self._sharp = now

    def fresh(self, frame: Frame, now: float) -> bool:
        """Take a frame that came at ``now`` [s]; False: it is stale and must not be published."""
        self._arrived = now
        if not self.live:
            return True
        if self._last_ns is not None and frame.device_time_ns == self._last_ns:
            self.late += 1
            return False
        self._last_ns = frame.device_time_ns
        if self._last is not None and _same(self._last, frame.image):
            self.repeated += 1
            return False
        self._last = frame.image
        self._changed = now
        if int(frame.image[::_STEP, ::_STEP].max(initial=0)) > _DARK:
            self._light = now
        return True

    def look(self, frame: Frame, now: float) -> None:
        """How sharp a fresh frame is, five times a second; after it was published, as it takes a millisecond."""
        if not self.live or (self._looked is not None and now - self._looked < _LOOK_S):
            return
        self._looked = now
        sharp = sharpness(frame.image)
        if sharp is None:
            self._sharp = now
            return
        if self._usual < _EDGES or sharp >= _BLURRED * self._usual:
            self._sharp = now
            self._usual = max(sharp, (1.0 - _LEARN) * self._usual)

    def complaint(self, now: float) -> str:
        """What is wrong at ``now`` [s], for a person; "" while all is well."""
        if self._arrived is None or self._changed is None or self._light is None:
            return ""
        patience = max(TOLD_AFTER_S, _PERIODS * self.period_s)
        silent = now - self._arrived
        if silent >= patience:
            return f"no frame for {silent:.1f} s"
        if not self.live:
            return ""
        if now - self._changed >= patience:
            return f"frozen: the same picture for {now - self._changed:.1f} s, not published"
        if now - self._light >= patience:
            return f"black picture for {now - self._light:.1f} s"
        if self._sharp is not None and now - self._sharp >= patience:
            return f"blurred for {now - self._sharp:.1f} s: out of focus, wet, or covered"
        return ""


def sharpness(image: Image) -> float | None:
    """Fine structure of a picture (H, W, 3) relative to its coarse one; None where there is hardly any.

    Strong edges two pixels wide against the differences of their surroundings: light and contrast cancel, and noise,
    which is everywhere and no edge, counts little.
    """
    if min(image.shape[:2]) < 32:
        return None
    grey = cv2.pyrDown(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    coarse = cv2.pyrDown(cv2.pyrDown(cv2.pyrDown(grey)))
    fine = cv2.Laplacian(grey, cv2.CV_16S)
    strongest = float(np.percentile(np.abs(fine[::2, ::2]), 99.5))
    weak = float(np.percentile(np.abs(fine[::2, ::2]), 50.0))
    structure = float(coarse.astype(np.float64).std())
    return None if structure < _PLAIN else max(strongest - 6.0 * weak, 0.0) / structure


def _same(a: Image, b: Image) -> bool:
    """Equal to the last bit, which noise forbids to a sensor that sees anything at all.

    Pictures of one single colour tell nothing: a lens cap can look like that for ever.
    """
    # A few rows tell almost every pair apart; the whole is compared only where they agree.
    if a.shape != b.shape or not np.array_equal(a[::64], b[::64]) or not np.array_equal(a, b):
        return False
    return bool((a != a[0, 0]).any())
