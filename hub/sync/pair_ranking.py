"""Ranking of camera pairs by a coarse lag scan."""

from __future__ import annotations

from collections.abc import Mapping

from hub.sync.lag_scan import PairMoments, ranked_minima, scan_lags, scan_step
from hub.sync.settings import PairSettings
from hub.sync.track_cache import TrackCache
from hub.trajectory.image_tracks import SmoothTrack

_COARSENING = 8.0  # times the grid step of the full scan


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
