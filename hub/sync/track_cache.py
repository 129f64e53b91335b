"""What every pair asks of a camera's tracks, made once for all pairs of that camera."""

from __future__ import annotations

from collections.abc import Sequence

from hub.sync.alignment import fast_motion
from hub.sync.lag_scan import GridTrack, grid_tracks
from hub.sync.null_distribution import bandwidth
from hub.trajectory.image_tracks import SmoothTrack


class Kept:
    """Grids, bandwidths and speeds of tracks, which are told apart by being the same objects.

    The tracks are kept with them: another object at the same address would pass for them.
    """

    def __init__(self) -> None:
        self._grids: dict[tuple[tuple[int, ...], float, float], tuple[tuple[SmoothTrack, ...], GridTrack]] = {}
        self._motions: dict[int, tuple[SmoothTrack, float, float]] = {}

    def grid(self, tracks: Sequence[SmoothTrack], step: float, sigma_px: float) -> GridTrack:
        """What `grid_tracks` makes of them."""
        key = tuple(map(id, tracks)), step, sigma_px
        if key not in self._grids:
            self._grids[key] = tuple(tracks), grid_tracks(tracks, step, sigma_px)
        return self._grids[key][1]

    def bandwidth(self, track: SmoothTrack) -> float:
        """What `bandwidth` says of it [Hz]."""
        return self._motion(track)[1]

    def fast_motion(self, track: SmoothTrack) -> float:
        """What `fast_motion` says of it [px/s]."""
        return self._motion(track)[2]

    def _motion(self, track: SmoothTrack) -> tuple[SmoothTrack, float, float]:
        if id(track) not in self._motions:
            self._motions[id(track)] = track, bandwidth(track), fast_motion(track)
        return self._motions[id(track)]
