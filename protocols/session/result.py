"""result.json: the whole result of `calibrate`, or its refusal, for scripts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from protocols.core.acceptance import AcceptanceTest, PairReport
from protocols.core.version import VERSION
from protocols.session.calibration import Calibration, TrajectoryTable, calibration_tables
from protocols.session.rig import Rig

TRAJECTORY_FILE = "trajectory.csv"


def result_document(calibration: Calibration, rig: Rig, *, command: str = "") -> dict[str, Any]:
    """The content of result.json of a solved session; keys always come in the same order.

    Lengths are in the rig's units, times in seconds. ``cameras`` holds calibration.toml's tables plus position (camera
    centre in the world), lag_s (reference time less camera time) and lag_std_s at camera time lag_time_s,
    clock_rate_ppm with its std, clock_steps, sensitivity (what one std of a given position, rotation or lens would do:
    largest displacement of a camera, largest change of a lag), detector_z (rms of residuals over the detector's stds)
    and rows_used; ``trajectory`` summarises trajectory.csv. A missing or non-finite value is None.
    """
    tables = calibration_tables(calibration, rig)
    metadata = tables.pop("metadata")
    metadata["refused"] = dict(calibration.refused)
    for name, camera in calibration.cameras.items():
        residuals = calibration.residuals.get(name)
        tables[name]["position"] = camera.pose.position
        tables[name]["lag_s"] = camera.lag
        tables[name]["lag_std_s"] = camera.lag_std
        tables[name]["lag_time_s"] = camera.lag_time
        tables[name]["clock_rate_ppm"] = 1e6 * (camera.time_map.clock_rate - 1.0)
        tables[name]["clock_rate_ppm_std"] = 1e6 * camera.clock_rate_std
        tables[name]["clock_steps"] = [
            {"time_s": time, "size_s": size, "size_std_s": std} for time, size, std in camera.clock_steps
        ]
        tables[name]["sensitivity"] = {
            one.given: {"std": one.std, "position": one.position, "of_camera": one.camera, "lag_s": one.lag}
            for one in camera.sensitivities
        }
        tables[name]["detector_z"] = camera.detector_z or None
        tables[name]["rows_used"] = None if residuals is None else len(residuals)
    return _document(
        status="solved",
        reason=None,
        command=command,
        metadata=metadata,
        cameras=tables,
        trajectory={
            "file": TRAJECTORY_FILE,
            "labels": [_summary(table) for table in calibration.trajectories],
        },
        pairs=[_pair(pair) for pair in calibration.pairs],
        convergence=[{"stage": step.stage, "residual_px": step.residual_px} for step in calibration.convergence],
        acceptance={name: _tests(tests) for name, tests in calibration.acceptance.items()},
        warnings=list(calibration.warnings),
        cpu_seconds=calibration.cpu_seconds,
    )


def refusal_document(
    reason: str,
    refused: dict[str, str],
    rig: Rig,
    *,
    command: str = "",
    solver: str = "joint",
    cpu_seconds: float = 0.0,
    pairs: Iterable[PairReport] = (),
    warnings: Iterable[str] = (),
    acceptance: Mapping[str, Sequence[AcceptanceTest]] | None = None,
) -> dict[str, Any]:
    """The content of result.json of a refused session: the same keys, and the reason.

    refused: reasons by camera. acceptance: their tests.
    """
    metadata = {
        **rig.metadata,
        "units": rig.units,
        "reference": None,
        "scale": None,
        "solver": solver,
        "version": VERSION,
        "refused": dict(refused),
    }
    return _document(
        status="refused",
        reason=reason,
        command=command,
        metadata=metadata,
        cameras={},
        trajectory={"file": None, "labels": []},
        pairs=[_pair(pair) for pair in pairs],
        convergence=[],
        acceptance={name: _tests(tests) for name, tests in (acceptance or {}).items()},
        warnings=list(warnings),
        cpu_seconds=cpu_seconds,
    )


def result_text(document: dict[str, Any]) -> str:
    """Strict JSON (no NaN, no Infinity) whose floats read back bit for bit."""
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _document(**values: Any) -> dict[str, Any]:
    return {key: _plain(value) for key, value in values.items()}


def _pair(pair: PairReport) -> dict[str, Any]:
    return {
        "cameras": list(pair.cameras),
        "lag_s": pair.lag_s,
        "lag_std_s": pair.lag_std_s,
        "clock_rate": pair.clock_rate,
        "fundamental": None if pair.fundamental is None else np.asarray(pair.fundamental).ravel(),
        "inliers": pair.inliers,
        "rms_px": pair.rms_px,
        "status": pair.status,
        "acceptance": _tests(pair.acceptance),
    }


def _tests(tests: Iterable[AcceptanceTest]) -> list[dict[str, Any]]:
    return [{**asdict(test), "passed": test.passed} for test in tests]


def _summary(table: TrajectoryTable) -> dict[str, Any]:
    there = len(table.time) > 0
    return {
        "label": table.label,
        "rows": len(table.time),
        "first_time": table.time[0] if there else None,
        "last_time": table.time[-1] if there else None,
        "median_std": np.median(table.std) if there else None,
    }


def _plain(value: Any) -> Any:
    """Convert to what JSON can hold: arrays become lists, numpy numbers Python's, non-finite numbers None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value + 0.0 if math.isfinite(value) else None  # -0.0 becomes 0.0
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)  # a date or a path in the rig's own keys
