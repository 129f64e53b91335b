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
    assert "hub.calibration.pairs.pair_network" in modules
    for slow in (
        "scipy.stats",
        "scipy.optimize",
        "scipy.spatial",
        "hub.distributed.solver",
        "hub.distributed.network.node",
        "rich",
        "plotly",
        "google.protobuf",
        "hub.calibration.rigid_body.solve",
        "scipy.fft",
    ):
        assert slow not in modules


def test_calibrate_does_not_load_what_scipy_imports_in_vain() -> None:
    code = (
        "import sys; from deploy.commands.offline.calibrate import UNUSED_OF_NUMPY as unused, defer_modules;"
        "defer_modules('numpy', unused); import scipy.linalg, numpy;"
        "print(*sys.modules); print(numpy.ma.array([1]).sum())"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules, one = process.stdout.splitlines()
    assert not {"numpy.f2py.crackfortran", "numpy.testing._private.utils", "numpy.ma.core"} & set(modules.split())
    assert one == "1"  # what is used is loaded then


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
