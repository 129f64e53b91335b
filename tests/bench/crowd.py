"""A crowd before seven cameras: ``python -m tests.bench.crowd [--seeds 10] [--spoil 1] [--through follow]``.

The annotated boxes of ``../shared/data/crowd`` are spoilt as a detector would: 10 % are missed; of the others top,
bottom and place are off by 3 % of the height (std); each view has 0.5 false boxes (Poisson). ``--spoil 2`` doubles all
three. They then go through the command ``syncline follow --truth``, or through ``syncline import`` and ``syncline
replay --through hub``. Prints MODA, MOTA, IDF1, HOTA (TrackEval; matches within 0.5 m) and CPU seconds per second
filmed.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import resource
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deploy.cli import run
from deploy.evaluation.tracking_scores import ScoredTrack, read_ground_truth, score_tracks
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.session.csv_table import read_csv_table
from protocols.session.rig import read_rig
from protocols.topics import TRACK
from tests.bench.real_rigs import DEFAULT_DATA

COLUMNS = ("moda", "mota", "idf1", "hota", "recall", "precision", "switches", "error", "cpu")
MISSED, HEIGHT_NOISE, FALSE_BOXES = 0.1, 0.03, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _HubTrack:
    """A track as the hub published it."""

    id: int
    times: Floats
    position: Floats


def spoilt_boxes(boxes: Path, calibration: Path, spoil: float, seed: int) -> str:
    """The text of a boxes.csv with misses, noise and false boxes. spoil: their factor, 0 = as annotated."""
    table = read_csv_table(boxes, "boxes", ("camera", "frame", "time", "x", "y", "width", "height"))
    names, frame = table.text("camera"), table.whole("frame").tolist()
    time = table.numbers("time", 1e9).tolist()
    box = np.column_stack([table.numbers(name, 1e6) for name in ("x", "y", "width", "height")])
    rng = np.random.default_rng(seed)
    sizes = {name: camera.size for name, camera in read_rig(calibration).cameras.items()}
    kept = rng.random(len(box)) >= MISSED * spoil
    noise = HEIGHT_NOISE * spoil * box[:, 3:] * rng.normal(size=(len(box), 3))
    spoilt = np.column_stack(
        [box[:, 0] + noise[:, 0], box[:, 1] + noise[:, 1], box[:, 2], box[:, 3] + noise[:, 2] - noise[:, 1]]
    )
    spoilt[:, 3] = np.maximum(spoilt[:, 3], 1.0)
    rows = [(names[i], frame[i], time[i], *spoilt[i]) for i in np.flatnonzero(kept).tolist()]
    for name, (width, height) in sizes.items():
        like = box[np.array(names) == name]
        for number, at in dict.fromkeys(zip(frame, time, strict=True)):
            for _ in range(int(rng.poisson(FALSE_BOXES * spoil))):
                w, h = like[rng.integers(len(like)), 2:]
                x, y = rng.uniform(0.0, width) - 0.5 * w, rng.uniform(0.0, height) - 0.5 * h
                rows.append((name, number, at, x, y, w, h))
    lines = [
        f"{name},{number},{at!r}," + ",".join(f"{value:.3f}" for value in rest) for name, number, at, *rest in rows
    ]
    return "\n".join(["camera,frame,time,x,y,width,height", *lines]) + "\n"


def followed(data: Path, folder: Path, options: list[str]) -> dict[str, Any]:
    """Scores of the command `follow` on the boxes in a folder."""
    arguments = ["follow", str(folder / "boxes.csv"), "--calibration", str(data / "calibration.toml")]
    arguments += ["--out", str(folder / "out"), "--truth", str(data / "truth.csv"), "--json", *options]
    _run(arguments)
    document = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    seconds = document["last_time"] - document["first_time"]
    return {**document["scores"], "cpu": document["cpu_seconds"] / seconds}


def replayed(data: Path, folder: Path) -> dict[str, Any]:
    """Scores of what the hub publishes for a log of the boxes in a folder."""
    log, out = folder / "boxes.mcap", folder / "hub.mcap"
    calibration = str(data / "calibration.toml")
    _run(["import", str(folder), "--calibration", calibration, "--out", str(log)])
    began = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    _run(["replay", str(log), "--through", "hub", "--calibration", calibration, "--out", str(out)])
    cpu = resource.getrusage(resource.RUSAGE_SELF).ru_utime - began
    truth = read_ground_truth(data / "truth.csv", None)
    times = np.unique(truth.time).tolist()
    return {**score_tracks(truth, published_tracks(out), times, 1.0), "cpu": cpu / (times[-1] - times[0])}


def published_tracks(log: Path) -> list[ScoredTrack]:
    """The confirmed and coasting tracks of people in a hub's log, by label."""
    rows: dict[str, dict[int, list[float]]] = defaultdict(dict)
    for logged in LogReader(log).messages([TRACK]):
        message = logged.message
        assert isinstance(message, pb.Track)
        if message.kind == "person" and message.state != "lost":
            rows[message.label][message.reference_time_ns] = list(message.position)
    return published_positions(rows)


def published_positions(rows: dict[str, dict[int, list[float]]]) -> list[ScoredTrack]:
    """Tracks from positions by label and reference time [ns]."""
    return [
        _HubTrack(index, np.array(sorted(mine)) / NANOSECONDS, np.array([mine[time] for time in sorted(mine)]))
        for index, mine in enumerate(rows.values())
    ]


def _run(arguments: list[str]) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        status = run(arguments)
    if status:
        raise SystemExit(f"`syncline {' '.join(arguments)}` ended with status {status}")


def main() -> int:
    """Run the seeds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder of the recordings")
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds of the spoiling, from --first on")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--spoil", type=float, default=1.0, help="factor of misses, noise and false boxes; 0 = none")
    parser.add_argument("--through", choices=("follow", "hub"), default="follow", help="what follows")
    parser.add_argument("--area", help="x0,x1,y0,y1: part of the ground that counts; only for follow")
    options = parser.parse_args()
    data = options.data / "crowd"
    if not (data / "boxes.csv").is_file():
        print(f"not run: no crowd in {options.data}")
        return 0
    print(
        f"{options.through}, spoil {options.spoil:g}\nseed   " + " ".join(f"{name:>9}" for name in COLUMNS), flush=True
    )
    table = []
    for seed in range(options.first, options.first + options.seeds):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            text = spoilt_boxes(data / "boxes.csv", data / "calibration.toml", options.spoil, seed)
            (folder / "boxes.csv").write_text(text, encoding="utf-8")
            extra = ["--area", options.area] if options.area else []
            scores = replayed(data, folder) if options.through == "hub" else followed(data, folder, extra)
        table.append([float(scores[name]) for name in COLUMNS])
        print(_line(str(seed), table[-1]), flush=True)
    for word, reduce in (("mean", np.mean), ("least", np.min), ("most", np.max)):
        print(_line(word, reduce(np.array(table), axis=0).tolist()))
    return 0


def _line(word: str, values: list[float]) -> str:
    return f"{word:<7}" + " ".join(f"{value:9.3f}" for value in values)


if __name__ == "__main__":
    sys.exit(main())
