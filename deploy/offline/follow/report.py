"""report.html of `syncline follow`: paths over the ground, identities over time, and what each camera contributed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from deploy.offline.follow.plan import MOST_NUMBERS, PlanView, plan_axes, track_colour
from hub.report.page import html_page, section
from hub.report.svg import THIN, at, drawing, esc, line, number, points, short, text, tick_text, ticks, time_axis, whole
from hub.report.tables import provenance, table
from hub.tracking.detections import TrackingCamera
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration
    from deploy.offline.follow.source import FollowInput
    from hub.tracking.offline import FollowedTrack, FollowResult

_WIDTH, _LEFT, _RIGHT = 1000.0, 130.0, 70.0  # px of the drawing, and of its margins
_MAX_ROWS = 150
"""Tracks in the timeline and in the table; longer ones first where there are more."""
_UNFOLDED = 30  # tracks; more are folded away
_STYLE = (
    "<style>.walk{fill:none;stroke-width:2;stroke-linejoin:round;stroke-linecap:round}.walk.coasting{stroke-width:1.4;"
    "stroke-dasharray:3 4}.ghost{fill:none;stroke:#c9d1da;stroke-width:1}.seen.small{fill-opacity:.8}"
    "svg text.id{font-size:12px;font-weight:600}.life{stroke:none}.life.coasting{fill-opacity:.3}"
    ".count{fill:var(--blue);fill-opacity:.18;stroke:var(--blue);stroke-width:1.2}</style>"
)
_SCORES = (
    ("mota", "MOTA: 1 − (misses + false + identity switches) / truths"),
    ("moda", "MODA: 1 − (misses + false) / truths"),
    ("idf1", "IDF1: F1 of places whose identity is right over the whole time"),
    ("hota", "HOTA: detection and association, over limits from 5 to 95 cm"),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Associated detections of one camera. time: (n,) reference [s]. place: (n, 3) where their tracks were then."""

    time: Floats
    place: Floats


def follow_report(result: FollowResult, source: FollowInput, known: GivenCalibration, document: dict[str, Any]) -> str:
    """The page: one file that loads nothing; the same input gives the same bytes. document: of result.json."""
    tracks = sorted(result.tracks, key=lambda track: track.id)
    unit = str(document["units"])
    view = PlanView.of(tracks, known, plan_axes(result.up), unit)
    seen = _seen(result, source, known)
    span = document["first_time"], document["last_time"]
    shown = _longest(tracks)
    noun = document["kind"] if len(tracks) == 1 else {"person": "people", "vehicle": "vehicles"}[document["kind"]]
    headline = f"{whole(len(tracks))} {noun} followed through {len(result.cameras)} cameras"
    left = f"The {len(shown)} longest of {whole(len(tracks))} tracks. " if len(shown) < len(tracks) else ""
    parts = [
        _STYLE,
        _summary(headline, tracks, result, document),
        section(
            "Scores",
            "Against the given truth, by TrackEval; matches are within 0.5 m on the ground.",
            _scores(document["scores"]) if document["scores"] else "",
        ),
        section(
            "Paths over the ground",
            "From above, to scale. Each path begins at a ring and ends at its number"
            + (f" (the {MOST_NUMBERS} longest; the others under the pointer)" if len(tracks) > MOST_NUMBERS else "")
            + "; dotted where nobody saw the target. Triangles are cameras and the width of their view.",
            view.paths(tracks),
        ),
        section(
            "Identities over time",
            f"{left}Dark where cameras saw the target, light where it was only predicted. Above, how many were "
            "followed at a time.",
            _timeline(shown, tracks, span),
        ),
        section(
            "Cameras",
            "Used: share of the detections that belong to a track. Clutter: false detections in a frame. Detection "
            "probability: of a target in view, behind nobody.",
            _cameras(result, seen),
        ),
        section(
            "Coverage of each camera",
            "Where each camera’s detections were used, on the same plan; all paths in grey.",
            '<div class="maps">'
            + "".join(view.coverage(name, tracks, one.place) for name, one in seen.items())
            + "</div>",
        ),
        section("Use of each camera over time", "", _use_over_time(seen, span, document["times"])),
        section("Tracks", left, _tracks(shown, unit)),
        section("Provenance", "", _provenance(source, known, document)),
    ]
    return html_page("Tracks", headline, parts)


