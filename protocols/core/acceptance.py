"""Named tests of an estimate (what was measured, its limit, and where the limit comes from), and reports of pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class AcceptanceTest:
    """A row of the table of acceptance tests, as in result.json and the report.

    value, limit: in ``unit``. source: the distribution, physical bound or bench that the limit comes from. reason: of
    the refusal in words, where the test fails. sense: "<=" or ">=", of value to limit. alternative: the test that
    decided in its stead, if any; then it counts as passed.
    """

    name: str
    value: float
    limit: float
    unit: str
    source: str
    reason: str = ""
    sense: str = "<="
    alternative: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value is within the limit, or another test decided; a value that is no number is not within."""
        within = self.value <= self.limit if self.sense == "<=" else self.value >= self.limit
        return bool(self.alternative) or (not math.isnan(self.value) and within)

    @property
    def excess(self) -> float:
        """How far beyond the limit: the factor by which the value exceeds it, or falls short of it."""
        small, large = (self.limit, self.value) if self.sense == "<=" else (self.value, self.limit)
        return large / max(small, 1e-300)


@dataclass(frozen=True, slots=True)
class PrecisionTest(AcceptanceTest):
    """Of a std or a number of rows: where it fails, the observations say too little, but do not refute the estimate."""


def first_failure(tests: Iterable[AcceptanceTest]) -> AcceptanceTest | None:
    """The first test that fails; None if all pass."""
    return next((test for test in tests if not test.passed), None)


@dataclass(frozen=True, slots=True, eq=False)
class PairReport:
    """One pair of cameras, as in result.json.

    lag_s: t_a - t_b of one instant, at mid-overlap [s]. clock_rate: t_a's rate against t_b. fundamental:
    (3, 3), undistorted pixels, norm 1, ``m_aᵀ F m_b = 0``, None where unknown. inliers: share, 0..1. acceptance: the
    tests that were made, in order. lag_std_s: of lag_s [s], of pairs that no solution of all cameras contains: lens and
    readout included where the lenses are given, else by noise alone.
    """

    cameras: tuple[str, str]
    status: str
    lag_s: float | None = None
    clock_rate: float | None = None
    fundamental: npt.NDArray[np.float64] | None = None
    inliers: float | None = None
    rms_px: float | None = None
    lag_std_s: float | None = None
    acceptance: tuple[AcceptanceTest, ...] = ()
