"""Acceptance of degenerate sessions, and calibration of the reported stds against the truth.

    python -m tests.bench.honesty [--sessions 100] [--runs 200] [--start 0] [--jobs 2] [--only degenerate,stds]

degenerate: eleven kinds of session with an unobservable quantity; required: wrong but accepted at most 0.1 %. A
result counts as wrong if a camera's clock is more than 5 ms off in the middle of what it saw, or its orientation more
than 3 degrees. The kinds take turns, so that an interrupted run has as many of each. stds: over random rigs a regime,
how often the truth lies within 1.96 stds; required: 93 to 97 %. Paths are evaluated once a second, as the errors of
neighbouring samples are correlated.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.calibration.pipeline import calibrate  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from protocols.geometry.pose import Pose, Similarity  # noqa: E402
from protocols.geometry.types import Floats  # noqa: E402
from protocols.session.calibration import Calibration  # noqa: E402
from tests.support import rigs  # noqa: E402

_WRONG_S, _WRONG_RAD = 0.005, np.deg2rad(3.0)
_WITHIN = 1.96
_REPORT_EACH = 5  # sessions of each kind
Make = Callable[[int], rigs.Session]


def _waves(rng: np.random.Generator, frequency: Floats, amplitude: Floats) -> rigs.Path:
    return rigs.Path(frequency, rng.uniform(0, 2 * np.pi, frequency.shape), amplitude)


def still(seed: int) -> rigs.Session:
    """The marker stands."""
    return rigs.simulate(
        seed, 2, path=rigs.Path(np.full((1, 3), 0.1), np.zeros((1, 3)), np.zeros((1, 3))), seconds=20.0
    )


def trembling(seed: int) -> rigs.Session:
    """It stands and trembles by a millimetre: less than the noise."""
    rng = np.random.default_rng([seed, 1])
    return rigs.simulate(seed, 2, path=_waves(rng, rng.uniform(0.05, 3.0, (5, 3)), np.full((5, 3), 3e-4)), seconds=20.0)


def planar(seed: int) -> rigs.Session:
    """It moves in a plane, seen by two cameras."""
    path = rigs.random_path(np.random.default_rng([seed, 2]))
    path.amplitude[:, 2] = 0.0
    return rigs.simulate(seed, 2, path=path, seconds=20.0)


def straight(seed: int) -> rigs.Session:
    """It moves to and fro along a line."""
    rng = np.random.default_rng([seed, 3])
    path = rigs.random_path(rng)
    one = (path.frequency[:, :1], path.phase[:, :1], path.amplitude[:, :1] * rng.normal(0, 0.5, 3))
    return rigs.simulate(seed, 2, path=rigs.Path(*(np.broadcast_to(v, (5, 3)).copy() for v in one)), seconds=20.0)


def regular(seed: int) -> rigs.Session:
    """It repeats itself every two seconds or so."""
    rng = np.random.default_rng([seed, 4])
    base = rng.uniform(0.3, 0.8)
    frequency = base * np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]])
    return rigs.simulate(seed, 2, path=_waves(rng, frequency, rng.uniform(0.1, 0.6, (2, 3))), seconds=20.0)


def short(seed: int) -> rigs.Session:
    """Two cameras have between half a second and three seconds in common."""
    common = float(np.random.default_rng([seed, 5]).uniform(0.5, 3.0))
    return rigs.simulate(seed, 2, windows=[(0.0, 10.0 + common), (10.0, 20.0)], late=0.1, seconds=20.0)


def too_slow(seed: int) -> rigs.Session:
    """10 fps, and motion of 3 to 5 Hz."""
    rng = np.random.default_rng([seed, 6])
    path = _waves(rng, rng.uniform(3.0, 5.0, (5, 3)), rng.uniform(0.05, 0.3, (5, 3)))
    return rigs.simulate(seed, 2, path=path, fps=(10.0, 10.0), seconds=20.0)


def noise_only(seed: int) -> rigs.Session:
    """The detector reports only outliers."""
    return rigs.simulate(seed, 2, outliers=1.0, seconds=20.0)


def unrelated_tracks(seed: int) -> rigs.Session:
    """Every camera observes a different, unrelated track."""
    parts = [rigs.simulate(seed + 7_000_000 * k, seconds=20.0) for k in range(3)]
    first = parts[0]
    pixels = np.concatenate([p.pixels[[c == f"cam{k}" for c in p.camera]] for k, p in enumerate(parts)])
    camera = [f"cam{k}" for k, p in enumerate(parts) for c in p.camera if c == f"cam{k}"]
    frame = np.concatenate([p.frame[[c == f"cam{k}" for c in p.camera]] for k, p in enumerate(parts)])
    time = np.concatenate([p.time[[c == f"cam{k}" for c in p.camera]] for k, p in enumerate(parts)])
    return replace(first, camera=camera, label=["marker"] * len(camera), frame=frame, time=time, pixels=pixels)


def no_clock(seed: int) -> rigs.Session:
    """One camera's times follow no clock: they scatter by a third of a second, or step repeatedly."""
    rng = np.random.default_rng([seed, 8])
    session = rigs.simulate(seed, 2, seconds=20.0)
    mine = session.of_camera("cam1")
    time = session.time.copy()
    count = int(mine.sum())
    if seed % 2:
        time[mine] += np.cumsum(rng.normal(0, 0.06, count))
    else:
        time[mine] += np.repeat(rng.uniform(-0.5, 0.5, count // 40 + 1), 40)[:count] + 2.0 * np.arange(count) / count
    return replace(session, time=time)


def one_place(seed: int) -> rigs.Session:
    """Two cameras hang in one place."""
    session = rigs.simulate(seed, 2, seconds=20.0)
    rng = np.random.default_rng([seed, 9])
    pose = rigs.look_at_pose(session.poses["cam0"].position, rng.normal(0, 0.15, 3), 0.3)
    lens = session.lens("cam1")
    mine = np.flatnonzero(session.of_camera("cam1"))
    true = np.array([session.true_time("cam1", float(t)) for t in session.time[mine]])
    pixels = session.pixels.copy()
    pixels[mine] = lens.project(pose.camera_from_world(session.paths["marker"].at(true))) + rng.normal(
        0, 0.5, (len(mine), 2)
    )
    return replace(session, pixels=pixels, poses=session.poses | {"cam1": pose})


DEGENERATE: tuple[tuple[str, Make, bool], ...] = (
    ("marker still", still, False),
    ("trembles less than the noise", trembling, False),
    ("planar, two cameras", planar, True),
    ("along a line", straight, True),
    ("repeats itself regularly", regular, True),
    ("0.5 to 3 s in common", short, True),
    ("10 fps, 3 to 5 Hz", too_slow, True),
    ("noise only", noise_only, False),
    ("each its own thing", unrelated_tracks, False),
    ("one clock is none", no_clock, False),
    ("two cameras in one place", one_place, False),
)
"""Name, session, and whether a correct result may exist (else any result counts as wrong)."""


@dataclass(frozen=True, slots=True)
class DegenerateResult:
    """One degenerate session. outcome: "refused", "right" or "wrong". cpu_s: of the whole command [s]."""

    kind: int
    seed: int
    outcome: str
    clock_ms: float
    turn_degrees: float
    cpu_s: float


def evaluate_session(kind: int, seed: int) -> DegenerateResult:
    """Calibrate one session as the command does, and compare the result, if any, with the truth."""
    _, make, answerable = DEGENERATE[kind]
    session = make(seed)
    begin = time.process_time()
    try:
        found = calibrate(session.rig, session.observations(), thorough=True)
    except Refused:
        return DegenerateResult(kind, seed, "refused", 0.0, 0.0, time.process_time() - begin)
    spent = time.process_time() - begin
    lag = max(abs(session.clock_error(n, found.reference, c.time_map)) for n, c in found.cameras.items())
    turn = session.turn_error({name: camera.pose for name, camera in found.cameras.items()})
    right = answerable and lag < _WRONG_S and turn < _WRONG_RAD
    return DegenerateResult(kind, seed, "right" if right else "wrong", 1e3 * lag, float(np.degrees(turn)), spent)


@dataclass(frozen=True, slots=True)
class Regime:
    """Arguments of `rigs.simulate`; references: positions surveyed to a centimetre, else the first camera's world."""

    name: str
    cameras: int = 3
    seconds: float = 20.0
    noise: float = 0.5
    drops: float = 0.02
    outliers: float = 0.0
    fps: tuple[float, ...] = (30.0, 25.0, 29.97, 50.0)
    fastest: float = 0.7
    references: bool = False


REGIMES = (
    Regime("clean, 30 fps", drops=0.0, fps=(30.0,)),
    Regime("6 to 60 fps, 1.5 px", 4, 30.0, 1.5, fps=(10.0, 30.0, 60.0, 6.0), fastest=1.5),
    Regime("mixed rates, 200 ppm"),
    Regime("two cameras", cameras=2),
    Regime("five cameras", cameras=5),
    Regime("30 % dropped", drops=0.3),
    Regime("10 % outliers", outliers=0.1),
    Regime("everything at once, 1 px", noise=1.0, drops=0.3, outliers=0.1),
    Regime("8 s", seconds=8.0),
    Regime("60 s", seconds=60.0),
    Regime("surveyed to 1 cm", references=True),
)


def scores(regime: int, seed: int) -> tuple[int, list[float], list[float], list[float]]:
    """z-scores of clocks, positions and path of one run; empty if refused."""
    r = REGIMES[regime]
    session = rigs.simulate(
        seed,
        r.cameras,
        r.seconds,
        noise=r.noise,
        drops=r.drops,
        outliers=r.outliers,
        fps=r.fps,
        fastest=r.fastest,
        late=2.0,
    )
    rig = session.rig
    if r.references:
        rng = np.random.default_rng([seed, 11])
        rig = replace(
            rig,
            cameras={
                name: replace(
                    camera,
                    position=session.poses[name].position + rng.normal(0, 0.01, 3),
                    position_std=np.full(3, 0.01),
                )
                for name, camera in rig.cameras.items()
            },
        )
    try:
        found = calibrate(rig, session.observations())
    except Refused:
        return regime, [], [], []
    world = _truth_in(session, found)
    clocks = [
        session.clock_error(name, found.reference, camera.time_map) / camera.time_offset_std
        for name, camera in found.cameras.items()
        if name != found.reference
    ]
    places: list[float] = []
    for name, camera in found.cameras.items():
        off = camera.pose.position - world.points(session.poses[name].position[None])[0]
        estimated = camera.position_std > 1e-9
        places += (off[estimated] / camera.position_std[estimated]).tolist()
    path: list[float] = []
    for table in found.trajectories:
        step = max(1, round(1.0 / float(np.median(np.diff(table.time)))))
        at = slice(step // 2, None, step)
        truth = world.points(session.truth_at(table.label, found.reference, table.time[at]))
        path += ((table.position[at] - truth) / table.std[at, None]).ravel().tolist()
    return regime, clocks, places, path


def _truth_in(session: rigs.Session, found: Calibration) -> Similarity:
    """The published world from the true one."""
    if found.scale == "metric":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    names = list(found.cameras)
    first: Pose = session.poses[names[0]]
    scale = 1.0 / float(np.linalg.norm(session.poses[names[1]].position - first.position))
    return Similarity(scale, first.rotation, -scale * first.rotation @ first.position)


def _histogram(z: Floats) -> str:
    bars = " ▁▂▃▄▅▆▇█"
    counts = np.histogram(np.clip(z, -3.99, 3.99), bins=16, range=(-4, 4))[0]
    return "".join(bars[round(8 * c / max(counts.max(), 1))] for c in counts)


def counts_by_kind(judged: list[DegenerateResult]) -> dict[str, object]:
    """Counts of each outcome, and the seeds of the wrong ones, by kind."""
    return {
        DEGENERATE[kind][0]: dict(Counter(one.outcome for one in judged if one.kind == kind))
        | {"bad": [one.seed for one in judged if one.kind == kind and one.outcome == "wrong"]}
        for kind in sorted({one.kind for one in judged})
    }


def _summary(judged: list[DegenerateResult]) -> str:
    wrong = sum(one.outcome == "wrong" for one in judged)
    share = 100.0 * wrong / max(len(judged), 1)
    return f"wrong but accepted: {wrong} of {len(judged)} ({share:.2f} %; required 0.1 %)"


def _print_degenerate(judged: list[DegenerateResult]) -> None:
    for kind in sorted({one.kind for one in judged}):
        mine = [one for one in judged if one.kind == kind]
        counts = Counter(one.outcome for one in mine)
        bad = [f"{one.seed}: {one.clock_ms:.1f} ms, {one.turn_degrees:.1f}°" for one in mine if one.outcome == "wrong"]
        print(
            f"{DEGENERATE[kind][0]:30} refused {counts['refused']:4}  right {counts['right']:4}  wrong "
            f"{counts['wrong']:3}  {np.mean([one.cpu_s for one in mine]):5.2f} s of CPU each"
            + (f"   ({'; '.join(bad[:6])})" if bad else "")
        )
    print(_summary(judged), flush=True)


def _keep(path: Path | None, kept: dict[str, object]) -> None:
    if path is not None:
        path.write_text(json.dumps(kept, indent=1))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=100, help="of each degenerate kind")
    parser.add_argument("--runs", type=int, default=200, help="of each regime")
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="degenerate,stds")
    parser.add_argument("--regimes", default="", help="parts of regimes' or kinds' names, comma separated")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    wanted = [part for part in arguments.regimes.split(",") if part]

    def chosen(names: list[str]) -> list[int]:
        return [i for i, name in enumerate(names) if not wanted or any(part in name for part in wanted)]

    kept: dict[str, object] = {}
    seeds = range(arguments.start, arguments.start + max(arguments.sessions, arguments.runs))
    with ProcessPoolExecutor(arguments.jobs) as pool:
        if "degenerate" in arguments.only:
            kinds = chosen([name for name, _, _ in DEGENERATE])
            todo = [(kind, seed) for seed in seeds[: arguments.sessions] for kind in kinds]
            judged: list[DegenerateResult] = []
            try:
                for one in pool.map(evaluate_session, *zip(*todo, strict=True)):
                    judged.append(one)
                    if one.outcome == "wrong":
                        print(f"wrong: {DEGENERATE[one.kind][0]}, {one}", flush=True)
                    if len(judged) % (_REPORT_EACH * len(kinds)) == 0:
                        kept |= counts_by_kind(judged)
                        print(f"{len(judged)} of {len(todo)} sessions, {_summary(judged)}", flush=True)
                        _keep(arguments.json, kept)
            except KeyboardInterrupt:
                print(f"interrupted after {len(judged)} of {len(todo)} sessions", flush=True)
                pool.shutdown(cancel_futures=True)
            kept |= counts_by_kind(judged)
            _print_degenerate(judged)
            _keep(arguments.json, kept)
            if len(judged) < len(todo):
                return
        if "stds" in arguments.only:
            print("\nwithin 1.96 std (required 93 to 97 %), and the histogram of z from -4 to 4")
            for regime in chosen([r.name for r in REGIMES]):
                runs = list(pool.map(partial(scores, regime), seeds[: arguments.runs]))
                parts = [np.array([z for run in runs for z in (run[1], run[2], run[3])[k]]) for k in range(3)]
                within = [
                    f"{label} {100 * np.mean(np.abs(z) < _WITHIN):5.1f} % {_histogram(z)}"
                    for label, z in zip(("clock", "position", "path"), parts, strict=True)
                ]
                refused = sum(not run[1] for run in runs)
                print(
                    f"{REGIMES[regime].name:26} " + "  ".join(within) + f"  refused {refused}/{len(runs)}", flush=True
                )
                kept[REGIMES[regime].name] = {
                    label: {"within": float(np.mean(np.abs(z) < _WITHIN)), "rms": float(np.sqrt(np.mean(z**2)))}
                    for label, z in zip(("clock", "position", "path"), parts, strict=True)
                }
                _keep(arguments.json, kept)


if __name__ == "__main__":
    main()
