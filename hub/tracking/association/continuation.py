"""How probable it is that one track's future is another's past: the pairs of which trajectories are linked."""

from __future__ import annotations

import numpy as np

from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY, log_density
from hub.tracking.filter.manoeuvre import ManoeuvreHypothesis
from hub.tracking.filter.target_models import TARGET_MODELS
from hub.tracking.filter.target_states import Targets
from protocols.geometry.types import Floats

_LOG_CONTINUED = 3.0
"""Log odds of a track going on against one ending and another beginning: one in twenty does, a scan."""
_ARRIVAL_AREA_M2 = 200.0
"""In which new tracks begin."""
_MAX_LINK_M = 6.0
_CLUTTER_COLOUR_STD, _COLOUR_MAX = 60.0, 12.0
"""Of a channel of other people's colours; limit of a squared difference, over its variance."""


def continuation_scores(
    past: Targets,
    future: Targets,
    manoeuvre: ManoeuvreHypothesis,
    gap_s: Floats,
    units_per_m: float,
    typical: float,
    colour_std: float,
) -> Floats:
    """Log odds (h, t) of each future continuing each past, against the past ending and the future beginning anywhere.

    past, future: h and t tracks at one time, from the detections before and from those after it; two with one
    ``initiation_number`` are the same track. manoeuvre: second hypothesis of the pasts.
    gap_s: (h,) since the last detections. typical: log of a typical size.
    """
    off = past.mean[:, None] - future.mean[None]
    near = np.linalg.norm(off[..., POSITION], axis=2) < _MAX_LINK_M * units_per_m
    a, b = np.nonzero(near & (past.kind[:, None] == future.kind[None, :]))
    score = np.full(near.shape, -np.inf)
    if not len(a):
        return score
    total = past.covariance[a] + future.covariance[b]
    odds = manoeuvre.prior_odds[a]
    with np.errstate(divide="ignore"):
        changed = log_density(off[a, b], manoeuvre.covariance[a] + future.covariance[b]) + np.log(odds)
    fit = np.logaddexp(log_density(off[a, b], total), changed) - np.log1p(odds)
    # The same, had the future begun anywhere: position uniform, velocity and size from their priors.
    model = [TARGET_MODELS[kind] for kind in future.kind.tolist()]
    speed = np.array([one.speed_std_m_s for one in model]) * units_per_m
    free = future.covariance[:, VELOCITY, VELOCITY] + speed[:, None, None] ** 2 * np.eye(3)
    velocity = future.mean[:, VELOCITY]
    chance = -0.5 * (np.einsum("ni,nij,nj->n", velocity, np.linalg.inv(free), velocity) + np.linalg.slogdet(free)[1])
    size2 = np.array([one.log_size_std for one in model]) ** 2 + future.covariance[:, LOG_SIZE, LOG_SIZE]
    chance -= 0.5 * ((future.mean[:, LOG_SIZE] - typical) ** 2 / size2 + np.log(size2))
    # The height is that of the floor in both cases: only the two horizontal dimensions are free.
    vertical = np.linalg.eigvalsh(total[:, POSITION, POSITION])[:, 0]
    chance_of = chance[b] - np.log(_ARRIVAL_AREA_M2 * units_per_m**2) - 0.5 * np.log(vertical) + np.log(2.0 * np.pi)
    off2 = ((past.colour[a] - future.colour[b]) ** 2).sum(axis=1) / colour_std**2
    alike = np.nan_to_num(3.0 * np.log(_CLUTTER_COLOUR_STD / colour_std) - 0.5 * np.minimum(off2, _COLOUR_MAX))
    alike[past.initiation_number[a] == future.initiation_number[b]] = 0.0  # one track's colour says nothing of it
    score[a, b] = fit - chance_of + _LOG_CONTINUED - gap_s[a] + alike
    return score
