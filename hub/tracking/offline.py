"""People and vehicles followed through a whole recording."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hub.tracking.association.initiation import LengthScale
from hub.tracking.calibration.vertical import VerticalEstimator
from hub.tracking.detections import FrameDetections, TrackingCamera, frame_detections
from hub.tracking.filter.detection_model import CORRELATION_S
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY
from hub.tracking.filter.target_models import TARGET_MODELS
from hub.tracking.filter.target_states import MultiTargetState, Targets
from hub.tracking.frame_update import jointly, process_frame
from hub.tracking.live_tracking import guessed_units_per_m, scale_of_people
from hub.tracking.parameters import TrackerParameters
from hub.tracking.smoothing import ITERATIONS, LOG_ABSENT, BatchSmoother, RecordedScan, SmoothedScan
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration
from protocols.session.rig import METRES_PER_UNIT

_SCALE_FRAMES, _SCALE_PASSES = 400, 2
"""Frames by whose people the scale of a world without units is known to a tenth, ten seconds of four cameras; and how
often: a guess that is far off finds the first person only."""
_MIN_LOG_ODDS = 3.0
"""Of a track's existence over its whole life: one in twenty of the accepted ones at the limit is false."""
_COASTING_S = 0.35
"""Without a detection for longer, a row is marked so; at few frames a second, for more than one and a half frames."""

_MIN_DETECTIONS, _MIN_USED = 30, 0.6
"""Detections of a camera of which the used share is judged, and that share over the other cameras' median below which
it is warned of: 0.9 and more where all is right, 0.4 with a picture that is mirrored."""


@dataclass(frozen=True, slots=True, eq=False)
class FollowedTrack:
    """One person or vehicle at n times.

    id: from 1. kind: person or vehicle. times: (n,) reference time [s]. position: (n, 3) of the foot on the ground, in
    world coordinates; std: (n,) of it, horizontal, per axis. height: (n,) in the world's units. confirmed: (n,), False
    = coasting. detections: camera, sequence number of its frame, and index of the detection in it.
    """

    id: int
    kind: str
    times: Floats
    position: Floats
    std: Floats
    height: Floats
    confirmed: Bools
    detections: tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, slots=True)
class CameraSummary:
    """What one camera contributed. used: associated share of its detections. clutter: false detections a frame, and
    detection_probability: of a person in full view, as estimated."""

    frames: int
    detections: int
    used: float
    clutter: float
    detection_probability: float


@dataclass(frozen=True, slots=True, eq=False)
class FollowResult:
    """Tracks, in the order of their first times, and what each camera contributed. up: (3,) unit vector in the world
    frame, given or estimated; None = unknown."""

    tracks: tuple[FollowedTrack, ...]
    cameras: dict[str, CameraSummary]
    warnings: tuple[str, ...] = ()
    up: Floats | None = None


def follow(
    observations: Sequence[pb.Observation],
    calibration: Calibration,
    times_ns: Sequence[int],
    *,
    up: Floats | None = None,
    iterations: int = ITERATIONS,
    progress: Callable[[float], None] | None = None,
) -> FollowResult:
    """The tracks of a recording: forward by the live tracker, then smoothed and linked over the whole.

    observations: in any order; their times are on each camera's clock. times_ns: reference times at which positions
    are wanted. up: (3,) unit vector in the world frame; None: estimated from upright people. iterations: of association
    and linking over the whole; with none, tracks are those of the forward pass. progress: gets the done share. Raises
    Refused if nobody can be followed.
    """
    cameras = {name: TrackingCamera.from_calibration(camera) for name, camera in calibration.cameras.items()}
    frames = sorted(
        (frame_detections(cameras[one.camera], one) for one in observations if one.camera in cameras),
        key=lambda frame: frame.key,
    )
    if not any(len(frame) for frame in frames):
        raise Refused("no calibrated camera has a detection of a person or vehicle")
    warnings: list[str] = []
    if up is None:
        vertical = VerticalEstimator()
        for frame in frames:
            vertical.handle(frame)
        up = vertical.estimate({name: camera.pose for name, camera in cameras.items()})
        if up is None:
            warnings.append("the vertical is unknown: targets are followed as points, without a ground")
    metric = calibration.scale == "metric"
    units_per_m = 1.0 / METRES_PER_UNIT[calibration.units] if metric else guessed_units_per_m(cameras)
    # Who has left is known from the whole recording: until its end nobody is given up soon.
    parameters = TrackerParameters(up=up, scale=LengthScale(units_per_m, metric), lifetime_s=60.0)
    for _ in range(0 if metric or up is None else _SCALE_PASSES):
        _, begun = _tracked(frames[:_SCALE_FRAMES], cameras, parameters, lambda share: None)
        parameters = replace(parameters, scale=scale_of_people(begun.targets, parameters.scale))
    said = progress or (lambda share: None)
    recorded, state = _tracked(frames, cameras, parameters, lambda share: said(0.5 * share))
    del frames
    smoother = _smoother(recorded, state, parameters)
    scans: list[SmoothedScan] = []
    if smoother is not None:
        scans = smoother.run(iterations=iterations, progress=lambda share: said(0.5 + 0.5 * share))
    tracks = _sampled(smoother, scans, np.asarray(times_ns, dtype=np.int64), up) if smoother is not None else ()
    summaries = _summaries(smoother, state, cameras)
    return FollowResult(tracks, summaries, (*warnings, *_unused(summaries)), up)


