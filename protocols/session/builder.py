"""Builds a session (rig and observations) from messages, for the live hub and for `calibrate` on a log alike."""

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

_DUPLICATE_WINDOW = 16_384
"""Sequence numbers of one run that a live hub remembers to detect duplicates: nine minutes at 30 Hz; 2 KiB a camera."""
MIN_ROWS_AFTER_RESTART = 90
"""Detections from which on the new clock of a restarted camera is used."""


@dataclass(slots=True, eq=False)
class _BootBuffer:
    """The observations of one boot of one camera's agent, which has one clock.

    rows: (device time ns, frame, u, v, size, label).
    """

    rows: deque[tuple[int, int, float, float, float, str]] = field(default_factory=deque)
    last_ns: int = -(2**63)
    """Clocks may count from any origin, so times may be negative."""
    frames: int = 0
    seen: set[int] = field(default_factory=set)
    highest: int = -1
    ring: bytearray | None = None
    """Bit ``sequence % _REMEMBERED``: received, for the last so many sequence numbers up to the highest."""

    def is_duplicate(self, sequence: int) -> bool:
        """Whether the sequence number was received before; marks it as received. Remembers all of them."""
        if sequence in self.seen:
            return True
        self.seen.add(sequence)
        return False

    def is_recent_duplicate(self, sequence: int) -> bool:
        """The same in constant memory, for a hub that runs for months: a very old number counts as a duplicate."""
        if self.ring is None:
            self.ring = bytearray(
                _DUPLICATE_WINDOW // 8
            )  # allocated at once: memory that grows for an hour looks like a leak
        ahead = sequence - self.highest
        if -ahead >= _DUPLICATE_WINDOW:
            return True
        if ahead >= _DUPLICATE_WINDOW:
            self.ring[:] = bytes(_DUPLICATE_WINDOW // 8)
        else:
            for between in range(self.highest + 1, sequence):
                self.ring[between % _DUPLICATE_WINDOW >> 3] &= ~(1 << (between & 7))
        self.highest = max(self.highest, sequence)
        byte, bit = sequence % _DUPLICATE_WINDOW >> 3, 1 << (sequence & 7)
        known = ahead <= 0 and bool(self.ring[byte] & bit)
        self.ring[byte] |= bit
        return known


class SessionBuilder:
    """Collects CameraInfo, RigInfo and Observation messages, in any order and with duplicates.

    A restarted camera has a new clock: each boot is stored separately, and the one with the most detections is used.
    window_s: keep only the detections of each boot's last so many seconds; None = all.
    """

    def __init__(self, window_s: float | None = None) -> None:
        self._window_ns = None if window_s is None else round(window_s * NANOSECONDS)
        self._cameras: dict[str, pb.CameraInfo] = {}
        self._rig: pb.RigInfo | None = None
        self._boots: dict[str, dict[str, _BootBuffer]] = {}
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
        """Cameras of which a message was received, sorted by name."""
        return sorted({*self._cameras, *self._boots})

    def boot(self, camera: str) -> str:
        """The boot id whose clock and detections the session uses.

        With a moving window, the newest boot with enough detections: otherwise an older one would be used too long.
        """
        boots = self._boots.get(camera, {})
        if self._window_ns is not None:
            for boot in reversed(boots):
                if len(boots[boot].rows) >= self._settled.get(boot, MIN_ROWS_AFTER_RESTART):
                    return boot
        return max(sorted(boots), key=lambda boot: len(boots[boot].rows), default="")

    def require_rows(self, boot: str, rows: int) -> None:
        """Use a boot only once it has so many detections; until then the boot before it is used."""
        self._settled[boot] = rows

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was omitted from the session."""
        warnings = []
        for camera in sorted(self._boots):
            kept = self.boot(camera)
            lost = sum(len(boot.rows) for name, boot in self._boots[camera].items() if name != kept)
            if lost:
                warnings.append(
                    f"{camera} was restarted, which begins a new clock: {lost} detections of other boots left out"
                )
        return tuple(warnings)

    def build(self) -> tuple[Rig, Observations]:
        """The session so far. Raises Refused where there is no camera or no detection."""
        if not self._cameras:
            raise Refused("no camera has introduced itself yet" if not self._boots else "no camera published its info")
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
            boot = boots[message.boot_id] = _BootBuffer()
        known = boot.is_duplicate if self._window_ns is None else boot.is_recent_duplicate
        if known(message.sequence):
            self.counters["duplicates"] += 1
            return
        boot.frames += 1
        labels: set[str] = set()
        # One row per label and frame: of several detections the one of the highest score is used.
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
        cameras = {name: rig_camera_from_info(self._cameras[name]) for name in order}
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


def rig_camera_from_info(info: pb.CameraInfo) -> RigCamera:
    """The rig's entry of a camera, from the CameraInfo that the camera published."""
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
