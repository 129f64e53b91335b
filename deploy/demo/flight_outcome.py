"""Result of `demo --scene town`: tracking errors against the ground truth of the simulated world."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import STATUS, TARGET

if TYPE_CHECKING:
    from edge.uav.world.flight_world import FlightWorld

LOG, REPORT = "demo.mcap", "report.html"
_MAX_IMAGE_ERROR_PX = 20.0  # as NEAR_PX of deploy.evaluation.track_scores
_MIN_GEO_TOLERANCE_M = 5.0  # about a car's length: for accuracies that are stated as less


@dataclass(frozen=True, slots=True)
class FlightOutcome:
    """Tracking errors against ground truth. Fractions are of frames, 0 … 1, None if there are no such frames.

    in_frames, in_near: number of frames that show a part of the car, and fraction of them with an error below 20 px.
    out_frames, out_length: number of frames without the car, and fraction with an error below one car length.
    claims_out: fraction of frames reported visible, from the third frame of an exit on. median_in_m, median_out_m:
    median ground position error, in and out of view. offset_error_s: error of the estimated offset between the
    vehicle's and the camera's clock. statuses: tracking status messages received. geo_near: fraction of the
    CAMERA_TRACKING_GEO_STATUS messages that were within three times their accuracy, or 5 m, of the car's position at
    arrival; geo_median_m: their median error.
    """

    frames: int
    in_frames: int
    in_near: float | None
    out_frames: int
    out_length: float | None
    claims_out: float | None
    states: dict[str, int]
    median_in_m: float | None
    median_out_m: float | None
    offset_error_s: float | None
    latency_p99_s: float | None
    statuses: int
    geo_near: float | None = None
    geo_median_m: float | None = None

    @property
    def good(self) -> bool:
        """Whether all errors are within the limits of the demo."""
        enough = self.in_frames >= 15 and (self.in_near or 0.0) >= 0.8
        honest = self.claims_out is None or self.claims_out <= 0.1
        located = self.geo_near is not None and self.geo_near >= 0.8
        return (
            enough and honest and located and (self.out_length is None or self.out_frames < 5 or self.out_length >= 0.5)
        )

    def as_json(self) -> str:
        """The outcome as one JSON object."""
        return json.dumps({**asdict(self), "good": self.good}, allow_nan=False)

    def print(self, out: Path) -> None:
        """Print the table of results and the output files."""
        from rich.table import Table

        from deploy.offline.outputs import wide_console

        table = Table("", "estimated", "limit", title="estimated against true position of the car")
        for row in as_rows(self):
            table.add_row(*row)
        console = wide_console()
        console.print(table)
        console.print(f"{self.statuses} tracking statuses received over MAVLink", soft_wrap=True)
        console.print(f"the log is {out / LOG}, the report {out / REPORT}", soft_wrap=True)
        console.print(f"replay it: syncline replay {out / LOG} --through uav --out again.mcap", soft_wrap=True)


def compare_log_with_world(log: Path, world: FlightWorld, boot_s: float, statuses: int = 0) -> FlightOutcome:
    """Compare the target states in a log with the ground truth of its world. Raises Refused if there are none."""
    states: Counter[str] = Counter()
    rows: list[tuple[float, float, float, bool, float]] = []  # inside, error px, car length px, visible, error m
    offsets: list[float] = []
    latency: float | None = None
    for logged in LogReader(log).messages([TARGET, "telemetry", STATUS]):
        message: Any = logged.message
        if isinstance(message, pb.VehicleTelemetry):
            offsets.append((message.vehicle_time_ns - message.device_time_ns) / NANOSECONDS - boot_s)
        elif isinstance(message, pb.AgentStatus):
            latency = message.gauges.get("latency_p99_s", latency)
        elif isinstance(message, pb.TargetState) and message.frame < world.length:
            truth = world.truth(message.frame)
            states[message.state] += 1
            error = np.inf
            if message.centre:
                error = float(np.hypot(message.centre[0] - truth.x, message.centre[1] - truth.y))
            metres = np.nan
            if message.ground:
                metres = float(np.hypot(message.ground[0] - truth.north, message.ground[1] - truth.east))
            rows.append((truth.inside, error, truth.length, message.state == "visible", metres))
    if not rows:
        raise Refused("the agent never reported a target", warnings=(f"see {log.parent}/logs",))
    table = np.array(rows, dtype=np.float64)
    inside, outside = table[:, 0] > 0.0, table[:, 0] == 0.0
    late = outside & np.r_[False, outside[:-1]] & np.r_[False, False, outside[:-2]]
    return FlightOutcome(
        frames=len(rows),
        in_frames=int(inside.sum()),
        in_near=_share(table[inside, 1] < _MAX_IMAGE_ERROR_PX),
        out_frames=int(outside.sum()),
        out_length=_share(table[outside, 1] < table[outside, 2]),
        claims_out=_share(table[late, 3] > 0),
        states=dict(states),
        median_in_m=_median(table[inside, 4]),
        median_out_m=_median(table[outside, 4]),
        # The last third, after the offset estimate has converged.
        offset_error_s=_median(np.array(offsets[-max(len(offsets) // 3, 1) :])) if offsets else None,
        latency_p99_s=latency,
        statuses=statuses,
    )


def compare_geo_positions(
    reported: list[tuple[float, float, float, float]], world: FlightWorld
) -> tuple[float | None, float | None]:
    """Fraction of positions within tolerance, and their median error [m]; None without any.

    reported: world time [s], latitude, longitude [degrees], accuracy [m].
    """
    from edge.mavlink.roles.autopilot import DEFAULT_ORIGIN

    errors, accuracies = [], []
    for moment, latitude, longitude, accuracy in reported:
        if 0.0 <= moment <= world.time(world.length - 1):
            place, _ = world.target_at(moment)
            errors.append(float(np.hypot(*(DEFAULT_ORIGIN.to_ned(latitude, longitude, 0.0)[:2] - place))))
            accuracies.append(accuracy)
    table = np.array(errors)
    return _share(table <= np.maximum(3.0 * np.array(accuracies), _MIN_GEO_TOLERANCE_M)), _median(table)


def as_rows(outcome: FlightOutcome) -> list[tuple[str, str, str]]:
    """Rows of the table: quantity, estimate, limit."""

    def percent(share: float | None) -> str:
        return "-" if share is None else f"{100.0 * share:.1f} %"

    def metres(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f} m"

    ground = f"{metres(outcome.median_in_m)} / {metres(outcome.median_out_m)}"
    geo = f"{percent(outcome.geo_near)}, median {metres(outcome.geo_median_m)}"
    rows = [
        (f"in view ({outcome.in_frames} frames): within 20 px", percent(outcome.in_near), ">= 80 %"),
        (f"out of view ({outcome.out_frames} frames): within a car length", percent(outcome.out_length), ">= 50 %"),
        ("reported visible while out of view", percent(outcome.claims_out), "<= 10 %"),
        ("ground position error, in / out of view (median)", ground, ""),
        ("latitude, longitude as reported over MAVLink: within 3 accuracies or 5 m", geo, ">= 80 %"),
    ]
    if outcome.offset_error_s is not None:
        rows.append(("vehicle clock against camera clock", f"{1e3 * outcome.offset_error_s:+.1f} ms off", ""))
    if outcome.latency_p99_s is not None:
        rows.append(("frame to status, p99", f"{1e3 * outcome.latency_p99_s:.0f} ms", ""))
    states = ", ".join(f"{outcome.states.get(name, 0)} {name}" for name in ("visible", "coasting", "lost"))
    return [*rows, ("states", states, "")]


def _share(good: Any) -> float | None:
    return float(np.mean(good)) if len(good) else None


def _median(values: Any) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
