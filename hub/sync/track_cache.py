"""What all pairs with a camera share (grids, bandwidths, image speeds), and the ranking of pairs by a coarse scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hub.sync.lag_scan import GridTrack, PairMoments, fast_image_speed, grid_tracks, ranked_minima, scan_lags, scan_step
from hub.sync.null_distribution import bandwidth
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack

_COARSENING = 8.0  # times the grid step of the full scan


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


def ranking_score(
    tracks_a: Mapping[str, SmoothTrack],
    tracks_b: Mapping[str, SmoothTrack],
    cache: TrackCache | None = None,
) -> float:
    """Ranking score of a pair: the best candidate's score (`lag_scan.ranked_minima`) in a coarse scan of all lags.

    Only for the order in which pairs are solved; 0 without common labels or candidates. cache: grids that other pairs
    of these cameras have computed.
    """
    s, cache = PairSettings(), cache or TrackCache()
    labels = [label for label in tracks_a if label in tracks_b]
    if not labels:
        return 0.0
    a, b = [tracks_a[k] for k in labels], [tracks_b[k] for k in labels]
    step = _COARSENING * scan_step(max(cache.fast_image_speed(track) for track in (*a, *b)), s)
    # The point moves by that much more in a grid step than in the full scan.
    sigma = s.sigma_px * _COARSENING
    scan = scan_lags(PairMoments(cache.grid(a, step, sigma), cache.grid(b, step, sigma)), s.min_scan_support)
    found = ranked_minima(scan, 1)[1]
    return float(found[0]) if len(found) else 0.0
