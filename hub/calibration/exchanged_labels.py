"""Labels that one camera's detector exchanges for a time, as a pose network does with left and right.

With poses and clocks known, a row fits another camera's rows of its label where their rays lie in one epipolar plane.
Where two labels do so only if they are exchanged, one of the two cameras has them exchanged; the others say which.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import CameraCalibration
from protocols.session.observations import Observations, Track

_FRAMES = 300  # of a pair of cameras, in which labels to look at are found
_LEAST_SHARE = 0.01  # of the frames of two labels: fewer are rejected as false detections, and no path follows them
_FITS = 3.0  # stds within which two rays meet; with thrice as many they do not
_COLUMNS = ("frame", "time", "pixels", "size")
_WITHIN_S = 0.2  # between two rows of the other camera, as everywhere where a camera is said to see a point


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """A label's rows in one camera: camera and reference times (n,) [s], directions in the world (n, 3)."""

    stamps: Floats
    time: Floats
    direction: Floats

    def at(self, times: Floats) -> Floats:
        """Directions (m, 3) at rising reference times (m,); NaN where the camera does not see it."""
        after = np.clip(np.searchsorted(self.time, times), 1, len(self.time) - 1)
        inside = (times >= self.time[0]) & (times <= self.time[-1])
        near = inside & (self.time[after] - self.time[after - 1] <= _WITHIN_S)
        found = np.column_stack([np.interp(times, self.time, axis) for axis in self.direction.T])
        return np.where(near[:, None], found, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Exchange:
    """Two labels of one camera that are exchanged in some frames.

    times: camera times (n,) [s] of frames that tell, ascending. exchanged: (n,) whether they are. other: the camera
    that may have them exchanged instead, where no third one tells: then the rows are left out; "" = none.
    """

    camera: str
    labels: tuple[str, str]
    times: Floats
    exchanged: Bools
    other: str = ""

    def at(self, times: Floats) -> tuple[Bools, Bools]:
        """Whether the labels are exchanged in rows with camera times (n,), and whether that is uncertain."""
        before = self.exchanged[np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)]
        after = self.exchanged[np.minimum(np.searchsorted(self.times, times), len(self.times) - 1)]
        return before & after, before != after

    @property
    def warning(self) -> str:
        """One sentence for a person."""
        a, b = self.labels
        shown = self.times[self.exchanged]
        where = f"exchanged in {len(shown)} of {len(self.times)} frames that tell, {shown[0]:.1f} to {shown[-1]:.1f} s"
        if self.other:
            return f"{self.camera} or {self.other}: {a} and {b} are {where}: left out of {self.camera}"
        return f"{self.camera}: {a} and {b} are {where}: each was taken for the other"


class _Views:
    """The rays of all labels in all cameras, and within which sines they meet, by two cameras."""

    def __init__(self, cameras: Mapping[str, CameraCalibration], observations: Observations) -> None:
        self.cameras = cameras
        self.rays = {name: _rays(camera, observations) for name, camera in cameras.items()}
        self.tolerance: dict[tuple[str, str], float] = {}

    def common(self, name: str, labels: tuple[str, ...]) -> tuple[Floats, list[Ints]]:
        """Camera times (n,) of frames with one of the labels, and of each label its rows in them, -1 where none."""
        mine = [self.rays[name][label].stamps for label in labels]
        times = np.unique(np.concatenate(mine))
        rows = [np.full(len(times), -1) for _ in labels]
        for row, stamps in zip(rows, mine, strict=True):
            row[np.searchsorted(times, stamps)] = np.arange(len(stamps))
        return times, rows

    def off_plane(self, a: str, b: str, labels: tuple[str, ...], rows: list[Ints]) -> Floats:
        """Sines (n, labels, labels) of the angles between a's rays of one label, in n frames, and the epipolar planes
        of b's rays of another one; NaN where either does not see it."""
        mine, others = self.rays[a], self.rays[b]
        parts = list(zip(labels, rows, strict=True))
        rays = np.stack([np.where(row[:, None] >= 0, mine[x].direction[row], np.nan) for x, row in parts])
        time = np.max([np.where(row >= 0, mine[x].time[row], -np.inf) for x, row in parts], axis=0)
        baseline = self.cameras[b].pose.position - self.cameras[a].pose.position
        planes = np.cross(baseline, np.stack([others[x].at(time) for x in labels]))
        planes /= np.maximum(np.linalg.norm(planes, axis=2, keepdims=True), 1e-300)
        return np.asarray(np.abs(np.einsum("inx,jnx->nij", rays, planes)))

    def candidates(self) -> list[tuple[str, str]]:
        """The pairs of labels that two cameras seem to have exchanged in some frames."""
        found: dict[tuple[str, str], None] = {}
        for a, b in combinations(self.cameras, 2):
            labels = tuple(label for label in self.rays[a] if label in self.rays[b])
            if len(labels) < 2:
                continue
            times, rows = self.common(a, labels)
            some = np.unique(np.linspace(0, len(times) - 1, _FRAMES).astype(np.int64))
            rows = [row[some] for row in rows]
            own = np.column_stack(
                [self.off_plane(a, b, (x,), [row])[:, 0, 0] for x, row in zip(labels, rows, strict=True)]
            )
            # Of the quarter of the rows that fit best, by a normal distribution: most labels may be exchanged.
            seen = own[np.isfinite(own)]
            self.tolerance[a, b] = tolerance = _FITS * float(np.quantile(seen, 0.25)) / 0.3186 if len(seen) else 0.0
            self.tolerance[b, a] = tolerance
            least = _LEAST_SHARE * len(some)
            suspicious = np.flatnonzero((own > _FITS * tolerance).sum(axis=0) >= least).tolist()
            for i, j in combinations(suspicious, 2):
                both = self.off_plane(a, b, (labels[i], labels[j]), [rows[i], rows[j]])
                wrong, _ = _verdicts(both, tolerance)
                if wrong.sum() >= least:
                    found[labels[i], labels[j]] = None
        return list(found)

    def largest(self, labels: tuple[str, str]) -> Exchange | None:
        """The exchange of two labels in the camera that has it in most frames; None where no camera has enough."""
        names = [name for name, mine in self.rays.items() if all(label in mine for label in labels)]
        found = [one for a in names if (one := self._exchange(a, names, labels)) is not None]
        return max(found, key=lambda one: (not one.other, int(one.exchanged.sum())), default=None)

    def _exchange(self, a: str, names: list[str], labels: tuple[str, str]) -> Exchange | None:
        times, rows = self.common(a, labels)
        votes, voters = np.zeros(len(times), dtype=np.int64), np.zeros(len(times), dtype=np.int64)
        against: dict[str, int] = {}
        for b in names:
            if (a, b) in self.tolerance:
                wrong, right = _verdicts(self.off_plane(a, b, labels, rows), self.tolerance[a, b])
                votes += wrong.astype(np.int64) - right
                voters += wrong | right
                against[b] = int(wrong.sum())
        for shown in ((votes != 0) & (voters > 1), votes != 0):
            exchanged = votes[shown] > 0
            if exchanged.sum() > _LEAST_SHARE * len(times):
                other = "" if voters[shown].min() > 1 else max(against, key=lambda name: against[name])
                return Exchange(a, labels, times[shown], exchanged, other)
        return None


