"""Whether a calibration's clocks are those of the recording: people, or vehicles, of two cameras meet at its lags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from hub.calibration.people.feet import (
    FRAMES,
    GROUND_STEP,
    GROUND_STEPS,
    MIN_LOOKED_AT,
    WITHIN,
    at_same_time,
    on_ground,
    seen_feet,
)
from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.target_models import PERSON
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration
from protocols.session.rig import METRES_PER_UNIT

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration

_SHIFT_S = 0.2  # within which a car at 10 m/s drives half its length
_SHIFTS_S: Floats = _SHIFT_S * np.arange(-75.0, 76.0)
"""Lags [s] that are tried: up to what videos that are started by hand differ by."""
_IS_GIVEN = np.abs(_SHIFTS_S) <= 2 * _SHIFT_S  # which of them are as good as none
_MIN_IN_PLANE = 0.5
"""Share of one camera's boxes with one of the other's in the epipolar plane, at the best lag, that is no chance: with
at most half of it at the given one, none of 17 simulated rigs with right offsets was warned of, 38 of 68 others."""
_MIN_MET_THERE, _MIN_OF_BEST = 0.3, 0.5
"""Share of people of one camera who are where another one sees somebody, at the best lag, that is no chance; and the
share of that at the given lag from which on this is right. Of 30 recordings of simulated rooms with right
clocks, and right or wrong poses, lenses and scales, none was warned of; with a clock 1.5 s off five of six rooms."""


def shifted_vehicles(messages: Sequence[pb.Observation], known: GivenCalibration) -> tuple[str, ...]:
    """A warning where vehicles of two cameras lie in one epipolar plane far more often at another lag."""
    seen = {name: _vehicle_rays(camera, messages) for name, camera in known.calibration.cameras.items()}
    pairs = dict[tuple[str, str], Floats]()
    for a, b in combinations([name for name, (times, *_) in seen.items() if len(times)], 2):
        times, rays, _ = seen[a]
        others, candidates, radius = seen[b]
        some = np.unique(np.linspace(0, len(times) - 1, 2 * FRAMES).astype(int))
        places = [known.calibration.cameras[name].pose.position for name in (a, b)]
        planes = np.cross(places[1] - places[0], rays[some])
        planes /= np.maximum(np.linalg.norm(planes, axis=2, keepdims=True), 1e-300)

        def met(at: Ints, planes: Floats = planes, candidates: Floats = candidates, radius: Floats = radius) -> Bools:
            off = np.abs(np.einsum("nix,njx->nij", planes, candidates[at]))
            return np.asarray((off < radius[at][:, None]).any(axis=2))

        pairs[a, b] = _shares(_SHIFTS_S, times[some], others, np.isfinite(planes[:, :, 0]), met)
    return _other_lags(pairs, "vehicles", _MIN_IN_PLANE)


def shifted_people(
    messages: Sequence[pb.Observation], known: GivenCalibration, up: Floats, usual: float
) -> tuple[str, ...]:
    """A warning where people of two cameras stand at one place far more often at another lag.

    On level ground, where most meet at the best lags: people's mean height does not tell it well enough. usual: where
    it would be along ``up`` (3,) if all were of `PERSON`'s size [units of the calibration].
    """
    step = GROUND_STEP * PERSON.size_m / METRES_PER_UNIT[known.calibration.units]
    grounds: Floats = usual + step * np.arange(-GROUND_STEPS, GROUND_STEPS + 1.0)
    seen = {name: seen_feet(one, messages) for name, one in known.calibration.cameras.items()}

    def most(levels: Floats, shifts: Floats) -> tuple[float, dict[tuple[str, str], Floats], float]:
        """Of these grounds the one on which most meet: their mean share in pairs of cameras, all shares, the ground."""
        met = [_meetings(seen, known, up, ground, shifts) for ground in levels]
        means = [float(np.mean([one.max() for one in pairs.values() if one.any()] or [0.0])) for pairs in met]
        best = int(np.argmax(means))
        return means[best], met[best], float(levels[best])

    ground = most(grounds, np.asarray(_SHIFTS_S[_IS_GIVEN]))[2]  # nearly always: lags are right
    mean, met, _ = most(np.array([ground]), _SHIFTS_S)
    if mean < _MIN_IN_PLANE:
        met = most(grounds, _SHIFTS_S)[1]
    return _other_lags(met, "people", _MIN_MET_THERE)


def _meetings(
    feet: Mapping[str, tuple[Floats, Floats]], known: GivenCalibration, up: Floats, ground: float, shifts: Floats
) -> dict[tuple[str, str], Floats]:
    """`_shares` of people who are where another camera sees somebody, by pair, on ground so far along ``up``."""
    seen = {
        name: (times, on_ground(known.calibration.cameras[name].pose, rays, up, ground))
        for name, (times, rays) in feet.items()
    }
    pairs, within = dict[tuple[str, str], Floats](), WITHIN * PERSON.size_m / METRES_PER_UNIT[known.calibration.units]
    for a, b in combinations([name for name, (times, _) in seen.items() if len(times) > 1], 2):
        (times, places), (others, candidates), camera = seen[a], seen[b], known.calibration.cameras[b]
        frame, place = np.nonzero(np.isfinite(places[:, :, 0]))
        some = np.unique(np.linspace(0, len(frame) - 1, 2 * FRAMES).astype(int)) if len(frame) else frame
        here, lens = places[frame[some], place[some]], camera.intrinsics
        pixel = lens.project(camera.pose.camera_from_world(here))
        inside = np.all((pixel > 0.0) & (pixel < [lens.width, lens.height]), axis=1, keepdims=True)

        def met(at: Ints, here: Floats = here, candidates: Floats = candidates) -> Bools:
            off = np.linalg.norm(here[:, None] - candidates[at], axis=2)
            return np.asarray((off < within).any(axis=1, keepdims=True))

        pairs[a, b] = _shares(shifts, times[frame[some]], others, inside, met)
    return pairs


def _shares(shifts: Floats, times: Floats, others: Floats, there: Bools, met: Callable[[Ints], Bools]) -> Floats:
    """Share at each shift [s] of what is looked for in one camera's frames (n,) that another one sees; 0 of few.

    times: (n,) of the frames; others: of all the other's, ascending [s]. there: (n, k) which of k things in a frame are
    looked for. met: whether they are (n, k) in these frames (n,) of the other.
    """
    shares = np.zeros(len(shifts))
    for number, shift in enumerate(shifts):
        nearest, at_once = at_same_time(times + shift, others)
        near = there & at_once[:, None]
        shares[number] = (met(nearest) & near).sum() / near.sum() if near.sum() >= MIN_LOOKED_AT else 0.0
    return shares


def _other_lags(pairs: Mapping[tuple[str, str], Floats], what: str, least: float) -> tuple[str, ...]:
    """A warning for each camera that fits others far better at another lag, in a share of ``least`` or more."""
    shifted = {
        pair: float(_SHIFTS_S[np.argmax(shares)])
        for pair, shares in pairs.items()
        if shares.max() >= least and shares[_IS_GIVEN].max() < _MIN_OF_BEST * shares.max()
    }
    out = []
    while shifted:
        count = Counter(name for pair in reversed(shifted) for name in reversed(pair))
        name = count.most_common(1)[0][0]
        mine = {pair: shift if name == pair[0] else -shift for pair, shift in shifted.items() if name in pair}
        others = ", ".join(other for pair in mine for other in pair if other != name)
        out.append(
            f"{name}: its {what} fit those of {others} with about {np.median(list(mine.values())):+.1f} s added to its "
            "time_offset: is the calibration of this recording?"
        )
        shifted = {pair: shift for pair, shift in shifted.items() if name not in pair}
    return tuple(out)


def _vehicle_rays(camera: CameraCalibration, messages: Sequence[pb.Observation]) -> tuple[Floats, Floats, Floats]:
    """Of n frames with boxes: reference times (n,) [s], directions in the world to k boxes (n, k, 3), NaN where a frame
    has fewer, and half the boxes' sizes (n, k) [rad]."""
    frames = [one for one in messages if one.camera == camera.name and any(len(d.box) == 4 for d in one.detections)]
    tracked = TrackingCamera.from_calibration(camera)
    times = np.array([tracked.reference_ns(one.device_time_ns) * 1e-9 for one in frames])
    frames, times = [frames[i] for i in np.argsort(times, kind="stable")], np.sort(times)
    if len(frames) < 2:
        return np.zeros(0), np.zeros((0, 0, 3)), np.zeros((0, 0))
    most = max(len(one.detections) for one in frames)
    boxes = np.full((len(frames), most, 4), np.nan)
    for row, one in zip(boxes, frames, strict=True):
        found = [list(d.box) for d in one.detections if len(d.box) == 4]
        row[: len(found)] = found
    middle = (boxes[:, :, :2] + 0.5 * boxes[:, :, 2:]).reshape(-1, 2)
    given = np.isfinite(middle[:, 0])
    rays = np.full((len(middle), 3), np.nan)
    rays[given] = np.column_stack([camera.intrinsics.unproject(middle[given]), np.ones(given.sum())])
    rays = rays @ camera.pose.rotation / np.linalg.norm(rays, axis=1, keepdims=True)
    radius = 0.5 * np.sqrt(boxes[:, :, 2] * boxes[:, :, 3]) / camera.intrinsics.focal
    return times, rays.reshape(len(frames), most, 3), radius
