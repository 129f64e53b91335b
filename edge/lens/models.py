"""What data sheets say of lenses: the field of view of common cameras, as a start where there is no board.

Facts of the makers' specifications, for the full sensor or the mode named, without stabilisation (which crops: film
with it off). ``across``: degrees across the longer side of the picture at 16:9 unless the maker tells another.
What a unit really has differs by focus, crop and version: the stated std is wide on purpose, and the focal length
is then found from the marker's path.
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass

from protocols.errors import InputError


@dataclass(frozen=True, slots=True)
class LensModel:
    """One camera or one of its modes.

    across: degrees. diagonal: whether the maker tells those of the diagonal. std: relative, of the focal length.
    """

    name: str
    across: float
    diagonal: bool = False
    fisheye: bool = False
    std: float = 0.08


# across or, where True, diagonal; fisheye
_TABLE: tuple[tuple[str, float, bool, bool, float], ...] = (
    ("gopro-wide", 118.0, False, True, 0.08),
    ("gopro-linear", 87.0, False, False, 0.08),
    ("gopro-narrow", 67.0, False, False, 0.10),
    ("gopro-superview", 121.0, False, True, 0.12),
    ("dji-action-wide", 155.0, True, True, 0.12),
    ("iphone-main", 65.0, False, False, 0.10),
    ("iphone-ultrawide", 120.0, True, False, 0.12),
    ("pixel-main", 82.0, True, False, 0.08),
    ("pixel-ultrawide", 114.0, True, False, 0.12),
    ("galaxy-main", 85.0, True, False, 0.08),
    ("galaxy-ultrawide", 120.0, True, False, 0.12),
    ("oak-1", 69.0, False, False, 0.05),
    ("oak-d", 69.0, False, False, 0.05),
    ("oak-d-mono", 71.9, False, False, 0.05),
    ("oak-d-lite", 69.0, False, False, 0.05),
    ("oak-d-lite-mono", 72.9, False, False, 0.05),
    ("oak-d-pro", 66.0, False, False, 0.05),
    ("oak-d-pro-mono", 80.0, False, False, 0.05),
    ("oak-1-w", 95.0, False, False, 0.08),
    ("oak-d-w", 95.0, False, False, 0.08),
    ("oak-d-w-mono", 127.0, False, True, 0.08),
    ("logitech-c270", 55.0, True, False, 0.08),
    ("logitech-c920", 78.0, True, False, 0.05),
    ("logitech-c922", 78.0, True, False, 0.05),
    ("logitech-c930e", 90.0, True, False, 0.05),
    ("logitech-brio", 90.0, True, False, 0.05),
    ("raspberry-pi-camera-1", 53.5, False, False, 0.08),
    ("raspberry-pi-camera-2", 62.2, False, False, 0.08),
    ("raspberry-pi-camera-3", 66.0, False, False, 0.05),
    ("raspberry-pi-camera-3-wide", 102.0, False, False, 0.08),
)
MODELS = {row[0]: LensModel(*row) for row in _TABLE}
UNKNOWN_STD = 0.1
"""Relative std of a focal length from a field of view that somebody told."""


def find_model(name: str) -> LensModel:
    """The model of this name, however it is written. Raises InputError."""
    wanted = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    if wanted in MODELS:
        return MODELS[wanted]
    close = difflib.get_close_matches(wanted, MODELS, 3, 0.5)
    remedy = f"did you mean {', '.join(close)}?" if close else f"one of {', '.join(MODELS)}"
    raise InputError(f"no camera {name!r} is known", remedy=f"{remedy}; or give --field-of-view from its data sheet")


def angle_across(model: LensModel, size: tuple[int, int]) -> float:
    """Degrees across the width of a picture (width, height): of a portrait picture its shorter side."""
    width, height = size
    half = math.radians(0.5 * model.across)
    told = math.hypot(width, height) if model.diagonal else max(width, height)
    if model.fisheye:  # equidistant: angles go with pixels
        return math.degrees(2.0 * half * width / told)
    return math.degrees(2.0 * math.atan(math.tan(half) * width / told))
