"""Labelled points for people-based calibration, from unlabelled detections of people.

Detections of each camera are linked from frame to frame into tracklets. The tracklets of all cameras are then clustered
by clothing colour into people. This needs neither synchronised clocks nor camera poses. People whose colours are
ambiguous are left out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from protocols.core.clocks import NANOSECONDS, CameraTime, TimeMap
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import Observations, gather_tracks

PERSON = "person"
SEVERAL_SHARE = 0.1
"""Of false rows beside one person's, beyond which there are several. As many as that may be among one's own, in frames
in which it is missed, and with 10 % outliers pair synchronisation found the lag in every run (``python -m
tests.bench.pair_timing``)."""
END_STD = {"head": 0.012, "foot": 0.045}
"""Std of the ends of a person's silhouette over its size: of one walker in five rendered rooms 0.009 to 0.014 of the
head, and 0.04 to 0.05 of the foot, which swings with the gait."""
MIN_INTERVAL_NS = 90_000_000
"""Of the frames that are used without colours, at least: with half as many, paths that turn bias clocks by 20 ms."""
_MAX_GAP_S = 0.6
"""A tracklet without a detection for longer than this ends."""
_MAX_STEP = 0.45
"""Largest displacement of a point between two frames 0.1 s apart, as a fraction of the size."""
_COLOUR_GATE = 60.0  # root mean square of the channels: as much as other people's colours differ
TOUCHING_DISTANCE = 0.45
"""Silhouettes nearer than this fraction of the size may be confused: both tracklets end there."""
_MAX_SIZE_RATIO = 1.12
"""Largest ratio of a size to its recent mean; beyond, the sample is skipped."""
_MIN_SAMPLES = 8  # of a tracklet: fewer give no mean colour to tell people by
_CLUSTER_RADIUS = 38.0
"""Largest difference of the mean colours of tracklets of one person (root mean square of the channels)."""
_MIN_COLOUR_GATE = 10.0  # at least, around a person's colour: samples of plain clothes hardly spread
_MIN_COMMON_S = 6.0
"""People seen by two cameras for a shorter time are not used."""


class _TrackletSample(NamedTuple):
    """time_ns: on the camera's clock. size: of the person [px]. head, foot, colour: None where not measured."""

    time_ns: int
    frame: int
    size: float
    head: tuple[float, float] | None
    foot: tuple[float, float] | None
    colour: tuple[int, int, int] | None


@dataclass(slots=True, eq=False)
class _Tracklet:
    """rows: samples in order of time. colour: sum over the ``colour_count`` samples that have one."""

    rows: deque[_TrackletSample] = field(default_factory=deque)
    position: Floats = field(default_factory=lambda: np.zeros(2))
    velocity: Floats = field(default_factory=lambda: np.zeros(2))
    size: float = 0.0
    last_ns: int = 0
    colour: Floats = field(default_factory=lambda: np.zeros(3))
    colour_count: int = 0

    @property
    def mean_colour(self) -> Floats:
        return self.colour / self.colour_count if self.colour_count else np.full(3, np.nan)


@dataclass(slots=True, eq=False)
class _CameraTracklets:
    boot_id: str
    live: list[_Tracklet] = field(default_factory=list)
    ended: deque[_Tracklet] = field(default_factory=deque)
    last_ns: int = -(2**63)
    rows: int = 0

    def all(self) -> list[_Tracklet]:
        return [*self.ended, *self.live]


