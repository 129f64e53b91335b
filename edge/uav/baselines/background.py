"""Section 4.2: how the background moves between two frames, by a particle filter on optical flow (4.10 to 4.18)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.prediction import particles as pf
from edge.uav.tracker import Box
from protocols.geometry.types import Bools, Floats

Grey = npt.NDArray[np.uint8]

_PARTICLES = 500
_START = np.array([8.0, 8.0, 0.02])  # std of the first motion: px, px, rad
_NOISE = np.array([2.5, 2.5, 0.008])  # a frame; the same
_CALM = 0.08  # a share of the particles walks this much less, so that a steady flight is followed finely
_CALM_SHARE = 0.6
_SHARPNESS = 12.0  # lambda of the likelihood [1/px]
_CAP = 3.0  # px: a flow that is farther off belongs to something that moves by itself
_CORNERS = 90
_FEWEST = 6  # flows, below which the motion is only predicted
_REPLENISH = 60
_BORDER = 24  # px: corners nearer to the border than this are left out
_APART = 14  # px between corners
_WINDOW = (15, 15)
_LEVELS = 3


@dataclass(frozen=True, slots=True)
class Motion:
    """The background's motion from one frame to the next: h. x, y [px]; turn [rad] about the image's centre."""

    x: float = 0.0
    y: float = 0.0
    turn: float = 0.0

    def moved(self, points: Floats, centre: Floats) -> Floats:
        """The matrix of (4.19): R(h_w) (p - c) + c + h, of points (n, 2); centre (2,) is the image's.

        The paper takes positions relative to the image's centre without saying so; the signs are those of the flow
        model (4.17), (4.18): u = -wY, v = wX.
        """
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        turn = np.array([[cos, -sin], [sin, cos]])
        return np.asarray((points - centre) @ turn.T + centre + [self.x, self.y], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """points: (m, 2) from the image's centre, in the earlier frame. vectors: (m, 2) to the later one. Pixels."""

    points: Floats
    vectors: Floats


def flow_of(motions: Floats, points: Floats) -> Floats:
    """Eqs. (4.17), (4.18): u = h_x - w Y, v = h_y + w X. motions (n, 3), points (m, 2) from the centre -> (n, m, 2)."""
    x, y = points[:, 0], points[:, 1]
    return np.stack(
        [motions[:, :1] - motions[:, 2:] * y[None], motions[:, 1:2] + motions[:, 2:] * x[None]],
        axis=-1,
    )


class MotionModel:
    """States (h_x, h_y, h_w): px, px, rad a frame."""

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Eqs. (4.10) to (4.12): random walks. Deviation: a share of the steps is small, as noise with heavy tails."""
        calm = np.where(rng.random(len(states)) < _CALM_SHARE, _CALM, 1.0)
        return np.asarray(states + calm[:, None] * _NOISE * rng.standard_normal(states.shape), dtype=np.float64)

    def log_likelihood(self, states: Floats, observation: Flow) -> Floats:
        """Second eq. (4.18): exp(-lambda mean ||V - V(h)||), the norm capped so that other cars do not pull."""
        apart = flow_of(states, observation.points) - observation.vectors
        distance = np.sqrt(np.square(apart).sum(axis=-1))
        return np.asarray(-_SHARPNESS * np.minimum(distance, _CAP).mean(axis=1), dtype=np.float64)


class BackgroundFilter:
    """The motion of the background from frame to frame. size: (width, height) [px]."""

    def __init__(self, size: tuple[int, int], rng: np.random.Generator) -> None:
        self._size, self._rng = size, rng
        self._centre = (np.array(size, dtype=np.float64) - 1.0) / 2.0
        self._model = MotionModel()
        self._cloud = pf.Particles.evenly(rng.standard_normal((_PARTICLES, 3)) * _START)
        self._grey: Grey = np.zeros((size[1], size[0]), dtype=np.uint8)
        self._corners = np.zeros((0, 2), dtype=np.float32)
        self.flow = Flow(np.zeros((0, 2)), np.zeros((0, 2)))
        """Of the last step."""

    def begin(self, grey: Grey, target: Box) -> None:
        """Take the first frame."""
        self._grey = grey
        self._corners = self._harris(grey, target)

    def step(self, grey: Grey, target: Box | None) -> Motion:
        """The motion from the last frame given to this one. target: where the car is (no corners are taken there)."""
        tracked, good = self._track(grey)
        before = self._corners[good].astype(np.float64) - self._centre
        self.flow = Flow(before, tracked[good].astype(np.float64) - self._corners[good])
        enough = len(before) >= _FEWEST
        self._cloud = pf.step(self._cloud, self._model, self.flow if enough else None, self._rng, resample_below=1.0)
        h = pf.weighted_mean(self._cloud.states, self._cloud.weights)
        self._grey, self._corners = grey, self._inside(tracked[good], target)
        if len(self._corners) < _REPLENISH:
            self._corners = self._harris(grey, target)
        return Motion(float(h[0]), float(h[1]), float(h[2]))

    def _track(self, grey: Grey) -> tuple[npt.NDArray[np.float32], Bools]:
        """Pyramidal Kanade-Lucas-Tomasi: where the corners (m, 2) are now, and which were found."""
        if not len(self._corners):
            return np.zeros((0, 2), dtype=np.float32), np.zeros(0, dtype=np.bool_)
        start = self._corners.reshape(-1, 1, 2)
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._grey, grey, start, start.copy(), winSize=_WINDOW, maxLevel=_LEVELS
        )
        return np.asarray(found, dtype=np.float32).reshape(-1, 2), status.ravel() > 0

    def _harris(self, grey: Grey, target: Box | None) -> npt.NDArray[np.float32]:
        """Harris corners (m, 2) away from the border and the target; looked for at half the resolution."""
        half = cv2.pyrDown(grey)
        mask = np.zeros(half.shape, dtype=np.uint8)
        edge = _BORDER // 2
        mask[edge:-edge, edge:-edge] = 255
        if target is not None:
            cv2.rectangle(mask, *_corners_of(target), 0, -1)
        found = cv2.goodFeaturesToTrack(half, _CORNERS, 0.002, _APART / 2, mask=mask, useHarrisDetector=True, k=0.04)
        if found is None:
            return np.zeros((0, 2), dtype=np.float32)
        return np.asarray(found.reshape(-1, 2) * 2.0, dtype=np.float32)

    def _inside(self, corners: npt.NDArray[np.float32], target: Box | None) -> npt.NDArray[np.float32]:
        x, y = corners.T
        keep = (x > _BORDER) & (x < self._size[0] - _BORDER) & (y > _BORDER) & (y < self._size[1] - _BORDER)
        if target is not None:
            keep &= ~((x > target.x) & (x < target.x + target.width) & (y > target.y) & (y < target.y + target.height))
        return np.asarray(corners[keep], dtype=np.float32)


def _corners_of(target: Box) -> tuple[tuple[int, int], tuple[int, int]]:
    """Opposite corners of the box at half the resolution, a little wider than it."""
    grow = 0.2 * max(target.width, target.height)
    first = (round((target.x - grow) / 2), round((target.y - grow) / 2))
    return first, (round((target.x + target.width + grow) / 2), round((target.y + target.height + grow) / 2))
