"""Result of `demo --scene town`: tracking errors against the ground truth of the simulated world.

And its report.html: one offline file with the results, a map, and selected frames.
"""

from __future__ import annotations

import base64
import itertools
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hub.report.page import html_page, section
from hub.report.svg import at, drawing, esc, points, text
from hub.report.tables import table
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.core.files import write_atomically
from protocols.core.jpeg import encode_jpeg
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, STATUS, TARGET, TARGET_CLOUD

if TYPE_CHECKING:
    from edge.uav.world.flight_world import FlightWorld

LOG, REPORT = "demo.mcap", "report.html"
_MAX_IMAGE_ERROR_PX = 20.0  # as NEAR_PX of deploy.evaluation.track_scores
_MIN_GEO_TOLERANCE_M = 5.0  # about a car's length: for accuracies that are stated as less

_COLOURS = {"visible": "#1d6b3a", "coasting": "#c2510a"}
_MAP_PX, _MARGIN_PX = (900.0, 560.0), 40.0  # size of the map, and of the room around the paths
_MIN_MAP_SPAN_M = 3.0  # smallest extent of the map


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


@dataclass(frozen=True, slots=True)
class _ReportFrame:
    """A frame shown in the report, and the reason."""

    frame: int
    why: str


def write_report(path: Path, log: Path, outcome: FlightOutcome, world: FlightWorld) -> None:
    """Write the report of a finished demo. log: its recording."""
    said = (logged.message for logged in LogReader(log).messages([TARGET]))
    states = [state for state in said if isinstance(state, pb.TargetState) and state.frame < world.length]
    headline = "The car was tracked, also out of view" if outcome.good else "The tracking errors exceed the limits"
    rows = [[esc(cell) for cell in row] for row in as_rows(outcome)]
    parts = [
        f'<section><div class="assessment{"" if outcome.good else " attention"}"><h1>{esc(headline)}</h1></div>'
        f"{table(['', 'estimated', 'limit'], rows)}</section>",
        section("Trajectory of the car", "", _map(states, world)),
        section("Selected frames of the operator's video", "", _pictures(log, states, world)),
    ]
    style = "<style>figure{margin:0}figure img{width:100%}</style>"
    page = html_page("demo, scene town", headline, [style, *parts])
    write_atomically(path, page)


def _map(states: Sequence[pb.TargetState], world: FlightWorld) -> str:
    """The true path in grey, north up, with the estimated positions on it."""
    placed = [state for state in states if len(state.ground) >= 2]
    if not placed:
        return ""
    frames = np.arange(placed[0].frame, placed[-1].frame + 1)
    true = np.asarray(world.target.ground[frames])
    estimated = np.array([tuple(state.ground[:2]) for state in placed])
    everything = np.vstack([true, estimated])
    low, high = everything.min(axis=0), everything.max(axis=0)
    room = np.array(_MAP_PX[::-1]) - 2.0 * _MARGIN_PX
    scale = float(np.min(room / np.maximum(high - low, _MIN_MAP_SPAN_M)))

    def xy(ground: Floats) -> tuple[Floats, Floats]:
        return _MARGIN_PX + scale * (ground[:, 1] - low[1]), _MARGIN_PX + scale * (high[0] - ground[:, 0])

    parts = [
        f'<polyline points="{points(*xy(true))}" fill="none" stroke="#b8c0ca" stroke-width="9" stroke-linecap="round"/>'
    ]
    for state, run in itertools.groupby(placed, key=lambda one: one.state):
        path = np.array([tuple(one.ground[:2]) for one in run])
        if state in _COLOURS:
            dots = "".join(f'<circle cx="{at(x)}" cy="{at(y)}" r="2"/>' for x, y in zip(*xy(path), strict=True))
            parts.append(f'<g fill="{_COLOURS[state]}">{dots}</g>')
    height = 2.0 * _MARGIN_PX + scale * float(high[0] - low[0])
    metres = float(10.0 ** np.floor(np.log10(max(0.4 * float((high - low).max()), 1.0))))
    parts.append(
        f'<path d="M{at(_MARGIN_PX)} {at(height - 8)}h{at(scale * metres)}" stroke="#1b2430" stroke-width="3"/>'
    )
    parts.append(text(_MARGIN_PX + scale * metres + 8.0, height - 4.0, f"{metres:g} m, north up"))
    lead = "Grey: true path. Green: estimated while the car was visible. Orange: estimated while it was out of view."
    label = "Map of the car's true path and of the agent's estimates"
    return f'<p class="lead">{lead}</p>{drawing(_MAP_PX[0], height, parts, label)}'


