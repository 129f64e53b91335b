"""Where in the image corners of the board were seen: distortion is measured only there."""

from __future__ import annotations

import numpy as np

from edge.lens.board import BoardView
from protocols.geometry.types import Ints

COVERAGE_GRID = (8, 6)
"""Columns and rows of the grid over the image on which coverage is counted."""


def coverage_map(cells: Ints) -> list[str]:
    """The corner counts as a text grid; a dot = none."""
    return ["".join(f"{value:5d}" if value else "    ." for value in row) for row in cells.tolist()]


def corner_counts(views: list[BoardView], size: tuple[int, int]) -> Ints:
    """Corners (rows, columns) in each cell of the grid, of all views of images of a size (width, height) [px]."""
    pixels = np.concatenate([view.pixels for view in views])
    across = np.clip((pixels[:, 0] + 0.5) / size[0] * COVERAGE_GRID[0], 0, COVERAGE_GRID[0] - 1).astype(np.int64)
    down = np.clip((pixels[:, 1] + 0.5) / size[1] * COVERAGE_GRID[1], 0, COVERAGE_GRID[1] - 1).astype(np.int64)
    columns, rows = COVERAGE_GRID
    return np.bincount(down * columns + across, minlength=columns * rows).reshape(rows, columns)


def uncovered_sides(cells: Ints) -> str:
    """The sides of the image with the fewest covered cells, in words."""
    rows, columns = COVERAGE_GRID[1] // 3, COVERAGE_GRID[0] // 3
    sides = {
        "the left": cells[:, :columns],
        "the right": cells[:, -columns:],
        "the top": cells[:rows],
        "the bottom": cells[-rows:],
    }
    shares = {name: float((part > 0).mean()) for name, part in sides.items()}
    least = min(shares.values())
    return " and ".join(name for name, share in shares.items() if share <= least + 0.1)
