"""A simulated session as its cameras' agents publish it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from deploy.offline.exchange.session_log import camera_info
from protocols.core.clocks import NANOSECONDS
from protocols.messages import syncline_pb2 as pb
from tests.support.rigs import Session


def info_messages(session: Session, boot: Callable[[str], str]) -> list[pb.CameraInfo]:
    """One a camera. boot: a camera's boot id."""
    infos = [camera_info(session.rig, name) for name in session.rig.cameras]
    for info in infos:
        info.boot_id = boot(info.camera)
    return infos


def row_messages(
    session: Session, boot: Callable[[str], str], order: Iterable[int], time: Callable[[int], float]
) -> Iterator[pb.Observation]:
    """One a row in this order. time: of a row on its camera's clock [s]."""
    counts: dict[str, int] = {}
    for i in order:
        name = session.camera[i]
        counts[name] = counts.get(name, -1) + 1
        yield pb.Observation(
            schema_version=1,
            camera=name,
            boot_id=boot(name),
            sequence=counts[name],
            frame=int(session.frame[i]),
            device_time_ns=round(time(i) * NANOSECONDS),
            detections=[pb.Detection(u=session.pixels[i, 0], v=session.pixels[i, 1], score=1.0, label="marker")],
        )