def _tracked(
    frames: Sequence[FrameDetections],
    cameras: dict[str, TrackingCamera],
    parameters: TrackerParameters,
    progress: Callable[[float], None],
) -> tuple[deque[tuple[RecordedScan, Targets]], MultiTargetState]:
    """Of each scan what the live tracker finds, and its last state."""
    state, recorded = MultiTargetState.empty(), deque[tuple[RecordedScan, Targets]]()
    for index, frame in enumerate(frames):
        if state.scan is not None and any(one.frame.camera.name == frame.camera.name for one in state.scan.frames):
            state = jointly(state, parameters)
            recorded.append(_recorded(state))
            state = replace(state, scan=None)  # who was taken for whom is the smoother's, which knows the future
        state = process_frame(state, frame, cameras, parameters)
        if index % 50 == 0:
            progress(index / len(frames))
    state = jointly(state, parameters)
    recorded.append(_recorded(state))
    return recorded, state


def _recorded(state: MultiTargetState) -> tuple[RecordedScan, Targets]:
    """What the smoother needs of a state: with all of it an hour would not fit into memory."""
    assert state.scan is not None
    assert state.time_ns is not None
    return RecordedScan(state.time_ns, state.scan.frames), state.targets


def _smoother(
    recorded: deque[tuple[RecordedScan, Targets]], last: MultiTargetState, parameters: TrackerParameters
) -> BatchSmoother | None:
    """The recording's scans with the tracker's associations; rows of tracks by track number. Empties ``recorded``."""
    number: dict[int, int] = {}
    for _, targets in recorded:
        named = targets.confirmed
        number |= dict(zip(targets.initiation_number[named].tolist(), targets.number[named].tolist(), strict=True))
    names = sorted(set(number.values()))
    if not names:
        return None
    row_of = {name: row for row, name in enumerate(names)}
    scans, states = [], []
    chosen: dict[int, Targets] = {}
    while recorded:
        scan, targets = recorded.popleft()
        frames = []
        for one in scan.frames:
            known = np.array([int(i) in number for i in one.ids.tolist()], dtype=np.bool_)
            ids = np.array([row_of[number[int(i)]] for i in one.ids[known].tolist()], dtype=np.int64)
            ids, at = np.unique(ids, return_index=True)
            statistics = last.statistics.get(one.frame.camera.name, one.statistics)
            statistics = replace(statistics, interval_s=one.statistics.interval_s)
            noise = one.noise_entries * (statistics.noise / one.statistics.noise)
            frames.append(
                replace(one, ids=ids, column=one.column[known][at], statistics=statistics, noise_entries=noise)
            )
        scans.append(replace(scan, frames=tuple(frames)))
        rows = [row_of[number[i]] if i in number else -1 for i in targets.initiation_number.tolist()]
        use = [i for i, row in enumerate(rows) if row >= 0 and row not in rows[:i]]
        order = sorted(use, key=lambda i: rows[i])
        for i in order:
            chosen[rows[i]] = targets.select(np.array([i]))
        at = np.array(order, dtype=np.int64)
        states.append((np.array([rows[i] for i in order], dtype=np.int64), targets.mean[at], targets.covariance[at]))
    tracks = [chosen[row] for row in range(len(names))]
    together = tracks[0]
    for track in tracks[1:]:
        together = together.concatenate(
            replace(track, seen_by=np.zeros((1, together.seen_by.shape[1]), dtype=np.int64))
        )
    together = replace(together, initiation_number=np.arange(len(names)))
    return BatchSmoother(scans, together, states, last.floor, parameters, last.colour_variance)


