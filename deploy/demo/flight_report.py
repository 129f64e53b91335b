"""report.html of `demo --scene town`: one offline file with the figures, the map, and what the operator saw."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deploy.demo.flight_outcome import Outcome, as_rows
from hub.report.style import STYLE
from hub.report.svg import at, drawing, esc, points, text
from hub.report.tables import table
from protocols.core.files import write_atomically
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, TARGET, TARGET_CLOUD

if TYPE_CHECKING:
    from edge.uav.world.world import World

_COLOURS = {"visible": "#1d6b3a", "coasting": "#c2510a"}
_MAP_PX, _MARGIN_PX = (900.0, 560.0), 40.0
_NEAREST_M = 3.0  # less than that apart, and a map shows one place
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


@dataclass(frozen=True, slots=True)
class _Moment:
    """A frame that is shown, and why."""

    frame: int
    why: str


def write_report(path: Path, log: Path, outcome: Outcome, world: World) -> None:
    """Write the page of a finished demo. log: what was recorded of it."""
    said = (logged.message for logged in LogReader(log).messages([TARGET]))
    states = [state for state in said if isinstance(state, pb.TargetState) and state.frame < world.length]
    headline = (
        "The car was followed, also out of the picture" if outcome.good else "The car was not followed as promised"
    )
    rows = [[esc(cell) for cell in row] for row in as_rows(outcome)]
    parts = [
        f'<section><div class="verdict{"" if outcome.good else " attention"}"><h1>{esc(headline)}</h1></div>'
        f"{table(['', 'recovered', 'promised'], rows)}</section>",
        _section("Where it drove", _map(states, world)),
        _section("What the operator saw", _pictures(log, states, world)),
    ]
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{esc(headline)} · Syncline</title>\n"
        f"<style>{STYLE}\nfigure{{margin:0}}figure img{{width:100%}}</style>\n</head>\n<body>\n"
        '<header class="top"><b>Syncline</b><span>demo, scene town</span></header>\n'
        f"<main>\n{''.join(parts)}\n</main>\n</body>\n</html>\n"
    )
    write_atomically(path, page)


def _section(title: str, content: str) -> str:
    return f"<section><h2>{esc(title)}</h2>{content}</section>" if content else ""


def _map(states: Sequence[pb.TargetState], world: World) -> str:
    """The true way in grey, north up, and the places that were told on it."""
    placed = [state for state in states if len(state.ground) >= 2]
    if not placed:
        return ""
    frames = np.arange(placed[0].frame, placed[-1].frame + 1)
    true = np.asarray(world.target.ground[frames])
    told = np.array([tuple(state.ground[:2]) for state in placed])
    everything = np.vstack([true, told])
    low, high = everything.min(axis=0), everything.max(axis=0)
    room = np.array(_MAP_PX[::-1]) - 2.0 * _MARGIN_PX
    scale = float(np.min(room / np.maximum(high - low, _NEAREST_M)))

    def xy(ground: Floats) -> tuple[Floats, Floats]:
        return _MARGIN_PX + scale * (ground[:, 1] - low[1]), _MARGIN_PX + scale * (high[0] - ground[:, 0])

    parts = [
        f'<polyline points="{points(*xy(true))}" fill="none" stroke="#b8c0ca" stroke-width="9" stroke-linecap="round"/>'
    ]
    for state, run in itertools.groupby(placed, key=lambda one: one.state):
        way = np.array([tuple(one.ground[:2]) for one in run])
        if state in _COLOURS:
            dots = "".join(f'<circle cx="{at(x)}" cy="{at(y)}" r="2"/>' for x, y in zip(*xy(way), strict=True))
            parts.append(f'<g fill="{_COLOURS[state]}">{dots}</g>')
    height = 2.0 * _MARGIN_PX + scale * float(high[0] - low[0])
    metres = _bar(float((high - low).max()))
    parts.append(
        f'<path d="M{at(_MARGIN_PX)} {at(height - 8)}h{at(scale * metres)}" stroke="#1b2430" stroke-width="3"/>'
    )
    parts.append(text(_MARGIN_PX + scale * metres + 8.0, height - 4.0, f"{metres:g} m, north up"))
    lead = "Grey: where the car was. Green: told while it was seen. Orange: told while it was out of sight."
    label = "Map of the car's true way and of the places that the agent told"
    return f'<p class="lead">{lead}</p>{drawing(_MAP_PX[0], height, parts, label)}'


def _bar(span: float) -> float:
    return float(10.0 ** np.floor(np.log10(max(0.4 * span, 1.0))))


def _moments(states: Sequence[pb.TargetState], world: World) -> list[_Moment]:
    """The first frame, the longest time out of the picture, and the car found again."""
    runs = [(state, [one.frame for one in run]) for state, run in itertools.groupby(states, key=lambda one: one.state)]
    away = [
        (k, [frame for frame in frames if world.truth(frame).inside == 0.0])
        for k, (state, frames) in enumerate(runs)
        if state == "coasting"
    ]
    out = [_Moment(states[0].frame, "chosen")]
    k, gone = max(away, key=lambda one: len(one[1]), default=(0, []))
    if gone:
        out.append(_Moment(gone[0], "it has just left the picture: the arrow points to where it is thought to be"))
        out.append(_Moment(gone[-1], f"unseen for {(gone[-1] - gone[0] + 1) / world.fps:.1f} s"))
        if k + 1 < len(runs) and runs[k + 1][0] == "visible":
            out.append(_Moment(runs[k + 1][1][0], "found again"))
    return out


def _pictures(log: Path, states: Sequence[pb.TargetState], world: World) -> str:
    if not states:
        return ""
    wanted = _moments(states, world)
    by_frame = {state.frame: state for state in states}
    images: dict[int, pb.FlightImage] = {}
    clouds: dict[int, pb.TargetCloud] = {}
    for logged in LogReader(log).messages([FLIGHT_IMAGE, TARGET_CLOUD]):
        message = logged.message
        if isinstance(message, pb.FlightImage):
            # Where a picture was dropped on the bus, the one after it is shown.
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
    import cv2

    from edge.uav.estimator import decoded
    from edge.uav.operator_view import draw
    from edge.uav.tracker import Estimate, State

    image = decoded(message)
    if image is None:
        return ""
    nan = float("nan")
    x, y = state.centre if state.centre else (nan, nan)
    width, height = state.size if state.size else (nan, nan)
    particles = next((np.array(cloud.pixels).reshape(-1, 2) for cloud in clouds), None)
    estimate = Estimate(0.0, State(state.state), x, y, width, height, nan, state.std_px, particles=particles)
    good, data = cv2.imencode(".jpg", draw(image, estimate, state.state), [cv2.IMWRITE_JPEG_QUALITY, 80])
    if not good:
        return ""
    source = f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"
    told = f"{state.state}, {why}" if why != state.state else why
    caption = f"<figcaption><small>Frame {message.frame}: {esc(told)}.</small></figcaption>"
    return f'<figure><img src="{source}" alt="{esc(told)}">{caption}</figure>'
