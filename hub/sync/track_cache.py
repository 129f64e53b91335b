"""Cache of per-camera quantities that all pairs with that camera share: grids, bandwidths, image speeds."""

from __future__ import annotations

from collections.abc import Sequence

from hub.sync.lag_scan import GridTrack, fast_image_speed, grid_tracks
from hub.sync.null_distribution import bandwidth
from hub.trajectory.image_tracks import SmoothTrack


class TrackCache:
    """Resampled grids, bandwidths and image speeds, keyed by the identity of the track objects.

    The tracks are kept alive with them: otherwise another object at the same address would match.
    """

    def __init__(self) -> None:
        self._grids: dict[tuple[tuple[int, ...], float, float], tuple[tuple[SmoothTrack, ...], GridTrack]] = {}
        self._motions: dict[int, tuple[SmoothTrack, float, float]] = {}

    def grid(self, tracks: Sequence[SmoothTrack], step: float, sigma_px: float) -> GridTrack:
        """`grid_tracks` of the same arguments."""
        key = tuple(map(id, tracks)), step, sigma_px
        if key not in self._grids:
            self._grids[key] = tuple(tracks), grid_tracks(tracks, step, sigma_px)
        return self._grids[key][1]

    def bandwidth(self, track: SmoothTrack) -> float:
        """`bandwidth` of a track [Hz]."""
        return self._motion(track)[1]

    def fast_image_speed(self, track: SmoothTrack) -> float:
        """`fast_image_speed` of a track [px/s]."""
        return self._motion(track)[2]

    def _motion(self, track: SmoothTrack) -> tuple[SmoothTrack, float, float]:
        if id(track) not in self._motions:
            self._motions[id(track)] = track, bandwidth(track), fast_image_speed(track)
        return self._motions[id(track)]
