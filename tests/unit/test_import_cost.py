"""What imports may cost: modules that `calibrate` must not load, and packages that load nothing by themselves."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys

import pytest


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


@pytest.mark.parametrize("package", ["protocols", "edge", "hub", "deploy"])
def test_a_package_offers_its_names_without_loading_what_is_behind_them(package: str) -> None:
    code = f"import sys, {package}; print(dir({package})); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names, modules = done.stdout.splitlines()
    assert "numpy" not in modules.split()
    for name in ast.literal_eval(names):
        assert getattr(importlib.import_module(package), name) is not None
    with pytest.raises(AttributeError):
        importlib.import_module(package).no_such_name  # noqa: B018
