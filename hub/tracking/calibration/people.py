"""Labelled points for calibration from people, whom nobody has labelled.

Each camera links what it sees from frame to frame into tracklets; clothes then tell which tracklets, of one camera
or of several, are one person. Nothing of clocks or places is needed for it. Who cannot be told from another by the
clothes is left out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import Observations, gather_tracks

PERSON = "person"
_GAP_S = 0.6
"""A tracklet that is not seen for longer has ended."""
_REACH = 0.45
"""Farthest step of a point between two frames 0.1 s apart, in sizes, at most."""
_COLOUR_REACH = 60.0
_TOUCH = 0.45
"""Silhouettes nearer than that many sizes may be taken for each other: both tracklets end there."""
_SIZE_JUMP = 1.12
"""Largest change of a size from what it was lately."""
_LEAST_ROWS = 8
_SAME_COLOUR = 38.0
"""Mean colours of one person differ by less between tracklets (root mean square of the channels)."""
_LEAST_SHADE = 10.0
_LEAST_SECONDS = 6.0
"""A walker that two cameras see for less time tells little."""


class _Row(NamedTuple):
    """time_ns: on the camera's clock. head, foot, colour: None where not told."""

    time_ns: int
    frame: int
    head: tuple[float, float] | None
    foot: tuple[float, float] | None
    colour: tuple[int, int, int] | None


@dataclass(slots=True, eq=False)
class _Tracklet:
    """rows: what was seen, in order of time. Colour sums of what told one."""

    rows: deque[_Row] = field(default_factory=deque)
    place: Floats = field(default_factory=lambda: np.zeros(2))
    velocity: Floats = field(default_factory=lambda: np.zeros(2))
    size: float = 0.0
    last_ns: int = 0
    colour: Floats = field(default_factory=lambda: np.zeros(3))
    told: int = 0

    @property
    def mean_colour(self) -> Floats:
        return self.colour / self.told if self.told else np.full(3, np.nan)


@dataclass(slots=True, eq=False)
class _Camera:
    boot: str
    live: list[_Tracklet] = field(default_factory=list)
    ended: deque[_Tracklet] = field(default_factory=deque)
    last_ns: int = -(2**63)
    rows: int = 0

    def all(self) -> list[_Tracklet]:
        return [*self.ended, *self.live]