def _longest(tracks: Sequence[FollowedTrack]) -> list[FollowedTrack]:
    chosen = sorted(tracks, key=lambda track: (-len(track.times), track.id))[:_MAX_ROWS]
    return sorted(chosen, key=lambda track: (float(track.times[0]), track.id))


def _summary(headline: str, tracks: Sequence[FollowedTrack], result: FollowResult, document: dict[str, Any]) -> str:
    seconds = document["last_time"] - document["first_time"]
    _, counts = _at_once(tracks)
    rows = sum(len(track.times) for track in tracks)
    confirmed = sum(int(track.confirmed.sum()) for track in tracks)
    keys = [
        (f"{short(seconds)}{THIN}s", f"on the clock of {document['reference']}, {whole(document['times'])} times"),
        (
            whole(int(counts.max(initial=0))),
            f"at once at most, {whole(int(np.median(counts)) if len(counts) else 0)} usually",
        ),
    ]
    if rows:
        std = float(np.median(np.concatenate([track.std for track in tracks])))
        keys.append(
            (f"{100 * confirmed / rows:.0f}{THIN}%", f"of {whole(rows)} rows seen by cameras, the rest predicted")
        )
        keys.append((f"± {short(std, figures=2)}{THIN}{document['units']}", "median std of a place, per axis"))
    keys.append((f"{short(document['cpu_seconds'])}{THIN}s", "of CPU time"))
    boxes = "".join(f"<div><b>{esc(a)}</b><span>{esc(b)}</span></div>" for a, b in keys)
    notes = "".join(f'<li class="note">{esc(warning)}</li>' for warning in document["warnings"])
    notes = f'<h3>Notes</h3><ul class="findings">{notes}</ul>' if notes else ""
    return f'<section class="assessment"><h1>{esc(headline)}</h1><div class="keys">{boxes}</div>{notes}</section>'


def _scores(scores: dict[str, float | int | None]) -> str:
    keys = "".join(f"<div><b>{number(scores[key], 3)}</b><span>{esc(text)}</span></div>" for key, text in _SCORES)
    error = scores["error"]
    counts = (
        f"{whole(int(scores['truths'] or 0))} true places of {scores['people']} in {scores['instants']} instants: "
        f"{whole(int(scores['matches'] or 0))} matched"
        + ("" if error is None else f" (mean distance {short(100 * error, figures=2)}{THIN}cm)")
        + f", {whole(int(scores['misses'] or 0))} missed, {whole(int(scores['false'] or 0))} false, "
        f"{scores['switches']} identity switches, {scores['fragments']} interruptions. "
        f"Recall {number(scores['recall'], 3)}, precision {number(scores['precision'], 3)}, "
        f"detection accuracy {number(scores['deta'], 3)}, association accuracy {number(scores['assa'], 3)}."
    )
    return f'<div class="keys">{keys}</div><p>{esc(counts)}</p>'


def _at_once(tracks: Sequence[FollowedTrack]) -> tuple[Floats, Floats]:
    """Times and how many tracks have a row then."""
    if not tracks:
        return np.zeros(0), np.zeros(0)
    times, counts = np.unique(np.concatenate([track.times for track in tracks]), return_counts=True)
    return times, counts.astype(np.float64)


def _runs(track: FollowedTrack) -> list[tuple[float, float, bool]]:
    """Begin, end and state of the spans of a track in which it is confirmed, or coasting, throughout."""
    step = float(np.median(np.diff(track.times))) if len(track.times) > 1 else 0.0
    breaks = np.flatnonzero((np.diff(track.times) > 2.5 * step) | np.diff(track.confirmed)) + 1
    out = []
    for run in np.split(np.arange(len(track.times)), breaks):
        begin, end = float(track.times[run[0]]), float(track.times[run[-1]])
        after = min(run[-1] + 1, len(track.times) - 1)
        if track.times[after] - end <= 2.5 * step:
            end = float(track.times[after])
        out.append((begin, end, bool(track.confirmed[run[0]])))
    return out


