"""Whether a camera still sees: stalled, frozen, black. No clock: moments are passed in.

A frozen camera is worse than a dead one: the same picture with ever new times is a marker that stands still.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.devices.base import Frame, Image

TOLD_AFTER_S = 1.0
"""How long it must last before it is told; half of what a status may take to say so."""
_DARK = 12
"""Grey levels below which a whole picture is black: sensors with a lens cap show 0 to 8."""
_STEP = 8
_PERIODS = 3.0


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

    def start(self, now: float) -> None:
        """The camera is open; the first frame is due."""
        self._arrived = self._changed = self._light = now

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
        return ""


def _same(a: Image, b: Image) -> bool:
    """Equal to the last bit, which noise forbids to a sensor that sees anything at all.

    Pictures of one single colour tell nothing: a lens cap can look like that for ever.
    """
    # A few rows tell almost every pair apart; the whole is compared only where they agree.
    if a.shape != b.shape or not np.array_equal(a[::64], b[::64]) or not np.array_equal(a, b):
        return False
    return bool((a != a[0, 0]).any())
