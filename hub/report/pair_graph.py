"""The pair graph: cameras as nodes, tried pairs as edges, readable without colour; a matrix for many cameras."""

from __future__ import annotations

import numpy as np

from hub.report.quality_assessment import is_contradicting
from hub.report.svg import THIN, at, drawing, esc, line, number, rect, text
from protocols.core.acceptance import PairReport
from protocols.core.errors import Refused
from protocols.session.calibration import Calibration

_MAX_LABELS = 15  # more labels than this would overlap
_MAX_NODES = 8  # beyond, a matrix is more readable


def edge_kind(outcome: Calibration | Refused, pair: PairReport) -> str:
    """ "agrees", "contradicts" or "refused"."""
    if pair.status != "ok":
        return "refused"
    return "contradicts" if is_contradicting(outcome, pair) else "agrees"


def draw_pair_graph(calibration: Calibration) -> str:
    """SVG of all cameras and pairs, with lags on the edges where there is room; "" without pairs."""
    names = [*calibration.cameras, *calibration.refused]
    pairs = [pair for pair in calibration.pairs if pair.cameras[0] in names and pair.cameras[1] in names]
    if not pairs:
        return ""
    if len(names) > _MAX_NODES:
        return _matrix(calibration, names, pairs)
    width, height = 480.0, 380.0 if len(names) > 2 else 150.0
    place = _node_positions(len(names), width, height)
    parts: list[str] = []
    labels: list[str] = []
    connected = [pair for pair in pairs if edge_kind(calibration, pair) != "refused"]
    for pair in pairs:
        i, j = names.index(pair.cameras[0]), names.index(pair.cameras[1])
        kind = edge_kind(calibration, pair)
        (x1, y1), (x2, y2) = place[i], place[j]
        tip = f"{pair.cameras[0]}–{pair.cameras[1]}: {pair.status}"
        parts.append(f"<g><title>{esc(tip)}</title>{line(x1, y1, x2, y2, f'edge {kind}')}</g>")
        if kind != "refused" and pair.lag_s is not None and len(connected) <= _MAX_LABELS:
            # Chords cross in the middle: their labels are off it.
            share = 0.5 if len(names) < 4 or abs(i - j) in (1, len(names) - 1) else 0.3
            x, y = x1 + share * (x2 - x1), y1 + share * (y2 - y1)
            lag = f"{number(pair.lag_s, 3, sign=True)}{THIN}s"
            half = 3.9 * len(lag) + 3
            labels.append(rect(x - half, y - 10, 2 * half, 20, "paper") + text(x, y + 4.5, lag, "", "middle"))
    nodes = [_node(name, *place[i], name in calibration.refused) for i, name in enumerate(names)]
    label = f"{len(connected)} of {len(pairs)} pairs of {len(names)} cameras were connected"
    return drawing(width, height, [*parts, *labels, *nodes], label, max_width=width)


def is_matrix(calibration: Calibration) -> bool:
    """Whether pairs are shown as a matrix, because there are many cameras."""
    return len(calibration.cameras) + len(calibration.refused) > _MAX_NODES


def _matrix(calibration: Calibration, names: list[str], pairs: list[PairReport]) -> str:
    """One sign per pair: a disc is consistent, a cross is a rejected outlier, a small ring is not connected."""
    cell = 30.0 if len(names) <= 25 else 18.0
    left = 8.0 * max(len(name) for name in names) + 14
    size = cell * len(names)
    parts = []
    for index, name in enumerate(names):
        middle = left + cell * (index + 0.5)
        parts.append(text(left - 10, 10 + cell * (index + 0.5) + 4, name, "rowname", "end"))
        parts.append(line(left, 10 + cell * (index + 0.5), left + size, 10 + cell * (index + 0.5), "grid"))
        parts.append(line(middle, 10, middle, 10 + size, "grid"))
        turned = f'transform="translate({at(middle + 4)} {at(22 + size)}) rotate(-90)"'
        parts.append(f'<text class="rowname" text-anchor="end" {turned}>{esc(name)}</text>')
    for pair in pairs:
        i, j = names.index(pair.cameras[0]), names.index(pair.cameras[1])
        lag = "" if pair.lag_s is None else f", lag {number(pair.lag_s, 4, sign=True)} s"
        tip = f"<title>{esc(f'{pair.cameras[0]}–{pair.cameras[1]}: {pair.status}{lag}')}</title>"
        kind = edge_kind(calibration, pair)
        for row, column in ((i, j), (j, i)):
            x, y = left + cell * (column + 0.5), 10 + cell * (row + 0.5)
            parts.append(f"<g>{tip}{_sign(kind, x, y, 0.27 * cell)}</g>")
    wide = left + size + 10
    label = f"Results of {len(pairs)} pairs of {len(names)} cameras"
    return drawing(wide, size + left + 20, parts, label, max_width=wide)


def _sign(kind: str, x: float, y: float, radius: float) -> str:
    if kind == "agrees":
        return f'<circle class="estimate" cx="{at(x)}" cy="{at(y)}" r="{at(radius)}"/>'
    if kind == "refused":
        return f'<circle class="ring" cx="{at(x)}" cy="{at(y)}" r="{at(0.5 * radius)}"/>'
    cross = line(x - radius, y - radius, x + radius, y + radius, "clash")
    return f"{cross}{line(x - radius, y + radius, x + radius, y - radius, 'clash')}"


def _node_positions(count: int, width: float, height: float) -> list[tuple[float, float]]:
    if count == 2:
        return [(90.0, height / 2), (width - 90.0, height / 2)]
    # For an even number of nodes the polygon is rotated by half a step, so that its edges are level.
    turn = -np.pi / 2 - (np.pi / count if count % 2 == 0 else 0.0) + 2 * np.pi * np.arange(count) / count
    across, down = np.cos(turn), np.sin(turn)
    x = width / 2 + (width / 2 - 60) * across / np.abs(across).max()
    y = height / 2 + (height / 2 - 34) * down / np.abs(down).max()
    return [(float(a), float(b)) for a, b in zip(x, y, strict=True)]


def _node(name: str, x: float, y: float, refused: bool) -> str:
    width = max(56.0, 8.2 * len(name) + 22)
    kind = "node refused" if refused else "node"
    box = (
        f'<rect class="{kind}" x="{at(x - width / 2)}" y="{at(y - 16)}" width="{at(width)}" height="32" rx="16"/>'
        + text(x, y + 5, name, "nodename refused" if refused else "nodename", "middle")
    )
    return box + (text(x, y + 30, "refused", "tick", "middle") if refused else "")


def legend(calibration: Calibration) -> str:
    """Legend of the line styles or signs."""
    matrix = is_matrix(calibration)
    kinds = (
        ("agrees", "consistent with the others"),
        ("contradicts", "rejected as outlier: contradicts the others"),
        ("refused", "not connected"),
    )
    parts = []
    for kind, words in kinds:
        shape = _sign(kind, 8, 8, 7) if matrix else line(1, 8, 45, 8, f"edge {kind}")
        sample = (
            f'<svg viewBox="0 0 {16 if matrix else 46} 16" class="sample{" small" if matrix else ""}">{shape}</svg>'
        )
        parts.append(f"<span>{sample}{esc(words)}</span>")
    return f'<p class="legend">{"".join(parts)}</p>'