def _sampled(
    smoother: BatchSmoother, scans: list[SmoothedScan], times_ns: Ints, up: Floats | None
) -> tuple[FollowedTrack, ...]:
    """The accepted tracks at the wanted times."""
    count = len(smoother.tracks)
    odds = np.full(count, 0.0)
    for scan in scans:
        np.add.at(odds, scan.row, scan.odds)
    scan_ns = np.array([scan.now_ns for scan in scans])
    interval_ns = float(np.median(np.diff(scan_ns))) if len(scan_ns) > 1 else 0.0
    coasting_ns = max(_COASTING_S * NANOSECONDS, 1.5 * interval_ns)
    out = []
    detections: list[list[tuple[str, int, int]]] = [[] for _ in range(count)]
    seen_ns: list[list[int]] = [[] for _ in range(count)]
    lasted: list[dict[str, float]] = [defaultdict(float) for _ in range(count)]  # seconds that each camera saw it
    for recorded in smoother.scans:
        for one in recorded.frames:
            for row, j in zip(one.ids.tolist(), one.column.tolist(), strict=True):
                detections[row].append((one.frame.camera.name, one.frame.sequence, j))
                seen_ns[row].append(one.frame.reference_ns)
                lasted[row][one.frame.camera.name] += one.statistics.interval_s
    own: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for index, scan in enumerate(scans):
        for place, row in enumerate(scan.row.tolist()):
            own[row].append((index, place))
    absent = _absences(scans, count)
    for row in range(count):
        if not seen_ns[row] or odds[row] < _MIN_LOG_ODDS:
            continue
        at = scan_ns[[index for index, _ in own[row]]]
        mean = np.array([scans[index].mean[place] for index, place in own[row]])
        covariance = np.array([scans[index].covariance[place] for index, place in own[row]])
        seen = np.sort(np.array(seen_ns[row]))
        inside = (times_ns > seen[0] - 0.5 * interval_ns) & (times_ns < seen[-1] + 0.5 * interval_ns)
        for begin, end in absent[row]:
            inside &= (times_ns <= begin + 0.5 * interval_ns) | (times_ns >= end - 0.5 * interval_ns)
        wanted = times_ns[inside]
        if not len(wanted):
            continue
        nearest = _nearest(at, wanted)
        elapsed = (wanted - at[nearest]) / NANOSECONDS
        position = mean[nearest][:, POSITION] + elapsed[:, None] * mean[nearest][:, VELOCITY]
        size = np.exp(mean[nearest][:, LOG_SIZE])
        model = TARGET_MODELS[int(smoother.tracks.kind[row])]
        if up is not None and model.upright:
            position = position - 0.5 * size[:, None] * up
        spread = covariance[nearest]
        across = np.trace(spread, axis1=1, axis2=2) - (0.0 if up is None else np.einsum("i,nij,j->n", up, spread, up))
        std = np.sqrt(across / (3.0 if up is None else 2.0))
        unseen = np.abs(seen[_nearest(seen, wanted)] - wanted)
        if not model.upright:  # without a floor one camera alone gives a direction: the place is a guess
            placed = (std < size) & (sorted([0.0, *lasted[row].values()])[-2] >= CORRELATION_S)
            wanted, position, std, size, unseen = (one[placed] for one in (wanted, position, std, size, unseen))
            if not len(wanted):
                continue
        out.append(
            (seen[0], model.kind, wanted / NANOSECONDS, position, std, size, unseen <= coasting_ns, detections[row])
        )
    out.sort(key=lambda one: one[0])
    return tuple(
        FollowedTrack(number, kind, times, position, std, size, confirmed, tuple(found))
        for number, (_, kind, times, position, std, size, confirmed, found) in enumerate(out, 1)
    )


def _nearest(times: Ints, wanted: Ints) -> Ints:
    """Indices (n,) of the times, which ascend, that are nearest to the wanted ones (n,)."""
    after = np.searchsorted(times, wanted).clip(max=len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(times[after] - wanted) < np.abs(wanted - times[before]), after, before)


def _absences(scans: list[SmoothedScan], count: int) -> list[list[tuple[int, int]]]:
    """Of each track, the spans [ns] between two detections in which it was more probably out of all cameras' sight."""
    out: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    last, unseen = np.full(count, -1), np.zeros(count)
    for scan in scans:
        hit, missed = scan.row[scan.hits > 0], scan.hits == 0
        for row in hit[(unseen[hit] < LOG_ABSENT) & (last[hit] >= 0)].tolist():
            out[row].append((int(last[row]), scan.now_ns))
        last[hit], unseen[hit] = scan.now_ns, 0.0
        unseen[scan.row[missed]] += scan.odds[missed]
    return out


def _unused(summaries: dict[str, CameraSummary]) -> list[str]:
    """A warning for each camera whose detections are of those that the others see much less often than the others'."""
    lines = []
    for name, one in summaries.items():
        others = [other.used for key, other in summaries.items() if key != name and other.detections]
        usual = float(np.median(others)) if len(others) > 1 else 0.0
        if one.detections >= _MIN_DETECTIONS and one.used < _MIN_USED * usual:
            lines.append(
                f"{name}: {100 * one.used:.0f} % of its detections are of somebody who is followed, of the others' "
                f"{100 * usual:.0f} %: are its pixels, pose and time offset right?"
            )
    return lines


def _summaries(
    smoother: BatchSmoother | None, state: MultiTargetState, cameras: dict[str, TrackingCamera]
) -> dict[str, CameraSummary]:
    frames = dict.fromkeys(cameras, 0)
    detections, used = dict(frames), dict(frames)
    for scan in smoother.scans if smoother is not None else ():
        for one in scan.frames:
            name = one.frame.camera.name
            frames[name] += 1
            detections[name] += len(one.frame)
            used[name] += len(one.ids)
    return {
        name: CameraSummary(
            frames[name],
            detections[name],
            used[name] / max(detections[name], 1),
            state.statistics[name].clutter if name in state.statistics else 0.0,
            state.statistics[name].clear if name in state.statistics else 0.0,
        )
        for name in cameras
    }
