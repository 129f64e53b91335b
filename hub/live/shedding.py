"""What a hub leaves out while it is behind its messages: in a fixed order, counted, and stated in its status.

First predictions, which are for the moment only; then smoothed tracks, which are for the log; observations last, and of
these the oldest of whoever has most of them waiting (`Inbox`, `FairShare`), so that estimates lose as little as may be.
"""

from __future__ import annotations

PREDICTIONS_S = 0.25
"""How late [s] a hub leaves out predictions: half of the 0.5 s after which a camera uses none of them."""
SMOOTHED_S = 1.0
"""How late [s] it leaves out smoothed tracks too: its status is a second old by then."""
_STATED_S = 2.0
"""How long a status says so afterwards: two statuses."""


class Shedding:
    """How late a hub is, by the messages of its last round. now: any monotonic clock [s]."""

    def __init__(self) -> None:
        self.behind_s = 0.0
        self._worst, self._last = 0.0, -float("inf")

    def see(self, behind_s: float, now: float) -> None:
        """The median sender's oldest message was ``behind_s`` old when the round's messages had been processed."""
        self.behind_s = behind_s
        if self.sheds_predictions:
            self._worst = max(self._worst, behind_s) if now - self._last < _STATED_S else behind_s
            self._last = now

    @property
    def sheds_predictions(self) -> bool:
        """Whether predictions are left out now."""
        return self.behind_s > PREDICTIONS_S

    @property
    def sheds_smoothed(self) -> bool:
        """Whether smoothed tracks are left out now."""
        return self.behind_s > SMOOTHED_S

    def text(self, now: float) -> str:
        """One clause for the status; "" while the hub keeps up."""
        if now - self._last >= _STATED_S:
            return ""
        what = "predictions and smoothed tracks" if self._worst > SMOOTHED_S else "predictions"
        return f"up to {self._worst:.1f} s behind its messages: {what} are left out"
