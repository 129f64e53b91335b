"""The images of one camera in a log, with their capture times on the camera's clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, FLIGHT_IMAGE, PICTURE

_TOPICS = (PICTURE, FLIGHT_IMAGE)


@dataclass(frozen=True, slots=True)
class ImageRun:
    """The images of one boot of a camera, within which its clock is continuous.

    times_ns: capture times on that clock, in file order. info: the CameraInfo of this boot, if there is one.
    """

    camera: str
    boot: str
    times_ns: tuple[int, ...]
    info: pb.CameraInfo | None


def image_runs(reader: LogReader) -> list[ImageRun]:
    """All boots of all cameras (and UAV agents) that have images in the log, in order of the first image."""
    times: dict[tuple[str, str], list[int]] = {}
    infos: dict[tuple[str, str], pb.CameraInfo] = {}
    for logged in reader.messages([*_TOPICS, CAMERA_INFO]):
        message: Any = logged.message
        if isinstance(message, pb.CameraInfo):
            infos[message.camera, message.boot_id] = message
        else:
            times.setdefault((logged.agent, message.boot_id), []).append(message.device_time_ns)
    return [ImageRun(*name, tuple(stamps), infos.get(name)) for name, stamps in times.items()]


def read_images(reader: LogReader, run: ImageRun) -> Iterator[pb.Picture | pb.FlightImage]:
    """The images of one boot in file order, as JPEG.

    ``width`` and ``height`` are of the image to whose pixels observations refer; the JPEG may be smaller.
    """
    for logged in reader.messages(_TOPICS):
        message: Any = logged.message
        if (logged.agent, message.boot_id) == (run.camera, run.boot):
            yield message
