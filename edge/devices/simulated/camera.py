"""A camera of a simulated scene as a device: rendered images, its own clock, timestamp jitter, dropped frames."""

from __future__ import annotations

import math
import time

import numpy as np

from edge import scenes
from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.playback_clock import PlaybackClock, RealTime, wait_until
from edge.scenes import renderer_for
from edge.scenes.common.base import Renderer, SimulatedScene, rescale_scene
from protocols.core.clocks import NANOSECONDS

_DAY_S = 86_400.0  # s
_TRANSFER_S = 0.004  # from the end of the exposure until the frame has been transferred


def open_simulated(
    scene: str,
    camera: str,
    *,
    seed: int = 0,
    cameras: int | None = None,
    width: int | None = None,
    fps: float | None = None,
    epoch_unix_s: float | None = None,
    duration_s: float | None = None,
) -> SimulatedDevice:
    """A camera of a shipped scene in real time, not yet open.

    scene, camera: names. seed, cameras: of the scene; cameras None = the scene's own number. width [px], fps [Hz]: of
    all its cameras; None = the scene's. epoch_unix_s: Unix time of true time 0; processes of one scene must share it;
    None = the machine's start of the day. duration_s: None = endless. Raises InputError for an unknown scene or camera.
    """
    made = scenes.get_scene(scene, seed, cameras)
    if width is not None or fps is not None:
        made = rescale_scene(made, width, fps)
    epoch = time.time() // _DAY_S * _DAY_S if epoch_unix_s is None else epoch_unix_s
    return SimulatedDevice(made, camera, seed, RealTime(epoch), duration_s=duration_s)


class SimulatedDevice:
    """Delivers rendered frames when they are due on the playback clock.

    scene, camera: the scene and the name of one of its cameras. seed: of jitter, drops and noise.
    playback_clock: the true time; processes of one scene must share it. Frames start when the device is opened.
    duration_s: duration of the recording; None = endless.

    Where rendering is slower than the frame rate, overdue frames are skipped (counted in ``late``) to stay in real
    time. ``dropped`` counts the simulated frame drops.
    """

    def __init__(
        self,
        scene: SimulatedScene,
        camera: str,
        seed: int,
        playback_clock: PlaybackClock,
        *,
        duration_s: float | None = None,
    ) -> None:
        self._scene = scene
        self._camera = scene.camera(camera)
        self._clock = self._camera.clock
        index = [one.name for one in scene.cameras].index(camera)
        self._capture, self._sensor = np.random.default_rng([seed, index]).spawn(2)
        self._playback_clock = playback_clock
        self._duration_s = duration_s
        self._renderer: Renderer | None = None
        self._start = 0.0
        self._frame = -1
        self._due = 0.0
        self.ended = False
        self.dropped = 0
        self.late = 0

    @property
    def info(self) -> DeviceInfo:
        """Description with the true intrinsics and readout."""
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

    def open(self) -> None:
        """Create the renderer; the first frame is due a random fraction of a period from now."""
        self._renderer = renderer_for(self._scene, self._camera.name, self._sensor)
        self.ended = False
        self._frame = -1
        self._start = self._playback_clock.now() + self._capture.uniform(0.0, 1.0) * self._period
        self._next()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, at the time at which a real camera would deliver it."""
        if self._renderer is None or self.ended:
            return None
        behind = self._playback_clock.now() - self._delivery
        if behind > self._period:  # rendering is too slow: skip frames and count them
            for _ in range(math.floor(behind / self._period)):
                self.late += 1
                self._next()
        if self._duration_s is not None and self._due - self._start > self._duration_s:
            self.ended = True
            return None
        if not wait_until(self._playback_clock, self._delivery, timeout_s):
            return None
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
        self.ended = True
        self._renderer = None

    @property
    def _period(self) -> float:
        return 1.0 / (self._camera.fps * self._clock.rate)

    @property
    def _delivery(self) -> float:
        """True time at which the due frame arrives at the host."""
        return self._due + 0.5 * (self._camera.exposure_s + self._camera.readout_s) + _TRANSFER_S

    def _next(self) -> None:
        """Advance to the next frame that is not dropped."""
        self._frame += 1
        while self._capture.random() < self._camera.drop_fraction:
            self._frame += 1
            self.dropped += 1
        self._due = float(self._camera.capture_times(self._start, self._frame, 1, self._capture)[0])
