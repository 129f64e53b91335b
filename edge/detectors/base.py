"""What every detector gives: where it saw something, how large, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Detection:
    """One thing in one picture.

    u, v: its centre, distorted pixels, (0, 0) = centre of the top-left pixel. size: diameter or height [px],
    0 = not measured. score: 0..1. label: which moving point. colour: mean sRGB (red, green, blue) 0..255.
    covariance: (uu, uv, vv) [px²] of (u, v); None = not known.
    """

    u: float
    v: float
    size: float = 0.0
    score: float = 1.0
    label: str = "marker"
    colour: tuple[int, int, int] | None = None
    covariance: tuple[float, float, float] | None = None


class Detector(Protocol):
    """Finds things in single pictures. It keeps no state that changes what it finds in the next one."""

    def detect(self, image: npt.NDArray[np.uint8]) -> list[Detection]:
        """Detections in an image (H, W, 3) uint8 BGR, best first; empty where there is none."""
