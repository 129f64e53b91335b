"""Two cameras far from a drone that share a short stretch, with lenses and shutters told a little wrong.

    python -m tests.bench.drone_pairs [--seconds 20] [--sessions 60] [--start 7000] [--strangers]

Each camera filmed 30 to 90 s more than the stretch, before or after it. Asked of every answer: its lag within 20 ms in
the middle of the stretch. Labels err alike for half a second, focal lengths by up to 2 %, centres by 8 px, k1 by 0.012;
shutters roll for up to 25 ms either way. Stretches in which a camera sees less than a third of motion do not count.
--strangers: a of each stretch with b of the next one, which watched another flight; none may be accepted.
"""

from __future__ import annotations

import argparse
import itertools
import os
from dataclasses import dataclass

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.calibration.pipeline import calibrate  # noqa: E402
from hub.trajectory.image_tracks import smooth_track  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from protocols.geometry import so3  # noqa: E402
from protocols.geometry.camera import Intrinsics  # noqa: E402
from protocols.geometry.types import Floats  # noqa: E402
from protocols.session.observations import Observations, Track  # noqa: E402
from protocols.session.rig import Rig, RigCamera  # noqa: E402
from tests import rigs  # noqa: E402

WRONG_S, FAR_S = 0.02, 0.03
SIZE = (1920, 1080)
FPS = (25.0, 29.97, 30.0, 50.0, 59.94)
_MOVING_PX = 20.0  # px/s
_EXTENT = 10.0  # m, of the flight


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A session of cameras a and b.

    at_a, at_b: times [s] on their clocks of one instant in the middle of what they share. turn: (3, 3) b from a.
    """

    rig: Rig
    observations: Observations
    at_a: float
    at_b: float
    turn: Floats


def flight(rng: np.random.Generator) -> rigs.Path:
    """Slow waves of some ten metres with small faster ones, more or less flat."""
    frequency = np.r_[rng.uniform(0.01, 0.05, 4), rng.uniform(0.05, 0.2, 3)][:, None] * rng.uniform(0.8, 1.25, (7, 3))
    amplitude = rng.uniform(0.4, 1.0, (7, 3))
    amplitude[4:] *= rng.uniform(0.03, 0.2)
    amplitude *= _EXTENT / amplitude.sum(axis=0) * rng.uniform(0.6, 1.2, 3)
    amplitude[:, 2] *= rng.choice([0.05, 0.15, 0.4, 0.8])
    return rigs.Path(frequency, rng.uniform(0.0, 2.0 * np.pi, (7, 3)), amplitude)


def stretch(seed: int, seconds: float) -> Stretch | None:
    """One pair, a pure function of its arguments; None where too little moves, or hardly anything is seen."""
    rng = np.random.default_rng([seed, 815])
    before, after = rng.uniform(30.0, 90.0, 2)
    path, first = flight(rng), float(rng.uniform(0.0, 2.0 * np.pi))
    bearings = (first, first + np.deg2rad(rng.uniform(25.0, 110.0)))
    spans = ((0.0, before + seconds), (before, before + seconds + after))
    cameras, tracks, middles, turns = {}, {}, [], []
    for name, bearing, (begin, end) in zip("ab", bearings, spans, strict=True):
        away = rng.uniform(35.0, 70.0)
        place = np.array([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-12.0, -6.0)])
        pose = rigs.looking_at(place, rng.normal(0.0, 1.5, 3), float(rng.normal(0.0, 0.03)))
        true, told = lenses(rng)
        rate, drift, epoch = float(rng.choice(FPS)), 1.0 + 1e-6 * rng.uniform(-100.0, 100.0), rng.uniform(0.0, 1e3)
        time = begin + rng.uniform(0.0, 1.0 / rate) + np.arange(int((end - begin) * rate)) / rate
        readout = rng.uniform(-0.025, 0.025)
        pixels = true.project(pose.camera_from_world(path.at(time)))
        for _ in range(3):  # the row that sees the drone is the one in which it is then
            row = np.clip(np.nan_to_num(pixels[:, 1]) / (SIZE[1] - 1), 0.0, 1.0) - 0.5
            pixels = true.project(pose.camera_from_world(path.at(time + readout * row)))
        pixels = pixels + _noise(rng, len(time), rate)
        with np.errstate(invalid="ignore"):
            seen = ((pixels >= 0) & (pixels < SIZE)).all(axis=1)
        rows, shown = pixels[seen], epoch + drift * time[seen]
        track = smooth_track(shown, told.unproject(rows), told.focal) if seen.any() else None
        if track is None:
            return None
        shared = epoch + drift * np.arange(before, before + seconds, 0.1) - track.epoch
        with np.errstate(invalid="ignore"):
            moving = np.linalg.norm(track.at(shared, 1), axis=1) * told.focal > _MOVING_PX
        if 0.1 * float(moving.sum()) < seconds / 3:
            return None
        cameras[name] = RigCamera(name, SIZE, fps=rate, intrinsics=told)
        tracks[name, "marker"] = Track(name, "marker", np.flatnonzero(seen), shown, rows, np.full(len(rows), np.nan))
        middles.append(float(epoch + drift * (before + 0.5 * seconds)))
        turns.append(pose.rotation)
    turn = so3.nearest(turns[1] @ turns[0].T)
    return Stretch(Rig(cameras), Observations(tracks), middles[0], middles[1], turn)


def lenses(rng: np.random.Generator) -> tuple[Intrinsics, Intrinsics]:
    """A long lens as it is and as it is told."""
    focal, centre = rng.uniform(1450.0, 1950.0), 0.5 * np.array(SIZE) + rng.normal(0.0, 8.0, 2)
    k1 = rng.uniform(-0.1, 0.05)
    out = []
    for told in (0.0, 1.0):
        matrix = np.eye(3)
        matrix[:2, :2] *= focal * np.exp(told * np.clip(rng.normal(0.0, 0.012), -0.02, 0.02))
        matrix[:2, 2] = centre + told * rng.normal(0.0, 8.0, 2)
        bent = np.array([k1 + told * rng.normal(0.0, 0.012), 0.05, 0.0, 0.0, 0.0])
        out.append(Intrinsics(*SIZE, matrix, bent))
    return out[0], out[1]


def _noise(rng: np.random.Generator, count: int, rate: float) -> Floats:
    """Labels' errors (n, 2) [px]: half of them each frame's own, half alike for up to half a second."""
    width = max(3, int(rng.uniform(0.2, 0.6) * rate))
    window = np.hanning(width + 2)[1:-1]
    window /= np.linalg.norm(window)
    alike = [np.convolve(rng.normal(0.0, 1.0, count + width), window, "same")[:count] for _ in range(2)]
    return np.asarray(rng.normal(0.0, 0.25, (count, 2)) + 0.3 * np.stack(alike, axis=1))


def strangers(stretches: list[Stretch]) -> int:
    """How many pairs are accepted of cameras that watched different flights."""
    accepted = 0
    for one, other in itertools.pairwise(stretches):
        tracks = [track for part, name in ((one, "a"), (other, "b")) for track in part.observations.of_camera(name)]
        rig = Rig({"a": one.rig.cameras["a"], "b": other.rig.cameras["b"]})
        try:
            calibrate(rig, Observations({(track.camera, track.label): track for track in tracks}))
        except Refused:
            continue
        accepted += 1
    return accepted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="how much the two share")
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--start", type=int, default=7000, help="first seed")
    parser.add_argument("--strangers", action="store_true", help="pairs that watched different things instead")
    options = parser.parse_args()
    seeds = range(options.start, options.start + options.sessions)
    if options.strangers:
        made = [part for seed in seeds if (part := stretch(seed, options.seconds)) is not None]
        print(f"{len(made) - 1} pairs that watched different flights: {strangers(made)} accepted")
        return
    count, errors, turns = 0, [], []
    for seed in seeds:
        pair = stretch(seed, options.seconds)
        if pair is None:
            continue
        count += 1
        try:
            found = calibrate(pair.rig, pair.observations)
        except Refused:
            continue
        one, other = (found.cameras[name].pose.rotation for name in "ab")
        turns.append(np.degrees(so3.angle_between(other @ one.T, pair.turn)))
        a, b = (found.cameras[name].time_map for name in "ab")
        errors.append(a.clock_rate * pair.at_a + a.time_offset - b.clock_rate * pair.at_b - b.time_offset)
    off = 1e3 * np.abs(np.array(errors))
    wrong = off > 1e3 * WRONG_S
    print(
        f"{count} pairs with {options.seconds:g} s in common, seeds {seeds[0]} to {seeds[-1]}: "
        f"{np.count_nonzero(~wrong)} solved, {np.count_nonzero(wrong)} wrong, "
        f"{np.count_nonzero(off > 1e3 * FAR_S)} of them over {1e3 * FAR_S:.0f} ms"
    )
    if len(off):
        print(f"lag {np.median(off):.1f} ms median, {np.sort(off)[-3:].round(1).tolist()} worst")
        print(f"rotation {np.median(turns):.1f}° median, {np.sort(turns)[-3:].round(1).tolist()} worst")


if __name__ == "__main__":
    main()
