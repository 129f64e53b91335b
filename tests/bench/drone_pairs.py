"""Two cameras far from a drone with a short common stretch, and inaccurate intrinsics and readout times.

    python -m tests.bench.drone_pairs [--seconds 20] [--sessions 60] [--start 7000] [--unrelated]

Each camera films 30 to 90 s more than the stretch, before or after it. A solution is wrong if its lag is over 20 ms off
at the middle of the stretch. Label errors are correlated over half a second, focal lengths are off by up to 2 %,
principal points by 8 px, k1 by 0.012; readout times are up to 25 ms in either direction. Stretches do not count if a
camera sees motion in less than a third of them.
--unrelated: a of each stretch with b of the next one, which saw another flight; none may be accepted.
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
from tests.support import rigs  # noqa: E402

WRONG_S, FAR_S = 0.02, 0.03
SIZE = (1920, 1080)
FPS = (25.0, 29.97, 30.0, 50.0, 59.94)
_MOVING_PX = 20.0  # px/s
_EXTENT = 10.0  # m, of the flight


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A session of cameras a and b.

    at_a, at_b: times [s] on their clocks of one instant in the middle of the common stretch. rotation: (3, 3) b from a.
    """

    rig: Rig
    observations: Observations
    at_a: float
    at_b: float
    rotation: Floats


def flight(rng: np.random.Generator) -> rigs.Path:
    """A path of slow waves of some ten metres and small faster ones, more or less planar."""
    frequency = np.r_[rng.uniform(0.01, 0.05, 4), rng.uniform(0.05, 0.2, 3)][:, None] * rng.uniform(0.8, 1.25, (7, 3))
    amplitude = rng.uniform(0.4, 1.0, (7, 3))
    amplitude[4:] *= rng.uniform(0.03, 0.2)
    amplitude *= _EXTENT / amplitude.sum(axis=0) * rng.uniform(0.6, 1.2, 3)
    amplitude[:, 2] *= rng.choice([0.05, 0.15, 0.4, 0.8])
    return rigs.Path(frequency, rng.uniform(0.0, 2.0 * np.pi, (7, 3)), amplitude)


def stretch(seed: int, seconds: float) -> Stretch | None:
    """One pair, a pure function of its arguments; None with too little motion or too few detections."""
    rng = np.random.default_rng([seed, 815])
    before, after = rng.uniform(30.0, 90.0, 2)
    path, first = flight(rng), float(rng.uniform(0.0, 2.0 * np.pi))
    bearings = (first, first + np.deg2rad(rng.uniform(25.0, 110.0)))
    spans = ((0.0, before + seconds), (before, before + seconds + after))
    cameras, tracks, middles, rotations = {}, {}, [], []
    for name, bearing, (begin, end) in zip("ab", bearings, spans, strict=True):
        away = rng.uniform(35.0, 70.0)
        place = np.array([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-12.0, -6.0)])
        pose = rigs.look_at_pose(place, rng.normal(0.0, 1.5, 3), float(rng.normal(0.0, 0.03)))
        true, given = lenses(rng)
        rate, drift, epoch = float(rng.choice(FPS)), 1.0 + 1e-6 * rng.uniform(-100.0, 100.0), rng.uniform(0.0, 1e3)
        time = begin + rng.uniform(0.0, 1.0 / rate) + np.arange(int((end - begin) * rate)) / rate
        readout = rng.uniform(-0.025, 0.025)
        pixels = true.project(pose.camera_from_world(path.at(time)))
        for _ in range(3):  # fixed point: the row of the drone and the time at which it is read
            row = np.clip(np.nan_to_num(pixels[:, 1]) / (SIZE[1] - 1), 0.0, 1.0) - 0.5
            pixels = true.project(pose.camera_from_world(path.at(time + readout * row)))
        pixels = pixels + _noise(rng, len(time), rate)
        with np.errstate(invalid="ignore"):
            seen = ((pixels >= 0) & (pixels < SIZE)).all(axis=1)
        rows, shown = pixels[seen], epoch + drift * time[seen]
        track = smooth_track(shown, given.unproject(rows), given.focal) if seen.any() else None
        if track is None:
            return None
        shared = epoch + drift * np.arange(before, before + seconds, 0.1) - track.time_origin
        with np.errstate(invalid="ignore"):
            moving = np.linalg.norm(track.at(shared, 1), axis=1) * given.focal > _MOVING_PX
        if 0.1 * float(moving.sum()) < seconds / 3:
            return None
        cameras[name] = RigCamera(name, SIZE, fps=rate, intrinsics=given)
        tracks[name, "marker"] = Track(name, "marker", np.flatnonzero(seen), shown, rows, np.full(len(rows), np.nan))
        middles.append(float(epoch + drift * (before + 0.5 * seconds)))
        rotations.append(pose.rotation)
    rotation = so3.nearest(rotations[1] @ rotations[0].T)
    return Stretch(Rig(cameras), Observations(tracks), middles[0], middles[1], rotation)


def lenses(rng: np.random.Generator) -> tuple[Intrinsics, Intrinsics]:
    """True and given intrinsics of a long lens."""
    focal, centre = rng.uniform(1450.0, 1950.0), 0.5 * np.array(SIZE) + rng.normal(0.0, 8.0, 2)
    k1 = rng.uniform(-0.1, 0.05)
    out = []
    for given in (0.0, 1.0):
        matrix = np.eye(3)
        matrix[:2, :2] *= focal * np.exp(given * np.clip(rng.normal(0.0, 0.012), -0.02, 0.02))
        matrix[:2, 2] = centre + given * rng.normal(0.0, 8.0, 2)
        distortion = np.array([k1 + given * rng.normal(0.0, 0.012), 0.05, 0.0, 0.0, 0.0])
        out.append(Intrinsics(*SIZE, matrix, distortion))
    return out[0], out[1]


def _noise(rng: np.random.Generator, count: int, rate: float) -> Floats:
    """Label errors (n, 2) [px]: white noise plus noise correlated over up to half a second."""
    width = max(3, int(rng.uniform(0.2, 0.6) * rate))
    window = np.hanning(width + 2)[1:-1]
    window /= np.linalg.norm(window)
    correlated = [np.convolve(rng.normal(0.0, 1.0, count + width), window, "same")[:count] for _ in range(2)]
    return np.asarray(rng.normal(0.0, 0.25, (count, 2)) + 0.3 * np.stack(correlated, axis=1))


def count_accepted_unrelated(stretches: list[Stretch]) -> int:
    """Number of accepted pairs of cameras that saw different flights."""
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
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the common stretch")
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--start", type=int, default=7000, help="first seed")
    parser.add_argument("--unrelated", action="store_true", help="pairs that saw different flights instead")
    options = parser.parse_args()
    seeds = range(options.start, options.start + options.sessions)
    if options.unrelated:
        made = [part for seed in seeds if (part := stretch(seed, options.seconds)) is not None]
        print(f"{len(made) - 1} pairs that saw different flights: {count_accepted_unrelated(made)} accepted")
        return
    count, errors, rotation_errors = 0, [], []
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
        rotation_errors.append(np.degrees(so3.angle_between(other @ one.T, pair.rotation)))
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
        worst = np.sort(rotation_errors)[-3:].round(1).tolist()
        print(f"rotation {np.median(rotation_errors):.1f}° median, {worst} worst")


if __name__ == "__main__":
    main()
