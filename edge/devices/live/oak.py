"""OAK cameras through depthai: fixed exposure and focus, mid-exposure stamps, back after being unplugged.

Given an NN archive, the board detects too; what it found comes with the picture that it was found in.

The only module that knows depthai, which is imported when a camera is opened (90 MB, half a second).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from edge.devices.base import DeviceInfo, Frame, check_size
from edge.devices.live.oak_network import Naming, boxes
from edge.devices.live.reconnecting import Connection, Gone, ReturningCamera
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_QUEUE = 4  # newest frames: what is older than that has been waited for in vain
_BEHIND = 16  # pictures that wait for what the network finds in them


@dataclass(frozen=True, slots=True)
class OakSettings:
    """One sensor of one OAK board.

    device: IP address, device id or USB path; "" = the only one there is. socket: CAM_A, CAM_B or CAM_C.
    size: (width, height) [px]. exposure_us, iso: fixed, so that mid-exposure and brightness keep still.
    focus: lens position 0..255 of an auto-focus lens, fixed; None = a lens that cannot move.
    nn: archive of a detection network that runs on the board; None = none. labels: of it, those that are kept; none =
    all. confidence: 0..1, the least of a detection. prefix: of the names of people and vehicles.
    """

    device: str = ""
    socket: str = "CAM_A"
    size: tuple[int, int] = (1280, 800)
    fps: float = 30.0
    exposure_us: int = 5000
    iso: int = 400
    focus: int | None = None
    nn: Path | None = None
    labels: tuple[str, ...] = ()
    confidence: float = 0.5
    prefix: str = "oak"


@dataclass(slots=True)
class Stream:
    """An open pipeline, the queue of its pictures and that of what its network finds (depthai's objects)."""

    pipeline: Any
    queue: Any
    results: Any = None


class OakCamera(ReturningCamera):
    """A camera on an OAK board; see ``edge.devices.base.Device``.

    Stamps are the host's CLOCK_MONOTONIC, to which depthai maps the board's clock: that clock goes on when the board
    is plugged in again, as the board's own does not. connect: makes the stream; tests give a host-only one.
    now_ns: a monotonic clock; sleep: for trying again.
    """

    def __init__(
        self,
        settings: OakSettings,
        *,
        intrinsics: Intrinsics | None = None,
        connect: Callable[[OakSettings], Stream] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        name = settings.device or "OAK camera"
        make = connect or open_stream
        naming = Naming(settings.prefix)

        def connected() -> Connection:
            try:
                return OakConnection(make(settings), settings.labels, naming)
            except ImportError:
                raise InputError("depthai is not installed", remedy='pip install "syncline[oak]"') from None
            except RuntimeError as error:
                raise InputError(f"{name} does not answer: {_one_line(error)}", remedy=_REMEDY) from None

        def describe(connection: Connection, first: Frame) -> DeviceInfo:
            height, width = first.image.shape[:2]
            check_size(intrinsics, width, height, name)
            return DeviceInfo(width, height, settings.fps, "oak", "monotonic", intrinsics)

        super().__init__(name, connected, describe, remedy=_REMEDY, now_ns=now_ns, sleep=sleep)


class OakConnection:
    """The pictures of one open stream; with a network, those that it has looked at, and what it found.

    labels: those that are kept; none = all.
    """

    def __init__(self, stream: Stream, labels: tuple[str, ...] = (), naming: Naming | None = None) -> None:
        self._stream, self._labels = stream, labels
        self._naming = naming or Naming("oak")
        self._result: Any = None
        self._picture: Any = None

    def take(self, timeout_s: float) -> Frame | None:
        import depthai as dai

        results = self._stream.results
        if results is None:
            picture = self._get(self._stream.queue, timeout_s)
        else:
            if self._result is None:
                self._result = self._get(results, timeout_s)
            picture = None if self._result is None else self._shown(self._result.getSequenceNum(), timeout_s)
        if picture is None:
            return None
        middle = picture.getTimestamp(dai.CameraExposureOffset.MIDDLE)
        image = np.ascontiguousarray(_bgr(picture.getCvFrame()), dtype=np.uint8)
        time_ns = (middle // timedelta(microseconds=1)) * 1000
        found = None
        if results is not None:
            result, self._result = self._result, None
            size = (image.shape[1], image.shape[0])
            found = self._naming.detections(boxes(result, picture, size, self._labels), time_ns, size)
        return Frame(
            image=image,
            device_time_ns=time_ns,
            frame=int(picture.getSequenceNum()),
            exposure_ns=(picture.getExposureTime() // timedelta(microseconds=1)) * 1000,
            found=found,
        )

    def _shown(self, number: int, timeout_s: float) -> Any:
        """The picture of this sequence number; None where it has not come yet, or never will: then its result goes."""
        while self._picture is None or self._picture.getSequenceNum() < number:
            self._picture = self._get(self._stream.queue, timeout_s)
            if self._picture is None:
                return None
        if self._picture.getSequenceNum() > number:
            self._result = None
            return None
        picture, self._picture = self._picture, None
        return picture

    def _get(self, queue: Any, timeout_s: float) -> Any:
        import depthai as dai

        try:
            message = queue.get(timedelta(seconds=timeout_s))
        except (RuntimeError, dai.MessageQueue.QueueException):  # the link is gone
            raise Gone from None
        if message is None and not self._stream.pipeline.isRunning():
            raise Gone
        return message

    def close(self) -> None:
        with suppress(RuntimeError):
            self._stream.pipeline.stop()

    @property
    def temperature(self) -> float | None:
        """Of the board's chip [°C]; None where it does not tell."""
        device = getattr(self._stream.pipeline, "getDefaultDevice", lambda: None)()
        try:
            return None if device is None else float(device.getChipTemperature().average)
        except (RuntimeError, AttributeError):
            return None


_REMEDY = (
    "check cable and power, the group of /dev/bus/usb (udev rules: `syncline install`), or the address of a PoE board"
)


def open_stream(settings: OakSettings) -> Stream:
    """Open the board and start its camera and network.

    Raises RuntimeError where none answers, ImportError without depthai, InputError for a bad archive.
    """
    import depthai as dai

    archive = None if settings.nn is None else open_archive(settings.nn, settings.labels)
    if settings.device:
        device = dai.Device(dai.DeviceInfo(settings.device))
    else:
        if not dai.Device.getAllAvailableDevices():
            raise RuntimeError("no OAK board is found")  # opening would look for 11 s
        device = dai.Device()
    pipeline = dai.Pipeline(device)
    camera = pipeline.create(dai.node.Camera).build(getattr(dai.CameraBoardSocket, settings.socket))
    camera.initialControl.setManualExposure(settings.exposure_us, settings.iso)
    if settings.focus is not None:
        camera.initialControl.setManualFocus(settings.focus)
    output = camera.requestOutput(settings.size, dai.ImgFrame.Type.BGR888i, fps=settings.fps)
    queue = output.createOutputQueue(maxSize=_QUEUE if archive is None else _BEHIND, blocking=False)
    results = None
    if archive is not None:
        network = pipeline.create(dai.node.DetectionNetwork).build(camera, archive, fps=settings.fps)
        network.setConfidenceThreshold(settings.confidence)
        results = network.out.createOutputQueue(maxSize=_QUEUE, blocking=False)
    pipeline.start()
    return Stream(pipeline, queue, results)


def open_archive(file: Path, labels: tuple[str, ...] = ()) -> Any:
    """depthai's NNArchive of a file. Raises InputError where it is none, or does not know one of the labels."""
    import depthai as dai

    if not file.is_file():
        raise InputError("this NN archive does not exist", file=file, remedy="check the path")
    try:
        archive = dai.NNArchive(file)
        heads = archive.getConfig().model.heads or []
    except (RuntimeError, ValueError) as error:
        what = f"this is no NN archive that depthai can read: {_one_line(error)}"
        raise InputError(what, file=file, remedy="take a .tar.xz made for this kind of board") from None
    known = [name for head in heads for name in (head.metadata.classes or ())]
    strange = [label for label in labels if known and label not in known]
    if strange:
        told = ", ".join(known[:12]) + (", …" if len(known) > 12 else "")
        raise InputError(f"the network knows no {', '.join(strange)}", file=file, remedy=f"use some of {told}")
    return archive


def _bgr(image: Any) -> Any:
    """(H, W, 3) of a colour or grey picture."""
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
