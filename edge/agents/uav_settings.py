"""Settings of a UAV agent."""

from __future__ import annotations

from dataclasses import dataclass

from edge.agents.thumbnails import THUMBNAIL_WIDTH
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class UavSettings:
    """The camera of a UAV agent and the settings of its estimator. lens, body_from_camera: None where not known.

    size: (width, height) [px]. jpeg_quality: of the images published on the bus, which are then also the tracker's
    input; None: no images are published. pictures_hz, picture_width: rate and width [px] of the thumbnails, which are
    published only while somebody subscribes; a rate of 0 disables them.
    """

    size: tuple[int, int]
    fps: float
    lens: Intrinsics | None
    body_from_camera: Floats | None
    seed: int = 0
    model: str = "ground"
    jpeg_quality: int | None = None
    pictures_hz: float = 2.0
    picture_width: int = THUMBNAIL_WIDTH
