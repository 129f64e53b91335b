"""Acceptance tests of the cameras of an adjusted network, in the order in which their failures explain one another.

And of people's heights: geometry that is wrong shortens and stretches them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from hub.bundle import covariance as cov
from hub.bundle.initialisation import Reconstruction, inlier_share, sigma_limit
from hub.bundle.model_comparison import LENS, ScoreTest, refuted_lenses
from hub.bundle.noise.correlated_noise import MIN_INFLATION, lens_tolerance
from hub.bundle.noise.noise_scale import correlation_inflation
from hub.bundle.problem import AdjustmentState, Column, Problem
from hub.bundle.smoothness_prior import estimate_smoothness
from hub.calibration.given_values import refuted_lens
from hub.calibration.self_calibration import MAX_FOCAL_STD
from hub.sync.hypothesis import PairSolution
from protocols.core.acceptance import AcceptanceTest, PrecisionTest, first_failure
from protocols.core.errors import Refused
from protocols.session.calibration import CameraCalibration, TrajectoryTable

_MIN_INLIER_SHARE = 0.5  # share of a camera's rows that must fit the trajectory
_MIN_ROWS = 30
"""Rows of a camera: with two coordinates each, five times its ten unknowns (pose, clock, focal length, k1)."""
_MAX_RESIDUAL = 0.015  # of the image width: with larger ones the poses are not those of the recording
_GROWTH, _GROWN_PX = 4.0, 2.0  # times the residuals of a calibration, and px: above both the rows are not like its own
MAX_ROTATION_STD = 0.05  # rad
_MAX_CLOCK_STD = 10e-3  # s: a frame is more than three of them
_MAX_LAG_CHANGE = 20e-3  # s
_WRONG_LENS = 0.05  # relative error of a focal length that no zoom, crop or temperature explains: another lens
_WRONG_GEOMETRY = 0.4
"""Relative error of a given focal length less three stds, from which a rig of two or three cameras is refused: in 250
simulated ones (1 to 3 px, 0 to 10 % false detections) at most 0.22 where poses were right, 0.55 and more where not."""
_MIN_TO_BLAME_A_LENS = 4  # cameras: of three, another camera's pose absorbs too much of a wrong lens
LAG_CONFLICT = "difference of the lags by trajectory and by epipolar geometry"

CameraTests = dict[str, list[AcceptanceTest]]
"""The tests by camera."""


Failure = tuple[str, AcceptanceTest]
"""A camera, and the test that it fails."""

_MAX_VARIATION = 0.04
"""Of the distance from head to foot, relative, as a robust std. Of one walker in five rendered rooms it is 0.008 to
0.010 where rotations are right to 1.1 degrees, 0.023 with lenses 6 % off, and 0.052 and 0.063 where they are 9 to 20
degrees off; of points with 2 px of noise 0.002 to 0.006."""
_MIN_PLACES = 30  # a robust std of fewer is off by more than an eighth


def misfits(reconstruction: Reconstruction, unknown_lenses: Iterable[str] = ()) -> list[Failure]:
    """The cameras that do not fit the trajectory that the others give, the worst one first.

    unknown_lenses: cameras whose lens is estimated: a wrong one may be the cause of all the others' misfit. Where one
    of them fails, only they are returned.
    """
    failed = ((name, first_failure(tests)) for name, tests in _fit(reconstruction).items())
    found = sorted(((name, test) for name, test in failed if test is not None), key=lambda item: -item[1].excess)
    return [item for item in found if item[0] in set(unknown_lenses)] or found


def larger_residuals(
    reconstruction: Reconstruction, before: Mapping[str, CameraCalibration]
) -> dict[str, tuple[float, float]]:
    """Cameras whose residuals are far larger than when they were calibrated ``before``: both [px]."""
    both = {
        name: (float(sigma), before[name].rms_px)
        for name, sigma in zip(reconstruction.names, reconstruction.state.sigma, strict=True)
        if name in before
    }
    return {name: (now, rms) for name, (now, rms) in both.items() if rms > 0.0 and now > max(_GROWTH * rms, _GROWN_PX)}


def network_failure(
    reconstruction: Reconstruction, pairs: Iterable[PairSolution], tests: CameraTests
) -> Failure | None:
    """The camera of a network without misfits that fails first; None if all pass. ``tests`` gets what was tested.

    pairs: that the network was made from.
    """
    lens = wrong_lens(reconstruction.problem, reconstruction.state)
    few = _wrong_geometry(reconstruction.problem, reconstruction.state)
    if lens := lens or few:
        name, source = "chi-squared of the given lens", "one in 10,000 rigs"
        reason = refuted_lens(lens) + ("; of so few cameras, their geometry may be what is wrong" if few else "")
        test = AcceptanceTest(name, lens.statistic, lens.limit, "", source, reason)
        return reconstruction.names[lens.camera], test
    found = _covariance(reconstruction)
    groups = (
        _fit(reconstruction),
        _focal_lengths(reconstruction, found),
        _precision(reconstruction, found),
        _lag_conflicts(reconstruction, pairs),
    )
    for group in groups:
        for name, made in group.items():
            tests.setdefault(name, []).extend(made)
    return next((failure for failure in map(_worst, groups) if failure is not None), None)


def wrong_lens(problem: Problem, state: AdjustmentState) -> ScoreTest | None:
    """Test of the lens refuted by most, where that is far more than any lens changes in the field; else None.

    It need not be the most significant one: the others' residuals, which are small, show what it does to them. Without
    correlated residuals there is none: a wrong lens displaces successive rows alike.
    """
    too_few = len(state.cameras) < _MIN_TO_BLAME_A_LENS
    if state.correlated_noise is not None or not problem.free_parameters.clock or too_few:
        return None
    if correlation_inflation(problem, state).max() < MIN_INFLATION:
        return None
    far = [camera for camera, sigma in enumerate(state.sigma) if sigma > sigma_limit(state, camera)]
    found = refuted_lenses(problem, state, LENS if far else LENS[:2])
    worst = max(found, key=lambda one: _excess(one, problem, one.camera in far), default=None)
    return None if worst is None or _excess(worst, problem, worst.camera in far) <= 1.0 else worst


def _wrong_geometry(problem: Problem, state: AdjustmentState) -> ScoreTest | None:
    """Of fewer cameras than `wrong_lens` blames one of: the lens refuted most, if so far that it or the geometry is."""
    if len(state.cameras) >= _MIN_TO_BLAME_A_LENS or not problem.free_parameters.clock:
        return None
    found = refuted_lenses(problem, state, LENS, LENS[:2])[:1]  # with two of three lenses free, the third is anything
    return next((one for one in found if _excess(one, problem, far=False) * _WRONG_LENS > _WRONG_GEOMETRY), None)


def _excess(test: ScoreTest, problem: Problem, far: bool) -> float:
    """A focal length's change less three stds, over what no zoom, crop or temperature explains; where the residuals
    are ``far`` larger than the others', also chi-squared of the lens beside its play in the field, over its limit."""
    focal = float(abs(test.change[0]) - 3.0 * np.sqrt(test.covariance[0, 0])) / _WRONG_LENS
    if not far:
        return focal
    field = lens_tolerance(problem.nominal[test.camera])
    play = np.diag([field.focal_std, field.k1_std, field.centre_std, field.centre_std]) ** 2
    return max(focal, float(test.change @ np.linalg.solve(test.covariance + play, test.change)) / test.limit)


