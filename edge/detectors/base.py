"""What every detector gives: where it saw something, how large, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Detection:
    """One thing in one picture.

    u, v: its centre, distorted pixels, (0, 0) = centre of the top-left pixel. size: diameter or height [px],
    0 = not measured. score: 0..1. label: which moving point. colour: mean sRGB (red, green, blue) 0..255.
    covariance: (uu, uv, vv) [px²] of (u, v); None = not known. kind: what it is, "" = not told.
    Of a person: (u, v) is the representative point (the maximum of the silhouette's distance transform), size the
    distance from head, the (u, v) of the head's top, to foot, that of the foot point; None = not seen. colour: the
    torso's. box: (x, y, width, height) [px] of what is seen of it, x and y of the top left.
    target: id of the track it was matched to, "" = unmatched.
    """

    u: float
    v: float
    size: float = 0.0
    score: float = 1.0
    label: str = "marker"
    colour: tuple[int, int, int] | None = None
    covariance: tuple[float, float, float] | None = None
    kind: Literal["", "marker", "person", "vehicle"] = ""
    head: tuple[float, float] | None = None
    foot: tuple[float, float] | None = None
    box: tuple[float, float, float, float] | None = None
    target: str = ""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where the tracking expects one of its targets in a camera's next picture.

    u, v: of the representative point [px]; covariance: (uu, uv, vv) [px²]. target: the track's id.
    size: head to foot [px], 0 = not told. colour: of the torso, sRGB 0..255; None = not told.
    """

    u: float
    v: float
    covariance: tuple[float, float, float]
    target: str
    size: float = 0.0
    colour: tuple[int, int, int] | None = None


class Detector(Protocol):
    """Finds things in a camera's pictures, which are handed in one after the other.

    One for a marker keeps no state; one of what moves before a background learns that background.
    """

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """Detections in an image (H, W, 3) uint8 BGR, best first; empty where there is none.

        time_s: of the picture, on the camera's clock; None = one frame after the last.
        predictions: what is expected in it; only detectors of people and vehicles use them.
        """
