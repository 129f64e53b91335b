"""Clock priors from times of arrival: a camera's frame cannot arrive before it was taken, and seldom much later.

The smallest of (arrival - camera time) over some seconds is the offset of the hub's clock from the camera's plus the
smallest delay of the link. It bounds lags to a few tenths of a second, no better: delays of cameras differ. Where the
smallest delays of successive seconds differ much (a backlog, a recording played as fast as it goes), there is no prior.
"""

from __future__ import annotations

from hub.clocks.external_prior import ExternalClockPrior

_INTERVAL_S = 2.0  # s: holds a frame with the smallest delay
_INTERVALS = 15  # half a minute
_MIN_INTERVALS = 3  # complete ones, whose spread is tested
_MAX_SPREAD_S = 0.1
"""Largest difference of the intervals' smallest delays."""
ERROR_BOUND_S = 0.15
"""Of one camera's offset: its smallest delay is 0 to 0.3 s."""


class ArrivalPriors:
    """The smallest delays of each camera's clock over the last half minute."""

    def __init__(self) -> None:
        self._least: dict[str, tuple[str, dict[int, float]]] = {}

    def handle(self, camera: str, boot_id: str, camera_time: float, arrival: float) -> None:
        """Add one frame: its time on the camera's clock and its arrival on the hub's [s]."""
        known = self._least.get(camera)
        if known is None or known[0] != boot_id:
            known = self._least[camera] = boot_id, {}
        least, interval, delay = known[1], int(arrival // _INTERVAL_S), arrival - camera_time
        before = least.get(interval)
        if before is None or delay < before:
            least[interval] = delay
            if len(least) > _INTERVALS:
                del least[min(least)]

    def priors(self) -> dict[str, ExternalClockPrior]:
        """By camera, the hub's clock in place of Unix time."""
        out = {}
        for camera, (boot_id, least) in self._least.items():
            complete = [least[interval] for interval in sorted(least)[:-1]]
            if len(complete) >= _MIN_INTERVALS and max(complete) - min(complete) <= _MAX_SPREAD_S:
                out[camera] = ExternalClockPrior(boot_id, min(complete), ERROR_BOUND_S)
        return out
