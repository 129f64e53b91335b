"""Interpolated attitude and position from telemetry, with an online estimate of its constant clock offset.

telemetry time = camera time + offset. Each sample's attitude is compared with the visually estimated one at every
candidate offset; the variance of the difference gives the likelihood of the offset. A constant bias cancels.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np

from edge.uav.base import Telemetry
from edge.uav.navigation import position_std
from protocols.geometry import so3
from protocols.geometry.types import Floats

MAX_OFFSET_S = 0.6
"""Largest offset [s]: half a second, plus some delay of the samples themselves."""
_STEP_S = 0.02  # between the offsets that are compared; their weighted mean is finer
PRIOR_STD_S = 0.3
"""Std of the offset [s] before anything is known of it: half of MAX_OFFSET_S."""
_MAX_GAP_S = 2.5  # between two samples for interpolation
_CONFIRMING_SAMPLES = 3  # one alone is an error, not a clock
_FORGETTING_FACTOR = 0.995  # of the cost, per sample
_NOISE_RAD = np.deg2rad(0.4)
_MIN_SPACING_S = 0.06  # samples closer than this are not independent
_MEAN_TIME_CONSTANT_S = 1.5  # of the mean difference: the visual attitude drifts more slowly, and turns are shorter
_TURN_STD_RAD_S2 = 0.2
"""Angular acceleration of a vehicle between two attitudes. Of those left out of a recorded plane's, 1 s apart, it
explains 0.10, of a simulated flight's 0.07, of a multirotor that sways by 3 degrees at 0.4 Hz 0.2."""
_BUFFER = 400  # samples: 4 s at 100 Hz, above the longest gap and MAX_OFFSET_S together


