"""The models of the UAV tracker by name; each is imported only when it is asked for."""

from __future__ import annotations

from edge.uav.tracker import Tracker
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

NAMES = ("ground", "paper", "plain")


def get(
    name: str,
    size: tuple[int, int],
    lens: Intrinsics | None = None,
    body_from_camera: Floats | None = None,
    fps: float = 30.0,
    seed: int = 0,
) -> Tracker:
    """A tracker that still has to ``begin``.

    name: "ground", "paper" or "plain". size: (width, height) of the pictures [px]. lens, body_from_camera (3, 3):
    the camera, as far as known. fps: nominal frame rate. seed: of everything random in it.
    Raises InputError for an unknown name.
    """
    if name == "ground":
        from edge.uav.ground_tracker import GroundTracker

        return GroundTracker(size, lens, body_from_camera, fps, seed)
    if name == "paper":
        from edge.uav.baselines.paper_tracker import PaperTracker

        return PaperTracker(size, lens, body_from_camera, fps, seed)
    if name == "plain":
        from edge.uav.baselines.plain_tracker import PlainTracker

        return PlainTracker(size, lens, body_from_camera, fps, seed)
    raise InputError(f"there is no model {name!r}", remedy=f"use one of {', '.join(NAMES)}")


__all__ = ["NAMES", "get"]
