"""Attitude and position from telemetry, and the unknown constant offset between its clock and the camera's.

telemetry time = camera time + offset. Each sample's attitude is compared with the one seen in the pictures at every
candidate offset; the spread of the difference tells how likely that offset is. A constant bias doesn't matter.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from edge.uav.tracker import Telemetry
from protocols.geometry import so3
from protocols.geometry.types import Floats

REACH_S = 0.6
"""Largest offset [s]: half a second, and a little lateness of the samples themselves."""
_STEP_S = 0.02
_PRIOR_STD_S = 0.3
_LONGEST_GAP_S = 2.5  # between two samples that are still interpolated
_FORGET = 0.995  # of the evidence, a sample
_NOISE_RAD = np.deg2rad(0.4)
_APART_S = 0.06  # samples closer than this are of one piece
_DRIFT_S = 1.5
_MEMORY = 400


class TelemetryClock:
    """Samples in order, queried in camera time. Bad samples are left out and counted."""

    def __init__(self, body_from_camera: Floats) -> None:
        self._camera_from_body = np.asarray(body_from_camera, dtype=np.float64).T
        self._times: deque[float] = deque(maxlen=_MEMORY)
        self._rotations: deque[Floats] = deque(maxlen=_MEMORY)
        self._positions: deque[Floats | None] = deque(maxlen=_MEMORY)
        self._waiting: deque[tuple[float, Floats]] = deque(maxlen=_MEMORY)
        self._seen_times: deque[float] = deque(maxlen=_MEMORY)
        self._seen: deque[Floats] = deque(maxlen=_MEMORY)
        self._grid = np.arange(-REACH_S, REACH_S + _STEP_S / 2, _STEP_S)
        self._count = 0.0
        self._cost = np.zeros(len(self._grid))
        self._mean: Floats | None = None
        self._compared = 0.0
        self.offset = 0.0
        self.offset_std = _PRIOR_STD_S
        self.rejected = 0

    def add(self, sample: Telemetry) -> None:
        """Take one sample; NaN, no rotation or a time that does not increase is counted in ``rejected``."""
        rotation = np.asarray(sample.ned_from_body, dtype=np.float64)
        good = np.isfinite(sample.time) and rotation.shape == (3, 3) and bool(np.isfinite(rotation).all())
        if good:
            good = bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 0.05)
        if good and self._times and sample.time <= self._times[-1]:
            good = False
        if not good:
            self.rejected += 1
            return
        position = None if sample.position is None else np.asarray(sample.position, dtype=np.float64)
        if position is not None and not np.isfinite(position).all():
            position = None
        camera_from_ned = self._camera_from_body @ rotation.T
        self._times.append(float(sample.time))
        self._rotations.append(camera_from_ned)
        self._positions.append(position)
        self._waiting.append((float(sample.time), camera_from_ned))

    @property
    def rate_hz(self) -> float:
        """Samples a second over those held; 0 with fewer than two."""
        if len(self._times) < 2:
            return 0.0
        return (len(self._times) - 1) / max(self._times[-1] - self._times[0], 1e-6)

    def rotation_at(self, time: float, ahead: float = 0.12) -> Floats | None:
        """Rotation (3, 3) camera from NED at a camera time; None where no samples are near.

        ahead: how far beyond the newest sample it is continued at constant turn rate [s].
        """
        at = self._bracket(time + self.offset, ahead)
        if at is None:
            return None
        index, share = at
        first, second = self._rotations[index], self._rotations[index + 1]
        return np.asarray(so3.exp(share * so3.log(second @ first.T)) @ first)

    def position_at(self, time: float, ahead: float = 0.25) -> Floats | None:
        """Position (3,) NED [m] at a camera time; None where no samples are near."""
        at = self._bracket(time + self.offset, ahead)
        if at is None:
            return None
        index, share = at
        first, second = self._positions[index], self._positions[index + 1]
        if first is None or second is None:
            return None
        return np.asarray(first + share * (second - first))

    def nearest(self, time: float, within: float) -> tuple[Floats, Floats | None] | None:
        """Rotation and position of the sample nearest to a camera time, or interpolated; None if none is near."""
        rotation = self.rotation_at(time, ahead=within)
        if rotation is not None:
            return rotation, self.position_at(time, ahead=within)
        if not self._times:
            return None
        gaps = np.abs(np.array(self._times) - (time + self.offset))
        index = int(np.argmin(gaps))
        if gaps[index] > within:
            return None
        return self._rotations[index], self._positions[index]

    def saw(self, time: float, rotation: Floats) -> None:
        """Take the attitude (3, 3) camera from NED that the pictures gave for a camera time."""
        self._seen_times.append(time)
        self._seen.append(rotation)
        while self._waiting and self._waiting[0][0] + REACH_S <= time:
            self._compare(*self._waiting.popleft())

    def forget_seen(self) -> None:
        """The pictures' attitudes began anew: what was compared says nothing of the new ones."""
        self._seen_times.clear()
        self._seen.clear()
        self._mean = None

    def _bracket(self, moment: float, ahead: float) -> tuple[int, float] | None:
        if len(self._times) < 2:
            return None
        times = np.array(self._times)
        if moment < times[0] - ahead or moment > times[-1] + ahead:
            return None
        index = int(np.clip(np.searchsorted(times, moment) - 1, 0, len(times) - 2))
        gap = times[index + 1] - times[index]
        if gap > _LONGEST_GAP_S:
            return None
        return index, float((moment - times[index]) / gap)

    def _compare(self, sampled: float, rotation: Floats) -> None:
        """Add one sample's evidence for every candidate offset."""
        soon = self._mean is not None and sampled - self._compared < _APART_S
        if len(self._seen_times) < 2 or soon:
            return
        times = np.array(self._seen_times)
        moments = sampled - self._grid
        if moments.min() < times[0] or moments.max() > times[-1]:
            return
        first = int(np.searchsorted(times, moments.min())) - 1
        seen = np.array([self._seen[i] for i in range(max(first, 0), len(times))])
        times = times[max(first, 0) :]
        index = np.clip(np.searchsorted(times, moments) - 1, 0, len(times) - 2)
        share = (moments - times[index]) / (times[index + 1] - times[index])
        between = seen[index] + share[:, None, None] * (seen[index + 1] - seen[index])
        m = np.einsum("ij,nkj->nik", rotation, between)
        difference = 0.5 * np.column_stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]])
        # Against its own recent mean: what the pictures drift within many seconds is not an offset.
        if self._mean is None:
            self._mean, self._compared = difference, sampled
            return
        share = 1.0 - np.exp(-(sampled - self._compared) / _DRIFT_S)
        change = difference - self._mean
        self._mean, self._compared = self._mean + share * change, sampled
        self._count = _FORGET * self._count + 1.0
        self._cost = _FORGET * self._cost + (1.0 - 0.5 * share) * np.square(change).sum(axis=1)
        if self._count < 4.0:
            return
        spread = self._cost
        noise = max(_NOISE_RAD, float(np.sqrt(spread.min() / (3.0 * self._count))))
        score = -0.5 * spread / noise**2 - 0.5 * np.square(self._grid / _PRIOR_STD_S)
        weight = np.exp(score - score.max())
        weight /= weight.sum()
        self.offset = float(weight @ self._grid)
        self.offset_std = float(np.sqrt(weight @ np.square(self._grid - self.offset)) + 0.3 * _STEP_S)
