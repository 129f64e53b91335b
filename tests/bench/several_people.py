"""Cameras calibrated by the keypoints of several walking people, whom every camera numbers in its own, changing way.

    python -m tests.bench.several_people [--seeds 1 2] [--people 3] [--fps 25 30 25] [--seconds 30]
        [--noise 2] [--no-lenses]

Keypoints have noise and gaps, and a camera numbers people anew every 5 s. Printed: the share of the keypoints whose
name is one person in all cameras, the errors of the calibration from them after one similarity (of two cameras: those
of the relative pose), those of lags and clock rates over their stds, and readouts and clock steps, of which there are
none.
"""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from hub.calibration.people.association import associate_people
from hub.calibration.pipeline import calibrate
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.pose import fit_similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from tests.bench.options import bench_parser
from tests.support.walking_people import JOINTS, PeopleWorld, people_world


def main() -> int:
    parser = bench_parser(__doc__, people=3, seconds=30.0, noise=2.0, no_lenses=False)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--fps", type=float, nargs="+", default=[25.0, 30.0, 25.0])
    options = parser.parse_args()
    errors, invented = [np.zeros((0, 4))], 0
    for seed in options.seeds:
        world = people_world(seed, options.people, tuple(options.fps))
        given = world.observations(options.seconds, noise=options.noise, seed=seed)
        began = time.process_time()
        rig, seen, _ = associate_people(world.rig(not options.no_lenses), given)
        spent = time.process_time() - began
        right = sum(max(who.values()) for who in named(world, seen).values())
        total = sum(who.total() for who in named(world, seen).values())
        print(
            f"seed {seed}: {100 * right / total:.1f} % named rightly, {100 * len(seen) / len(given):.0f} % of the rows,"
        )
        try:
            text, found = scored(world, rig, seen)
        except Refused as refused:
            print(f"  refused: {refused.reason}", flush=True)
            continue
        errors.append(clock_errors(world, found))
        names = [name for name, one in found.cameras.items() if one.readout_std or one.clock_steps]
        invented += bool(names)
        print(f"  {text}; association {spent:.0f} s of CPU; a readout or step: {', '.join(names) or 'none'}")
        print(f"  lag ± std [s], rate ± std: {errors[-1].tolist()}", flush=True)
    lag, lag_std, rate, rate_std = np.concatenate(errors).T
    z = [float(np.sqrt(np.mean(error**2))) for error in (lag / lag_std, rate / rate_std)]
    print(f"rms of z: lags {z[0]:.2f}, rates {z[1]:.2f}; {invented} of {len(errors) - 1} with a readout or step")
    return 0


def clock_errors(world: PeopleWorld, found: Calibration) -> Floats:
    """Errors of lag [s] and rate, each with its std, (n, 4), of the cameras but the reference."""
    base, out = world.cameras[found.reference], list[tuple[float, ...]]()
    for name, one in found.cameras.items():
        if name != found.reference:
            rate, offset = np.array([world.cameras[name].rate, world.cameras[name].offset - base.offset]) / base.rate
            lag = one.lag - (rate - 1.0) * one.lag_time - offset
            out.append((lag, one.lag_std, one.time_map.clock_rate - rate, one.clock_rate_std))
    return np.array(out).reshape(-1, 4)


def named(world: PeopleWorld, observations: Observations) -> dict[str, Counter[int]]:
    """How often each name is which true person, by the place of the nose."""
    nose = JOINTS.index("nose")
    found: dict[str, Counter[int]] = {}
    for (camera, label), track in observations.tracks.items():
        person, _, joint = label.partition(".")
        if joint == "nose":
            one = world.cameras[camera]
            for stamp, pixel in zip(track.time[::10].tolist(), track.pixels[::10], strict=True):
                noses = world.people(stamp * one.rate + one.offset)[:, nose]
                distance = np.linalg.norm(one.lens.project(one.pose.camera_from_world(noses)) - pixel, axis=1)
                found.setdefault(person, Counter())[int(distance.argmin())] += 1
    return found


def scored(world: PeopleWorld, rig: Rig, seen: Observations) -> tuple[str, Calibration]:
    """The errors of the calibration, and itself."""
    began = time.process_time()
    calibration = calibrate(rig, seen, thorough=True)
    spent, found = time.process_time() - began, calibration.cameras
    poses = [{name: one[name].pose for name in found} for one in (found, world.cameras)]
    centres = [np.array([pose.position for pose in one.values()]) for one in poses]
    if len(found) > 2:
        fit = fit_similarity(*centres)
        turns = [so3.angle_between(fit.pose(poses[0][name]).rotation, pose.rotation) for name, pose in poses[1].items()]
        worst = f"{100 * float(np.linalg.norm(fit.points(centres[0]) - centres[1], axis=1).max()):.1f} cm"
    else:  # two centres fit always, and leave the turn about their line
        base, other = ([one[name].rotation for one in poses] for name in found)
        turns = [so3.angle_between(*(b @ a.T for a, b in zip(base, other, strict=True)))]
        lines = [a @ (one[1] - one[0]) / np.linalg.norm(one[1] - one[0]) for a, one in zip(base, centres, strict=True)]
        worst = f"direction {np.degrees(np.arccos(min(lines[0] @ lines[1], 1.0))):.2f}°"
    lags = 1e3 * float(np.abs(clock_errors(world, calibration)[:, 0]).max())
    text = f"{len(found)} of {len(world.cameras)} cameras, {worst}, {np.degrees(max(turns)):.2f}°, lags {lags:.1f} ms"
    return f"{text}, {spent:.0f} s of CPU", calibration


if __name__ == "__main__":
    raise SystemExit(main())
