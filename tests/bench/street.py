"""A street of cameras, each overlapping some ten others: ``python -m tests.bench.street [--cameras 60] [--live]``.

Prints the pairs that are chosen and solved, the cameras that are placed, and CPU seconds on one core: of the pairs, of
all until the final adjustment is done, and of the whole calibration. With --live they
are streamed to a hub in rounds of its loop, on a clock that advances by the film's time, so that other work on the
machine changes nothing: an answer is used after the CPU that it took, and the hub keeps up where a second takes less
than one of CPU. A transport's CPU is not in it.
"""

from __future__ import annotations

import sys
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from deploy.offline.exchange.session_log import _observation_messages, camera_info
from hub.calibration.pipeline import calibrate
from hub.clocks.external_prior import ExternalClockPrior
from hub.live.agent import freeze_garbage_collector, status_message
from hub.live.live_hub import LiveHub, LiveSettings
from hub.live.solver import SolverAnswer, SolverJob
from hub.live.worker import WorkerSolver
from protocols.bus.transport.inbox import Inbox
from protocols.core.clocks import NANOSECONDS, CameraTime, TimeMap
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from protocols.topics import OBSERVATION
from protocols.validation.codec import encode
from tests.bench.load import resident_mb
from tests.bench.options import bench_parser
from tests.support.long_street import street

_ROUND_S = 0.05
"""Film's time of a round of the hub's loop: as long as one takes while it is busy."""


class _OwnCore(WorkerSolver):
    """Answers at once, which are used after the CPU time that they took: as if the solver had a core to itself."""

    _answer: SolverAnswer | None = None
    _due = 0.0

    def submit(self, job: SolverJob, now: float) -> None:
        """Solve the job."""
        super().submit(job, now)
        while (answer := super().poll(now)) is None:
            time.sleep(0.1)
        placed = answer.reason[:100] if answer.calibration is None else f"{len(answer.calibration.cameras)} placed"
        size = f"{len(job.rig.cameras)} cameras, {len(job.observations)} rows"
        print(f"{now:7.1f} s: {size}: CPU {answer.cpu_s:.1f} s, {placed}", flush=True)
        self._answer, self._due = answer, now + answer.cpu_s

    @property
    def busy(self) -> bool:
        """Whether an answer was not used yet."""
        return self._answer is not None

    def poll(self, now: float) -> SolverAnswer | None:
        """The answer, when it is due."""
        if now < self._due:
            return None
        answer, self._answer = self._answer, None
        return answer


def accuracy(found: Calibration, poses: Mapping[str, Pose], clocks: Mapping[str, TimeMap]) -> str:
    """Errors of lags, rotations and positions, relative to the first camera and baseline, rms, and over their stds."""
    first, second = list(found.cameras)[:2]
    world, base = poses[first], clocks[found.reference]
    scale = float(np.linalg.norm(poses[second].position - world.position))
    lags, rotations, positions = list[float](), list[float](), list[Floats]()
    for name, camera in found.cameras.items():
        relative = camera.pose.rotation @ world.rotation @ poses[name].rotation.T
        rotations.append(float(np.linalg.norm(so3.log(relative))))
        true = world.rotation @ (poses[name].position - world.position) / scale
        if name not in (first, second, found.reference):
            positions.append((camera.pose.position - true) / camera.position_std)
            at = camera.lag_time
            seen = float(
                base.reference_from_camera(CameraTime(float(camera.time_map.reference_from_camera(CameraTime(at)))))
            )
            lags.append(seen - float(clocks[name].reference_from_camera(CameraTime(at))))
    stds = [camera.lag_std for name, camera in found.cameras.items() if name not in (first, second, found.reference)]
    rms = [float(np.sqrt(np.mean(np.square(one)))) for one in (lags, np.array(lags) / stds, rotations, positions)]
    return (
        f"rms errors: lag {1e3 * rms[0]:.2f} ms ({rms[1]:.2f} stds), rotation {np.rad2deg(rms[2]):.3f}°, "
        f"position {rms[3]:.2f} stds"
    )


