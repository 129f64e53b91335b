"""Fields of view of common cameras from their data sheets, as nominal intrinsics where no board is available.

For the full sensor or the mode named, without stabilisation (which crops: record with it off). ``field_of_view_deg``:
across the longer side of the image at 16:9 unless the maker states another. A particular unit differs by focus, crop
and version: the stated std is wide on purpose, and the focal length is then estimated from the marker's motion.
Rows without a source give what the maker is known to advertise and were not looked up again: their std is 0.12 or more.
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass

from protocols.core.errors import InputError

# name, field of view, diagonal, fisheye, std
_TABLE: tuple[tuple[str, float, bool, bool, float], ...] = (
    # Wide: one unit of a HERO3 was measured at 114 (equidistant) to 121 degrees by its owner, R. Cunniff, in 2012.
    ("gopro-wide", 118.0, False, True, 0.10),
    ("gopro-linear", 87.0, False, False, 0.15),
    ("gopro-narrow", 67.0, False, False, 0.15),
    ("gopro-superview", 121.0, False, True, 0.15),
    ("dji-action-wide", 155.0, True, True, 0.15),
    # Phone makers state the focal length that has the same diagonal on 35 mm film: 24 to 28 mm, 72 to 63 degrees
    # across; video is cropped a little more.
    ("iphone-main", 65.0, False, False, 0.12),
    ("iphone-ultrawide", 120.0, True, False, 0.15),
    ("pixel-main", 82.0, True, False, 0.12),
    ("pixel-ultrawide", 114.0, True, False, 0.15),
    ("galaxy-main", 85.0, True, False, 0.12),
    ("galaxy-ultrawide", 120.0, True, False, 0.15),
    # docs.luxonis.com, the sensors' and products' pages: IMX378 66 with autofocus and 69 with fixed focus, its wide
    # lens 95; OV9282 80; OV9782 wide 127; OV7251 73.
    ("oak-1", 67.5, False, False, 0.06),
    ("oak-d", 67.5, False, False, 0.06),
    ("oak-d-mono", 71.9, False, False, 0.12),
    ("oak-d-lite", 69.0, False, False, 0.12),
    ("oak-d-lite-mono", 73.0, False, False, 0.05),
    ("oak-d-s2", 67.5, False, False, 0.06),
    ("oak-d-s2-mono", 80.0, False, False, 0.05),
    ("oak-d-pro", 67.5, False, False, 0.06),
    ("oak-d-pro-mono", 80.0, False, False, 0.05),
    ("oak-1-w", 95.0, False, False, 0.08),
    ("oak-d-w", 95.0, False, False, 0.08),
    ("oak-d-w-mono", 127.0, False, True, 0.08),
    ("logitech-c270", 55.0, True, False, 0.12),
    # Advertised as 78 on the diagonal, of 16:9 (wimsworld.wordpress.com, 2013, quotes and tries it).
    ("logitech-c920", 78.0, True, False, 0.06),
    ("logitech-c922", 78.0, True, False, 0.06),
    ("logitech-c930e", 90.0, True, False, 0.12),
    ("logitech-brio", 90.0, True, False, 0.12),
    # raspberrypi/documentation, camera hardware: 53.50 ± 0.13, 62.2, of all the sensor. Their 1080p is its middle, 1920
    # of 2592 and of 3280 pixels. The third was announced with 66 and 102 degrees.
    ("raspberry-pi-camera-1", 53.5, False, False, 0.08),
    ("raspberry-pi-camera-2", 62.2, False, False, 0.08),
    ("raspberry-pi-camera-1-1080p", 40.9, False, False, 0.08),
    ("raspberry-pi-camera-2-1080p", 38.9, False, False, 0.08),
    ("raspberry-pi-camera-3", 66.0, False, False, 0.06),
    ("raspberry-pi-camera-3-wide", 102.0, False, False, 0.08),
)
FIELD_OF_VIEW_STD = 0.1
"""Relative std of a focal length from a field of view given by the user."""


@dataclass(frozen=True, slots=True)
class LensModel:
    """One camera or one of its modes.

    field_of_view_deg: degrees. diagonal: whether it is stated for the diagonal. std: relative, of the focal length.
    """

    name: str
    field_of_view_deg: float
    diagonal: bool = False
    fisheye: bool = False
    std: float = 0.08


LENS_MODELS = {row[0]: LensModel(*row) for row in _TABLE}


def find_lens_model(name: str) -> LensModel:
    """The model of this name, in any spelling. Raises InputError."""
    wanted = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    if wanted in LENS_MODELS:
        return LENS_MODELS[wanted]
    close = difflib.get_close_matches(wanted, LENS_MODELS, 3, 0.5)
    remedy = f"did you mean {', '.join(close)}?" if close else f"one of {', '.join(LENS_MODELS)}"
    raise InputError(f"no camera {name!r} is known", remedy=f"{remedy}; or give --field-of-view from its data sheet")


def horizontal_field_of_view(model: LensModel, size: tuple[int, int]) -> float:
    """Horizontal field of view [degrees] of an image of ``size`` (width, height); in portrait the shorter side's."""
    width, height = size
    half = math.radians(0.5 * model.field_of_view_deg)
    reference_px = math.hypot(width, height) if model.diagonal else max(width, height)
    if model.fisheye:  # equidistant: angles are proportional to pixels
        return math.degrees(2.0 * half * width / reference_px)
    return math.degrees(2.0 * math.atan(math.tan(half) * width / reference_px))
