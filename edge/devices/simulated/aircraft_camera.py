"""The camera of the simulated aircraft as a device: renders the town from the aircraft's true pose."""

from __future__ import annotations

import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.playback_clock import PlaybackClock, wait_until
from edge.devices.simulated.aircraft import SimulatedAircraft
from edge.uav.world.flight_world import FlightWorld
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Image

_TRANSFER_S = 0.004  # from mid-exposure to the host


class FlightCamera:
    """Delivers a frame when it is due on the playback clock; overdue frames are skipped and counted in ``late``.

    world: the rendered world. aircraft: gives the camera pose. playback_clock: the true time. clock_offset_s: the
    camera's clock minus the true time [s].
    """

    def __init__(
        self,
        world: FlightWorld,
        aircraft: SimulatedAircraft,
        playback_clock: PlaybackClock,
        *,
        clock_offset_s: float = 0.0,
    ) -> None:
        self._world, self._aircraft, self._playback_clock = world, aircraft, playback_clock
        self._clock_offset_s = clock_offset_s
        self._last = world.length
        self._next = 0
        self._open = False
        self.late = 0

    @property
    def info(self) -> DeviceInfo:
        """Description, valid before opening too."""
        width, height = self._world.size
        return DeviceInfo(width, height, self._world.fps, "simulated", "monotonic", self._world.lens)

    @property
    def ended(self) -> bool:
        """Whether the flight is over."""
        return self._next >= self._last

    def open(self) -> None:
        """Start; frames that are overdue from now on are skipped."""
        self._open = True

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None if it is not due within ``timeout_s``."""
        if not self._open or self.ended:
            return None
        due = max(0, int(np.ceil((self._playback_clock.now() - _TRANSFER_S) * self._world.fps - 1.0)))
        if due > self._next:
            self.late += due - self._next
            self._next = due
            if self.ended:
                return None
        index = self._next
        if not wait_until(self._playback_clock, self._world.time(index) + _TRANSFER_S, timeout_s):
            return None
        self._next = index + 1
        return Frame(self.render_frame(index), self.device_time_ns(index), index)

    def device_time_ns(self, index: int) -> int:
        """Time stamp [ns] of a frame on the camera's clock."""
        return round((self._world.time(index) + self._clock_offset_s) * NANOSECONDS)

    def render_frame(self, index: int) -> Image:
        """Render frame ``index`` from the aircraft's pose at its time."""
        rotation, centre = self._aircraft.camera_from_ned(self._world.time(index), self._world.body_from_camera)
        return self._world.render_from(index, rotation, centre)

    def close(self) -> None:
        """May be called twice."""
        self._open = False
