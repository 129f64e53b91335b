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
from tests.faults.stations import fetch_stations

_HERE = str(Path(__file__).parent)


def main() -> int:
    fetch_stations()
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
