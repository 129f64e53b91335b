"""Shipped simulated worlds: pure functions of a name, a seed and a number of cameras.

They are for demos, simulation and tests; no agent of real cameras imports them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from protocols.core.errors import InputError

if TYPE_CHECKING:
    from edge.scenes.common.base import Scene
    from edge.scenes.marker.scene import MarkerScene
    from edge.scenes.people.scene import PeopleScene

NAMES = ("marker", "marker-outdoor")
PEOPLE = "people"


def get(name: str, seed: int, cameras: int | None = None, mixed_fps: bool = False) -> MarkerScene:
    """The scene ``name``; the same arguments always give the same world.

    cameras: at least 2; None = the scene's own number (marker 3, marker-outdoor 5).
    mixed_fps: whether the cameras of ``marker`` run at 30, 25, 29.97 and 50 fps instead of 30
    (``marker-outdoor`` always does). Raises InputError for an unknown name or too few cameras.
    """
    from edge.scenes.marker.scene import marker_field, marker_room

    if name not in NAMES:
        raise InputError(f"there is no scene {name!r}", remedy=f"use one of {', '.join((*NAMES, PEOPLE))}, or town")
    if cameras is not None and cameras < 2:
        raise InputError(f"a scene needs at least 2 cameras, not {cameras}", remedy="give --cameras 2 or more")
    if name == "marker-outdoor":
        return marker_field(seed, 5 if cameras is None else cameras)
    return marker_room(seed, 3 if cameras is None else cameras, mixed_fps)


def get_people(
    seed: int, cameras: int | None = None, people: int | None = None, *, mixed_fps: bool = False
) -> PeopleScene:
    """The scene ``people``: walkers in a room; the same arguments always give the same world.

    cameras: 2 or more, None = 5. people: 1 to 12, None = 5. mixed_fps: 10, 12.5, 9.99 and 15 fps instead of 10.
    Raises InputError.
    """
    from edge.scenes.people.scene import MOST_PEOPLE, people_room

    cameras, people = 5 if cameras is None else cameras, 5 if people is None else people
    if cameras < 2:
        raise InputError(f"a scene needs at least 2 cameras, not {cameras}", remedy="give --cameras 2 or more")
    if not 1 <= people <= MOST_PEOPLE:
        raise InputError(f"{people} people do not fit into the room", remedy=f"give --people 1 to {MOST_PEOPLE}")
    return people_room(seed, cameras, people, mixed_fps)


def any_scene(name: str, seed: int, cameras: int | None = None, people: int | None = None) -> Scene:
    """Whichever scene bears this name: what a simulated device films. Raises InputError."""
    if name == PEOPLE:
        return get_people(seed, cameras, people)
    if name not in NAMES:
        raise InputError(f"there is no scene {name!r}", remedy=f"use one of {', '.join((*NAMES, PEOPLE))}")
    return get(name, seed, cameras)
