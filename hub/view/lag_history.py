"""How a camera's published lag and residual have changed: what the lag chart shows. Bounded in memory."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from protocols.messages import syncline_pb2 as pb

LAG_WINDOW_S = 300.0
"""Samples older than this are not shown [s]."""
_MAX_SAMPLES = 600  # two a second over the window


def lag_of(found: pb.CameraCalibration) -> float:
    """Reference time less camera time [s], at the camera time that the std holds for."""
    return (found.clock_rate - 1.0) * found.lag_time_s + found.time_offset


class LagSample(NamedTuple):
    """One published calibration of a camera. at: the view's time [s]. lag: reference time less camera time, at the
    camera time that the std holds for, less the first published lag [s]."""

    at: float
    lag: float
    std: float
    rms_px: float


class LagHistory:
    """The published lags of one camera; they start again when its clock or the reference clock is another one.

    first: the lag [s] that the samples are differences to.
    """

    def __init__(self) -> None:
        self.samples: deque[LagSample] = deque(maxlen=_MAX_SAMPLES)
        self.first = 0.0
        self._clocks: tuple[str, ...] = ()

    def add(self, found: pb.CameraCalibration, clocks: tuple[str, ...], now: float) -> None:
        """Add a new revision. clocks: what the lag is between, such as boot ids."""
        lag = lag_of(found)
        if clocks != self._clocks:
            self.samples.clear()
            self._clocks, self.first = clocks, lag
        self.samples.append(LagSample(now, lag - self.first, found.time_offset_std, found.rms_px))

    def recent(self, now: float) -> list[LagSample]:
        """The samples of the shown window."""
        return [sample for sample in self.samples if sample.at > now - LAG_WINDOW_S]
