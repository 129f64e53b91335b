"""How time and memory grow with the work: one small figure for tests/bench/README.md.

    python -m tests.bench.growth [--quick] [--out docs/pictures/growth.png]

CPU of the adjustment against observations and cameras, of the whole calibration against cameras, of pair timing against
the length of the tracks and against the number of pairs, of the live hub an observation against cameras, of the UAV
tracker against particles, of the marker detector against pixels; memory of the adjustment (peak of numpy's and Python's
own allocations) and of the live hub.
Beside each curve the power of the last half of it (1 = linear).
"""

from __future__ import annotations

import argparse
import gc
import os
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from tests.bench.real_rigs import REPOSITORY  # noqa: E402


@dataclass(slots=True)
class Curve:
    """x: size of the work; y: what it cost."""

    title: str
    x_name: str
    y_name: str
    x: list[float] = field(default_factory=list)
    y: list[float] = field(default_factory=list)

    def add(self, x: float, y: float) -> None:
        """One point; printed at once."""
        self.x.append(x)
        self.y.append(y)
        print(f"{self.title}: {x:g} {self.x_name} → {y:.4g} {self.y_name}", flush=True)

    @property
    def power(self) -> float:
        """Slope of the upper half in a log-log plot."""
        half = len(self.x) // 2
        return float(np.polyfit(np.log(self.x[half:]), np.log(self.y[half:]), 1)[0])


def _cpu(work: Callable[[], object], times: int = 2) -> float:
    best = float("inf")
    for _ in range(times):
        began = time.process_time()
        work()
        best = min(best, time.process_time() - began)
    return best


def _peak_mb(work: Callable[[], object]) -> float:
    gc.collect()
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def adjustment(quick: bool) -> list[Curve]:
    """The joint adjustment: rows at six cameras, and cameras at the same length."""
    from tests.bench.speed.joint import make, ours

    rows = Curve("adjustment", "observations", "s of CPU")
    memory = Curve("adjustment, memory", "observations", "MB")
    for seconds in (15, 30, 60, 120) if quick else (30, 60, 120, 240, 480):
        task = make(7, seconds, 6)
        rows.add(task.rows, _cpu(lambda task=task: ours(task)))  # type: ignore[misc]
        memory.add(task.rows, _peak_mb(lambda task=task: ours(task)))  # type: ignore[misc]
    cameras = Curve("adjustment of 20 s", "cameras", "s of CPU")
    for count in (4, 8, 16) if quick else (4, 8, 16, 32, 64):
        task = make(8, 20.0, count)
        cameras.add(count, _cpu(lambda task=task: ours(task)))  # type: ignore[misc]
    return [rows, memory, cameras]


def rig(quick: bool) -> list[Curve]:
    """The whole of `calibrate` against cameras, over the rows; required: no faster than cameras^1.3."""
    from hub.calibration.pipeline import calibrate
    from tests.support import rigs

    curve = Curve("calibrate, 30 s", "cameras", "ms of CPU a row")
    for count in (4, 8, 16) if quick else (4, 8, 16, 32):
        session = rigs.simulate(9, count, 30.0, fps=(30.0,), late=2.0)
        seen = session.observations()
        spent = _cpu(lambda one=session, seen=seen: calibrate(one.rig, seen, thorough=True), 1)  # type: ignore[misc]
        curve.add(count, 1e3 * spent / len(session.time))
    return [curve]


def pairs(quick: bool) -> list[Curve]:
    """Timing: seconds of two tracks (lags within them all), and all pairs of a number of cameras."""
    from hub.bundle.preprocessing import prepare
    from hub.calibration.pairs.pair_network import solve_pairs
    from tests.bench import pair_timing
    from tests.bench.pair_trials import Regime, make_trial
    from tests.support import rigs

    length = Curve("pair timing", "s of track", "s of CPU")
    for span in (10, 20, 40, 80) if quick else (10, 20, 40, 80, 160, 320):
        trials = [make_trial(Regime(span=float(span)), seed) for seed in range(30_000, 30_003)]
        length.add(span, _cpu(lambda trials=trials: [pair_timing.run(t, True) for t in trials], 1) / len(trials))  # type: ignore[misc]
    count = Curve("timing of all pairs, 20 s", "pairs", "s of CPU")
    for cameras in (3, 5, 8) if quick else (3, 5, 8, 12, 17):
        session = rigs.simulate(9, cameras, 20.0, fps=(30.0,), late=2.0)
        prepared = prepare(session.rig, session.observations())
        count.add(cameras * (cameras - 1) / 2, _cpu(lambda p=prepared: solve_pairs(p, lambda text, share: None), 1))  # type: ignore[misc]
    return [length, count]


