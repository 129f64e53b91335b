"""Modules that `calibrate` must not import: loading each takes at least a tenth of the time of calibrating a flight."""

from __future__ import annotations

import subprocess
import sys


def test_calibrate_imports_no_slow_module() -> None:
    code = "import sys, hub.calibration.pipeline; print(*sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(process.stdout.split())
    assert "hub.calibration.pair_network" in modules
    for slow in (
        "scipy.stats",
        "scipy.optimize",
        "scipy.spatial",
        "hub.distributed.solver",
        "hub.distributed.network.node",
        "rich",
        "plotly",
    ):
        assert slow not in modules
