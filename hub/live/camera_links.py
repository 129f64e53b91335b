"""What a hub knows of the link to each camera: when it was last heard of, how late its frames are, its faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from google.protobuf.message import Message

from protocols.core.clocks import NANOSECONDS
from protocols.messages import syncline_pb2 as pb

_FORGOTTEN_S = 600.0
"""A camera that is not calibrated is not waited for after this time without a frame."""
_RATE_FRAMES, _RATE_S = 100, 5.0
"""Frames, and seconds of arrivals, over which a camera's times are compared with the hub's: an outage and the burst
after it are shorter in frames"""
_LEAST_RATE = 0.01
"""Of a camera's clock against the hub's: times in microseconds for nanoseconds have a thousandth. A log may be replayed
as fast as one likes, but not a hundred times slower."""
_MAX_FAULTS = 3
"""Errors that a camera's messages may raise before they are not used any more, until its agent is restarted."""


class CameraLinks:
    """The links of all cameras.

    last_frame: hub time [s]. delays: arrival of the newest frame on the hub's clock less its time on the camera's [s];
    camera_time: that time; boots: of the newest frames. fresh: cameras whose frames have not all waited for this hub:
    their delays are those of the network. faults: errors that a camera's messages raised; notices: why it is left out.
    """

    def __init__(self) -> None:
        self.last_frame: dict[str, float] = {}
        self.delays: dict[str, float] = {}
        self.camera_time: dict[str, float] = {}
        self.boots: dict[str, str] = {}
        self.fresh: set[str] = set()
        self.faults: Counter[str] = Counter()
        self.notices: dict[str, str] = {}
        self.standing: dict[str, str] = {}
        """By camera, what is wrong with times that hardly advance, or numbers that do not."""
        self._muted: dict[str, str] = {}
        self._windows: dict[str, tuple[int, float, pb.Observation]] = {}
        """Frames, first arrival [s], and the frame that arrived then."""

    def forget(self, camera: str) -> None:
        """Forget a camera, as if it had never been heard of."""
        for of_camera in (self.last_frame, self.delays, self.camera_time, self.boots, self.notices, self.standing):
            of_camera.pop(camera, None)
        self._windows.pop(camera, None)
        self.fresh.discard(camera)

    def receive(self, message: pb.Observation, now: float, arrival: float | None, *, backlog: bool) -> None:
        """Note a frame; arguments as of ``LiveHub.handle``."""
        camera = message.camera
        if arrival is not None:
            camera_time = self.camera_time[camera] = message.device_time_ns / NANOSECONDS
            if not backlog:
                self.fresh.add(camera)
            self.delays[camera] = arrival - camera_time
        self.last_frame[camera], self.boots[camera] = now, message.boot_id

    def compare_anew(self) -> None:
        """Forget what is wrong with times and numbers, as of observations that are forgotten."""
        self.standing.clear()
        self._windows.clear()

    def compare_rates(self, message: pb.Observation, arrival: float | None, repeated: tuple[int, int, int]) -> None:
        """Note a frame, also one left out, to find times and numbers that stand still.

        arrival: as of ``receive``. repeated: the camera's, as of `SessionBuilder`.
        """
        if arrival is None:
            return
        camera, camera_time = message.camera, message.device_time_ns / NANOSECONDS
        frames, began, first = self._windows.get(camera, (0, arrival, message))
        if first.boot_id != message.boot_id:
            frames, began, first = 0, arrival, message
        self._windows[camera] = frames + 1, began, first
        if frames < _RATE_FRAMES or arrival - began < _RATE_S:
            return
        del self._windows[camera]
        rate = (camera_time - first.device_time_ns / NANOSECONDS) / (arrival - began)
        self.standing.pop(camera, None)
        if 0.0 <= rate < _LEAST_RATE:
            self.standing[camera] = (
                f"the times of {camera} advance by {rate:.2g} s a second: device_time_ns must be in nanoseconds, "
                "and that of each frame"
            )
        elif message.sequence == first.sequence:
            self.standing[camera] = (
                f"the frames of {camera} all have sequence {first.sequence}: it must count them, from 0"
            )
        elif repeated[0] >= _RATE_FRAMES:  # parts of a history come later too, but among new frames
            _, highest, later_ns = repeated
            what = "counts its frames anew" if later_ns > 0 else "is replayed again, or counts frames and times anew,"
            self.standing[camera] = (
                f"{camera} {what} ({message.sequence} after {highest}) under one boot_id, so its markers are not used: "
                f"each run must have a new one{'' if later_ns > 0 else '; for a replay, restart the hub'}"
            )

    def ages(self, now: float, kept: Iterable[str]) -> dict[str, float]:
        """Seconds since the last frame of each camera of ``kept`` or heard of lately."""
        ages = {name: now - last for name, last in sorted(self.last_frame.items())}
        return {name: age for name, age in ages.items() if age < _FORGOTTEN_S or name in kept}

    def is_left_out(self, message: pb.Observation | pb.CameraInfo) -> bool:
        """Whether this run of the camera's agent has caused too many errors."""
        return bool(self._muted) and self._muted.get(message.camera) == message.boot_id

    def record_fault(self, message: Message, error: Exception) -> None:
        """Count an error that a message raised; after some of them its camera is left out."""
        camera = getattr(message, "camera", "")
        if not camera:
            return
        self.faults[camera] += 1
        if self.faults[camera] >= _MAX_FAULTS:
            self._muted[camera] = getattr(message, "boot_id", "")
            self.notices[camera] = f"{camera} is left out until it is restarted: {type(error).__name__}: {error}"[:200]
