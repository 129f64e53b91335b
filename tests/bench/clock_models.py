"""What is made of a camera's clock: even, with a step, a rolling shutter's readout, jitter of its stamps, or slewed.

    python -m tests.bench.clock_models [--sessions 4] [--first 7000] [--only step30,readouts+jitter] [--verbose]
        [--seconds 40] [--noise 0.5] [--fps 30,25,29.97,50] [--fastest 0.7] [--focal-error 0] [--labels 1]

Four cameras round one path, calibrated once with each effect put into a random camera, or into all (plural): a step in
ms, half a frame interval of readout (reversed: of the last row first), jitter in ms (std), a rate that is ppm more for
a quarter of the time. Found: reported of that camera (a step within 5 s, its size to a half). Wrong: any other; of a
readout, more than 3 stds from its truth. z: errors over their stds; beside slews, of all lags where no clock steps or
jitters. --focal-error: relative error (std) of given focal lengths. --fastest: largest frequency of the motion [Hz].
"""

from __future__ import annotations

import argparse
import os
import re
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.calibration.pipeline import calibrate  # noqa: E402
from protocols.core.clocks import CameraTime, TimeMap  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from protocols.geometry.types import Floats  # noqa: E402
from protocols.session.calibration import Calibration  # noqa: E402
from protocols.session.observations import Observations  # noqa: E402
from protocols.session.rig import Rig  # noqa: E402
from tests.support import rigs  # noqa: E402

CAMERAS = 4
EFFECTS = (
    "none,step15,step30,step60,readout,readouts,jitter5,jitter20,jitters5,step30+readouts,step30+jitter10,"
    "step30+jitters10,readout+jitter5,readouts+jitters10,slew150,slew500,reversed,readouts+reversed"
)
_PART = re.compile(r"(step|readout|jitter|slew|reversed)(s?)(\d*)")
_NEAR_S, _NEAR_SHARE, _WRONG_Z = 5.0, 0.5, 3.0


@dataclass(frozen=True, slots=True)
class World:
    """What all sessions have in common."""

    seconds: float
    noise: float
    fps: tuple[float, ...]
    fastest: float
    focal_error: float
    labels: int


@dataclass(frozen=True, slots=True)
class Clock:
    """A camera's effects, put in or reported: steps as (camera time, size, std), readout with std, jitter [s], changes
    of its rate as (camera time, size). even: its clock without them. lag_z: error of its lag in stds."""

    steps: tuple[tuple[float, float, float], ...] = ()
    readout: float = 0.0
    readout_std: float = 0.0
    jitter: float = 0.0
    slews: tuple[tuple[float, float], ...] = ()
    even: TimeMap | None = None
    lag_z: float = 0.0

    def slewed(self, time: Floats) -> Floats:
        """What the changes of its rate add to camera times (n,)."""
        return np.asarray(sum((rate * np.maximum(time - at, 0.0) for at, rate in self.slews), np.zeros_like(time)))


@dataclass(frozen=True, slots=True)
class Run:
    """One calibration: by camera what was put in and what is reported (None: refused)."""

    clocks: dict[str, tuple[Clock, Clock | None]]
    cpu: float


