"""Whether the people of a calibration keep their height: geometry that is wrong shortens and stretches them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from protocols.core.errors import Refused
from protocols.session.calibration import TrajectoryTable

_MAX_VARIATION = 0.04
"""Of the distance from head to foot, relative, as a robust std. Of one walker in five rendered rooms it is 0.008 to
0.010 where rotations are right to 1.1 degrees, 0.023 with lenses 6 % off, and 0.052 and 0.063 where they are 9 to 20
degrees off; of points with 2 px of noise 0.002 to 0.006."""
_MIN_PLACES = 30  # a robust std of fewer is off by more than an eighth


def check_stature(trajectories: Iterable[TrajectoryTable]) -> None:
    """Raise Refused where the distance between the points ``NAME-head`` and ``NAME-foot`` varies along the path."""
    found = {}
    for table in trajectories:
        seen = np.isfinite(table.position).all(axis=1)
        found[table.label] = table.time[seen], table.position[seen]
    for label, (times, foot) in found.items():
        name, _, end = label.rpartition("-")
        if end != "foot" or not name or f"{name}-head" not in found or not len(times):
            continue
        when, head = found[f"{name}-head"]
        common = (when >= times[0]) & (when <= times[-1])
        if common.sum() < _MIN_PLACES:
            continue
        below = np.column_stack([np.interp(when[common], times, column) for column in foot.T])
        height = np.linalg.norm(head[common] - below, axis=1)
        middle = float(np.median(height))
        variation = 1.4826 * float(np.median(np.abs(height - middle))) / max(middle, 1e-300)
        if variation > _MAX_VARIATION:
            raise Refused(
                f"{name} would be {100.0 * variation:.0f} % taller and smaller along the path (std): the geometry is "
                "wrong; measure the lenses, or let somebody walk nearer and through more of each picture"
            )