def _timeline(shown: Sequence[FollowedTrack], tracks: Sequence[FollowedTrack], span: tuple[float, float]) -> str:
    if not shown:
        return "<p>Nobody was followed.</p>"
    low, high = span[0], max(span[1], span[0] + 1e-3)
    row = 17.0 if len(shown) <= 60 else 12.0
    top, inner = 98.0, _WIDTH - _LEFT - _RIGHT
    bottom = top + row * len(shown) + 4
    parts = time_axis(low, high, _LEFT, inner, 4, bottom)

    def x(time: Floats | float) -> Any:
        return _LEFT + inner * (time - low) / (high - low)

    values = ticks(low, high, 8)
    parts += [text(x(value), 90, tick_text(value, values), "tick", "middle") for value in values]
    times, counts = _at_once(tracks)
    scale = 60.0 / max(float(counts.max()), 1.0)
    for value in [tick for tick in ticks(0, float(counts.max()), 2) if tick == round(tick)]:
        parts.append(line(_LEFT, 72 - scale * value, _LEFT + inner, 72 - scale * value, "grid"))
        parts.append(text(_LEFT - 8, 76 - scale * value, tick_text(value, [0, 1]), "tick", "end"))
    parts.append(text(0, 46, "at once", "rowname"))
    outline_x, outline_y = np.r_[x(times[0]), x(times), x(times[-1])], np.r_[72.0, 72.0 - scale * counts, 72.0]
    parts.append(f'<polygon class="count" points="{points(outline_x, outline_y)}"/>')
    for index, track in enumerate(shown):
        y = top + row * index
        colour = track_colour(track.id)
        parts.append(text(_LEFT - 8, y + row - 4, str(track.id), "tick", "end"))
        parts.append(line(_LEFT, y + row / 2, _LEFT + inner, y + row / 2, "grid"))
        for begin, end, confirmed in _runs(track):
            title = f"{track.id}: {begin:.2f} to {end:.2f} s, {'confirmed' if confirmed else 'coasting'}"
            kind = "life" if confirmed else "life coasting"
            parts.append(
                f'<rect class="{kind}" fill="{colour}" x="{at(x(begin))}" y="{at(y + 2)}" '
                f'width="{at(max(x(end) - x(begin), 1.5))}" height="{at(row - 4)}"><title>{esc(title)}</title></rect>'
            )
        seconds = float(track.times[-1] - track.times[0])
        parts.append(text(_WIDTH - 6, y + row - 4, f"{short(seconds)}{THIN}s", "tick", "end"))
    parts.append(text(_LEFT + inner / 2, bottom + 32, "seconds on the reference clock", "tick", "middle"))
    return drawing(_WIDTH, bottom + 38, parts, "Identities over time")


def _seen(result: FollowResult, source: FollowInput, known: GivenCalibration) -> dict[str, _Seen]:
    """By camera, when and where its detections were associated."""
    stamps: dict[tuple[str, int], float] = {}
    for name in result.cameras:
        camera = TrackingCamera.from_calibration(known.calibration.cameras[name])
        for message in source.observations:
            if message.camera == name:
                stamps[name, message.sequence] = camera.reference_ns(message.device_time_ns) / NANOSECONDS
    times: dict[str, list[Floats]] = {name: [] for name in result.cameras}
    places: dict[str, list[Floats]] = {name: [] for name in result.cameras}
    for track in result.tracks:
        for name in result.cameras:
            mine = np.array([stamps[name, frame] for camera, frame, _ in track.detections if camera == name])
            times[name].append(mine)
            places[name].append(
                np.column_stack([np.interp(mine, track.times, track.position[:, axis]) for axis in range(3)])
            )
    return {
        name: _Seen(np.concatenate([*times[name], np.zeros(0)]), np.concatenate([*places[name], np.zeros((0, 3))]))
        for name in result.cameras
    }


