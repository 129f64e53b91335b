"""The ground as one camera sees it, from upright people of one height: single-view calibration by pedestrians.

Lv, Zhao and Nevatia (2006) find focal length and horizon from heads and feet; here the lens is known, and the sizes
of all bodies give the camera's vertical and its height above the ground in heights of a person.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocols.geometry.types import Bools, Floats, Ints

_MIN_BODIES = 40  # as many as an angle of 1 degree needs with heights of 5 % (std) in one half of a picture
_SPREAD = 0.05  # log size: people differ by 4 %, boxes by 3 %; the scale of the robust loss
_HEIGHTS_STD = 0.1  # log height of somebody, where each body's person is known: adults; the loss lets children be
_MAX_SPREAD = 0.25  # of log size, robust std: beyond, what is seen are no upright people on one plane
_MAX_ANGLE_STD = np.deg2rad(3.0)
"""Of the vertical: people in one place of the picture tell a size, not how it grows. From 3 degrees on, a ground point
at ten heights from the camera is half a height off, as far as people keep apart."""
_TILTS, _HEIGHTS = (0.05, 0.3, 0.8), (0.2, 0.6, 1.6)  # first values: slope of the vertical, heights over the camera's
_HORIZON = 0.02  # sine of the angle below the horizon, at least: a tenth of a height is 50 heights away


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """n bodies in normalised coordinates. centre: (n, 2) of a body. top, bottom: (n,) y of head and foot."""

    centre: Floats
    top: Floats
    bottom: Floats

    def ends(self, up: Floats) -> Floats:
        """Head and foot (2, n, 2) on the image of the vertical ``up`` (3,) through the centre."""
        slope = (up[0] - self.centre[:, 0] * up[2]) / (up[1] - self.centre[:, 1] * up[2])
        y = np.stack([self.top, self.bottom])
        return np.stack([self.centre[:, 0] + slope * (y - self.centre[:, 1]), y], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class GroundPlane:
    """up: (3,) unit vector in the camera's axes. height: of the camera above the ground, in heights of a person."""

    up: Floats
    height: float

    @property
    def local_from_camera(self) -> Floats:
        """Rotation (3, 3) to axes on the ground: along the optical axis, to the left, up."""
        forward = np.array([0.0, 0.0, 1.0]) - self.up[2] * self.up
        forward /= np.linalg.norm(forward)
        return np.stack([forward, np.cross(self.up, forward), self.up])

    def places(self, bodies: Bodies) -> tuple[Floats, Bools]:
        """Where the bodies stand (n, 2) [heights], in the local axes from the point below the camera, and which of
        them are below the horizon."""
        foot = bodies.ends(self.up)[1]
        rays = np.column_stack([foot, np.ones(len(foot))]) @ self.local_from_camera.T
        below = rays[:, 2] < -_HORIZON * np.linalg.norm(rays, axis=1)
        return rays[:, :2] * (self.height / np.where(below, -rays[:, 2], np.inf))[:, None], below


def estimate_ground_plane(bodies: Bodies, person: Ints | None = None) -> GroundPlane | None:
    """The ground plane on which bodies of one height stand; None where they do not determine it.

    person: (n,) whose body each one is, from 0: then each person has a height, and the mean is of people.
    """
    from scipy.optimize import least_squares  # a quarter of a second to import, which markers do not need

    if len(bodies.top) < _MIN_BODIES:
        return None
    size = bodies.bottom - bodies.top

    def residuals(x: Floats) -> Floats:
        """Log of predicted over observed size, and heights. x: slopes of the vertical, log height of people over the
        camera's, log of each one's over that."""
        up = np.array([x[0], -1.0, x[1]]) / np.sqrt(1.0 + x[0] ** 2 + x[1] ** 2)
        foot = np.column_stack([bodies.ends(up)[1], np.ones(len(size))])
        down = -foot @ up
        below = down > _HORIZON
        tall = np.exp(x[2] + np.append(x[3:], 0.0)[whose])
        head = foot / np.where(below, down, 1.0)[:, None] + tall[:, None] * up
        above = bodies.bottom - head[:, 1] / np.maximum(head[:, 2], _HORIZON)
        errors = np.where(below & (above > 0.0), np.log(np.maximum(above, 1e-6) / size), 20.0 * _SPREAD)
        return np.append(errors, _SPREAD / _HEIGHTS_STD * x[3:])

    whose = np.full(len(size), -1)
    starts = [np.array([0.0, tilt, np.log(height)]) for tilt in _TILTS for height in _HEIGHTS]
    if person is not None:
        if (plain := estimate_ground_plane(bodies)) is None:
            return None
        whose, slopes = person, -plain.up[[0, 2]] / plain.up[1]
        starts = [np.array([*slopes, -np.log(plain.height), *np.zeros(person.max() + 1)])]
    found = [least_squares(residuals, start, loss="cauchy", f_scale=_SPREAD, max_nfev=50) for start in starts]
    best = min(found, key=lambda one: float(one.cost))
    errors = residuals(best.x)[: len(size)]
    spread = 1.4826 * float(np.median(np.abs(errors)))
    jacobian = np.asarray(best.jac)
    information = jacobian.T @ jacobian / max(spread, 1e-3) ** 2
    stds = np.sqrt(np.diag(np.linalg.pinv(information)))
    if spread > _MAX_SPREAD or stds[:2].max() > _MAX_ANGLE_STD:
        return None
    up = np.array([best.x[0], -1.0, best.x[1]])
    return GroundPlane(up / np.linalg.norm(up), float(np.exp(-best.x[2])))
