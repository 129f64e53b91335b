"""Which pairs of cameras can be synchronised: those that saw the same target at the same time, by times of arrival.

A pair with less common motion than a lag scan needs has no solution whatever its lag, so pairs without that overlap
need no scan. Of a street's thousand cameras that leaves ten each in place of half a million.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import LARGE_NETWORK
from hub.clocks.external_prior import ExternalClockPrior
from hub.sync.overlap import BIN_S, MOST_PARTNERS, common_seconds
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import smooth_only
from protocols.geometry.types import Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def candidate_pairs(
    prepared: PreparedSession, arrivals: Mapping[str, ExternalClockPrior] | None
) -> list[tuple[str, str]]:
    """Pairs to solve: all in the rig's order, or in a large network those whose tracks overlap by their clock priors,
    the longest overlap first.

    A camera without a prior may overlap with every other. On a shared clock no pair is scanned, so none is left out.
    """
    names = prepared.names
    every = itertools.combinations(range(len(names)), 2)
    known = [name in (arrivals or {}) for name in names]
    if len(names) <= LARGE_NETWORK or prepared.shared_clock or not any(known):
        return [(names[a], names[b]) for a, b in every]
    seconds = _overlaps(prepared, arrivals or {})
    chosen, least = dict[tuple[int, int], float](), PairSettings().min_scan_support
    for camera in range(len(names)):
        row = slice(seconds.indptr[camera], seconds.indptr[camera + 1])
        # Of equal overlaps the next in the rig's order, so that not all choose the same.
        after = (seconds.indices[row] - camera) % len(names)
        partners = zip(-seconds.data[row], after, seconds.indices[row], strict=True)
        enough = [(less, other) for less, _, other in sorted(partners) if other != camera and -less >= least]
        chosen |= {(min(camera, other), max(camera, other)): less for less, other in enough[:MOST_PARTNERS]}
    unknown = [camera for camera, one in enumerate(known) if not one]
    chosen |= {(min(a, b), max(a, b)): 0.0 for a in unknown for b in range(len(names)) if a != b}
    return [(names[a], names[b]) for a, b in sorted(chosen, key=lambda both: (chosen[both], both))]


def _overlaps(prepared: PreparedSession, clocks: Mapping[str, ExternalClockPrior]) -> csr_array[Any]:
    """(cameras, cameras) seconds in which both saw one target, to within a bin."""
    cameras, bins = list[Ints](), list[Ints]()
    targets = {label: index for index, label in enumerate(prepared.labels)}
    for number, name in enumerate(prepared.names):
        if name not in clocks:
            continue
        offset = prepared.time_origins[name] + clocks[name].unix_minus_camera
        for label, track in smooth_only(prepared.camera(name).tracks).items():
            seen = np.unique(np.floor((track.time + offset) / BIN_S).astype(np.int64))
            bins.append(seen * len(targets) + targets[label])
            cameras.append(np.full(len(seen), number))
    nothing = [np.zeros(0, np.int64)]
    seconds: csr_array[Any] = common_seconds(
        np.concatenate(cameras or nothing), np.concatenate(bins or nothing), len(targets), len(prepared.names)
    )
    return seconds
