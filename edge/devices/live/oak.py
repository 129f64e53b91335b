"""OAK cameras through depthai: fixed exposure and focus, mid-exposure stamps, automatic reconnection.

With an NN archive the board also runs a detection network; its detections are delivered with the frame they belong to.

depthai is imported only when a camera is opened (90 MB, half a second).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from edge.detectors.network.boxes import BoxLabeller, NetworkBox
from edge.devices.base import DeviceInfo, Frame
from edge.devices.live.reconnecting import Connection, ConnectionLost, ReconnectingCamera
from edge.devices.settings import OakSettings
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_MAX_BOXES = 64  # by confidence: more are noise
_QUEUE_LENGTH = 4  # frames: older ones are discarded
_SYNC_QUEUE_LENGTH = 16  # frames that wait for the network's result
_REMEDY = (
    "check cable and power, the group of /dev/bus/usb (udev rules: `syncline install`), or the address of a PoE board"
)


def boxes_in_image(message: Any, image: Any, size: tuple[int, int], keep: Sequence[str] = ()) -> list[NetworkBox]:
    """The boxes of a depthai ImgDetections in an image (ImgFrame) of ``size`` (width, height) px, by confidence.

    keep: only these labels; empty = all. Both messages carry the transformation from the sensor's image (crop, scale);
    raises InputError where one lacks it, because the boxes then cannot be located in the image.
    """
    found, image_transform = message.getTransformation(), image.getTransformation()
    if found is None or image_transform is None or not (found.isValid() and image_transform.isValid()):
        raise InputError(
            "the network's results carry no image transformation, so their boxes cannot be located",
            remedy="update depthai",
        )
    result = []
    for detection in message.transformTo(image_transform).detections:
        left, right = detection.xmin * size[0], detection.xmax * size[0]
        top, bottom = detection.ymin * size[1], detection.ymax * size[1]
        valid = all(math.isfinite(value) for value in (left, right, top, bottom, detection.confidence))
        label = detection.labelName or str(detection.label)
        if valid and right > left and bottom > top and (not keep or label in keep):
            box = NetworkBox(label, min(max(detection.confidence, 0.0), 1.0), left, top, right - left, bottom - top)
            if 0.0 <= left + 0.5 * box.width <= size[0] and 0.0 <= top + 0.5 * box.height <= size[1]:
                result.append(box)
    return sorted(result, key=lambda box: box.confidence, reverse=True)[:_MAX_BOXES]


@dataclass(slots=True)
class OakStream:
    """depthai's objects of an open pipeline: the pipeline, its queue of frames and its queue of detections."""

    pipeline: Any
    queue: Any
    results: Any = None