class Walkers:
    """Gathers people from observations and names them. window_s: how much of the past is kept."""

    def __init__(self, window_s: float = 60.0) -> None:
        self._window_ns = round(window_s * NANOSECONDS)
        self._cameras: dict[str, _Camera] = {}

    def handle(self, message: pb.Observation) -> None:
        """Take one frame; frames of a camera come in order, others are left out. A restarted camera begins anew."""
        camera = self._cameras.get(message.camera)
        people = [d for d in message.detections if d.kind == PERSON]
        if camera is None or camera.boot != message.boot_id:
            if not people:
                return
            camera = self._cameras[message.camera] = _Camera(message.boot_id)
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

    def seconds(self, camera: str) -> float:
        """How long the present tracklets of a camera last together [s]."""
        held = self._cameras.get(camera)
        if held is None:
            return 0.0
        return sum((t.rows[-1].time_ns - t.rows[0].time_ns) / NANOSECONDS for t in held.all() if t.rows)

    @property
    def cameras(self) -> list[str]:
        """Cameras that have seen people."""
        return sorted(self._cameras)

    def boot(self, camera: str) -> str:
        """The boot whose clock the observations speak of."""
        return self._cameras[camera].boot if camera in self._cameras else ""

    def observations(self, most: int = 4) -> Observations:
        """Head tops and foot points of the ``most`` best seen walkers, under one name in all cameras.

        Labels are walker1-head, walker1-foot, … A camera's rows are those of its present boot.
        """
        tracklets = [
            (name, tracklet)
            for name in sorted(self._cameras)
            for tracklet in self._cameras[name].all()
            if len(tracklet.rows) >= _LEAST_ROWS and tracklet.told >= _LEAST_ROWS // 2
        ]
        groups = [group for group in grouped(tracklets) if _common_seconds(tracklets, group) >= _LEAST_SECONDS]
        groups.sort(key=lambda group: -_common_seconds(tracklets, group))
        shades = [_shades(tracklets, group) for group in groups]
        names, labels, frames, times, pixels = [], [], [], [], []
        for number, group in enumerate(groups[:most]):
            for index in group:
                camera, tracklet = tracklets[index]
                for row in tracklet.rows:
                    # A tracklet may have gone over to a neighbour: each row's own colour must be this walker's.
                    if row.colour is not None and not _belongs(row.colour, shades, number):
                        continue
                    for end, name in ((row.head, "head"), (row.foot, "foot")):
                        if end is not None:
                            names.append(camera)
                            labels.append(f"walker{number + 1}-{name}")
                            frames.append(row.frame)
                            times.append(row.time_ns / NANOSECONDS)
                            pixels.append(end)
        return gather_tracks(
            names,
            labels,
            np.array(frames, dtype=np.int64),
            np.array(times, dtype=np.float64),
            np.array(pixels, dtype=np.float64).reshape(-1, 2),
            np.full(len(names), np.nan),
            order=sorted(self._cameras),
        )

    def _link(self, camera: _Camera, people: list[pb.Detection], now: int, frame: int) -> None:
        ended = [t for t in camera.live if now - t.last_ns > _GAP_S * NANOSECONDS]
        live = [t for t in camera.live if now - t.last_ns <= _GAP_S * NANOSECONDS]
        places = np.array([(d.u, d.v) for d in people]).reshape(-1, 2)
        sizes = np.array([_size(d) for d in people])
        if len(people) > 1:
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(len(people))
            touching = (apart < _TOUCH * np.maximum(sizes[:, None], sizes[None])).any(axis=1)
        else:
            touching = np.zeros(len(people), dtype=np.bool_)
        matched: set[int] = set()
        if live and people:
            cost = np.full((len(live), len(people)), np.inf)
            for i, tracklet in enumerate(live):
                elapsed = (now - tracklet.last_ns) / NANOSECONDS
                ahead = tracklet.place + elapsed * tracklet.velocity
                far = np.linalg.norm(places - ahead, axis=1) / max(tracklet.size, 1.0)
                reach = _REACH * min(max(elapsed / 0.1, 0.5), 3.0)
                shade = np.array([_shade(tracklet.mean_colour, d) for d in people])
                good = (far < reach) & (shade < _COLOUR_REACH)
                cost[i] = np.where(good, far / reach + shade / _COLOUR_REACH, np.inf)
            rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e3))
            for i, j in zip(rows.tolist(), columns.tolist(), strict=True):
                if np.isfinite(cost[i, j]) and not touching[j]:
                    _extend(live[i], people[j], now, frame)
                    matched.add(j)
                elif np.isfinite(cost[i, j]):
                    ended.append(live[i])  # whoever comes out of the crowd is somebody new
                    matched.add(j)
        camera.live = [t for t in live if all(t is not e for e in ended)]
        camera.ended.extend(t for t in ended if len(t.rows) >= _LEAST_ROWS)
        for j, detection in enumerate(people):
            if j not in matched and not touching[j]:
                tracklet = _Tracklet(place=places[j], last_ns=now)
                _extend(tracklet, detection, now, frame)
                camera.live.append(tracklet)


def grouped(tracklets: list[tuple[str, _Tracklet]]) -> list[list[int]]:
    """Indices of tracklets that are one person each, by clothes: average linkage, nearest first.

    Two tracklets of one camera at one time are two people. Groups that come nearer to each other than to themselves
    are told by nothing, and are left out.
    """
    groups = [[index] for index in range(len(tracklets))]
    if not groups:
        return []
    colour = np.array([tracklet.mean_colour for _, tracklet in tracklets])
    weight = np.array([float(len(tracklet.rows)) for _, tracklet in tracklets])
    apart = _apart(tracklets)
    means, masses = colour.copy(), weight.copy()
    distance = np.sqrt(((means[:, None] - means[None]) ** 2).mean(axis=2))
    distance[apart] = np.inf
    np.fill_diagonal(distance, np.inf)
    alive = np.ones(len(groups), dtype=np.bool_)
    while alive.sum() > 1:
        i, j = divmod(int(np.argmin(distance)), len(distance))
        if not distance[i, j] < _SAME_COLOUR:
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
        if not others or min(others) > 0.75 * _SAME_COLOUR:
            clear.append(groups[one])
    return clear