def _covariance(reconstruction: Reconstruction) -> cov.Covariance:
    problem, state = reconstruction.problem, reconstruction.state
    return cov.covariance(problem, state, estimate_smoothness(problem, state))


def _worst(group: CameraTests) -> Failure | None:
    """Of the first test of the group that a camera fails, the camera that exceeds the limit most.

    Of two with equal values, the later one: the first camera is usually the reference.
    """
    for row in zip(*group.values(), strict=True):
        failed = [(test.excess, number) for number, test in enumerate(row) if not test.passed]
        if failed:
            number = max(failed)[1]
            return list(group)[number], row[number]
    return None


def _fit(reconstruction: Reconstruction) -> CameraTests:
    """Whether each camera fits the trajectory that the others give.

    Of two cameras each one's residuals hide in the other's: no noise is as large as they may get.
    """
    out: CameraTests = {}
    fits = "observations fit the trajectory seen by the other cameras"
    why = ": is its lens another, or was it moved?" if reconstruction.problem.free_parameters.pose else ""
    for name, camera, sigma in zip(
        reconstruction.names, reconstruction.state.cameras, reconstruction.state.sigma.tolist(), strict=True
    ):
        share, count = inlier_share(reconstruction, name)
        out[name] = [
            AcceptanceTest(
                "observations that fit the trajectory",
                share,
                _MIN_INLIER_SHARE,
                "share",
                "measured: python -m tests.bench.broken_cameras",
                f"only {100 * share:.0f} % of its {count} {fits}{why}",
                ">=",
            ),
            AcceptanceTest(
                "typical residual",
                sigma,
                _MAX_RESIDUAL * camera.intrinsics.width,
                "px",
                "1.5 % of the image width",
                f"its observations contradict the calibration (typical residual: {sigma:.1f} px)",
            ),
        ]
        if reconstruction.problem.free_parameters.pose:
            reason = f"only {count} of its {fits}"
            out[name].append(PrecisionTest("observations", count, _MIN_ROWS, "", "five rows an unknown", reason, ">="))
    return out


