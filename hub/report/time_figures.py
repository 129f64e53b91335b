"""Figures over time: time offsets with 95 % intervals, residuals over the session, visibility of the point.

And the convergence: residual per step of the bundle adjustment, and std of the clock offsets over a recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hub.report import measures
from hub.report.measures import RowUsage, Span
from hub.report.quality_assessment import half_interval_ms
from hub.report.svg import THIN, at, drawing, line, number, points, rect, short, text, tick_text, ticks, time_axis
from protocols.geometry.types import Floats
from protocols.session.calibration import AdjustmentStep, Calibration
from protocols.session.observations import Observations

_WIDTH, _LEFT, _RIGHT = 1000.0, 130.0, 16.0  # px of the drawing, and of its margins
_MAX_SPANS = 400  # drawn per camera; long recordings have more
_TIME_BINS, _ROWS_A_BIN = 250, 8  # largest number of bins; rows per bin for meaningful quantiles

_INDENT, _KEYS, _HEIGHT = 84.0, 190.0, 250.0  # px: margins of the axis and of the names, and the drawing
_DASHES = ("", "9 4", "2 4", "14 4 2 4", "5 2", "1 3")
_STAGES = {
    "first poses": "cameras added",
    "robust": "all rows, robust",
    "fitting rows": "inlier rows",
    "free lenses": "free intrinsics",
    "correlated noise": "correlated noise",
}


def offset_intervals(calibration: Calibration, used: dict[str, RowUsage]) -> str:
    """Each camera's time offset with its 95 % interval around the estimate, on a common scale in milliseconds."""
    names = list(calibration.cameras)
    halves = {name: half_interval_ms(calibration.cameras[name]) for name in names}
    finite = [half for half in halves.values() if np.isfinite(half)]
    reach = 1.15 * max([*finite, 0.05])
    left, right = 270.0, 210.0
    inner, row = _WIDTH - left - right, 30.0
    height = row * len(names) + 44

    def x(ms: float) -> float:
        return left + inner * (0.5 + 0.5 * ms / reach)

    bottom = row * len(names) + 8
    parts = []
    values = ticks(-reach, reach, 8)
    for value in values:
        parts.append(line(x(value), 4, x(value), bottom, "zero" if abs(value) < 1e-12 else "grid"))
        parts.append(text(x(value), bottom + 15, tick_text(value, values), "tick", "middle"))
    parts.append(text(x(0), bottom + 31, "milliseconds around the estimate", "tick", "middle"))
    for index, name in enumerate(names):
        y = 8 + row * (index + 0.5)
        camera, half = calibration.cameras[name], halves[name]
        parts.append(text(0, y + 4, name, "rowname"))
        parts.append(text(left - 20, y + 4, f"{number(camera.lag, 6, sign=True)}{THIN}s", "figure", "end"))
        if name == calibration.reference:
            parts.append(f'<path class="diamond" d="M{x(0) - 6:.1f} {y:.1f}l6 -6 6 6 -6 6z"/>')
            parts.append(text(_WIDTH - right + 16, y + 4, "reference: exact", "tick"))
            continue
        if not np.isfinite(half):
            parts.append(text(_WIDTH - right + 16, y + 4, "unknown", "tick"))
            continue
        parts.append(line(x(-half), y, x(half), y, "whisker"))
        parts += [line(x(side), y - 6, x(side), y + 6, "whisker") for side in (-half, half)]
        parts.append(f'<circle class="estimate" cx="{x(0):.1f}" cy="{y:.1f}" r="4.5"/>')
        interval = 1e3 * used[name].interval
        share = f" ({100 * half / interval:.1f}{THIN}% of a frame)" if interval > 0 else ""
        parts.append(text(_WIDTH - right + 16, y + 4, f"±{THIN}{short(half, figures=2)}{THIN}ms{share}", "tick"))
    return drawing(_WIDTH, height, parts, "Lag of each camera at mid-overlap with its 95 % interval")


