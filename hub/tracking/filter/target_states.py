"""State of the multi-target tracker as arrays, one row per target. Immutable, so that earlier states stay valid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hub.tracking.filter.kalman import STATE_DIM
from protocols.geometry.types import Bools, Floats, Ints

if TYPE_CHECKING:
    from hub.tracking.association.initiation import UnassociatedDetection

TENTATIVE, CONFIRMED = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """n targets at one time.

    initiation_number: (n,) in order of initiation. number: (n,) in order of confirmation, 0 = tentative. kind: (n,)
    index in TARGET_MODELS. mean, covariance: (n, 7), (n, 7, 7). colour: (n, 3) mean RGB, NaN where never measured;
    colour_count: (n,) measurements of it. born_ns, seen_ns: (n,) reference times of initiation and last detection.
    hits, opportunities: (n,) detections, and frames in which one was expected. detection_rate: (n,) recent fraction of
    hits. seen_by: (n, c) time of the last detection [ns] by camera. overlap_s: (n,) time spent at the position of an
    older target, less the time spent apart from it.
    """

    initiation_number: Ints
    number: Ints
    kind: Ints
    mean: Floats
    covariance: Floats
    colour: Floats
    colour_count: Floats
    born_ns: Ints
    seen_ns: Ints
    hits: Ints
    opportunities: Ints
    detection_rate: Floats
    seen_by: Ints
    overlap_s: Floats

    def __len__(self) -> int:
        return len(self.initiation_number)

    @property
    def confirmed(self) -> Bools:
        """(n,) whether the track is confirmed, and therefore published."""
        return np.asarray(self.number > 0)

    def select(self, keep: Bools) -> Targets:
        """The targets given by a mask or by indices."""
        return Targets(*(getattr(self, name)[keep] for name in self.__slots__))

    def concatenate(self, other: Targets) -> Targets:
        """These targets followed by others."""
        return Targets(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__slots__))

    @classmethod
    def empty(cls, cameras: int = 0) -> Targets:
        """No targets."""
        no_integers = np.zeros(0, dtype=np.int64)
        return cls(
            no_integers,
            no_integers,
            no_integers,
            np.zeros((0, STATE_DIM)),
            np.zeros((0, STATE_DIM, STATE_DIM)),
            np.zeros((0, 3)),
            np.zeros(0),
            no_integers,
            no_integers,
            no_integers,
            no_integers,
            np.zeros(0),
            np.zeros((0, cameras), dtype=np.int64),
            np.zeros(0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class LostTrack:
    """A lost track, kept for re-identification. mean: (7,) state when it was last detected, at seen_ns."""

    number: int
    kind: int
    mean: Floats
    seen_ns: int
    colour: Floats
    colour_count: float


@dataclass(frozen=True, slots=True, eq=False)
class MultiTargetState:
    """The complete tracker state after a frame: a function of the frames so far, in the order of their keys.

    time_ns: reference time of the last frame. unassociated: by camera, the detections of its last frame that are
    associated with no target. last_frame_ns: by camera. lost_tracks: oldest first. floor_height, floor_weight: running
    mean and weight of the foot heights of confirmed upright targets. colour_variance: of one channel, between a
    detection's colour and the stored colour of its target.
    """

    time_ns: int | None
    cameras: tuple[str, ...]
    targets: Targets
    unassociated: dict[str, tuple[UnassociatedDetection, ...]]
    last_frame_ns: dict[str, int]
    lost_tracks: tuple[LostTrack, ...] = ()
    next_initiation_number: int = 1
    next_number: int = 1
    floor_height: float = 0.0
    floor_weight: float = 0.0
    colour_variance: float = 400.0

    @classmethod
    def empty(cls) -> MultiTargetState:
        """The state before the first frame."""
        return cls(None, (), Targets.empty(), {}, {})

    def with_camera(self, name: str) -> MultiTargetState:
        """The state with a column for a camera that was not known before."""
        if name in self.cameras:
            return self
        column = np.full((len(self.targets), 1), -(2**62), dtype=np.int64)
        seen_by = np.concatenate([self.targets.seen_by, column], axis=1)
        return replace(self, cameras=(*self.cameras, name), targets=replace(self.targets, seen_by=seen_by))