class TelemetryTrack:
    """Telemetry samples in order, queried by camera time. Invalid samples are rejected and counted.

    longest_gap_s: between two samples for interpolation.
    """

    def __init__(self, body_from_camera: Floats, longest_gap_s: float = _MAX_GAP_S) -> None:
        self._longest_gap_s = longest_gap_s
        self._camera_from_body = np.asarray(body_from_camera, dtype=np.float64).T
        self._times: deque[float] = deque(maxlen=_BUFFER)
        self._rotations: deque[Floats] = deque(maxlen=_BUFFER)
        self._positions: deque[Floats | None] = deque(maxlen=_BUFFER)
        self._position_stds: deque[float] = deque(maxlen=_BUFFER)
        self._pending: deque[tuple[float, Floats]] = deque(maxlen=_BUFFER)
        self._visual_times: deque[float] = deque(maxlen=_BUFFER)
        self._visual: deque[Floats] = deque(maxlen=_BUFFER)
        self._offsets = np.arange(-MAX_OFFSET_S, MAX_OFFSET_S + _STEP_S / 2, _STEP_S)
        self._weight_sum = 0.0
        self._cost = np.zeros(len(self._offsets))
        self._mean: Floats | None = None
        self._last_update = 0.0
        self.offset = 0.0
        self.offset_std = PRIOR_STD_S
        self._set_back = 0
        self.rejected = 0

    def add(self, sample: Telemetry) -> None:
        """Add one sample; NaN, no rotation matrix or a time that does not increase is counted in ``rejected``.

        Three in a row that go back by more than the longest gap are a clock that was set back, and begin a new series.
        """
        rotation = np.asarray(sample.ned_from_body, dtype=np.float64)
        valid = np.isfinite(sample.time) and rotation.shape == (3, 3) and bool(np.isfinite(rotation).all())
        if valid:
            valid = bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 0.05)
        if valid and self._times and sample.time <= self._times[-1]:
            self._set_back = self._set_back + 1 if sample.time < self._times[-1] - _MAX_GAP_S else 0
            valid = self._set_back >= _CONFIRMING_SAMPLES
            if valid:
                for samples in (self._times, self._rotations, self._positions, self._position_stds, self._pending):
                    samples.clear()
        if not valid:
            self.rejected += 1
            return
        position = None if sample.position is None else np.asarray(sample.position, dtype=np.float64)
        if position is not None and not np.isfinite(position).all():
            position = None
        self._set_back = 0
        camera_from_ned = self._camera_from_body @ rotation.T
        self._times.append(float(sample.time))
        self._rotations.append(camera_from_ned)
        self._positions.append(position)
        self._position_stds.append(sample.position_std)
        self._pending.append((float(sample.time), camera_from_ned))

    @property
    def rate_hz(self) -> float:
        """Sample rate over the samples held [Hz]; 0 with fewer than two."""
        if len(self._times) < 2:
            return 0.0
        return (len(self._times) - 1) / max(self._times[-1] - self._times[0], 1e-6)

    def rotation_at(self, time: float, extrapolation: float = 0.12) -> Floats | None:
        """Rotation (3, 3) camera from NED at a camera time; None where no samples are near.

        extrapolation: how far beyond the newest sample it is continued at constant angular rate [s].
        """
        bracket = self._bracket(time + self.offset, extrapolation)
        if bracket is None:
            return None
        index, fraction = bracket
        first, second = self._rotations[index], self._rotations[index + 1]
        return np.asarray(so3.exp(fraction * so3.log(second @ first.T)) @ first)

    def position_at(self, time: float, extrapolation: float = 0.25) -> Floats | None:
        """Position (3,) NED [m] at a camera time; None where no samples are near."""
        bracket = self._bracket(time + self.offset, extrapolation)
        if bracket is None:
            return None
        index, fraction = bracket
        first, second = self._positions[index], self._positions[index + 1]
        if first is None or second is None:
            return None
        return np.asarray(first + fraction * (second - first))

    def stds_at(self, time: float) -> tuple[float, float]:
        """Stds of position [m], one coordinate, and attitude [rad] at a camera time, between the samples around it or
        beyond the last one; 0 with fewer than two."""
        if len(self._times) < 2:
            return 0.0, 0.0
        index, between = self._around(time + self.offset)
        since = min(abs(between), _MAX_GAP_S)
        until = min(abs(self._times[index + 1] - self._times[index] - between), _MAX_GAP_S)
        reported = max(self._position_stds[index], self._position_stds[index + 1])
        return float(np.hypot(reported, position_std(since, until))), 0.5 * _TURN_STD_RAD_S2 * since * until

    def nearest_time(self, time: float) -> float:
        """A camera time that has samples around it, else that of the nearest sample; that time without samples."""
        if len(self._times) < 2:
            return self._times[0] - self.offset if self._times else time
        index, between = self._around(time + self.offset)
        gap = self._times[index + 1] - self._times[index]
        if gap <= _MAX_GAP_S and 0.0 <= between <= gap:
            return time
        return self._times[index + (between > 0.5 * gap)] - self.offset

    def nearest(self, time: float, within: float) -> tuple[Floats, Floats | None] | None:
        """Rotation and position interpolated at a camera time, or of the nearest sample; None if none is within [s]."""
        rotation = self.rotation_at(time, extrapolation=within)
        if rotation is not None:
            return rotation, self.position_at(time, extrapolation=within)
        if not self._times:
            return None
        gaps = np.abs(np.array(self._times) - (time + self.offset))
        index = int(np.argmin(gaps))
        if gaps[index] > within:
            return None
        return self._rotations[index], self._positions[index]

    def add_visual_attitude(self, time: float, rotation: Floats) -> None:
        """Add the attitude (3, 3) camera from NED that was estimated from the image of a camera time."""
        self._visual_times.append(time)
        self._visual.append(rotation)
        while self._pending and self._pending[0][0] + MAX_OFFSET_S <= time:
            self._update_offset(*self._pending.popleft())

    def reset_visual_attitudes(self) -> None:
        """Discard the visual attitudes, whose frame has changed."""
        self._visual_times.clear()
        self._visual.clear()
        self._mean = None

    def _bracket(self, telemetry_time: float, extrapolation: float) -> tuple[int, float] | None:
        if len(self._times) < 2:
            return None
        times = self._times
        if telemetry_time < times[0] - extrapolation or telemetry_time > times[-1] + extrapolation:
            return None
        index, between = self._around(telemetry_time)
        gap = times[index + 1] - times[index]
        if gap > self._longest_gap_s:
            return None
        return index, between / gap

    def _around(self, telemetry_time: float) -> tuple[int, float]:
        """Index of the first of the two samples around a time, or next to it, and the time since it [s]."""
        index = min(max(bisect_left(self._times, telemetry_time) - 1, 0), len(self._times) - 2)
        return index, telemetry_time - self._times[index]

    def _update_offset(self, sample_time: float, rotation: Floats) -> None:
        """Add the cost of one sample at every candidate offset and update the estimate."""
        too_soon = self._mean is not None and sample_time - self._last_update < _MIN_SPACING_S
        if len(self._visual_times) < 2 or too_soon:
            return
        times = np.array(self._visual_times)
        camera_times = sample_time - self._offsets  # descending
        if camera_times[-1] < times[0] or camera_times[0] > times[-1]:
            return
        first = int(np.searchsorted(times, camera_times[-1])) - 1
        visual = np.array([self._visual[i] for i in range(max(first, 0), len(times))])
        times = times[max(first, 0) :]
        index = np.clip(np.searchsorted(times, camera_times) - 1, 0, len(times) - 2)
        fraction = (camera_times - times[index]) / (times[index + 1] - times[index])
        interpolated = visual[index] + fraction[:, None, None] * (visual[index + 1] - visual[index])
        m = rotation @ interpolated.transpose(0, 2, 1)
        difference = 0.5 * np.column_stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]])
        # Relative to its recent mean: slow drift of the visual attitude is not caused by a clock offset.
        if self._mean is None:
            self._mean, self._last_update = difference, sample_time
            return
        fraction = 1.0 - np.exp(-(sample_time - self._last_update) / _MEAN_TIME_CONSTANT_S)
        change = difference - self._mean
        self._mean, self._last_update = self._mean + fraction * change, sample_time
        self._weight_sum = _FORGETTING_FACTOR * self._weight_sum + 1.0
        self._cost = _FORGETTING_FACTOR * self._cost + (1.0 - 0.5 * fraction) * np.square(change).sum(axis=1)
        if self._weight_sum < 4.0:
            return
        spread = self._cost
        noise = max(_NOISE_RAD, float(np.sqrt(spread.min() / (3.0 * self._weight_sum))))
        score = -0.5 * spread / noise**2 - 0.5 * np.square(self._offsets / PRIOR_STD_S)
        weight = np.exp(score - score.max())
        weight /= weight.sum()
        self.offset = float(weight @ self._offsets)
        self.offset_std = float(np.sqrt(weight @ np.square(self._offsets - self.offset)) + 0.3 * _STEP_S)