def residuals_over_time(calibration: Calibration) -> str:
    """Median residual and the 10 to 90 % band, one strip per camera, on the reference clock."""
    series: dict[str, tuple[Floats, Floats]] = {}
    for name, camera in calibration.cameras.items():
        rows = calibration.residuals.get(name)
        if rows is not None and len(rows):
            order = np.argsort(rows[:, 0], kind="stable")
            clock = camera.time_map
            time = clock.clock_rate * rows[order, 0] + clock.time_offset
            series[name] = time, np.hypot(rows[order, 3], rows[order, 4])
    if not series:
        return ""
    low = min(time[0] for time, _ in series.values())
    high = max(max(time[-1] for time, _ in series.values()), low + 1e-3)
    top = max(float(np.quantile(norms, 0.98)) for _, norms in series.values())
    top = max(top, 1e-3) * 1.1
    strip, gap = (72.0, 22.0) if len(series) <= 8 else (40.0, 12.0)
    height = (strip + gap) * len(series) - gap + 52
    inner = _WIDTH - _LEFT - _RIGHT
    parts = time_axis(low, high, _LEFT, inner, 8, height - 38)
    for index, (name, (time, norms)) in enumerate(series.items()):
        base = (strip + gap) * index + strip + 8
        values = ticks(0, top, 3 if strip > 60 else 1)
        for value in values:
            y = base - strip * value / top
            parts.append(line(_LEFT, y, _WIDTH - _RIGHT, y, "grid"))
            parts.append(text(_LEFT - 8, y + 4, tick_text(value, values), "tick", "end"))
        parts.append(text(0, base - strip / 2 + 4, name, "rowname"))
        parts += _band(time, norms, low, high, base, strip, top)
    parts.append(text(_LEFT + inner / 2, height - 6, "seconds on the reference clock", "tick", "middle"))
    return drawing(_WIDTH, height, parts, "Residual of each camera over time")


def _band(time: Floats, norms: Floats, low: float, high: float, base: float, strip: float, top: float) -> list[str]:
    """Band and median of one camera, interrupted where it has no rows."""
    cells = int(np.clip(len(time) / _ROWS_A_BIN, 20, _TIME_BINS))
    width = (high - low) / cells
    number_of = np.clip(((time - low) / width).astype(np.int64), 0, cells - 1)
    bins, starts = np.unique(number_of, return_index=True)
    ordered = norms[np.lexsort((norms, number_of))]
    place = starts[:, None] + np.outer(np.diff(np.r_[starts, len(norms)]) - 1, [0.1, 0.5, 0.9])
    low_row = np.floor(place).astype(np.int64)
    levels = ordered[low_row] + (place - low_row) * (ordered[np.ceil(place).astype(np.int64)] - ordered[low_row])
    inner = _WIDTH - _LEFT - _RIGHT
    x = _LEFT + inner * (bins + 0.5) / cells
    y = base - strip * np.minimum(levels / top, 1.0)
    out = []
    for run in np.split(np.arange(len(bins)), np.flatnonzero(np.diff(bins) > 1 + 0.5 / width) + 1):
        if len(run) == 1:
            out.append(line(x[run[0]], y[run[0], 0], x[run[0]], y[run[0], 2], "bandline"))
            out.append(line(x[run[0]] - 1, y[run[0], 1], x[run[0]] + 1, y[run[0], 1], "median"))
            continue
        around = points(np.r_[x[run], x[run][::-1]], np.r_[y[run, 0], y[run, 2][::-1]])
        out.append(f'<polygon class="band" points="{around}"/>')
        out.append(f'<polyline class="median" points="{points(x[run], y[run, 1])}"/>')
    return out


def time_line(calibration: Calibration, observations: Observations) -> str:
    """Visibility of the point by camera, by two or more cameras, and trajectory coverage, on the reference clock."""
    seen = measures.seen_on_reference(calibration, observations)
    rows: list[tuple[str, list[Span], str]] = [(name, intervals, "bar") for name, intervals in seen.items()]
    rows.append(("two or more", measures.shared_spans(list(seen.values())), "bar both"))
    path = [table.time for table in calibration.trajectories if len(table.time)]
    if path:
        step = max(float(np.median(np.diff(time))) if len(time) > 1 else 0.1 for time in path)
        rows.append(("3-D path", measures.spans(np.concatenate(path), max(0.1, 2.5 * step)), "bar path"))
    return _bars(rows, "seconds on the reference clock", "Visibility of the point by camera")


