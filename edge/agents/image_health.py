"""Image health of a camera: detects stalled, frozen, black and blurred streams. All times are arguments.

A frozen camera does more harm than one without frames: the same image with new time stamps looks like a static marker.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge.devices.base import Frame
from protocols.geometry.types import Image

REPORT_DELAY_S = 1.0
"""Duration of a fault [s] before it is reported; half the allowed latency of a status."""
_DARK_LEVEL = 12
"""Grey level up to which an image counts as black: sensors with a lens cap give 0 to 8."""
_STRIDE = 8  # px: a lit area of this size is found
_TIMEOUT_PERIODS = 3.0  # two frames may be lost in a row
_SHARPNESS_PERIOD_S = 0.2  # between two measurements of the sharpness
_BLUR_RATIO = 0.3  # of the reference sharpness of this camera
_REFERENCE_DECAY = 0.02  # per measurement: decay of the reference when the scene has less detail; it rises at once
_MIN_REFERENCE = 0.15  # reference below which there are no edges to lose (grass, water, noise): no blur test
_MIN_CONTRAST = 1.5  # grey levels: with less large-scale structure the sharpness is undefined


@dataclass(slots=True)
class ImageHealth:
    """Checks every frame of one camera.

    live: False for recordings, which are only tested for stalls. period_s: nominal frame period; 0 = not known.
    repeated, stale: counts of frames that must not be published: identical image; time stamp that does not advance.
    """

    live: bool
    period_s: float = 0.0
    repeated: int = 0
    stale: int = 0
    _last: Image | None = None
    _last_ns: int | None = None
    _arrived_s: float | None = None
    _changed_s: float | None = None
    _bright_s: float | None = None
    _sharp_s: float | None = None
    _reference: float = 0.0
    _measured_s: float | None = None

    def start(self, now: float) -> None:
        """Start the timeouts: the camera is open and the first frame is due."""
        self._arrived_s = self._changed_s = self._bright_s = self._sharp_s = now

    def accept(self, frame: Frame, now: float) -> bool:
        """Check a frame that arrived at ``now`` [s]; False if it is repeated or stale and must not be published."""
        self._arrived_s = now
        if not self.live:
            return True
        if self._last_ns is not None and frame.device_time_ns == self._last_ns:
            self.stale += 1
            return False
        self._last_ns = frame.device_time_ns
        if self._last is not None and _is_identical(self._last, frame.image):
            self.repeated += 1
            return False
        self._last = frame.image
        self._changed_s = now
        if int(frame.image[::_STRIDE, ::_STRIDE].max(initial=0)) > _DARK_LEVEL:
            self._bright_s = now
        return True

    def measure_sharpness(self, frame: Frame, now: float) -> None:
        """Measure the sharpness of an accepted frame, five times a second; takes 1 ms, so call it after publishing."""
        if not self.live or (self._measured_s is not None and now - self._measured_s < _SHARPNESS_PERIOD_S):
            return
        self._measured_s = now
        sharp = sharpness(frame.image)
        if sharp is None:
            self._sharp_s = now
            return
        if self._reference < _MIN_REFERENCE or sharp >= _BLUR_RATIO * self._reference:
            self._sharp_s = now
            self._reference = max(sharp, (1.0 - _REFERENCE_DECAY) * self._reference)

    def problem(self, now: float) -> str:
        """Description of the present fault at ``now`` [s]; "" while there is none."""
        if self._arrived_s is None or self._changed_s is None or self._bright_s is None:
            return ""
        limit = max(REPORT_DELAY_S, _TIMEOUT_PERIODS * self.period_s)
        silent = now - self._arrived_s
        if silent >= limit:
            return f"no frame for {silent:.1f} s"
        if not self.live:
            return ""
        if now - self._changed_s >= limit:
            return f"frozen: the same picture for {now - self._changed_s:.1f} s, not published"
        if now - self._bright_s >= limit:
            return f"black picture for {now - self._bright_s:.1f} s"
        if self._sharp_s is not None and now - self._sharp_s >= limit:
            return f"blurred for {now - self._sharp_s:.1f} s: out of focus, wet, or covered"
        return ""


def sharpness(image: Image) -> float | None:
    """Ratio of fine to coarse structure of an image (H, W, 3); None where there is hardly any coarse structure.

    The 99.5th percentile of the absolute Laplacian at half resolution, less six times its median (the noise floor),
    over the standard deviation at 1/16 of the resolution: brightness and contrast cancel.
    """
    if min(image.shape[:2]) < 32:
        return None
    grey = cv2.pyrDown(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    coarse = cv2.pyrDown(cv2.pyrDown(cv2.pyrDown(grey)))
    fine = cv2.Laplacian(grey, cv2.CV_16S)
    strongest = float(np.percentile(np.abs(fine[::2, ::2]), 99.5))
    weak = float(np.percentile(np.abs(fine[::2, ::2]), 50.0))
    structure = float(coarse.astype(np.float64).std())
    return None if structure < _MIN_CONTRAST else max(strongest - 6.0 * weak, 0.0) / structure


def _is_identical(a: Image, b: Image) -> bool:
    """Whether two images are bitwise equal, which sensor noise excludes for any live image.

    Images of a single colour never count as identical: a sensor behind a lens cap can give them continually.
    """
    # A few rows distinguish almost every pair; the whole images are compared only where those agree.
    if a.shape != b.shape or not np.array_equal(a[::64], b[::64]) or not np.array_equal(a, b):
        return False
    return bool((a != a[0, 0]).any())