def live(
    rig: Rig,
    observations: Observations,
    arrivals: Mapping[str, ExternalClockPrior],
    without: str,
    score: Callable[[Calibration], str],
) -> None:
    """Print what a hub makes of a session that is streamed to it, through its queue and gate. score: of an answer."""
    frames = []
    for name, camera in rig.cameras.items():
        offset = arrivals[name].unix_minus_camera
        for message in _observation_messages(replace(rig, cameras={name: camera}), observations):
            at = message.device_time_ns / NANOSECONDS + offset
            frames.append((at, OBSERVATION.key_for("local", name), encode(message)))
    frames.sort()
    inbox, solver = Inbox(OBSERVATION), _OwnCore()
    hub = LiveHub(LiveSettings(track=without != "tracks"), solver=solver)
    if hub.tracking is not None:
        hub.tracking.markers.smooths = without != "smoothing"
    for name in rig.cameras:
        hub.handle(camera_info(rig, name))
    now = start = frames[0][0]
    begun_mb = resident_mb()
    sent, spent, per_second, round_s, taken = 0, 0.0, list[float](), list[float](), 0
    freeze_garbage_collector()
    while sent < len(frames):
        now += _ROUND_S
        end = bisect_left(frames, (now, "", b""), sent)
        inbox.push_all(
            deque((key, payload, round(at * NANOSECONDS), "", True) for at, key, payload in frames[sent:end])
        )
        sent, began = end, time.process_time()
        while received := inbox.drain():
            taken += len(received)
            for frame in received:
                hub.handle(frame.message, frame.arrival_ns / NANOSECONDS)
        messages = hub.tick(now - start)
        if (now - start) // 1.0 > len(per_second):
            size = len(encode(status_message(hub, "hub", "boot", taken, [inbox.counters], now - start)))
            spent += time.process_time() - began
            per_second.append(spent)
            if len(per_second) % 10 == 0:
                print(
                    f"{now - start:7.1f} s: {taken} frames, {inbox.counters['dropped']} dropped; {spent:.2f} s of CPU "
                    f"in the last second, longest round {1e3 * max(round_s):.0f} ms; {resident_mb() - begun_mb:.0f} "
                    f"MB more than at the beginning; status {size} bytes, {hub.state(now - start)[1][:60]}", flush=True,
                )  # fmt: skip
                round_s = []
            spent, began = 0.0, time.process_time()
        for one in messages:
            encode(one)
            if isinstance(one, pb.Calibration) and one.status == "solved" and hub.calibration is not None:
                found = f"{len(one.cameras)} cameras, {len(one.refused)} not"
                print(f"{now - start:7.1f} s: {found}; {score(hub.calibration)}", flush=True)
        round_s.append(time.process_time() - began)
        spent += round_s[-1]
    solver_mb = 0.0 if solver._pid is None else resident_mb(solver._pid.result())
    print(f"CPU {1e6 * sum(per_second) / taken:.1f} µs a frame, solver {solver_mb:.0f} MB; {dict(hub.counters)}")
    solver.close()


def main() -> int:
    """Simulate, calibrate and print."""
    parser = bench_parser(__doc__, cameras=60, seconds=30.0, seed=3, fps=30.0, live=False)
    parser.add_argument("--without", choices=("tracks", "smoothing"), help="of what a hub makes live")
    options = parser.parse_args()
    rig, observations, arrivals, poses, clocks = street(options.seed, options.cameras, options.seconds, options.fps)
    if options.live:
        live(rig, observations, arrivals, options.without, lambda found: accuracy(found, poses, clocks))
        return 0
    began, marks = time.process_time(), {}

    def report(text: str, share: float) -> None:
        marks[text.split()[0]] = time.process_time() - began

    found = calibrate(rig, observations, report, arrivals=arrivals)
    print(
        f"{options.cameras} cameras, {options.seconds:g} s: {len(found.pairs)} pairs; "
        f"{len(found.cameras)} placed, {len(found.refused)} refused; CPU {marks['placing']:.1f} s until placed, "
        f"{marks['covariances']:.1f} s adjusted, {time.process_time() - began:.1f} s in all\n"
        f"{accuracy(found, poses, clocks)}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
