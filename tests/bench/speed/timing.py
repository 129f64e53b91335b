"""Pair timing: 20 s of one marker in two cameras, begun up to 5 s apart; from pixels to lag and geometry.

Beside it the paper's basic method, begun at lag 0 as the paper has it, and what one would write with scipy: the
eight-point residual at every lag of half a frame, then least squares on lag, rate and the essential matrix from the
best three. Right: the clock map within 2 ms over the common time.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from hub.baselines.alternating_lag import estimate_alternately
from hub.two_view.relative_pose import RelativePose, decompose_essential, homogeneous, sampson
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from tests.bench import pair_timing
from tests.bench.pair_trials import FOCAL, MATRIX, Regime, Trial, make_trial, time_map_error
from tests.bench.speed.rows import Limit, Row, Section, cpu_of

_RIGHT_S = 2e-3
_LATE_S = 6.0
_STARTS = 3


def basic(trial: Trial) -> bool:
    """The paper's method on tracks by frame index; whether its lag is right."""
    a, b = (view.pixels for view in trial.views)
    try:
        found = estimate_alternately(a, b)
    except Refused:
        return False
    # Index i of a and i + lag of b are one instant; both cameras are nominally 30 frames a second.
    offset = trial.views[0].time[0] - trial.views[1].time[0] - found.lag / 30.0
    return time_map_error(trial, 1.0, offset)[1] < _RIGHT_S


def plain(trial: Trial) -> bool:
    """What one would write with scipy in an hour; whether its clock map is right."""
    a, b = trial.views
    one = (a.pixels - MATRIX[:2, 2]) / FOCAL
    time_a, time_b = a.time - a.time[0], b.time - b.time[0]
    other = CubicSpline(time_b, (b.pixels - MATRIX[:2, 2]) / FOCAL)
    # b's clock shows time_a + lag at the same instant.
    tried = []
    for lag in np.arange(-_LATE_S, _LATE_S, 1.0 / 60.0):
        inside = (time_a + lag >= 0) & (time_a + lag <= time_b[-1])
        if inside.sum() >= 200:
            x, y = one[inside], other(time_a[inside] + lag)
            rows = (homogeneous(y)[:, :, None] * homogeneous(x)[:, None, :]).reshape(-1, 9)
            values, vectors = np.linalg.eigh(rows.T @ rows)
            tried.append((float(values[0]) / len(x), float(lag), vectors[:, 0].reshape(3, 3), x, y))
    tried.sort(key=lambda item: item[0])
    starts: list[tuple[float, Floats, Floats, Floats]] = []
    for _, lag, essential, x, y in tried:
        if len(starts) < _STARTS and all(abs(lag - known[0]) > 0.1 for known in starts):
            starts.append((lag, essential, x, y))
    best = min((_refined(one, other, time_a, time_b, *start) for start in starts), key=lambda fit: fit[0])
    _, rate, offset = best
    # time_b = rate * time_a + offset; map_error wants time_a of time_b.
    slow = 1.0 / rate
    return time_map_error(trial, slow, a.time[0] - slow * (b.time[0] + offset))[1] < _RIGHT_S


def _refined(
    one: Floats, other: CubicSpline, time_a: Floats, time_b: Floats, lag: float, essential: Floats, x: Floats, y: Floats
) -> tuple[float, float, float]:
    """Mean cost, rate and offset of least squares on the Sampson distance from one start."""
    start = decompose_essential(essential, x, y)
    inside = (time_a + lag >= 0.2) & (time_a + lag <= time_b[-1] - 0.2)
    mine, at = one[inside], time_a[inside]
    middle = float(at.mean())

    def residual(step: Floats) -> Floats:
        pose: RelativePose = start.retract(step[:5])
        shown = np.clip(at + lag + step[5] + 1e-3 * step[6] * (at - middle), 0.0, time_b[-1])
        return sampson(pose.essential, mine, other(shown), 0.5 / FOCAL, 0.5 / FOCAL)

    found = least_squares(residual, np.zeros(7), loss="soft_l1", x_scale=[1e-3] * 5 + [1e-2, 0.1])
    rate = 1.0 + 1e-3 * float(found.x[6])
    return float(found.cost) / len(at), rate, lag + float(found.x[5]) - (rate - 1.0) * middle


def measure(quick: bool, data: Path) -> Section:
    """Median CPU of one pair."""
    del data
    trials = [make_trial(Regime(), seed) for seed in range(20_000, 20_000 + (6 if quick else 20))]
    methods = {"basic": basic, "plain": plain}
    spent: dict[str, list[float]] = {name: [] for name in ("ours", *methods)}
    right = dict.fromkeys(spent, 0)
    pair_timing.run(make_trial(Regime(), 19_999), calibrated=True)  # what is imported and cached at the first call
    for trial in trials:
        done = pair_timing.run(trial, calibrated=True)  # smoothing and solving, as `calibrate` has it
        spent["ours"].append(done.smooth_ms + done.pair_ms)  # without the scoring and its Cramér-Rao bound
        right["ours"] += done.map_s < _RIGHT_S
        for name, method in methods.items():
            box: list[bool] = []
            spent[name].append(1e3 * cpu_of(lambda method=method, trial=trial, box=box: box.append(method(trial))))  # type: ignore[misc]
            right[name] += box[0]
    ms = {name: float(np.median(values)) for name, values in spent.items()}
    notes = {name: f"right in {right[name]} of {len(trials)}" for name in spent}
    work = "pair timing, 20 s tracks, ±5 s"
    return Section(
        [
            Row(work, ms["ours"], "ms", "a plain scipy solve", ms["plain"],
                must=Limit("ours", 10.0), reach=Limit("ours", 5.0),
                note=f"ours {notes['ours']}, scipy {notes['plain']}; CPU from pixels, smoothing included"),
            Row(work, ms["ours"], "ms", "the paper's basic method", ms["basic"],
                note=f"begun at lag 0, good for ±0.3 s: {notes['basic']}"),
        ]
    )  # fmt: skip
