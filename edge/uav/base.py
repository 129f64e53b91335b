"""The interface of the UAV target trackers: inputs, outputs and protocol. Each tracker has its own module.

A tracker uses no files, sockets, threads or clocks. It is started by ``begin`` with a frame and the target's bounding
box, then receives one ``handle_frame`` per frame and one ``handle_telemetry`` per sample, in order of arrival.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from protocols.geometry.types import Floats, Image

LOST_STD, LOST_AFTER_S = 8.0, 15.0  # std in target lengths, time unseen: beyond, an estimate is of no use


class TrackState(StrEnum):
    """Track state of the target in one frame."""

    VISIBLE = "visible"
    """The target is detected in this frame."""
    COASTING = "coasting"
    """Not detected (outside the image or occluded); estimate and std are predictions."""
    LOST = "lost"
    """The particle set is too dispersed to give a useful estimate."""


class Basis(StrEnum):
    """Frame of reference of an estimate, the best one first."""

    GROUND = "ground"
    """The ground plane in metres: lens, attitude and height are known."""
    PLANE = "plane"
    """The ground plane up to scale."""
    STABILISED = "stabilised"
    """The image, its motion compensated by what lies around."""
    IMAGE = "image"
    """The plain image."""


@dataclass(frozen=True, slots=True)
class Box:
    """A bounding box in image pixels: x, y are its top left corner, as in ``--target x,y,w,h``."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """One telemetry sample, stamped by the telemetry's own clock [s].

    ned_from_body: (3, 3), v_ned = R v_body, body axes forward-right-down. position: (3,) north, east, down [m],
    or None. position_std: of it, one coordinate [m], by the time to the reports that it was computed from.
    """

    time: float
    ned_from_body: Floats
    position: Floats | None = None
    position_std: float = 0.0


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One of several modes of the position estimate: image pixels; the weights of one frame add up to 1."""

    weight: float
    x: float
    y: float


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The target state estimated for one frame.

    x, y: centre in image pixels, also outside the image; nan when lost. heading: atan2(dy, dx) in the image
    [rad], y down; nan where unknown. std: of the centre, one coordinate [px].
    north, east, speed, course, std_m: on the ground [m, m/s, rad]; nan where no metric ground frame is available;
    course = atan2(east, north). ground_frame: which frame these are of; two may be metres apart.
    basis: frame of reference, and the reason for it; None where a tracker has only one. particles: (n, 2) image pixels,
    for overlays. layers: further named geometry in image pixels for overlays (road, regions, tracks), (n, 2) each.
    """

    time: float
    state: TrackState
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
    ground_frame: tuple[int, ...] = ()
    basis: Basis | None = None
    reason: str = ""
    hypotheses: tuple[Hypothesis, ...] = ()
    particles: Floats | None = None
    layers: Mapping[str, Floats] = field(default_factory=dict)


class Tracker(Protocol):
    """One tracking method. Constructed with the image size, a seed and, if known, the intrinsics and the mounting."""

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        """Initialise the target from its first frame. Raises InputError for an invalid box."""

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Add one sample; the offset between its clock and the camera's is unknown (up to ±0.5 s)."""

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        """Track the target into the next frame; ``None`` for a frame that could not be decoded."""
