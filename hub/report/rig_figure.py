"""Figure of the rig: camera frusta and trajectories, as an interactive 3-D view and as plan and side view."""

from __future__ import annotations

import html
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hub.report import measures
from hub.report.svg import THIN, at, drawing, line, number, points, round_below, text
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration
from protocols.session.rig import Rig

Rows = Sequence[Sequence[float | None]]

MOST_POINTS = 3000  # of the trajectory: the page stays below 6 MB
_BREAK = 0.5  # a trajectory is not drawn across a longer gap [s]
_NAVY, _ORANGE = "#123a5f", "#c2510a"
DIV = "scene-3d"


@dataclass(frozen=True, slots=True, eq=False)
class RigFigure:
    """The geometry of the figure in display axes, with the third axis up.

    paths: (n, 3) per trajectory segment. cameras: centre and the four far corners of the frustum (5, 3) by name. axes:
    names of the axes. unit: of length.
    """

    paths: list[Floats]
    cameras: dict[str, Floats]
    axes: tuple[str, str, str]
    unit: str


def build_rig_figure(calibration: Calibration, rig: Rig) -> RigFigure:
    """The figure in display axes with up vertical, whatever the world axes are."""
    up = measures.estimate_up(calibration, rig)
    turn, own_axes = _display_from_world(calibration, up)
    paths = _path_segments(calibration)
    places = np.array([camera.pose.position for camera in calibration.cameras.values()])
    everything = np.concatenate([places, *paths])
    extent = float(np.linalg.norm(np.ptp(everything, axis=0)))
    size = 0.06 * extent if extent > 0 else 1.0
    cameras = {}
    for name, camera in calibration.cameras.items():
        lens = camera.intrinsics
        half = np.array([lens.width / lens.matrix[0, 0], lens.height / lens.matrix[1, 1]]) / 2
        half = half / max(1.0, float(half.max()) / 0.8)  # a very wide lens must not dominate the figure
        cameras[name] = _frustum(camera.pose, half, size) @ turn.T
    unit = calibration.units if calibration.scale == "metric" else "× first baseline"
    axes = ("x", "y", "z") if own_axes else ("right", "ahead", "up")
    return RigFigure([path @ turn.T for path in paths], cameras, axes, unit)


def _display_from_world(calibration: Calibration, up: Floats) -> tuple[Floats, bool]:
    """Rotation (3, 3) from world to right, ahead, up of the first camera; True if it is the identity (z is up)."""
    if up[2] > 1 - 1e-6:
        return np.eye(3), True
    first = next(iter(calibration.cameras.values())).pose.rotation
    ahead = first[2] - up * (first[2] @ up)
    if np.linalg.norm(ahead) < 0.1:  # it looks straight up or down
        ahead = first[1] - up * (first[1] @ up)
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up]), False


def _path_segments(calibration: Calibration) -> list[Floats]:
    tables = [table for table in calibration.trajectories if len(table.time)]
    total = sum(len(table.time) for table in tables)
    out = []
    for table in tables:
        share = max(2, int(MOST_POINTS * len(table.time) / max(total, 1)))
        chosen = measures.thinned_indices(len(table.time), share)
        time, position = table.time[chosen], table.position[chosen]
        usual = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        cuts = np.flatnonzero(np.diff(time) > max(_BREAK, 3 * usual)) + 1
        out += [part for part in np.split(position, cuts) if len(part)]
    return out


def _frustum(pose: Pose, half: Floats, size: float) -> Floats:
    corners = [(-half[0], -half[1]), (half[0], -half[1]), (half[0], half[1]), (-half[0], half[1])]
    return pose.world_from_camera(size * np.array([(0.0, 0.0, 0.0), *((x, y, 1.0) for x, y in corners)]))


