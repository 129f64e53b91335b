"""Cameras on a Raspberry Pi's ribbon cable, through picamera2, which is a Debian package and no wheel.

SensorTimestamp is sampled at the interrupt that begins a frame, as its first row is read out: that row's exposure has
just ended (picamera2, issue 821). Mid-exposure of the middle row is then half a readout later and half an exposure
earlier.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.devices.base import DeviceInfo, Frame, check_size
from edge.devices.live.reconnecting import Connection, Gone, ReturningCamera
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_REMEDY = "check the ribbon cable (contacts, both ends), and that `rpicam-hello --list-cameras` shows it"


@dataclass(frozen=True, slots=True)
class PiSettings:
    """One camera of a Raspberry Pi.

    camera: its number. size: (width, height) [px]. exposure_us: fixed; None = the camera chooses, and tells for each
    frame what it chose. gain: fixed analogue gain; None = chosen. readout_s: first to last row; None = the shortest
    time in which this mode of the sensor can take a frame, which is a few per cent too long (its blanking).
    """

    camera: int = 0
    size: tuple[int, int] = (1280, 720)
    fps: float = 30.0
    exposure_us: int | None = 5000
    gain: float | None = None
    readout_s: float | None = None


class PiCamera(ReturningCamera):
    """See ``edge.devices.base.Device``. make: gives the picamera2 object of a camera number; tests give another."""

    def __init__(
        self,
        settings: PiSettings,
        *,
        intrinsics: Intrinsics | None = None,
        make: Callable[[int], Any] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        name = f"Pi camera {settings.camera}"

        def connect() -> Connection:
            try:
                return PiConnection((make or _picamera2)(settings.camera), settings)
            except ImportError:
                remedy = (
                    "sudo apt install python3-picamera2, and a .venv made with --system-site-packages: it needs the "
                    "system's libcamera"
                )
                raise InputError("picamera2 is not installed", remedy=remedy) from None
            except (RuntimeError, IndexError, OSError) as error:
                what = f"{name} does not answer: {' '.join(str(error).split())[:160]}"
                raise InputError(what, remedy=_REMEDY) from None

        def describe(connection: Connection, first: Frame) -> DeviceInfo:
            assert isinstance(connection, PiConnection)
            height, width = first.image.shape[:2]
            check_size(intrinsics, width, height, name)
            unknown = () if connection.readout_s else ("readout of a rolling shutter",)
            return DeviceInfo(
                width, height, settings.fps, "picamera2", "monotonic", intrinsics, connection.readout_s, unknown
            )

        super().__init__(name, connect, describe, remedy=_REMEDY, now_ns=now_ns, sleep=sleep)


class PiConnection:
    """A started picamera2 object. Frames that it lost are told by the gaps between stamps: it numbers none."""

    def __init__(self, camera: Any, settings: PiSettings) -> None:
        self._camera = camera
        self._period_ns = 1e9 / settings.fps
        period_us = round(1e6 / settings.fps)
        controls: dict[str, Any] = {"FrameDurationLimits": (period_us, period_us)}
        if settings.exposure_us is not None:
            controls |= {"AeEnable": False, "ExposureTime": settings.exposure_us}
        if settings.gain is not None:
            controls["AnalogueGain"] = settings.gain
        # In picamera2 "RGB888" is blue, green, red in memory: OpenCV's order.
        camera.configure(
            camera.create_video_configuration(
                main={"size": settings.size, "format": "RGB888"}, controls=controls, buffer_count=4
            )
        )
        self.readout_s = settings.readout_s or 0.0
        if settings.readout_s is None:
            shortest = camera.camera_controls.get("FrameDurationLimits", (0,))[0]
            self.readout_s = min(float(shortest) * 1e-6, 1.0 / settings.fps)
        self._order: Any = None
        self._number = -1
        self._last_ns = 0
        self.temperature: float | None = None
        camera.start()

    def take(self, timeout_s: float) -> Frame | None:
        try:
            # One order at a time: an order that nobody waits for any more would keep its buffer for ever.
            self._order = self._order or self._camera.capture_request(wait=False)
            request = self._camera.wait(self._order, timeout=timeout_s)
        except TimeoutError:
            return None
        except (RuntimeError, OSError):
            raise Gone from None
        self._order = None
        try:
            known = request.get_metadata()
            image = np.ascontiguousarray(request.make_array("main")[..., :3], dtype=np.uint8)
        finally:
            request.release()
        first_row_ended = int(known["SensorTimestamp"])
        exposure_ns = int(known.get("ExposureTime", 0)) * 1000
        if "SensorTemperature" in known:
            self.temperature = float(known["SensorTemperature"])
        period = float(known.get("FrameDuration", 0)) * 1e3 or self._period_ns
        passed = 1 if self._number < 0 else max(round((first_row_ended - self._last_ns) / period), 1)
        self._number += passed
        self._last_ns = first_row_ended
        middle = first_row_ended - exposure_ns // 2 + round(self.readout_s * 0.5e9)
        return Frame(image.copy(), middle, self._number, exposure_ns)

    def close(self) -> None:
        for end in (self._camera.stop, self._camera.close):
            with suppress(RuntimeError, OSError):
                end()


def _picamera2(number: int) -> Any:
    from picamera2 import Picamera2

    return Picamera2(number)
