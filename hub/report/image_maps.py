"""Maps over the image of each camera: detections, and mean residual vectors."""

from __future__ import annotations

import numpy as np

from hub.report import measures
from hub.report.svg import THIN, at, drawing, esc, line, number, rect, short, whole
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration

_WIDTH = 340.0  # px of the drawing
_ARROW_BINS = 16  # across the image: arrows stay apart
_MIN_ROWS = 3  # the mean residual of fewer rows is noise
_MAX_DOTS = 400  # in one image: more are a blot


def residual_maps(calibration: Calibration) -> str:
    """One map per camera: grey level by number of rows, arrows for mean residuals, one arrow scale for all."""
    bins = {}
    for name, camera in calibration.cameras.items():
        residuals = calibration.residuals.get(name)
        if residuals is not None and len(residuals):
            bins[name] = measures.residual_bins(
                residuals, (camera.intrinsics.width, camera.intrinsics.height), _ARROW_BINS
            )
    if not bins:
        return ""
    magnitudes = np.concatenate(
        [np.linalg.norm(b.mean[b.count >= _MIN_ROWS], axis=1) for b in bins.values()] or [np.zeros(1)]
    )
    typical = float(np.quantile(magnitudes, 0.9)) if len(magnitudes) else 1.0
    unit = next((step for step in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0) if step >= typical), 20.0)
    cell = _WIDTH / _ARROW_BINS
    maps = []
    for name, found in bins.items():
        camera = calibration.cameras[name]
        size = (camera.intrinsics.width, camera.intrinsics.height)
        covered = measures.covered_cells(calibration.residuals[name][:, 1:3], size)
        caption = (
            f"<b>{esc(name)}</b> {number(camera.rms_px, 2)}{THIN}px · {whole(int(found.count.sum()))} rows · "
            f"{100 * covered.mean():.0f}{THIN}% of the image"
        )
        maps.append(f"<figure>{_map(name, found, size, 1.15 * cell / unit)}<figcaption>{caption}</figcaption></figure>")
    arrow = f'<svg viewBox="0 0 40 10" class="sample">{_arrow(4, 5, 4 + 1.15 * cell, 5)}</svg>'
    legend = (
        f'<p class="legend"><span>{arrow}mean residual of {short(unit, figures=1)}{THIN}px '
        "(observed minus predicted)</span>"
        '<span><i class="swatch few"></i>few rows</span><span><i class="swatch many"></i>many rows</span>'
        '<span><i class="swatch none"></i>none</span></p>'
    )
    return f'{legend}<div class="{_columns(len(maps))}">{"".join(maps)}</div>'


def _columns(count: int) -> str:
    return "maps two" if count in (2, 4) else "maps"


def _map(name: str, found: measures.ResidualBins, size: tuple[int, int], per_px: float) -> str:
    scale = _WIDTH / size[0]
    height = size[1] * scale
    parts = [rect(0.5, 0.5, _WIDTH - 1, height - 1, "image")]
    most = float(np.log1p(found.count.max()))
    arrows = []
    for centre, mean, rms, count in zip(found.centre, found.mean, found.rms, found.count, strict=True):
        x, y = (centre + 0.5) * scale
        w, h = found.cell[0] * scale, found.cell[1] * scale
        level = 1 + min(4, int(4.999 * np.log1p(count) / max(most, 1e-9)))
        tip = f"{int(count)} rows, rms {rms:.2f} px, mean ({mean[0]:+.2f}, {mean[1]:+.2f}) px"
        parts.append(rect(x - w / 2, y - h / 2, w, h, f"cell c{level}", tip))
        if count >= _MIN_ROWS:
            step = mean * per_px
            reach = float(np.hypot(*step))
            if reach > 2.5 * w:  # an outlier bin must not cross the whole map
                step = step * (2.5 * w / reach)
            arrows.append(_arrow(x - step[0] / 2, y - step[1] / 2, x + step[0] / 2, y + step[1] / 2))
    parts.append(_cross(size, scale))
    return drawing(_WIDTH, height, [*parts, *arrows], f"Mean residuals over the image of {name}")


def _cross(size: tuple[int, int], scale: float) -> str:
    x, y = size[0] * scale / 2, size[1] * scale / 2
    return line(x - 5, y, x + 5, y, "cross") + line(x, y - 5, x, y + 5, "cross")


def _arrow(x1: float, y1: float, x2: float, y2: float) -> str:
    """An arrow whose head scales with its length; a dot if it is too short."""
    dx, dy = x2 - x1, y2 - y1
    reach = float(np.hypot(dx, dy))
    if reach < 1.5:
        return f'<circle class="dot" cx="{at((x1 + x2) / 2)}" cy="{at((y1 + y2) / 2)}" r="1.1"/>'
    ux, uy = dx / reach, dy / reach
    head = min(5.0, 0.45 * reach + 1)
    bx, by = x2 - head * ux, y2 - head * uy
    half = 0.5 * head
    tip = f"{at(x2)},{at(y2)} {at(bx - half * uy)},{at(by + half * ux)} {at(bx + half * uy)},{at(by - half * ux)}"
    return f'{line(x1, y1, bx, by, "arrow")}<polygon class="head" points="{tip}"/>'


def seen_maps(rows: dict[str, Floats], sizes: dict[str, tuple[int, int]]) -> str:
    """The detections of each camera as dots; rows: camera time, u, v (n, 3) by camera."""
    maps = []
    for name, seen in rows.items():
        size = sizes[name]
        scale = _WIDTH / size[0]
        height = size[1] * scale
        parts = [rect(0.5, 0.5, _WIDTH - 1, height - 1, "image"), _cross(size, scale)]
        for u, v in seen[measures.thinned_indices(len(seen), _MAX_DOTS), 1:3]:
            parts.append(f'<circle class="seen" cx="{at((u + 0.5) * scale)}" cy="{at((v + 0.5) * scale)}" r="1.6"/>')
        share = 100 * measures.covered_cells(seen[:, 1:3], size).mean() if len(seen) else 0.0
        caption = f"<b>{esc(name)}</b> {whole(len(seen))} rows · {share:.0f}{THIN}% of the image"
        picture = drawing(_WIDTH, height, parts, f"Where {name} saw the point")
        maps.append(f"<figure>{picture}<figcaption>{caption}</figcaption></figure>")
    return f'<div class="{_columns(len(maps))}">{"".join(maps)}</div>'
