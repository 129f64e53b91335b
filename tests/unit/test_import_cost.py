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


def test_the_first_alignment_in_flight_imports_nothing() -> None:
    """It held up the images for 2 s, 6 s after the start."""
    code = (
        "import sys, numpy as np; from edge.uav.timing import clock_alignment, telemetry_offset as t;"
        "from edge.uav.base import Telemetry; from protocols.geometry import so3;"
        "from protocols.geometry.camera import Intrinsics;"
        "clock_alignment.ClockAligner((640, 480), Intrinsics(640, 480, np.eye(3)), np.eye(3));"
        "before = set(sys.modules);"
        "at = np.arange(0.0, 12.0, 1 / 30); turn = np.outer(np.sin(at * at / 4), np.ones(3)) / 9; r = so3.exp(turn);"
        "seen = [so3.log(b.T @ a) for a, b in zip(r, r[1:])]; every = slice(None, None, 4);"
        "given = [Telemetry(float(x), y) for x, y in zip(at[every], r[every])];"
        "print(t.find_offset(t.RelativeRotations(at[:-1], at[1:], np.array(seen)), given, np.eye(3), (-0.5, 0.5)).std);"
        "print(*set(sys.modules) - before)"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    std, modules = process.stdout.splitlines()
    assert float(std) < 0.02
    assert not [name for name in modules.split() if name.startswith("scipy")]


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


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("edge.devices.playback.playback_clock", "edge.devices.base"),
        ("edge.devices.simulated.aircraft", "edge.uav.world.rendering"),
    ],
)
def test_a_clock_loads_no_device_and_an_aircraft_no_renderer(module: str, heavy: str) -> None:
    code = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert heavy not in done.stdout.split()


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
