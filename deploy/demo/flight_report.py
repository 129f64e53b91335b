"""report.html of `demo --scene town`: one offline file with the results, a map, and selected frames."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deploy.demo.flight_outcome import FlightOutcome, as_rows
from hub.report.page import html_page, section
from hub.report.svg import at, drawing, esc, points, text
from hub.report.tables import table
from protocols.core.files import write_atomically
from protocols.core.jpeg import encode_jpeg
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, TARGET, TARGET_CLOUD

if TYPE_CHECKING:
    from edge.uav.world.flight_world import FlightWorld

_COLOURS = {"visible": "#1d6b3a", "coasting": "#c2510a"}
_MAP_PX, _MARGIN_PX = (900.0, 560.0), 40.0  # size of the map, and of the room around the paths
_MIN_MAP_SPAN_M = 3.0  # smallest extent of the map


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
