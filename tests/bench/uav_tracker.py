"""UAV tracking of a car that leaves the image, in comparison with other trackers.

    python -m tests.bench.uav_tracker [--seeds 10] [--models ground,plain,paper,csrt,kcf] [--scenarios exit-bend,yaw]
        [--no-telemetry] [--rate HZ] [--offset] [--jobs 2] [--json FILE]

Simulated flights with ground truth (edge/uav/world); telemetry with 0.2° noise, 0.4° bias, one frame late. Scores as
in ``uav_scoring``. CSRT and KCF need opencv-contrib: ``uav_rivals`` says how to get it; without it they are left out,
and the bench says so.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2

from edge.uav.base import Estimate, Telemetry, Tracker
from edge.uav.world import scenarios
from edge.uav.world.flight_world import FlightWorld
from tests.bench import uav_rivals
from tests.bench.uav_scoring import PAIRS, Score, score

MODELS = ("ground", "plain", "paper", *uav_rivals.NAMES)
_HD = (1280, 720)


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of flight. group: the row of the table in which it is counted."""

    group: str
    scenario: str
    frames: int | None = None
    telemetry: bool = True
    size: tuple[int, int] = (640, 480)

    @property
    def title(self) -> str:
        """As it is printed."""
        extra = "" if self.telemetry else " blind"
        return f"{self.scenario}{'' if self.frames is None else f' {self.frames}'}{extra}{' 720p' * (self.size == _HD)}"