def _focal_lengths(reconstruction: Reconstruction, found: cov.Covariance) -> CameraTests:
    """Precision of the focal lengths; 0 of one that was kept as given."""
    stds = np.sqrt(np.maximum(found.variances[:, Column.FOCAL], 0.0))
    name, source = "std of the focal length", "measured: python -m tests.bench.lenses"
    return {
        camera: [
            PrecisionTest(
                name,
                float(std),
                MAX_FOCAL_STD,
                "relative",
                source,
                f"the common motion determines its focal length only to {100 * std:.1f} % (std)",
            )
        ]
        for camera, std in zip(reconstruction.names, stds, strict=True)
    }


def _precision(reconstruction: Reconstruction, found: cov.Covariance) -> CameraTests:
    """Precision of each camera's orientation and clock relative to the camera to which they are known best."""
    problem, state = reconstruction.problem, reconstruction.state
    rotations, clocks = cov.smallest_relative_stds(found, problem, state)
    if not problem.free_parameters.clock:
        clocks = np.zeros_like(rotations)
    only = "the common motion determines its"
    return {
        name: [
            PrecisionTest(
                "std of the orientation",
                float(rotation),
                MAX_ROTATION_STD,
                "rad",
                "measured: python -m tests.bench.simulated_rigs",
                f"{only} orientation only to {np.rad2deg(rotation):.1f}° (std)",
            ),
            PrecisionTest(
                "std of the clock at mid-overlap",
                float(clock),
                _MAX_CLOCK_STD,
                "s",
                "a third of a frame at 30 fps",
                f"{only} clock only to {1e3 * clock:.1f} ms (std, mid-overlap)",
            ),
        ]
        for name, rotation, clock in zip(reconstruction.names, rotations, clocks, strict=True)
    }


def _lag_conflicts(reconstruction: Reconstruction, pairs: Iterable[PairSolution]) -> CameraTests:
    """How far the adjustment moved the lag of an isolated pair, by its later camera.

    Epipolar geometry and trajectory are two estimates of the lag with different sensitivities: where they differ, one
    of them is wrong. With three and more cameras a pair's lag is only an initial value.
    """
    out: CameraTests = {}
    for pair in pairs:
        if pair.fit is None or not np.isfinite(pair.fit.total_lag_std):
            continue
        a, b = (reconstruction.state.cameras[reconstruction.names.index(name)] for name in (pair.a, pair.b))
        at_a = np.array([pair.fit.mid_time])
        at_b = (at_a - pair.fit.offset) / pair.fit.rate
        difference = float(abs(a.reference_time(at_a) - b.reference_time(at_b))[0])
        reason = f"the trajectory puts its clock {1e3 * difference:.0f} ms from the lag of the epipolar geometry"
        source = "twice the largest std that a pair's lag may have"
        out[pair.b] = [AcceptanceTest(LAG_CONFLICT, difference, _MAX_LAG_CHANGE, "s", source, reason)]
    return out


def check_stature(trajectories: Iterable[TrajectoryTable]) -> None:
    """Raise Refused where the distance between the points ``NAME-head`` and ``NAME-foot`` varies along the path."""
    found = {}
    for table in trajectories:
        seen = np.isfinite(table.position).all(axis=1)
        found[table.label] = table.time[seen], table.position[seen]
    for label, (times, foot) in found.items():
        name, _, end = label.rpartition("-")
        if end != "foot" or not name or f"{name}-head" not in found or not len(times):
            continue
        when, head = found[f"{name}-head"]
        common = (when >= times[0]) & (when <= times[-1])
        if common.sum() < _MIN_PLACES:
            continue
        below = np.column_stack([np.interp(when[common], times, column) for column in foot.T])
        height = np.linalg.norm(head[common] - below, axis=1)
        middle = float(np.median(height))
        variation = 1.4826 * float(np.median(np.abs(height - middle))) / max(middle, 1e-300)
        if variation > _MAX_VARIATION:
            raise Refused(
                f"{name} would be {100.0 * variation:.0f} % taller and smaller along the path (std): the geometry is "
                "wrong; measure the lenses, or let somebody walk nearer and through more of each picture"
            )
