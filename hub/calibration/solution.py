"""The adjusted camera network in the internal gauge: what solvers return and the result is assembled from."""

from __future__ import annotations

from dataclasses import dataclass, field

from hub.bundle.initialisation import Reconstruction
from hub.bundle.preprocessing import PreparedSession
from hub.sync.hypothesis import PairSolution
from protocols.session.calibration import FixedCalibration


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """An adjusted network in the internal gauge and on the internal clock, before publication.

    refused: reason by camera. solver: "joint", "distributed" or "paper".
    """

    reconstruction: Reconstruction
    pairs: tuple[PairSolution, ...]
    refused: dict[str, str]
    prepared: PreparedSession
    solver: str
    warnings: tuple[str, ...] = field(default=())
    known: FixedCalibration | None = None
    """Poses that were given and are kept; their world is then the published one."""
