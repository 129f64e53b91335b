"""What the rig states as known: tests of measured lenses, and what an error of a given value would do to the answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.bundle.covariance import Covariance
from hub.bundle.model_comparison import LENS, ScoreTest, mirrored_axis, refuted_lenses
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, Column, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from protocols.session.calibration import Sensitivity
from protocols.session.rig import Rig

_LENS_STD = 0.01
"""Relative std of a measured focal length for which no std is given: as `--refine-lenses` allows for."""


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
