"""An earlier answer that a restarted hub goes on with, unverified until the first consistent second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hub.clocks.external_prior import ERROR_BOUND_S
from hub.live.camera_links import CameraLinks
from protocols.core.clocks import TimeMap
from protocols.session.calibration import Calibration, CameraCalibration

VERIFY_ROWS = 60  # detections of two cameras that a reloaded calibration is verified with
_VERIFY_S = 15.0  # s: after this time without success it is dropped
_ALL_HEARD_S = 3.0
"""How long the other cameras of a reloaded calibration are waited for, once two are heard of."""
_SAME_CLOCK_S = 1.0
"""Largest change of a camera's delay against the hub's clock for a reloaded time map to be of the same clock."""


@dataclass(slots=True, eq=False)
class ReloadedCalibration:
    """boots, delays: of its cameras then. arrival: the hub's clock at those delays [s], None = unknown.

    Cameras that were restarted since, or whose clock was set, are left out; where ``arrival`` is given, they come to
    their new clocks by the delays then and now. since: when it was first tested [s].
    """

    calibration: Calibration
    boots: Mapping[str, str]
    delays: Mapping[str, float]
    arrival: float | None
    since: float | None = None
    _heard_two_at: float = np.inf

    def on_present_clocks(self, boots: Mapping[str, str], links: CameraLinks, now: float) -> Calibration | None:
        """The answer as soon as two of its cameras are heard of; boots: of the cameras now.

        Without those that are heard on a clock that it does not know; those not heard of are as they were.
        """
        last = self.calibration
        heard = {name: last.cameras[name] for name in boots if name in last.cameras and name in links.delays}
        shifts = {name: links.delays[name] - self.delays.get(name, -np.inf) for name in heard}
        unheard = {name: one for name, one in last.cameras.items() if name not in boots and name in self.boots}
        kept = {
            name: camera
            for name, camera in heard.items()
            if boots[name] == self.boots.get(name) and abs(shifts[name]) < _SAME_CLOCK_S
        }
        if self.arrival is not None and len(kept) < len(last.cameras):
            fresh = {
                name: camera for name, camera in heard.items() if name in links.fresh and np.isfinite(shifts[name])
            }
            if len(fresh) < 2 or last.reference not in fresh:
                return None
            self._heard_two_at = min(self._heard_two_at, now)
            if len(fresh) < len(last.cameras) and now < self._heard_two_at + _ALL_HEARD_S:
                return None
            kept = {
                name: on_new_clock(
                    camera,
                    shifts[name] - shifts[last.reference],
                    then=self.arrival - self.delays[name],
                    now=links.camera_time[name],
                )
                for name, camera in fresh.items()
            }
            # The reference clock began anew, the clocks of those that are not heard did not, as far as is known.
            unheard = {
                name: on_new_clock(one, -shifts[last.reference], then=one.lag_time, now=one.lag_time)
                for name, one in unheard.items()
            }
            self.calibration = replace(last, cameras=kept | unheard)
        if len(kept) < 2:
            return None  # not heard of yet, a backlog, or clocks that it does not know
        return replace(self.calibration, cameras=kept | unheard)

    def on_clocks(self, boots: Mapping[str, str]) -> Calibration:
        """Without the cameras on a clock that it does not know. boots: of those that are heard of."""
        known = {
            name: one
            for name, one in self.calibration.cameras.items()
            if name not in boots or self.arrival is not None or self.boots.get(name) == boots[name]
        }
        return replace(self.calibration, cameras=known)

    def has_failed(self, now: float) -> bool:
        """Whether new rows did not verify it in time."""
        return self.since is None or now - self.since > _VERIFY_S


def on_new_clock(camera: CameraCalibration, shift: float, then: float, now: float) -> CameraCalibration:
    """A calibrated camera whose clock, or whose reference camera's, began anew, by delays against the hub's clock.

    A camera's delay is the hub's clock less its own. shift: its delay now less then, less the same of the reference
    camera: what the hub's clock was set by meanwhile cancels. then, now: its times [s], between which its rate counts;
    the lag is that of now. Both differ from the truth by the variation of the network's delays.
    """
    rate = camera.time_map.clock_rate
    offset = camera.time_map.time_offset + shift + (rate - 1.0) * (then - now)
    std = float(np.hypot(camera.time_offset_std, ERROR_BOUND_S))
    return replace(camera, time_map=TimeMap(rate, offset), time_offset_std=std, lag_time=now, lag_std=std)
