"""The targets that are followed, as arrays: one row a target. Never changed in place, so that an older state stays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hub.tracking.filter.kalman import SIZE
from protocols.geometry.types import Bools, Floats, Ints

if TYPE_CHECKING:
    from hub.tracking.association.initiation import Feature

TENTATIVE, CONFIRMED = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """n targets at one moment.

    identity: (n,) numbers in the order of founding. number: (n,) in the order of confirmation, 0 = tentative. kind:
    (n,) index in BODIES. mean, covariance: (n, 7), (n, 7, 7). colour: (n, 3) mean, NaN where none was told;
    colour_count: (n,). born_ns, seen_ns: (n,) reference times. hits, chances: (n,) observations, and frames that
    should have held one. support: (n,) recent share of hits. seen_by: (n, c) last time
    [ns] by camera. beside_s: (n,) for how long it has been where an older one is, less how long not.
    """

    identity: Ints
    number: Ints
    kind: Ints
    mean: Floats
    covariance: Floats
    colour: Floats
    colour_count: Floats
    born_ns: Ints
    seen_ns: Ints
    hits: Ints
    chances: Ints
    support: Floats
    seen_by: Ints
    beside_s: Floats

    def __len__(self) -> int:
        return len(self.identity)

    @property
    def confirmed(self) -> Bools:
        """(n,) whether it is told to anybody."""
        return np.asarray(self.number > 0)

    def kept(self, keep: Bools) -> Targets:
        """Only some of them."""
        return Targets(*(getattr(self, name)[keep] for name in self.__slots__))

    def joined(self, other: Targets) -> Targets:
        """These and others."""
        return Targets(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__slots__))

    @classmethod
    def none(cls, cameras: int = 0) -> Targets:
        """No target."""
        whole = np.zeros(0, dtype=np.int64)
        return cls(
            whole,
            whole,
            whole,
            np.zeros((0, SIZE)),
            np.zeros((0, SIZE, SIZE)),
            np.zeros((0, 3)),
            np.zeros(0),
            whole,
            whole,
            whole,
            whole,
            np.zeros(0),
            np.zeros((0, cameras), dtype=np.int64),
            np.zeros(0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Gone:
    """A target that was lost and may come back. mean: (7,) when it was last seen, at seen_ns."""

    number: int
    kind: int
    mean: Floats
    seen_ns: int
    colour: Floats
    colour_count: float


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Everything that tracking knows at one moment: a function of the frames so far, in their order.

    time_ns: of the last frame. pool: by camera, its last frame's features that no target explains. gone: lost
    targets, oldest first. ended: (number, kind, mean) of targets lost at this frame. floor: heights of the feet of
    confirmed upright targets, running mean and weight. colour_variance: of one channel, between what cameras tell of a
    target and what is known of it.
    """

    time_ns: int | None
    cameras: tuple[str, ...]
    targets: Targets
    pool: dict[str, tuple[Feature, ...]]
    fresh: dict[str, int]
    gone: tuple[Gone, ...] = ()
    next_identity: int = 1
    next_number: int = 1
    floor: float = 0.0
    floor_weight: float = 0.0
    colour_variance: float = 400.0

    @classmethod
    def empty(cls) -> State:
        """Before the first frame."""
        return cls(None, (), Targets.none(), {}, {})

    def with_camera(self, name: str) -> State:
        """Room for a camera that was not heard of before."""
        if name in self.cameras:
            return self
        column = np.full((len(self.targets), 1), -(2**62), dtype=np.int64)
        seen_by = np.concatenate([self.targets.seen_by, column], axis=1)
        return replace(self, cameras=(*self.cameras, name), targets=replace(self.targets, seen_by=seen_by))
