"""Synchronisation of two cameras over random rigs: success, lag error over its bound, wrong solutions, CPU time.

    python -m tests.bench.pair_timing [--trials 100] [--regimes clean,short] [--uncalibrated] [--jobs 2]

Success: accepted, with a time map within 5 ms RMS over the overlap and F within 2 px. Wrong: accepted and over 20 ms or
10 px off. Unrelated: pairs that saw different motions, of which none may be accepted. The lag error is the RMS at
mid-overlap of all accepted solutions that are not wrong, in ms and over each one's Cramér-Rao bound
(`tests.bench.pair_trials.lag_bound`); ms are CPU time of smoothing both tracks and of solving the pair on one core.

The last table says what each acceptance test decides: how many wrong and right alignments failed it, how many failed
nothing else, and how many were accepted because another test decided in its stead. One that is alone nowhere decides
nothing here.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from hub.sync.pair_solver import solve_pair  # noqa: E402
from hub.two_view.relative_pose import fundamental_from  # noqa: E402
from tests.bench.pair_trials import (  # noqa: E402
    MATRIX,
    Regime,
    Trial,
    geometry_error,
    lag_bound,
    make_trial,
    time_map_error,
    unrelated_trial,
)

GOOD_S, GOOD_PX = 5e-3, 2.0
WRONG_S, WRONG_PX = 20e-3, 10.0


@dataclass(frozen=True, slots=True)
class Row:
    """A regime of the table. required, target: success rates. max_over_bound, max_lag_ms: of the lag error."""

    regime: Regime
    required: float | None = None
    target: float | None = None
    max_over_bound: float | None = None
    max_lag_ms: float | None = None


ROWS: dict[str, Row] = {
    "clean, ±5 s": Row(Regime(), 0.99, 1.0, 1.15),
    "30 % dropped": Row(Regime(dropped=0.3), 0.99, 1.0, 1.15),
    "10 % outliers": Row(Regime(outliers=0.1), 0.99, 1.0, 1.15),
    "30/25 fps, ±200 ppm": Row(Regime(fps=(30.0, 25.0), ppm=200), 0.99, 1.0, 1.15),
    "120 s, ±100 s": Row(Regime(span=120, late=100), 0.99, 1.0, 1.15),
    "everything at once, 1 px": Row(
        Regime(late=10, fps=(30.0, 25.0), ppm=200, noise=1.0, dropped=0.2, outliers=0.1, gaps=3),
        0.98,
        0.999,
        max_lag_ms=0.8,
    ),
    "(a)": Row(Regime(paper_path=True, span=11, late=0.5), None, None, max_lag_ms=3.1),
    "overlap 3 s of 10": Row(Regime(span=10, overlap=3), 0.95, 0.99),
    "40 % outliers, 30 % dropped": Row(Regime(outliers=0.4, dropped=0.3), 0.60, 0.95),
    "second thing 20 %": Row(Regime(second_object=0.2), 0.80, 0.95),
    "second thing 40 %": Row(Regime(second_object=0.4), None, 0.80),
    "10 fps, 3 Hz": Row(Regime(fps=(10.0, 10.0), slowest=0.5, fastest=3.0), None, 0.80),
    "120 s, ±5000 ppm": Row(Regime(span=120, ppm=5000)),
    "25 fps given as 30": Row(Regime(fps=(25.0, 30.0), assumed_fps=(30.0, 30.0))),
    "59.94 fps given as 25": Row(Regime(fps=(30.0, 59.94), assumed_fps=(30.0, 25.0))),
    "29.97 fps given as 30": Row(Regime(fps=(30.0, 29.97), assumed_fps=(30.0, 30.0))),
    "rolling shutter 20 ms": Row(Regime(readout=0.02)),
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a trial. lag_s, map_s: error at mid-overlap, RMS. f_px: of epipolar lines. floor_s: bound of lag_s."""

    status: str
    lag_s: float
    map_s: float
    f_px: float
    floor_s: float
    smooth_ms: float
    pair_ms: float
    failed: tuple[str, ...] = ()
    decided: tuple[tuple[str, str], ...] = ()
    """Tests that failed, and those in whose stead another one decided, with that one."""

    @property
    def accepted(self) -> bool:
        return self.status == "ok"

    @property
    def success(self) -> bool:
        return self.accepted and self.map_s < GOOD_S and self.f_px < GOOD_PX

    @property
    def wrong(self) -> bool:
        return self.accepted and (self.map_s > WRONG_S or self.f_px > WRONG_PX)


def run(trial: Trial, calibrated: bool, related: bool = True) -> Outcome:
    """Smooth, solve and score one trial. related: whether the two cameras saw the same motion."""
    begin = time.process_time()
    tracks = trial.smoothed()
    smoothed = time.process_time()
    if len(tracks) < 2:
        return Outcome("no track", np.inf, np.inf, np.inf, np.nan, 1e3 * (smoothed - begin), 0.0)
    a, b = tracks
    answer = solve_pair({"": a}, {"": b}, ("a", "b"), calibrated=calibrated, thorough=True)
    solved = time.process_time()
    spent = 1e3 * (smoothed - begin), 1e3 * (solved - smoothed)
    tests = (
        tuple(test.name for test in answer.acceptance if not test.passed),
        tuple((test.name, test.alternative) for test in answer.acceptance if test.alternative),
    )
    if answer.fit is None or not related:
        return Outcome(answer.status, np.inf, np.inf, np.inf, np.nan, *spent, *tests)
    rate = answer.fit.rate
    lag, error = time_map_error(trial, rate, answer.fit.offset + a.time_origin - rate * b.time_origin)
    found = fundamental_from(answer.fit.geometry, MATRIX, MATRIX)
    return Outcome(
        answer.status, lag, error, geometry_error(trial, found), lag_bound(trial, calibrated), *spent, *tests
    )


