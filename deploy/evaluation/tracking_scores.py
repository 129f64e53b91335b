"""Scores of followed people or vehicles against ground truth, computed by TrackEval (the extra ``evaluation``).

MODA, MOTA: Bernardin and Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics" (2008).
IDF1: Ristani et al., "Performance measures and a data set for multi-target, multi-camera tracking" (2016). HOTA: Luiten
et al., "HOTA: a higher order metric for evaluating multi-object tracking" (2021).
"""

from __future__ import annotations

import cmath
import io
import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from protocols.core.errors import InputError
from protocols.core.ranges import MAX_LENGTH, MAX_TIME_S
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.csv_table import read_csv_header, read_csv_table

MATCH_M = 0.5
"""Largest distance on the ground [m] of a track from the person that it follows."""
_LEVEL = 0.95  # cosine of 18° between z and the vertical: distances in x and y are those on the ground within 5 %
_MIN_RECALL, _OTHER_FRAME = 0.5, 0.8
"""Recall below which another frame of the truth is looked for, and from which one is named."""
_MIN_COMMON, _MIN_CORRELATION, _MIN_EXTENT_M = 10, 0.9, 2.0
"""Common instants, correlation and extent of a person's and a track's path that give a frame: a point fits anything."""
_MAX_LATE_S = 10.0  # of times that are tried: clocks that were set by hand differ by seconds
_MOST_INSTANTS = 200  # in which another frame is looked for, to bound its time
_SMALL = 0.03  # change of scale, or turn [rad], that a path's noise explains
_INSTALL = "pip install --no-deps trackeval (its other requirements, a second OpenCV among them, are not needed)"


class ScoredTrack(Protocol):
    """A track as ``hub.tracking.offline`` gives it."""

    @property
    def id(self) -> int: ...
    @property
    def times(self) -> Floats: ...
    @property
    def position(self) -> Floats: ...


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """n true positions. time: (n,) reference time [s]. person: (n,) numbers 0, 1, …. place: (n, 2) x, y."""

    time: Floats
    person: Ints
    place: Floats

    def select(self, kept: Bools) -> GroundTruth:
        """Only some of the rows (n,)."""
        return GroundTruth(self.time[kept], self.person[kept], self.place[kept])


def read_ground_truth(file: Path, frame_times: Mapping[int, float] | None) -> GroundTruth:
    """Read frame or time, person, x, y[, z]; where both stand, time counts.

    frame_times: reference time [s] of each frame number, for a file without times; None = frame numbers are taken as
    times, where the file is only checked. Raises InputError.
    """
    timed = "time" in read_csv_header(file, "truth")
    table = read_csv_table(file, "truth", ("time" if timed else "frame", "person", "x", "y"))
    if timed:
        time = table.numbers("time", MAX_TIME_S)
    else:
        frame = table.whole("frame").tolist()
        frame_times = {number: float(number) for number in frame} if frame_times is None else frame_times
        known = np.array([number in frame_times for number in frame])
        if not known.any():
            what = f"frame {frame[0]} is none of the followed frames ({min(frame_times)} to {max(frame_times)})"
            raise InputError(what, file=file, line=table.line[0], remedy="give time in place of frame")
        time = np.array([frame_times.get(number, math.nan) for number in frame])
    people = table.text("person")
    names = {name: index for index, name in enumerate(dict.fromkeys(people))}
    person = np.array([names[name] for name in people], dtype=np.int64)
    place = np.column_stack([table.numbers(name, MAX_LENGTH) for name in ("x", "y")])
    pairs: dict[tuple[float, int], int] = {}
    for row, key in enumerate(zip(time.tolist(), person.tolist(), strict=True)):
        if pairs.setdefault(key, row) != row:
            what = f"person {people[row]!r} is at two places at one time"
            raise InputError(what, file=file, line=table.line[row], remedy="keep one row a person a time")
    truth = GroundTruth(time, person, place)
    return truth.select(np.isfinite(time))


