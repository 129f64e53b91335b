"""Tests of what the rig states as known: measured lenses."""

from __future__ import annotations

from hub.bundle.model_comparison import refuted_lenses
from hub.bundle.problem import AdjustmentState, Problem


def refuted_lens_warnings(names: list[str], problem: Problem, state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each measured lens that the observations refute; the answer keeps it as given."""
    return tuple(
        f"{names[one.camera]}: its measured lens is refuted by the observations, which give a focal length "
        f"{100 * one.focal_change:+.2g} % ± {100 * one.focal_std:.1g} % off (chi-squared {one.statistic:.0f} for focal "
        f"length and k1, limit {one.limit:.0f}); it was kept as given: correct it, or estimate it with --refine-lenses"
        for one in refuted_lenses(problem, state)
    )
