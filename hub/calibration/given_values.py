"""Tests of what the rig states as known: measured lenses."""

from __future__ import annotations

from hub.bundle.model_comparison import LensTest, refuted_lenses
from hub.bundle.problem import AdjustmentState, Problem


def refuted_lens(test: LensTest) -> str:
    """What the observations say about a measured lens."""
    change, std = 100 * test.focal_change, 100 * test.focal_std
    return (
        "its measured lens is refuted by the observations, which give a focal length "
        f"{change:+.2g} % ± {std:.1g} % off (chi-squared {test.statistic:.0f} for focal length and k1, "
        f"limit {test.limit:.0f})"
    )


def refuted_lens_warnings(names: list[str], problem: Problem, state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each measured lens that the observations refute; the answer keeps it as given."""
    return tuple(
        f"{names[one.camera]}: {refuted_lens(one)}; it was kept as given: correct it, or estimate it "
        "with --refine-lenses"
        for one in refuted_lenses(problem, state)
    )