def session(seed: int, effect: str, world: World) -> tuple[Rig, Observations, dict[str, Clock]]:
    """One session and the clocks of its cameras, a pure function of its arguments."""
    rng = np.random.default_rng([seed, 31])
    labels = {f"point{i}": range(CAMERAS) for i in range(world.labels)}
    one = rigs.simulate(
        seed, CAMERAS, world.seconds, fps=world.fps, noise=0.0, ppm=50.0, drops=0.0, fastest=world.fastest,
        labels=labels,
    )  # fmt: skip
    chosen, sign, share = f"cam{rng.integers(CAMERAS)}", float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.25, 0.75))
    cameras, clocks, tracks = dict(one.rig.cameras), dict[str, Clock](), {}
    for name, camera in one.rig.cameras.items():
        parts = {kind: float(size or 0) for kind, every, size in _PART.findall(effect) if every or name == chosen}
        own = [track for (of, _), track in one.observations().tracks.items() if of == name]
        begin, end = min(track.time[0] for track in own), max(track.time[-1] for track in own)
        clock = Clock(
            ((float(begin + share * (end - begin)), 1e-3 * sign * parts["step"], 0.0),) if "step" in parts else (),
            -0.5 / camera.fps if "reversed" in parts else 0.5 / camera.fps if "readout" in parts else 0.0,
            jitter=1e-3 * parts.get("jitter", 0.0),
            slews=tuple(
                (float(begin + part * (end - begin)), 1e-6 * rate)
                for part, rate in ((0.8 * share, parts["slew"]), (0.8 * share + 0.25, -parts["slew"]))
            )
            if "slew" in parts
            else (),
            even=one.clocks[name],
        )
        clocks[name] = clock
        errors = rng.normal(0.0, clock.jitter, max(int(track.frame.max()) for track in own) + 1)
        for track in own:
            stamps = track.time + errors[track.frame] + clock.slewed(track.time)
            for at, size, _ in clock.steps:
                stamps = stamps + np.where(track.time >= at, size, 0.0)
            pixels = _pixels(one, name, track.label, track.time, clock.readout)
            pixels += rng.normal(0.0, world.noise, pixels.shape)
            with np.errstate(invalid="ignore"):
                seen = ((pixels >= 0) & (pixels < rigs.SIZE)).all(axis=1) & (rng.random(len(pixels)) > 0.05)
            seen &= np.diff(np.maximum.accumulate(stamps), prepend=-np.inf) > 0.0
            tracks[name, track.label] = replace(track, time=stamps, pixels=pixels).select(seen)
        matrix = camera.intrinsics.matrix.copy()
        matrix[:2, :2] *= 1.0 + rng.normal(0.0, world.focal_error)
        cameras[name] = replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))
    return replace(one.rig, cameras=cameras), Observations(tracks), clocks


def _pixels(one: rigs.Session, name: str, label: str, shown: Floats, readout: float) -> Floats:
    """Pixels (n, 2) of a label in frames whose middle rows are read at camera times (n,)."""
    true = one.clocks[name].clock_rate * shown + one.clocks[name].time_offset
    lens, pose, late = one.rig.cameras[name].intrinsics, one.poses[name], np.zeros(len(true))
    for _ in range(4):
        pixels = lens.project(pose.camera_from_world(one.paths[label].at(true + late)))
        late = readout * (np.nan_to_num(pixels[:, 1]) / (rigs.SIZE[1] - 1) - 0.5)
    return np.asarray(pixels)


def reported(found: Calibration, name: str, true: dict[str, Clock]) -> Clock | None:
    """What a calibration says of a camera's clock."""
    if name not in found.cameras:
        return None
    mine, base = true[name], true[found.reference]
    assert mine.even is not None
    assert base.even is not None
    shown = CameraTime(found.cameras[name].lag_time - float(mine.slewed(np.array([found.cameras[name].lag_time]))[0]))
    even = float(base.even.camera_from_reference(mine.even.reference_from_camera(shown)))
    error = float(found.cameras[name].time_map.reference_from_camera(CameraTime(found.cameras[name].lag_time))) - (
        even + float(base.slewed(np.array([even]))[0])
    )
    jitter = [re.match(name + r": its stamps jitter by ([\d.e-]+) ms", text) for text in found.warnings]
    one = found.cameras[name]
    stds = [1e-3 * float(match[1]) for match in jitter if match]
    slews = (
        ((0.0, 0.0),) if any(text.startswith(f"{name}: its clock's rate changes") for text in found.warnings) else ()
    )
    return Clock(
        one.clock_steps, one.readout, one.readout_std, max(stds, default=0.0), slews,
        lag_z=error / one.lag_std if one.lag_std else 0.0,
    )  # fmt: skip


