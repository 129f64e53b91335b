"""What `demo --scene town` ends with: the car as recovered against the truth of the world it drove in."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import STATUS, TARGET

if TYPE_CHECKING:
    from edge.uav.world.world import World

LOG, REPORT = "demo.mcap", "report.html"
_NEAR_PX = 20.0
_GEO_NEAR_M = 5.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """Recovered against true. Shares are of frames, 0 … 1, None where there were none of that kind.

    in_frame, in_near: frames that show a part of the car, and those of them within 20 px. out_frames, out_length: that
    show nothing of it, and within one car length. claims_out: says visible from the third frame out on. median_m: of
    the place on the ground, in and out. offset_error_s: of the map between the vehicle's clock and the camera's.
    geo_near: share of the CAMERA_TRACKING_GEO_STATUS that came within three times their accuracy, or 5 m, of where the
    car was when they came; geo_median_m: how far off they were.
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
        """Whether the demo shows what it promises."""
        enough = self.in_frames >= 15 and (self.in_near or 0.0) >= 0.8
        honest = self.claims_out is None or self.claims_out <= 0.1
        told = self.geo_near is not None and self.geo_near >= 0.8
        return enough and honest and told and (self.out_length is None or self.out_frames < 5 or self.out_length >= 0.5)


def compare(log: Path, world: World, boot_s: float, statuses: int = 0) -> Outcome:
    """What a log's agent said of the target against the truth of its world."""
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
        raise Refused("the agent never said anything of a target", warnings=(f"see {log.parent}/logs",))
    table = np.array(rows, dtype=np.float64)
    inside, outside = table[:, 0] > 0.0, table[:, 0] == 0.0
    late = outside & np.r_[False, outside[:-1]] & np.r_[False, False, outside[:-2]]
    return Outcome(
        frames=len(rows),
        in_frames=int(inside.sum()),
        in_near=_share(table[inside, 1] < _NEAR_PX),
        out_frames=int(outside.sum()),
        out_length=_share(table[outside, 1] < table[outside, 2]),
        claims_out=_share(table[late, 3] > 0),
        states=dict(states),
        median_in_m=_median(table[inside, 4]),
        median_out_m=_median(table[outside, 4]),
        # The last third: once it was found.
        offset_error_s=_median(np.array(offsets[-max(len(offsets) // 3, 1) :])) if offsets else None,
        latency_p99_s=latency,
        statuses=statuses,
    )


def compare_geo(told: list[tuple[float, float, float, float]], world: World) -> tuple[float | None, float | None]:
    """Share of places that are near enough, and their median error [m]; None without any.

    told: world time [s], latitude, longitude [degrees], accuracy [m].
    """
    from edge.mavlink.roles.autopilot import ORIGIN

    errors, accuracies = [], []
    for moment, latitude, longitude, accuracy in told:
        if 0.0 <= moment <= world.time(world.length - 1):
            place, _ = world.target_at(moment)
            errors.append(float(np.hypot(*(ORIGIN.local(latitude, longitude, 0.0)[:2] - place))))
            accuracies.append(accuracy)
    table = np.array(errors)
    return _share(table <= np.maximum(3.0 * np.array(accuracies), _GEO_NEAR_M)), _median(table)


def as_json(outcome: Outcome) -> str:
    """The outcome as one JSON object."""
    import json
    from dataclasses import asdict

    return json.dumps({**asdict(outcome), "good": outcome.good}, allow_nan=False)


def as_rows(outcome: Outcome) -> list[tuple[str, str, str]]:
    """What was measured, recovered, promised."""

    def percent(share: float | None) -> str:
        return "-" if share is None else f"{100.0 * share:.1f} %"

    def metres(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f} m"

    ground = f"{metres(outcome.median_in_m)} / {metres(outcome.median_out_m)}"
    geo = f"{percent(outcome.geo_near)}, median {metres(outcome.geo_median_m)}"
    rows = [
        (f"in the picture ({outcome.in_frames} frames): within 20 px", percent(outcome.in_near), ">= 80 %"),
        (f"out of it ({outcome.out_frames} frames): within a car length", percent(outcome.out_length), ">= 50 %"),
        ("says visible while out", percent(outcome.claims_out), "<= 10 %"),
        ("place on the ground, in / out (median)", ground, ""),
        ("latitude, longitude as told over MAVLink: within 3 accuracies or 5 m", geo, ">= 80 %"),
    ]
    if outcome.offset_error_s is not None:
        rows.append(("vehicle clock against camera clock", f"{1e3 * outcome.offset_error_s:+.1f} ms off", ""))
    if outcome.latency_p99_s is not None:
        rows.append(("frame to status, p99", f"{1e3 * outcome.latency_p99_s:.0f} ms", ""))
    states = ", ".join(f"{outcome.states.get(name, 0)} {name}" for name in ("visible", "coasting", "lost"))
    return [*rows, ("states", states, "")]


def print_outcome(outcome: Outcome, out: Path) -> None:
    """The table at the end."""
    from rich.table import Table

    from deploy.offline.outputs import wide_console

    table = Table(title="the car as recovered against the truth")
    for name in ("", "recovered", "promised"):
        table.add_column(name)
    for row in as_rows(outcome):
        table.add_row(*row)
    console = wide_console()
    console.print(table)
    console.print(f"{outcome.statuses} tracking statuses came over MAVLink", soft_wrap=True)
    console.print(f"the log is {out / LOG}, the report {out / REPORT}", soft_wrap=True)
    console.print(f"replay it: syncline replay {out / LOG} --through uav --out again.mcap", soft_wrap=True)


def _share(good: Any) -> float | None:
    return float(np.mean(good)) if len(good) else None


def _median(values: Any) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