def _select_report_frames(states: Sequence[pb.TargetState], world: FlightWorld) -> list[_ReportFrame]:
    """The first frame, the start and end of the longest time out of view, and the reacquisition."""
    runs = [(state, [one.frame for one in run]) for state, run in itertools.groupby(states, key=lambda one: one.state)]
    away = [
        (k, [frame for frame in frames if world.truth(frame).inside == 0.0])
        for k, (state, frames) in enumerate(runs)
        if state == "coasting"
    ]
    out = [_ReportFrame(states[0].frame, "selected")]
    k, gone = max(away, key=lambda one: len(one[1]), default=(0, []))
    if gone:
        out.append(_ReportFrame(gone[0], "it has just left the view: the arrow points to its estimated position"))
        out.append(_ReportFrame(gone[-1], f"unseen for {(gone[-1] - gone[0] + 1) / world.fps:.1f} s"))
        if k + 1 < len(runs) and runs[k + 1][0] == "visible":
            out.append(_ReportFrame(runs[k + 1][1][0], "reacquired"))
    return out


def _pictures(log: Path, states: Sequence[pb.TargetState], world: FlightWorld) -> str:
    if not states:
        return ""
    wanted = _select_report_frames(states, world)
    by_frame = {state.frame: state for state in states}
    images: dict[int, pb.FlightImage] = {}
    clouds: dict[int, pb.TargetCloud] = {}
    for logged in LogReader(log).messages([FLIGHT_IMAGE, TARGET_CLOUD]):
        message = logged.message
        if isinstance(message, pb.FlightImage):
            # If an image was dropped on the bus, the next one is shown.
            for moment in wanted:
                if moment.frame <= message.frame < moment.frame + 5 and message.frame in by_frame:
                    images.setdefault(moment.frame, message)
        elif isinstance(message, pb.TargetCloud):
            clouds[message.frame] = message
    figures = []
    for moment in wanted:
        if moment.frame in images:
            image = images[moment.frame]
            near = [cloud for frame, cloud in clouds.items() if abs(frame - image.frame) <= 6]
            figures.append(_figure(image, by_frame[image.frame], near[:1], moment.why))
    return f'<div class="columns">{"".join(figures)}</div>' if figures else ""


def _figure(message: pb.FlightImage, state: Any, clouds: Iterable[pb.TargetCloud], why: str) -> str:
    from edge.uav.base import Estimate, TrackState
    from edge.uav.estimator import decode_image
    from edge.uav.operator_view import draw

    image = decode_image(message)
    if image is None:
        return ""
    nan = float("nan")
    x, y = state.centre if state.centre else (nan, nan)
    width, height = state.size if state.size else (nan, nan)
    particles = next((np.array(cloud.pixels).reshape(-1, 2) for cloud in clouds), None)
    estimate = Estimate(0.0, TrackState(state.state), x, y, width, height, nan, state.std_px, particles=particles)
    source = f"data:image/jpeg;base64,{base64.b64encode(encode_jpeg(draw(image, estimate, state.state), 80)).decode()}"
    caption_text = f"{state.state}, {why}" if why != state.state else why
    caption = f"<figcaption><small>Frame {message.frame}: {esc(caption_text)}.</small></figcaption>"
    return f'<figure><img src="{source}" alt="{esc(caption_text)}">{caption}</figure>'
