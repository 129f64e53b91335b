"""Whether the box is on the target: a two-state hidden Markov model, filtered by likelihood ratios.

The box may slip off the target at any time, at a small rate, and the evidence of each frame speaks for or against it.
Frames that follow each other show the same thing in the same light, so they are worth independent looks only at a
limited rate.
"""

from __future__ import annotations

import numpy as np

_LOSS_RATE = 0.2  # at which a box slips off its target [1/s]
_LOOKS_RATE = 5.0  # independent looks a second
_LIMIT = 6.0  # of the log odds: no evidence is surer than the model
_SEARCH_BELOW = -3.0  # log odds at which the target is searched elsewhere


class Belief:
    """log_odds: that the box is on the target; now: with all of the last frame's evidence."""

    def __init__(self, log_odds: float = _LIMIT) -> None:
        self.log_odds = self.now = float(np.clip(log_odds, -_LIMIT, _LIMIT))

    def doubt(self, within: float) -> None:
        """The target lies in the region that is looked at with probability ``within`` only."""
        on = min(max(within, 1e-3) / (1.0 + np.exp(-self.log_odds)), 1.0 - 1e-9)
        self.log_odds = float(np.log(on) - np.log1p(-on))

    def add(self, log_ratio: float, dt: float) -> None:
        """One frame's log likelihood ratio, ``dt`` [s] after the last one."""
        on = 1.0 / (1.0 + np.exp(-self.log_odds))
        on *= np.exp(-_LOSS_RATE * dt)
        before = float(np.log(on) - np.log1p(-on))
        self.now = before + log_ratio
        self.log_odds = float(np.clip(before + min(1.0, _LOOKS_RATE * dt) * log_ratio, -_LIMIT, _LIMIT))

    @property
    def probability(self) -> float:
        """That the box is on the target."""
        return float(1.0 / (1.0 + np.exp(-self.log_odds)))

    @property
    def visible(self) -> bool:
        """Whether the last frame shows the target, rather than not."""
        return self.now > 0.0 and self.log_odds > 0.0

    @property
    def gone(self) -> bool:
        """Whether the target is to be searched elsewhere."""
        return self.log_odds < _SEARCH_BELOW
