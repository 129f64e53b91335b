"""What every camera driver is to the rest: opened, asked for frames, closed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

Image: TypeAlias = npt.NDArray[np.uint8]
"""(H, W, 3) uint8, channels in OpenCV's order: blue, green, red."""

ClockKind = Literal["device", "monotonic", "unix", "stream"]
"""What a device time is read from: the camera's own oscillator, the host's uptime, the host's Unix time,
or the time stamps inside a file or stream."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture and when it was taken.

    image: (H, W, 3) uint8 BGR; the reader may keep it, the driver does not write to it again.
    device_time_ns: mid-exposure of the middle row, on the device's own clock of arbitrary epoch.
    frame: the device's frame number; a gap is a dropped frame.
    exposure_ns: 0 = not known.
    found: what the device itself detected in it; None = it does not look.
    """

    image: Image
    device_time_ns: int
    frame: int
    exposure_ns: int = 0
    found: tuple[Detection, ...] | None = None


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What a driver can say of its camera once it is open.

    width, height: image size [px]. fps: nominal, 0 = not known. driver: its name.
    clock: what the device times are read from. intrinsics: None = uncalibrated.
    readout_s: first to last row; 0 = global shutter or not known.
    unknown: what this driver cannot tell, in words for a person ("exposure", "time of capture").
    """

    width: int
    height: int
    fps: float
    driver: str
    clock: ClockKind
    intrinsics: Intrinsics | None = None
    readout_s: float = 0.0
    unknown: tuple[str, ...] = ()


class Device(Protocol):
    """A source of frames. One thread uses it."""

    @property
    def info(self) -> DeviceInfo:
        """Valid after ``open``."""

    @property
    def ended(self) -> bool:
        """True once no frame will ever come again: the end of a recording, or the camera is gone."""

    def open(self) -> None:
        """Start delivering. Raises InputError where the source cannot be opened."""

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None where none came within ``timeout_s`` or the source has ended."""

    def close(self) -> None:
        """Release the source; may be called twice."""


@runtime_checkable
class Returning(Protocol):
    """What a device that comes back by itself after it was unplugged can say besides."""

    @property
    def away(self) -> bool:
        """Whether it is gone, and is tried again with every ``read``."""

    @property
    def reconnections(self) -> int:
        """How often it came back."""


@runtime_checkable
class Warm(Protocol):
    """What a device that measures its own heat can say besides."""

    @property
    def temperature(self) -> float | None:
        """[°C]; None where it does not tell."""


def check_size(intrinsics: Intrinsics | None, width: int, height: int, what: str) -> None:
    """Raise InputError where intrinsics are for another image size than the source ``what`` has."""
    if intrinsics is not None and (intrinsics.width, intrinsics.height) != (width, height):
        raise InputError(
            f"{what} is {width}x{height}, its intrinsics are for {intrinsics.width}x{intrinsics.height}",
            remedy="calibrate at this size, or set the camera to that one",
        )
