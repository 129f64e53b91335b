"""Clutter: a lamp, a reflection or a burnt pixel that a detector takes for the target again and again."""

from __future__ import annotations

import numpy as np
from scipy.special import betainc

from protocols.geometry.types import Floats

CELL_PX = 6.0  # about a fixed pixel: three sigma of a poor detector
_JUMP_PX = 60.0  # between rows is a jump if longer; a target that leaves a place of rest is seen nearer, above 3 fps
_CELL_SHARE = CELL_PX / _JUMP_PX  # of a target's rows within a jump of a pixel that it passes: its path is a line there
_RUN = 3  # rows without a jump are a target in motion: of 30 % false rows all over the image, one in 10^4 begins one
_FALSE_ALARM = 1e-4  # of a track


def static_clutter(x: Floats) -> Floats | None:
    """The pixel (2,) of rows (n, 2) [px], by time, with most jumps to it, if it is clutter and no target.

    A target arrives at a pixel, rests and leaves through its neighbourhood; one that is too fast for the camera to show
    that is as often beside it as its size tells, and one on a closed path comes from the same place each time. So the
    different places of a moving target before jumps to the pixel, and all jumps to beside it, have binomial odds.
    """
    begins = np.flatnonzero(np.r_[True, np.hypot(*(x[1:] - x[:-1]).T) > _JUMP_PX])
    least = np.log(_FALSE_ALARM / len(begins)) / np.log(_CELL_SHARE)
    if len(begins) <= least:
        return None
    low, high = (limit.reduceat(x, begins, axis=0) for limit in (np.minimum, np.maximum))
    rests = np.r_[False, (high - low).max(axis=1)[1:] <= 2.0 * CELL_PX]
    places, is_moving = 0.5 * (low + high)[rests], np.diff(begins, prepend=-_RUN)[rests] >= _RUN
    origin = np.rint(x[begins[rests] - 1] / (2.0 * CELL_PX)) @ [1.0, 1j]
    _, cell, count = np.unique(np.rint(places / (2.0 * CELL_PX)), axis=0, return_inverse=True, return_counts=True)
    for one in np.argsort(-count, kind="stable")[: np.count_nonzero(count > 0.5 * least)]:
        spot = np.median(places[cell.ravel() == one], axis=0)
        distance = np.hypot(*(places - spot).T)
        here = len(np.unique(origin[(distance <= CELL_PX) & is_moving]))
        beside = np.count_nonzero((distance > CELL_PX) & (distance <= _JUMP_PX))
        if here > least and betainc(here, beside + 1, _CELL_SHARE) * len(begins) < _FALSE_ALARM:
            return np.asarray(spot)
    return None
