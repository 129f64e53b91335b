"""Detections, predictions of targets in the image, and the protocol that every detector implements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

Kind = Literal["person", "vehicle"]

CUT_VEHICLE_STD = 0.9
"""Std of the middle of a vehicle's box that the border cuts, over the side that is not cut: of a vehicle three times as
long as high anything from none to all is in the picture."""


@dataclass(frozen=True, slots=True)
class Detection:
    """One detected object in one image.

    u, v: its centre in distorted pixels, (0, 0) = centre of the top-left pixel. size: diameter or height [px], 0 = not
    measured. score: 0..1. label: which moving point it belongs to. colour: mean sRGB (red, green, blue) 0..255.
    covariance: (uu, uv, vv) [px²] of (u, v); None = not known. kind: class of the object, "" = not given.

    Of a person: (u, v) is the representative point (the maximum of the silhouette's distance transform), size the
    distance from head to foot, head the (u, v) of the top of the head, foot that of the foot point; None = not visible.
    colour: the torso's. box: (x, y, width, height) [px] of the visible part, x and y of the top left. target: id of the
    track that it was matched to, "" = unmatched.
    """

    u: float
    v: float
    size: float = 0.0
    score: float = 1.0
    label: str = "marker"
    colour: tuple[int, int, int] | None = None
    covariance: tuple[float, float, float] | None = None
    kind: Literal["", "marker", "person", "vehicle", "corner"] = ""
    head: tuple[float, float] | None = None
    foot: tuple[float, float] | None = None
    box: tuple[float, float, float, float] | None = None
    target: str = ""


@dataclass(frozen=True, slots=True)
class Prediction:
    """A target's predicted measurement in a camera's next image.

    u, v: predicted representative point [px]. covariance: (uu, uv, vv) [px²] of it. target: id of the track. size:
    predicted distance from head to foot [px], 0 = not known. colour: of the torso, sRGB 0..255; None = not known.
    """

    u: float
    v: float
    covariance: tuple[float, float, float]
    target: str
    size: float = 0.0
    colour: tuple[int, int, int] | None = None


@dataclass(frozen=True, slots=True)
class DetectorOptions:
    """What a detector is made for: the images of one camera, passed one after the other.

    kind: report only objects of this kind; None = all that it knows. fps: frame rate [Hz], where images come without
    times. prefix: put before the labels of tracks (p0, t0, …), so that those of two cameras differ. seed: of random
    numbers, where it draws any.
    """

    kind: Kind | None = None
    fps: float = 25.0
    prefix: str = ""
    seed: int = 0


class Detector(Protocol):
    """Detects objects in the images of one camera, which are passed one after the other.

    Detectors of light spots and tags keep no state. The ball detector remembers the background behind the ball;
    detectors of people and vehicles learn a background model and track from image to image. Other packages may register
    theirs: see ``edge.detectors.plugins``.
    """

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """Detections in an image (H, W, 3) uint8 BGR, best first; empty where there are none.

        time_s: time of the image [s] on the camera's clock; None = one frame period after the last one. predictions: of
        targets in this image; only detectors of people and vehicles use them.
        """


@runtime_checkable
class BatchDetector(Detector, Protocol):
    """A detector that is faster on several images of its camera at once, as networks are on some hardware.

    batch: number of images that it takes best at once, >= 1.
    """

    @property
    def batch(self) -> int: ...

    def detect_batch(self, images: Sequence[npt.NDArray[np.uint8]], times_s: Sequence[float]) -> list[list[Detection]]:
        """The detections in each image (H, W, 3) uint8 BGR, as by ``detect`` on one after the other.

        times_s: increasing times of the images [s] on the camera's clock.
        """