class PeopleTracklets:
    """Collects tracklets of people by camera and labels them across cameras. window_s: how much of the past is kept."""

    def __init__(self, window_s: float = 60.0) -> None:
        self._window_ns = round(window_s * NANOSECONDS)
        self._cameras: dict[str, _CameraTracklets] = {}

    def handle(self, message: pb.Observation) -> None:
        """Add one frame; out-of-order frames are ignored. After a restart a camera's tracklets are dropped."""
        camera = self._cameras.get(message.camera)
        people = [d for d in message.detections if d.kind == PERSON]
        if camera is None or camera.boot_id != message.boot_id:
            if not people:
                return
            camera = self._cameras[message.camera] = _CameraTracklets(message.boot_id)
        now = message.device_time_ns
        if now <= camera.last_ns:
            return
        camera.last_ns = now
        self._link(camera, people, now, message.frame)
        while camera.ended and camera.ended[0].last_ns < now - self._window_ns:
            camera.ended.popleft()
        for tracklet in camera.live:
            while tracklet.rows and tracklet.rows[0].time_ns < now - self._window_ns:
                tracklet.rows.popleft()

    def forget(self, camera: str) -> None:
        """Forget a camera's tracklets."""
        self._cameras.pop(camera, None)

    def seconds(self, camera: str) -> float:
        """Total duration of the present tracklets of a camera [s]."""
        held = self._cameras.get(camera)
        if held is None:
            return 0.0
        return sum((t.rows[-1].time_ns - t.rows[0].time_ns) / NANOSECONDS for t in held.all() if t.rows)

    def shared_seconds(self, clocks: Mapping[str, TimeMap]) -> dict[str, float]:
        """By camera, the duration of its tracklets [s] while another of them sees somebody, by the given clocks."""
        spans = {
            name: [
                (
                    clock.reference_from_camera(CameraTime(t.rows[0].time_ns / NANOSECONDS)),
                    clock.reference_from_camera(CameraTime(t.rows[-1].time_ns / NANOSECONDS)),
                )
                for t in self._cameras[name].all()
                if t.rows
            ]
            for name, clock in clocks.items()
            if name in self._cameras
        }
        shared = dict.fromkeys(clocks, 0.0)
        for name, own in spans.items():
            seen: list[list[float]] = []
            for first, last in sorted(span for other, theirs in spans.items() if other != name for span in theirs):
                if seen and first <= seen[-1][1]:
                    seen[-1][1] = max(seen[-1][1], last)
                else:
                    seen.append([first, last])
            shared[name] = sum(
                max(min(last, end) - max(first, begin), 0.0) for begin, end in own for first, last in seen
            )
        return shared

    @property
    def cameras(self) -> list[str]:
        """Cameras that have detected people."""
        return sorted(self._cameras)

    def boot(self, camera: str) -> str:
        """The boot id of the clock that the observations refer to."""
        return self._cameras[camera].boot_id if camera in self._cameras else ""

    def observations(self, most: int = 4) -> Observations:
        """Head tops and foot points of the ``most`` longest seen people, under one label in all cameras.

        Labels are walker1-head, walker1-foot, … A camera's rows are those of its present boot id.
        """
        tracklets = [
            (name, tracklet)
            for name in sorted(self._cameras)
            for tracklet in self._cameras[name].all()
            if len(tracklet.rows) >= _MIN_SAMPLES and tracklet.colour_count >= _MIN_SAMPLES // 2
        ]
        groups = [group for group in cluster_by_colour(tracklets) if _common_seconds(tracklets, group) >= _MIN_COMMON_S]
        groups.sort(key=lambda group: -_common_seconds(tracklets, group))
        colour_models = [_colour_model(tracklets, group) for group in groups]
        names, labels, frames, times, pixels, stds = [], [], [], [], [], []
        for number, group in enumerate(groups[:most]):
            for index in group:
                camera, tracklet = tracklets[index]
                for row in tracklet.rows:
                    # A tracklet may have switched to another person: the colour of each row must match.
                    if row.colour is not None and not _matches_colour(row.colour, colour_models, number):
                        continue
                    for end, name in ((row.head, "head"), (row.foot, "foot")):
                        if end is not None:
                            names.append(camera)
                            labels.append(f"walker{number + 1}-{name}")
                            frames.append(row.frame)
                            times.append(row.time_ns / NANOSECONDS)
                            pixels.append(end)
                            stds.append(END_STD[name] * row.size)
        return gather_tracks(
            names,
            labels,
            np.array(frames, dtype=np.int64),
            np.array(times, dtype=np.float64),
            np.array(pixels, dtype=np.float64).reshape(-1, 2),
            np.full(len(names), np.nan),
            stds=np.array(stds, dtype=np.float64),
            order=sorted(self._cameras),
        )

    def _link(self, camera: _CameraTracklets, people: list[pb.Detection], now: int, frame: int) -> None:
        ended = [t for t in camera.live if now - t.last_ns > _MAX_GAP_S * NANOSECONDS]
        live = [t for t in camera.live if now - t.last_ns <= _MAX_GAP_S * NANOSECONDS]
        positions = np.array([(d.u, d.v) for d in people]).reshape(-1, 2)
        sizes = np.array([_size(d) for d in people])
        if len(people) > 1:
            apart = np.linalg.norm(positions[:, None] - positions[None], axis=2) + 1e9 * np.eye(len(people))
            touching = (apart < TOUCHING_DISTANCE * np.maximum(sizes[:, None], sizes[None])).any(axis=1)
        else:
            touching = np.zeros(len(people), dtype=np.bool_)
        matched: set[int] = set()
        if live and people:
            cost = np.full((len(live), len(people)), np.inf)
            for i, tracklet in enumerate(live):
                elapsed = (now - tracklet.last_ns) / NANOSECONDS
                ahead = tracklet.position + elapsed * tracklet.velocity
                far = np.linalg.norm(positions - ahead, axis=1) / max(tracklet.size, 1.0)
                reach = _MAX_STEP * min(max(elapsed / 0.1, 0.5), 3.0)
                colour_distance = np.array([_colour_distance(tracklet.mean_colour, d) for d in people])
                good = (far < reach) & (colour_distance < _COLOUR_GATE)
                cost[i] = np.where(good, far / reach + colour_distance / _COLOUR_GATE, np.inf)
            rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e3))
            for i, j in zip(rows.tolist(), columns.tolist(), strict=True):
                if np.isfinite(cost[i, j]) and not touching[j]:
                    _extend(live[i], people[j], now, frame)
                    matched.add(j)
                elif np.isfinite(cost[i, j]):
                    ended.append(live[i])  # after an occlusion the identity is uncertain: start a new tracklet
                    matched.add(j)
        camera.live = [t for t in live if all(t is not e for e in ended)]
        camera.ended.extend(t for t in ended if len(t.rows) >= _MIN_SAMPLES)
        for j, detection in enumerate(people):
            if j not in matched and not touching[j]:
                tracklet = _Tracklet(position=positions[j], last_ns=now)
                _extend(tracklet, detection, now, frame)
                camera.live.append(tracklet)


