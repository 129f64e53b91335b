"""Builds a session (rig and observations) from messages, for the live hub and for `calibrate` on a log alike."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf.message import Message

from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError, Refused
from protocols.core.ranges import MAX_FPS
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import DEFAULT_LABEL, Observations, gather_columns
from protocols.session.rig import Rig, RigCamera, longest_readout

_DUPLICATE_WINDOW = 16_384
"""Sequence numbers of one run that a live hub remembers to detect duplicates: nine minutes at 30 Hz; 2 KiB a camera."""
CHUNK_S = 2.0
"""Length of the intervals that are kept or dropped as a whole [s]."""
_MAX_AGE = 10
"""A chunk older than so many windows is dropped first: clocks do not stay linear for ever."""
_MAX_STEP_PX = 50.0
"""A longer step from frame to frame is a false detection rather than motion."""
_MOVING = 20.0
"""Motion in a chunk [px] from which a camera saw its target move."""
_MAX_CHUNK_ROWS = 8_000
"""Detections of one camera in a chunk: twelve points at 330 frames a second. A camera that floods costs only itself."""
_MAX_ROWS = 600_000
"""Detections of all cameras that a live hub holds, 64 bytes each, and once more while they are solved: 20 s of a
thousand cameras at 30 Hz. Above, frames between are left out where less than `LONG_FILM_S` would be held, and then the
camera with the most gives up its oldest."""
LONG_FILM_S = 30.0
"""A street of cameras is connected by a film of so many seconds, and by one of 20 s not (docs/results/speed.md)."""
_THINNED_HZ = 10.0
"""Frames a second where all do not fit: 30 s of 1,000 cameras are solved in 78 s of CPU, at 30 frames a second in 125.
"""
_MAX_LABELS = 256
"""Labels of one camera: whole bodies have 133 points."""
_MAX_BOOTS = 8
"""Runs of one camera that are remembered, segments of its clock included."""
MIN_ROWS_AFTER_RESTART = 90
"""Detections from which on the new clock of a restarted camera is used."""


_ROW = np.dtype("i8, i8, i8, i4, i4, f8, f8, f8, f8")
_ROW.names = ("time_ns", "frame", "sequence", "chunk", "label", "u", "v", "size", "std")
_pack_row = struct.Struct("=qqqiidddd").pack
"""A detection; chunk: number of the interval of arrival; label: index into the builder's labels."""