CASES = (
    *(Case("short", f"exit-{kind}", frames) for kind in ("straight", "bend") for frames in (15, 30, 45)),
    Case("short", "yaw", 45),
    Case("bend", "exit-bend", 60),
    Case("bend", "exit-bend", 90),
    Case("long", "exit-straight", 150),
    Case("long", "exit-bend", 150),
    Case("same colour 60", "distractors", 60),
    Case("same colour 120", "distractors", 120),
    Case("turn", "turn-out-of-view", 75),
    *(Case("hidden", name) for name in ("trees", "bridge")),
    *(Case("hard to see", name) for name in ("lighting", "off-road", "partial")),
    *(Case("size", name) for name in ("cut", "climb", "far")),
    Case("size blind", "climb", telemetry=False),
    Case("size blind", "far", telemetry=False),
    Case("no telemetry", "exit-straight", 60, telemetry=False),
    Case("no telemetry", "exit-bend", 60, telemetry=False),
    Case("720p", "exit-bend", 45, size=_HD),
)


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a run. rate_hz: of the telemetry; any_offset: its clock has an unknown constant offset within ±0.5 s.

    blind_lens: whether a tracker without telemetry is given the intrinsics.
    """

    models: tuple[str, ...]
    rate_hz: float = 30.0
    any_offset: bool = False
    blind_lens: bool = False


def make(model: str, world: FlightWorld, telemetry: bool, options: Options) -> Tracker:
    """A tracker for a flight, given what a user would give."""
    if model in uav_rivals.NAMES:
        return uav_rivals.OpenCvTracker(model)
    from edge.uav import tracker_factory

    lens = world.lens if telemetry or options.blind_lens else None
    body = world.body_from_camera if telemetry else None
    return tracker_factory.make_tracker(
        model, world.size, lens=lens, body_from_camera=body, fps=world.fps, seed=world.seed
    )


def fly(
    world: FlightWorld, trackers: dict[str, Tracker], samples: Sequence[Telemetry], offset: float
) -> dict[str, Score]:
    """Run several trackers on one flight and score each; one that raises loses the rest of the flight."""
    truths = [world.truth(i) for i in range(world.length)]
    estimates: dict[str, list[Estimate]] = {name: [] for name in trackers}
    scores = {name: Score() for name in trackers}
    failed: dict[str, str] = {}
    arrived = 0
    for i in range(world.length):
        image = world.frame(i)
        last = arrived
        while arrived < len(samples) and samples[arrived].time - offset <= world.time(i):
            arrived += 1
        for name, tracker in trackers.items():
            if name in failed:
                continue
            began = time.process_time()
            try:
                for sample in samples[last:arrived]:
                    tracker.handle_telemetry(sample)
                if i == 0:
                    new = tracker.begin(image, world.time(0), truths[0].box)
                else:
                    new = tracker.handle_frame(image, world.time(i))
            except Exception as error:  # noqa: BLE001 - crashes are counted by the bench
                failed[name] = f"{world.name} seed {world.seed} frame {i}: {type(error).__name__}: {error}"
                continue
            scores[name].seconds += (time.process_time() - began) * (i > 0)
            scores[name].frames += i > 0
            estimates[name].append(new)
    for name in trackers:
        if name in failed:
            scores[name].failures.append(failed[name])
            continue
        scores[name].add(score(truths, estimates[name], world.size))
    return scores


def run(case: Case, seed: int, options: Options) -> dict[str, Score]:
    """One flight of a case."""
    cv2.setNumThreads(1)
    world = scenarios.get(case.scenario, seed, size=case.size, frames=case.frames)
    offset = world.time_offset if options.any_offset else 0.0
    samples = world.telemetry(options.rate_hz, time_offset=offset) if case.telemetry else []
    trackers = {name: make(name, world, case.telemetry, options) for name in options.models}
    return fly(world, trackers, samples, offset)


Figure = Callable[[Score], str]


def _percents(*names: str) -> Figure:
    return lambda s: " / ".join(f"{s.percent(name):.1f}" for name in names) + " %"


def _reacquired(s: Score) -> str:
    return f"{s.reacquired[0]}/{s.reacquired[1]}, {s.delay:.1f}"


ROWS: tuple[tuple[str, tuple[str, ...], str, str, Figure], ...] = (
    ("exits up to 45 frames: length / 20 px", ("short",), "95 / 90", "100 / 98", _percents("out_length", "out_near")),
    ("60-90 frames round a bend", ("bend",), "95 / 70", "99 / 92", _percents("out_length", "out_near")),
    ("150 frames", ("long",), "90 / 40", "98 / 75", _percents("out_length", "out_near")),
    ("same colour, 60 frames: length", ("same colour 60",), "95", "", _percents("out_length")),
    ("same colour, 60 frames: identity swaps", ("same colour 60",), "0", "", lambda s: str(s.swaps)),
    ("same colour, 120 frames: length", ("same colour 120",), "", "95", _percents("out_length")),
    ("same colour, 120 frames: identity swaps", ("same colour 120",), "", "0", lambda s: str(s.swaps)),
    ("turn out of view: any hypothesis / best", ("turn",), "80 /", "/ 80", _percents("out_any", "out_length")),
    ("trees, bridge: in frame", ("hidden",), "90", "97", _percents("in_near")),
    ("lighting, off-road, partial: in frame", ("hard to see",), "95", "99", _percents("in_near")),
    ("cut at first, tenfold scale, 10 px: in frame", ("size",), "", "", _percents("in_near")),
    ("the last two without telemetry: in frame", ("size blind",), "", "", _percents("in_near")),
    ("re-acquired, mean frames", ("*",), "95 %, 3", "100 %, 1", _reacquired),
    ("claims visible while out", ("*",), "2", "0.2", _percents("claims_out")),
    ("says visible while in", ("*",), "90", "98", _percents("says_in")),
    ("no telemetry, 60 frames: length", ("no telemetry",), "80", "", _percents("out_length")),
    ("CPU a frame, 640x480", ("*",), "10 ms", "3 ms", lambda s: f"{s.ms:.1f} ms"),
    ("CPU a frame, 720p", ("720p",), "15 ms", "5 ms", lambda s: f"{s.ms:.1f} ms"),
    ("(no limit) in frame, all", ("*",), "", "", _percents("in_near")),
    ("(no limit) says visible while wholly hidden", ("hidden",), "", "", _percents("claims_hidden")),
    ("(no limit) out: truth within the 95 % std", ("*",), "", "", _percents("std_95")),
    ("(no limit) identity swaps, all", ("*",), "", "", lambda s: str(s.swaps)),
    ("(no limit) crashes", ("*", "720p"), "", "", lambda s: str(len(s.failures))),
)


def total(scores: dict[tuple[Case, str], Score], groups: tuple[str, ...], model: str) -> Score:
    """The sum over the cases of some groups; ``*`` is all but 720p."""
    out = Score()
    for (case, name), part in scores.items():
        if name == model and (case.group in groups or ("*" in groups and case.group != "720p")):
            out.add(part)
    return out


def table(scores: dict[tuple[Case, str], Score], models: Sequence[str]) -> str:
    """The table of requirements, and below it one line per case and model."""
    flown = {case.group for case, _ in scores}
    lines = [f"{'':44s}{'must':>9s}{'reach':>10s}" + "".join(f"{model:>18s}" for model in models)]
    for title, groups, must, reach, figure in ROWS:
        if not ("*" in groups or flown.intersection(groups)):
            continue
        cells = "".join(f"{figure(total(scores, groups, model)):>18s}" for model in models)
        lines.append(f"{title:44s}{must:>9s}{reach:>10s}{cells}")
    lines += [
        "",
        f"{'case':24s}{'model':8s}  length  20 px    any  in 20  back      delay  claims    says  std95    ms",
    ]
    for (case, model), part in scores.items():
        percents = [part.percent(name) for name in ("out_length", "out_near", "out_any", "in_near")]
        rest = [part.percent(name) for name in ("claims_out", "says_in", "std_95")]
        back = f"{part.reacquired[0]}/{part.reacquired[1]}"
        lines.append(
            f"{case.title:24s}{model:8s}"
            + "".join(f"{value:7.1f}" for value in percents)
            + f"  {back:8s}{part.delay:7.1f}"
            + "".join(f"{value:8.1f}" for value in rest)
            + f"{part.ms:6.1f}"
        )
    failures = [f"{model}: {text}" for (_, model), part in scores.items() for text in part.failures]
    return "\n".join([*lines, *failures])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="flights of each case")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--scenarios", default="", help="only these scenarios or groups, by comma")
    parser.add_argument("--no-telemetry", action="store_true", help="in all cases")
    parser.add_argument("--rate", type=float, default=30.0, help="of the telemetry [Hz]")
    parser.add_argument("--offset", action="store_true", help="unknown constant offset of the telemetry's clock")
    parser.add_argument("--blind-lens", action="store_true", help="give the intrinsics also without telemetry")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", type=Path, help="write all counts to this file, - for the screen")
    return parser.parse_args()


def _chosen(names: str, no_telemetry: bool) -> list[Case]:
    wanted = {name.strip() for name in names.split(",") if name.strip()}
    unknown = wanted - {case.scenario for case in CASES} - {case.group for case in CASES}
    if unknown:
        raise SystemExit(f"no case {', '.join(sorted(unknown))}; scenarios: {', '.join(scenarios.SCENARIOS)}")
    cases = [case for case in CASES if not wanted or case.scenario in wanted or case.group in wanted]
    if no_telemetry:
        cases = [dataclasses.replace(case, telemetry=False) for case in cases]
    return list(dict.fromkeys(cases))


def _models(names: str) -> tuple[str, ...]:
    out = []
    for name in names.split(","):
        if name in uav_rivals.NAMES and not uav_rivals.available(name):
            print(f"{name} left out: this OpenCV has no {name.upper()}; uav_rivals.py says how to get it")
            continue
        out.append(name)
    return tuple(out)


def main() -> None:
    """Run and print."""
    arguments = _arguments()
    options = Options(_models(arguments.models), arguments.rate, arguments.offset, arguments.blind_lens)
    cases = _chosen(arguments.scenarios, arguments.no_telemetry)
    work = [(case, arguments.first_seed + k) for case in cases for k in range(arguments.seeds)]
    scores = {(case, model): Score() for case in cases for model in options.models}
    began = time.perf_counter()
    with ProcessPoolExecutor(max(arguments.jobs, 1)) as pool:
        results = pool.map(run, *zip(*((case, seed, options) for case, seed in work), strict=True))
        for (case, _), flown in zip(work, results, strict=True):
            for model, part in flown.items():
                scores[case, model].add(part)
    if arguments.json is None or str(arguments.json) != "-":
        print(table(scores, options.models))
        print(f"{len(work)} flights of {arguments.seeds} seeds a case, {time.perf_counter() - began:.0f} s")
    if arguments.json is not None:
        text = json.dumps([_record(case, model, part) for (case, model), part in scores.items()], indent=1)
        print(text) if str(arguments.json) == "-" else arguments.json.write_text(text)


def _record(case: Case, model: str, part: Score) -> dict[str, object]:
    counts: dict[str, object] = {name: list(getattr(part, name)) for name in PAIRS}
    return {
        **dataclasses.asdict(case),
        "model": model,
        **counts,
        "delays": part.delays,
        "swaps": part.swaps,
        "ms_a_frame": part.ms,
        "failures": part.failures,
    }


if __name__ == "__main__":
    main()
