"""Shipped simulated scenes: pure functions of a name, a seed and a number of cameras.

They are for demos, simulation and tests; agents of real cameras do not import them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from protocols.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from edge.scenes.common.base import Renderer, SimulatedScene
    from edge.scenes.marker.scene import MarkerScene
    from edge.scenes.people.scene import PeopleScene

MARKER_SCENES = ("marker", "marker-outdoor")
PEOPLE_SCENE = "people"


def get_marker_scene(name: str, seed: int, cameras: int | None = None, mixed_fps: bool = False) -> MarkerScene:
    """The marker scene ``name``; the same arguments always give the same scene.

    cameras: at least 2; None = the scene's own number (marker 3, marker-outdoor 5). mixed_fps: whether the cameras of
    ``marker`` run at 30, 25, 29.97 and 50 fps instead of 30 (``marker-outdoor`` always does). Raises InputError for an
    unknown name or too few cameras.
    """
    from edge.scenes.marker.scene import marker_field, marker_room

    if name not in MARKER_SCENES:
        raise InputError(
            f"there is no scene {name!r}", remedy=f"use one of {', '.join((*MARKER_SCENES, PEOPLE_SCENE))}, or town"
        )
    if cameras is not None and cameras < 2:
        raise InputError(f"a scene needs at least 2 cameras, not {cameras}", remedy="give --cameras 2 or more")
    if name == "marker-outdoor":
        return marker_field(seed, 5 if cameras is None else cameras)
    return marker_room(seed, 3 if cameras is None else cameras, mixed_fps)


def get_people_scene(seed: int, cameras: int | None = None, people: int | None = None) -> PeopleScene:
    """The scene ``people``: people walking in a room; the same arguments always give the same scene.

    cameras: 2 or more, None = 5. people: 1 to 12, None = 5. Raises InputError.
    """
    from edge.scenes.people.scene import MAX_PEOPLE, people_room

    cameras, people = 5 if cameras is None else cameras, 5 if people is None else people
    if cameras < 2:
        raise InputError(f"a scene needs at least 2 cameras, not {cameras}", remedy="give --cameras 2 or more")
    if not 1 <= people <= MAX_PEOPLE:
        raise InputError(f"{people} people do not fit into the room", remedy=f"give --people 1 to {MAX_PEOPLE}")
    return people_room(seed, cameras, people)


def get_scene(name: str, seed: int, cameras: int | None = None, people: int | None = None) -> SimulatedScene:
    """The scene of any kind with this name: what a simulated device renders. Raises InputError."""
    if name == PEOPLE_SCENE:
        return get_people_scene(seed, cameras, people)
    if name not in MARKER_SCENES:
        raise InputError(
            f"there is no scene {name!r}", remedy=f"use one of {', '.join((*MARKER_SCENES, PEOPLE_SCENE))}"
        )
    return get_marker_scene(name, seed, cameras)


def renderer_for(scene: SimulatedScene, camera: str, rng: np.random.Generator) -> Renderer:
    """The renderer of one camera of a scene; ``rng`` gives the sensor noise. Raises TypeError for a foreign scene."""
    # OpenCV is only needed for rendering.
    from edge.scenes.marker.renderer import MarkerRenderer
    from edge.scenes.marker.scene import MarkerScene
    from edge.scenes.people.renderer import PeopleRenderer
    from edge.scenes.people.scene import PeopleScene

    if isinstance(scene, MarkerScene):
        return MarkerRenderer(scene, camera, rng)
    if isinstance(scene, PeopleScene):
        return PeopleRenderer(scene, camera, rng)
    raise TypeError(f"no renderer for {type(scene).__name__}")
