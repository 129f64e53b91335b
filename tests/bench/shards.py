"""Hubs that share a street: their one answer against one joint optimum, and what the death of a hub costs.

    python -m tests.bench.shards [--cameras 500] [--hubs 4] [--seconds 40] [--fps 15] [--seed 5]
    python -m tests.bench.shards --live [--cameras 48] [--hubs 4] [--seconds 60]

The first splits the cameras by overlap, calibrates each group with the cameras across its border in a process of its
own, joins the answers, and calibrates all cameras at once. Errors: of camera positions after a similarity to the true
ones. With --live, hubs are agents (processes) over a Zenoh router, and the street is played in real time; then a hub is
killed, and then the one that leads.
"""

from __future__ import annotations

import multiprocessing
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.offline.exchange.session_log import _observation_messages, camera_info
from hub.calibration.pipeline import calibrate
from hub.clocks.external_prior import ExternalClockPrior
from hub.distributed.merge import merge_calibrations
from hub.distributed.sharding import OverlapMeter, border, split
from hub.sync.overlap import BIN_S
from protocols.bus.base import Bus
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.pose import Pose, fit_similarity
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, PART, SHARD, SOLVER_EVENT, TRACK
from tests.bench.options import bench_parser
from tests.support.long_street import street

Arrivals = Mapping[str, ExternalClockPrior]


def errors(found: Mapping[str, Pose], true: Mapping[str, Pose], names: Iterable[str]) -> Floats:
    """Position errors (n,) [m] after the best similarity."""
    one, other = (np.array([poses[name].position for name in names]) for poses in (found, true))
    return np.asarray(np.linalg.norm(fit_similarity(one, other).points(one) - other, axis=1))