def run(task: tuple[str, int], world: World) -> Run:
    """One session calibrated."""
    rig, observations, clocks = session(task[1], task[0], world)
    began = time.process_time()
    try:
        found = calibrate(rig, observations)
    except Refused:
        return Run({name: (clock, None) for name, clock in clocks.items()}, time.process_time() - began)
    cpu = time.process_time() - began
    return Run({name: (clock, reported(found, name, clocks)) for name, clock in clocks.items()}, cpu)


def row(effect: str, runs: list[Run]) -> str:
    """The table's line of one effect."""
    put = dict.fromkeys(("step", "readout", "jitter", "slew"), 0)
    found, wrong, z = dict(put), dict(put), {kind: list[float]() for kind in put}
    refused = 0
    for true, said in (pair for one in runs for pair in one.clocks.values()):
        if said is None:
            refused += 1
            continue
        for kind, there in (
            ("step", true.steps),
            ("readout", true.readout),
            ("jitter", true.jitter),
            ("slew", true.slews),
        ):
            put[kind] += bool(there)
        hits = [
            (step, size - of, std)
            for at, of, _ in true.steps
            for step in said.steps
            for when, size, std in [step]
            if abs(when - at) < _NEAR_S and abs(size - of) < _NEAR_SHARE * abs(of)
        ]
        found["step"] += bool(hits)
        wrong["step"] += len(said.steps) - len(hits)
        z["step"] += [error / std for _, error, std in hits]
        if said.readout_std > 0.0:
            z["readout"].append((said.readout - true.readout) / said.readout_std)
            wrong["readout"] += abs(z["readout"][-1]) > _WRONG_Z
        found["readout"] += true.readout * said.readout > 0.0
        found["jitter"] += true.jitter > 0.0 and said.jitter > 0.0
        wrong["jitter"] += true.jitter == 0.0 and said.jitter > 0.0
        found["slew"] += bool(true.slews and said.slews)
        wrong["slew"] += bool(said.slews and not true.slews)
        z["slew"] += [] if said.steps or said.jitter else [said.lag_z]
        if true.jitter and said.jitter:
            z["jitter"].append(said.jitter / true.jitter)
    cells = [f"{found[kind]:>3} of {put[kind]:<3}{wrong[kind]:>3} wrong, {_rms(z[kind]):4.2f}" for kind in put]
    return f"{effect:>20} {refused:>4}   {'   '.join(cells)}   {np.mean([one.cpu for one in runs]):5.2f} s"


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else np.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--first", type=int, default=7000, help="first seed")
    parser.add_argument("--only", default=EFFECTS)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--noise", type=float, default=0.5, help="px")
    parser.add_argument("--fps", default="30,25,29.97,50")
    parser.add_argument("--fastest", type=float, default=0.7, help="Hz")
    parser.add_argument("--focal-error", type=float, default=0.0)
    parser.add_argument("--labels", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--verbose", action="store_true", help="what was put in and reported, by camera")
    options = parser.parse_args()
    world = World(
        options.seconds, options.noise, tuple(map(float, options.fps.split(","))), options.fastest,
        options.focal_error, options.labels,
    )  # fmt: skip
    print(
        f"{'effect':>20} refused  {'step: rms z':>22}   {'readout: rms z':>22}   {'jitter: of its truth':>22}"
        f"   {'slew: rms z of lags':>22}"
    )
    with ProcessPoolExecutor(options.jobs) as pool:
        for effect in options.only.split(","):
            tasks = [(effect, seed) for seed in range(options.first, options.first + options.sessions)]
            runs = list(pool.map(partial(run, world=world), tasks))
            print(row(effect, runs), flush=True)
            for number, one in enumerate(runs if options.verbose else []):
                for name, pair in one.clocks.items():
                    print(f"    {options.first + number} {name}: {pair[0]} -> {pair[1]}")


if __name__ == "__main__":
    main()
