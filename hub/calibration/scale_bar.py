"""A wand: two labelled points at a known distance from each other, which tells the scale without a survey."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.problem import Problem, State
from hub.datum.gauge import Gauge
from protocols.core.errors import Refused
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Bools, Floats
from protocols.session.rig import Rig

_WITHIN = 0.2  # s: a point counts as seen by a camera if it saw it this near
_STEP = 0.05  # s between looks
_LEAST = 10
_STIFF = 0.2  # robust spread of a wand's length, relative: more is no wand
_INDEPENDENT = 0.25  # s between looks whose errors are independent
_LEAST_STD = 1e-4  # relative: no wand is measured better
_FAR, _TOLD_STD, _DISAGREE = 5.0, 2e-3, 0.02


@dataclass(frozen=True, slots=True)
class WandLength:
    """One wand as the paths measure it. length: told [rig units]. measured: the same in the solution's units.
    std: relative, of the measurement."""

    labels: tuple[str, str]
    length: float
    measured: float
    std: float


def measured_wands(rig: Rig, labels: list[str], problem: Problem, state: State) -> list[WandLength]:
    """The rig's wands whose two labels are seen together. Raises Refused where one bends."""
    out = []
    for a, b, length in rig.wands:
        if a not in labels or b not in labels:
            continue
        apart = _apart(problem, state, labels.index(a), labels.index(b))
        if len(apart) < _LEAST:
            continue
        middle = float(np.median(apart))
        spread = 1.4826 * float(np.median(np.abs(apart - middle))) / middle
        if spread > _STIFF:
            raise Refused(
                f"the wand {a}–{b} is {100 * spread:.0f} % longer and shorter while it moves: are these its two ends?"
            )
        std = 1.2533 * spread / np.sqrt(max(len(apart) * _STEP / _INDEPENDENT, 1.0))
        out.append(WandLength((a, b), length, middle, float(std)))
    return out


def scaled_by_wands(gauge: Gauge, wands: list[WandLength]) -> Gauge:
    """The world at the wands' scale, each weighed by its std, where nothing else tells it; a warning if they differ."""
    if not wands:
        return gauge
    s = gauge.similarity
    factor = np.array([wand.length / (s.scale * wand.measured) for wand in wands])
    weight = np.array([max(wand.std, _LEAST_STD) ** -2 for wand in wands])
    mean = float((weight * factor).sum() / weight.sum())
    if gauge.scale == "metric":
        std = max(float(weight.sum() ** -0.5), _TOLD_STD)
        if abs(mean - 1.0) <= _FAR * std:
            return gauge
        warning = f"the wand is {100 * abs(mean - 1.0):.1f} % {'longer' if mean > 1 else 'shorter'} by its told length"
        return replace(gauge, warnings=(*gauge.warnings, f"{warning} than by the other references, which decide"))
    warnings = tuple(text for text in gauge.warnings if "fix no scale" not in text)
    spread = float(np.abs(factor / mean - 1.0).max())
    if spread > _DISAGREE:
        warnings += (f"the wands disagree by {100 * spread:.1f} %: is one told wrongly?",)
    return replace(
        gauge, similarity=Similarity(mean * s.scale, s.rotation, mean * s.shift), scale="metric", warnings=warnings
    )


def _apart(problem: Problem, state: State, a: int, b: int) -> Floats:
    """Distances (n,) between two paths where at least two cameras see each."""
    paths = [state.trajectories[label] for label in (a, b)]
    begin = max(path.basis.begin for path in paths)
    end = min(path.basis.end for path in paths)
    time = np.arange(begin, end, _STEP)
    if not len(time):
        return np.zeros(0)
    good = _seen(problem, state, a, time) & _seen(problem, state, b, time)
    distance = np.linalg.norm(paths[0].at(time) - paths[1].at(time), axis=1)
    return np.asarray(distance[good & np.isfinite(distance)])


def _seen(problem: Problem, state: State, label: int, time: Floats) -> Bools:
    count = np.zeros(len(time))
    for number, camera in enumerate(state.cameras):
        mine = [rows.time[rows.use] for rows in problem.rows if rows.camera == number and rows.label == label]
        joined = np.concatenate(mine) if mine else np.zeros(0)
        if len(joined) < 2:
            continue
        seen = np.sort(camera.reference_time(joined))
        after = np.clip(np.searchsorted(seen, time), 1, len(seen) - 1)
        count += np.minimum(np.abs(seen[after] - time), np.abs(time - seen[after - 1])) <= _WITHIN
    return count >= 2
