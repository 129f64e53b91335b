"""The result of one pair of cameras, which results and refusals both carry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from protocols.core.acceptance import AcceptanceTest


@dataclass(frozen=True, slots=True, eq=False)
class PairReport:
    """One pair of cameras, as in result.json.

    lag_s: t_a - t_b of one instant, at mid-overlap [s]. clock_rate: t_a's rate against t_b. fundamental:
    (3, 3), undistorted pixels, norm 1, ``m_aᵀ F m_b = 0``, None where unknown. inliers: share, 0..1. acceptance: the
    tests that were made, in order.
    """

    cameras: tuple[str, str]
    status: str
    lag_s: float | None = None
    clock_rate: float | None = None
    fundamental: npt.NDArray[np.float64] | None = None
    inliers: float | None = None
    rms_px: float | None = None
    acceptance: tuple[AcceptanceTest, ...] = ()
