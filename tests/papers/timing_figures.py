"""The paper's figures 11 to 17 as PNG, with the default method beside figure 13.

Every figure keeps the paper's number in its title and reads without colour: markers, line styles and labels at the
lines carry what colour carries too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from tests.papers.timing_real import SHOWN, RealRun, misfit
from tests.papers.timing_rig import DURATION, PERIOD, TRAJECTORIES, LagResult, film

Comparison = Mapping[tuple[str, str], Sequence[LagResult]]
"""Results by (trajectory, name of the method and its tracks)."""

_INK, _GREY, _RED, _BLUE = "#202020", "#8a8a8a", "#c03a00", "#0060a8"
_STYLES: Sequence[dict[str, Any]] = (
    {"color": _RED, "marker": "o", "mfc": "none", "ls": "-", "lw": 0.5, "ms": 5},
    {"color": _RED, "marker": "x", "ls": ":", "lw": 0.6, "ms": 5.5},
    {"color": _BLUE, "marker": "s", "mfc": "none", "ls": "-", "lw": 0.5, "ms": 5},
    {"color": _BLUE, "marker": "+", "ls": ":", "lw": 0.6, "ms": 7},
)
_REFUSED: dict[str, Any] = {"color": _INK, "marker": "D", "mfc": "none", "ls": "", "ms": 8.5, "mew": 0.8}
_REFUSED_LABEL = "refused: its best alignment"
_FLOORS = (1e-3, 1e-3)  # ms and px below which an error is drawn at the edge
_SUBJECT = {"1": "trajectory 1, eq. (24)", "a": "trajectory (a)", "b": "trajectory (b)", "c": "trajectory (c)"}
_DPI, _COLOURS = 80, 64
_LEAST_E = 3e-3  # px at which figure 12 ends
_FOUND: dict[str, Any] = {"color": _GREY, "ls": "-", "lw": 0.7, "marker": ".", "ms": 3}
_WHOLE: dict[str, Any] = {"color": _BLUE, "ls": ":", "lw": 1.4, "marker": "s", "ms": 4, "mfc": "none"}
_WRONG: dict[str, Any] = {"color": _RED, "ls": "--", "lw": 1.8, "marker": "x", "ms": 6}


def residuals(out: Path, results: Sequence[LagResult]) -> Path:
    """Figures 11 and 12: E(n) against the iteration, one line a lag; the whole and, logarithmic, the detail near 0."""
    figure, (whole, detail) = plt.subplots(1, 2, figsize=(12.0, 4.9), layout="constrained")
    last = 10
    for axes in (whole, detail):
        for result in results:
            n = np.arange(min(len(result.distances), last + 1))
            style = _WRONG if not result.right else _WHOLE if _whole_frames(result.tau) else _FOUND
            axes.plot(n, np.maximum(np.array(result.distances)[n], _LEAST_E), **style)
        axes.set(xlabel="iteration n", ylabel="E(n), mean distance from the epipolar lines [px]", xlim=(0, last))
        axes.grid(alpha=0.25)
    for result in results:
        if result.right and round(100 * result.tau) in (1, 5, 10, 15, 20, 25):
            whole.annotate(f"lag {result.tau:.2f} s", (0, result.distances[0]), (-4, 0), **_beside("right"))
    wrong = [result for result in results if not result.right]
    if wrong:
        text = "\n".join(f"lag {result.tau:.2f} s: {1e3 * result.tau_error:+.0f} ms off" for result in wrong)
        end = wrong[0].distances[: last + 1]
        whole.annotate(text, (len(end) - 1, end[-1]), (14, 0), **_beside("left", _RED))
    whole.tick_params(axis="y", pad=52)
    whole.set(title=f"Figure 11: trajectory 1, all {len(results)} lags from 0.01 to 0.39 s", ylim=(0, None))
    detail.set(title="Figure 12: detail near 0, here on a logarithmic axis", yscale="log", ylim=(_LEAST_E, 2e3))
    detail.plot([], [], **_FOUND, label="lag found within 5 ms, F within 2 px")
    detail.plot([], [], **_WHOLE, label="found; a lag of whole frames, nothing to interpolate")
    detail.plot([], [], **_WRONG, label="converges to a wrong result")
    detail.legend(loc="upper right", fontsize=9)
    return _save(figure, out / "timing_paper_fig11_12.png")


def errors(out: Path, comparison: Comparison, methods: Sequence[str]) -> Path:
    """Figure 13 for all four trajectories: errors of tau and F against the lag, both methods."""
    figure, axes = plt.subplots(2, 4, figsize=(13.5, 6.4), sharex=True, sharey="row", layout="constrained")
    for column, name in enumerate(TRAJECTORIES):
        for style, method in zip(_STYLES, methods, strict=True):
            results = comparison.get((name, method), ())
            lags = [r.tau for r in results]
            _log(axes[0, column], lags, [1e3 * abs(r.tau_error) for r in results], _FLOORS[0], style, method)
            _log(axes[1, column], lags, [r.f_error for r in results], _FLOORS[1], style, method)
            refused = [r for r in results if r.refused]
            both = [1e3 * abs(r.tau_error) for r in refused], [r.f_error for r in refused]
            for axis, values, floor in zip(axes[:, column], both, _FLOORS, strict=True):
                _log(axis, [r.tau for r in refused], values, floor, _REFUSED, _REFUSED_LABEL)
        axes[0, column].set_title(_SUBJECT[name])
        axes[1, column].set_xlabel("true lag [s]")
        for row in range(2):
            axes[row, column].axvline(0.32, color=_INK, lw=0.9, ls="-.") if name == "1" else None
            axes[row, column].grid(alpha=0.25)
    axes[0, 0].axhline(0.1, color=_INK, lw=0.9, ls="--")
    axes[1, 0].axhline(0.2, color=_INK, lw=0.9, ls="--")
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
    axes[0, 0].text(0.005, 12.0, "paper: under 0.1 ms (- -)", fontsize=8, bbox=box)
    axes[1, 0].text(0.005, 1.2, "paper: under 0.2 px (- -)", fontsize=8, bbox=box)
    axes[0, 0].text(0.312, 200.0, "paper fails\nfrom 0.32 s (-·-)", fontsize=8, ha="right", bbox=box)
    axes[0, 0].set_ylabel("error of the lag [ms]")
    axes[1, 0].set_ylabel("error of F on 281 points [px]")
    axes[0, 0].set_ylim(_FLOORS[0] / 1.5, 2e3)
    axes[1, 0].set_ylim(_FLOORS[1] / 1.5, 3e2)
    known = {label: line for one in axes.flat for line, label in zip(*one.get_legend_handles_labels(), strict=True)}
    known |= {name: known.pop(name) for name in [_REFUSED_LABEL] if name in known}  # last
    figure.legend(list(known.values()), list(known), loc="outside lower center", ncols=5)
    figure.suptitle("Figure 13, with (a) to (c) and the default method: error against lag (under 0.001: at the edge)")
    return _save(figure, out / "timing_paper_fig13.png")


def trajectories(out: Path) -> Path:
    """Figures 9 and 14 (the marker in 3-D), 10 and 15 (its image tracks in both cameras)."""
    figure = plt.figure(figsize=(12.5, 8.2), layout="constrained")
    grid = figure.add_gridspec(3, 4, height_ratios=(1.35, 1.0, 1.0))
    time = np.arange(0.0, DURATION, PERIOD / 4.0)
    for column, (name, trajectory) in enumerate(TRAJECTORIES.items()):
        number = "9" if name == "1" else "14"
        space = figure.add_subplot(grid[0, column], projection="3d")
        space.plot(*trajectory(time).T, color=_INK, lw=0.8)
        space.set(xlabel="x [cm]", ylabel="y [cm]", zlabel="z [cm]", xlim=(-120, 120), ylim=(-120, 120))
        space.set(zlim=(-120, 120), xticks=(-100, 0, 100), yticks=(-100, 0, 100), zticks=(-100, 0, 100))
        space.tick_params(labelsize=8)
        space.set_title(f"Figure {number}: {_SUBJECT[name]}", fontsize=11)
        space.set_box_aspect((1, 1, 1), zoom=0.8)
        space.plot(*trajectory(time[:1]).T, marker="o", color=_RED, ms=5)
        filmed = film(trajectory, 0.0)
        for row, pixels in enumerate((filmed.a, filmed.b)):
            image = figure.add_subplot(grid[1 + row, column])
            image.plot(*pixels.T, color=_INK, lw=0.5, marker=".", ms=2.5)
            image.plot(*pixels[0], marker="o", color=_RED, ms=5)
            image.set(xlim=(190, -190), ylim=(-150, 150), aspect="equal", xticks=(-150, 0, 150), yticks=(-100, 0, 100))
            image.set_title(f"Figure {'10' if name == '1' else '15'}: camera {row + 1}", fontsize=10)
            image.set_xlabel("u from the centre [px]" if row else "")
            image.set_ylabel("v [px]" if column == 0 else "")
            image.grid(alpha=0.25)
    figure.suptitle("The marker over 11 s, from the dot on; images as the camera sees them (u left, v up), 30 fps")
    return _save(figure, out / "timing_paper_fig14_15.png")


def real(out: Path, filmed: RealRun, own_delay: float) -> Path | None:
    """Figures 16 and 17: the corner's tracks, and f_i by frame and in one-frame bins at n = 0, 4, 9.

    own_delay: what camera 2 itself is late by the calibrated poses [s].
    """
    iterations = [filmed.iteration(n) for n in SHOWN]
    if filmed.result is None or any(iteration is None for iteration in iterations):
        return None
    figure = plt.figure(figsize=(12.5, 6.4), layout="constrained")
    grid = figure.add_gridspec(2, 4, width_ratios=(1.15, 1.0, 1.0, 1.0))
    for row, (name, pixels) in enumerate(zip(filmed.cameras, (filmed.a, filmed.b), strict=True)):
        image = figure.add_subplot(grid[row, 0])
        image.plot(*pixels.T, color=_INK, lw=0.6, marker="o", ms=2.5)
        image.set(aspect="equal", xlabel="u [px]" if row else "", ylabel="v [px]", adjustable="datalim")
        image.invert_yaxis()
        image.set_title(f"Figure 16: {name}, corner {filmed.label}, 6 fps", fontsize=11)
        image.grid(alpha=0.25)
    asked, low, high = filmed.lag_by_stamps, -3, 4
    by_calibration = asked + own_delay / filmed.period
    share: Axes | None = None
    for column, (wanted, iteration) in enumerate(zip(SHOWN, iterations, strict=True), 1):
        if iteration is None:
            continue
        n, state = iteration
        scatter = figure.add_subplot(grid[0, column])
        seen = np.flatnonzero(np.isfinite(state.lags))
        inside = np.clip(state.lags[seen], low, high)
        scatter.plot(seen, inside, "o", ms=4, mfc="none", color=_INK, label="f_i of one frame")
        scatter.axhline(asked, color=_BLUE, ls="--", lw=1.2, label=f"by the stamps: {asked:.2f}")
        scatter.axhline(
            by_calibration, color=_INK, ls=":", lw=1.4, label=f"by the calibrated poses: {by_calibration:.2f}"
        )
        scatter.axhline(state.lag, color=_RED, lw=1.2, label=f"f, mean of the fullest bin: {state.lag:.2f}")
        ended = "" if n == wanted else " (the last)"
        e = float(misfit(filmed, state).mean())
        scatter.set_title(f"Figure 17: n = {n}{ended}, then E = {e:.2f} px", fontsize=10)
        scatter.set(ylim=(low - 0.2, high + 1.2), yticks=range(low, high + 1), xlabel=f"frame of {filmed.cameras[0]}")
        scatter.set_ylabel("f_i [frames of 0.167 s]" if column == 1 else "")
        scatter.legend(fontsize=8, loc="upper right")
        scatter.grid(alpha=0.25)
        bars = figure.add_subplot(grid[1, column], sharey=share)
        share = bars
        bars.hist(state.lags[seen], bins=list(range(low, high + 1)), color="#d8d8d8", edgecolor=_INK)
        bars.axvline(asked, color=_BLUE, ls="--", lw=1.2)
        bars.axvline(by_calibration, color=_INK, ls=":", lw=1.4)
        bars.axvline(state.lag, color=_RED, lw=1.2)
        beyond = int(((state.lags[seen] < low) | (state.lags[seen] >= high)).sum())
        bars.set(xlabel=f"f_i [frames]; {beyond} beyond the axis", xticks=range(low, high + 1))
        bars.set_ylabel("frames in the bin, H(I)" if column == 1 else "")
        bars.grid(alpha=0.25, axis="y")
    return _save(figure, out / "timing_paper_fig16_17.png")


def _beside(side: str, colour: str = _INK) -> dict[str, Any]:
    return {"textcoords": "offset points", "ha": side, "va": "center", "fontsize": 8, "color": colour}


def _log(
    axes: Axes, lags: Sequence[float], values: Sequence[float], floor: float, style: dict[str, Any], name: str
) -> None:
    """Errors on a logarithmic axis, those under its floor at the floor."""
    axes.semilogy(lags, np.maximum(np.nan_to_num(values, nan=np.nan), floor), label=name, **style)


def _whole_frames(tau: float) -> bool:
    return abs(tau / PERIOD - round(tau / PERIOD)) < 1e-6


def _save(figure: Figure, file: Path) -> Path:
    """PNG with a palette: a third of the size."""
    file.parent.mkdir(parents=True, exist_ok=True)
    drawn = BytesIO()
    figure.savefig(drawn, dpi=_DPI, facecolor="white")
    plt.close(figure)
    drawn.seek(0)
    Image.open(drawn).convert("RGB").quantize(
        _COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
    ).save(file, optimize=True)
    return file
