"""How the answer settled while the cameras filmed: each clock's std after every calibration of a live hub."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hub.report.svg import THIN, drawing, line, number, points, short, text, time_axis

_WIDTH, _LEFT, _RIGHT, _HEIGHT = 1000.0, 84.0, 190.0, 250.0
_DASHES = ("", "9 4", "2 4", "14 4 2 4", "5 2", "1 3")


@dataclass(frozen=True, slots=True)
class Step:
    """One calibration of a recorded hub: seconds since the log began, and the std of each camera's offset [s]."""

    seconds: float
    time_offset_std: dict[str, float]


def convergence(history: tuple[Step, ...], reference: str) -> str:
    """The stds over time on a logarithmic scale, a line of its own dashes a camera; "" for fewer than two answers."""
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
        place = max(height, place + 15)  # names do not lie over each other
        label = f"{name} ±{THIN}{short(std, figures=2)}{THIN}ms"
        parts.append(text(_LEFT + inner + 10, place + 4, label, "tick"))
    parts.append(text(_LEFT + inner / 2, _HEIGHT - 6, "seconds since the recording began", "tick", "middle"))
    first = number(series[next(iter(series))][0][0], 1)
    return drawing(_WIDTH, max(_HEIGHT, place + 10), parts, f"Std of the clocks after every answer, from {first} s on")
