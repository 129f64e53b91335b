"""What a calibration warns of: lengths, lenses, clocks, detectors and residuals that are not as stated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from hub.bundle.initialisation import sigma_limit
from hub.bundle.model_comparison import REFUTED_SIGMA
from hub.bundle.problem import CRYSTAL_RATE_STD, AdjustmentState, Problem
from hub.bundle.residuals import residual_norms
from hub.calibration.pairs.pair_network import RATE_TOLERANCE
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration, TrajectoryTable
from protocols.session.rig import Rig

_MAX_Z = 2.0
"""Residuals over the detector's stds, or the reverse, from which these are reported as wrong."""
_MAX_REJECTED = 0.2
"""Share of a camera's rows that is left out without a warning: a detector is rarely wrong more often."""
_MAX_DEPTH_STD = 0.05
"""Largest std of a path over its distance that its errors follow. Depth is one over disparity: of an error e of 1.96
stds, e² is then a quarter of the depth's std, which alone is 1.36 of one std for three axes."""


def estimated_lenses(rig: Rig, cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each lens that was estimated: unknown, refined on request, or given with a std."""
    out = []
    for name, camera in cameras.items():
        given, lens, std = rig.cameras[name], camera.intrinsics, f"{100 * camera.focal_std:.2g} % (std)"
        if camera.focal_std > 0.0 and given.is_measured and given.intrinsics is not None:
            before = given.intrinsics.focal
            change = f"from {before:.1f} to {lens.focal:.1f} px ± {std}, by {100 * (lens.focal / before - 1):+.2g} %"
            weight = f"; given ± {100 * given.focal_std:.2g} %" if given.focal_std else ""
            if weight and abs(np.log(lens.focal / before)) > REFUTED_SIGMA * given.focal_std:
                weight += ", which the observations refute"
            out.append(f"{name}: its lens was refined: focal length {change}{weight}")
        elif camera.focal_std > 0.0:
            out.append(f"{name}: its lens was estimated from the trajectory: focal length {lens.focal:.1f} px ± {std}")
    return tuple(out)


def unused_lengths(rig: Rig, names: list[str], labels: list[str]) -> tuple[str, ...]:
    """One sentence for each distance and scale bar of which an end was not solved."""
    out = []
    for what, given, known in (("distance", rig.distances, names), ("scale bar (wand)", rig.scale_bars, labels)):
        for a, b, _ in given:
            missing = " and ".join(one for one in (a, b) if one not in known)
            if missing:
                out.append(f"the {what} {a}–{b} was not used: no solution has {missing}")
    return tuple(out)


def other_frame_rates(rig: Rig, cameras: dict[str, CameraCalibration], reference: str) -> tuple[str, ...]:
    """One sentence for each camera whose clock rate no crystal explains."""
    out = []
    common = float(np.median([camera.time_map.clock_rate for camera in cameras.values()])) if len(cameras) > 2 else 1.0
    std = float(np.median([camera.clock_rate_std for camera in cameras.values()]))
    # Where the others agree on another rate than the reference's, it is the reference that runs differently.
    common, whom, whose = (
        (common, "the others", "the others'") if _is_no_crystal(common, std) else (1.0, reference, f"{reference}'s")
    )
    for name, camera in cameras.items():
        rate, fps = camera.time_map.clock_rate / common, rig.cameras[name].fps
        own = std if name == reference else camera.clock_rate_std
        if _is_no_crystal(rate, own):
            out.append(
                f"{name}: its times run {1e6 * (rate - 1.0):+.0f} ± {1e6 * own:.0f} ppm against {whose}, more "
                f"than the 100 ppm of crystals: a different frame rate, {fps / rate:.5g} fps for {fps:.5g}, or that of "
                f"{whom}"
            )
    return tuple(out)


def _is_no_crystal(rate: float, std: float) -> bool:
    """Whether a relative clock rate, with its std, is one that no crystal explains."""
    return abs(rate - 1.0) < RATE_TOLERANCE and (rate - 1.0) ** 2 > REFUTED_SIGMA**2 * (CRYSTAL_RATE_STD**2 + std**2)


def rejected_rows(names: list[str], problem: Problem, state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each camera many of whose rows were left out, though others saw the point then."""
    out = []
    for number, name in enumerate(names):
        parts = problem.of_camera(number)
        norms = [residual_norms(part, state.cameras[number], state.trajectories[part.label]) for part in parts]
        seen = sum(int(np.isfinite(norm).sum()) for norm in norms)
        left = sum(int((np.isfinite(norm) & ~part.use).sum()) for norm, part in zip(norms, parts, strict=True))
        if left > _MAX_REJECTED * seen:
            out.append(
                f"{name}: {left} of its {seen} rows ({100 * left / seen:.0f} %) do not fit the others' path at its lag "
                "and were left out: false detections, a moved camera, or a clock that is not even"
            )
    return tuple(out)


def readout_notes(cameras: dict[str, CameraCalibration], by: str) -> tuple[str, ...]:
    """One sentence for each rolling-shutter readout that was estimated ``by`` something."""
    return tuple(
        f"{name}: its rolling-shutter readout was estimated from {by}: "
        f"{1e3 * camera.readout:.1f} ms from the first {'column' if camera.intrinsics.is_portrait else 'row'} "
        f"to the last ± {1e3 * camera.readout_std:.1f} ms (std)"
        for name, camera in cameras.items()
        if camera.readout_std > 0.0
    )


def jitter_notes(names: list[str], stds: Floats, by: str) -> tuple[str, ...]:
    """One sentence for each camera with time-stamp jitter, of stds (cameras,) [s], estimated ``by`` something."""
    return tuple(
        f"{name}: its stamps jitter by {1e3 * std:.2g} ms (std): each frame's time was estimated from {by}"
        for name, std in zip(names, stds.tolist(), strict=True)
        if std > 0.0
    )


def wandering_clocks(names: list[str], state: AdjustmentState, time_scales: list[float]) -> tuple[str, ...]:
    """One sentence for each clock that wanders."""
    return tuple(
        f"{names[one.camera]}: its clock's rate changes: beside an even clock it is off by up to "
        f"{1e3 * float(np.abs(one.values).max()) / time_scales[one.camera]:.2g} ms: each frame's time was corrected, "
        "and its time map holds at lag_time_s"
        for one in state.wanders
    )


def clock_step_warnings(cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each clock step."""
    return tuple(
        f"{name}: its clock steps by {1e3 * size:+.1f} ± {1e3 * std:.1g} ms at its time {time:.2f} s; its map holds "
        f"{'before' if time > camera.lag_time else 'after'} the step, and the rows on the other side were corrected"
        for name, camera in cameras.items()
        for time, size, std in camera.clock_steps
    )


def large_residuals(cameras: dict[str, CameraCalibration], state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each camera whose residuals are no noise, though no test shows what they are.

    They are larger than the others' as angles too: what blurs an image has more pixels in a larger one; and than what
    the detector states, if it does, by more than the others'.
    """
    if len(cameras) < 3:
        return ()
    stated = [camera.detector_z for camera in cameras.values() if camera.detector_z > 0.0]
    usual = _MAX_Z * min(1.0, float(np.median(stated or [1.0])))
    angles = replace(state, sigma=state.sigma / [camera.intrinsics.focal for camera in state.cameras])
    return tuple(
        f"{name}: its residuals ({state.sigma[i]:.2g} px a coordinate) are {3.0 * state.sigma[i] / limit:.1f} times "
        "the others': its lens, its detections or its times are not what they are said to be, and its pose may be "
        "further off than its std"
        for i, (name, camera) in enumerate(cameras.items())
        if state.sigma[i] > (limit := sigma_limit(state, i))
        and angles.sigma[i] > sigma_limit(angles, i)
        and not 0.0 < camera.detector_z < usual
    )


def wrong_detector_stds(cameras: dict[str, CameraCalibration]) -> tuple[str, ...]:
    """One sentence for each camera whose residuals are not what its detector's covariances say."""
    return tuple(
        f"{name}: its residuals are {camera.detector_z:.2g} times the stds that its detector states (z-scores); only "
        "the ratios of its covariances were used, as weights"
        for name, camera in cameras.items()
        if camera.detector_z > 0.0 and not 1.0 / _MAX_Z < camera.detector_z < _MAX_Z
    )


def uncertain_depths(tables: Iterable[TrajectoryTable], state: AdjustmentState) -> tuple[str, ...]:
    """One sentence for each path whose depth is known so badly that its errors are not as its stds say."""
    out = list[str]()
    for table in tables:
        some = slice(None, None, 1 + len(table.std) // 100)
        distances = [np.linalg.norm(table.position[some] - one.pose.position, axis=1) for one in state.cameras]
        share = float(np.median(table.std[some] / np.min(distances, axis=0))) if len(table.std) else 0.0
        if share > _MAX_DEPTH_STD:
            text = "of its distance (std), which errors exceed: move the cameras apart"
            out.append(f"{table.label}: its path is known to {share:.0%} {text}")
    return tuple(out)
