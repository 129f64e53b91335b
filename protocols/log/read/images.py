"""The pictures of one camera in a log, with the capture times that the camera gave them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, FLIGHT_IMAGE, PICTURE

_TOPICS = (PICTURE, FLIGHT_IMAGE)


@dataclass(frozen=True, slots=True)
class PictureRun:
    """The pictures of one run (boot) of a camera: within it, its clock is one.

    times_ns: capture times on that clock, in file order. info: what the camera told of itself in this run, if it did.
    """

    camera: str
    boot: str
    times_ns: tuple[int, ...]
    info: pb.CameraInfo | None


def picture_runs(reader: LogReader) -> list[PictureRun]:
    """All runs of all cameras (UAV agents too) that have pictures in the log, in the order of their first."""
    times: dict[tuple[str, str], list[int]] = {}
    infos: dict[tuple[str, str], pb.CameraInfo] = {}
    for logged in reader.messages([*_TOPICS, CAMERA_INFO]):
        message: Any = logged.message
        if isinstance(message, pb.CameraInfo):
            infos[message.camera, message.boot_id] = message
        else:
            times.setdefault((logged.agent, message.boot_id), []).append(message.device_time_ns)
    return [PictureRun(*name, tuple(stamps), infos.get(name)) for name, stamps in times.items()]


def pictures(reader: LogReader, run: PictureRun) -> Iterator[pb.Picture | pb.FlightImage]:
    """The pictures of one run in file order, as JPEG.

    ``width`` and ``height`` are of the image in which the camera told its observations; the JPEG may be smaller.
    """
    for logged in reader.messages(_TOPICS):
        message: Any = logged.message
        if (logged.agent, message.boot_id) == (run.camera, run.boot):
            yield message