@dataclass(slots=True, eq=False)
class _BootBuffer:
    """The observations of one boot of one camera's agent, which has one clock.

    rows: packed, in order of arrival. last: by label, u and v. room: a chunk, and how many rows of it are still taken.
    """

    rows: bytearray = field(default_factory=bytearray)
    last: dict[int, tuple[float, float]] = field(default_factory=dict)
    room: tuple[int, int] = (-1, 0)
    seen: set[int] = field(default_factory=set)
    highest: int = -1
    highest_at: tuple[int, float] = 0, 0.0
    """Device time [ns] and moment of arrival [s] of the frame with the highest sequence number."""
    ring: bytearray | None = None
    """Bit ``sequence % _REMEMBERED``: received, for the last so many sequence numbers up to the highest."""

    def __len__(self) -> int:
        return len(self.rows) // _ROW.itemsize

    def table(self) -> Any:
        """A copy of the rows, as an array of ``_ROW``: nothing may be appended to what an array looks at."""
        return np.frombuffer(bytes(self.rows), dtype=_ROW)

    def take(self, keep: Ints | Bools) -> None:
        """Keep only these rows."""
        self.rows = bytearray(self.table()[keep].tobytes())

    def is_duplicate(self, sequence: int) -> bool:
        """Whether the sequence number was received before; marks it as received. Remembers all of them."""
        if sequence in self.seen:
            return True
        self.seen.add(sequence)
        return False

    def is_recent_duplicate(self, sequence: int, time_ns: int, moment: float) -> bool:
        """The same in constant memory, for a hub that runs for months: a very old number counts as a duplicate."""
        if self.ring is None:
            self.ring = bytearray(
                _DUPLICATE_WINDOW // 8
            )  # allocated at once: memory that grows for an hour looks like a leak
        ahead = sequence - self.highest
        if self.highest >= 0 and is_stray_number(ahead, moment - self.highest_at[1]):
            return False
        if -ahead >= _DUPLICATE_WINDOW:
            return True
        if ahead >= _DUPLICATE_WINDOW:
            self.ring[:] = bytes(_DUPLICATE_WINDOW // 8)
        elif ahead != 1:
            for between in range(self.highest + 1, sequence):
                self.ring[between % _DUPLICATE_WINDOW >> 3] &= ~(1 << (between & 7))
        if ahead > 0:
            self.highest, self.highest_at = sequence, (time_ns, moment)
        byte, bit = sequence % _DUPLICATE_WINDOW >> 3, 1 << (sequence & 7)
        known = ahead <= 0 and bool(self.ring[byte] & bit)
        self.ring[byte] |= bit
        return known


def is_stray_number(ahead: int, elapsed_s: float) -> bool:
    """Whether a sequence number is further ahead than a camera can have counted in this time [s].

    By one within the memory for duplicates nothing is lost, and frames that waited come at once.
    """
    return ahead >= _DUPLICATE_WINDOW and ahead > MAX_FPS * elapsed_s


_score = attrgetter("score")


class SessionBuilder:
    """Collects CameraInfo, RigInfo and Observation messages, in any order and with duplicates.

    A restarted camera has a new clock: each boot is stored separately, and the one with the most detections is used.
    window_s: total duration of what is kept; None = all. Of a longer recording the intervals with the most motion that
    two cameras saw are kept, and always the newest: a target at rest adds no information.
    """

    def __init__(self, window_s: float | None = None) -> None:
        self._chunks = None if window_s is None else max(3, round(window_s / CHUNK_S))
        self._motion: dict[int, dict[str, float]] = {}
        self._chunk = 0
        self._cameras: dict[str, pb.CameraInfo] = {}
        self._rig: pb.RigInfo | None = None
        self._rig_cameras: dict[str, tuple[pb.CameraInfo, RigCamera]] = {}
        self._boots: dict[str, dict[str, _BootBuffer]] = {}
        self._settled: dict[str, int] = {}
        self._labels: dict[str, int] = {}
        self._labels_of: dict[str, dict[str, int]] = {}
        self._since: dict[tuple[str, str], int] = {}
        self._is_thinned = False
        self._selection: dict[str, list[tuple[str, int, int, int]]] | None = None
        self.counters: Counter[str] = Counter()
        self.repeated: dict[str, tuple[int, int, int]] = {}
        """By camera, frames with detections left out as duplicates since the last one that was none; the highest number
        received, and how much later [ns] than that frame the last one of them is."""

    def handle(self, message: Message, moment: float = 0.0) -> None:
        """Take one message; other kinds are ignored. moment: of its arrival [s], any fixed clock."""
        if isinstance(message, pb.Observation):
            self._observe(message, moment)
        elif isinstance(message, pb.CameraInfo):
            self._cameras[message.camera] = message
            with suppress(InputError, ValueError):  # `build` says what is wrong with it
                self._rig_camera(message)
        elif isinstance(message, pb.RigInfo):
            self._rig = message

    def shared_motions_s(self) -> dict[str, float]:
        """Duration of the kept intervals [s] in which a camera and another one saw motion, where there are any."""
        out: Counter[str] = Counter()
        for moved in self._motion.values():
            moving = [camera for camera, motion in moved.items() if motion > _MOVING]
            out.update(moving if len(moving) > 1 else ())
        return {camera: CHUNK_S * count for camera, count in out.items()}

    def forget(self, camera: str) -> None:
        """Forget a camera and its detections, as if it had never been heard of."""
        for of_camera in (self._cameras, self._rig_cameras, self._boots, self._labels_of, self.repeated):
            of_camera.pop(camera, None)

    def forget_before(self, camera: str, time: float) -> None:
        """Do not use a camera's detections before a time on its clock [s]: it was moved then."""
        self._since[camera, self.boot(camera)] = round(time * NANOSECONDS)

    @property
    def film_s(self) -> float:
        """Duration of the kept intervals [s]."""
        return CHUNK_S * len(self._motion)

    def rows(self, camera: str) -> int:
        """Detections held of a camera, over all its boots."""
        return sum(len(boot) for boot in self._boots.get(camera, {}).values())

    @property
    def cameras(self) -> list[str]:
        """Cameras of which a message was received, sorted by name."""
        return sorted({*self._cameras, *self._boots})

    def boot(self, camera: str) -> str:
        """The boot id whose clock and detections the session uses.

        With a moving window, the newest boot with enough detections: otherwise an older one would be used too long.
        """
        boots = self._boots.get(camera, {})
        if self._chunks is not None:
            for boot in reversed(boots):
                if len(boots[boot]) >= self._settled.get(boot, MIN_ROWS_AFTER_RESTART):
                    return boot
        return max(sorted(boots), key=lambda boot: len(boots[boot]), default="")

    def require_rows(self, boot: str, rows: int) -> None:
        """Use a boot only once it has so many detections; until then the boot before it is used."""
        self._settled[boot] = rows

    def warnings(self, run_of: Callable[[str], str] = str) -> tuple[str, ...]:
        """What was omitted of other runs of cameras. run_of: the run that a boot id, as of a clock's segment, is of."""
        warnings = []
        for camera in sorted(self._boots):
            kept = self.boot(camera)
            lost = sum(len(boot) for name, boot in self._boots[camera].items() if run_of(name) != run_of(kept))
            if lost:
                warnings.append(
                    f"{camera} was restarted, which begins a new clock: {lost} detections of other boots left out"
                )
        return tuple(warnings)

    def build(self, newest_s: float = math.inf) -> tuple[Rig, Observations]:
        """The session so far, or of what arrived last. Raises Refused where there is no camera or no detection."""
        if not self._cameras:
            raise Refused("no camera has introduced itself yet" if not self._boots else "no camera published its info")
        order = sorted(self._cameras)
        parts = [self._used(camera, self._chunk - newest_s / CHUNK_S) for camera in order]
        names = [camera for camera, (rows, used) in zip(order, parts, strict=True) if len(used)]
        if not names:
            raise Refused("no camera has seen anything yet")
        taken = [(rows, used) for rows, used in parts if len(used)]
        table = np.concatenate([rows[used] for rows, used in taken])
        labels = sorted(self._labels)
        place = {label: number for number, label in enumerate(labels)}
        rank = np.array([place[label] for label in self._labels], dtype=np.int64)
        observations = gather_columns(
            names,
            labels,
            np.repeat(np.arange(len(names)), [len(used) for _, used in taken]),
            rank[table["label"]],
            np.ascontiguousarray(table["frame"]),
            table["time_ns"] / NANOSECONDS,
            np.column_stack([table["u"], table["v"]]),
            np.where(table["size"] > 0, table["size"], np.nan),
            stds=np.where(table["std"] > 0, table["std"], np.nan),
            frames_may_repeat=True,
        )
        return self._build_rig(order), observations

    def ranges(self) -> list[tuple[str, str, int, int, int]]:
        """Which detections `build` uses: camera, boot id, first and last sequence number of a run, detections in it.

        A run ends where an interval was dropped.
        """
        out = []
        for camera in sorted(self._cameras):
            rows, used = self._used(camera)
            if not len(used):
                continue
            chunk, sequence = rows["chunk"][used], rows["sequence"][used]
            ends = np.flatnonzero([(one + 1 not in self._motion) for one in np.unique(chunk)])
            last = np.unique(chunk)[ends]
            run = np.searchsorted(last, chunk)
            for index in np.unique(run):
                inside = sequence[run == index]
                out.append((camera, self.boot(camera), int(inside.min()), int(inside.max()), len(inside)))
        return out

    def select(self, ranges: Iterable[tuple[str, str, int, int, int]]) -> None:
        """Let `build` use exactly these detections, as `ranges` gave them."""
        self._selection = {}
        for camera, boot, first, last, count in ranges:
            self._selection.setdefault(camera, []).append((boot, first, last, count))

    def _used(self, camera: str, after: float = -math.inf) -> tuple[Any, Ints]:
        """A camera's rows, and the indices of those that are used: one a time and label, of intervals ``after`` one."""
        boots = self._boots.get(camera)
        nothing = np.zeros(0, dtype=_ROW), np.zeros(0, dtype=np.int64)
        if not boots:
            return nothing
        if self._selection is not None:
            runs = [run for run in self._selection.get(camera, []) if run[0] in boots]
            if not runs:
                return nothing
            rows = boots[runs[0][0]].table()
            sequence, kept = rows["sequence"], rows["frame"] % self._every(camera) == 0
            inside = np.zeros(len(sequence), dtype=np.bool_)
            for _, begin, end, count in runs:
                run = (sequence >= begin) & (sequence <= end)
                thinned = run & kept
                inside |= thinned if abs(thinned.sum() - count) < abs(run.sum() - count) else run
            return rows, self._one_a_time(rows, np.flatnonzero(inside))
        rows = boots[self.boot(camera)].table()
        since = self._since.get((camera, self.boot(camera)), -(2**63))
        used = np.flatnonzero((rows["time_ns"] >= since) & (rows["chunk"] > after))
        return rows, self._one_a_time(rows, used)

    @staticmethod
    def _one_a_time(rows: Any, used: Ints) -> Ints:
        """Of two rows of one time and label the first: a camera's fault that must not cost the others their answer."""
        time, label = rows["time_ns"][used], rows["label"][used]
        order = np.lexsort((used, time, label))
        repeated = (np.diff(time[order]) == 0) & (np.diff(label[order]) == 0)
        return np.sort(used[order[np.concatenate([[True], ~repeated])]]) if len(used) else used

    def _observe(self, message: pb.Observation, moment: float) -> None:
        camera, sequence = message.camera, message.sequence
        boots = self._boots.get(camera)
        if boots is None:
            boots, self._labels_of[camera] = self._boots.setdefault(camera, {}), {}
        boot = boots.get(message.boot_id)
        if boot is None:
            self._forget_a_boot(camera)
            boot = boots[message.boot_id] = _BootBuffer()
        time_ns, is_live = message.device_time_ns, self._chunks is not None
        if boot.is_recent_duplicate(sequence, time_ns, moment) if is_live else boot.is_duplicate(sequence):
            self.counters["duplicates"] += 1
            if message.detections:
                frames = self.repeated.get(camera, (0, 0, 0))[0] + 1
                self.repeated[camera] = frames, boot.highest, time_ns - boot.highest_at[0]
            return
        self.repeated.pop(camera, None)
        chunk = self._advance(moment)
        if self._is_thinned and message.frame % self._every(camera):
            self.counters["thinned"] += 1
            return
        detections = list(message.detections)
        if self._chunks is not None:
            room = boot.room[1] if boot.room[0] == chunk else _MAX_CHUNK_ROWS
            boot.room = chunk, room - len(detections)
            if boot.room[1] < 0:
                self.counters["flooded"] += 1
                return
        # One row per label and frame: of several detections the one of the highest score is used.
        if len(detections) > 1:
            detections.sort(key=_score, reverse=True)
        rows, stamps = boot.rows, (message.device_time_ns, message.frame, sequence, chunk)
        labels, known_labels = set[int](), self._labels_of[camera]
        moved = self._motion.get(chunk)
        for detection in detections:
            label = detection.label or DEFAULT_LABEL
            index = known_labels.get(label)
            if index is None and (index := self._introduced(camera, label)) is None:
                self.counters["too_many_labels"] += 1
                continue
            if index in labels:
                self.counters["second_detections"] += 1
                continue
            labels.add(index)
            at = detection.u, detection.v
            std, covariance = 0.0, detection.covariance
            if covariance:  # of one coordinate [px]
                std = math.sqrt(max(0.5 * (covariance[0] + covariance[2]), 0.0))
            rows += _pack_row(*stamps, index, *at, detection.size, std)
            if moved is not None:
                step = min(math.dist(at, boot.last.get(index, at)), _MAX_STEP_PX)
                boot.last[index] = at
                moved[camera] = moved.get(camera, 0.0) + step

    def _introduced(self, camera: str, label: str) -> int | None:
        """The index of a camera's new label; None where it has too many."""
        own = self._labels_of[camera]
        if len(own) >= _MAX_LABELS:
            return None
        own[label] = self._labels.setdefault(label, len(self._labels))
        return own[label]

    def _advance(self, moment: float) -> int:
        """The chunk of a moment; a new one may replace the one with the least motion."""
        if self._chunks is None:
            return 0
        chunk = max(int(moment // CHUNK_S), self._chunk)
        if chunk > self._chunk or not self._motion:
            self._chunk = chunk
            self._motion[chunk] = {}
            if len(self._motion) > self._chunks:
                newest = sorted(self._motion)
                oldest = [number for number in newest if number < chunk - _MAX_AGE * self._chunks]
                candidates = oldest or newest[: -self._chunks // 3]
                dropped = min(candidates, key=lambda number: (_shared(self._motion[number]), number))
                del self._motion[dropped]
                for boots in self._boots.values():
                    for boot in boots.values():
                        kept = boot.table()["chunk"] != dropped
                        if not kept.all():
                            boot.take(kept)
            self._drop_excess()
        return chunk

    def _drop_excess(self) -> None:
        """Where all cameras together have too many rows, those with the most give up their oldest."""
        held = {camera: self.rows(camera) for camera in self._boots}
        if sum(held.values()) > _MAX_ROWS and self.film_s < LONG_FILM_S and not self._is_thinned:
            self._is_thinned = True
            for camera, boots in self._boots.items():
                for boot in boots.values():
                    boot.take(boot.table()["frame"] % self._every(camera) == 0)
                held[camera] = self.rows(camera)
        excess = sum(held.values()) - _MAX_ROWS
        while excess > 0:
            camera = max(held, key=lambda name: held[name])
            boot = max(self._boots[camera].values(), key=lambda one: len(one))
            drop = min(excess, max(len(boot) // 2, 1))
            boot.take(np.arange(drop, len(boot)))
            held[camera] -= drop
            excess -= drop
            self.counters["excess_rows"] += drop

    def _every(self, camera: str) -> int:
        """Which frames are kept of a camera of which not all are: each so manieth."""
        info = self._cameras.get(camera)
        return 1 if info is None else max(round(info.fps / _THINNED_HZ), 1)

    def _forget_a_boot(self, camera: str) -> None:
        """Forget the run with the fewest rows of a camera that restarts again and again, but not the one in use."""
        boots = self._boots[camera]
        if self._chunks is None or len(boots) < _MAX_BOOTS:
            return
        used = self.boot(camera)
        least = min((name for name in boots if name != used), key=lambda name: len(boots[name]))
        del boots[least]
        self._settled.pop(least, None)
        self._since.pop((camera, least), None)

    def _rig_camera(self, info: pb.CameraInfo) -> RigCamera:
        """The camera of an info, made when it arrives: of a thousand, one round of a hub would take 0.1 s longer."""
        known = self._rig_cameras.get(info.camera)
        if known is None or known[0] != info:
            known = self._rig_cameras[info.camera] = info, rig_camera_from_info(info)
        return known[1]

    def _build_rig(self, order: list[str]) -> Rig:
        info = self._rig
        cameras = {name: self._rig_camera(self._cameras[name]) for name in order}
        sought = {self._cameras[name].target for name in order}
        metadata: dict[str, Any] = {"target": min(sought)} if len(sought) == 1 and any(sought) else {}
        if info is None:
            return Rig(cameras, metadata=metadata)
        inside = [d for d in info.distances if d.camera_a in cameras and d.camera_b in cameras]
        up: Floats | str | None = None
        if info.up_camera in cameras:
            up = info.up_camera
        elif len(info.up) == 3:
            up = np.array(info.up) / np.linalg.norm(info.up)
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


def _shared(motion: dict[str, float]) -> float:
    """Motion [px] that more than one camera saw."""
    return sum(motion.values()) - max(motion.values(), default=0.0)


def rig_camera_from_info(info: pb.CameraInfo) -> RigCamera:
    """The rig's entry of a camera, from the CameraInfo that the camera published."""
    longest = longest_readout(info.fps)  # a configuration's may be longer than a rig.toml may say
    return RigCamera(
        name=info.camera,
        size=(info.width, info.height),
        fps=info.fps,
        intrinsics=Intrinsics.of_message(info),
        position=_vector(info.position),
        rotation=None if len(info.rotation) != 3 else so3.exp(np.array(info.rotation)),
        position_std=_vector(info.position_std),
        rotation_std=_vector(info.rotation_std),
        focal_std=info.focal_std,
        readout=min(max(info.readout_s, -longest), longest) or None,
        table={"name": info.camera, "size": [info.width, info.height], "fps": info.fps},
    )


def _vector(values: Any) -> Floats | None:
    return np.array(values, dtype=np.float64) if len(values) == 3 else None
