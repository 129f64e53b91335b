"""Which of many pairs of cameras to look at first."""

from __future__ import annotations

from collections.abc import Mapping

from hub.sync.alignment import PairSettings, grid_step
from hub.sync.lag_scan import PairMoments, ranked, scan_lags
from hub.sync.track_cache import Kept
from hub.trajectory.image_tracks import SmoothTrack

_COARSER = 8.0  # than the step of the scan proper


def promise(
    tracks_a: Mapping[str, SmoothTrack],
    tracks_b: Mapping[str, SmoothTrack],
    settings: PairSettings | None = None,
    kept: Kept | None = None,
) -> float:
    """What a coarse scan says for any alignment of two cameras: seconds of support times how much better than usual.

    Tells which of many pairs to try first, and nothing else. kept: what other pairs of these cameras asked already.
    """
    s, kept = settings or PairSettings(), kept or Kept()
    labels = [label for label in tracks_a if label in tracks_b]
    if not labels:
        return 0.0
    a, b = [tracks_a[k] for k in labels], [tracks_b[k] for k in labels]
    step = _COARSER * grid_step(max(kept.fast_motion(track) for track in (*a, *b)), s)
    # A step moves the point by that much more than in the scan proper.
    sigma = s.sigma_px * _COARSER
    scan = scan_lags(PairMoments(kept.grid(a, step, sigma), kept.grid(b, step, sigma)), s.least_support)
    found = ranked(scan, 1)[1]
    return float(found[0]) if len(found) else 0.0
