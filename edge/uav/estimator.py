"""The UAV agent's target estimator: images, telemetry and operator commands in, target state messages out.

It has no clock and no connection: live, the agent feeds it; a replay feeds it from a log in the same order and gets the
same bytes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from google.protobuf.message import Message

from edge.uav import tracker_factory
from edge.uav.base import Box, Estimate, Telemetry, Tracker, TrackState
from edge.uav.georeference import Georeference
from edge.uav.navigation import Origin, rotation_from_quaternion
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.jpeg import decode_jpeg
from protocols.core.ranges import MAX_PIXEL
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image
from protocols.messages import syncline_pb2 as pb
from protocols.validation.rules import SCHEMA_VERSION

_TELEMETRY_BUFFER = 200  # telemetry samples kept from before a target is selected
_PARTICLES_EVERY, _ROAD_EVERY = 6, 15  # frames
_MAX_PARTICLES, _MAX_ROAD_POINTS = 100, 600  # that a message shows: enough for the operator's picture
_DEFAULT_BOX_M = 5.5  # side of the box placed around a selected point where the height above ground is known
_LEAST_BOX_PX = 8.0  # side of a box around a point: of less, too little is seen to follow
_DEFAULT_BOX_PX = 40.0  # where it is not known: that car at 0.14 m a pixel


class TargetEstimator:
    """The estimator of one agent. size: (width, height) [px]. seed: of the trackers' random numbers.

    The n-th target's tracker uses seed + n. model: of ``tracker_factory.NAMES``. lens, body_from_camera: where known;
    where the camera hangs on a gimbal, body is the gimbal. estimate: the newest; None while no target is tracked.
    refused, undecodable: counts of rejected commands and of images that could not be decoded.
    """

    def __init__(
        self,
        agent: str,
        boot_id: str,
        size: tuple[int, int],
        lens: Intrinsics | None = None,
        body_from_camera: Floats | None = None,
        *,
        fps: float = 30.0,
        seed: int = 0,
        model: str = "ground",
    ) -> None:
        self._agent, self._boot = agent, boot_id
        self._size, self._fps, self._seed, self._model = size, fps, seed, model
        self._lens, self._mounting = lens, body_from_camera
        calibrated = lens is not None and body_from_camera is not None
        self._georeference = Georeference(lens, body_from_camera) if calibrated else None  # type: ignore[arg-type]
        self._samples: deque[Telemetry] = deque(maxlen=_TELEMETRY_BUFFER)
        self._tracker: Tracker | None = None
        self._image: Image | None = None
        self._frame, self._time_ns = 0, 0
        self._sequence = 0
        self._targets = 0
        self.origin: Origin | None = None
        self.estimate: Estimate | None = None
        self.refused = 0
        self.undecodable = 0

    @property
    def has_target(self) -> bool:
        """Whether a target is tracked."""
        return self._tracker is not None

    def handle(self, message: Message) -> list[Message]:
        """Process one input message; returns the messages to publish."""
        if isinstance(message, pb.FlightImage):
            return self.handle_frame(decode_image(message), message.frame, message.device_time_ns)
        if isinstance(message, pb.VehicleTelemetry):
            self._handle_telemetry(message)
        elif isinstance(message, pb.TargetCommand):
            return self._handle_command(message)
        return []

    def handle_frame(self, image: Image | None, frame: int, device_time_ns: int) -> list[Message]:
        """Process one image; None for one that could not be decoded."""
        if image is None or image.shape[:2] != (self._size[1], self._size[0]):
            image = None
            self.undecodable += 1
        self._image, self._frame, self._time_ns = image, frame, device_time_ns
        if self._tracker is None:
            return []
        self.estimate = self._in_vehicle_frame(self._tracker.handle_frame(image, device_time_ns / NANOSECONDS))
        return self._target_messages()

    def box_around(self, x: float, y: float, radius: float = 0.0) -> Box:
        """The box for a selected point (x, y) [px]: about its radius if that is not 0, else the size of a car.

        A car's size follows from the height above ground, where that is known.
        """
        side = _DEFAULT_BOX_PX
        sample = self._samples[-1] if self._samples else None
        if radius > 0.0:
            side = float(np.clip(2.0 * radius, _LEAST_BOX_PX, 0.5 * self._size[1]))
        elif (
            sample is not None and sample.position is not None and self._lens is not None and self._mounting is not None
        ):
            ray = np.append(self._lens.unproject(np.array([[x, y]]))[0], 1.0)
            down = float((sample.ned_from_body @ self._mounting @ ray)[2])
            if np.isfinite(down) and down > 1e-3 and sample.position[2] < -2.0:
                side = float(
                    np.clip(
                        _DEFAULT_BOX_M * self._lens.focal * down / -sample.position[2],
                        _LEAST_BOX_PX,
                        0.5 * self._size[1],
                    )
                )
        return Box(x - 0.5 * side, y - 0.5 * side, side, side)

    def _handle_telemetry(self, message: pb.VehicleTelemetry) -> None:
        rotation = rotation_from_quaternion(list(message.ned_from_body))
        if rotation is None:
            return
        position = np.array(message.position) if message.position else None
        if message.origin:
            self.origin = Origin(*message.origin)
        sample = Telemetry(message.device_time_ns / NANOSECONDS, rotation, position, message.position_std)
        self._samples.append(sample)
        if self._georeference is not None:
            self._georeference.add(sample)
        if self._tracker is not None:
            self._tracker.handle_telemetry(sample)

    def _handle_command(self, message: pb.TargetCommand) -> list[Message]:
        if message.kind == "stop":
            self._tracker = self.estimate = None
            return []
        if self._image is None:
            self.refused += 1
            return []
        tracker = tracker_factory.make_tracker(
            self._model, self._size, self._lens, self._mounting, self._fps, self._seed + self._targets
        )
        for sample in self._samples:
            tracker.handle_telemetry(sample)
        try:
            estimate = tracker.begin(self._image, self._time_ns / NANOSECONDS, Box(*message.box))
        except InputError:
            self.refused += 1  # the previous target stays tracked
            return []
        self._targets += 1
        if self._georeference is not None:
            self._georeference.reset()
        self._tracker, self.estimate = tracker, self._in_vehicle_frame(estimate)
        return self._target_messages()

    def _in_vehicle_frame(self, estimate: Estimate) -> Estimate:
        if self._georeference is None:
            return estimate
        return self._georeference.corrected(estimate, self._time_ns / NANOSECONDS)

    def _target_messages(self) -> list[Message]:
        estimate = self.estimate
        assert estimate is not None
        out: list[Message] = [self._state_message(estimate)]
        if self._sequence % _PARTICLES_EVERY == 0 and estimate.particles is not None:
            pixels = _finite_pixels(estimate.particles)
            out.append(
                pb.TargetCloud(
                    **self._header(), particles=len(pixels), pixels=_subsampled(pixels, _MAX_PARTICLES).ravel()
                )
            )
        if self._sequence % _ROAD_EVERY == 0:
            out.append(self._road_message(estimate))
        self._sequence += 1
        return out

    def _header(self) -> dict[str, Any]:
        return {
            "schema_version": SCHEMA_VERSION,
            "agent": self._agent,
            "boot_id": self._boot,
            "sequence": self._sequence,
            "frame": self._frame,
            "device_time_ns": self._time_ns,
        }

    def _state_message(self, e: Estimate) -> pb.TargetState:
        message = pb.TargetState(**self._header(), state=e.state.value)
        if e.state is not TrackState.LOST:
            message.centre.extend((_clipped(e.x), _clipped(e.y)))
            message.std_px = min(e.std, MAX_PIXEL) if math.isfinite(e.std) else 0.0
        if math.isfinite(e.width) and math.isfinite(e.height):
            message.size.extend((_clipped(e.width), _clipped(e.height)))
        if math.isfinite(e.heading):
            message.heading.append(e.heading)
        if e.state is not TrackState.LOST and math.isfinite(e.north) and math.isfinite(e.east):
            message.ground.extend((e.north, e.east))
            message.std_m = e.std_m if math.isfinite(e.std_m) else 0.0
            if math.isfinite(e.speed) and math.isfinite(e.course):
                message.velocity.extend((e.speed * math.cos(e.course), e.speed * math.sin(e.course)))
            if self.origin is not None:
                message.geo.extend(float(part) for part in self.origin.to_geodetic(e.north, e.east, 0.0))
        for hypothesis in e.hypotheses:
            if math.isfinite(hypothesis.x) and math.isfinite(hypothesis.y):
                message.hypotheses.add(weight=hypothesis.weight, x=_clipped(hypothesis.x), y=_clipped(hypothesis.y))
        return message

    def _road_message(self, estimate: Estimate) -> pb.RoadMap:
        message = pb.RoadMap(**self._header())
        outline: Callable[[], tuple[Floats, Floats | None]] | None = getattr(self._tracker, "road_outline", None)
        if outline is None:
            return message
        pixels, ground = outline()
        valid = np.isfinite(pixels).all(axis=1) & (np.abs(pixels).max(axis=1, initial=0.0) < MAX_PIXEL)
        chosen = np.flatnonzero(valid)
        chosen = chosen[:: max(1, -(-len(chosen) // _MAX_ROAD_POINTS))]
        message.pixels.extend(pixels[chosen].ravel())
        if ground is not None:
            if self._georeference is not None and self._georeference.offset is not None:
                ground = ground + self._georeference.offset
            message.ground.extend(ground[chosen].ravel())
        return message


def decode_image(message: pb.FlightImage) -> Image | None:
    """The image (h, w, 3) BGR of a message; None if it is missing or damaged."""
    image = decode_jpeg(message.jpeg)
    return None if image is None or image.shape[:2] != (message.height, message.width) else image


def _clipped(value: float) -> float:
    return float(np.clip(value, -MAX_PIXEL, MAX_PIXEL))


def _finite_pixels(pixels: Floats) -> Floats:
    """Those of the pixels (n, 2) that are finite and within the representable range."""
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(pixels).all(axis=1) & np.asarray((np.abs(pixels) < MAX_PIXEL).all(axis=1))
    return pixels[valid]


def _subsampled(points: Floats, limit: int) -> Floats:
    return points[:: max(1, -(-len(points) // limit))]
