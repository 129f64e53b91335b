"""Raspberry Pi cameras (CSI) through picamera2, which is a Debian package and not on PyPI as a wheel.

SensorTimestamp is sampled at the interrupt that begins a frame, as its first row is read out: that row's exposure has
just ended (picamera2, issue 821). Mid-exposure of the middle row is then half a readout later and half an exposure
earlier.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.live.reconnecting import Connection, ConnectionLost, ReconnectingCamera
from edge.devices.settings import PiSettings
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_REMEDY = "check the ribbon cable (contacts, both ends), and that `rpicam-hello --list-cameras` shows it"


class PiCamera(ReconnectingCamera):
    """See ``edge.devices.base.Device``. make: creates the picamera2 object of a camera number; replaced in tests."""

    def __init__(
        self,
        settings: PiSettings,
        *,
        intrinsics: Intrinsics | None = None,
        make: Callable[[int], Any] | None = None,
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

        def describe(connection: PiConnection, width: int, height: int) -> DeviceInfo:
            unknown = () if connection.readout_s else ("readout of a rolling shutter",)
            readout_s = connection.readout_s
            return DeviceInfo(width, height, settings.fps, "picamera2", "monotonic", None, readout_s, unknown)

        super().__init__(name, connect, describe, intrinsics, remedy=_REMEDY)


class PiConnection:
    """A started picamera2 object. It does not number frames: lost ones are found from the gaps between stamps."""

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
        self._pending_request: Any = None
        self._number = -1
        self._last_ns = 0
        self.temperature: float | None = None
        camera.start()

    def take(self, timeout_s: float) -> Frame | None:
        try:
            # One request at a time: an abandoned request would never return its buffer.
            self._pending_request = self._pending_request or self._camera.capture_request(wait=False)
            request = self._camera.wait(self._pending_request, timeout=timeout_s)
        except TimeoutError:
            return None
        except (RuntimeError, OSError):
            raise ConnectionLost from None
        self._pending_request = None
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
        periods = 1 if self._number < 0 else max(round((first_row_ended - self._last_ns) / period), 1)
        self._number += periods
        self._last_ns = first_row_ended
        middle = first_row_ended - exposure_ns // 2 + round(self.readout_s * 0.5e9)
        return Frame(image.copy(), middle, self._number, exposure_ns)

    def close(self) -> None:
        for release in (self._camera.stop, self._camera.close):
            with suppress(RuntimeError, OSError):
                release()


def _picamera2(number: int) -> Any:
    from picamera2 import Picamera2

    return Picamera2(number)
