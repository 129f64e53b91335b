"""The live hub's clocks: against the offline answer on the same rows, while a clock drifts, and when one steps.

    python -m tests.bench.live_clocks [--sessions 8] [--start 0] [--only window,drift,step]

Three cameras, 0.5 px, clocks of any epoch; messages arrive in the order in which they were made. window: error of the
live hub's last clocks over 20 s, over that of `calibrate` on the rows of those 20 s as they were made (asked: 1.2).
drift: one clock runs 200 ppm faster from the 30th second on; the largest error of the published map at that camera's
present time (asked: 1 ms), when it is published, and whenever a frame comes while it is the newest. step: one clock
jumps by 0.3 to 30 s (asked: told within 5 s, both sides kept apart).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from hub.calibrate import calibrate  # noqa: E402
from hub.live import LiveHub, LiveSettings  # noqa: E402
from protocols.clocks import NANOSECONDS  # noqa: E402
from protocols.errors import Refused  # noqa: E402
from protocols.messages import syncline_pb2 as pb  # noqa: E402
from tests import rigs  # noqa: E402

CHANGED = "cam1"
CHANGES_AT_S = 30.0
WINDOW_S = 20.0
_DELAY_S, _SCATTER_S = 2e-3, 3e-4


@dataclass(frozen=True, slots=True)
class Change:
    """What happens to the clock of CHANGED after CHANGES_AT_S: a jump [s], another rate (less 1)."""

    step_s: float = 0.0
    rate: float = 0.0

    def shown(self, own: float, true: float) -> float:
        """What the clock shows where it would have shown ``own``."""
        after = true - CHANGES_AT_S
        return own if after <= 0.0 else own + self.step_s + self.rate * after


def stream(session: rigs.Session, change: Change, seed: int) -> Iterator[tuple[float, pb.Observation | pb.CameraInfo]]:
    """(true time, message) in the order of arrival; arrivals are _DELAY_S after it, with a scatter."""
    for name, camera in session.rig.cameras.items():
        lens = camera.intrinsics
        assert lens is not None
        yield (
            0.0,
            pb.CameraInfo(
                schema_version=1,
                camera=name,
                boot_id=f"boot-{name}",
                width=lens.width,
                height=lens.height,
                fps=camera.fps,
                matrix=lens.matrix.ravel(),
                distortions=lens.distortions,
            ),
        )
    true = np.array([session.true_time(c, float(t)) for c, t in zip(session.camera, session.time, strict=True)])
    scatter = np.random.default_rng([seed, 3]).exponential(_SCATTER_S, len(true))
    counts: dict[str, int] = {}
    for i in np.argsort(true):
        name = session.camera[i]
        counts[name] = counts.get(name, -1) + 1
        own = float(session.time[i])
        own = change.shown(own, float(true[i])) if name == CHANGED else own
        message = pb.Observation(
            schema_version=1,
            camera=name,
            boot_id=f"boot-{name}",
            sequence=counts[name],
            frame=int(session.frame[i]),
            device_time_ns=round(own * NANOSECONDS),
            detections=[pb.Detection(u=session.pixels[i, 0], v=session.pixels[i, 1], score=1.0, label="marker")],
        )
        yield float(true[i]) + float(scatter[i]), message


def window(seeds: range) -> None:
    """Live against offline, on the same rows."""
    live: list[float] = []
    offline: list[float] = []
    refused = 0
    for seed in seeds:
        session = rigs.simulate(seed, 3, 40.0, late=2.0)
        hub = LiveHub(LiveSettings(window_s=WINDOW_S, interval_s=8.0))
        for true, message in stream(session, Change(), seed):
            hub.handle(message, true + _DELAY_S)
            hub.tick(true)
        hub.tick(1e3, final=True)
        keep = np.zeros(len(session.time), dtype=np.bool_)
        for name in session.rig.cameras:
            mine = np.array([camera == name for camera in session.camera])
            keep |= mine & (session.time >= session.time[mine].max() - WINDOW_S)
        at = np.flatnonzero(keep)
        late = replace(
            session,
            camera=[session.camera[i] for i in at],
            label=[session.label[i] for i in at],
            frame=session.frame[at],
            time=session.time[at],
            pixels=session.pixels[at],
        )
        try:
            found = calibrate(session.rig, late.observations())
        except Refused:
            found = None
        if found is None or hub.calibration is None or hub.refusal is not None:
            refused += 1
            continue
        for told, answer in ((live, hub.calibration), (offline, found)):
            told += [
                late.clock_error(name, answer.reference, camera.time_map)
                for name, camera in answer.cameras.items()
                if name != answer.reference
            ]
    rms = [1e3 * float(np.sqrt(np.mean(np.square(errors)))) for errors in (live, offline)]
    print(
        f"window of {WINDOW_S:.0f} s, {len(seeds)} sessions: clocks live {rms[0]:.3f} ms, offline {rms[1]:.3f} ms "
        f"(rms), ratio {rms[0] / rms[1]:.3f} (asked 1.2); {refused} refused by either",
        flush=True,
    )


@dataclass(frozen=True, slots=True)
class Followed:
    """How a change went: seconds after it until it was told and until the map was right again (None = never).

    errors: (seconds after the change, error [ms] at the camera's present time) of each published map; aged: the same at
    every frame of the camera, of the newest map. counts: of the watch's alarms.
    """

    told_s: float | None
    right_s: float | None
    errors: list[tuple[float, float]]
    aged: list[tuple[float, float]]
    steps: int
    drifts: int


def follow(seed: int, change: Change, seconds: float, right_ms: float) -> Followed:
    """One session in which a clock changes; the map of every calibration is judged at once."""
    session = rigs.simulate(seed, 3, seconds, late=2.0, fps=(30.0,))
    hub = LiveHub(LiveSettings(window_s=30.0, interval_s=4.0))
    told = right = None
    errors: list[tuple[float, float]] = []
    aged: list[tuple[float, float]] = []
    newest: tuple[pb.CameraCalibration, str] | None = None

    def off_ms(true: float) -> float:
        assert newest is not None
        camera, reference = newest
        shown = change.shown(session.shown(CHANGED, true), true)
        return 1e3 * abs(float(camera.clock_rate) * shown + float(camera.time_offset) - session.shown(reference, true))

    for true, message in stream(session, change, seed):
        hub.handle(message, true + _DELAY_S)
        after = true - CHANGES_AT_S
        if told is None and hub.counters["clock_steps"] + hub.counters["clock_drifts"]:
            told = after
        for out in hub.tick(true):
            if not isinstance(out, pb.Calibration) or out.status != "solved":
                continue
            camera = next((c for c in out.cameras if c.camera == CHANGED), None)
            if camera is None or out.reference_camera == CHANGED:
                continue
            newest = camera, out.reference_camera
            errors.append((after, off_ms(true)))
            if right is None and after > 0.0 and errors[-1][1] < right_ms:
                right = after
        if newest is not None and message.camera == CHANGED:
            aged.append((after, off_ms(true)))
    return Followed(told, right, errors, aged, hub.counters["clock_steps"], hub.counters["clock_drifts"])


def drift(seeds: range) -> None:
    """A change of rate of 200 ppm, either way."""
    for seed in seeds:
        found = follow(seed, Change(rate=2e-4 if seed % 2 else -2e-4), 75.0, 1.0)
        before = max((e for at, e in found.errors if at <= 0.0), default=float("nan"))
        worst = max((e for at, e in found.errors if at > 0.0), default=float("nan"))
        settled = max((e for at, e in found.errors if at > 20.0), default=float("nan"))
        between = max((e for at, e in found.aged if at > 0.0), default=float("nan"))
        told = "never told" if found.told_s is None else f"told after {found.told_s:.1f} s"
        print(
            f"drift of 200 ppm, session {seed}: {told}, {found.drifts} alarms of drift, {found.steps} of steps; map "
            f"{before:.2f} ms off before, {worst:.2f} ms at worst after, {settled:.2f} ms from 20 s on (asked 1 ms); "
            f"{between:.2f} ms at worst between two maps",
            flush=True,
        )


def step(seeds: range) -> None:
    """A jump either way."""
    for seed in seeds:
        size = float(np.random.default_rng([seed, 21]).choice([-30.0, -1.0, -0.3, 0.3, 1.0, 30.0]))
        found = follow(seed, Change(step_s=size), 40.0, 5.0)
        told = "never told" if found.told_s is None else f"told after {found.told_s:.2f} s"
        right = "never" if found.right_s is None else f"after {found.right_s:.2f} s"
        worst = max((e for at, e in found.errors if at > (found.told_s or 0.0)), default=float("nan"))
        print(
            f"step of {size:+.1f} s, session {seed}: {told} (asked 5 s), {found.steps} alarms of steps, {found.drifts} "
            f"of drift; map right {right}, at worst {worst:.2f} ms off from then on",
            flush=True,
        )


def main() -> None:
    """Print the rows that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=8)
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--only", default="window,drift,step")
    options = parser.parse_args()
    seeds = range(options.start, options.start + options.sessions)
    for name, run in (("window", window), ("drift", drift), ("step", step)):
        if name in options.only.split(","):
            run(seeds)


if __name__ == "__main__":
    main()
