"""How probable it is that one track's future is another's past: the pairs of which trajectories are linked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY, log_density
from hub.tracking.filter.prediction import ManoeuvreHypothesis, log_mixture
from hub.tracking.filter.target_models import CLUTTER_COLOUR_STD, TARGET_MODELS
from hub.tracking.filter.target_states import Targets
from protocols.geometry.types import Floats, Ints

_REGION_M = 1.5
"""Radius within which entries and exits are counted: a walker's way in a second."""
_MAX_LINK_M = 6.0  # between where the past would be and the future: farther pairs are not scored
_COLOUR_MAX = 12.0  # chi-squared of three channels: once in 140 by chance; a shadow or a wrong box


@dataclass(frozen=True, slots=True, eq=False)
class EntryExitRates:
    """Where tracks begin and end, a scan, as estimated from all tracks of a recording.

    Rates by counts within a radius, with Jeffreys' prior (half an event): people come and go at doors and at the
    borders of what the cameras see, not in the middle of a hall. Entry and exit zones: Makris and Ellis, "Learning
    semantic scene models from observing activity in visual surveillance" (2005).

    starts, ends: (n, 3) of each track, NaN where that is unknown. scans: their number.
    """

    starts: Floats
    ends: Floats
    scans: int
    radius: float
    _trees: tuple[cKDTree, cKDTree, cKDTree]

    @classmethod
    def of(cls, starts: Floats, ends: Floats, visits: Floats, scans: int, units_per_m: float) -> EntryExitRates:
        """From where tracks begin and end. visits: (v, 3) places of all tracks at all scans."""
        trees = [cKDTree(points[np.isfinite(points).all(axis=1)]) for points in (starts, ends, visits)]
        return cls(starts, ends, scans, _REGION_M * units_per_m, (trees[0], trees[1], trees[2]))

    def log_entry(self, track: Ints, place: Floats) -> Floats:
        """Log rate (n,) of others' beginnings, an area unit and a scan, where a track is. track: (n,) its number."""
        begun = self._within(0, place) - self._is_own(self.starts, track, place)
        return np.asarray(np.log((begun + 0.5) / (np.pi * self.radius**2 * self.scans)))

    def log_exit(self, track: Ints, place: Floats) -> Floats:
        """Log odds (n,) of ending at a scan, against going on, where a track is."""
        ended = self._within(1, place) - self._is_own(self.ends, track, place)
        return np.asarray(np.log((ended + 0.5) / (np.maximum(self._within(2, place) - ended, 0.0) + 0.5)))

    def _within(self, which: int, place: Floats) -> Floats:
        found = self._trees[which].query_ball_point(place, self.radius, return_length=True)
        return np.asarray(found, dtype=np.float64)

    def _is_own(self, points: Floats, track: Ints, place: Floats) -> Floats:
        return np.asarray(np.linalg.norm(points[track] - place, axis=1) <= self.radius, dtype=np.float64)


def continuation_scores(
    past: Targets,
    future: Targets,
    manoeuvre: ManoeuvreHypothesis,
    gap_s: Floats,
    rates: tuple[Floats, Floats],
    units_per_m: float,
    typical: float,
    colour_std: float,
) -> Floats:
    """Log odds (h, t) of each future continuing each past, against the past ending and the future beginning anywhere.

    past, future: h and t tracks at one time, from the detections before and from those after it; two with one
    ``initiation_number`` are the same track. manoeuvre: second hypothesis of the pasts.
    gap_s: (h,) since the last detections. rates: log odds (h,) of the pasts' ending, and log rate (t,) of new tracks
    where the futures begin. typical: log of a typical size.
    """
    off = past.mean[:, None] - future.mean[None]
    near = np.linalg.norm(off[..., POSITION], axis=2) < _MAX_LINK_M * units_per_m
    a, b = np.nonzero(near & (past.kind[:, None] == future.kind[None, :]))
    score = np.full(near.shape, -np.inf)
    if not len(a):
        return score
    total = past.covariance[a] + future.covariance[b]
    changed = log_density(off[a, b], manoeuvre.covariance[a] + future.covariance[b])
    fit = log_mixture(manoeuvre.prior_odds[a], log_density(off[a, b], total), changed)
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
    chance_of = chance[b] + rates[1][b] - 0.5 * np.log(vertical) + np.log(2.0 * np.pi)
    off2 = ((past.colour[a] - future.colour[b]) ** 2).sum(axis=1) / colour_std**2
    alike = np.nan_to_num(3.0 * np.log(CLUTTER_COLOUR_STD / colour_std) - 0.5 * np.minimum(off2, _COLOUR_MAX))
    alike[past.initiation_number[a] == future.initiation_number[b]] = 0.0  # one track's colour says nothing of it
    score[a, b] = fit - chance_of - rates[0][a] - gap_s[a] + alike
    return score