def own_time_lines(rows: dict[str, Floats]) -> str:
    """Visibility of the point, each camera on its own clock from its first row; rows: time, u, v by camera."""
    bars: list[tuple[str, list[Span], str]] = [
        (name, measures.spans(seen[:, 0] - seen[:, 0].min()) if len(seen) else [], "bar") for name, seen in rows.items()
    ]
    return _bars(bars, "seconds since each camera’s own first row", "When each camera saw the point")


def _bars(rows: list[tuple[str, list[Span], str]], axis: str, label: str) -> str:
    every = [span for _, intervals, _ in rows for span in intervals]
    if not every:
        return ""
    low = min(begin for begin, _ in every)
    high = max(max(end for _, end in every), low + 1e-3)
    row, inner = 26.0, _WIDTH - _LEFT - _RIGHT - 60
    bottom = row * len(rows) + 4
    height = bottom + 38
    parts = time_axis(low, high, _LEFT, inner, 0, bottom)
    for index, (name, intervals, kind) in enumerate(rows):
        y = row * index + 5
        parts.append(text(0, y + 13, name, "rowname"))
        parts.append(line(_LEFT, y + 9, _LEFT + inner, y + 9, "grid"))
        chosen = [intervals[i] for i in measures.thinned_indices(len(intervals), _MAX_SPANS)]
        for begin, end in chosen:
            x = _LEFT + inner * (begin - low) / (high - low)
            width = max(inner * (end - begin) / (high - low), 1.2)
            parts.append(rect(x, y, width, 18, kind, f"{name}: {begin:.2f} s to {end:.2f} s"))
        parts.append(text(_WIDTH - _RIGHT, y + 13, f"{short(measures.total_length(intervals))}{THIN}s", "tick", "end"))
    parts.append(text(_LEFT + inner / 2, height - 6, axis, "tick", "middle"))
    return drawing(_WIDTH, height, parts, label)


@dataclass(frozen=True, slots=True)
class OffsetStdSample:
    """One calibration in a log: seconds since its start, and the std of each camera's time offset [s]."""

    seconds: float
    time_offset_std: dict[str, float]


def offset_std_history(history: tuple[OffsetStdSample, ...], reference: str) -> str:
    """The offset stds over time on a log scale, one dashed line per camera; "" for fewer than two calibrations."""
    names = sorted({name for step in history for name in step.time_offset_std if name != reference})
    series = {
        name: [
            (step.seconds, 1e3 * step.time_offset_std[name])
            for step in history
            if step.time_offset_std.get(name, 0.0) > 0.0
        ]
        for name in names
    }
    series = {name: steps for name, steps in series.items() if len(steps) > 1}
    if not series:
        return ""
    every = [std for steps in series.values() for _, std in steps]
    low, high = math.floor(math.log10(min(every))), math.ceil(math.log10(max(every)) + 1e-9)
    begin = min(steps[0][0] for steps in series.values())
    end = max(steps[-1][0] for steps in series.values())
    inner, bottom, top = _WIDTH - _INDENT - _KEYS, _HEIGHT - 38, 10.0

    def y(std: float) -> float:
        return bottom - (bottom - top) * (math.log10(std) - low) / max(high - low, 1)

    parts = time_axis(begin, end, _INDENT, inner, top, bottom)
    for power in range(low, high + 1):
        parts.append(line(_INDENT, y(10.0**power), _INDENT + inner, y(10.0**power), "grid"))
        parts.append(text(_INDENT - 8, y(10.0**power) + 4, f"{10.0**power:g}{THIN}ms", "tick", "end"))
    ends: list[tuple[float, str, float]] = []
    for index, (name, steps) in enumerate(series.items()):
        x = [_INDENT + inner * (moment - begin) / max(end - begin, 1e-9) for moment, _ in steps]
        heights = [y(std) for _, std in steps]
        dash = _DASHES[index % len(_DASHES)]
        style = f' stroke-dasharray="{dash}"' if dash else ""
        parts.append(f'<polyline class="median"{style} points="{points(x, heights)}"/>')
        ends.append((heights[-1], name, steps[-1][1]))
    place = -math.inf
    for height, name, std in sorted(ends):
        place = max(height, place + 15)  # labels do not overlap
        label = f"{name} ±{THIN}{short(std, figures=2)}{THIN}ms"
        parts.append(text(_INDENT + inner + 10, place + 4, label, "tick"))
    parts.append(text(_INDENT + inner / 2, _HEIGHT - 6, "seconds since the recording began", "tick", "middle"))
    first = number(series[next(iter(series))][0][0], 1)
    return drawing(
        _WIDTH,
        max(_HEIGHT, place + 10),
        parts,
        f"Std of the clock offsets after each calibration, from {first} s on",
    )


