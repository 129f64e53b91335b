"""A camera of a simulated world as a device: real pictures, its own clock, jitter and dropped frames."""

from __future__ import annotations

import math

import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.playback_clock import Pace
from edge.scenes.common.base import Renderer, Scene, SimulatedClock
from protocols.core.clocks import NANOSECONDS

_TRANSFER_S = 0.004  # from the end of the exposure until the picture has come over the wire


class SimulatedDevice:
    """Delivers rendered frames when the world's true time has come for them.

    scene, camera: which world, which of its cameras. seed: of jitter, drops and noise.
    pace: the true time; processes of one world must be given the same one. The device starts whenever it is opened.
    duration_s: it ends after that long; None = never. clock: another clock than the scene's, as after a reboot.

    A machine too slow to render every frame loses some: the device skips what it is late for (``late``) and stays
    in time. ``dropped`` counts frames that the world decided to lose.
    """

    def __init__(
        self,
        scene: Scene,
        camera: str,
        seed: int,
        pace: Pace,
        *,
        duration_s: float | None = None,
        clock: SimulatedClock | None = None,
    ) -> None:
        self._scene = scene
        self._camera = scene.camera(camera)
        self._clock = self._camera.clock if clock is None else clock
        index = [one.name for one in scene.cameras].index(camera)
        self._capture, self._sensor = np.random.default_rng([seed, index]).spawn(2)
        self._pace = pace
        self._duration_s = duration_s
        self._renderer: Renderer | None = None
        self._start = 0.0
        self._frame = -1
        self._due = 0.0
        self._ended = False
        self.dropped = 0
        self.late = 0

    @property
    def info(self) -> DeviceInfo:
        """Everything about a simulated camera is known."""
        lens = self._camera.intrinsics
        return DeviceInfo(
            width=lens.width,
            height=lens.height,
            fps=self._camera.fps,
            driver="simulated",
            clock="device",
            intrinsics=lens,
            readout_s=self._camera.readout_s,
        )

    @property
    def ended(self) -> bool:
        """True after ``duration_s``, or once closed."""
        return self._ended

    def open(self) -> None:
        """Set the scene; the first frame is due a random part of a period from now."""
        self._renderer = self._scene.renderer(self._camera.name, self._sensor)
        self._ended = False
        self._frame = -1
        self._start = self._pace.now() + self._capture.uniform(0.0, 1.0) * self._period
        self._next()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, at the moment at which a real camera would have delivered it."""
        if self._renderer is None or self._ended:
            return None
        behind = self._pace.now() - self._delivery
        if behind > self._period:  # too slow for this world: stay in time, and say what it cost
            for _ in range(math.floor(behind / self._period)):
                self.late += 1
                self._next()
        if self._duration_s is not None and self._due - self._start > self._duration_s:
            self._ended = True
            return None
        wait = self._delivery - self._pace.now()
        if wait > timeout_s:
            self._pace.sleep(timeout_s)
            return None
        self._pace.sleep(wait)
        stamp = self._clock.device_time_ns(self._due)
        stamp += round(self._capture.normal(0.0, self._clock.stamp_noise_s) * NANOSECONDS)
        frame = Frame(
            image=self._renderer.render(self._due),
            device_time_ns=stamp,
            frame=self._frame,
            exposure_ns=round(self._camera.exposure_s * NANOSECONDS),
        )
        self._next()
        return frame

    def close(self) -> None:
        """No more frames."""
        self._ended = True
        self._renderer = None

    @property
    def _period(self) -> float:
        return 1.0 / (self._camera.fps * self._clock.rate)

    @property
    def _delivery(self) -> float:
        """True time at which the frame that is due has arrived."""
        return self._due + 0.5 * (self._camera.exposure_s + self._camera.readout_s) + _TRANSFER_S

    def _next(self) -> None:
        """Go to the next frame that is not dropped."""
        self._frame += 1
        while self._capture.random() < self._camera.drop_fraction:
            self._frame += 1
            self.dropped += 1
        self._due = float(self._camera.capture_times(self._start, self._frame, 1, self._capture)[0])
