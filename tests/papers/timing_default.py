"""The default pair solver on the simulated tracks of the asynchronous calibration paper, for comparison.

It is given the focal length, which the paper's method does not need, and estimates lag and clock rate.
"""

from __future__ import annotations

import numpy as np

from hub.sync.hypothesis import PairSolution
from hub.sync.pair_solver import solve_pair
from hub.trajectory.image_tracks import smooth_track
from hub.two_view.relative_pose import fundamental_from
from tests.papers.timing_rig import FOCAL, Filmed, LagResult, evaluation_error


def default_method(filmed: Filmed) -> LagResult:
    """The default solver (hub/sync): splines, lag scan, refinement. A refusal keeps its best alignment's errors."""
    tracks = [smooth_track(filmed.time, pixels / FOCAL, FOCAL) for pixels in (filmed.a, filmed.b)]
    if tracks[0] is None or tracks[1] is None:
        return LagResult(filmed.tau, float("nan"), float("nan"), "no track")
    solution = solve_pair({"marker": tracks[0]}, {"marker": tracks[1]}, ("camera 1", "camera 2"))
    if solution.fit is None:
        return LagResult(filmed.tau, float("nan"), float("nan"), solution.status)
    matrix = np.diag([FOCAL, FOCAL, 1.0])
    fundamental = fundamental_from(solution.fit.pose, matrix, matrix)
    return LagResult(
        filmed.tau,
        lag_of(solution) - filmed.tau,
        evaluation_error(fundamental),
        "" if solution.solved else solution.status,
    )


def lag_of(solution: PairSolution) -> float:
    """``t_1 - t_2`` [s] at the middle of the common motion; nan without an alignment."""
    if solution.fit is None:
        return float("nan")
    fit = solution.fit
    return float(fit.mid_time - (fit.mid_time - fit.offset) / fit.rate)
