"""State of the multi-target tracker as arrays, one row per target. Immutable, so that earlier states stay valid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from hub.tracking.detections import FrameDetections
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import STATE_DIM
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats, Ints

if TYPE_CHECKING:
    from hub.tracking.association.initiation import UnassociatedDetection


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """n targets at one time.

    initiation_number: (n,) in order of initiation. number: (n,) in order of confirmation, 0 = tentative. kind: (n,)
    index in TARGET_MODELS. mean, covariance: (n, 7), (n, 7, 7). colour: (n, 3) mean RGB, NaN where never measured;
    colour_count: (n,) measurements of it. born_ns, seen_ns: (n,) reference times of initiation and last detection.
    hits: (n,) detections. existence: (n,) probability that there is such a target. seen_by: (n, c) time of the last
    detection [ns] by camera. overlap: (n,) log likelihood ratio of this being the same as its older neighbour.
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
    existence: Floats
    seen_by: Ints
    overlap: Floats

    def __len__(self) -> int:
        return len(self.initiation_number)

    @property
    def confirmed(self) -> Bools:
        """(n,) whether the track is confirmed, and therefore published."""
        return np.asarray(self.number > 0)

    def select(self, keep: Bools | Ints) -> Targets:
        """The targets given by a mask or by indices."""
        return Targets(*(getattr(self, name)[keep] for name in self.__slots__))

    def concatenate(self, other: Targets) -> Targets:
        """These targets followed by others."""
        if not len(self) or not len(other):
            return self if len(self) else other
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
            np.zeros(0),
            np.zeros((0, cameras), dtype=np.int64),
            np.zeros(0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class DetectionStatistics:
    """What one camera's detector does, as estimated from the tracks.

    clear, occluded: probability of detecting a target in full view, and one behind another. clutter: expected false
    detections a frame. noise: variance of the detected points over their model's. interval_s: between two frames.
    """

    clear: float = 0.85
    occluded: float = 0.5
    clutter: float = 0.5
    noise: float = 2.0
    touching_noise: float = 4.0
    interval_s: float = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ScanFrame:
    """A frame of the scan. value: (n, 7) its measurements. noise_entries: (n, 8) of their noise that are not zero. ids:
    (k,) initiation numbers of the targets, column: (k,) their detections. ambiguous: whether another association was
    nearly as probable."""

    frame: FrameDetections
    value: Floats
    noise_entries: Floats
    statistics: DetectionStatistics
    ids: Ints
    column: Ints
    ambiguous: bool


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """The frames since ``prior``, the targets before the first of them, at ``prior_ns``."""

    prior: Targets
    prior_ns: int | None
    frames: tuple[ScanFrame, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Encounters:
    """Of k pairs of targets, that they were exchanged. time_ns: of all states. pair: (k, 2) initiation numbers. mean,
    covariance: (k, 2, 7), (k, 2, 7, 7) of both, had each made the other's detections since. colour: (k, 2, 3) before.
    log_odds: (k,) against the present tracks. opened_ns: (k,) scan at which they were exchanged."""

    time_ns: int | None
    pair: Ints
    mean: Floats
    covariance: Floats
    colour: Floats
    log_odds: Floats
    opened_ns: Ints

    def select(self, index: Ints) -> Encounters:
        """Some of them."""
        return Encounters(self.time_ns, *(getattr(self, name)[index] for name in self.__slots__[1:]))

    @classmethod
    def empty(cls) -> Encounters:
        """None."""
        none = np.zeros(0, dtype=np.int64)
        shape = (0, 2, STATE_DIM)
        return cls(
            None, np.zeros((0, 2), dtype=np.int64), np.zeros(shape), np.zeros((*shape, STATE_DIM)),
            np.zeros((0, 2, 3)), np.zeros(0), none,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class MultiTargetState:
    """The complete tracker state after a frame: a function of the frames so far, in the order of their keys.

    time_ns: reference time of the last frame. unassociated: by camera, the detections of its last frame that are
    associated with no target. last_frame_ns, statistics: by camera. lost: tracks kept for re-identification, oldest
    first, as predicted to the time lost_ns (k,) at which they were lost. floor: on which upright targets stand.
    colour_variance: of one channel, between a detection's colour and the stored colour of its target. scan: the last
    frames of all cameras, whose association may still change. encounters: pairs that may have been exchanged.
    """

    time_ns: int | None
    cameras: tuple[str, ...]
    targets: Targets
    unassociated: dict[str, tuple[UnassociatedDetection, ...]]
    last_frame_ns: dict[str, int]
    lost: Targets = field(default_factory=Targets.empty)
    lost_ns: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    next_initiation_number: int = 1
    next_number: int = 1
    floor: Floor | None = None
    colour_variance: float = 400.0
    statistics: dict[str, DetectionStatistics] = field(default_factory=dict)
    scan: Scan | None = None
    encounters: Encounters = field(default_factory=Encounters.empty)

    @property
    def scan_complete(self) -> bool:
        """Whether every camera that had a frame lately has one in the scan."""
        if self.scan is None or self.time_ns is None:
            return False
        recent_ns = round(1.5 * self.interval_s * NANOSECONDS)
        recent = {name for name, time_ns in self.last_frame_ns.items() if self.time_ns - time_ns <= recent_ns}
        return recent <= {one.frame.camera.name for one in self.scan.frames}

    @property
    def interval_s(self) -> float:
        """Between two frames of the fastest camera [s]."""
        return min((one.interval_s for one in self.statistics.values()), default=0.5)

    @classmethod
    def empty(cls) -> MultiTargetState:
        """The state before the first frame."""
        return cls(None, (), Targets.empty(), {}, {})

    def with_camera(self, name: str) -> MultiTargetState:
        """The state with a column for a camera that was not known before."""
        if name in self.cameras:
            return self
        targets, lost = (
            replace(one, seen_by=np.hstack([one.seen_by, np.full((len(one), 1), -(2**62), dtype=np.int64)]))
            for one in (self.targets, self.lost)
        )
        return replace(self, cameras=(*self.cameras, name), targets=targets, lost=lost)
