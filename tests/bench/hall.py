"""A simulated hall: ``python -m tests.bench.hall [--cameras 7] [--people 20] [--fps 10] [--seconds 20]``.

People walk to goals, stop, avoid each other, and some walk in pairs. Each camera misses 10 % of those in view and 70 %
of those behind somebody; head, foot and place are off by 3 % of the height, and half a box a view is false. The same
detections go through ``follow`` and, in the order of their times, through the hub's live tracking. Prints MOTA, IDF1
(TrackEval, matches within 0.5 m), identity switches, mean error and CPU seconds a second filmed. ``--turn`` and
``--shift``: std of the given poses' errors [deg, m]. ``--lag``: the cameras take their frames spread over so much [s].
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from deploy.evaluation.tracking_scores import GroundTruth, ScoredTrack, score_tracks
from edge.scenes.common.base import look_at_pose
from hub.tracking.live_tracking import LiveTracking
from hub.tracking.offline import follow
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, CameraCalibration
from tests.bench.crowd import published_positions

UP = np.array([0.0, 0.0, 1.0])
SIZE, FOCAL = (1280, 720), 900.0
STEPS_HZ = 60
MISSED, HIDDEN_MISSED, NOISE, FALSE_BOXES = 0.1, 0.7, 0.03, 0.5
COLUMNS = ("mota", "idf1", "recall", "precision", "switches", "error")


@dataclass(frozen=True, slots=True, eq=False)
class Hall:
    """Detections in the order of their times [s], the given calibration, the truth, and the wanted times [s]."""

    messages: list[tuple[float, pb.Observation]]
    calibration: Calibration
    truth: GroundTruth
    times: list[float]


def walk(rng: np.random.Generator, people: int, seconds: float, half: float) -> Floats:
    """Places (t, n, 2) [m] of people in a square of side 2 ``half``, ``STEPS_HZ`` a second."""
    place, goal = rng.uniform(-half, half, (2, people, 2))
    velocity, pause = np.zeros((people, 2)), np.zeros(people)
    speed = rng.normal(1.3, 0.2, people).clip(0.7, 2.0)
    mate = np.where((np.arange(people) % 2 == 1) & (rng.random(people) < 0.4), np.arange(people) - 1, -1)
    place[mate >= 0] = place[mate[mate >= 0]] + [0.5, 0.0]
    beside = 0.55 * np.column_stack([np.cos(angle := rng.uniform(0.0, 2.0 * np.pi, people)), np.sin(angle)])
    out = np.zeros((round(seconds * STEPS_HZ) + STEPS_HZ, people, 2))
    for step in range(len(out)):
        for i in np.flatnonzero(np.linalg.norm(goal - place, axis=1) < 0.4).tolist():
            pause[i] = rng.uniform(2.0, 10.0) if rng.random() < 0.35 else pause[i]
            goal[i] = rng.uniform(-half, half, 2)
        led = mate >= 0
        goal[led] = place[mate[led]] + beside[led] + 0.8 * velocity[mate[led]]
        way = goal - place
        wanted = speed[:, None] * way / np.maximum(np.linalg.norm(way, axis=1), 0.3)[:, None]
        wanted[pause > 0.0] = 0.0
        pause = np.maximum(pause - 1.0 / STEPS_HZ, 0.0)
        off = place[:, None] - place[None]
        distance = np.linalg.norm(off, axis=2) + 9.0 * np.eye(people)
        push = (off / distance[..., None] * (4.0 * np.clip(0.7 - distance, 0.0, 1.0))[..., None]).sum(axis=1)
        velocity += (wanted + push - velocity) * (5.0 / STEPS_HZ)
        place = place + velocity / STEPS_HZ
        out[step] = place
    return out


def simulated(
    seed: int,
    cameras: int = 7,
    people: int = 20,
    fps: float = 10.0,
    seconds: float = 20.0,
    half: float = 6.0,
    turn: float = 0.0,
    shift: float = 0.0,
    lag: float = 0.0,
    move: Callable[[np.random.Generator, int, float, float], Floats] = walk,
) -> Hall:
    """The detections of a hall. turn [rad], shift [m]: std of the given poses' errors. lag [s]: of the last camera.

    move: paths as of `walk`.
    """
    rng = np.random.default_rng(seed)
    paths, tall = move(rng, people, seconds, half), rng.normal(1.72, 0.08, people)
    matrix = np.array([[FOCAL, 0.0, SIZE[0] / 2 - 0.5], [0.0, FOCAL, SIZE[1] / 2 - 0.5], [0.0, 0.0, 1.0]])
    lens = Intrinsics(*SIZE, matrix)
    frames = round(seconds * fps)
    seen = np.zeros((frames, people), dtype=np.bool_)
    messages, given = [], {}
    for index in range(cameras):
        name, angle, delay = f"cam{index}", 2.0 * np.pi * index / cameras + 0.3, lag * index / max(cameras - 1, 1)
        stand = np.array([1.7 * half * np.cos(angle), 1.7 * half * np.sin(angle), 3.0 * (1.0 + 0.25 * (index % 3))])
        pose = look_at_pose(stand, 0.9 * UP)
        wrong = Pose(so3.exp(rng.normal(0.0, turn, 3)) @ pose.rotation, stand + rng.normal(0.0, shift, 3))
        clock = 100.0 * index
        given[name] = CameraCalibration(name, lens, wrong, TimeMap(1.0, -clock), 1e-3, np.zeros(3), 1.0)
        for number in range(frames):
            moment = number / fps + delay
            feet = np.column_stack([_places(paths, moment), np.zeros(people)])
            message = pb.Observation(
                schema_version=1, camera=name, boot_id="b", sequence=number, frame=number,
                device_time_ns=round((moment + clock) * NANOSECONDS),
            )  # fmt: skip
            inside, hidden = _detect(message, rng, lens, pose, feet, tall)
            seen[number] |= inside & ~hidden
            messages.append((moment, message))
    messages.sort(key=lambda one: one[0])
    number, person = np.nonzero(seen)
    place = paths[np.round(number / fps * STEPS_HZ).astype(np.int64), person]
    truth = GroundTruth(number / fps, person, place)
    calibration = Calibration(cameras=given, reference="cam0", scale="metric", units="m", solver="given", version="")
    return Hall(messages, calibration, truth, [number / fps for number in range(frames)])


def _places(paths: Floats, moment: float) -> Floats:
    """Places (n, 2) at a moment [s]. Rounded to a step, a camera's clock would seem to be up to 8 ms off."""
    step, share = divmod(moment * STEPS_HZ, 1.0)
    return np.asarray(paths[int(step)] * (1.0 - share) + paths[int(step) + 1] * share)


