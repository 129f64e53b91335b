"""Runs the fault tests and prints the matrix: `python -m tests.faults [pytest arguments]`; `make faults`."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import pytest

from tests.faults.matrix import VARIABLE, table


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "matrix.jsonl"
        os.environ[VARIABLE] = str(file)
        began = time.monotonic()
        status = pytest.main([str(Path(__file__).parent), *sys.argv[1:]])
        print(f"\n{table(file)}\n\n{time.monotonic() - began:.0f} s, {os.cpu_count()} cores")
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
