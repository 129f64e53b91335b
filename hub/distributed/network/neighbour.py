"""One neighbour of a pose node: its edge, its state, and which of its observations have been heard."""

from __future__ import annotations

from dataclasses import dataclass

from hub.distributed.factors.factor import Edge
from hub.distributed.network.messages import SharedObservation, StateMessage

_SEQUENCES = 256
"""Messages of one camera that may overtake each other."""


@dataclass(slots=True, eq=False)
class Neighbour:
    """What a pose node holds of one neighbour. state: the last one heard; highest, bits: observations heard so far."""

    edge: Edge
    boot: int = -1
    highest: int = -1
    bits: int = 0
    state: StateMessage | None = None
    stale: int = 0
    """Own updates since the last state came."""

    def refuses(self, seen: SharedObservation) -> str:
        """Why an observation is not taken: heard before, or too late to tell (METHODS C, step 1); ""."""
        if seen.boot != self.boot:
            if seen.boot < self.boot:
                return "earlier boot"
            self.boot, self.highest, self.bits = seen.boot, -1, 0
        ahead = seen.sequence - self.highest
        if ahead > 0:
            self.bits = ((self.bits << ahead) | 1) & ((1 << _SEQUENCES) - 1) if ahead < _SEQUENCES else 1
            self.highest = seen.sequence
            return ""
        if -ahead >= _SEQUENCES:
            return "too late"
        bit = 1 << -ahead
        if self.bits & bit:
            return "duplicate"
        self.bits |= bit
        return ""