def _detect(
    message: pb.Observation, rng: np.random.Generator, lens: Intrinsics, pose: Pose, feet: Floats, tall: Floats
) -> tuple[Bools, Bools]:
    """Fill in a frame's detections; who (n,) is inside the picture, and who behind somebody."""
    below, above = pose.camera_from_world(feet), pose.camera_from_world(feet + tall[:, None] * UP)
    before = (below[:, 2] > 0.5) & (above[:, 2] > 0.5)
    foot, head = np.full((len(feet), 2), np.nan), np.full((len(feet), 2), np.nan)
    foot[before], head[before] = lens.project(below[before]), lens.project(above[before])
    with np.errstate(invalid="ignore"):
        inside = before & (head[:, 0] > 5.0) & (head[:, 0] < SIZE[0] - 5.0) & (head[:, 1] > 0) & (foot[:, 1] < SIZE[1])
        height = foot[:, 1] - head[:, 1]
        nearer = below[None, :, 2] < below[:, None, 2] - 0.05
        across = np.abs(foot[None, :, 0] - foot[:, None, 0]) < 0.2 * height[:, None]
        along = (foot[None, :, 1] > foot[:, None, 1]) & (head[None, :, 1] < (head[:, 1] + 0.45 * height)[:, None])
    hidden = (nearer & across & along & inside[None, :]).any(axis=1)
    for i in np.flatnonzero(inside).tolist():
        if rng.random() >= (HIDDEN_MISSED if hidden[i] else MISSED):
            top, bottom, side = NOISE * height[i] * rng.normal(size=3)
            _add(message, 0.5 * (head[i, 0] + foot[i, 0]) + side, head[i, 1] + top, foot[i, 1] + bottom)
    for _ in range(int(rng.poisson(FALSE_BOXES))):
        top = rng.uniform(50.0, SIZE[1] - 250.0)
        _add(message, rng.uniform(0.0, SIZE[0]), top, top + rng.uniform(60.0, 220.0))
    return inside, hidden


def _add(message: pb.Observation, u: float, top: float, bottom: float) -> None:
    message.detections.add(
        u=u, v=0.62 * top + 0.38 * bottom, head=[u, top], foot=[u, bottom], size=max(bottom - top, 2.0), kind="person",
        score=1.0,
    )  # fmt: skip


def live(hall: Hall) -> list[ScoredTrack]:
    """What the hub's tracking publishes when the frames arrive at once."""
    known = hall.calibration
    tracking = LiveTracking()
    tracking.calibrate(known.cameras, {}, reference=known.reference, scale=known.scale, units=known.units, up=UP)
    rows: dict[str, dict[int, list[float]]] = defaultdict(dict)
    for moment, message in hall.messages:
        tracking.handle(message)
        for one in tracking.tick(moment):
            if isinstance(one, pb.Track) and one.state != "lost":
                rows[one.label][one.reference_time_ns] = list(one.position)
    return published_positions(rows)


def main() -> int:
    """Simulate, follow and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=7)
    parser.add_argument("--people", type=int, default=20)
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--half", type=float, default=6.0, help="half the side of the square in which they walk [m]")
    parser.add_argument("--turn", type=float, default=0.0, help="std of a given rotation's error, per axis [deg]")
    parser.add_argument("--shift", type=float, default=0.0, help="std of a given position's error, per axis [m]")
    parser.add_argument("--lag", type=float, default=0.0, help="of the last camera's frames behind the first's [s]")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--through", choices=("follow", "live", "both"), default="both")
    options = parser.parse_args()
    hall = simulated(
        options.seed, options.cameras, options.people, options.fps, options.seconds, options.half,
        float(np.radians(options.turn)), options.shift, options.lag,
    )  # fmt: skip
    print("        " + " ".join(f"{name:>9}" for name in (*COLUMNS, "cpu")))
    area = (-options.half, options.half, -options.half, options.half)
    for way in ("follow", "live") if options.through == "both" else (options.through,):
        begun = time.process_time()
        if way == "live":
            tracks = live(hall)
        else:
            wanted = [round(moment * NANOSECONDS) for moment in hall.times]
            tracks = list(follow([message for _, message in hall.messages], hall.calibration, wanted, up=UP).tracks)
        cpu = (time.process_time() - begun) / options.seconds
        scores = score_tracks(hall.truth, tracks, hall.times, 1.0, area)
        print(
            f"{way:<8}" + " ".join(f"{float(scores[name] or 0.0):9.3f}" for name in COLUMNS) + f" {cpu:9.3f}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
