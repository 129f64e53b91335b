"""Figure of the pair bench: success rate by regime, and the lag error of each trial.

python -m tests.bench.pair_timing --json pairs.json
python -m tests.figures.pair_timing_picture pairs.json docs/pictures/pair_timing.png
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from tests.bench.pair_timing import GOOD_PX, GOOD_S, ROWS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", type=Path, help="what --json wrote")
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    kept = json.loads(options.bench.read_text())
    names = [name for name in ROWS if name in kept]
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 0.42 * len(names) + 1.4), sharey=True, layout="constrained")
    for row, name in enumerate(names):
        done = [one for one in kept[name] if np.isfinite(one["floor_s"])]
        good = [one for one in done if one["status"] == "ok" and one["map_s"] < GOOD_S and one["f_px"] < GOOD_PX]
        share = 100 * len(good) / len(done)
        left.barh(row, share, color="0.75", edgecolor="0.3")
        left.text(2, row, f"{share:.0f} % of {len(done)}", va="center")
        for wanted, mark in ((ROWS[name].required, "|"), (ROWS[name].target, "D")):
            if wanted is not None:
                left.plot(100 * wanted, row, mark, color="k", markersize=14 if mark == "|" else 5)
        errors = np.array([1e3 * abs(one["lag_s"]) for one in good])
        spread = row + 0.5 * (np.linspace(0, 1, len(errors)) - 0.5)
        right.plot(np.maximum(errors, 1e-3), spread, ".", color="0.45", markersize=3)
        right.plot(1e3 * np.median([one["floor_s"] for one in good]), row, "|", color="k", markersize=18)
    left.set(yticks=range(len(names)), yticklabels=names, xlim=(0, 103), xlabel="success [%]")
    left.set_title("Right within 5 ms and 2 px\n(bar: must, diamond: reach for)", fontsize=10)
    right.set(xscale="log", xlim=(1e-3, 10), xlabel="error of the lag at mid-overlap [ms]")
    right.set_title("Every right answer\n(bar: least possible std, median rig)", fontsize=10)
    right.grid(axis="x", color="0.9")
    left.invert_yaxis()
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.picture, dpi=90)


if __name__ == "__main__":
    main()
