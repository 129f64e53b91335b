"""Runs the fault tests and prints the matrix: `python -m tests.faults [pytest arguments]`; `make faults`.

Failed tests are run once more, one after the other: these tests kill, freeze and impair processes, and two of them
at once on two cores disturb each other. Tests that pass only then are reported.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from tests.faults.matrix import VARIABLE, table

_HERE = str(Path(__file__).parent)
_STATIONS = ("mavsdk>=3.10,<4", "MAVProxy>=1.8.70")
"""Ground stations run as processes. Without their requirements, which would replace OpenCV by another build."""


def _fetch_stations() -> None:
    folder = Path(sys.prefix) / "stations"
    if not folder.is_dir():
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        if subprocess.run([*pip, "--target", str(folder), *_STATIONS], check=False).returncode:
            print("left out: MAVSDK and MAVProxy could not be installed", flush=True)


def main() -> int:
    _fetch_stations()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "matrix.jsonl"
        os.environ[VARIABLE] = str(file)
        began = time.monotonic()
        status = pytest.main([_HERE, *sys.argv[1:]])
        if status == pytest.ExitCode.TESTS_FAILED:
            print("\nSECOND TRY of what failed, one test after the other:", flush=True)
            again = [sys.executable, "-m", "pytest", _HERE, "--last-failed", "--last-failed-no-failures", "none"]
            status = subprocess.run(again, check=False).returncode
        print(f"\n{table(file)}\n\n{time.monotonic() - began:.0f} s, {os.cpu_count()} cores")
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