class OakCamera(ReconnectingCamera):
    """A camera on an OAK board; see ``edge.devices.base.Device``.

    Stamps are in the host's CLOCK_MONOTONIC, to which depthai maps the board's clock: unlike the board's own clock it
    continues when the board is plugged in again.
    prefix: of the labels of people and vehicles. connect: opens the stream; tests pass a host-only pipeline.
    now_ns: a monotonic clock.
    """

    def __init__(
        self,
        settings: OakSettings,
        *,
        intrinsics: Intrinsics | None = None,
        prefix: str = "oak",
        connect: Callable[[OakSettings], OakStream] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        name = settings.device or "OAK camera"
        make = connect or open_stream
        labeller = BoxLabeller(f"{prefix}-")

        def connected() -> Connection:
            try:
                return OakConnection(make(settings), settings.labels, labeller)
            except ImportError:
                raise InputError("depthai is not installed", remedy='pip install "syncline[oak]"') from None
            except RuntimeError as error:
                raise InputError(f"{name} does not answer: {_one_line(error)}", remedy=_REMEDY) from None

        def describe(connection: OakConnection, width: int, height: int) -> DeviceInfo:
            return DeviceInfo(width, height, settings.fps, "oak", "monotonic")

        super().__init__(name, connected, describe, intrinsics, remedy=_REMEDY, now_ns=now_ns)


class OakConnection:
    """The frames of one open stream; with a network, only the frames that it processed, with their detections.

    labels: the classes to keep; empty = all.
    """

    def __init__(self, stream: OakStream, labels: tuple[str, ...] = (), labeller: BoxLabeller | None = None) -> None:
        self._stream, self._labels = stream, labels
        self._labeller = labeller or BoxLabeller("oak-")
        self._result: Any = None
        self._pending_frame: Any = None

    def take(self, timeout_s: float) -> Frame | None:
        import depthai as dai

        results = self._stream.results
        if results is None:
            message = self._get(self._stream.queue, timeout_s)
        else:
            if self._result is None:
                self._result = self._get(results, timeout_s)
            message = None if self._result is None else self._matching_image(self._result.getSequenceNum(), timeout_s)
        if message is None:
            return None
        middle = message.getTimestamp(dai.CameraExposureOffset.MIDDLE)
        image = np.ascontiguousarray(message.getCvFrame(), dtype=np.uint8)
        if image.ndim == 2:
            image = np.repeat(image[:, :, None], 3, axis=2)
        time_ns = (middle // timedelta(microseconds=1)) * 1000
        detections = None
        if results is not None:
            result, self._result = self._result, None
            size = (image.shape[1], image.shape[0])
            detections = self._labeller.detections(boxes_in_image(result, message, size, self._labels), time_ns, size)
        return Frame(
            image=image,
            device_time_ns=time_ns,
            frame=int(message.getSequenceNum()),
            exposure_ns=(message.getExposureTime() // timedelta(microseconds=1)) * 1000,
            detections=detections,
        )

    def _matching_image(self, number: int, timeout_s: float) -> Any:
        """The frame of this sequence number; None if it has not arrived, or was lost: then its result is dropped."""
        while self._pending_frame is None or self._pending_frame.getSequenceNum() < number:
            self._pending_frame = self._get(self._stream.queue, timeout_s)
            if self._pending_frame is None:
                return None
        if self._pending_frame.getSequenceNum() > number:
            self._result = None
            return None
        message, self._pending_frame = self._pending_frame, None
        return message

    def _get(self, queue: Any, timeout_s: float) -> Any:
        import depthai as dai

        try:
            message = queue.get(timedelta(seconds=timeout_s))
        except (RuntimeError, dai.MessageQueue.QueueException):  # the connection is lost
            raise ConnectionLost from None
        if message is None and not self._stream.pipeline.isRunning():
            raise ConnectionLost
        return message

    def close(self) -> None:
        with suppress(RuntimeError):
            self._stream.pipeline.stop()

    @property
    def temperature(self) -> float | None:
        """Temperature of the board's chip [°C]; None where it is not available."""
        device = getattr(self._stream.pipeline, "getDefaultDevice", lambda: None)()
        try:
            return None if device is None else float(device.getChipTemperature().average)
        except (RuntimeError, AttributeError):
            return None


def open_stream(settings: OakSettings) -> OakStream:
    """Open the board and start its camera and network.

    Raises RuntimeError where no board answers, ImportError without depthai, InputError for a bad archive.
    """
    import depthai as dai

    archive = None if settings.nn is None else open_archive(settings.nn, settings.labels)
    if settings.device:
        device = dai.Device(dai.DeviceInfo(settings.device))
    else:
        if not dai.Device.getAllAvailableDevices():
            raise RuntimeError("no OAK board is found")  # depthai would search for 11 s
        device = dai.Device()
    pipeline = dai.Pipeline(device)
    camera = pipeline.create(dai.node.Camera).build(getattr(dai.CameraBoardSocket, settings.socket))
    camera.initialControl.setManualExposure(settings.exposure_us, settings.iso)
    if settings.focus is not None:
        camera.initialControl.setManualFocus(settings.focus)
    output = camera.requestOutput(settings.size, dai.ImgFrame.Type.BGR888i, fps=settings.fps)
    queue = output.createOutputQueue(maxSize=_QUEUE_LENGTH if archive is None else _SYNC_QUEUE_LENGTH, blocking=False)
    results = None
    if archive is not None:
        network = pipeline.create(dai.node.DetectionNetwork).build(camera, archive, fps=settings.fps)
        network.setConfidenceThreshold(settings.confidence)
        results = network.out.createOutputQueue(maxSize=_QUEUE_LENGTH, blocking=False)
    pipeline.start()
    return OakStream(pipeline, queue, results)


def open_archive(file: Path, labels: tuple[str, ...] = ()) -> Any:
    """depthai's NNArchive of a file. Raises InputError if it cannot be read or lacks one of the labels."""
    import depthai as dai

    if not file.is_file():
        raise InputError("this NN archive does not exist", file=file, remedy="check the path")
    try:
        archive = dai.NNArchive(file)
        heads = archive.getConfig().model.heads or []
    except (RuntimeError, ValueError) as error:
        what = f"depthai cannot read this NN archive: {_one_line(error)}"
        raise InputError(what, file=file, remedy="take a .tar.xz made for this kind of board") from None
    known = [name for head in heads for name in (head.metadata.classes or ())]
    unknown = [label for label in labels if known and label not in known]
    if unknown:
        listed = ", ".join(known[:12]) + (", …" if len(known) > 12 else "")
        raise InputError(f"the network has no class {', '.join(unknown)}", file=file, remedy=f"use some of {listed}")
    return archive


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
