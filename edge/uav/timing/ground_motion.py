"""The way over the ground that the images show against that of the telemetry's positions.

Where a camera that looks down only yaws, its rotation is the same however it is turned about its optical axis; the
direction of its way is not. The ratio of both ways also shows positions that are not in metres, and the height.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.uav.base import Telemetry
from protocols.geometry.types import Bools, Floats

CONTRADICTION = "positions move otherwise than the images"
"""Begins the reason where telemetry is of another mounting, camera or heading."""
_WINDOW_S = 1.0  # over which ways are compared: an unknown offset of the clocks of 0.5 s matters little
_MAX_GAP_S = 1.5  # between positions that are interpolated: of receivers at 1 Hz
_MIN_WINDOWS = 5  # by chance a coherence of 0.9 is one of 700 among so few
_MIN_WAY = 0.015  # heights a window (rms), 0.9 m/s at 60 m: ten times the images' error in a simulated hover
_MIN_COHERENCE = 0.9  # of a simulated flight it is 0.995, in wind, with clocks 0.25 s apart
_UNLIKE = (
    0.65  # with clocks 3 s apart 0.2 to 0.6 in four simulated flights; 0.67 of positions 3 s apart in turns of 6 s
)
_LONG_M = 2.0  # a window: a receiver's noise of 0.5 m changes the coherence of such ways by 0.1
_MAX_TURN = 0.25 * math.pi  # nearer to another quarter turn than to none; no compass is so wrong
_MAX_HEADING_ERROR = 0.15  # rad, 9 degrees, four stds of a heading; with clocks 0.25 s apart both ways differ by 1
_MAX_LOG_RATIO = 0.12  # of both ways: of simulated flights with clocks 0.25 s apart it is up to 0.1
_STANDS_STILL = 0.01  # ratio of positions in degrees, or that never change; no ground is so much nearer


@dataclass(frozen=True, slots=True, eq=False)
class RelativeRotations:
    """Rotation vectors (n, 3) [rad] of the camera from ``starts`` to ``ends`` (n,) [s], in camera axes.

    moved: (n, 3) its way in the axes of the start, in heights above the ground; None where it was not measured.
    """

    starts: Floats
    ends: Floats
    vectors: Floats
    moved: Floats | None = None

    def part(self, chosen: Bools) -> RelativeRotations:
        """Those that are chosen (n,)."""
        moved = None if self.moved is None else self.moved[chosen]
        return RelativeRotations(self.starts[chosen], self.ends[chosen], self.vectors[chosen], moved)


@dataclass(frozen=True, slots=True)
class GroundMotion:
    """turn: angle [rad] by which the positions' way is turned from the images'. ratio: of its length to theirs.

    coherence: 0 … 1. seen, reported: rms way [m] in a second. height: mean, above down = 0 [m].
    """

    turn: float
    ratio: float
    coherence: float
    seen: float
    reported: float
    height: float

    @property
    def agrees_in_shape(self) -> bool:
        """Whether both are one way but for its direction and scale."""
        return self.coherence >= _MIN_COHERENCE and self.reported >= _MIN_WAY * self.height

    @property
    def differs_in_shape(self) -> bool:
        """Whether both are long, and ways of different flights or times."""
        return self.coherence < _UNLIKE and min(self.seen, self.reported) >= max(_MIN_WAY * self.height, _LONG_M)

    @property
    def contradiction(self) -> str:
        """That the positions are of a camera mounted otherwise; "" where they are not."""
        if not self.agrees_in_shape or abs(self.turn) <= _MAX_TURN:
            return ""
        quarter = 90 * round(math.degrees(self.turn) / 90.0) % 360
        return (
            f"{CONTRADICTION}, but as of a camera turned by {quarter} degrees: check body_from_camera, and the heading"
        )

    @property
    def wrong_heading(self) -> str:
        """That the telemetry's heading is not that of the images; "" where it is."""
        if not self.agrees_in_shape or self.contradiction or abs(self.turn) <= _MAX_HEADING_ERROR:
            return ""
        return f"the images move as with a heading that is wrong by {abs(math.degrees(self.turn)):.0f} degrees"

    @property
    def wrong_height(self) -> str:
        """That the ground is at another height than down = 0; "" where it is not."""
        if not self.agrees_in_shape or self.contradiction or abs(math.log(self.ratio)) <= _MAX_LOG_RATIO:
            return ""
        return f"the images move as from {self.ratio * self.height:.0f} m above the ground, not {self.height:.0f} m"

    @property
    def stands_still(self) -> bool:
        """Whether the positions hardly change where the images show a way."""
        return self.reported < _STANDS_STILL * self.seen


def compare_ways(
    images: RelativeRotations, telemetry: Sequence[Telemetry], body_from_camera: Floats, offset: float
) -> GroundMotion | None:
    """Both ways, horizontally; None where the images show none, or too few samples have a position.

    telemetry: by increasing time = camera time + offset [s]. body_from_camera: (3, 3).
    """
    placed = [sample for sample in telemetry if sample.position is not None]
    if len(placed) < 2 or images.moved is None or not len(images.moved):
        return None
    times = np.array([sample.time for sample in placed])
    positions = np.array([sample.position for sample in placed])
    starts, ends = images.starts + offset, images.ends + offset
    inside = (starts >= times[0]) & (ends <= times[-1])
    after = np.clip(np.searchsorted(times, starts, side="right"), 1, len(times) - 1)
    inside &= times[after] - times[after - 1] <= _MAX_GAP_S
    starts, ends, moved = starts[inside], ends[inside], images.moved[inside]
    nearest = np.clip(np.searchsorted(times, starts), 0, len(times) - 1)
    heights = np.maximum(-positions[nearest, 2], 0.0)
    attitudes = np.array([placed[k].ned_from_body for k in nearest]).reshape(-1, 3, 3) @ body_from_camera
    seen = heights[:, None] * np.einsum("nij,nj->ni", attitudes, moved)[:, :2]
    reported = np.column_stack([np.interp(ends, times, p) - np.interp(starts, times, p) for p in positions.T[:2]])
    window = ((starts - times[0]) // _WINDOW_S).astype(np.int64)
    used = np.flatnonzero(np.bincount(window, ends - starts) > 0.8 * _WINDOW_S)
    if len(used) < _MIN_WINDOWS:
        return None
    a, b = (
        np.bincount(window, way[:, 0])[used] + 1j * np.bincount(window, way[:, 1])[used] for way in (seen, reported)
    )
    energy, other = float(np.square(np.abs(a)).mean()), float(np.square(np.abs(b)).mean())
    height = float(heights.mean())
    if not math.sqrt(energy) >= _MIN_WAY * height > 0.0:
        return None
    cross = complex((a.conj() * b).mean())
    coherence = abs(cross) / math.sqrt(energy * other) if other > 0.0 else 0.0
    return GroundMotion(cmath.phase(cross), abs(cross) / energy, coherence, math.sqrt(energy), math.sqrt(other), height)
