"""What ground stations do and what they get: `python -m tests.faults.stations` prints it as a table.

Without the command every row is looked up in the page that has the table, so that the page stays current.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

VARIABLE = "SYNCLINE_EXCHANGES"
PAGE = Path("docs/results/ground-stations.md")
STATIONS = Path(sys.prefix) / "stations"
"""Ground stations that run as processes. Without their requirements, which would replace OpenCV by another build."""
_PACKAGES = ("mavsdk==3.17.4", "mavsdk-grpc==4.0.5", "MAVProxy==1.8.75")
_TESTS = ("tests/integration/uav/test_ground_stations.py", "tests/unit/edge/mavlink", "tests/faults/test_stations.py")


def exchanged(client: str, step: str, result: str) -> None:
    """Note one row of the table. result: what does not depend on how fast the machine is."""
    row, file = f"| {client} | {step} | {result} |", os.environ.get(VARIABLE)
    if file:
        with Path(file).open("a", encoding="utf-8") as out:
            out.write(row + "\n")
    else:
        page = (Path(__file__).parents[2] / PAGE).read_text(encoding="utf-8")
        assert row in page, f"{PAGE} lacks the row {row}: python -m tests.faults.stations prints the table"


def fetch_stations() -> None:
    """Install the stations into their folder, unless they are there."""
    installed = STATIONS / "packages"
    if installed.is_file() and installed.read_text() == repr(_PACKAGES):
        return
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--upgrade"]
    if subprocess.run([*pip, "--target", str(STATIONS), *_PACKAGES], check=False).returncode:
        print("left out: MAVSDK and MAVProxy could not be installed", flush=True)
    else:
        installed.write_text(repr(_PACKAGES))


def main() -> int:
    fetch_stations()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.md"
        os.environ[VARIABLE] = str(file)
        status = pytest.main([*_TESTS, *sys.argv[1:]])
        rows = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    print("\n| client | step | result |", "|---|---|---|", *dict.fromkeys(rows), sep="\n")
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