def _cameras(result: FollowResult, seen: dict[str, _Seen]) -> str:
    rows = [
        [
            f"<b>{esc(name)}</b>",
            whole(camera.frames),
            whole(camera.detections),
            f"{whole(len(seen[name].time))} <small>({number(100 * camera.used, 0)}{THIN}%)</small>",
            number(camera.clutter, 2),
            number(camera.detection_probability, 2),
        ]
        for name, camera in result.cameras.items()
    ]
    head = ["Camera", "Frames", "Detections", "Used", "Clutter <small>a frame</small>", "Detection probability"]
    return table(head, rows, numeric=1, kind="cameras")


def _use_over_time(seen: dict[str, _Seen], span: tuple[float, float], times: int) -> str:
    """Associated detections of each camera in time bins, one strip a camera."""
    low, high = span[0], max(span[1], span[0] + 1e-3)
    count = int(np.clip(times // 4, 1, 100))
    edges = np.linspace(low, high, count + 1)
    width = float(edges[1] - edges[0])
    rates = {name: np.histogram(one.time, edges)[0] / width for name, one in seen.items()}
    top = max(max((float(rate.max(initial=0.0)) for rate in rates.values()), default=0.0), 1e-9)
    strip, gap, inner = 46.0, 14.0, _WIDTH - _LEFT - _RIGHT
    height = (strip + gap) * len(rates) + 46
    parts = time_axis(low, high, _LEFT, inner, 4, height - 40)
    for index, (name, rate) in enumerate(rates.items()):
        base = (strip + gap) * index + strip + 6
        parts.append(text(0, base - strip / 2 + 4, name, "rowname"))
        parts.append(line(_LEFT, base, _LEFT + inner, base, "zero"))
        across = _LEFT + inner * (np.repeat(edges, 2) - low) / (high - low)
        up = np.r_[0.0, np.repeat(rate, 2), 0.0]
        parts.append(f'<polygon class="count" points="{points(across, base - strip * up / top)}"/>')
        parts.append(text(_WIDTH, base - 2, f"{short(float(rate.mean()), figures=2)}{THIN}/s", "tick", "end"))
    parts.append(text(_LEFT + inner / 2, height - 6, "seconds on the reference clock", "tick", "middle"))
    lead = f'<p class="lead">Used detections a second; the strips are {short(top, figures=2)} a second high.</p>'
    return lead + drawing(_WIDTH, height, parts, "Used detections of each camera over time")


def _tracks(shown: Sequence[FollowedTrack], unit: str) -> str:
    head = [
        "Id", "From <small>s</small>", "To <small>s</small>", "Rows <small>confirmed</small>",
        f"Height <small>{esc(unit)}</small>", f"Path <small>{esc(unit)}</small>", f"Std <small>{esc(unit)}</small>",
        "Cameras",
    ]  # fmt: skip
    rows = []
    for track in shown:
        path = float(np.linalg.norm(np.diff(track.position, axis=0), axis=1).sum())
        swatch = f'<span class="swatch" style="background:{track_colour(track.id)};border:0"></span>'
        rows.append(
            [
                f"{swatch} <b>{track.id}</b>",
                number(float(track.times[0]), 2),
                number(float(track.times[-1]), 2),
                f"{whole(len(track.times))} <small>({100 * float(track.confirmed.mean()):.0f}{THIN}%)</small>",
                number(float(np.median(track.height)), 2),
                number(path, 1),
                short(float(np.median(track.std)), figures=2),
                str(len({camera for camera, _, _ in track.detections})),
            ]
        )
    listed = table(head, rows, numeric=1) if rows else ""
    if len(rows) <= _UNFOLDED:
        return listed
    return f"<details><summary>{len(rows)} tracks</summary>{listed}</details>"


def _provenance(source: FollowInput, known: GivenCalibration, document: dict[str, Any]) -> str:
    facts = {
        "Syncline": document["version"],
        "Session": source.name,
        "Reference clock": known.calibration.reference,
        "Lengths": document["units"],
        "Seed": str(document["seed"]),
    }
    return provenance(facts, known.rig, document["command"])
