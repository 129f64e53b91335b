"""The floor on which people stand: a plane estimated from their feet, and a constraint for their tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.tracking.filter.kalman import LOG_SIZE, POSITION, STATE_DIM
from hub.tracking.filter.target_models import PERSON
from protocols.geometry.types import Floats

_SLOPE_STD = 0.02
"""Of the plane against the vertical: a levelled camera or an estimated vertical is off by about one degree."""
_ROUGHNESS_M = 0.05
"""Std of a foot's height above the plane: steps, soles, and a walking person's changing height."""
_FIRST_VIEWS, _MAX_VIEWS = 30, 300
"""Views of people from which the first height is estimated (its std is then a fifth of one view's), and of the last
ones if they do not suffice."""
_MAX_LEVEL_STD = 0.15
"""As a fraction of a person's height: below it, the floor is known well enough to place people on it."""
_FEET_STD_M = 0.3
"""Of one foot's height, for the plane. Ten times the roughness: feet of one person at 10 Hz are not independent."""


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """A plane: height above the world's origin along up = level + slope · (horizontal position - origin).

    up: (3,). axes: (2, 3) horizontal unit vectors. origin: (2,) along them. mean: (3,) level and slope. covariance:
    (3, 3). units_per_m: of the world. views: (k, 3) single views of people until the first estimate: camera, its
    height along up, and how far below it a foot is, as a fraction of the person's height. height: typical, of people.
    """

    up: Floats
    axes: Floats
    units_per_m: float
    origin: Floats
    mean: Floats
    covariance: Floats
    views: Floats
    height: float

    @classmethod
    def unknown(cls, up: Floats, units_per_m: float) -> Floor:
        """Before anybody was seen."""
        first = np.eye(3)[int(np.argmin(np.abs(up)))]
        x = first - up * (up @ first)
        x /= np.linalg.norm(x)
        covariance = np.diag([np.inf, _SLOPE_STD**2, _SLOPE_STD**2])
        axes = np.stack([x, np.cross(up, x)])
        height = PERSON.size_m * units_per_m
        return cls(up, axes, units_per_m, np.zeros(2), np.zeros(3), covariance, np.zeros((0, 3)), height)

    @property
    def known(self) -> bool:
        """Whether people can be placed on it."""
        return bool(self.covariance[0, 0] < (_MAX_LEVEL_STD * self.height) ** 2)

    def heights(self, points: Floats) -> tuple[Floats, Floats]:
        """Heights (n,) of the floor under points (n, 3), along up, and the variances of a foot there."""
        design = self._design(points)
        spread = np.einsum("ni,ij,nj->n", design, self.covariance, design)
        return design @ self.mean, spread + (_ROUGHNESS_M * self.units_per_m) ** 2

    def with_views(self, views: Floats, enough_cameras: int) -> Floor:
        """With more single views (n, 3): level and typical height by least squares over the cameras.

        A foot that is ``b`` heights below its camera at height ``c`` stands at c - b · height, which is the level for
        all of them: cameras at different heights determine both, others need the prior of a person's height.
        """
        views = np.concatenate([self.views, views])[-_MAX_VIEWS:]
        cameras = np.unique(views[:, 0])
        if len(views) < _FIRST_VIEWS or len(cameras) < enough_cameras:
            return replace(self, views=views)
        prior, prior_std = PERSON.size_m * self.units_per_m, PERSON.size_m * PERSON.log_size_std * self.units_per_m
        rows, target = [[0.0, 1.0 / prior_std]], [prior / prior_std]
        for camera in cameras:
            _, c, below = views[views[:, 0] == camera].T
            middle = float(np.median(below))
            # One person's height differs by its std from the typical one, and so does what is seen of it.
            std = middle * prior_std / np.sqrt(len(below)) + 1.4826 * float(np.median(np.abs(below - middle))) * prior
            std = max(std / np.sqrt(len(below)), 0.02 * self.units_per_m)
            rows.append([1.0 / std, middle / std])
            target.append(float(c[0]) / std)
        design = np.array(rows)
        covariance = np.linalg.inv(design.T @ design)
        level, height = covariance @ design.T @ np.array(target)
        full = self.covariance.copy()
        full[0, 0] = covariance[0, 0]
        return replace(self, mean=np.array([level, 0.0, 0.0]), covariance=full, views=views, height=float(height))

    def with_feet(self, feet: Floats) -> Floor:
        """With the feet (n, 3) of confirmed tracks at one instant."""
        if not len(feet):
            return self
        if not np.isfinite(self.covariance[0, 0]):
            covariance = self.covariance.copy()
            covariance[0, 0] = (1e3 * self.units_per_m) ** 2
            begun = replace(self, origin=(feet @ self.axes.T).mean(axis=0), covariance=covariance)
            return begun.with_feet(feet)
        design = self._design(feet)
        innovation = feet @ self.up - design @ self.mean
        noise = (_FEET_STD_M * self.units_per_m) ** 2
        keep = innovation**2 < 9.0 * (np.einsum("ni,ij,nj->n", design, self.covariance, design) + noise)
        design, innovation = design[keep], innovation[keep]
        if not len(design):
            return self
        gain = self.covariance @ design.T
        gain = np.linalg.solve(design @ gain + noise * np.eye(len(design)), gain.T).T
        covariance = self.covariance - gain @ design @ self.covariance
        # The floor is never known better than to a centimetre: tracks lean on it, so their feet are no new evidence.
        covariance[0, 0] = max(covariance[0, 0], (0.01 * self.units_per_m) ** 2)
        return replace(self, mean=self.mean + gain @ innovation, covariance=0.5 * (covariance + covariance.T))

    def constraint(self, mean: Floats) -> tuple[Floats, Floats, Floats]:
        """The pseudo-measurement "the foot is on the floor" of states (n, 7): innovation, Jacobian (n, 7), variance."""
        size = np.exp(mean[:, LOG_SIZE])
        points = mean[:, POSITION]
        level, variance = self.heights(points)
        jacobian = np.zeros((len(mean), STATE_DIM))
        jacobian[:, POSITION] = self.up - self.mean[1:] @ self.axes
        jacobian[:, LOG_SIZE] = -0.5 * size
        return level - (points @ self.up - 0.5 * size), jacobian, variance

    def _design(self, points: Floats) -> Floats:
        return np.column_stack([np.ones(len(points)), points @ self.axes.T - self.origin])