def cluster_by_colour(tracklets: list[tuple[str, _Tracklet]]) -> list[list[int]]:
    """Cluster tracklets into people by mean colour: average linkage, nearest first. Returns indices by person.

    Two concurrent tracklets of one camera are two people. Clusters that are too close to another are ambiguous and are
    left out.
    """
    groups = [[index] for index in range(len(tracklets))]
    if not groups:
        return []
    colour = np.array([tracklet.mean_colour for _, tracklet in tracklets])
    weight = np.array([float(len(tracklet.rows)) for _, tracklet in tracklets])
    apart = _concurrent(tracklets)
    means, masses = colour.copy(), weight.copy()
    distance = np.sqrt(((means[:, None] - means[None]) ** 2).mean(axis=2))
    distance[apart] = np.inf
    np.fill_diagonal(distance, np.inf)
    alive = np.ones(len(groups), dtype=np.bool_)
    while alive.sum() > 1:
        i, j = divmod(int(np.argmin(distance)), len(distance))
        if not distance[i, j] < _CLUSTER_RADIUS:
            break
        groups[i] = groups[i] + groups[j]
        means[i] = (masses[i] * means[i] + masses[j] * means[j]) / (masses[i] + masses[j])
        masses[i] += masses[j]
        alive[j] = False
        apart[i] |= apart[j]
        apart[:, i] |= apart[:, j]
        row = np.sqrt(((means - means[i]) ** 2).mean(axis=1))
        row = np.where(alive & ~apart[i], row, np.inf)
        row[i] = np.inf
        distance[i], distance[:, i] = row, row
        distance[j], distance[:, j] = np.inf, np.inf
    left = np.flatnonzero(alive)
    strong = [k for k in left.tolist() if masses[k] >= 0.1 * masses[left].max()]
    clear = []
    for one in strong:
        others = [float(np.sqrt(((means[one] - means[k]) ** 2).mean())) for k in strong if k != one]
        if not others or min(others) > 0.75 * _CLUSTER_RADIUS:
            clear.append(groups[one])
    return clear


