"""What `calibrate` must not import: each of these takes as long as a tenth of a drone flight's calibration or more."""

from __future__ import annotations

import subprocess
import sys


def test_calibrate_imports_nothing_dear() -> None:
    told = "import sys, hub.calibration.pipeline; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    assert "hub.calibration.pair_network" in modules
    for dear in (
        "scipy.stats",
        "scipy.optimize",
        "scipy.spatial",
        "hub.distributed.solver",
        "hub.nodes",
        "rich",
        "plotly",
    ):
        assert dear not in modules
