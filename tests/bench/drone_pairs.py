"""Two cameras far from a drone that share a short stretch, with lenses and shutters told a little wrong.

    python -m tests.bench.drone_pairs [--seconds 20] [--sessions 60] [--start 7000]

Each camera filmed 30 to 90 s more than the stretch, before or after it. Asked of every answer: its lag within 20 ms in
the middle of the stretch. Labels err alike for half a second, focal lengths by up to 2 %, centres by 8 px, k1 by 0.012;
shutters roll for up to 25 ms either way. Stretches in which a camera sees less than a third of motion do not count.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.timing.pair import solve_pair  # noqa: E402
from hub.timing.tracks import SmoothTrack, smooth_track  # noqa: E402
from protocols.geometry.camera import Intrinsics  # noqa: E402
from protocols.geometry.types import Floats  # noqa: E402
from tests import rigs  # noqa: E402

WRONG_S = 0.02
SIZE = (1920, 1080)
_FPS = (25.0, 29.97, 30.0, 50.0, 59.94)
_MOVING_PX = 20.0  # px/s
_EXTENT = 10.0  # m, of the flight


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Two smoothed tracks, and the times [s] on their own clocks of one instant in the middle of what they share."""

    left: SmoothTrack
    right: SmoothTrack
    at_left: float
    at_right: float


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
    tracks, middles = [], []
    for bearing, (begin, end) in zip(bearings, spans, strict=True):
        away = rng.uniform(35.0, 70.0)
        place = np.array([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-12.0, -6.0)])
        pose = rigs.looking_at(place, rng.normal(0.0, 1.5, 3), float(rng.normal(0.0, 0.03)))
        true, told = _lenses(rng)
        rate, drift, epoch = float(rng.choice(_FPS)), 1.0 + 1e-6 * rng.uniform(-100.0, 100.0), rng.uniform(0.0, 1e3)
        time = begin + rng.uniform(0.0, 1.0 / rate) + np.arange(int((end - begin) * rate)) / rate
        readout = rng.uniform(-0.025, 0.025)
        pixels = true.project(pose.camera_from_world(path.at(time)))
        for _ in range(3):  # the row that sees the drone is the one in which it is then
            row = np.clip(np.nan_to_num(pixels[:, 1]) / (SIZE[1] - 1), 0.0, 1.0) - 0.5
            pixels = true.project(pose.camera_from_world(path.at(time + readout * row)))
        pixels = pixels + _noise(rng, len(time), rate)
        with np.errstate(invalid="ignore"):
            seen = ((pixels >= 0) & (pixels < SIZE)).all(axis=1)
        track = (
            smooth_track(epoch + drift * time[seen], told.unproject(pixels[seen]), told.focal) if seen.any() else None
        )
        if track is None:
            return None
        shared = epoch + drift * np.arange(before, before + seconds, 0.1) - track.epoch
        with np.errstate(invalid="ignore"):
            moving = np.linalg.norm(track.at(shared, 1), axis=1) * told.focal > _MOVING_PX
        if 0.1 * float(moving.sum()) < seconds / 3:
            return None
        tracks.append(track)
        middles.append(float(epoch + drift * (before + 0.5 * seconds) - track.epoch))
    return Stretch(tracks[0], tracks[1], middles[0], middles[1])


def _lenses(rng: np.random.Generator) -> tuple[Intrinsics, Intrinsics]:
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="how much the two share")
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--start", type=int, default=7000, help="first seed")
    options = parser.parse_args()
    count, errors, doubts = 0, [], []
    for seed in range(options.start, options.start + options.sessions):
        pair = stretch(seed, options.seconds)
        if pair is None:
            continue
        count += 1
        found = solve_pair({"": pair.left}, {"": pair.right}, ("a", "b"))
        if found.solved and found.fit is not None:
            errors.append(abs(found.fit.rate * pair.at_right + found.fit.offset - pair.at_left))
            doubts.append(found.fit.lag_doubt)
    off, std = np.array(errors), np.array(doubts)
    wrong = off > WRONG_S
    print(
        f"{count} pairs with {options.seconds:g} s in common, seeds {options.start} to "
        f"{options.start + options.sessions - 1}: {np.count_nonzero(~wrong)} solved, {np.count_nonzero(wrong)} wrong"
    )
    if len(off):
        ratio = off / std
        print(
            f"error {1e3 * np.median(off):.1f} ms median, {1e3 * off.max():.1f} worst; over its std "
            f"{np.median(ratio):.2f} median, {ratio.max():.1f} worst"
        )


if __name__ == "__main__":
    main()
