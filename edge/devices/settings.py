"""Settings of the drivers of real cameras: the tables [oak], [usb] and [picamera2] of an agent's configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Hertz = Annotated[float, Meta(gt=0.0, le=1000.0)]
Byte = Annotated[int, Meta(ge=0, le=255)]
Size = tuple[Annotated[int, Meta(ge=16, le=16_384)], Annotated[int, Meta(ge=16, le=16_384)]]
Microseconds = Annotated[int, Meta(ge=1, le=1_000_000)]
Readout = Annotated[float, Meta(ge=0.0, le=1.0)]


class OakSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[oak]: one sensor of an OAK board, through depthai.

    device: IP address, device id or USB path; "" = the only one connected. size: [w, h]. exposure_us, iso: fixed, so
    that mid-exposure time and brightness stay constant. focus: lens position 0..255, fixed; None = a fixed-focus lens.
    nn: archive of a detection network (.tar.xz) that then runs on the board instead of a detector on the host. labels:
    which of its classes are published; none = all. confidence: smallest confidence of a published detection.
    """

    device: str = ""
    socket: Literal["CAM_A", "CAM_B", "CAM_C"] = "CAM_A"
    size: tuple[Annotated[int, Meta(ge=64, le=8192)], Annotated[int, Meta(ge=64, le=8192)]] = (1280, 800)
    fps: Hertz = 30.0
    exposure_us: Annotated[int, Meta(ge=1, le=500_000)] = 5000
    iso: Annotated[int, Meta(ge=100, le=6400)] = 400
    focus: Byte | None = None
    nn: Path | None = None
    labels: tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...] = ()
    confidence: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5

    def __post_init__(self) -> None:
        if self.labels and self.nn is None:
            raise ValueError("labels are of a network; give its archive as nn")


class UsbSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[usb]: a V4L2 camera with the kernel's time stamps. Settings that are absent are left as the camera has them.

    device: /dev/video0, a stable udev name, or a number. size: [w, h]. exposure_us: fixed, so that the mid-exposure
    time stays constant. gain: in the camera's own units. readout_s: rolling-shutter readout time from the first to
    the last row; 0 = not known.
    """

    device: str = "/dev/video0"
    size: Size | None = None
    fps: Hertz | None = None
    pixels: Literal["MJPG", "YUYV", "GREY"] = "MJPG"
    exposure_us: Microseconds | None = None
    gain: Annotated[int, Meta(ge=0, le=1_000_000)] | None = None
    readout_s: Readout = 0.0


class PiSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[picamera2]: a camera on a Raspberry Pi's ribbon cable.

    camera: its number. size: [w, h]. exposure_us, gain: fixed; without exposure_us, auto exposure. readout_s:
    rolling-shutter readout time; None = the shortest frame duration of the sensor mode.
    """

    camera: Annotated[int, Meta(ge=0, le=15)] = 0
    size: Size = (1280, 720)
    fps: Hertz = 30.0
    exposure_us: Microseconds | None = 5000
    gain: Annotated[float, Meta(ge=1.0, le=64.0)] | None = None
    readout_s: Readout | None = None
