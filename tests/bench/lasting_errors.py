"""Calibration of four cameras far from a drone under correlated label errors, with and without modelling them.

    python -m tests.bench.lasting_errors [--sessions 10] [--first 8000] [--exact-lenses] [--compare]

180 s from 35 to 70 m away. Label errors: white noise of 0.4 px plus a Gauss-Markov process of 0.2 to 2 px with a time
constant of 0.5 to 5 s; a fifth of the rows is missing; given intrinsics are wrong as in `drone_pairs`, or exact; global
shutters. Paths are compared after a similarity and a time map, lags in the middle of a camera's span. --compare: the
same sessions once more without `refit_with_correlated_noise`; errors and lags are then of the sessions in which both
settings solve all four cameras.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from unittest import mock

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
from scipy.signal import lfilter  # noqa: E402

from hub.bundle.noise.correlated_noise import refit_with_correlated_noise  # noqa: E402
from hub.bundle.problem import AdjustmentState, Problem  # noqa: E402
from hub.calibration.pipeline import calibrate  # noqa: E402
from protocols.core.clocks import TimeMap  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from protocols.geometry.types import Floats  # noqa: E402
from protocols.session.calibration import Calibration  # noqa: E402
from protocols.session.observations import Observations, Track  # noqa: E402
from protocols.session.rig import Rig, RigCamera  # noqa: E402
from tests.bench import scoring  # noqa: E402
from tests.bench.drone_pairs import FPS, SIZE, flight, lenses  # noqa: E402
from tests.support import rigs  # noqa: E402

CAMERAS = 4
SECONDS = 180.0
_LARGEST_FPS = 30.0  # faster cameras are labelled at this rate
_WHITE_PX = 0.4
_DROPPED = 0.2
_STDS = 1.96


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """Rig and observations; the drone's true path and each camera's clock from true time."""

    rig: Rig
    observations: Observations
    path: rigs.Path
    clocks: dict[str, TimeMap]


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One result. error: mean 3-D error [m]. lags, stds: (k,) [s] against the reference. cpu: [s]."""

    refused: int
    cpu: float
    error: float = np.inf
    lags: tuple[float, ...] = ()
    stds: tuple[float, ...] = ()


def session(seed: int, exact_lenses: bool = False) -> Session:
    """One session, a pure function of its arguments; observations do not depend on ``exact_lenses``."""
    rng = np.random.default_rng([seed, 77])
    path, bearing = flight(rng), float(rng.uniform(0.0, 2.0 * np.pi))
    cameras, tracks, clocks = {}, {}, {}
    for number in range(CAMERAS):
        name = f"cam{number}"
        at, away = bearing + number * rng.uniform(0.4, 1.2), rng.uniform(35.0, 70.0)
        place = np.array([away * np.cos(at), away * np.sin(at), rng.uniform(-12.0, -2.0)])
        pose = rigs.look_at_pose(place, rng.normal(0.0, 1.5, 3), float(rng.normal(0.0, 0.03)))
        true, nominal = lenses(rng)
        rate = min(float(rng.choice(FPS)), _LARGEST_FPS)
        clock = TimeMap(1.0 + 1e-6 * rng.uniform(-100.0, 100.0), rng.uniform(0.0, 1e3))
        instant = rng.uniform(0.0, 1.0 / rate) + np.arange(int(SECONDS * rate)) / rate
        pixels = true.project(pose.camera_from_world(path.at(instant))) + _noise(rng, len(instant), rate)
        with np.errstate(invalid="ignore"):
            seen = ((pixels >= 0) & (pixels < SIZE)).all(axis=1)
        seen &= rng.random(len(instant)) > _DROPPED
        shown, rows = clock.time_offset + clock.clock_rate * instant[seen], pixels[seen]
        cameras[name] = RigCamera(name, SIZE, fps=rate, intrinsics=true if exact_lenses else nominal)
        tracks[name, "marker"] = Track(name, "marker", np.flatnonzero(seen), shown, rows, np.full(len(rows), np.nan))
        clocks[name] = clock
    return Session(Rig(cameras), Observations(tracks), path, clocks)


def _noise(rng: np.random.Generator, count: int, rate: float) -> Floats:
    """Label errors (n, 2) [px]: white noise plus a Gauss-Markov process with this camera's std and time constant."""
    time_constant, std = rng.uniform(0.5, 5.0), rng.uniform(0.2, 2.0)
    correlation = np.exp(-1.0 / (rate * time_constant))
    innovation = rng.normal(0.0, std, (count, 2))
    innovation[1:] *= np.sqrt(1.0 - correlation**2)
    correlated_errors = lfilter([1.0], [1.0, -correlation], innovation, axis=0)
    return np.asarray(correlated_errors + rng.normal(0.0, _WHITE_PX, (count, 2)))