def check_area(truth: GroundTruth, area: tuple[float, float, float, float]) -> None:
    """Raise InputError where nobody is in the area."""
    if not _inside(truth.place, area).any():
        what = f"no person of the truth is in the area {','.join(f'{limit:g}' for limit in area)}"
        raise InputError(what, remedy="give --area in the calibration's world and units")


def check_level(up: Floats | None, calibration: Path) -> None:
    """Raise InputError where x and y are not along the ground. up: (3,) in the calibration's world; None = unknown."""
    if up is not None and abs(up[2]) < _LEVEL:
        direction = ", ".join(f"{value:.2f}" for value in up + 0.0)
        raise InputError(
            f"the vertical is [{direction}] in the calibration's world: x and y of a truth are not on the ground",
            file=calibration,
            remedy="give a calibration and a truth whose z is up, or leave out --truth",
        )


def parse_area(text: str) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 of ``--area``. Raises InputError."""
    remedy = "give --area x0,x1,y0,y1 in the calibration's units, as in -3,9,-9,27"
    try:
        x0, x1, y0, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--area {text!r} is not four numbers", remedy=remedy) from None
    if not (x0 < x1 and y0 < y1 and all(map(math.isfinite, (x0, x1, y0, y1)))):
        raise InputError(f"--area {text!r} is empty", remedy=remedy)
    return x0, x1, y0, y1


def score_tracks(
    truth: GroundTruth,
    tracks: Sequence[ScoredTrack],
    times: Sequence[float],
    units_per_m: float,
    area: tuple[float, float, float, float] | None = None,
) -> dict[str, float | int | None]:
    """Scores at the instants of the truth that lie in the followed span, in the horizontal plane of x and y.

    times: sorted reference times [s] at which tracks were wanted; between two of them a track is interpolated. Within
    ``MATCH_M`` a track can match a person; HOTA averages over the limits from 5 to 95 cm that come of TrackEval's
    similarity 1 - distance / 1 m. area: x0, x1, y0, y1 outside of which neither truth nor tracks count.

    moda, mota, idf1, hota, deta, assa: up to 1. recall, precision. truths, matches, misses, false, switches, fragments:
    counts. error: mean distance of matches [m]. people: of the truth. tracks: that were scored. instants: scored; left:
    instants of the truth outside the followed span. Raises InputError where TrackEval is missing, nothing overlaps, or
    the truth fits the tracks in another frame alone.
    """
    metrics = trackeval_metrics()
    every = np.unique(truth.time)
    half = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.5
    moments = every[(every >= times[0] - half) & (every <= times[-1] + half)]
    if not len(moments):
        spans = f"{every[0]:g} to {every[-1]:g} s", f"{times[0]:g} to {times[-1]:g} s"
        what = f"the truth ({spans[0]}) and the tracks ({spans[1]}) do not overlap"
        raise InputError(what, remedy="give its times on the calibration's reference clock")
    found = _places_at(tracks, moments, times)
    if other := other_frame(truth, tracks, times, units_per_m):
        raise InputError(
            f"the truth is in another frame than the tracks: it fits them {other}",
            remedy="give it in the calibration's world and units, at times on the reference clock",
        )
    gt_ids, ids, similarity = [], [], []
    for index, moment in enumerate(moments):
        here = truth.select(truth.time == moment)
        there = [(track, place[index]) for track, place in found.items() if np.isfinite(place[index]).all()]
        places = np.array([place for _, place in there]).reshape(-1, 2)
        inside = _inside(here.place, area)
        here = here.select(inside)
        near = _inside(places, area)
        distance = np.linalg.norm(here.place[:, None] - places[near][None], axis=2) / units_per_m
        gt_ids.append(here.person)
        ids.append(np.array([track for (track, _), kept in zip(there, near, strict=True) if kept], dtype=np.int64))
        similarity.append(np.maximum(0.0, 1.0 - distance * (0.5 / MATCH_M)))
    data = _numbered(gt_ids, ids, similarity)
    results: dict[str, Any] = {}
    for metric in metrics:
        results |= metric.eval_sequence(data)
    matches = int(results["CLR_TP"])
    return {
        "moda": _or_none(results["MODA"], data["num_gt_dets"]),
        "mota": _or_none(results["MOTA"], data["num_gt_dets"]),
        "idf1": _or_none(results["IDF1"], data["num_gt_dets"]),
        "hota": _or_none(np.mean(results["HOTA"]), data["num_gt_dets"]),
        "deta": _or_none(np.mean(results["DetA"]), data["num_gt_dets"]),
        "assa": _or_none(np.mean(results["AssA"]), data["num_gt_dets"]),
        "recall": _or_none(results["CLR_Re"], data["num_gt_dets"]),
        "precision": _or_none(results["CLR_Pr"], data["num_tracker_dets"]),
        "truths": data["num_gt_dets"],
        "matches": matches,
        "misses": int(results["CLR_FN"]),
        "false": int(results["CLR_FP"]),
        "switches": int(results["IDSW"]),
        "fragments": int(results["Frag"]),
        "error": _or_none(2.0 * MATCH_M * (1.0 - results["MOTP"]), matches),
        "people": data["num_gt_ids"],
        "tracks": data["num_tracker_ids"],
        "instants": len(moments),
        "left": len(every) - len(moments),
    }


def other_frame(truth: GroundTruth, tracks: Sequence[ScoredTrack], times: Sequence[float], units_per_m: float) -> str:
    """How the truth fits the tracks at other times, or in another world or unit; "" where it fits, or nothing helps.

    The similarity of the plane, mirrored or not, in which one person's path fits a track's best has to fit most places
    of all.
    """
    reach, step = MATCH_M * units_per_m, float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    if not tracks or _recall(truth, tracks, times, reach) >= _MIN_RECALL:
        return ""
    moments = np.unique(truth.time)
    some = moments[np.linspace(0, len(moments) - 1, min(len(moments), _MOST_INSTANTS)).astype(int)]
    truth = truth.select(np.isin(truth.time, some))
    lates = np.arange(-_MAX_LATE_S, _MAX_LATE_S, max(step, 0.1))
    recalls = np.array([_recall(replace(truth, time=truth.time + late), tracks, times, reach) for late in lates])
    if recalls.max() >= _OTHER_FRAME:
        late = float(lates[recalls == recalls.max()].mean())
        return f"{abs(late):.1f} s {'later' if late > 0 else 'earlier'}"
    given, best, text = truth.place @ np.array([1.0, 1j]), 0.0, ""
    paths = (place @ np.array([1.0, 1j]) for place in _places_at(tracks, truth.time, times).values())
    for person, path in itertools.product(np.unique(truth.person), list(paths)):
        common = (truth.person == person) & np.isfinite(path)
        if common.sum() < _MIN_COMMON or np.abs(path[common] - path[common][0]).max() < _MIN_EXTENT_M * units_per_m:
            continue
        for source in (given, given.conj()):
            middle, target = source[common].mean(), path[common].mean()
            a, b = source[common] - middle, path[common] - target
            product, power = np.vdot(a, b), np.vdot(a, a).real
            if abs(product) <= _MIN_CORRELATION * np.sqrt(power * np.vdot(b, b).real):
                continue
            factor = product / power
            moved = factor * (source - middle) + target
            recall = _recall(replace(truth, place=np.column_stack([moved.real, moved.imag])), tracks, times, reach)
            if recall > best:
                best, text = recall, _similarity_text(source is not given, factor, target - factor * middle, reach)
    return text if best >= _OTHER_FRAME else ""


def _similarity_text(mirrored: bool, factor: complex, shift: complex, reach: float) -> str:
    """A similarity of the plane in words, without what changes nothing. shift: beyond ``reach`` it counts."""
    degrees = math.degrees(cmath.phase(factor))
    parts = [
        (mirrored, "with the sign of y changed"),
        (abs(math.log(abs(factor))) > _SMALL, f"times {abs(factor):.3g}"),
        (abs(math.radians(degrees)) > _SMALL, f"turned by {degrees:.0f} degrees"),
        (abs(shift) > 0.5 * reach, f"shifted by {shift.real:.2f}, {shift.imag:.2f}"),
    ]
    return ", ".join(text for counts, text in parts if counts)


def _recall(truth: GroundTruth, tracks: Sequence[ScoredTrack], times: Sequence[float], reach: float) -> float:
    """Share of the truth's places in the followed span that have a track within ``reach``."""
    here = truth.select((truth.time >= times[0]) & (truth.time <= times[-1]))
    places = np.array(list(_places_at(tracks, here.time, times).values()))
    if not len(here.time):
        return 0.0
    distance = np.linalg.norm(places - here.place, axis=2)
    return float((np.nan_to_num(distance, nan=np.inf).min(axis=0) <= reach).mean())


