"""Clock priors: external ones (NTP, PTP), checked against the calibration and used only where images are ambiguous.

A time service gives the offset of a camera's clock from Unix time, t_unix = t_camera + m, and a bound of its error.
Two such cameras have a known lag, which the calibration estimates independently from the images. Where both differ by
more than their uncertainties, a clock is wrong or a camera's time stamps are late; the image-based estimate is kept.
Only where the images leave several lags (periodic motion) does the prior select one of them
(`hub.calibration.pairs.pair_network`).

Without such a service times of arrival give a prior: a camera's frame cannot arrive before it was taken, and seldom
much later. The smallest of (arrival - camera time) over some seconds is the offset of the hub's clock from the camera's
plus the smallest delay of the link. It bounds lags to a few tenths of a second, no better: delays of cameras differ.
Where the smallest delays of successive seconds differ much (a backlog, a recording played as fast as it goes), there is
no prior.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from protocols.core.clocks import CameraTime
from protocols.core.ranges import MAX_TIME_S
from protocols.session.calibration import Calibration

if TYPE_CHECKING:
    from protocols.messages import syncline_pb2 as pb

MAX_CAMERA_DELAY_S = 0.1
"""Largest delay from exposure to time stamp [s], unknown to time services: frames stamped on arrival are late."""
_TEST_SIGMAS = 3.0  # 0.3 % by chance
_MAX_PRIORS = 1024
"""Cameras; as many as a hub has."""

_INTERVAL_S = 2.0  # s: holds a frame with the smallest delay
_INTERVALS = 15  # half a minute
_MIN_INTERVALS = 3  # complete ones, whose spread is tested
_MAX_SPREAD_S = 0.1
"""Largest difference of the intervals' smallest delays."""
ERROR_BOUND_S = 0.15
"""Of one camera's offset: its smallest delay is 0 to 0.3 s."""


@dataclass(frozen=True, slots=True)
class ExternalClockPrior:
    """Prior of one run (boot id) of a camera's clock. unix_minus_camera: t_unix - t_camera, error_bound: of it [s]."""

    boot_id: str
    unix_minus_camera: float
    error_bound: float


class ExternalClockPriors:
    """The latest prior of each camera."""

    def __init__(self) -> None:
        self._priors: dict[str, ExternalClockPrior] = {}
        self.times: dict[str, float] = {}
        """By camera, the time [s] of its latest observation on its clock."""

    def handle(self, message: pb.AgentStatus) -> None:
        """Add a camera agent's status: its prior."""
        if message.role != "camera":
            return
        gauges = message.gauges
        self._priors.pop(message.agent, None)
        offset, bound = gauges.get("unix_minus_camera_s", math.nan), gauges.get("clock_error_s", math.nan)
        plausible = abs(offset) <= MAX_TIME_S and 0.0 <= bound <= MAX_TIME_S
        if gauges.get("clock_synchronised", 0.0) > 0.0 and plausible and len(self._priors) < _MAX_PRIORS:
            self._priors[message.agent] = ExternalClockPrior(message.boot_id, offset, bound)

    def for_boots(self, boots: Mapping[str, str]) -> dict[str, ExternalClockPrior]:
        """The priors that belong to the given boot ids, by camera."""
        return {name: prior for name, prior in self._priors.items() if prior.boot_id == boots.get(name)}

    def contradictions(self, calibration: Calibration, boots: Mapping[str, str]) -> list[str]:
        """One line for each camera whose prior contradicts the calibration. boots: boot ids of the calibrated cameras.

        Of two cameras it cannot be decided which one is wrong; of more, those that differ from the median are reported.
        """
        valid = self.for_boots(boots)
        priors = {name: valid[name] for name in calibration.cameras if name in valid and name in self.times}
        if len(priors) < 2:
            return []
        first = next(iter(priors))
        unix = self.times[first] + priors[first].unix_minus_camera
        # One Unix time on the reference clock by each camera's prior and time map: equal if all are consistent.
        reference_times = {
            name: float(
                calibration.cameras[name].time_map.reference_from_camera(CameraTime(unix - prior.unix_minus_camera))
            )
            for name, prior in priors.items()
        }
        median = statistics.median_low(list(reference_times.values()))
        against = next(name for name, reference_time in reference_times.items() if reference_time == median)
        lines = []
        for name, reference_time in reference_times.items():
            a, b = calibration.cameras[name], calibration.cameras[against]
            allowed = priors[name].error_bound + priors[against].error_bound + MAX_CAMERA_DELAY_S
            allowed += _TEST_SIGMAS * math.hypot(a.time_offset_std, b.time_offset_std)
            if not math.isfinite(reference_time) or not abs(reference_time - median) > allowed:
                continue
            one = name if name != calibration.reference or len(priors) > 2 else against
            difference = abs(reference_time - median)
            other = against if one == name else name
            lines.append(
                f"{one}'s clock reports synchronisation to {_format_seconds(priors[one].error_bound)} and {other}'s to "
                f"{_format_seconds(priors[other].error_bound)}, but the images show a difference of "
                f"{_format_seconds(difference)}: a clock is wrong, or a camera's time stamps are late; the estimate "
                f"from the images is used"
            )
        return lines


def _format_seconds(seconds: float) -> str:
    """Seconds with two or three digits, in s, ms or µs."""
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if seconds * factor >= 1.0:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e6:.2g} µs"


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