def without_refit(problem: Problem, state: AdjustmentState) -> tuple[Problem, AdjustmentState]:
    """Replaces `refit_with_correlated_noise`: the adjustment stays unchanged."""
    return problem, state


def run(one: Session, correlated: bool) -> Run:
    """One calibration, evaluated. correlated: whether correlated noise is modelled."""
    began = time.process_time()
    try:
        with mock.patch(
            "hub.calibration.final_adjustment.refit_with_correlated_noise",
            refit_with_correlated_noise if correlated else without_refit,
        ):
            found = calibrate(one.rig, one.observations)
    except Refused:
        return Run(CAMERAS, time.process_time() - began)
    cpu = time.process_time() - began
    lags = {name: _lag(one, found, name) for name in found.cameras if name != found.reference}
    return Run(
        CAMERAS - len(found.cameras),
        cpu,
        _error(one, found),
        tuple(lags.values()),
        tuple(found.cameras[name].time_offset_std for name in lags),
    )


def _error(one: Session, found: Calibration) -> float:
    """Mean 3-D error [m] of the path; infinite where it cannot be aligned with the truth."""
    instant, table = np.arange(0.0, SECONDS, 0.2), found.trajectories[0]
    try:
        return float(scoring.align(table.time, table.position, instant, one.path.at(instant)).error.mean())
    except ValueError:
        return np.inf


def _lag(one: Session, found: Calibration, name: str) -> float:
    """Error [s] of a camera's map to the reference clock in the middle of the camera's span."""
    shown = one.observations.tracks[name, "marker"].time
    middle = 0.5 * float(shown[0] + shown[-1])
    clock, reference, nominal = one.clocks[name], one.clocks[found.reference], found.cameras[name].time_map
    instant = (middle - clock.time_offset) / clock.clock_rate
    truth = reference.clock_rate * instant + reference.time_offset
    return nominal.clock_rate * middle + nominal.time_offset - truth


def row(setting: str, runs: list[Run], whole: list[int]) -> str:
    """One setting's table row; whole: indices of the sessions whose errors and lags are reported."""
    refused, cpu = sum(one.refused for one in runs), np.mean([one.cpu for one in runs])
    if whole:
        errors = 100.0 * np.array([runs[i].error for i in whole])
        lags, stds = (np.abs([getattr(runs[i], key) for i in whole]) for key in ("lags", "stds"))
        within = np.count_nonzero(lags <= _STDS * stds) / lags.size
        figures = (
            f"{errors.mean():10.2f} {np.median(errors):10.2f} {1e3 * lags.max(axis=1).mean():10.2f} {within:10.2f}"
        )
    else:
        figures = f"{'–':>10} {'–':>10} {'–':>10} {'–':>10}"
    return f"{setting:<16}{figures} {refused:>4} of {CAMERAS * len(runs):<4} {cpu:6.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--first", type=int, default=8000, help="first seed")
    parser.add_argument("--exact-lenses", action="store_true", help="given intrinsics are exact")
    parser.add_argument("--compare", action="store_true", help="once more without modelling correlated noise")
    options = parser.parse_args()
    settings = {"correlated noise": True} | ({"without": False} if options.compare else {})
    runs: dict[str, list[Run]] = {setting: [] for setting in settings}
    for seed in range(options.first, options.first + options.sessions):
        one = session(seed, options.exact_lenses)
        for setting, correlated in settings.items():
            runs[setting].append(run(one, correlated))
    whole = [i for i in range(options.sessions) if all(made[i].refused == 0 for made in runs.values())]
    print(
        f"seeds {options.first} to {options.first + options.sessions - 1}, lenses "
        f"{'given exactly' if options.exact_lenses else 'given slightly wrong'}; errors and lags of the "
        f"{len(whole)} of {options.sessions} sessions with all {CAMERAS} cameras"
        f"{' in both settings' if options.compare else ''}"
    )
    print(f"{'':<16}{'mean cm':>10} {'median cm':>10} {'lag ms':>10} {'in 1.96 σ':>10} {'refused':<12} {'CPU s':>6}")
    for setting, made in runs.items():
        print(row(setting, made, whole))


if __name__ == "__main__":
    main()
