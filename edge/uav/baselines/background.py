"""Section 4.2: background motion between two frames by a particle filter on optical flow (4.10 to 4.18)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.base import Box
from edge.uav.prediction import particle_filter as pf
from protocols.geometry.types import Bools, Floats

Grey = npt.NDArray[np.uint8]

_PARTICLES = 500  # of three dimensions: more cost CPU, fewer make their mean noisy
_INITIAL_STD = np.array([8.0, 8.0, 0.02])  # std of the initial motion: px, px, rad
_PROCESS_NOISE_STD = np.array([2.5, 2.5, 0.008])  # std per frame: px, px, rad
_SMALL_STEP_SCALE = 0.08  # factor on the noise of a share of the particles, for precision in a steady flight
_SMALL_STEP_SHARE = 0.6  # the others follow manoeuvres
_SHARPNESS = 12.0  # lambda of the likelihood [1/px]
_MAX_RESIDUAL = 3.0  # px: flow residuals are capped here; larger ones belong to moving objects
_MAX_CORNERS = 90  # each adds a residual to every particle's likelihood: CPU
_MIN_FLOWS = 6  # smallest number of flow vectors for an update; with fewer, prediction only
_MIN_CORNERS = 60  # with fewer they are detected anew: those that leave the image leave one side of it empty
_BORDER = 24  # px: corners nearer to the border than this are not used
_CORNER_SPACING = 14  # px between corners
_WINDOW = (15, 15)  # px: a smaller one fails where there is little texture, a larger one mixes motions
_LEVELS = 3  # halvings of the image: half a window of the smallest one is 56 px


@dataclass(frozen=True, slots=True)
class BackgroundMotion:
    """The background's motion from one frame to the next: h. x, y [px]; rotation [rad] about the image centre."""

    x: float = 0.0
    y: float = 0.0
    rotation: float = 0.0

    def moved(self, points: Floats, centre: Floats) -> Floats:
        """The matrix of (4.19): R(h_w) (p - c) + c + h, of points (n, 2); centre (2,): of the image.

        The paper implicitly takes positions relative to the image centre; the signs are those of the flow
        model (4.17), (4.18): u = -wY, v = wX.
        """
        cos, sin = np.cos(self.rotation), np.sin(self.rotation)
        rotation = np.array([[cos, -sin], [sin, cos]])
        return np.asarray((points - centre) @ rotation.T + centre + [self.x, self.y], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class OpticalFlow:
    """points: (m, 2) relative to the image centre, in the earlier frame. vectors: (m, 2) to the later one. Pixels."""

    points: Floats
    vectors: Floats


def predicted_flow(motions: Floats, points: Floats) -> Floats:
    """Eqs. (4.17), (4.18): u = h_x - w Y, v = h_y + w X. motions (n, 3), points (m, 2) from the centre -> (n, m, 2)."""
    x, y = points[:, 0], points[:, 1]
    return np.stack([motions[:, :1] - motions[:, 2:] * y[None], motions[:, 1:2] + motions[:, 2:] * x[None]], axis=-1)


class BackgroundFilter:
    """The motion of the background from frame to frame. size: (width, height) [px].

    It is its particles' model, too: states (h_x, h_y, h_w) in px, px, rad a frame.
    """

    def __init__(self, size: tuple[int, int], rng: np.random.Generator) -> None:
        self._size, self._rng = size, rng
        self._centre = (np.array(size, dtype=np.float64) - 1.0) / 2.0
        self._particles = pf.Particles.uniform(rng.standard_normal((_PARTICLES, 3)) * _INITIAL_STD)
        self._grey: Grey = np.zeros((size[1], size[0]), dtype=np.uint8)
        self._corners = np.zeros((0, 2), dtype=np.float32)
        self.flow = OpticalFlow(np.zeros((0, 2)), np.zeros((0, 2)))
        """Optical flow of the last step."""

    def begin(self, grey: Grey, target: Box) -> None:
        """Initialise with the first frame."""
        self._grey = grey
        self._corners = self._detect_corners(grey, target)

    def step(self, grey: Grey, target: Box | None) -> BackgroundMotion:
        """The motion from the previous frame to this one. target: box of the car, excluded from corner detection."""
        tracked, good = self._track(grey)
        before = self._corners[good].astype(np.float64) - self._centre
        self.flow = OpticalFlow(before, tracked[good].astype(np.float64) - self._corners[good])
        enough = len(before) >= _MIN_FLOWS
        self._particles = pf.step(self._particles, self, self.flow if enough else None, self._rng, resample_below=1.0)
        h = pf.weighted_mean(self._particles.states, self._particles.weights)
        self._grey, self._corners = grey, self._inside(tracked[good], target)
        if len(self._corners) < _MIN_CORNERS:
            self._corners = self._detect_corners(grey, target)
        return BackgroundMotion(float(h[0]), float(h[1]), float(h[2]))

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Eqs. (4.10) to (4.12): random walks. Deviation: heavy-tailed noise, a share of the steps is small."""
        step_scale = np.where(rng.random(len(states)) < _SMALL_STEP_SHARE, _SMALL_STEP_SCALE, 1.0)
        return np.asarray(
            states + step_scale[:, None] * _PROCESS_NOISE_STD * rng.standard_normal(states.shape), dtype=np.float64
        )

    def log_likelihood(self, states: Floats, observation: OpticalFlow) -> Floats:
        """Second eq. (4.18): exp(-lambda mean ||V - V(h)||), the norm capped for robustness to other cars."""
        residual = predicted_flow(states, observation.points) - observation.vectors
        distance = np.sqrt(np.square(residual).sum(axis=-1))
        return np.asarray(-_SHARPNESS * np.minimum(distance, _MAX_RESIDUAL).mean(axis=1), dtype=np.float64)

    def _track(self, grey: Grey) -> tuple[npt.NDArray[np.float32], Bools]:
        """Pyramidal Kanade-Lucas-Tomasi tracking: current positions of the corners (m, 2), and which were found."""
        if not len(self._corners):
            return np.zeros((0, 2), dtype=np.float32), np.zeros(0, dtype=np.bool_)
        start = self._corners.reshape(-1, 1, 2)
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._grey, grey, start, start.copy(), winSize=_WINDOW, maxLevel=_LEVELS
        )
        return np.asarray(found, dtype=np.float32).reshape(-1, 2), status.ravel() > 0

    def _detect_corners(self, grey: Grey, target: Box | None) -> npt.NDArray[np.float32]:
        """Harris corners (m, 2) away from the border and the target, detected at half the resolution."""
        half = cv2.pyrDown(grey)
        mask = np.zeros(half.shape, dtype=np.uint8)
        edge = _BORDER // 2
        mask[edge:-edge, edge:-edge] = 255
        if target is not None:
            cv2.rectangle(mask, *_corners_of(target), 0, -1)
        found = cv2.goodFeaturesToTrack(
            half, _MAX_CORNERS, 0.002, _CORNER_SPACING / 2, mask=mask, useHarrisDetector=True, k=0.04
        )
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
    """Opposite corners of the enlarged box at half the resolution."""
    grow = 0.2 * max(target.width, target.height)
    first = (round((target.x - grow) / 2), round((target.y - grow) / 2))
    return first, (round((target.x + target.width + grow) / 2), round((target.y + target.height + grow) / 2))
