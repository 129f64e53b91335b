"""What the tracker is given about the scene, and labels of tracks."""

from __future__ import annotations

from dataclasses import dataclass, field

from hub.tracking.association.initiation import LengthScale
from hub.tracking.filter.target_models import TARGET_MODELS
from protocols.geometry.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class TrackerParameters:
    """Scene knowledge and track-management limits.

    up: (3,) unit vector in world coordinates, None = unknown. scale: of the world. coast_s: how long a target is kept
    without detections. remember_s: how long a lost track may be re-identified; at most ``max_lost_tracks`` are kept.
    lifetime_s: mean time that a target stays, where nothing is seen of it: a walker's way through a hall of 20 m.
    """

    up: Floats | None = None
    scale: LengthScale = field(default_factory=LengthScale)
    coast_s: float = 2.5
    remember_s: float = 120.0
    max_lost_tracks: int = 200
    lifetime_s: float = 15.0


def track_label(kind: int, number: int) -> str:
    """The label under which a confirmed track is published."""
    return f"{TARGET_MODELS[kind].kind}-{number}"