def exchanged_back(
    cameras: Mapping[str, CameraCalibration], observations: Observations
) -> tuple[Observations, tuple[str, ...]]:
    """The observations with the labels that cameras exchange put right, and a sentence for each two of them."""
    views = _Views(cameras, observations)
    warnings: list[str] = []
    for labels in views.candidates():
        for _ in cameras:
            found = views.largest(labels)
            if found is None:
                break
            warnings.append(found.warning)
            observations = _put_right(observations, found)
            views.rays[found.camera] = _rays(cameras[found.camera], observations)
    return observations, tuple(warnings)


def _rays(camera: CameraCalibration, observations: Observations) -> dict[str, _Rays]:
    """A camera's rays by label."""
    out = {}
    for track in observations.of_camera(camera.name):
        if len(track) < 2:
            continue
        lens, clock = camera.intrinsics, camera.time_map
        time = track.time + camera.readout * lens.row_offset(track.pixels)
        if not (np.diff(time) > 0.0).all():  # a false detection low in a rolling shutter's picture
            time = track.time
        rays = np.column_stack([lens.unproject(track.pixels), np.ones(len(track))]) @ camera.pose.rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        out[track.label] = _Rays(track.time, clock.clock_rate * time + clock.time_offset, rays)
    return out


def _verdicts(off: Floats, tolerance: float) -> tuple[Bools, Bools]:
    """Of sines (n, 2, 2): where the rows of two labels fit only if exchanged, and where only as they are."""
    own = np.maximum(off[:, 0, 0], off[:, 1, 1])
    other = np.maximum(off[:, 0, 1], off[:, 1, 0])
    apart = _FITS * tolerance
    return (other < tolerance) & (own > apart), (own < tolerance) & (other > apart)


def _put_right(observations: Observations, found: Exchange) -> Observations:
    """The observations with an exchange undone, or without its rows where it may be another camera's."""
    keys = [(found.camera, label) for label in found.labels]
    a, b = (observations.tracks[key] for key in keys)
    (moved_a, unsure_a), (moved_b, unsure_b) = found.at(a.time), found.at(b.time)
    left = [a.select(~(moved_a | unsure_a)), b.select(~(moved_b | unsure_b))]
    if not found.other:
        left = [_joined(left[0], b.select(moved_b)), _joined(left[1], a.select(moved_a))]
    tracks = observations.tracks | dict(zip(keys, left, strict=True))
    return replace(observations, tracks={key: track for key, track in tracks.items() if len(track)})


def _joined(track: Track, other: Track) -> Track:
    """A track with the rows of another one."""
    order = np.argsort(np.concatenate([track.time, other.time]), kind="stable")

    def both(a: Any, b: Any) -> Any:
        return np.concatenate([a, b])[order]

    std = None
    if track.std is not None or other.std is not None:
        std = both(*(np.full(len(one), np.nan) if one.std is None else one.std for one in (track, other)))
    frame, time, pixels, size = (both(getattr(track, one), getattr(other, one)) for one in _COLUMNS)
    return replace(track, frame=frame, time=time, pixels=pixels, size=size, std=std)
