"""Scale bars (`wand` in rig.toml): two labelled points at a known distance, which fix the scale without a survey."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.datum.gauge import Gauge
from hub.bundle.initialisation import observation_times, seen_by_two
from hub.bundle.problem import AdjustmentState, Problem
from protocols.core.errors import Refused
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Floats
from protocols.session.rig import Rig

_SAMPLING_STEP = 0.05  # s between samples
_MIN_SAMPLES = 10  # of a bar's length
_MAX_LENGTH_SPREAD = 0.2  # relative robust spread of the length; more means that it is not rigid
_CORRELATION_TIME = 0.25  # s between samples with independent errors
_MIN_STD = 1e-4  # relative: lower bound of the std
_MAX_CONFLICT_SIGMAS = 5.0  # once in 1.7 million by chance
_GIVEN_LENGTH_STD, _MAX_DISAGREEMENT = 2e-3, 0.02  # relative: 1 mm in half a metre of a tape measure; ten times that


@dataclass(frozen=True, slots=True)
class ScaleBarMeasurement:
    """One scale bar measured from the trajectories. length: given [rig units]. measured: in the solution's units.
    std: relative, of the measurement."""

    labels: tuple[str, str]
    length: float
    measured: float
    std: float


def measure_scale_bars(
    rig: Rig, labels: list[str], problem: Problem, state: AdjustmentState
) -> list[ScaleBarMeasurement]:
    """The rig's scale bars whose two labels are seen together. Raises Refused where one is not rigid."""
    out = []
    for a, b, length in rig.scale_bars:
        if a not in labels or b not in labels:
            continue
        distances = _distances(problem, state, labels.index(a), labels.index(b))
        if len(distances) < _MIN_SAMPLES:
            continue
        median = float(np.median(distances))
        spread = 1.4826 * float(np.median(np.abs(distances - median))) / median
        if spread > _MAX_LENGTH_SPREAD:
            raise Refused(
                f"the length of the scale bar (wand) {a}–{b} varies by {100 * spread:.0f} % while it moves: "
                "are these its two ends?"
            )
        std = 1.2533 * spread / np.sqrt(max(len(distances) * _SAMPLING_STEP / _CORRELATION_TIME, 1.0))
        out.append(ScaleBarMeasurement((a, b), length, median, float(std)))
    return out


def scaled_by_bars(gauge: Gauge, bars: list[ScaleBarMeasurement]) -> Gauge:
    """The gauge at the bars' scale, weighted by their stds, unless control points fix the scale; warns of conflicts."""
    if not bars:
        return gauge
    s = gauge.similarity
    factor = np.array([bar.length / (s.scale * bar.measured) for bar in bars])
    weight = np.array([max(bar.std, _MIN_STD) ** -2 for bar in bars])
    mean = float((weight * factor).sum() / weight.sum())
    if gauge.scale == "metric":
        std = max(float(weight.sum() ** -0.5), _GIVEN_LENGTH_STD)
        if abs(mean - 1.0) <= _MAX_CONFLICT_SIGMAS * std:
            return gauge
        comparison = f"{100 * abs(mean - 1.0):.1f} % {'longer' if mean > 1 else 'shorter'}"
        warning = f"the scale bar (wand) is {comparison} by its given length than by the control points, which are used"
        return replace(gauge, warnings=(*gauge.warnings, warning))
    warnings = tuple(text for text in gauge.warnings if "fix no scale" not in text)
    spread = float(np.abs(factor / mean - 1.0).max())
    if spread > _MAX_DISAGREEMENT:
        warnings += (f"the scale bars (wands) disagree by {100 * spread:.1f} %: is one of the given lengths wrong?",)
    return replace(
        gauge, similarity=Similarity(mean * s.scale, s.rotation, mean * s.shift), scale="metric", warnings=warnings
    )


def _distances(problem: Problem, state: AdjustmentState, a: int, b: int) -> Floats:
    """Distances (n,) between two trajectories at times when at least two cameras see each."""
    paths = [state.trajectories[label] for label in (a, b)]
    begin = max(path.basis.begin for path in paths)
    end = min(path.basis.end for path in paths)
    time = np.arange(begin, end, _SAMPLING_STEP)
    if not len(time):
        return np.zeros(0)
    seen_a, seen_b = (seen_by_two(observation_times(problem, state, label), time) for label in (a, b))
    distance = np.linalg.norm(paths[0].at(time) - paths[1].at(time), axis=1)
    return np.asarray(distance[seen_a & seen_b & np.isfinite(distance)])
