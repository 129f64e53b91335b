"""Realistic sessions: every defect of real cameras, alone and mixed, on simulated rigs.

    python -m tests.bench.real_life [--sessions 8] [--start 0] [--only hover,lenses] [--each]

A marker is carried about a room, or hovers as a drone does; each row adds one defect, the last rows mix them over 2
to 20 cameras. Required: every camera localised that can be, none wrong. A camera's result is wrong if its clock is
more than 20 ms off in the middle of what it saw, or its orientation more than 3 degrees; a camera without a clock at
all counts as wrong if it is not refused by name.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.calibration.pipeline import calibrate  # noqa: E402
from protocols.core.clocks import TimeMap  # noqa: E402
from protocols.core.errors import Refused  # noqa: E402
from protocols.geometry import so3  # noqa: E402
from protocols.geometry.camera import Intrinsics  # noqa: E402
from protocols.geometry.pose import Pose  # noqa: E402
from protocols.geometry.types import Bools, Floats  # noqa: E402
from protocols.session.observations import DEFAULT_LABEL  # noqa: E402
from protocols.session.rig import Rig, RigCamera  # noqa: E402
from tests.support import rigs  # noqa: E402

_WRONG_S, _WRONG_RAD = 0.02, np.deg2rad(3.0)
_STEP = 0.005  # s, of the table of a path that pauses
_EASING = 0.4  # s over which it stops and goes on
_FPS = (29.97, 25.0, 50.0, 30.0, 59.94, 24.0)


@dataclass(frozen=True, slots=True)
class Trouble:
    """What goes wrong in a session; the defaults are no trouble at all.

    hover: share of the time in which the marker stands. gaps: times a camera loses it for 5 to 20 s. glimpse: mean
    seconds [s] for which it is seen at a time, 0 = always. jitter: how far [share of an interval] a phone's frame
    intervals wander about their mean; times are true. stamps: std [s] by which the stamp of a frame is off. focal,
    centre_px, k1: std of the given intrinsics minus the true ones (log, px, 1). every: only each n-th frame has a
    label. outliers: share of false detections, half of them in one place for a while. numbers: cameras with random
    frame numbers. stagger: cameras whose times are no clock's. chain: whether a camera sees together with the two
    before it and the two after it only. readout_s: longest readout of a rolling shutter.
    """

    cameras: int = 4
    seconds: float = 60.0
    fastest: float = 0.5
    noise: float = 0.5
    hover: float = 0.0
    gaps: int = 0
    glimpse: float = 0.0
    jitter: float = 0.0
    stamps: float = 0.0
    focal: float = 0.0
    centre_px: float = 0.0
    k1: float = 0.0
    every: int = 1
    outliers: float = 0.0
    numbers: int = 0
    stagger: int = 0
    chain: bool = False
    readout_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Pausing(rigs.Path):
    """A path that is not always gone on along: ``progress`` (n,) [s of the path] at each ``_STEP`` of time."""

    progress: Floats = field(default_factory=lambda: np.zeros(1))

    def at(self, time: Floats) -> Floats:
        """Positions (n, 3) [m] at true times (n,) [s]."""
        return rigs.Path.at(self, np.interp(time, _STEP * np.arange(len(self.progress)), self.progress))


def pausing(rng: np.random.Generator, seconds: float, fastest: float, hover: float) -> Pausing:
    """A random path that stands still for ``hover`` of the time, in pieces of 2 to 60 s."""
    path = rigs.random_path(rng, fastest)
    going = np.ones(int((seconds + 2.0) / _STEP))
    at = float(rng.uniform(0.0, 5.0))
    while hover > 0.0 and at < seconds:
        still = float(np.exp(rng.uniform(np.log(2.0), np.log(60.0))))
        going[int(at / _STEP) : int((at + still) / _STEP)] = 0.0
        at += still + still * (1.0 - hover) / hover * float(rng.uniform(0.5, 1.5))
    width = int(_EASING / _STEP)
    going = np.convolve(going, np.ones(width) / width, mode="same")
    return Pausing(path.frequency, path.phase, path.amplitude, _STEP * np.cumsum(going))


def session(seed: int, trouble: Trouble) -> rigs.Session:
    """One session, a pure function of its arguments."""
    t = trouble
    rng = np.random.default_rng([seed, 2024])
    path = pausing(rng, t.seconds, t.fastest, t.hover)
    poses = rigs.random_poses(rng, t.cameras)
    windows = _windows(t)
    table: dict[str, RigCamera] = {}
    clocks: dict[str, TimeMap] = {}
    camera: list[str] = []
    parts = []
    for i, pose in enumerate(poses):
        name = f"cam{i}"
        lens, rate = rigs.random_lens(rng), float(rng.choice(_FPS))
        drift, clock_origin = 1.0 + 1e-6 * float(rng.uniform(-200, 200)), rigs.EPOCHS[i % len(rigs.EPOCHS)]
        clocks[name] = TimeMap(1.0 / drift, -clock_origin / drift)
        table[name] = RigCamera(name, rigs.SIZE, rate, _told(rng, lens, t))
        interval = np.full(int(t.seconds * rate) + 1, 1.0 / rate)
        if t.jitter > 0.0:
            wander = np.convolve(rng.normal(0, 1, len(interval)), np.ones(30) / 30**0.5, mode="same")
            interval *= np.exp(t.jitter * (0.7 * wander + 0.7 * rng.normal(0, 1, len(interval))))
        true = float(rng.uniform(0, 3)) + np.cumsum(interval)
        frame = np.arange(len(true))
        use = (true < t.seconds) & (frame % t.every == 0) & (rng.random(len(true)) >= 0.02)
        use &= _seen(rng, true, t, windows[i])
        true, frame = true[use], frame[use]
        pixels = _pixels(rng, path, lens, pose, true, t)
        false = rng.random(len(true)) < t.outliers
        pixels[false] = rng.uniform((0, 0), rigs.SIZE, (int(false.sum()), 2))
        # A reflection: the same place for up to a second at a time.
        where = np.repeat(rng.uniform((0, 0), rigs.SIZE, (len(true) // 20 + 1, 2)), 20, axis=0)[: len(true)]
        sticky = np.repeat(rng.random(len(true) // 20 + 1) < 0.5 * t.outliers, 20)[: len(true)]
        pixels[sticky] = where[sticky] + rng.normal(0, t.noise, (int(sticky.sum()), 2))
        shown = clock_origin + drift * true
        if t.stamps > 0.0:  # frames keep their order
            shown = np.sort(shown + rng.normal(0, t.stamps, len(shown)))
        if i >= t.cameras - t.stagger:
            shown = np.sort(shown + np.cumsum(rng.normal(0, 0.05, len(shown))))
        if i >= t.cameras - t.stagger - t.numbers and i < t.cameras - t.stagger:
            frame = rng.permutation(10 * len(frame))[: len(frame)]
        keep = ((pixels >= 0) & (pixels < rigs.SIZE)).all(axis=1) & np.isfinite(pixels).all(axis=1)
        camera += [name] * int(keep.sum())
        parts.append((frame[keep], shown[keep], pixels[keep]))
    return rigs.Session(
        Rig(table),
        camera,
        [DEFAULT_LABEL] * len(camera),
        np.concatenate([frame for frame, _, _ in parts]),
        np.concatenate([shown for _, shown, _ in parts]),
        np.concatenate([pixels for _, _, pixels in parts]),
        {f"cam{i}": pose for i, pose in enumerate(poses)},
        clocks,
        {DEFAULT_LABEL: path},
    )


def _pixels(rng: np.random.Generator, path: Pausing, lens: Intrinsics, pose: Pose, true: Floats, t: Trouble) -> Floats:
    """What a camera sees (n, 2) of the path in frames whose middle rows are of times ``true`` (n,)."""
    readout = float(rng.uniform(0.3, 1.0)) * t.readout_s
    pixels = lens.project(pose.camera_from_world(path.at(true)))
    for _ in range(4 if readout else 0):  # the row that sees the marker is the one in which it is then
        row = np.clip(np.nan_to_num(pixels[:, 1]) / (rigs.SIZE[1] - 1), 0.0, 1.0) - 0.5
        pixels = lens.project(pose.camera_from_world(path.at(true + readout * row)))
    return np.asarray(pixels + rng.normal(0, t.noise, (len(true), 2)))


def _told(rng: np.random.Generator, lens: Intrinsics, t: Trouble) -> Intrinsics:
    """The lens as the rig has it."""
    matrix, distortions = lens.matrix.copy(), lens.distortions.copy()
    matrix[:2, :2] *= np.exp(np.clip(rng.normal(0, 1), -2, 2) * t.focal)
    matrix[:2, 2] += rng.normal(0, 1, 2) * t.centre_px
    distortions[0] += rng.normal(0, 1) * t.k1
    return Intrinsics(lens.width, lens.height, matrix, distortions)


def _windows(t: Trouble) -> list[tuple[float, float]]:
    """True times in which each camera sees.

    In a chain never more than three see together: a third of the time of the last two and of the next two. (With two at
    a time the baseline of the next two would not be observable.)
    """
    if not t.chain:
        return [(0.0, t.seconds)] * t.cameras
    length = t.seconds / (t.cameras + 2)
    return [(i * length, (i + 3) * length) for i in range(t.cameras)]


def _seen(rng: np.random.Generator, true: Floats, t: Trouble, window: tuple[float, float]) -> Bools:
    use = np.asarray((true >= window[0]) & (true < window[1]))
    for _ in range(t.gaps):
        begin = rng.uniform(window[0], window[1])
        use &= ~((true >= begin) & (true < begin + rng.uniform(5.0, 20.0)))
    at = window[0]
    while t.glimpse > 0.0 and at < window[1]:
        at += float(rng.uniform(0.5, 1.5)) * t.glimpse
        away = float(rng.uniform(0.3, 1.5)) * t.glimpse
        use &= ~((true >= at) & (true < at + away))
        at += away
    return use


def mixed(seed: int, cameras: int) -> Trouble:
    """Most troubles at once, each in a random strength."""
    rng = np.random.default_rng([seed, cameras, 77])
    chain = cameras > 2 and bool(rng.random() < 0.3)
    return Trouble(
        cameras=cameras,
        seconds=20.0 * (cameras + 2) if chain else float(rng.uniform(60, 180)),
        fastest=float(rng.uniform(0.25, 0.8)),
        noise=float(rng.uniform(0.3, 1.2)),
        hover=float(rng.choice([0.0, 0.4, 0.7])),
        gaps=int(rng.integers(0, 3)),
        glimpse=float(rng.choice([0.0, 0.0, 4.0, 8.0])),
        jitter=float(rng.choice([0.0, 0.1])),
        focal=float(rng.choice([0.0, 0.01])),
        centre_px=float(rng.choice([0.0, 6.0])),
        k1=float(rng.choice([0.0, 0.01])),
        every=int(rng.choice([1, 1, 2, 4])),
        outliers=float(rng.choice([0.0, 0.03, 0.1])),
        numbers=int(rng.integers(0, 2)),
        stagger=int(cameras > 2 and rng.random() < 0.3),
        chain=chain,
        readout_s=float(rng.choice([0.0, 0.0, 0.025])),
    )


Make = Callable[[int], Trouble]


def _always(trouble: Trouble) -> Make:
    return lambda seed: trouble


def _mixed(cameras: int) -> Make:
    return lambda seed: mixed(seed, cameras)


_CARRIED = Trouble()
ROWS: dict[str, Make] = {
    "no trouble": _always(_CARRIED),
    "hovers for 80 % of 5 min": _always(replace(_CARRIED, hover=0.8, seconds=300.0, fastest=0.3)),
    "gaps of 5 to 20 s": _always(replace(_CARRIED, gaps=3, seconds=90.0)),
    "seen for 3 s at a time": _always(replace(_CARRIED, glimpse=3.0)),
    "variable frame rate": _always(replace(_CARRIED, jitter=0.15)),
    "stamps that jitter by 10 ms": _always(replace(_CARRIED, stamps=0.01)),
    "stamps that jitter by 30 ms": _always(replace(_CARRIED, stamps=0.03)),
    "lenses: focal length 1.5 %, centre 8 px, k1 0.015": _always(replace(_CARRIED, focal=0.015, centre_px=8, k1=0.015)),
    "false detections, 15 %": _always(replace(_CARRIED, outliers=0.15)),
    "labels on every fourth frame": _always(replace(_CARRIED, every=4)),
    "random frame numbers": _always(replace(_CARRIED, numbers=2)),
    "one camera has no clock": _always(replace(_CARRIED, stagger=1)),
    "never more than three see it together": _always(replace(_CARRIED, cameras=6, chain=True, seconds=120.0)),
    "rolling shutters of up to 30 ms": _always(replace(_CARRIED, readout_s=0.03)),
    "mixed, 2 cameras": _mixed(2),
    "mixed, 3 cameras": _mixed(3),
    "mixed, 4 cameras": _mixed(4),
    "mixed, 6 cameras": _mixed(6),
    "mixed, 10 cameras": _mixed(10),
    "mixed, 20 cameras": _mixed(20),
}


@dataclass(frozen=True, slots=True)
class SessionResult:
    """One session: cameras that could be localised, that were, wrong ones (with the reason), errors and CPU [s]."""

    localisable: int
    localised: int
    wrong: tuple[str, ...]
    lag_ms: tuple[float, ...]
    turn_degrees: tuple[float, ...]
    refused: dict[str, str]
    cpu_s: float


def evaluate_session(seed: int, trouble: Trouble) -> SessionResult:
    """Calibrate one session as the command does and compare every camera with the truth."""
    made = session(seed, trouble)
    clockless = {f"cam{i}" for i in range(trouble.cameras - trouble.stagger, trouble.cameras)}
    localisable = trouble.cameras - len(clockless)
    begin = time.process_time()
    try:
        found = calibrate(made.rig, made.observations(), thorough=True)
    except Refused as refusal:
        return SessionResult(localisable, 0, (), (), (), refusal.cameras, time.process_time() - begin)
    spent = time.process_time() - begin
    lags, turns, wrong = [], [], []
    first = next((name for name in found.cameras if name not in clockless), found.reference)
    if found.reference in clockless:
        wrong.append(f"{found.reference} is the reference and has no clock")
    for name, one in found.cameras.items():
        if name in clockless:
            wrong.append(f"{name} has no clock")
            continue
        lag = abs(made.clock_error(name, found.reference, one.time_map))
        turned = so3.nearest(made.poses[name].rotation @ made.poses[first].rotation.T)
        turn = so3.angle_between(one.pose.rotation @ found.cameras[first].pose.rotation.T, turned)
        if lag > _WRONG_S or turn > _WRONG_RAD:
            wrong.append(f"{name}: {1e3 * lag:.1f} ms, {np.degrees(turn):.2f}°")
        if name != found.reference:
            lags.append(1e3 * lag)
        if name != first:
            turns.append(float(np.degrees(turn)))
    localised = len([name for name in found.cameras if name not in clockless])
    return SessionResult(localisable, localised, tuple(wrong), tuple(lags), tuple(turns), found.refused, spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=8)
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--only", default="", help="rows whose name contains one of these")
    parser.add_argument("--each", action="store_true", help="report every session in which something is missing")
    options = parser.parse_args()
    print(f"{options.sessions} sessions a row from seed {options.start}")
    print(f"{'':52} localised      wrong  lag ms, median, worst   rotation °     CPU s")
    for name, make in ROWS.items():
        if not any(part in name for part in options.only.split(",")):
            continue
        answers = []
        for seed in range(options.start, options.start + options.sessions):
            answer = evaluate_session(seed, make(seed))
            answers.append(answer)
            if options.each and (answer.wrong or answer.localised < answer.localisable):
                print(f"  seed {seed}: {make(seed)}\n    wrong {answer.wrong}, refused {answer.refused}", flush=True)
        localisable, localised = sum(one.localisable for one in answers), sum(one.localised for one in answers)
        lags = [value for one in answers for value in one.lag_ms]
        turns = [value for one in answers for value in one.turn_degrees]
        print(
            f"{name:52} {localised:4d} of {localisable:4d}   {sum(len(one.wrong) for one in answers):4d}  "
            f"{_told_figures(lags)}   {_told_figures(turns)}   {np.mean([one.cpu_s for one in answers]):6.2f}",
            flush=True,
        )


def _told_figures(values: list[float]) -> str:
    return f"{np.median(values):8.3f} {max(values):9.3f}" if values else f"{'–':>8} {'–':>9}"


if __name__ == "__main__":
    main()
