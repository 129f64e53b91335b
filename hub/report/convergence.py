"""Convergence figures: residual per step of the bundle adjustment, and std of the clock offsets over a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hub.report.svg import THIN, at, drawing, line, number, points, short, text, time_axis
from protocols.session.calibration import AdjustmentStep

_WIDTH, _LEFT, _RIGHT, _HEIGHT = 1000.0, 84.0, 190.0, 250.0  # px of the drawing, and of its margins
_DASHES = ("", "9 4", "2 4", "14 4 2 4", "5 2", "1 3")


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
    inner, bottom, top = _WIDTH - _LEFT - _RIGHT, _HEIGHT - 38, 10.0

    def y(std: float) -> float:
        return bottom - (bottom - top) * (math.log10(std) - low) / max(high - low, 1)

    parts = time_axis(begin, end, _LEFT, inner, top, bottom)
    for power in range(low, high + 1):
        parts.append(line(_LEFT, y(10.0**power), _LEFT + inner, y(10.0**power), "grid"))
        parts.append(text(_LEFT - 8, y(10.0**power) + 4, f"{10.0**power:g}{THIN}ms", "tick", "end"))
    ends: list[tuple[float, str, float]] = []
    for index, (name, steps) in enumerate(series.items()):
        x = [_LEFT + inner * (moment - begin) / max(end - begin, 1e-9) for moment, _ in steps]
        heights = [y(std) for _, std in steps]
        dash = _DASHES[index % len(_DASHES)]
        style = f' stroke-dasharray="{dash}"' if dash else ""
        parts.append(f'<polyline class="median"{style} points="{points(x, heights)}"/>')
        ends.append((heights[-1], name, steps[-1][1]))
    place = -math.inf
    for height, name, std in sorted(ends):
        place = max(height, place + 15)  # labels do not overlap
        label = f"{name} ±{THIN}{short(std, figures=2)}{THIN}ms"
        parts.append(text(_LEFT + inner + 10, place + 4, label, "tick"))
    parts.append(text(_LEFT + inner / 2, _HEIGHT - 6, "seconds since the recording began", "tick", "middle"))
    first = number(series[next(iter(series))][0][0], 1)
    return drawing(
        _WIDTH, max(_HEIGHT, place + 10), parts, f"Std of the clock offsets after each calibration, from {first} s on"
    )


_STAGES = {
    "first poses": "cameras added",
    "robust": "all rows, robust",
    "fitting rows": "inlier rows",
    "free lenses": "free intrinsics",
    "correlated noise": "correlated noise",
}


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
    inner, bottom, top = _WIDTH - _LEFT - 30.0, _HEIGHT - 38, 26.0

    def x(index: int) -> float:
        return _LEFT + 12.0 + (inner - 24.0) * index / (len(steps) - 1)

    def y(residual: float) -> float:
        return bottom - (bottom - top) * (math.log10(residual) - low) / (high - low)

    parts = []
    for level in levels:
        parts.append(line(_LEFT, y(level), _LEFT + inner, y(level), "grid"))
        parts.append(text(_LEFT - 8, y(level) + 4, f"{level:g}{THIN}px", "tick", "end"))
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
    parts.append(text(_LEFT + inner / 2, _HEIGHT - 12, f"{len(steps)} steps of the adjustment", "tick", "middle"))
    return drawing(
        _WIDTH, _HEIGHT, parts, f"Residual after each of {len(steps)} steps of the adjustment, {last} px at the end"
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
