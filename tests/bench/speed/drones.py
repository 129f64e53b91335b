"""The drone flights from scratch, the whole command, beside mvus' CPU on the same labels (published, not run here)."""

from __future__ import annotations

import statistics
import subprocess
import sys
from pathlib import Path

from tests.bench.real_rigs import MVUS, CommandFailed, cpu_seconds, run_calibrate
from tests.bench.speed.rows import Limit, Row, Section

_MUST_S = {"drone1": 1.5, "drone2": 2.5}
_REFERENCE = """
import numpy as np, scipy.linalg
random = np.random.default_rng(0)
band, right = np.abs(random.random((12, 1500))) + 20.0 * (np.arange(12) == 11)[:, None], random.random((1500, 40))
for _ in range(60):
    scipy.linalg.cho_solve_banded((scipy.linalg.cholesky_banded(band), False), right)
points = random.random((2000, 3))
for _ in range(6000):
    points = points * 0.999 + points[::-1] * 0.001
sum(i * i % 7 for i in range(2_000_000))
"""
"""Work like that of the command, which nobody makes faster: what the machine itself was worth during the run."""


def reference_cpu() -> float:
    """CPU seconds of the reference, a process of its own."""
    before = cpu_seconds()
    subprocess.run([sys.executable, "-c", _REFERENCE], check=True)
    return cpu_seconds() - before


def measure(quick: bool, data: Path) -> Section:
    """Medians of five (quick: three) of the whole command's CPU, the interpreter's start and files too, in turn with
    the reference's."""
    found = Section()
    for name in ("drone1", "drone2"):
        session = data / name
        if not (session / "observations.csv").is_file():
            found.missing.append(f"{name} from scratch: no recording in the data folder")
            continue
        ours, reference = [], []
        try:
            for _ in range(3 if quick else 5):
                ours.append(run_calibrate(session, "observations.csv").cpu)
                reference.append(reference_cpu())
        except CommandFailed as error:
            found.missing.append(f"{name} from scratch: {error}")
            continue
        cpu, theirs = statistics.median(ours), MVUS[name, "observations.csv"][0]
        work = f"{name} from scratch, whole command"
        found.rows += [
            Row(work, cpu, "s", "mvus' CPU, as given", float(theirs),
                must=Limit("ratio", 15.0), reach=Limit("ratio", 50.0)),
            Row(work, cpu, "s", "a fixed piece of numpy work", statistics.median(reference),
                must=Limit("ours", _MUST_S[name]), note="the other column is the machine's speed"),
        ]  # fmt: skip
    return found
