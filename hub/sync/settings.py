"""Settings of the pair solver: image noise, search effort, acceptance limits."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PairSettings:
    """Noise assumptions, search effort and acceptance limits of the pair solver; the defaults suit every rig.

    Support is the time [s] in which both tracks move; strength and evidence are those of `acceptance.strength` and
    `hypothesis.evidence`.
    """

    min_scan_step: float = 0.01
    """Finest grid step of the lag scan [s]."""
    max_scan_step: float = 0.05
    """Coarsest grid step of the lag scan [s]."""
    scan_step_px: float = 8.0
    """Motion in a grid step [px], of the fastest tenth of the motion."""
    min_scan_support: float = 1.0
    """Support [s] from which a lag is scanned."""
    sigma_px: float = 0.5
    """Image noise std of a good track [px]; the unit of the scan's costs."""
    candidates_per_octave: int = 6
    """Candidate lags per octave of support."""
    max_candidates: int = 18
    """Candidate lags in all."""
    max_unreliable_candidates: int = 18
    """Candidate lags that are refined while none of them is reliable; then the search ends without a solution."""
    start_samples: int = 160
    """Point pairs in the choice among a candidate's initial geometries."""
    refinement_samples: int = 500
    """Point pairs in the refinement of a candidate and in the sensitivity test."""
    final_samples: int = 6000
    """Point pairs in the final refinement of the solution."""
    max_residual_px: float = 6.0
    """Robust residual [px], lens errors included, above which no geometry fits."""
    rate_prior_std: float = 2e-3
    """Prior std of a clock's rate about its nominal value."""
    min_speed_px: float = 20.0
    """Image speed [px/s] from which a sample counts as moving."""
    min_support: float = 1.5
    """Support of inliers [s] below which nothing is accepted."""
    min_support_without_null: float = 8.0
    """Support of inliers [s] required where the recordings are too short for a null distribution."""
    min_inliers_long: float = 0.6
    """Inlier fraction of the common motion required at ``long_support``."""
    min_inliers_short: float = 0.95
    """Inlier fraction required at ``short_support``: seven parameters and a search over all lags fit a few seconds of
    any motion. Linear in between."""
    long_support: float = 12.0
    """Support [s] from which ``min_inliers_long`` is enough."""
    short_support: float = 4.0
    """Support [s] up to which ``min_inliers_short`` is required."""
    max_rate_error: float = 1e-2
    """Difference of the clock rate from 1 beyond which the frame rate must be wrong."""
    max_log10_false_alarm: float = -1.3
    """log10 of the probability that the best of all wrong lags fits as well."""
    min_lts_zscore: float = 3.0
    """Standard deviations by which a lag's inlier seconds must exceed those of other lags in the LTS scan."""
    min_lts_support: float = 4.0
    """Support of inliers [s] required of a solution of the LTS scan."""
    max_log10_gap: float = -2.0
    """log10 of the probability of the gap to the next best lag; either this or ``max_log10_false_alarm`` must hold."""
    unique_min_support: float = 5.0
    """Inlier support [s] that the uniqueness tests require."""
    unique_min_strength: float = 3.0
    """Strength that the uniqueness tests require: cycles of inlier motion times the log of their misfit ratio."""
    unique_min_margin: float = 2.3
    """Margin of strength over the next best alignment that they require: half the log of the Bayes factor 100."""
    unique_max_strength_ratio: float = 0.6
    """Unique maximum: strength of the next best alignment over the best one's. (At the noise floor the limit is
    ``max_evidence_ratio``: a periodic motion makes two alignments that are both strong.)"""
    independent_lag_spacing: float = 0.3
    """Distance of lags [s] whose misfits are independent."""
    min_planar_ratio: float = 3.0
    """Residual of the best homography over the epipolar one, below which a plane explains the motion as well."""
    min_in_front: float = 0.95
    """Fraction of inliers in front of both cameras (cheirality)."""
    max_evidence_ratio: float = 0.5
    """Evidence of the best competing hypothesis over the best alignment's."""
    competing_residual_ratio: float = 1.6
    """Ratio of residuals, another alignment over the best one, up to which the other one competes."""
    competing_residual_ratio_at_noise: float = 1.4
    """The same ratio where the best alignment is at the noise floor."""
    competing_log10_margin: float = 3.0
    """A competing alignment is ignored if its false-alarm probability is larger by this many powers of ten."""
    chance_log10_margin: float = 2.0
    """The same margin for alignments that every search is expected to yield by chance."""
    predicted_lag_window: float = 0.3
    """Half-width [s] of the search about a lag that other cameras imply."""
    max_noise_ratio: float = 1.3
    """Residual over the tracks' own noise up to which an alignment is at the noise floor."""
    max_lag_std: float = 4e-3
    """Largest std of the lag [s] by noise alone."""
    max_slow_lag_std: float = 10e-3
    """Largest std of the lag [s] by noise alone, where the point moves by less than a pixel in that time."""
    standalone: bool = True
    """Whether the pair is the final result. If not, it only initialises a bundle adjustment of more cameras, which
    tests it, and the sensitivity tests below are left out."""
    max_total_lag_std: float = 10e-3
    """Largest std of the lag [s] with lens and readout uncertainty; the bundle adjustment must agree with it."""
    max_total_lag_std_planar: float = 7e-3
    """The same limit for a unique maximum where a plane explains the motion nearly as well."""
    max_total_lag_std_short: float = 7e-3
    """The same limit for a unique maximum with less support than ``unique_long_support``."""
    unique_long_support: float = 10.0
    """Inlier support [s] from which a unique maximum counts as long."""
    max_leave_out_change: float = 30e-3
    """Largest change of the lag [s] when a fifth of the samples is left out."""
    max_rotation_ambiguity: float = 0.5
    """Angle [rad] between equally likely rotations, beyond which a standalone pair has no pose."""
    max_rotation_std: float = 0.1
    """Largest std of the relative rotation [rad]."""
    unique_max_rotation_std: float = 0.04
    """The same limit for an alignment that is accepted as a unique maximum."""
    max_rotation_std_certain_lag: float = 0.25
    """The same limit where the lag is certain: epipolar lines can fit while the pose is undetermined."""
    certain_lag_log10_false_alarm: float = -3.0
    """log10 of the false-alarm probability of one wrong lag, from which the lag is certain."""
