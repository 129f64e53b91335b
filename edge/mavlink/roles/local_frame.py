"""One north-east-down frame for what an autopilot reports of its position, with height 0 at home.

LOCAL_POSITION_NED counts from where the autopilot's estimator was started. In height that need not be home (it was
switched on elsewhere, or a station has set the origin at sea level), and it moves when the estimator is reset in
flight. GLOBAL_POSITION_INT has neither fault, but comes less often: it corrects the local positions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.mavlink.roles.telemetry import MAX_DISTANCE_M, GlobalPosition, LocalPosition
from edge.uav.navigation import Origin
from protocols.geometry.types import Floats

MAX_POSITION_AGE_S = 1.5
"""For how long a position is extrapolated at its velocity: one sent each second may be late."""
_SMOOTH_S = 0.5
"""For how long a vehicle flies on nearly straight: at 3 m/s² it is 0.4 m from there by then, after 1.5 s 3.4 m."""
_MAX_LOCAL_AGE_S = 2.0  # without a local position, after which the global one is used
_ON_GROUND_S = 3.0  # after arming, when home is set: a heartbeat may say so first, and no vehicle is high by then
_STEP_M, _STEP_DOWN_M = 3.0, 0.5  # from which the frame has moved: 0.15 s at 20 m/s, and at a climb of 3 m/s
_MANOEUVRE_M_S2 = 10.0  # times the interval squared: half of 2 g, by which a velocity that was kept is wrong


class LocalFrame:
    """Positions in one frame, from local and global reports in the order of their times [s].

    origin: geodetic, at home's height above sea level; None while unknown. position: time [s], position (3,) NED [m]
    from there and velocity (3,) [m/s] of the last report; None where there is none.
    """

    def __init__(self) -> None:
        self.origin: Origin | None = None
        self.position: tuple[float, Floats, Floats] | None = None
        self._shift = np.zeros(3)  # from reported local positions into this frame
        self._local_s: float | None = None
        self._interval_s = MAX_POSITION_AGE_S  # between reports, as a moving mean
        self._armed_s: float | None = None

    def set_armed(self, armed: bool, time: float) -> None:
        """Add a heartbeat. Some seconds after arming home's height is kept, until then it is followed."""
        self._armed_s = (time if self._armed_s is None else self._armed_s) if armed else None

    def restart(self) -> None:
        """The autopilot or its clock was restarted: its local frame may be another one."""
        self.position = self._local_s = None
        self._shift = np.zeros(3)

    def at(self, time: float) -> tuple[Floats, Floats] | None:
        """Position and velocity (3,) at a time; None if not known of late."""
        if self.position is None or abs(time - self.position[0]) >= MAX_POSITION_AGE_S:
            return None
        last, position, velocity = self.position
        return np.asarray(position + (time - last) * velocity), velocity

    def measured_at(self, time: float) -> Floats | None:
        """Position (3,) at a time; None where a report is missing, from which on `at` is a guess."""
        if self.position is None or abs(time - self.position[0]) >= max(2.0 * self._interval_s, _SMOOTH_S):
            return None
        known = self.at(time)
        return None if known is None else known[0]

    def take_local(self, report: LocalPosition, time: float) -> None:
        """Add a local position. A jump that its velocity does not explain is one of its frame, until a global one."""
        expected = self.at(time)
        if self._local_s is None:
            self.origin = None  # so far it was the vehicle's first global position, not the local frame's origin
        if expected is not None and self.position is not None:
            slack = _MANOEUVRE_M_S2 * (time - self.position[0]) ** 2
            self._correct(expected[0] - report.position - self._shift, slack, across=self._local_s is not None)
        if np.abs(report.position + self._shift).max() > MAX_DISTANCE_M:
            self._shift = np.zeros(3)
        self._local_s = time
        self._report(time, report.position + self._shift, report.velocity)

    def take_global(self, report: GlobalPosition, time: float) -> None:
        """Add a global position."""
        local = None if self._local_s is None or time - self._local_s >= _MAX_LOCAL_AGE_S else self.at(time)
        place, home = (report.latitude, report.longitude), report.altitude - report.relative_altitude
        position = None if self.origin is None else self.origin.to_ned(*place, report.altitude)
        if self.origin is None or position is None or np.abs(position).max() > MAX_DISTANCE_M:
            if local is not None:  # the origin is where this global position has the vehicle's local position
                place = Origin(*place, home).to_geodetic(-local[0][0], -local[0][1], 0.0)[:2]
            self.origin = Origin(*place, home)
        elif self._armed_s is None or time - self._armed_s < _ON_GROUND_S:
            self.origin = replace(self.origin, altitude=home)
        position = self.origin.to_ned(report.latitude, report.longitude, report.altitude)
        if local is None:
            last, velocity = self.position, report.velocity
            if last is not None and not velocity.any() and 0.0 < time - last[0] < 2 * MAX_POSITION_AGE_S:
                velocity = (position - last[1]) / (time - last[0])  # Betaflight sends 0 in place of it
            self._report(time, position, velocity)
        else:
            self._correct(position - local[0], 0.0)

    def _report(self, time: float, position: Floats, velocity: Floats) -> None:
        if self.position is not None:
            self._interval_s += 0.3 * (min(time - self.position[0], MAX_POSITION_AGE_S) - self._interval_s)
        self.position = time, position, velocity

    def _correct(self, lacking: Floats, slack_m: float, *, across: bool = True) -> None:
        """Move the frame by what its positions lack (3,) [m], if that is a step of the frame. across: also sideways."""
        across = across and bool(np.hypot(*lacking[:2]) > _STEP_M + slack_m)
        step = lacking * (across, across, abs(lacking[2]) > _STEP_DOWN_M + slack_m)
        self._shift = self._shift + step
        if self.position is not None:
            self.position = self.position[0], self.position[1] + step, self.position[2]