def _one(name: str, calibrated: bool, job: tuple[int, bool]) -> Outcome:
    cv2.setNumThreads(1)
    seed, related = job
    row = ROWS[name]
    trial = make_trial(row.regime, seed)
    if not related:
        trial = unrelated_trial(trial, row.regime, seed)
    return run(trial, calibrated, related)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--start", type=int, default=10_000, help="first seed")
    parser.add_argument("--regimes", default="", help="parts of their names, separated by commas")
    parser.add_argument("--unrelated", type=int, default=5, help="pairs that saw different motions, per regime")
    parser.add_argument("--uncalibrated", action="store_true", help="without intrinsics: F in place of E")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path, help="every trial, for figures of your own")
    options = parser.parse_args()
    wanted = [part for part in options.regimes.split(",") if part]
    names = [name for name in ROWS if not wanted or any(part in name for part in wanted)]
    print(f"{options.trials} random rigs a regime, {'unknown' if options.uncalibrated else 'known'} intrinsics, 0.5 px")
    print(
        f"{'':27s} {'success':>8s} {'need':>5s} {'target':>6s} {'wrong':>6s} {'unrelated':>10s} {'lag RMS':>9s} "
        f"{'/ bound':>8s} {'need':>8s} {'F px':>6s} {'smooth':>7s} {'pair':>7s}"
    )
    results: dict[str, object] = {}
    all_done: list[Outcome] = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for name in names:
            trials = options.trials
            jobs = [(options.start + k, True) for k in range(trials)]
            jobs += [(options.start + k, False) for k in range(options.unrelated)]
            done = list(pool.map(partial(_one, name, not options.uncalibrated), jobs, chunksize=4))
            all_done += done
            results[name] = [asdict(one) for one in done]
            _print(name, done[:trials], done[trials:])
    _print_tests(all_done)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


def _print(name: str, done: list[Outcome], unrelated: list[Outcome]) -> None:
    row = ROWS[name]
    good = [one for one in done if one.success]
    share = len(good) / len(done)
    counted = [one for one in done if one.accepted and not one.wrong]
    lag = np.sqrt(np.mean([one.lag_s**2 for one in counted])) if counted else np.nan
    over = np.sqrt(np.mean([(one.lag_s / one.floor_s) ** 2 for one in counted])) if counted else np.nan
    pixels = np.median([one.f_px for one in good]) if good else np.nan
    limit = f"{row.max_over_bound:.2f}" if row.max_over_bound else f"{row.max_lag_ms:.1f} ms" if row.max_lag_ms else ""
    print(
        f"{name:27s} {100 * share:6.1f} % {_percent(row.required):>5s} {_percent(row.target):>6s} "
        f"{sum(one.wrong for one in done):6d} {sum(one.accepted for one in unrelated):3d} of {len(unrelated):3d} "
        f"{1e3 * lag:6.3f} ms {over:8.2f} {limit:>8s} {pixels:6.2f} "
        f"{np.mean([one.smooth_ms for one in done]):4.0f} ms {np.mean([one.pair_ms for one in done]):4.0f} ms",
        flush=True,
    )
    reasons: dict[str, int] = {}
    for one in done:
        if not one.success:
            text = one.status if not one.accepted else f"accepted, {1e3 * one.map_s:.1f} ms, {one.f_px:.1f} px off"
            reasons[text[:100]] = reasons.get(text[:100], 0) + 1
    for reason, count in sorted(reasons.items(), key=lambda item: -item[1])[:4]:
        print(f"{'':6s}{count} × {reason}")


def _print_tests(done: list[Outcome]) -> None:
    names = dict.fromkeys(name for one in done for name in (*one.failed, *(test for test, _ in one.decided)))
    print(
        f"\n{'acceptance test':50s} {'wrong':>6s} {'alone':>6s} {'right':>6s} {'alone':>6s} {'decided by another':>19s}"
    )
    for name in names:
        failed = [one for one in done if name in one.failed]
        right = [one for one in failed if one.map_s < GOOD_S and one.f_px < GOOD_PX]
        wrong = [one for one in failed if one not in right]
        alone = [sum(one.failed == (name,) for one in group) for group in (wrong, right)]
        instead = Counter(other for one in done if one.accepted for test, other in one.decided if test == name)
        others = ", ".join(f"{count} {other}" for other, count in instead.items())
        print(f"{name:50s} {len(wrong):6d} {alone[0]:6d} {len(right):6d} {alone[1]:6d} {others:>19s}")


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:g}"


if __name__ == "__main__":
    main()
