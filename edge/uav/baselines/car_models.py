"""State-space models of the car: section 3 (the road determines the heading), section 4 (the road is observed)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.base import Box
from edge.uav.baselines import histograms
from edge.uav.baselines.background import BackgroundMotion
from edge.uav.baselines.regions import ExistenceMap
from edge.uav.baselines.road import (
    RoadCourse,
    mixture_log_likelihood,
    orientation_log_likelihood,
    road_heading,
    road_log_likelihood,
)
from protocols.geometry.types import Floats, Image

_TURN_NOISE = 0.06  # rad a frame
_ROAD_TURN_NOISE = 0.10  # rad: std of theta' about the road heading
_ALPHA = 0.95  # of (3.12); the paper gives no value. With less, the road term pulls the particles off a visible car
_ORIENTATION_STD = 0.35  # rad, of (4.22)


@dataclass(frozen=True, slots=True, eq=False)
class FrameObservation:
    """The observation of one frame from which the particles are weighted.

    image: None if it could not be decoded. template, mean: (BINS,). course: None without a known road. direction: of
    travel along the order of the course's points, +1 or -1; 0 if unknown. existence: None if regions are unknown.
    """

    image: Image | None
    box: Box
    template: Floats
    mean: Floats
    course: RoadCourse | None
    direction: int
    existence: ExistenceMap | None

    def colour(self, positions: Floats) -> Floats:
        """Log-likelihood (n,) of (2.8) with (3.13) at positions (n, 2); zeros without an image."""
        if self.image is None:
            return np.zeros(len(positions))
        similarity = histograms.border_filled_similarity(self.image, positions, self.box, self.template, self.mean)
        return histograms.colour_log_likelihood(similarity)

    def road(self, positions: Floats, headings: Floats) -> tuple[Floats, Floats]:
        """Distances (n,) to the road and theta_road (n,) of (3.9) for particles (n, 2), (n,) [rad]; requires a course.

        While the direction of travel is unknown, each particle takes the direction nearer to its own heading.
        """
        assert self.course is not None
        distance, tangent = self.course.nearest(positions)
        against = np.cos(tangent - headings) < 0.0
        direction = np.where(against, -1.0, 1.0) if self.direction == 0 else float(self.direction)
        return distance, road_heading(tangent, direction)


class RoadSteeredModel:
    """Section 3.2: the road gives the heading; the likelihood is a mixture of colour and road.

    Section 3 takes the helicopter's controls as known; here the estimated motion of section 4.2 replaces them.
    """

    def __init__(self, centre: Floats, speed_noise: float) -> None:
        self.centre, self.speed_noise = centre, speed_noise
        self.motion = BackgroundMotion()
        self.previous: FrameObservation | None = None

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Eqs. (2.3), (2.4) and (3.9), (3.10): theta is the road heading at the previous position, plus noise.

        Without a road, (2.5). The result is transformed into the new frame as in (4.19).
        """
        noise = rng.standard_normal((len(states), 2))
        heading = states[:, 3] + _TURN_NOISE * noise[:, 0]
        if self.previous is not None and self.previous.course is not None:
            heading = self.previous.road(states[:, :2], states[:, 3])[1] + _ROAD_TURN_NOISE * noise[:, 0]
        turned = np.column_stack([states[:, :3], heading])
        return move_with_background(
            turned, self.motion, self.centre, self.speed_noise * noise[:, 1], np.zeros(len(states))
        )

    def log_likelihood(self, states: Floats, observation: FrameObservation) -> Floats:
        """Eqs. (2.8), (3.11) to (3.13)."""
        colour = observation.colour(states[:, :2])
        if observation.course is None:
            return colour
        distance, _ = observation.road(states[:, :2], states[:, 3])
        return mixture_log_likelihood(colour, road_log_likelihood(distance, observation.course.half_width), _ALPHA)


class BackgroundAwareModel:
    """Section 4.3: the background's motion moves the car; colour, orientation and existence are observed."""

    def __init__(self, centre: Floats, speed_noise: float) -> None:
        self.centre, self.speed_noise = centre, speed_noise
        self.motion = BackgroundMotion()
        self.previous: FrameObservation | None = None

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Eqs. (4.19) to (4.21)."""
        noise = rng.standard_normal((len(states), 2))
        return move_with_background(
            states, self.motion, self.centre, self.speed_noise * noise[:, 0], _TURN_NOISE * noise[:, 1]
        )

    def log_likelihood(self, states: Floats, observation: FrameObservation) -> Floats:
        """Eq. (4.23): the product of colour (2.8), orientation (4.22) and existence (section 4.3)."""
        total = observation.colour(states[:, :2])
        if observation.course is not None:
            _, road = observation.road(states[:, :2], states[:, 3])
            total = total + orientation_log_likelihood(states[:, 3], road, _ORIENTATION_STD)
        if observation.existence is not None:
            total = total + observation.existence.log_likelihood(states[:, :2])
        return total


def move_with_background(
    states: Floats, motion: BackgroundMotion, centre: Floats, speed_noise: Floats, turn_noise: Floats
) -> Floats:
    """Eqs. (4.19) to (4.21): p <- R(h_w)(p + V [cos theta, sin theta]) + h, theta += h_w + noise, V random walk.

    states: (n, 4). centre: (2,) of the image, about which the background turns. Noises (n,): px a frame, rad.
    """
    x, y, speed, heading = states.T
    driven = np.column_stack([x + speed * np.cos(heading), y + speed * np.sin(heading)])
    return np.column_stack([motion.moved(driven, centre), speed + speed_noise, heading + motion.rotation + turn_noise])