def rms(values: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def only(rig: Rig, observations: Observations, names: Iterable[str]) -> tuple[Rig, Observations]:
    """A session of some of its cameras."""
    kept = set(names)
    tracks = {key: track for key, track in observations.tracks.items() if key[0] in kept}
    cameras = {name: camera for name, camera in rig.cameras.items() if name in kept}
    return replace(rig, cameras=cameras), replace(observations, tracks=tracks)


def _quietly(rig: Rig, observations: Observations, arrivals: Arrivals) -> tuple[Calibration, float]:
    began = time.process_time()
    found = calibrate(rig, observations, lambda text, share: None, arrivals=arrivals)
    return replace(found, trajectories=(), residuals={}), time.process_time() - began


def overlaps(observations: Observations, arrivals: Arrivals) -> OverlapMeter:
    """What a hub has measured after a film."""
    seen = {
        (int((time + arrivals[camera].unix_minus_camera) // BIN_S), camera, label)
        for (camera, label), track in observations.tracks.items()
        for time in track.time.tolist()
    }
    meter = OverlapMeter()
    for number, camera, label in sorted(seen):
        meter.observe(camera, [label], number * BIN_S)
    return meter


def offline(cameras: int, hubs: int, seconds: float, fps: float, seed: int) -> None:
    """One row of the table."""
    rig, observations, arrivals, true, _ = street(seed, cameras, seconds, fps)
    pairs = overlaps(observations, arrivals).pairs()
    groups = split(pairs, rig.cameras, [f"hub{number}" for number in range(hubs)], {})
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
        sessions = {h: only(rig, observations, {*group, *border(pairs, group)}) for h, group in groups.items()}
        jobs = {hub: pool.submit(_quietly, *session, arrivals) for hub, session in sessions.items()}
        answers = {hub: job.result() for hub, job in jobs.items()}
        joint, joint_s = pool.submit(_quietly, rig, observations, arrivals).result()
    began = time.process_time()
    merged = merge_calibrations({hub: part for hub, (part, _) in answers.items()}, groups, rig)
    merge_s = time.process_time() - began
    both = [name for name in merged.cameras if name in joint.cameras]
    one, other = (errors({n: c.pose for n, c in f.cameras.items()}, true, both) for f in (merged, joint))
    first, at = both[0], {name: joint.cameras[name].lag_time for name in both}
    lag = [_on_clock_of(merged, name, first, at[name]) - _on_clock_of(joint, name, first, at[name]) for name in both]
    print(
        f"| {cameras} | {hubs} | {seed} | {len(merged.cameras)} / {len(joint.cameras)} | {1e3 * rms(one):.2f} | "
        f"{1e3 * rms(other):.2f} | {rms(one) / rms(other):.3f} | {1e3 * rms(np.array(lag)):.3f} | "
        f"{max(spent for _, spent in answers.values()):.0f} | {joint_s:.0f} | {merge_s:.2f} |", flush=True,
    )  # fmt: skip


def _on_clock_of(found: Calibration, name: str, first: str, at: float) -> float:
    """A camera's time ``at`` [s] on the first camera's clock."""
    own, base = found.cameras[name].time_map, found.cameras[first].time_map
    return (own.clock_rate * at + own.time_offset - base.time_offset) / base.clock_rate


class Site:
    """A street's cameras on the bus, in real time, and what its hubs publish. hubs: processes by name."""

    def __init__(self, stack: ExitStack, folder: Path, names: list[str], film: tuple[Rig, Observations, Arrivals]):
        self.endpoint = free_endpoint()
        stack.enter_context(Router(self.endpoint))
        self._stack, self._folder = stack, folder
        self._config = BusConfig(mode="client", connect=(self.endpoint,))
        self.bus: Bus = stack.enter_context(open_bus("local", self._config))
        self.rig, self._film, self._arrivals = film
        topics = (SHARD, PART, CALIBRATION, SOLVER_EVENT, TRACK)
        self._subscriptions = [self.bus.subscribe(topic) for topic in topics]
        self.shards: dict[str, pb.Shard] = {}
        self.parts: dict[str, pb.Calibration] = {}
        self.site: pb.Calibration | None = None
        self.publisher = ""
        self.jobs: dict[str, set[str]] = {}
        self._submitted: dict[str, float] = {}
        self.began = self.film_s = 0.0
        """When the film began, and how much of it the answers are made of [s]."""
        self.solved: dict[str, set[str]] = {}
        self.tracks: dict[str, list[pb.Track]] = {}
        self.hubs = {name: self.start(name) for name in names}
        self._ended = threading.Event()
        stack.callback(self._ended.set)

    def start(self, name: str) -> subprocess.Popen[bytes]:
        """A hub's agent."""
        file = self._folder / f"{name}.toml"
        file.write_text(
            f'id = "{name}"\nsharded = true\ninterval_s = 1.0\nstate = "{(self._folder / name).as_posix()}"\n'
            f'[bus]\nmode = "client"\nconnect = ["{self.endpoint}"]\n',
            encoding="utf-8",
        )
        process = subprocess.Popen([sys.executable, "-m", "deploy", "hub", str(file)], stdout=subprocess.DEVNULL)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def play(self) -> None:
        """Begin to publish the film, each frame when it was taken."""
        frames = []
        for name, camera in self.rig.cameras.items():
            offset = self._arrivals[name].unix_minus_camera
            for message in _observation_messages(replace(self.rig, cameras={name: camera}), self._film):
                frames.append((message.device_time_ns / NANOSECONDS + offset, message))
        frames.sort(key=lambda frame: frame[0])
        publishers = {name: self.bus.publisher(OBSERVATION, name) for name in self.rig.cameras}
        for name in self.rig.cameras:
            self._stack.enter_context(self.bus.announce("camera", name, "import"))
            self.bus.publisher(CAMERA_INFO, name).put(camera_info(self.rig, name))

        self.began = time.monotonic()

        def run() -> None:
            began = self.began - frames[0][0]
            for at, message in frames:
                while (ahead := began + at - time.monotonic()) > 0.0:
                    if self._ended.wait(ahead):
                        return
                publishers[message.camera].put(message)

        threading.Thread(target=run, daemon=True).start()

    def read(self) -> None:
        """Take what the hubs have published."""
        for subscription in self._subscriptions:
            for received in subscription.drain():
                message = received.message
                if isinstance(message, pb.Shard):
                    self.shards[received.agent] = message
                elif isinstance(message, pb.Track):
                    self.tracks.setdefault(received.agent, []).append(message)
                elif isinstance(message, pb.SolverEvent):
                    if message.kind == "submitted":
                        self.jobs[received.agent] = {rows.camera for rows in message.rows}
                        self._submitted[received.agent] = time.monotonic() - self.began
                    elif message.kind == "applied":
                        self.film_s = max(self.film_s, self._submitted.get(received.agent, 0.0))
                        self.solved[received.agent] = self.jobs.get(received.agent, set())
                elif isinstance(message, pb.Calibration) and received.topic is PART:
                    self.parts[received.agent] = message
                elif isinstance(message, pb.Calibration) and message.status == "solved":
                    self.site, self.publisher = message, received.agent

    def groups(self) -> dict[str, list[str]]:
        """The newest groups, empty while living hubs follow different ones."""
        living = [self.shards[name] for name, hub in self.hubs.items() if hub.poll() is None and name in self.shards]
        found = [{group.hub: list(group.cameras) for group in one.groups} for one in living]
        return found[0] if found and all(one == found[0] for one in found) else {}

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> float:
        """Seconds until the condition holds; infinite where it does not."""
        began = time.monotonic()
        while time.monotonic() - began < timeout_s:
            self.read()
            if condition():
                return time.monotonic() - began
            time.sleep(0.02)
        return float("inf")

    def kill(self, name: str) -> None:
        """End a hub's process at once."""
        self.hubs[name].send_signal(signal.SIGKILL)
        self.hubs[name].wait()
        self.shards.pop(name, None)
        self.solved.clear()
        self.jobs.clear()

    def is_split(self, hubs: set[str]) -> bool:
        """Whether all cameras are in the groups of exactly these hubs."""
        groups = self.groups()
        return set(groups) == hubs and sum(map(len, groups.values())) == len(self.rig.cameras)

    def is_answered(self) -> bool:
        """Whether each camera is in the part of the hub that has it."""
        return all(
            hub in self.parts and set(cameras) <= {one.camera for one in self.parts[hub].cameras}
            for hub, cameras in self.groups().items()
        )

    def is_solved(self) -> bool:
        """Whether each camera was solved by the hub that has it, from rows that it has heard itself."""
        return all(set(cameras) <= self.solved.get(hub, set()) for hub, cameras in self.groups().items())

    def poses(self) -> dict[str, Pose]:
        """Of the site's last calibration."""
        cameras = () if self.site is None else self.site.cameras
        return {c.camera: Pose.from_rodrigues(np.array(c.rotation), np.array(c.translation)) for c in cameras}


def live(cameras: int, hubs: int, seconds: float, fps: float, seed: int) -> None:
    """Print what hubs over a router make of a street, and of the death of two of them."""
    rig, observations, arrivals, true, _ = street(seed, cameras, seconds + 300.0, fps, reach=4.0, stretch=4.0)
    names = [f"hub{number}" for number in range(hubs)]
    with ExitStack() as stack:
        site = Site(
            stack, Path(stack.enter_context(tempfile.TemporaryDirectory())), names, (rig, observations, arrivals)
        )
        assert site.wait(lambda: len(site.shards) == hubs, 60.0) < 60.0
        site.play()
        split_s = site.wait(lambda: site.is_split(set(names)), 60.0)
        print(f"split after {split_s:.1f} s: {[len(group) for group in site.groups().values()]}", flush=True)
        first = split_s + site.wait(lambda: len(site.poses()) == cameras, 120.0)
        site.wait(lambda: False, site.began + seconds - time.monotonic())
        found, film_s = site.poses(), site.film_s
        print(f"all {len(found)} cameras in one answer after {first:.1f} s of film", flush=True)
        for victim in (names[-1], names[0])[: hubs - 1]:
            left = {name for name, hub in site.hubs.items() if hub.poll() is None} - {victim}
            site.kill(victim)
            steps = [site.wait(lambda left=left: site.is_split(left), 60.0)]  # type: ignore[misc]
            steps.append(steps[-1] + site.wait(site.is_answered, 60.0))
            steps.append(steps[-1] + site.wait(site.is_solved, 90.0))
            sizes, off = [len(group) for group in site.groups().values()], errors(site.poses(), true, found)
            print(
                f"{victim} killed: split {steps[0]:.2f} s, answered {steps[1]:.2f} s, solved from its own rows "
                f"{steps[2]:.1f} s; {sizes}, {site.publisher} publishes {len(site.poses())}: {1e3 * rms(off):.2f} mm",
                flush=True,
            )
    # What the hubs have had: from the split on, before which nobody keeps rows, until the last job that was applied.
    begin = {name: track.time.min() for (name, _), track in observations.tracks.items()}
    kept = {
        key: track.select((track.time >= begin[key[0]] + split_s) & (track.time < begin[key[0]] + film_s))
        for key, track in observations.tracks.items()
    }
    heard = replace(observations, tracks={key: track for key, track in kept.items() if len(track.time)})
    joint, _ = _quietly(rig, heard, arrivals)
    both = [name for name in found if name in joint.cameras]
    one, other = errors(found, true, both), errors({n: c.pose for n, c in joint.cameras.items()}, true, both)
    print(
        f"{len(found)} / {len(joint.cameras)} cameras, film from {split_s:.0f} to {film_s:.0f} s: hubs "
        f"{1e3 * rms(one):.2f} mm, joint {1e3 * rms(other):.2f} mm, ratio {rms(one) / rms(other):.3f}"
    )


def main() -> None:
    """Choose."""
    words = bench_parser(__doc__, cameras=int, hubs=4, seconds=float, fps=15.0, seed=5, live=False).parse_args()
    if words.live:
        live(words.cameras or 48, words.hubs, words.seconds or 60.0, words.fps, words.seed)
        return
    print("cameras | hubs | seed | placed / joint | hubs mm | joint mm | ratio | lags ms | s a hub | joint s | join s")
    offline(words.cameras or 500, words.hubs, words.seconds or 40.0, words.fps, words.seed)


if __name__ == "__main__":
    main()
