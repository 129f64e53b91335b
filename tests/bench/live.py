"""The live hub as it is lived: a hub's process, frames that arrive at their own pace, and a listener.

    python -m tests.bench.live [--data FOLDER] [--only drone1,drone2,simulated] [--seconds N] [--seed 1] [--json FILE]

drone1, drone2: the recordings (labels by hand), with the offline calibration as reference and RTK as truth.
simulated: eight cameras at 30 fps round a moving marker, 120 s, with the truth as reference; one joins after a third of
the time, and halfway another is bumped by 5 cm and 2 degrees. Every frame arrives 50 ms + |N(0, 20 ms)| after its
exposure. A run takes as long as the recording.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from deploy.agents.processes import interrupt_on_signals  # noqa: E402
from deploy.offline.exchange.session_log import Arrivals, session_to_log  # noqa: E402
from hub.calibration.pipeline import calibrate  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from protocols.geometry import so3  # noqa: E402
from protocols.geometry.pose import Pose  # noqa: E402
from protocols.geometry.types import Floats  # noqa: E402
from protocols.session.observations import DEFAULT_LABEL, read_observations  # noqa: E402
from protocols.session.rig import read_rig  # noqa: E402
from tests.bench.live_run import RunFailed, run_live  # noqa: E402
from tests.bench.live_scores import Bump, LiveScores, Reference  # noqa: E402
from tests.bench.real_rigs import DEFAULT_DATA, CommandFailed, run_calibrate  # noqa: E402
from tests.bench.speed.rows import machine  # noqa: E402
from tests.support import rigs  # noqa: E402

SCENARIOS = ("drone1", "drone2", "simulated")
DELAY_S, JITTER_S = 0.05, 0.02
SIMULATED_S = 120.0
BUMPED, LATE = "cam3", "cam7"
_CAMERAS, _FPS = 8, 30.0
_BUMP_M, _BUMP_RAD = 0.05, float(np.radians(2.0))
_TRUTH_HZ = 20.0

ROWS = {
    "cameras": "cameras in the last answer",
    "answers": "answers published",
    "first_calibration_s": "first calibration after, s",
    "all_calibrated_s": "all cameras calibrated after, s",
    "status_silence_s": "longest silence of the status, s",
    "track_silence_s": "longest silence of the track, s",
    "cpu_before": "CPU a second before the first answer, s",
    "cpu_after": "CPU a second after it, s",
    "latency_median_ms": "from a frame to its track, median, ms",
    "latency_p99_ms": "the same, 99th percentile, ms",
    "rows_without_track_percent": "frames without a track, %",
    "track_mean_cm": "track as it came, mean 3-D error, cm",
    "track_coverage_percent": "its coverage, %",
    "track_offline_mean_cm": "offline path over the same time, cm",
    "track_ratio": "track over offline",
    "smoothed_mean_cm": "smoothed track as it came, cm",
    "smoothed_coverage_percent": "its coverage, %",
    "smoothed_ratio": "smoothed track over offline",
    "last_answer_mean_cm": "path by the last answer, cm",
    "last_answer_ratio": "last answer over offline",
    "lag_z_max": "lag error over its std, largest",
    "lag_z_within_3_percent": "lag errors within three stds, %",
    "lag_error_max_ms": "largest lag error, ms",
    "lag_error_last_ms": "largest lag error of the last answer, ms",
    "centre_moves_max_std": "camera centre between answers, largest, stds",
    "centre_moves_within_3_percent": "moves within three stds, %",
    "bump_right_after_s": "bumped camera right again after, s",
    "bump_error_last_cm": "its last error, cm",
    "bump_error_last_degrees": "its last error, degrees",
    "late_calibrated_after_s": "late camera calibrated after, s",
}
"""Figures of the table; the JSON file has all."""


def recorded(session: Path) -> Reference:
    """A flight, its offline calibration and RTK. Raises CommandFailed where `calibrate` does."""
    run = run_calibrate(session, "observations.csv", refine_lenses=True)
    rig = read_rig(session / "rig.toml")
    table = np.loadtxt(session / "truth_trajectory.csv", delimiter=",", skiprows=1)
    label = next(iter(run.path))
    seen = read_observations(session / "observations.csv", rig.cameras)
    return Reference(rig, seen, run.cameras, run.path_time[label], run.path[label], table[:, 0], table[:, 1:])


def simulated(seconds: float, seed: int) -> Reference:
    """Eight cameras, one of which joins late and one of which is bumped. The offline path knows no bump."""
    windows = [(seconds / 3.0 if f"cam{i}" == LATE else 0.0, seconds) for i in range(_CAMERAS)]
    session = rigs.simulate(seed, _CAMERAS, seconds, fps=(_FPS,), windows=windows)
    truth = session.true_cameras()
    found = calibrate(session.rig, session.observations())
    table, base = found.trajectories[0], found.cameras[found.reference].time_map
    clock = session.clocks[found.reference]
    path_time = clock.clock_rate * (table.time - base.time_offset) / base.clock_rate + clock.time_offset
    time = np.arange(0.0, seconds, 1.0 / _TRUTH_HZ)
    bump, moved = _bumped(session, 0.5 * seconds, np.random.default_rng([seed, 1]))
    return Reference(
        session.rig,
        moved.observations(),
        truth,
        path_time,
        table.position,
        time,
        session.paths[DEFAULT_LABEL].at(time),
        bump,
        LATE,
    )


def _bumped(session: rigs.Session, at: float, rng: np.random.Generator) -> tuple[Bump, rigs.Session]:
    """The session with one camera displaced from a true time on; each row keeps its noise."""

    def direction() -> Floats:
        vector = rng.normal(size=3)
        return np.asarray(vector / np.linalg.norm(vector))

    old = session.poses[BUMPED]
    new = Pose(so3.exp(_BUMP_RAD * direction()) @ old.rotation, old.position + _BUMP_M * direction())
    moved = session.moved(BUMPED, at, new)
    moved = moved.where(np.all((moved.pixels >= 0) & (moved.pixels < rigs.SIZE), axis=1))
    return Bump(BUMPED, at, moved.poses), moved


def measure(reference: Reference, seconds: float, seed: int, refine_lenses: bool = False) -> dict[str, Any]:
    """The figures of one run of at most ``seconds``, and its lag errors by answer. Raises RunFailed.

    refine_lenses: for the flights, whose lens data are off by up to 2 %.
    """
    missing = [name for name in reference.rig.cameras if name not in reference.cameras]
    if missing:
        raise RunFailed(f"not calibrated offline: {', '.join(missing)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arrivals = Arrivals(reference.cameras, DELAY_S, JITTER_S, seed)
        session_to_log(reference.rig, reference.seen, folder / "log.mcap", arrivals)
        heard = run_live(folder / "log.mcap", folder, seconds, refine_lenses)
    scores = LiveScores(heard, reference)
    found = scores.figures()
    for name, offline in (("track", "track"), ("smoothed", "smoothed"), ("last_answer", "track")):
        ours, theirs = found.get(f"{name}_mean_cm"), found.get(f"{offline}_offline_mean_cm")
        if ours is not None and theirs:
            found[f"{name}_ratio"] = ours / theirs
    return {**found, "by_answer": scores.lag_errors()}


def run(name: str, data: Path, seconds: float | None, seed: int) -> dict[str, Any] | str:
    """One scenario; the reason where it could not be measured. seconds: of the stream; None = all."""
    try:
        if name == "simulated":
            seconds = seconds or SIMULATED_S
            return measure(simulated(seconds, seed), seconds, seed)
        if not (data / name / "truth_trajectory.csv").is_file():
            return "no such recording in the data folder"
        return measure(recorded(data / name), seconds or 1e6, seed, refine_lenses=True)
    except (CommandFailed, Refused, RunFailed) as error:
        return str(error)


def table(name: str, figures: dict[str, Any]) -> str:
    """The figures of one scenario, a row each; "–" where there is nothing to tell."""
    width = max(map(len, ROWS.values()))
    lines = [f"{name}: {figures['stream_s']:.0f} s of stream"]
    for key, text in ROWS.items():
        value = figures.get(key)
        shown = "–" if value is None else f"{value}" if isinstance(value, int) else f"{value:.2f}"
        lines.append(f"  {text:{width}} {shown:>9}")
    return "\n".join(lines)


def main() -> int:
    """Print one table a scenario. Status 1 if a scenario could not be run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder of the recordings")
    parser.add_argument("--only", default=",".join(SCENARIOS), help="scenarios, by comma")
    parser.add_argument("--seconds", type=float, help="of each stream; default: the whole recording, 120 s simulated")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="where to write all figures")
    options = parser.parse_args()
    wanted = options.only.split(",")
    unknown = [name for name in wanted if name not in SCENARIOS]
    if unknown:
        parser.error(f"no scenario named {', '.join(unknown)}; there are {', '.join(SCENARIOS)}")
    interrupt_on_signals()
    found, failed = dict[str, Any](), False
    for name in wanted:
        figures = run(name, options.data, options.seconds, options.seed)
        if isinstance(figures, str):
            print(f"{name}: not run: {figures}\n", flush=True)
            failed |= not figures.startswith("no such recording")
            continue
        found[name] = figures
        print(f"{table(name, figures)}\n", flush=True)
    if options.json:
        document = {"machine": machine(), "seed": options.seed, "scenarios": found}
        options.json.write_text(json.dumps(document, indent=1, default=float) + "\n", encoding="utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