def _apart(tracklets: list[tuple[str, _Tracklet]]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which tracklets (n, n) cannot be one person: one camera saw both at a time."""
    camera = np.array([name for name, _ in tracklets])
    begin = np.array([tracklet.rows[0].time_ns for _, tracklet in tracklets])
    end = np.array([tracklet.rows[-1].time_ns for _, tracklet in tracklets])
    out = (camera[:, None] == camera[None]) & (begin[:, None] <= end[None]) & (begin[None] <= end[:, None])
    np.fill_diagonal(out, False)
    return np.asarray(out)


def _common_seconds(tracklets: list[tuple[str, _Tracklet]], group: list[int]) -> float:
    """How long the camera that sees a person second longest sees it [s]."""
    total: dict[str, float] = {}
    for index in group:
        camera, tracklet = tracklets[index]
        total[camera] = total.get(camera, 0.0) + (tracklet.rows[-1].time_ns - tracklet.rows[0].time_ns) / NANOSECONDS
    return sorted(total.values())[-2] if len(total) > 1 else 0.0


def _shades(tracklets: list[tuple[str, _Tracklet]], group: list[int]) -> tuple[Floats, float]:
    """Median colour (3,) of a group's rows and how far, as root mean square, they are from it: the 68 % quantile."""
    told = np.array([row.colour for index in group for row in tracklets[index][1].rows if row.colour is not None])
    middle = np.median(told, axis=0)
    off = np.sqrt(((told - middle) ** 2).mean(axis=1))
    return middle, float(np.quantile(off, 0.68))


def _belongs(colour: tuple[int, int, int], shades: list[tuple[Floats, float]], number: int) -> bool:
    off = [float(np.sqrt(np.mean((np.array(colour) - middle) ** 2))) for middle, _ in shades]
    return off[number] < max(2.5 * shades[number][1], _LEAST_SHADE) and off[number] <= min(off)


def _extend(tracklet: _Tracklet, detection: pb.Detection, now: int, frame: int) -> None:
    place = np.array([detection.u, detection.v])
    elapsed = (now - tracklet.last_ns) / NANOSECONDS
    if elapsed > 0.0:
        tracklet.velocity = 0.5 * tracklet.velocity + 0.5 * (place - tracklet.place) / elapsed
    tracklet.place, tracklet.last_ns = place, now
    size = _size(detection)
    odd = tracklet.size > 0.0 and not 1.0 / _SIZE_JUMP < size / tracklet.size < _SIZE_JUMP
    tracklet.size = size if tracklet.size == 0.0 else 0.8 * tracklet.size + 0.2 * size
    if odd:
        return  # two in one silhouette, or half of one
    if detection.HasField("colour"):
        tracklet.colour = tracklet.colour + [detection.colour.red, detection.colour.green, detection.colour.blue]
        tracklet.told += 1
    head = (detection.head[0], detection.head[1]) if len(detection.head) == 2 else None
    foot = (detection.foot[0], detection.foot[1]) if len(detection.foot) == 2 else None
    c = detection.colour
    colour = (c.red, c.green, c.blue) if detection.HasField("colour") else None
    tracklet.rows.append(_Row(now, frame, head, foot, colour))


def _size(detection: pb.Detection) -> float:
    if detection.size > 0.0:
        return float(detection.size)
    return float(detection.box[3]) if len(detection.box) == 4 else 40.0


def _shade(colour: Floats, detection: pb.Detection) -> float:
    if not detection.HasField("colour") or np.isnan(colour).any():
        return 0.25 * _COLOUR_REACH
    seen = np.array([detection.colour.red, detection.colour.green, detection.colour.blue], dtype=np.float64)
    return float(np.sqrt(np.mean((seen - colour) ** 2)))
