"""Factory of the UAV trackers by name; each is imported only when it is requested."""

from __future__ import annotations

from edge.uav.base import Tracker
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

NAMES = ("ground", "paper", "plain")


def make_tracker(
    name: str,
    size: tuple[int, int],
    lens: Intrinsics | None = None,
    body_from_camera: Floats | None = None,
    fps: float = 30.0,
    seed: int = 0,
) -> Tracker:
    """A tracker, to be started with ``begin``.

    name: "ground", "paper" or "plain". size: (width, height) of the images [px]. lens, body_from_camera (3, 3):
    intrinsics and mounting, as far as known. fps: nominal frame rate. seed: of all its random numbers.
    Raises InputError for an unknown name.
    """
    if name == "ground":
        from edge.uav.adaptive_tracker import PictureTracker

        return PictureTracker(size, lens, (body_from_camera, fps, seed))
    if name == "paper":
        from edge.uav.baselines.paper_tracker import PaperTracker

        return PaperTracker(size, lens, body_from_camera, fps, seed)
    if name == "plain":
        from edge.uav.baselines.plain_tracker import PlainTracker

        return PlainTracker(size, lens, body_from_camera, fps, seed)
    raise InputError(f"there is no model {name!r}", remedy=f"use one of {', '.join(NAMES)}")
