"""What one broken camera costs a rig, and whether it is named and the others' answer stays.

    python -m tests.bench.broken_cameras [--cameras N] [--seconds S] [--seeds N] [--first SEED] [--session FOLDER]

Each rig is calibrated without its last camera, with it as it is, and with it broken in one way after the other: rows
labelled by another frame numbering, rows shuffled, another recording, a mirrored or turned picture, wrong lenses, a
camera that is moved. CPU seconds are those of `calibrate`; change: the largest change of another camera's position or
lag, in its stated stds. Requirement: at most twice the CPU without it, named, changes below one std.
--session: a recorded session instead of simulated ones, each of its cameras broken in turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from hub.calibration.pipeline import calibrate
from protocols.geometry import so3
from protocols.geometry.types import Bools
from protocols.session.calibration import Calibration
from protocols.session.folder import read_folder
from tests.bench.options import bench_parser
from tests.support import rigs

Breakage = Callable[[rigs.Session, str, Bools, np.random.Generator], rigs.Session]


def other_numbering(session: rigs.Session, name: str, mine: Bools, random: np.random.Generator) -> rigs.Session:
    """Every label belongs to a frame that is on average 1.7 s away, by jumps: a numbering that skips frames."""
    times = session.time.copy()
    times[mine] += np.repeat(random.uniform(-3.0, 3.0, 1 + mine.sum() // 40), 40)[: mine.sum()]
    return replace(session, time=times)


def shuffled(session: rigs.Session, name: str, mine: Bools, random: np.random.Generator) -> rigs.Session:
    """Pixels permuted among the rows."""
    pixels = session.pixels.copy()
    pixels[mine] = pixels[random.permutation(np.flatnonzero(mine))]
    return replace(session, pixels=pixels)


def another_recording(session: rigs.Session, name: str, mine: Bools, random: np.random.Generator) -> rigs.Session:
    """The camera watched another path; a recorded one: its own, in reverse."""
    if not session.paths:
        pixels = session.pixels.copy()
        pixels[mine] = pixels[mine][::-1]
        return replace(session, pixels=pixels)
    other = rigs.random_path(np.random.default_rng([7, int(random.integers(1 << 30))]))
    true = np.array([session.true_time(name, float(t)) for t in session.time[mine]])
    lens = session.lens(name)
    pixels = session.pixels.copy()
    pixels[mine] = lens.project(session.poses[name].camera_from_world(other.at(true)))
    return replace(session, pixels=np.nan_to_num(pixels, nan=0.0))


def mirrored(session: rigs.Session, name: str, mine: Bools, random: np.random.Generator) -> rigs.Session:
    """The picture is a mirror image."""
    pixels = session.pixels.copy()
    pixels[mine, 0] = session.rig.cameras[name].size[0] - 1 - pixels[mine, 0]
    return replace(session, pixels=pixels)


def wrong_lens(
    session: rigs.Session, name: str, mine: Bools, focal: float, resized: float = 1.0, moved: float = 0.0
) -> rigs.Session:
    """The camera matrix is another one: a focal length, a picture of another size, a centre moved by a crop."""
    camera = session.rig.cameras[name]
    assert camera.intrinsics is not None
    matrix = camera.intrinsics.matrix.copy()
    matrix[:2, :2] *= focal
    matrix[:2] *= resized
    matrix[:2, 2] += moved * np.array(camera.size)
    wrong = replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))
    return replace(session, rig=replace(session.rig, cameras=session.rig.cameras | {name: wrong}))


def turned(session: rigs.Session, name: str, mine: Bools, random: np.random.Generator) -> rigs.Session:
    """The picture is upside down: its lens then differs by twice what its centre is off."""
    pixels = session.pixels.copy()
    pixels[mine] = np.array(session.rig.cameras[name].size) - 1 - pixels[mine]
    return replace(session, pixels=pixels)


def fisheye(session: rigs.Session, name: str, mine: Bools, random: np.random.Generator) -> rigs.Session:
    """The lens is a fisheye, given as a plain one."""
    lens, pixels = session.rig.cameras[name].intrinsics, session.pixels.copy()
    assert lens is not None
    rays = np.column_stack([lens.unproject(pixels[mine]), np.ones(mine.sum())])
    pixels[mine] = replace(lens, distortions=np.zeros(4), fisheye=True).project(rays)
    return replace(session, pixels=pixels)


def moved(session: rigs.Session, name: str, mine: Bools, random: np.random.Generator) -> rigs.Session:
    """The camera is turned by 1° to 10° at a quarter to three quarters of the recording."""
    lens, pixels = session.rig.cameras[name].intrinsics, session.pixels.copy()
    assert lens is not None
    after = mine & (session.time > np.quantile(session.time[mine], random.uniform(0.25, 0.75)))
    axis = random.normal(size=3)
    turn = so3.exp(np.deg2rad(10.0 ** random.uniform(0.0, 1.0)) * axis / np.linalg.norm(axis))
    pixels[after] = lens.project(np.column_stack([lens.unproject(pixels[after]), np.ones(after.sum())]) @ turn.T)
    return replace(session, pixels=pixels)


BREAKAGES: dict[str, Breakage] = {
    "other numbering": other_numbering,
    "shuffled": shuffled,
    "another recording": another_recording,
    "mirrored": mirrored,
    "wrong lens": lambda session, name, mine, _: wrong_lens(session, name, mine, 1.3),
    "short lens": lambda session, name, mine, _: wrong_lens(session, name, mine, 0.7),
    "half size": lambda session, name, mine, _: wrong_lens(session, name, mine, 1.0, 0.5),
    "double size": lambda session, name, mine, _: wrong_lens(session, name, mine, 1.0, 2.0),
    "crop": lambda session, name, mine, _: wrong_lens(session, name, mine, 1.0, moved=0.2),
    "turned": turned,
    "fisheye": fisheye,
    "moved": moved,
}


def recorded(folder: Path) -> rigs.Session:
    """A recorded session, whose truth is unknown."""
    rig, found = read_folder(folder)
    tracks = [(name, track) for name in rig.cameras for track in found.of_camera(name)]
    counts = [len(track.time) for _, track in tracks]
    return rigs.Session(
        rig,
        [name for (name, _), count in zip(tracks, counts, strict=True) for _ in range(count)],
        [track.label for (_, track), count in zip(tracks, counts, strict=True) for _ in range(count)],
        np.concatenate([np.arange(count) for count in counts]),
        np.concatenate([track.time for _, track in tracks]),
        np.concatenate([track.pixels for _, track in tracks]),
        {},
        {},
        {},
    )


def without(session: rigs.Session, name: str) -> rigs.Session:
    """The session without a camera."""
    cameras = {one: camera for one, camera in session.rig.cameras.items() if one != name}
    return replace(session, rig=replace(session.rig, cameras=cameras)).where(~session.of_camera(name))


def timed(session: rigs.Session) -> tuple[Calibration, float]:
    """The calibration as the command makes it, and its CPU seconds, the least of three runs."""
    observations, spent = session.observations(), []
    for _ in range(3):
        began = time.process_time()
        found = calibrate(session.rig, observations, thorough=True)
        spent.append(time.process_time() - began)
    return found, min(spent)


def change(before: Calibration, after: Calibration) -> float:
    """Largest change of a position or lag in its stated std; inf where a camera is missing."""
    worst = 0.0
    for name, one in before.cameras.items():
        if name not in after.cameras:
            return float("inf")
        other = after.cameras[name]
        free = one.position_std > 0.0
        moved = np.abs(other.pose.position - one.pose.position)[free] / one.position_std[free]
        worst = max(worst, float(moved.max(initial=0.0)))
        if one.lag_std > 0.0:
            at_lag = (other.time_map.clock_rate - 1.0) * one.lag_time + other.time_map.time_offset
            worst = max(worst, abs(at_lag - one.lag) / one.lag_std)
    return worst


def names(found: Calibration, name: str) -> bool:
    """Whether the answer says that something is wrong with the camera."""
    return name in found.refused or any(text.startswith(f"{name}:") for text in found.warnings)


def main() -> None:
    """Print one line a rig and breakage."""
    options = bench_parser(__doc__, cameras=7, seconds=40.0, seeds=3, first=0, session=Path).parse_args()
    ratios, bad = [], []
    if options.session is None:
        seeds = range(options.first, options.first + options.seeds)
        tasks = [(seed, rigs.simulate(seed, options.cameras, options.seconds), -1) for seed in seeds]
    else:
        real = recorded(options.session)
        tasks = [(number, real, number) for number in range(len(real.rig.cameras))]
    for seed, session, number in tasks:
        name = list(session.rig.cameras)[number]
        mine = session.of_camera(name)
        before, base = timed(without(session, name))
        whole = timed(session)[1]
        print(f"rig {seed}: {base:.1f} s CPU without {name}, {whole:.1f} s with it", flush=True)
        for kind, breakage in BREAKAGES.items():
            found, cpu = timed(breakage(session, name, mine, np.random.default_rng(seed)))
            moved, named = change(before, found), names(found, name)
            ratios.append(cpu / base)
            if not (named and moved < 1.0 and cpu < 2.0 * base):
                bad.append(f"{seed} {kind}")
            reason = found.refused.get(name) or next((t for t in found.warnings if t.startswith(f"{name}:")), "")
            print(
                f"  {kind}: {cpu:.1f} s ({cpu / base:.2f}), change {moved:.2f} std, {reason[:110] or 'NOT NAMED'}",
                flush=True,
            )
    print(f"CPU ratio: median {np.median(ratios):.2f}, worst {max(ratios):.2f}; {len(bad)} not met: {', '.join(bad)}")


if __name__ == "__main__":
    main()
