"""What cameras' machines claim of their clocks: held against what the pictures say, and asked where these say nothing.

A time service ties a machine's clock to Unix time, t_unix = t_camera + m, and says within what. Two cameras that are
both so tied are tied to each other, which the calibration has found too, from the pictures. Where the two contradict
each other by more than both allow, a clock is wrong or a camera stamps late; the pictures are believed. Only where
they leave several lags open (periodic motion) the claim chooses among these (`hub/calibration/pair_network.py`).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass

from protocols.core.clocks import NANOSECONDS, CameraTime
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration

CAMERA_DELAY = 0.1
"""Seconds of a camera's own, which no time service knows: what is stamped on arrival is late by that."""
_STDS = 3.0


@dataclass(frozen=True, slots=True)
class Claim:
    """Of one run (boot) of a camera. unix_minus_camera: t_unix - t_camera [s]. error: of Unix time, as claimed [s]."""

    boot: str
    unix_minus_camera: float
    error: float


class ClockClaims:
    """Remembers each camera's latest claim, and its latest picture's time."""

    def __init__(self) -> None:
        self._claims: dict[str, Claim] = {}
        self._now: dict[str, float] = {}

    def handle(self, message: pb.Observation | pb.AgentStatus) -> None:
        """Take what a camera's agent says of itself, or when it saw something."""
        if isinstance(message, pb.Observation):
            self._now[message.camera] = message.device_time_ns / NANOSECONDS
            return
        if message.role != "camera":
            return
        gauges = message.gauges
        tied = gauges.get("clock_synchronised", 0.0) > 0.0 and "clock_error_s" in gauges
        if tied and "unix_minus_camera_s" in gauges:
            claim = Claim(message.boot_id, gauges["unix_minus_camera_s"], gauges["clock_error_s"])
            self._claims[message.agent] = claim
        else:
            self._claims.pop(message.agent, None)

    def of(self, boots: Mapping[str, str]) -> dict[str, Claim]:
        """The claims of the runs (boots) of cameras that are spoken of."""
        return {name: claim for name, claim in self._claims.items() if claim.boot == boots.get(name)}

    def contradictions(self, calibration: Calibration, boots: Mapping[str, str]) -> list[str]:
        """One line for each camera whose claim the calibration contradicts. boots: those it speaks of.

        Of two cameras nobody can say which is wrong; of more, those away from the median are told.
        """
        told_of = self.of(boots)
        claims = {name: told_of[name] for name in calibration.cameras if name in told_of and name in self._now}
        if len(claims) < 2:
            return []
        first = next(iter(claims))
        unix = self._now[first] + claims[first].unix_minus_camera
        # One moment of Unix time on the reference clock, by each camera's claim and time map: the same if all is well.
        moments = {
            name: float(
                calibration.cameras[name].time_map.reference_from_camera(CameraTime(unix - claim.unix_minus_camera))
            )
            for name, claim in claims.items()
        }
        usual = statistics.median_low(list(moments.values()))
        against = next(name for name, moment in moments.items() if moment == usual)
        told = []
        for name, moment in moments.items():
            a, b = calibration.cameras[name], calibration.cameras[against]
            allowed = claims[name].error + claims[against].error + CAMERA_DELAY
            allowed += _STDS * math.hypot(a.time_offset_std, b.time_offset_std)
            if not math.isfinite(moment) or not abs(moment - usual) > allowed:
                continue
            one = name if name != calibration.reference or len(claims) > 2 else against
            away = abs(moment - usual)
            other = against if one == name else name
            told.append(
                f"{one}'s clock says it is synchronised to {_short(claims[one].error)} and {other}'s to "
                f"{_short(claims[other].error)}, the pictures say {_short(away)} off: a clock is wrong, or a camera's "
                f"times are late; the pictures are believed"
            )
        return told


def _short(seconds: float) -> str:
    """Two or three digits, in s, ms or µs."""
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if seconds * factor >= 1.0:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e6:.2g} µs"
