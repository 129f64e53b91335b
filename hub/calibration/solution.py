"""The adjusted camera network in the internal gauge: what solvers return and the result is assembled from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from hub.bundle.initialisation import Reconstruction
from hub.bundle.preprocessing import PreparedSession
from hub.sync.hypothesis import PairSolution
from protocols.core.acceptance import AcceptanceTest
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
    acceptance: Mapping[str, Sequence[AcceptanceTest]] = field(default_factory=dict)
    """The acceptance tests by camera, those of refused cameras among them."""
