"""Median and quantiles of a few hundred values, in a fraction of the time that numpy takes for any shape and NaN."""

from __future__ import annotations

import math

import numpy as np

from protocols.geometry.types import Floats


def median(values: Floats) -> float:
    """Median of values (n,), n > 0, none of them NaN."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    parted = np.partition(values, (middle - 1, middle))
    return 0.5 * float(parted[middle - 1] + parted[middle])


def quantile(values: Floats, share: float) -> float:
    """Quantile of values (n,), n > 0, none of them NaN, by linear interpolation; share: from 0 to 1."""
    place = share * (len(values) - 1)
    low = min(math.floor(place), max(len(values) - 2, 0))
    high = min(low + 1, len(values) - 1)
    parted = np.partition(values, (low, high))
    return float(parted[low] + (place - low) * (parted[high] - parted[low]))