def _concurrent(tracklets: list[tuple[str, _Tracklet]]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which pairs of tracklets (n, n) cannot be one person: both are in one frame of one camera.

    That one begins before another ends is no proof: where a detection jumps, two tracklets may share it by turns.
    """
    numbers: dict[str, list[int]] = {}
    for index, (name, _) in enumerate(tracklets):
        numbers.setdefault(name, []).append(index)
    out = np.zeros((len(tracklets), len(tracklets)), dtype=np.bool_)
    for mine in numbers.values():
        times, frame = np.unique([row.time_ns for k in mine for row in tracklets[k][1].rows], return_inverse=True)
        seen = np.zeros((len(mine), len(times)), dtype=np.float32)
        seen[np.repeat(np.arange(len(mine)), [len(tracklets[k][1].rows) for k in mine]), frame] = 1.0
        out[np.ix_(mine, mine)] = seen @ seen.T > 0.0
    np.fill_diagonal(out, False)
    return out


def _common_seconds(tracklets: list[tuple[str, _Tracklet]], group: list[int]) -> float:
    """Duration of a person in the camera that sees it second longest [s]."""
    total: dict[str, float] = {}
    for index in group:
        camera, tracklet = tracklets[index]
        total[camera] = total.get(camera, 0.0) + (tracklet.rows[-1].time_ns - tracklet.rows[0].time_ns) / NANOSECONDS
    return sorted(total.values())[-2] if len(total) > 1 else 0.0


def _colour_model(tracklets: list[tuple[str, _Tracklet]], group: list[int]) -> tuple[Floats, float]:
    """Median colour (3,) of a group's samples, and the 68 % quantile of their root-mean-square distance from it."""
    colours = np.array([row.colour for index in group for row in tracklets[index][1].rows if row.colour is not None])
    middle = np.median(colours, axis=0)
    off = np.sqrt(((colours - middle) ** 2).mean(axis=1))
    return middle, float(np.quantile(off, 0.68))


def _matches_colour(colour: tuple[int, int, int], colour_models: list[tuple[Floats, float]], number: int) -> bool:
    off = [float(np.sqrt(np.mean((np.array(colour) - middle) ** 2))) for middle, _ in colour_models]
    return off[number] < max(2.5 * colour_models[number][1], _MIN_COLOUR_GATE) and off[number] <= min(off)


def _extend(tracklet: _Tracklet, detection: pb.Detection, now: int, frame: int) -> None:
    position = np.array([detection.u, detection.v])
    elapsed = (now - tracklet.last_ns) / NANOSECONDS
    if elapsed > 0.0:
        tracklet.velocity = 0.5 * tracklet.velocity + 0.5 * (position - tracklet.position) / elapsed
    tracklet.position, tracklet.last_ns = position, now
    size = _size(detection)
    is_jump = tracklet.size > 0.0 and not 1.0 / _MAX_SIZE_RATIO < size / tracklet.size < _MAX_SIZE_RATIO
    tracklet.size = size if tracklet.size == 0.0 else 0.8 * tracklet.size + 0.2 * size
    if is_jump:
        return  # two merged people, or a truncated one
    if detection.HasField("colour"):
        tracklet.colour = tracklet.colour + [detection.colour.red, detection.colour.green, detection.colour.blue]
        tracklet.colour_count += 1
    head = (detection.head[0], detection.head[1]) if len(detection.head) == 2 else None
    foot = (detection.foot[0], detection.foot[1]) if len(detection.foot) == 2 else None
    c = detection.colour
    colour = (c.red, c.green, c.blue) if detection.HasField("colour") else None
    tracklet.rows.append(_TrackletSample(now, frame, tracklet.size, head, foot, colour))


def _size(detection: pb.Detection) -> float:
    if detection.size > 0.0:
        return float(detection.size)
    return float(detection.box[3]) if len(detection.box) == 4 else 40.0


def _colour_distance(colour: Floats, detection: pb.Detection) -> float:
    if not detection.HasField("colour") or np.isnan(colour).any():
        return 0.25 * _COLOUR_GATE
    seen = np.array([detection.colour.red, detection.colour.green, detection.colour.blue], dtype=np.float64)
    return float(np.sqrt(np.mean((seen - colour) ** 2)))
