"""What every model of the UAV tracker takes and gives; the models themselves are in their own files.

A tracker knows no files, sockets, threads or clocks: ``begin`` with a frame and the target's box, then one
``handle_frame`` a frame and ``handle_telemetry`` for each sample, in the order in which they arrive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats

Image = npt.NDArray[np.uint8]


class State(StrEnum):
    """What is known of the target."""

    VISIBLE = "visible"
    """It is seen in this frame."""
    COASTING = "coasting"
    """It is not seen (outside the picture, hidden); the estimate is a prediction with a std that means it."""
    LOST = "lost"
    """The cloud no longer says anything useful."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box in image pixels: x, y are its top left, as in ``--target x,y,w,h``."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """One sample on the telemetry's own clock [s].

    ned_from_body: (3, 3), v_ned = R v_body, body forward-right-down. position: (3,) north, east, down [m],
    or None.
    """

    time: float
    ned_from_body: Floats
    position: Floats | None = None


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One of several places where the target may be: image pixels, weights of one frame add up to 1."""

    weight: float
    x: float
    y: float


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The target in one frame.

    x, y: centre in image pixels, also outside the image; nan when lost. heading: atan2(dy, dx) in the image
    [rad], y down; nan where unknown. std: of the centre, one coordinate [px].
    north, east, speed, course, std_m: on the ground, nan where no metric ground frame is known;
    course = atan2(east, north). particles: (n, 2) image pixels, for overlays. layers: further named
    geometry in image pixels for overlays (road, regions, tracks), (n, 2) each.
    """

    time: float
    state: State
    x: float
    y: float
    width: float
    height: float
    heading: float
    std: float
    north: float = float("nan")
    east: float = float("nan")
    speed: float = float("nan")
    course: float = float("nan")
    std_m: float = float("nan")
    hypotheses: tuple[Hypothesis, ...] = ()
    particles: Floats | None = None
    layers: Mapping[str, Floats] = field(default_factory=dict)


class Tracker(Protocol):
    """One model. Constructed with the camera's size and, if known, lens and mounting, and a seed."""

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Learn the target from its first frame. Raises InputError for a box that can't be one."""
        ...

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Take one sample; the offset between its clock and the camera's is unknown (up to ±0.5 s)."""
        ...

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Follow into the next frame; ``None`` for a frame that could not be decoded."""
        ...
