"""Clock steps put into flights: how many are reported, with what time and size, and how many that are not there.

    python -m tests.bench.clock_steps [--sessions 10] [--first 9000] [--sizes 20,40,60] [--exact-lenses] [--jobs 2]
                                      [--recorded FOLDER]

Simulated flights of `lasting_errors`; in each the clock of one camera steps by each size, in a random direction, after
0.2 to 0.8 of its span; and once by nothing. --recorded: a session folder instead, each of its cameras with each size in
both directions after 0.4 and 0.65 of its span. A step that is reported without one having been put in (of a recording
it may be real) is no part of the figures. Found: reported of that camera, within 15 s (a parked drone does not tell),
with its size to a half. Wrong: any other. z: error of the size over its stated std, of those found.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.calibration.pipeline import calibrate  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from protocols.session.folder import read_folder  # noqa: E402
from protocols.session.observations import Observations  # noqa: E402
from protocols.session.rig import Rig  # noqa: E402
from tests.bench import lasting_errors  # noqa: E402

_NEAR_S, _NEAR_SHARE = 15.0, 0.5
_SHARES = (0.4, 0.65)
Steps = dict[str, tuple[tuple[float, float, float], ...]]


@dataclass(frozen=True, slots=True)
class Put:
    """A step of a camera's clock at camera time ``at`` [s] by ``size`` [s]; size 0: none."""

    camera: str
    at: float
    size: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was made of a step: found with z of its size, or not; and how many others were reported."""

    put: Put
    found: bool
    z: float
    wrong: int
    refused: bool = False


def stepped(observations: Observations, put: Put) -> Observations:
    """The observations with one camera's clock set forward; stamps that a clock set back shows twice are left out."""
    tracks = dict(observations.tracks)
    for key, track in observations.tracks.items():
        if key[0] == put.camera:
            stamps = track.time + np.where(track.time >= put.at, put.size, 0.0)
            shown = np.diff(np.maximum.accumulate(stamps), prepend=-np.inf) > 0.0
            tracks[key] = replace(track, time=stamps).select(shown)
    return replace(observations, tracks=tracks)


def reported(rig: Rig, observations: Observations) -> Steps | None:
    """The clock steps that a calibration reports; None where it is refused."""
    try:
        cameras = calibrate(rig, observations).cameras
    except Refused:
        return None
    return {name: camera.clock_steps for name, camera in cameras.items() if camera.clock_steps}


def outcome(before: Steps, after: Steps | None, put: Put) -> Outcome:
    """How a step was reported, beside those that were reported without it."""
    if after is None:
        return Outcome(put, False, 0.0, 0, refused=True)
    found, z, wrong = False, 0.0, 0
    for name, steps in after.items():
        for at, size, std in steps:
            mine = (
                name == put.camera and abs(at - put.at) < _NEAR_S and abs(size - put.size) < _NEAR_SHARE * abs(put.size)
            )
            known = any(abs(size - one[1]) < _NEAR_SHARE * abs(one[1]) for one in before.get(name, ()))
            if mine and not found:
                found, z = True, (size - put.size) / std
            elif not known:
                wrong += 1
    return Outcome(put, found, z, wrong)


def simulated(seed: int, sizes: tuple[float, ...], exact_lenses: bool) -> tuple[int, list[Outcome]]:
    """Number of steps reported of one flight without any, and the outcomes of those put in."""
    one, rng = lasting_errors.session(seed, exact_lenses), np.random.default_rng([seed, 4])
    before = reported(one.rig, one.observations)
    if before is None:
        return 0, []
    outcomes = []
    for size in sizes:
        name = f"cam{rng.integers(lasting_errors.CAMERAS)}"
        time = one.observations.tracks[name, "marker"].time
        at = float(time[0] + rng.uniform(0.2, 0.8) * np.ptp(time))
        put = Put(name, at, size * float(rng.choice([-1.0, 1.0])))
        outcomes.append(outcome({}, reported(one.rig, stepped(one.observations, put)), put))
    return sum(map(len, before.values())), outcomes


def recorded_steps(observations: Observations, sizes: tuple[float, ...]) -> Iterator[Put]:
    """The steps that are put into a recording."""
    for name in observations.cameras:
        (track,) = observations.of_camera(name)
        for share in _SHARES:
            for size in sizes:
                for sign in (-1.0, 1.0):
                    yield Put(name, float(track.time[0] + share * np.ptp(track.time)), sign * size)


def recorded(folder: Path, before: Steps, put: Put) -> Outcome:
    """The outcome of one step put into a recording."""
    rig, observations = read_folder(folder)
    return outcome(before, reported(rig, stepped(observations, put)), put)


def table(outcomes: list[Outcome]) -> None:
    """Print the outcomes by size."""
    print(f"{'size':>7} {'found':>9} {'wrong':>6} {'refused':>8} {'rms z':>6} {'worst z':>8}")
    for size in sorted({abs(one.put.size) for one in outcomes}):
        mine = [one for one in outcomes if abs(one.put.size) == size]
        z = np.array([one.z for one in mine if one.found] or [np.nan])
        print(
            f"{1e3 * size:4.0f} ms {sum(one.found for one in mine):>3} of {len(mine):<3}"
            f"{sum(one.wrong for one in mine):>5} {sum(one.refused for one in mine):>8} "
            f"{np.sqrt(np.mean(z**2)):6.2f} {np.abs(z).max():8.1f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--first", type=int, default=9000, help="first seed")
    parser.add_argument("--sizes", default="20,40,60", help="ms, comma-separated")
    parser.add_argument("--exact-lenses", action="store_true", help="given intrinsics are exact")
    parser.add_argument("--recorded", type=Path, help="a session folder instead of simulated flights")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    sizes = tuple(1e-3 * float(size) for size in options.sizes.split(","))
    with ProcessPoolExecutor(options.jobs) as pool:
        if options.recorded is not None:
            rig, observations = read_folder(options.recorded)
            before = reported(rig, observations) or {}
            print(f"{options.recorded.name}: without a step put in, {before or 'none'} is reported")
            puts = list(recorded_steps(observations, sizes))
            table(list(pool.map(partial(recorded, options.recorded, before), puts)))
            return
        seeds = range(options.first, options.first + options.sessions)
        made = list(pool.map(partial(simulated, sizes=sizes, exact_lenses=options.exact_lenses), seeds))
    print(f"seeds {seeds[0]} to {seeds[-1]}: {sum(one[0] for one in made)} steps reported where there is none")
    table([one for _, outcomes in made for one in outcomes])


if __name__ == "__main__":
    main()
