"""What the rig states as known: tests of measured lenses, and what an error of a given value would do to the answer.

Of two labelled points at a known distance (scale bars, `wand` in rig.toml) the scale is taken without a survey.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.covariance import Covariance
from hub.bundle.datum.gauge import Gauge
from hub.bundle.initialisation import observation_times, seen_by_two
from hub.bundle.model_comparison import LENS, ScoreTest, mirrored_axis, refuted_lenses
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, Column, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior
from protocols.core.errors import Refused
from protocols.geometry.pose import Similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Sensitivity
from protocols.session.rig import Rig

_LENS_STD = 0.01
"""Relative std of a measured focal length for which no std is given: as `--refine-lenses` allows for."""

_SAMPLING_STEP = 0.05  # s between samples
_MIN_SAMPLES = 10  # of a bar's length
_MAX_LENGTH_SPREAD = 0.2  # relative robust spread of the length; more means that it is not rigid
_CORRELATION_TIME = 0.25  # s between samples with independent errors
_MIN_STD = 1e-4  # relative: lower bound of the std
_MAX_CONFLICT_SIGMAS = 5.0  # once in 1.7 million by chance
_GIVEN_LENGTH_STD, _MAX_DISAGREEMENT = 2e-3, 0.02  # relative: 1 mm in half a metre of a tape measure; ten times that


def refuted_lens(test: ScoreTest) -> str:
    """What the observations say about a measured lens."""
    change, std = test.change, np.sqrt(np.diag(test.covariance))
    text = f"focal length {100 * change[0]:+.2g} % ± {100 * std[0]:.1g} % off, k1 {change[1]:+.2g} ± {std[1]:.1g}"
    if len(std) > 2:
        text += f", principal point ({change[2]:+.0f}, {change[3]:+.0f}) px ± {max(std[2:]):.1g} px"
    return (
        f"its measured lens is refuted by the observations, which give a {text} "
        f"(chi-squared {test.statistic:.0f}, limit {test.limit:.0f})"
    )


def refuted_lens_warnings(
    names: list[str], problem: Problem, state: AdjustmentState, refine_lenses: bool = False
) -> tuple[str, ...]:
    """One sentence for each measured lens that the observations refute; the answer keeps it as given.

    Raises Refused where mirrored ones would fit: then the answer is a mirror image.
    """
    refuted = refuted_lenses(problem, state, LENS, LENS[:2])
    if refuted and (axis := mirrored_axis(problem, state)):
        side, size = ("right", "width") if axis == "u" else ("bottom", "height")
        raise Refused(
            f"every camera's picture is mirrored: the measured lenses are refuted, and fit with {axis} counted from "
            f"the {side}; give {axis} from the other side, {size} - 1 - {axis}, as of the pictures that the lenses "
            "were measured with"
        )
    remedy = "correct it" if refine_lenses else "correct it, or estimate it with --refine-lenses"
    return tuple(f"{names[one.camera]}: {refuted_lens(one)}; it was kept as given: {remedy}" for one in refuted)


def sensitivities(
    rig: Rig, names: list[str], problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, found: Covariance
) -> list[tuple[Sensitivity, ...]]:
    """By camera: what an error of one std of its given position, rotation and lens would do to the answer.

    problem, state, found: in the published world, the references among the covariance's information. With the normal
    matrix N and its inverse C the answer moves by C times the pull of the error: C[:, i] / std for a reference of
    parameter i or a focal length, whose weight is 1 / std², and -C N[:, f] std for a focal length f that was held. Of
    three axes, the worst one. References without std have no error to speak of, and unknown lenses are not given.
    """
    free, base = problem.free_parameters, problem.free_columns
    if not free.pose:
        return [() for _ in names]
    lenses: dict[int, Floats] = {}
    held = [i for i in range(len(names)) if problem.lens_prior(i) is None and not free.lens]
    if held:
        freed = replace(problem, free_parameters=replace(free, lens=True))
        system, columns = build_system(freed, state, prior, robust=False)[0], freed.free_columns
        focal = np.searchsorted(columns, np.array(held) * CAMERA_PARAMETERS + Column.FOCAL)
        normal = system.corner.columns(focal)[np.searchsorted(columns, base)]
        # The paths were eliminated for the covariance: all but the focal lengths' columns of the border is in A⁻¹ B.
        for (_, seeing, border), (_, own, solved) in zip(system.border.parts, found.a_inv_b.parts, strict=True):
            here = np.flatnonzero(np.isin(seeing, focal))
            normal[np.ix_(own, np.searchsorted(focal, seeing[here]))] -= solved.T @ border[:, here]
        changes = -found.spread(found.free @ normal)
        lenses = dict(zip(held, changes.T, strict=True))
    out: list[tuple[Sensitivity, ...]] = []
    for i, name in enumerate(names):
        camera, mine = rig.cameras[name], list[Sensitivity]()
        for given, std, first in (("position", camera.position_std, 3), ("rotation", camera.rotation_std, 0)):
            value = camera.position if given == "position" else camera.rotation
            if value is None or std is None or not (std > 0.0).all():
                continue
            axes = (base[:, None] == i * CAMERA_PARAMETERS + first + np.arange(3)) / std
            moved = zip(found.spread(found.free @ axes).T, std.tolist(), strict=True)
            effects = [_effect(given, one, change, names, problem) for change, one in moved]
            mine.append(max(effects, key=lambda effect: effect.position))
        lens, std_of_lens = problem.lens_prior(i), camera.focal_std or _LENS_STD
        if i in lenses:
            mine.append(_effect("lens", std_of_lens, std_of_lens * lenses[i], names, problem))
        elif camera.is_measured and lens is not None:
            pull = (base == i * CAMERA_PARAMETERS + Column.FOCAL) / lens.focal_std
            mine.append(_effect("lens", lens.focal_std, found.spread(found.free @ pull), names, problem))
        out.append(tuple(mine))
    return out


def _effect(given: str, std: float, change: Floats, names: list[str], problem: Problem) -> Sensitivity:
    """The effect of a change (18 n,) of all cameras' parameters."""
    by_camera = change.reshape(len(names), CAMERA_PARAMETERS)
    moved = np.linalg.norm(by_camera[:, 3:6], axis=1)
    lags = by_camera[:, Column.OFFSET] - by_camera[problem.clock_reference, Column.OFFSET]
    farthest = int(np.argmax(moved))
    return Sensitivity(given, std, float(moved[farthest]), names[farthest], float(np.abs(lags).max()))


@dataclass(frozen=True, slots=True)
class ScaleBarMeasurement:
    """One scale bar measured from the trajectories. length: given [rig units]. measured: in the solution's units.
    std: relative, of the measurement."""

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
        out.append(ScaleBarMeasurement(length, median, float(std)))
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
