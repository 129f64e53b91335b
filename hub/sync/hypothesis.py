"""Alignment hypotheses of a camera pair: fit, solution or refusal, evidence."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hub.two_view.relative_pose import RelativePose, TwoViewGeometry
from protocols.core.acceptance import AcceptanceTest
from protocols.geometry.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class PairFit:
    """One refined alignment hypothesis: time map, two-view geometry and quality figures."""

    rate: float
    """Clock rate of ``t_a = rate * t_b + offset``, on the tracks' own (shifted) times."""
    offset: float
    """Offset of the same time map [s]."""
    geometry: TwoViewGeometry
    """Relative pose with intrinsics, fundamental matrix without."""
    residual_px: float
    """Robust std of the Sampson distance [px]."""
    inliers: float
    """Inlier fraction of the moving samples."""
    in_front: float
    """Fraction of the inliers in front of both cameras (cheirality)."""
    support: float
    """Inlier support: seconds of motion that agree with the geometry."""
    moving_overlap: float
    """Seconds in which both tracks exist and move."""
    mid_time: float
    """Median time of a in the moving overlap [s], at which ``lag`` holds."""
    parallax: float
    """Median angle between the two rays of a point [rad]; 0 without intrinsics."""
    planar_residual_px: float = float("nan")
    """Residual of the best homography [px]; near ``residual_px`` the geometry is degenerate."""
    misfit: float = float("inf")
    """Mean squared Sampson distance of the smoothed inliers, over the settings' noise."""
    track_noise_px: float = float("nan")
    """Measured noise std of the noisier camera's tracks [px]."""
    log10_false_alarm: float | None = None
    """log10 of the probability that unrelated motion of this length fits as well; None where the recordings are too
    short for a null distribution."""
    log10_gap: float = 0.0
    """log10 of the probability of so large a gap to the next best lag by chance."""
    cycles: float = 0.0
    """Bandwidth of the motion times inlier support."""
    lag_std: float = float("nan")
    """Std of the lag in the final refinement, by noise alone [s]."""
    rotation_std: float = float("nan")
    """Largest std of the relative rotation in the final refinement, by noise alone [rad]."""
    total_lag_std: float = float("nan")
    """Std of the lag with lens and readout uncertainty included (consider covariance) [s]; nan where not computed."""
    rate_prior_std: float = float("nan")
    """Std of the rate prior in the final refinement; narrow where the motion does not determine the rate."""

    @property
    def pose(self) -> RelativePose:
        """The relative pose. Raises ValueError without intrinsics."""
        if not isinstance(self.geometry, RelativePose):
            raise ValueError("cameras without intrinsics have no relative pose")
        return self.geometry

    @property
    def lag(self) -> float:
        """``t_a - t_b`` [s] at ``mid_time``."""
        return self.mid_time - (self.mid_time - self.offset) / self.rate


@dataclass(frozen=True, slots=True, eq=False)
class PairSolution:
    """Result for a pair of cameras a and b: the accepted alignment, or a refusal with the best hypothesis if any.

    status: "ok" or the reason of the refusal. alternatives: next best alignments, best first. acceptance: the tests
    that were made, in order. refuted: whether no geometry agrees at the lag that other cameras imply. incomplete:
    whether further lags were not searched.
    """

    a: str
    b: str
    status: str
    fit: PairFit | None = None
    alternatives: tuple[PairFit, ...] = field(default=())
    fundamental: Floats | None = None
    """(3, 3) of undistorted pixels, ``m_aᵀ F m_b = 0``, where the method found it directly."""
    acceptance: tuple[AcceptanceTest, ...] = ()
    refuted: bool = False
    incomplete: bool = False

    @property
    def solved(self) -> bool:
        """Whether the fit was accepted."""
        return self.status == "ok"


def swap_cameras(fit: PairFit) -> PairFit:
    """The same alignment with the two cameras exchanged. Raises ValueError without intrinsics."""
    mid_time, pose = (fit.mid_time - fit.offset) / fit.rate, fit.pose.inverse()
    return replace(fit, rate=1.0 / fit.rate, offset=-fit.offset / fit.rate, geometry=pose, mid_time=mid_time)


def evidence(fit: PairFit) -> float:
    """Evidence for an alignment: inlier support [s], discounted by outliers, points behind and residual."""
    return float(fit.support * fit.inliers * fit.in_front / np.sqrt(1.0 + fit.residual_px))
