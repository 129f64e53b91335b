"""Messages of the pose benchmark's cameras as their agents would publish them, for tests of hosts and hubs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import Rig, RigCamera
from tests.bench.pose_worlds import FOCAL, Sightings, SimulatedRig

CENTRE = (639.5, 479.5)
STEP_NS = 20_000_000


def name(camera: int) -> str:
    """A camera's id."""
    return f"cam{camera}"


def info(camera: int, boot: str = "b0", focal: float = FOCAL) -> pb.CameraInfo:
    """A camera's CameraInfo message with its intrinsics."""
    matrix = [focal, 0.0, CENTRE[0], 0.0, focal, CENTRE[1], 0.0, 0.0, 1.0]
    return pb.CameraInfo(
        schema_version=1, camera=name(camera), boot_id=boot, width=1280, height=960, fps=30.0, matrix=matrix,
        distortions=[0.0] * 5,
    )  # fmt: skip


class Stream:
    """Converts sightings to observations: one point per time step, on one clock."""

    def __init__(self) -> None:
        self.time_ns = 1_000_000_000
        self._sequences: dict[int, int] = {}

    def observations(self, sightings: Sightings, boot: str = "b0") -> Iterator[pb.Observation]:
        """Two observations per point."""
        for cameras, seen in zip(sightings.cameras.tolist(), sightings.seen, strict=True):
            self.time_ns += STEP_NS
            for camera, (x, y, log_size) in zip(cameras, seen.tolist(), strict=True):
                sequence = self._sequences.get(camera, 0)
                self._sequences[camera] = sequence + 1
                found = pb.Detection(
                    u=FOCAL * x + CENTRE[0], v=FOCAL * y + CENTRE[1], size=FOCAL * float(np.exp(log_size)), score=0.9
                )
                yield pb.Observation(
                    schema_version=1,
                    camera=name(camera),
                    boot_id=boot,
                    sequence=sequence,
                    frame=sequence,
                    device_time_ns=self.time_ns,
                    detections=[found],
                )


def known_rig(world: SimulatedRig) -> Rig:
    """Rig with known intrinsics, two known positions and one known attitude, as in section 4; one clock. In cm."""
    cameras = {}
    for k, pose in enumerate(world.poses):
        from protocols.session.builder import rig_camera_from_info

        lens = rig_camera_from_info(info(k)).intrinsics
        position = pose.position if k < 2 else None
        rotation = pose.rotation if k == 0 else None
        cameras[name(k)] = RigCamera(name(k), (1280, 960), 30.0, lens, position, rotation)
    return Rig(cameras, "cm", "shared")
