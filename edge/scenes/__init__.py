"""Shipped simulated worlds: pure functions of a name, a seed and a number of cameras.

They are for demos, simulation and tests; no agent of real cameras imports them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from protocols.errors import InputError

if TYPE_CHECKING:
    from edge.scenes.marker import MarkerScene

NAMES = ("marker", "marker-outdoor")


def get(name: str, seed: int, cameras: int | None = None, mixed_fps: bool = False) -> MarkerScene:
    """The scene ``name``; the same arguments always give the same world.

    cameras: at least 2; None = the scene's own number (marker 3, marker-outdoor 5).
    mixed_fps: whether the cameras of ``marker`` run at 30, 25, 29.97 and 50 fps instead of 30
    (``marker-outdoor`` always does). Raises InputError for an unknown name or too few cameras.
    """
    from edge.scenes.marker import marker_field, marker_room

    if name not in NAMES:
        raise InputError(f"there is no scene {name!r}", remedy=f"use one of {', '.join(NAMES)}")
    if cameras is not None and cameras < 2:
        raise InputError(f"a scene needs at least 2 cameras, not {cameras}", remedy="give --cameras 2 or more")
    if name == "marker-outdoor":
        return marker_field(seed, 5 if cameras is None else cameras)
    return marker_room(seed, 3 if cameras is None else cameras, mixed_fps)