def hub(quick: bool) -> list[Curve]:
    """The live hub's estimator without a bus: CPU an observation and memory against cameras at 5 a second for 20 s."""
    from hub.live.live_hub import LiveHub, LiveSettings
    from protocols.messages import syncline_pb2 as pb

    cost = Curve("live hub", "cameras", "µs of CPU an observation")
    memory = Curve("live hub, memory, windows of 10 s", "cameras", "MB")
    for cameras in (10, 100, 500) if quick else (10, 30, 100, 300, 1000):
        spent = [0.0]

        def run(cameras: int = cameras, spent: list[float] = spent) -> LiveHub:
            estimator = LiveHub(LiveSettings(window_s=10.0, interval_s=1e9))
            began = time.process_time()
            for frame in range(100):
                for number in range(cameras):
                    message = pb.Observation(
                        schema_version=1, camera=f"cam{number:04d}", boot_id=f"boot{number:04d}", sequence=frame,
                        frame=frame, device_time_ns=frame * 200_000_000 + number,
                        detections=[pb.Detection(u=float(frame), v=2.0, size=12.0)],
                    )  # fmt: skip
                    estimator.handle(message, frame * 0.2)
            spent[0] = time.process_time() - began
            return estimator

        kept = run()
        cost.add(cameras, 1e6 * spent[0] / (100 * cameras))
        del kept
        memory.add(cameras, _peak_mb(run))
    return [cost, memory]


def particles(quick: bool) -> list[Curve]:
    """The image-plane tracker (`--model plain`), which has a fixed number of particles."""
    from edge.uav import tracker_factory
    from edge.uav.baselines import plain_tracker
    from edge.uav.world import scenarios

    world = scenarios.get("exit-bend", 16, frames=30)
    images = [world.frame(i) for i in range(20)]
    curve = Curve("UAV tracker (plain)", "particles", "ms of CPU a frame")
    for count in (100, 800, 6400) if quick else (100, 400, 1600, 6400, 25600):

        def run() -> None:
            tracker = tracker_factory.make_tracker("plain", world.size, fps=world.fps, seed=1)
            tracker.begin(images[0], world.time(0), world.truth(0).box)
            for i in range(1, len(images)):
                tracker.handle_frame(images[i], world.time(i))

        with mock.patch.object(plain_tracker, "_PARTICLES", count):
            curve.add(count, 1e3 * _cpu(run) / (len(images) - 1))
    return [curve]


def pixels(quick: bool) -> list[Curve]:
    """The marker detector against the image size."""
    from edge import scenes
    from edge.detectors.marker.ball import MarkerDetector

    renderer = scenes.renderer_for(scenes.get_marker_scene("marker", 0), "cam0", np.random.default_rng(0))
    drawn = [renderer.render(moment) for moment in np.linspace(1.0, 30.0, 10)]
    curve = Curve("marker detector", "megapixels", "ms of CPU a frame")
    sizes = ((320, 240), (640, 480), (1280, 960), (2560, 1920))
    for size in sizes if quick else (*sizes, (3840, 2880)):
        images = [np.asarray(cv2.resize(one, size), dtype=np.uint8) for one in drawn]
        detector = MarkerDetector()
        spent = _cpu(lambda d=detector, images=images: [d.detect(image) for image in images])  # type: ignore[misc]
        curve.add(size[0] * size[1] / 1e6, 1e3 * spent / len(images))
    return [curve]


def draw(curves: list[Curve], file: Path) -> None:
    """All of them in log-log, a dashed line where linear growth from the first point would go."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    columns = 3
    rows = -(-len(curves) // columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(10.5, 2.6 * rows), dpi=80)
    for axis, curve in zip(axes.flat, curves, strict=False):
        axis.loglog(curve.x, curve.y, "o-", color="#1f6f8b", markersize=4)
        ends = np.array([curve.x[0], curve.x[-1]])
        axis.loglog(ends, curve.y[-1] * ends / ends[-1], "--", color="0.7", linewidth=1)
        axis.set_title(f"{curve.title}: power {curve.power:.2f}", fontsize=9)
        axis.set_xlabel(curve.x_name, fontsize=8)
        axis.set_ylabel(curve.y_name, fontsize=8)
        axis.tick_params(labelsize=7, which="both")
        axis.set_xticks(curve.x, labels=[f"{x:.3g}" if x < 1000 else f"{x / 1000:.3g}k" for x in curve.x])
        axis.xaxis.set_minor_formatter(ticker.NullFormatter())
    for axis in axes.flat[len(curves) :]:
        axis.axis("off")
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default="", help="parts of functions' names, by comma")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "pictures" / "growth.png")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    wanted = [name for name in options.only.split(",") if name]
    curves: list[Curve] = []
    for part in (adjustment, rig, pairs, hub, particles, pixels):
        if not wanted or part.__name__ in wanted:
            curves += part(options.quick)
    for curve in curves:
        print(f"{curve.title}: power {curve.power:.2f} in {curve.x_name} ({curve.y_name})")
    draw(curves, options.out)
    print(f"drawn: {options.out}")


if __name__ == "__main__":
    main()
