"""SVG and HTML elements: escaped text, formatted numbers, axes. All output is deterministic."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable

from protocols.geometry.types import Floats

MINUS = "\u2212"
THIN = "\u202f"  # narrow no-break space, between a number and its unit


def esc(text: object) -> str:
    """Text for HTML, also inside attributes."""
    return html.escape(str(text), quote=True)


def number(value: float | None, digits: int = 3, *, sign: bool = False) -> str:
    """A number with ``digits`` decimals and a typographic minus; "–" if None or not finite."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"
    if float(text) == 0.0:
        text = text.lstrip("+-")
    return text.replace("-", MINUS)


def short(value: float | None, *, sign: bool = False, figures: int = 3) -> str:
    """A number with about ``figures`` significant figures, without exponent."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    digits = 0 if size >= 10 ** (figures - 1) else figures - 1
    if 0 < size < 1:
        digits = min(figures - 1 - math.floor(math.log10(size)), 7)
    elif size >= 1:
        digits = max(figures - 1 - math.floor(math.log10(size)), 0)
    return number(value, digits, sign=sign)


def whole(value: int) -> str:
    """An integer with thousands separators."""
    return f"{value:,}".replace(",", THIN)


def at(value: float) -> str:
    """A drawing coordinate, to a tenth of a pixel."""
    text = f"{value:.1f}"
    text = text.removesuffix(".0")
    return "0" if text == "-0" else text


def points(x: Floats | Iterable[float], y: Floats | Iterable[float]) -> str:
    """The points of a polyline."""
    return " ".join(f"{at(a)},{at(b)}" for a, b in zip(x, y, strict=True))


def ticks(low: float, high: float, about: int = 6) -> list[float]:
    """Round numbers in [low, high], about ``about`` of them."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low] if math.isfinite(low) else []
    raw = span / max(about, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def round_below(value: float) -> float:
    """The largest of 1, 2, 5, 10, … that is no more than ``value`` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(factor * power for factor in (5, 2, 1) if factor * power <= value * (1 + 1e-9))


def tick_text(value: float, values: list[float]) -> str:
    """A tick's label with as many decimals as its neighbours need."""
    step = abs(values[1] - values[0]) if len(values) > 1 else abs(value) or 1.0
    return number(value, max(0, -math.floor(math.log10(step) + 1e-9)))


def line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    """A line with a CSS class of the style sheet."""
    return f'<line class="{kind}" x1="{at(x1)}" y1="{at(y1)}" x2="{at(x2)}" y2="{at(y2)}"/>'


def rect(x: float, y: float, width: float, height: float, kind: str, title: str = "") -> str:
    """A rectangle with an optional tooltip."""
    shape = f'<rect class="{kind}" x="{at(x)}" y="{at(y)}" width="{at(width)}" height="{at(height)}"'
    return f"{shape}><title>{esc(title)}</title></rect>" if title else f"{shape}/>"


def text(x: float, y: float, content: str, kind: str = "", anchor: str = "start") -> str:
    """Text at a baseline; anchor: start, middle or end."""
    style = f' class="{kind}"' if kind else ""
    place = "" if anchor == "start" else f' text-anchor="{anchor}"'
    return f'<text{style}{place} x="{at(x)}" y="{at(y)}">{esc(content)}</text>'


def drawing(width: float, height: float, parts: Iterable[str], label: str, max_width: float = 0.0) -> str:
    """A complete SVG that scales with its column, up to ``max_width`` pixels wide (0: any).

    label: text for screen readers.
    """
    limit = f' style="max-width:{at(max_width)}px"' if max_width else ""
    frame = f'<svg viewBox="0 0 {at(width)} {at(height)}"{limit} role="img" aria-label="{esc(label)}">'
    return f"{frame}{''.join(parts)}</svg>"


def time_axis(low: float, high: float, left: float, width: float, top: float, bottom: float) -> list[str]:
    """Grid lines and labels of a horizontal axis in seconds."""
    parts = []
    values = ticks(low, high, 8)
    for value in values:
        x = left + width * (value - low) / max(high - low, 1e-12)
        parts.append(line(x, top, x, bottom, "grid"))
        parts.append(text(x, bottom + 15, tick_text(value, values), "tick", "middle"))
    return parts