def adjustment_history(steps: tuple[AdjustmentStep, ...]) -> str:
    """The residual after each step of the last bundle adjustment, on a logarithmic scale; "" for fewer than two.

    A new line starts where rows and noise are reweighted. Each stage has its own marker and label.
    """
    steps = tuple(step for step in steps if math.isfinite(step.residual_px) and step.residual_px > 0.0)
    if len(steps) < 2:
        return ""
    values = [step.residual_px for step in steps]
    levels = _levels(min(values), max(values))
    low, high = math.log10(levels[0]), math.log10(levels[-1])
    inner, bottom, top = _WIDTH - _INDENT - 30.0, _HEIGHT - 38, 26.0

    def x(index: int) -> float:
        return _INDENT + 12.0 + (inner - 24.0) * index / (len(steps) - 1)

    def y(residual: float) -> float:
        return bottom - (bottom - top) * (math.log10(residual) - low) / (high - low)

    parts = []
    for level in levels:
        parts.append(line(_INDENT, y(level), _INDENT + inner, y(level), "grid"))
        parts.append(text(_INDENT - 8, y(level) + 4, f"{level:g}{THIN}px", "tick", "end"))
    stages = list(dict.fromkeys(step.stage for step in steps))
    begin = 0
    for index, step in enumerate(steps):
        if index and step.stage == steps[index - 1].stage:
            continue
        if index:
            middle = (x(index - 1) + x(index)) / 2
            ends = f'x1="{at(middle)}" y1="{at(top)}" x2="{at(middle)}" y2="{at(bottom)}"'
            parts.append(f'<line class="grid" {ends} stroke-dasharray="4 4"/>')
        side = "end" if index == len(steps) - 1 else "start"  # the label of the last step would leave the page
        parts.append(text(x(index), top - 10, _STAGES.get(step.stage, step.stage), "tick", side))
    for index in range(1, len(steps) + 1):
        # A reweighted round starts from the same state with another residual: no line connects them.
        if (
            index == len(steps)
            or steps[index].residual_px >= values[index - 1]
            or (steps[index].stage != steps[index - 1].stage)
        ):
            run = range(begin, index)
            parts.append(
                f'<polyline class="median" points="{points([x(i) for i in run], [y(values[i]) for i in run])}"/>'
            )
            begin = index
    for index, step in enumerate(steps):
        parts.append(_mark(x(index), y(step.residual_px), stages.index(step.stage)))
    last = number(values[-1], 3)
    parts.append(text(x(len(steps) - 1), y(values[-1]) - 10, f"{last}{THIN}px", "tick", "end"))
    parts.append(text(_INDENT + inner / 2, _HEIGHT - 12, f"{len(steps)} steps of the adjustment", "tick", "middle"))
    return drawing(
        _WIDTH,
        _HEIGHT,
        parts,
        f"Residual after each of {len(steps)} steps of the adjustment, {last} px at the end",
    )


def _levels(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from below ``low`` to above ``high``; at least two."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1
    steps = [step * 10.0**power for power in range(first, last + 1) for step in (1.0, 2.0, 5.0)]
    begin = max(index for index, step in enumerate(steps) if step <= low)
    end = min(index for index, step in enumerate(steps) if step >= high and index > begin)
    return steps[begin : end + 1]


def _mark(x: float, y: float, kind: int) -> str:
    """A circle, square or diamond marker."""
    if kind % 3 == 0:
        return f'<circle class="dot" cx="{at(x)}" cy="{at(y)}" r="3.5"/>'
    turn = f' transform="rotate(45 {at(x)} {at(y)})"' if kind % 3 == 2 else ""
    return f'<rect class="dot" x="{at(x - 3.2)}" y="{at(y - 3.2)}" width="6.4" height="6.4"{turn}/>'
