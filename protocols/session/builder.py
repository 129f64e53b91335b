"""A session from messages: what the hub gathers live and what `calibrate` reads from a log are one thing."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import Message

from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import DEFAULT_LABEL, Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera

_REMEMBERED = 16_384
"""Sequences of one run that a live hub remembers to know duplicates by: nine minutes at 30 Hz; 2 KiB a camera."""
SETTLED_ROWS = 90
"""Detections from which on a restarted camera's new clock is worth solving."""


@dataclass(slots=True, eq=False)
class _Boot:
    """One run of one camera's agent: one clock. rows: (device time ns, frame, u, v, size, label)."""

    rows: deque[tuple[int, int, float, float, float, str]] = field(default_factory=deque)
    last_ns: int = -(2**63)
    """Clocks may count from anywhere, also below zero."""
    frames: int = 0
    seen: set[int] = field(default_factory=set)
    highest: int = -1
    ring: bytearray | None = None
    """Bit ``sequence % _REMEMBERED``: heard, of the last so many sequences up to the highest."""

    def knows(self, sequence: int) -> bool:
        """Whether it was heard before; from now on it was. Remembers all."""
        if sequence in self.seen:
            return True
        self.seen.add(sequence)
        return False

    def knows_lately(self, sequence: int) -> bool:
        """The same in constant memory, for a hub that runs for months: what is very old is taken for known."""
        if self.ring is None:
            self.ring = bytearray(_REMEMBERED // 8)  # all of it at once: what grows for an hour looks like a leak
        ahead = sequence - self.highest
        if -ahead >= _REMEMBERED:
            return True
        if ahead >= _REMEMBERED:
            self.ring[:] = bytes(_REMEMBERED // 8)
        else:
            for between in range(self.highest + 1, sequence):
                self.ring[between % _REMEMBERED >> 3] &= ~(1 << (between & 7))
        self.highest = max(self.highest, sequence)
        byte, bit = sequence % _REMEMBERED >> 3, 1 << (sequence & 7)
        known = ahead <= 0 and bool(self.ring[byte] & bit)
        self.ring[byte] |= bit
        return known


class SessionBuilder:
    """Gathers CameraInfo, RigInfo and Observation messages, in any order, duplicates and all.

    A camera that was restarted has a new clock: each boot is kept apart, and the one that saw most is used.
    window_s: keep only what each boot saw in its last so many seconds; None = everything.
    """

    def __init__(self, window_s: float | None = None) -> None:
        self._window_ns = None if window_s is None else round(window_s * NANOSECONDS)
        self._cameras: dict[str, pb.CameraInfo] = {}
        self._rig: pb.RigInfo | None = None
        self._boots: dict[str, dict[str, _Boot]] = {}
        self._settled: dict[str, int] = {}
        self.counters: Counter[str] = Counter()

    def handle(self, message: Message) -> None:
        """Take one message; other kinds are ignored."""
        if isinstance(message, pb.Observation):
            self._observe(message)
        elif isinstance(message, pb.CameraInfo):
            self._cameras[message.camera] = message
        elif isinstance(message, pb.RigInfo):
            self._rig = message

    def rows(self, camera: str) -> int:
        """Detections held of a camera, over all its boots."""
        return sum(len(boot.rows) for boot in self._boots.get(camera, {}).values())

    def frames(self, camera: str) -> int:
        """Frames received of a camera, also those without a detection."""
        return sum(boot.frames for boot in self._boots.get(camera, {}).values())

    @property
    def cameras(self) -> list[str]:
        """Cameras that were heard of, by name."""
        return sorted({*self._cameras, *self._boots})

    def boot(self, camera: str) -> str:
        """The boot whose clock the session speaks of.

        While a window moves on, the newest that has seen enough: an older one would else stay for as long as it saw.
        """
        boots = self._boots.get(camera, {})
        if self._window_ns is not None:
            for boot in reversed(boots):
                if len(boots[boot].rows) >= self._settled.get(boot, SETTLED_ROWS):
                    return boot
        return max(sorted(boots), key=lambda boot: len(boots[boot].rows), default="")

    def settle_after(self, boot: str, rows: int) -> None:
        """A boot is used only from so many detections on, because until then the one before it serves better."""
        self._settled[boot] = rows

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was left out of the session."""
        told = []
        for camera in sorted(self._boots):
            kept = self.boot(camera)
            lost = sum(len(boot.rows) for name, boot in self._boots[camera].items() if name != kept)
            if lost:
                told.append(
                    f"{camera} was restarted, which begins a new clock: {lost} detections of other boots left out"
                )
        return tuple(told)

    def build(self) -> tuple[Rig, Observations]:
        """The session as it stands. Raises Refused where there is no camera or nothing was seen."""
        if not self._cameras:
            raise Refused("no camera has introduced itself yet" if not self._boots else "no camera told its intrinsics")
        names: list[str] = []
        labels: list[str] = []
        values: list[tuple[int, int, float, float, float]] = []
        for camera in sorted(self._cameras):
            boots = self._boots.get(camera)
            if not boots:
                continue
            for row in boots[self.boot(camera)].rows:
                names.append(camera)
                labels.append(row[5])
                values.append(row[:5])
        if not values:
            raise Refused("no camera has seen anything yet")
        time = np.array([value[0] for value in values], dtype=np.float64) / NANOSECONDS
        rest = np.array([value[1:] for value in values], dtype=np.float64)
        size = np.where(rest[:, 3] > 0, rest[:, 3], np.nan)
        order = sorted(self._cameras)
        observations = gather_tracks(
            names, labels, rest[:, 0].astype(np.int64), time, np.ascontiguousarray(rest[:, 1:3]), size, order=order
        )
        return self._build_rig(order), observations

    def _observe(self, message: pb.Observation) -> None:
        boots = self._boots.setdefault(message.camera, {})
        boot = boots.get(message.boot_id)
        if boot is None:
            boot = boots[message.boot_id] = _Boot()
        known = boot.knows if self._window_ns is None else boot.knows_lately
        if known(message.sequence):
            self.counters["duplicates"] += 1
            return
        boot.frames += 1
        labels: set[str] = set()
        # One row a label and frame: of several detections the surest is the point, the rest are doubtful.
        for detection in sorted(message.detections, key=lambda found: -found.score):
            label = detection.label or DEFAULT_LABEL
            if label in labels:
                self.counters["second_detections"] += 1
                continue
            labels.add(label)
            boot.rows.append((message.device_time_ns, message.frame, detection.u, detection.v, detection.size, label))
        boot.last_ns = max(boot.last_ns, message.device_time_ns)
        if self._window_ns is not None:
            while boot.rows and boot.rows[0][0] < boot.last_ns - self._window_ns:
                boot.rows.popleft()

    def _build_rig(self, order: list[str]) -> Rig:
        info = self._rig
        cameras = {name: rig_camera(self._cameras[name]) for name in order}
        if info is None:
            return Rig(cameras)
        inside = [d for d in info.distances if d.camera_a in cameras and d.camera_b in cameras]
        up: Floats | str | None = None
        if info.up_camera in cameras:
            up = info.up_camera
        elif len(info.up) == 3:
            up = np.array(info.up) / np.linalg.norm(info.up)
        metadata: dict[str, Any] = {}
        if info.reference_camera:
            metadata["reference"] = info.reference_camera
        return Rig(
            cameras,
            info.units or "m",
            info.clock or "independent",
            tuple((d.camera_a, d.camera_b, d.distance) for d in inside),
            up,
            metadata,
        )


def rig_camera(info: pb.CameraInfo) -> RigCamera:
    """The rig's table of a camera as the camera itself tells it."""
    lens = None
    if len(info.matrix) == 9:
        matrix = np.array(info.matrix).reshape(3, 3)
        distortions = np.array(info.distortions) if info.distortions else np.zeros(4 if info.fisheye else 5)
        lens = Intrinsics(info.width, info.height, matrix, distortions, info.fisheye)
    return RigCamera(
        name=info.camera,
        size=(info.width, info.height),
        fps=info.fps,
        intrinsics=lens,
        position=_vector(info.position),
        rotation=None if len(info.rotation) != 3 else so3.exp(np.array(info.rotation)),
        position_std=_vector(info.position_std),
        rotation_std=_vector(info.rotation_std),
        table={"name": info.camera, "size": [info.width, info.height], "fps": info.fps},
    )


def _vector(values: Any) -> Floats | None:
    return np.array(values, dtype=np.float64) if len(values) == 3 else None
