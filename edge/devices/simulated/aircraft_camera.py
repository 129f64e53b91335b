"""The simulated aircraft's camera as a device: pictures of the town from wherever the aircraft really is."""

from __future__ import annotations

import numpy as np

from edge.devices.base import DeviceInfo, Frame, Image
from edge.devices.playback.playback_clock import Pace
from edge.devices.simulated.aircraft import SimulatedAircraft
from edge.uav.world.world import World
from protocols.core.clocks import NANOSECONDS

_TRANSFER_S = 0.004


class FlightCamera:
    """Delivers a frame when the world's true time has come for it; frames that it is late for are left out.

    world: what there is to see. aircraft: where the camera is. pace: the true time. ahead_s: the camera's clock against
    the true time [s]: what it stamps is its own. duration_s: it ends then; None: with the world.
    """

    def __init__(
        self,
        world: World,
        aircraft: SimulatedAircraft,
        pace: Pace,
        *,
        ahead_s: float = 0.0,
        duration_s: float | None = None,
    ) -> None:
        self._world, self._aircraft, self._pace = world, aircraft, pace
        self._ahead = ahead_s
        last = world.length if duration_s is None else min(world.length, int(duration_s * world.fps) + 1)
        self._last = last
        self._next = 0
        self._open = False
        self.late = 0

    @property
    def info(self) -> DeviceInfo:
        """Known before it is opened."""
        width, height = self._world.size
        return DeviceInfo(width, height, self._world.fps, "simulated", "monotonic", self._world.lens)

    @property
    def ended(self) -> bool:
        """Whether the flight is over."""
        return self._next >= self._last

    def open(self) -> None:
        """From now on, frames whose time has passed are lost."""
        self._open = True

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None where its time does not come within ``timeout_s``."""
        if not self._open or self.ended:
            return None
        due = max(0, int(np.ceil((self._pace.now() - _TRANSFER_S) * self._world.fps - 1.0)))
        if due > self._next:
            self.late += due - self._next
            self._next = due
            if self.ended:
                return None
        index = self._next
        wait = self._world.time(index) + _TRANSFER_S - self._pace.now()
        if wait > timeout_s:
            self._pace.sleep(timeout_s)
            return None
        self._pace.sleep(wait)
        self._next = index + 1
        return Frame(self.picture(index), self.device_time_ns(index), index)

    def device_time_ns(self, index: int) -> int:
        """What the camera's clock says of a frame."""
        return round((self._world.time(index) + self._ahead) * NANOSECONDS)

    def picture(self, index: int) -> Image:
        """Frame ``index``, from where the aircraft was then."""
        rotation, centre = self._aircraft.camera_from_ned(self._world.time(index), self._world.body_from_camera)
        return self._world.draw_from(index, rotation, centre)

    def close(self) -> None:
        """May be called twice."""
        self._open = False