def _inside(place: Floats, area: tuple[float, float, float, float] | None) -> Bools:
    if area is None:
        return np.ones(len(place), dtype=np.bool_)
    low, high = np.array(area[::2]), np.array(area[1::2])
    return np.asarray(((place >= low) & (place <= high)).all(axis=1))


def _places_at(tracks: Sequence[ScoredTrack], moments: Floats, times: Sequence[float]) -> dict[int, Floats]:
    """x, y (t, 2) of each track at the moments, NaN where it does not exist: linear between neighbouring times."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    out = {}
    for track in tracks:
        before = np.clip(np.searchsorted(track.times, moments, "right") - 1, 0, len(track.times) - 1)
        after = np.minimum(before + 1, len(track.times) - 1)
        low, high = track.times[before], track.times[after]
        between = (low <= moments) & (moments <= high) & (high - low <= 1.5 * step)
        nearest = np.where(np.abs(moments - low) <= np.abs(high - moments), before, after)
        near = np.abs(track.times[nearest] - moments) <= 0.5 * step
        line = np.column_stack([np.interp(moments, track.times, track.position[:, axis]) for axis in (0, 1)])
        held = np.where(near[:, None], track.position[nearest, :2], np.nan)
        out[track.id] = np.where(between[:, None], line, held)
    return out


def _numbered(gt_ids: list[Ints], ids: list[Ints], similarity: list[Floats]) -> dict[str, Any]:
    """TrackEval's input: identities numbered from 0."""
    gt_names = np.unique(np.concatenate([*gt_ids, np.zeros(0, np.int64)]))
    names = np.unique(np.concatenate([*ids, np.zeros(0, np.int64)]))
    return {
        "num_timesteps": len(gt_ids),
        "gt_ids": [np.searchsorted(gt_names, part) for part in gt_ids],
        "tracker_ids": [np.searchsorted(names, part) for part in ids],
        "similarity_scores": similarity,
        "num_gt_dets": int(sum(map(len, gt_ids))),
        "num_tracker_dets": int(sum(map(len, ids))),
        "num_gt_ids": len(gt_names),
        "num_tracker_ids": len(names),
    }


def trackeval_metrics() -> list[Any]:
    """TrackEval's HOTA, CLEAR and Identity, matching from a similarity of 0.5 on. Raises InputError."""
    try:
        with redirect_stdout(io.StringIO()):  # its import prints which of its other requirements are missing
            from trackeval.metrics import CLEAR, HOTA, Identity
    except ImportError as error:
        raise InputError(f"TrackEval, which scores tracks, is not installed ({error})", remedy=_INSTALL) from None
    quiet = {"PRINT_CONFIG": False, "THRESHOLD": 0.5}
    return [HOTA(), CLEAR(dict(quiet)), Identity(dict(quiet))]


def _or_none(value: Any, count: int) -> float | None:
    return float(value) if count and math.isfinite(value) else None
