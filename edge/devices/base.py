"""The interface of all camera drivers: ``Device``, its frames and its description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from edge.detectors.base import Detection
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Image

ClockKind = Literal["device", "monotonic", "unix", "stream"]
"""The clock of the device times: the camera's own oscillator, the host's monotonic clock, the host's Unix time,
or the time stamps inside a file or stream."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image and its time stamp.

    image: (H, W, 3) uint8 BGR; the reader may keep it, the driver does not write to it again.
    device_time_ns: mid-exposure of the middle row, on the device's own clock of arbitrary epoch.
    frame: the device's frame number; a gap means dropped frames.
    exposure_ns: 0 = not known.
    detections: those of a network on the device itself; None = the device does not detect.
    """

    image: Image
    device_time_ns: int
    frame: int
    exposure_ns: int = 0
    detections: tuple[Detection, ...] | None = None


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Description of an open camera.

    width, height: image size [px]. fps: nominal, 0 = not known. driver: its name.
    clock: the clock of the device times. intrinsics: None = uncalibrated.
    readout_s: first to last row; 0 = global shutter or not known.
    unknown: quantities that this driver cannot provide, as text ("exposure", "time of capture").
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
    """A source of frames, used by one thread at a time."""

    @property
    def info(self) -> DeviceInfo:
        """Valid after ``open``."""

    @property
    def ended(self) -> bool:
        """True once no further frame will come: the end of a recording, or a camera lost for good."""

    def open(self) -> None:
        """Start delivering. Raises InputError where the source cannot be opened."""

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None if none came within ``timeout_s`` or the source has ended."""

    def close(self) -> None:
        """Release the source; may be called twice."""


@runtime_checkable
class Reconnecting(Protocol):
    """Additional properties of a live camera, which reconnects by itself after it was unplugged."""

    @property
    def disconnected(self) -> bool:
        """Whether the connection is lost; every ``read`` then tries to reconnect."""

    @property
    def reconnections(self) -> int:
        """Number of successful reconnections."""

    @property
    def temperature(self) -> float | None:
        """[°C]; None where it is not measured."""


class WrappedDevice:
    """A device that passes everything on to another; base of those that add something to it."""

    def __init__(self, device: Device) -> None:
        self._device = device

    @property
    def info(self) -> DeviceInfo:
        return self._device.info

    @property
    def ended(self) -> bool:
        return self._device.ended

    @property
    def disconnected(self) -> bool:
        """Whether the device is disconnected; False for one that does not reconnect."""
        return isinstance(self._device, Reconnecting) and self._device.disconnected

    @property
    def reconnections(self) -> int:
        return self._device.reconnections if isinstance(self._device, Reconnecting) else 0

    @property
    def temperature(self) -> float | None:
        return self._device.temperature if isinstance(self._device, Reconnecting) else None

    def open(self) -> None:
        self._device.open()

    def read(self, timeout_s: float) -> Frame | None:
        return self._device.read(timeout_s)

    def close(self) -> None:
        self._device.close()


def check_size(intrinsics: Intrinsics | None, width: int, height: int, what: str) -> None:
    """Raise InputError if the intrinsics are for another image size than that of the source ``what``."""
    if intrinsics is not None and (intrinsics.width, intrinsics.height) != (width, height):
        raise InputError(
            f"{what} is {width}x{height}, its intrinsics are for {intrinsics.width}x{intrinsics.height}",
            remedy="calibrate at this size, or set the camera to that one",
        )
