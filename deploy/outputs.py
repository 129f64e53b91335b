"""The files of a calibration in their folder, and the summary that a person reads."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from hub.report import build_report
from protocols.errors import Refused
from protocols.files import write_atomically
from protocols.session.calibration import Calibration, write_calibration, write_trajectory
from protocols.session.observations import Observations
from protocols.session.result import refusal_document, result_document
from protocols.session.rig import Rig

CALIBRATION, TRAJECTORY, RESULT, REPORT = "calibration.toml", "trajectory.csv", "result.json", "report.html"


def remove_outputs(out: Path) -> None:
    """Take away an earlier answer: beside a refusal it would look like the present one."""
    for name in (CALIBRATION, TRAJECTORY):
        (out / name).unlink(missing_ok=True)


def write_outputs(
    out: Path, calibration: Calibration, rig: Rig, observations: Observations, command: str, echo_json: bool = False
) -> None:
    """All four outputs, each whole or not there."""
    document = result_document(calibration, rig, command=command)
    write_calibration(out / CALIBRATION, calibration, rig)
    write_trajectory(out / TRAJECTORY, calibration)
    write_atomically(out / RESULT, json.dumps(document, indent=2, allow_nan=False) + "\n")
    write_atomically(out / REPORT, build_report(calibration, rig, observations, command))
    if echo_json:
        print(json.dumps(document, allow_nan=False))
    else:
        print_summary(calibration, out)


def write_refusal(
    out: Path,
    refusal: Refused,
    rig: Rig,
    observations: Observations,
    command: str,
    cpu_seconds: float,
    echo_json: bool = False,
) -> None:
    """result.json and report.html of a session that has no answer."""
    document = refusal_document(refusal.reason, refusal.cameras, rig, command=command, cpu_seconds=cpu_seconds)
    write_atomically(out / RESULT, json.dumps(document, indent=2, allow_nan=False) + "\n")
    write_atomically(out / REPORT, build_report(refusal, rig, observations, command))
    if echo_json:
        print(json.dumps(document, allow_nan=False))


def wide_console() -> Any:
    """A console that never squeezes a table below what its figures need."""
    from rich.console import Console

    return Console(file=sys.stdout, highlight=False, width=None if sys.stdout.isatty() else 140)


def print_summary(calibration: Calibration, out: Path) -> None:
    """A table of the cameras, the refused ones and warnings, and where the files are."""
    from rich.table import Table

    console = wide_console()
    unit = calibration.units if calibration.scale == "metric" else "baselines"
    table = Table(
        title=f"{len(calibration.cameras)} cameras, {calibration.cpu_seconds:.1f} s of CPU", title_justify="left"
    )
    for column in ("camera", "offset [s]", "± [ms]", "rate [ppm]", f"position [{unit}]", "±", "rms [px]"):
        table.add_column(column, justify="left" if column == "camera" else "right")
    for name, camera in calibration.cameras.items():
        position = " ".join(f"{value:.3f}" for value in camera.pose.position)
        table.add_row(
            name + (" (reference)" if name == calibration.reference else ""),
            f"{camera.time_map.time_offset:.6f}",
            f"{1e3 * camera.time_offset_std:.3f}",
            f"{1e6 * (camera.time_map.clock_rate - 1.0):+.1f}",
            position,
            f"{float(max(camera.position_std)):.2g}",
            f"{camera.rms_px:.2f}",
        )
    console.print(table)
    for name, reason in calibration.refused.items():
        console.print(f"refused {name}: {reason}", soft_wrap=True)
    for warning in calibration.warnings:
        console.print(f"warning: {warning}", soft_wrap=True)
    console.print(
        f"written: {', '.join(str(out / name) for name in (CALIBRATION, TRAJECTORY, RESULT, REPORT))}", soft_wrap=True
    )


__all__ = ["CALIBRATION", "REPORT", "RESULT", "TRAJECTORY", "print_summary", "remove_outputs", "write_outputs"]
