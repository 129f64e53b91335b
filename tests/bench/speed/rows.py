"""One comparison: what ours costs, what the other costs on the same work in the same run, and the required limits."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

FELL = 0.8
"""A ratio below this share of the kept one is shown."""


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit on ours itself (in its unit) or on the ratio. Which side is meant follows from the row."""

    of: Literal["ours", "ratio"]
    value: float


@dataclass(frozen=True, slots=True)
class Row:
    """ours, theirs: in ``unit``. less: whether less is better. beside: what the other is; None = nothing but a limit.

    must, reach: limits. note: what one must know to read the figures.
    """

    work: str
    ours: float
    unit: str
    beside: str = ""
    theirs: float | None = None
    less: bool = True
    must: Limit | None = None
    reach: Limit | None = None
    note: str = ""

    @property
    def key(self) -> str:
        """Names the row in what is kept."""
        return f"{self.work} | {self.beside}" if self.beside else self.work

    @property
    def ratio(self) -> float | None:
        """How many times better than the other: above 1 we are ahead."""
        if self.theirs is None or not min(self.ours, self.theirs) > 0.0:
            return None
        return self.theirs / self.ours if self.less else self.ours / self.theirs

    def kept(self) -> dict[str, Any]:
        """What later runs are compared with."""
        kept = {"ours": self.ours, "theirs": self.theirs, "unit": self.unit, "ratio": self.ratio}
        return {**kept, "met": self.holds(self.must)}

    def holds(self, limit: Limit | None) -> bool | None:
        """Whether a limit is kept; None where there is none, or nothing to compare with."""
        if limit is None:
            return None
        if limit.of == "ratio":
            return None if self.ratio is None else self.ratio >= limit.value
        return self.ours <= limit.value if self.less else self.ours >= limit.value

    def formatted(self, limit: Limit | None) -> str:
        """A limit as it is printed."""
        if limit is None:
            return ""
        if limit.of == "ratio":
            return f"≥ {limit.value:.3g}×"
        return f"{'≤' if self.less else '≥'} {number(limit.value)} {self.unit}"


@dataclass(slots=True)
class Section:
    """What one section found. missing: comparisons that were not made, and why."""

    rows: list[Row] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """For the process that prints the table."""
        return {"rows": [asdict(row) for row in self.rows], "missing": self.missing}

    @staticmethod
    def from_json(found: dict[str, Any]) -> Section:
        """What ``as_json`` wrote."""
        rows = []
        for row in found["rows"]:
            limits = {name: Limit(**row[name]) if row[name] else None for name in ("must", "reach")}
            rows.append(Row(**{**row, **limits}))
        return Section(rows, list(found["missing"]))


def number(value: float) -> str:
    """Three figures, without an exponent."""
    if value >= 1000.0:
        return f"{value:,.0f}"
    return f"{value:.3g}" if value < 100.0 else f"{value:.0f}"


def table(rows: Sequence[Row]) -> str:
    """The table, as Markdown that can be read as it is."""
    head = ("work", "ours", "beside", "its", "ratio", "must", "met", "reach for")
    lines = [head]
    for row in rows:
        met = row.holds(row.must)
        lines.append(
            (
                row.work,
                f"{number(row.ours)} {row.unit}",
                row.beside or "–",
                "" if row.theirs is None else f"{number(row.theirs)} {row.unit}",
                "" if row.ratio is None else f"{number(row.ratio)}×",
                row.formatted(row.must),
                {None: "", True: "yes", False: "**no**"}[met],
                row.formatted(row.reach) + ("" if row.holds(row.reach) is not True else " ✓"),
            )
        )
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    padded = [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    text = [f"| {' | '.join(line)} |" for line in padded]
    text.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    notes = [f"- {row.key}: {row.note}" for row in rows if row.note]
    return "\n".join([*text, "", *notes]) if notes else "\n".join(text)


def fallen(rows: Sequence[Row], kept: dict[str, Any]) -> list[str]:
    """Rows whose ratio is by a fifth or more below the kept one; without a ratio, ours itself is compared."""
    out = []
    for row in rows:
        before = kept.get(row.key)
        if before is None:
            continue
        if row.ratio is not None and before.get("ratio"):
            if row.ratio < FELL * before["ratio"]:
                out.append(f"{row.key}: {number(row.ratio)}×, was {number(before['ratio'])}×")
        elif row.theirs is None and before.get("ours"):
            share = before["ours"] / row.ours if row.less else row.ours / before["ours"]
            if share < FELL:
                out.append(f"{row.key}: {number(row.ours)} {row.unit}, was {number(before['ours'])} {row.unit}")
    return out


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    import cv2
    import numpy as np
    import scipy

    model = ""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else ""
    return {
        "machine": platform.machine(),
        "processor": model,
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "opencv": cv2.__version__,
        "load_at_begin": round(os.getloadavg()[0], 2),
    }


def cpu_of(work: Callable[[], object]) -> float:
    """CPU seconds of this process for one call."""
    began = time.process_time()
    work()
    return time.process_time() - began


def interleaved(methods: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Least CPU seconds of each method over some rounds, one after the other in each: what else runs hits all alike."""
    best = dict.fromkeys(methods, float("inf"))
    for _ in range(rounds):
        for name, method in methods.items():
            best[name] = min(best[name], cpu_of(method))
    return best
