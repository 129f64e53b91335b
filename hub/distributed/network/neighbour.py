"""One neighbour of a pose node: its edge, its state, and the observations received from it."""

from __future__ import annotations

from dataclasses import dataclass

from hub.distributed.factors.factor import Edge
from hub.distributed.network.messages import SharedObservation, StateMessage

_REORDER_WINDOW = 256
"""Largest reordering of one camera's messages."""
_RECEIVED_MASK = (1 << _REORDER_WINDOW) - 1


@dataclass(slots=True, eq=False)
class Neighbour:
    """Data of one neighbour. state: the last received. highest_sequence, received_mask: observations received."""

    edge: Edge
    boot: int = -1
    highest_sequence: int = -1
    received_mask: int = 0
    state: StateMessage | None = None
    state_age: int = 0
    """Own updates since the last state was received."""

    def rejection_reason(self, seen: SharedObservation) -> str:
        """Why an observation is rejected: a duplicate, or too late (distributed pose paper, step 1); "" if accepted."""
        if seen.boot != self.boot:
            if seen.boot < self.boot:
                return "earlier boot"
            self.boot, self.highest_sequence, self.received_mask = seen.boot, -1, 0
        ahead = seen.sequence - self.highest_sequence
        if ahead > 0:
            self.received_mask = ((self.received_mask << ahead) | 1) & _RECEIVED_MASK if ahead < _REORDER_WINDOW else 1
            self.highest_sequence = seen.sequence
            return ""
        if -ahead >= _REORDER_WINDOW:
            return "too late"
        bit = 1 << -ahead
        if self.received_mask & bit:
            return "duplicate"
        self.received_mask |= bit
        return ""
