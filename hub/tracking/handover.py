"""Which of a site's hubs publishes a track: the one that has the camera nearest to it, and others' tracks go on there.

Both hubs at a border track what is there, since each hears the cameras across it. A hub publishes a target until
another one publishes it, so that there is no gap; labels of markers are the site's own, and targets without one take
over the label of the neighbour's track that they are found in (chi² gate of both covariances, Bar-Shalom).
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats
from protocols.messages import syncline_pb2 as pb

_FRESH_S = 0.5
"""A track of another hub counts for so long: ten publications, as long as its estimates may wait for late cameras."""
_GATE = 16.27  # chi², 3 degrees of freedom, 0.1 %
_MOST = 1024  # tracks of others, and labels of its own, that are remembered


class TrackHandover:
    """The tracks of one hub among those of others. now: any monotonic clock [s]."""

    def __init__(self, hub: str) -> None:
        self._hub = hub
        self._centres: Floats = np.zeros((0, 3))
        self._is_own: Bools = np.zeros(0, np.bool_)
        self._others: dict[str, tuple[float, pb.Track]] = {}
        self._labels: dict[str, str] = {}

    def place(self, centres: Mapping[str, Floats], own: frozenset[str]) -> None:
        """Where all cameras of the site are, and which of them this hub has in its group."""
        self._centres = np.array(list(centres.values())).reshape(-1, 3)
        self._is_own = np.array([name in own for name in centres], np.bool_)

    def hear(self, track: pb.Track, now: float) -> None:
        """A track that another hub has published."""
        self._others.pop(track.label, None)
        if track.state != "lost":
            self._others[track.label] = now, track
            if len(self._others) > _MOST:
                del self._others[next(iter(self._others))]

    def own(self, track: pb.Track, now: float) -> pb.Track | None:
        """The track as it is published, None where another hub publishes it."""
        is_here = not len(self._centres) or bool(
            self._is_own[np.argmin(np.linalg.norm(self._centres - np.array(track.position), axis=1))]
        )
        label = track.label
        if re.fullmatch(rf"{re.escape(track.kind)}-\d+", label):
            known = self._labels.get(label)
            if known is None and not is_here:
                return None  # not met before: its own hub has it
            label = known or self._found_in(track, now) or f"{self._hub}-{label}"
            self._labels[track.label] = label
            if track.state == "lost":
                del self._labels[track.label]
            elif len(self._labels) > _MOST:
                del self._labels[next(iter(self._labels))]
        elsewhere = label in self._others and now - self._others[label][0] < _FRESH_S
        if elsewhere and (not is_here or track.state == "lost"):
            return None
        if label == track.label:
            return track
        renamed = pb.Track()
        renamed.CopyFrom(track)
        renamed.label = label
        return renamed

    def _found_in(self, track: pb.Track, now: float) -> str | None:
        """The label of another hub's track that this is, the nearest by its covariance."""
        best, found = _GATE, None
        for label, (heard, other) in self._others.items():
            if other.kind != track.kind or now - heard >= _FRESH_S or label in self._labels.values():
                continue
            ahead = (track.reference_time_ns - other.reference_time_ns) / NANOSECONDS
            off = np.array(track.position) - np.array(other.position)
            spread = np.zeros((3, 3))
            for one, seconds in ((track, 0.0), (other, ahead)):
                if one.position_covariance:
                    spread += np.array(one.position_covariance).reshape(3, 3)
                if one.velocity_covariance:
                    spread += seconds**2 * np.array(one.velocity_covariance).reshape(3, 3)
            if other.velocity:
                off = off - ahead * np.array(other.velocity)
            distance = float(off @ np.linalg.pinv(spread, hermitian=True) @ off)
            if distance < best:
                best, found = distance, label
        return found