def rig_figure_script(figure: RigFigure) -> str:
    """JavaScript that draws the figure into the element DIV with plotly."""
    data: list[dict[str, Any]] = []
    broken: list[Sequence[float | None]] = []
    for path in figure.paths:
        broken += [*([_round(value) for value in row] for row in path), [None, None, None]]
    if broken:
        data.append(_trace(broken, "lines", "path", line={"color": _ORANGE, "width": 4}))
        ends = [figure.paths[0][0], figure.paths[-1][-1]]
        data.append(
            _trace(
                [[_round(v) for v in end] for end in ends],
                "markers",
                "start ●, end ◆",
                marker={"color": _ORANGE, "size": 6, "symbol": ["circle", "diamond"]},
                text=["start", "end"],
                hoverinfo="text",
            )
        )
    for name, corners in figure.cameras.items():
        order = (1, 2, 3, 4, 1, 0, 2, None, 3, 0, 4)
        edges: Rows = [[None] * 3 if i is None else [_round(v) for v in corners[i]] for i in order]
        data.append(_trace(edges, "lines", name, line={"color": _NAVY, "width": 4}, hoverinfo="skip", showlegend=False))
    centres = [[_round(v) for v in corners[0]] for corners in figure.cameras.values()]
    names = list(figure.cameras)
    data.append(
        _trace(
            centres,
            "markers+text",
            "cameras",
            text=[f"<b>{html.escape(name, quote=False)}</b>" for name in names],
            textposition="bottom center",
            textfont={"color": _NAVY, "size": 14},
            marker={"color": _NAVY, "size": 4},
            hovertemplate="%{text}<br>%{x:.3g}, %{y:.3g}, %{z:.3g}<extra></extra>",
        )
    )
    unit = f" [{figure.unit}]"
    axis = {"gridcolor": "#d5dae0", "zeroline": False, "showbackground": False, "color": "#445"}
    middle, half = _box(figure)
    axes = {
        f"{key}axis": {**axis, "title": {"text": name + unit}, "range": [_round(m - h), _round(m + h)]}
        for key, name, m, h in zip("xyz", figure.axes, middle, half, strict=True)
    }
    ratio = 1.7 * half / np.linalg.norm(half)
    layout = {
        "scene": {
            **axes,
            "aspectmode": "manual",
            "aspectratio": dict(zip("xyz", (_round(value) for value in ratio), strict=True)),
            "camera": _viewpoint(figure),
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
        "paper_bgcolor": "#fff",
        "font": {"family": "system-ui, sans-serif", "color": "#223"},
    }
    buttons = [
        "zoom3d",
        "pan3d",
        "orbitRotation",
        "tableRotation",
        "resetCameraDefault3d",
    ]  # no button that sends data elsewhere
    config = {"displaylogo": False, "responsive": True, "modeBarButtons": [buttons]}
    texts = (json.dumps(part, separators=(",", ":"), allow_nan=False) for part in (data, layout, config))
    arguments = ",".join(texts).replace("<", "\\u003c")  # safe inside a <script> element
    return f'Plotly.newPlot("{DIV}",{arguments});'


def _box(figure: RigFigure) -> tuple[Floats, Floats]:
    """Centre and half sides (3,) of a bounding box, with a minimum thickness."""
    everything = np.concatenate([*figure.cameras.values(), *figure.paths])
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = 0.54 * (high - low)
    return 0.5 * (low + high), np.maximum(half, max(0.15 * float(half.max()), 1e-9))


def _viewpoint(figure: RigFigure) -> dict[str, Any]:
    """Initial plotly viewpoint: above and behind the cameras, with the trajectory beyond them."""
    towards = np.zeros(3)
    for corners in figure.cameras.values():
        towards += (corners[1:].mean(axis=0) - corners[0]) / np.linalg.norm(corners[1:].mean(axis=0) - corners[0])
    flat = towards[:2]
    # A ring of cameras has no common viewing direction: any side will do.
    behind = (
        -flat / np.linalg.norm(flat) if np.linalg.norm(flat) > 0.3 * len(figure.cameras) else np.array([-0.6, -0.8])
    )
    side = np.array([behind[1], -behind[0]])
    x, y = 1.3 * behind + 0.65 * side
    return {
        "eye": {"x": _round(x), "y": _round(y), "z": 0.8},
        "center": {"x": 0, "y": 0, "z": -0.12},
        "up": {"x": 0, "y": 0, "z": 1},
    }


def _trace(rows: Rows, mode: str, name: str, **more: Any) -> dict[str, Any]:
    x, y, z = ([row[k] for row in rows] for k in range(3))
    return {"type": "scatter3d", "mode": mode, "name": name, "x": x, "y": y, "z": z, **more}


def _round(value: float) -> float:
    return float(f"{value:.5g}") + 0.0


def plan_and_side(figure: RigFigure) -> str:
    """Plan and side view to scale as SVG, for printing and without scripts."""
    views = [_view(figure, 0, 1, "From above"), _view(figure, 0, 2, "From the side")]
    return f'<div class="views">{"".join(views)}</div>'


def _view(figure: RigFigure, first: int, second: int, title: str) -> str:
    everything = np.concatenate([*figure.cameras.values(), *figure.paths])
    low, high = everything.min(axis=0), everything.max(axis=0)
    width, pad = 490.0, 46.0
    span = np.maximum(high - low, 1e-9)
    across = max(float(span[0]), 0.3 * float(span.max()))
    scale = min((width - 2 * pad) / across, 380.0 / float(span.max()))
    height = max(float(span[second]) * scale, 60.0) + 2 * pad + 16
    middle = 0.5 * (low + high)

    def place(rows: Floats) -> tuple[Floats, Floats]:
        return width / 2 + scale * (rows[:, first] - middle[first]), height / 2 - 8 - scale * (
            rows[:, second] - middle[second]
        )

    parts = [f'<rect class="image" x="0.5" y="0.5" width="{at(width - 1)}" height="{at(height - 1)}"/>']
    for path in figure.paths:
        x, y = place(path)
        parts.append(f'<polyline class="track" points="{points(x, y)}"/>')
    for corners in figure.cameras.values():
        x, y = place(corners)
        parts.append(f'<polygon class="frustum" points="{points(x[1:], y[1:])}"/>')
        parts += [line(x[0], y[0], x[i], y[i], "frustumline") for i in range(1, 5)]
        parts.append(f'<circle class="estimate" cx="{at(x[0])}" cy="{at(y[0])}" r="3"/>')
    taken: list[tuple[float, float]] = []
    for name, corners in figure.cameras.items():
        x, y = place(corners)
        # The label is placed away from the viewing direction, unless another label is there.
        tries = [17.0, -9.0, 33.0, -25.0, 49.0, -41.0]
        if y[1:].mean() > y[0] + 1:
            tries[0], tries[1] = tries[1], tries[0]
        wide = 8.5 * len(name)
        free = [t for t in tries if not any(abs(x[0] - a) < wide and abs(y[0] + t - b) < 14 for a, b in taken)]
        spot = float(y[0]) + (free[0] if free else tries[0])
        taken.append((float(x[0]), spot))
        parts.append(text(x[0], spot, name, "halo strong", "middle"))
    if figure.paths:
        x, y = place(np.array([figure.paths[0][0], figure.paths[-1][-1]]))
        parts.append(f'<circle class="start" cx="{at(x[0])}" cy="{at(y[0])}" r="4.5"/>')
        parts.append(f'<path class="end" d="M{at(x[1] - 5)} {at(y[1])}l5 -5 5 5 -5 5z"/>')
    bar = round_below((width / 4) / scale)
    parts.append(line(14, height - 14, 14 + bar * scale, height - 14, "scalebar"))
    parts.append(
        text(14, height - 20, f"{number(bar, max(0, -math.floor(math.log10(bar) + 1e-9)))}{THIN}{figure.unit}", "tick")
    )
    parts.append(text(width - 12, height - 14, f"{figure.axes[first]} →  {figure.axes[second]} ↑", "tick", "end"))
    return f"<figure>{drawing(width, height, parts, title)}<figcaption><b>{title}</b></figcaption></figure>"
