"""The files of a calibration in their folder, and the summary that a person reads."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hub.report import build_report
from protocols.core.errors import InputError, Refused
from protocols.core.files import write_together
from protocols.session.calibration import Calibration, calibration_text, trajectory_text
from protocols.session.observations import Observations
from protocols.session.result import refusal_document, result_document, result_text
from protocols.session.rig import Rig

CALIBRATION, TRAJECTORY, RESULT, REPORT = "calibration.toml", "trajectory.csv", "result.json", "report.html"
_WEAK_S = 0.002  # a clock known no better than this deserves advice


def remove_outputs(out: Path) -> None:
    """Take away an earlier answer: beside a refusal it would look like the present one. Raises InputError."""
    for name in (CALIBRATION, TRAJECTORY):
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as error:
            what = f"cannot be removed: {error.strerror}"
            raise InputError(what, file=out / name, remedy="choose another --out") from None


def write_outputs(
    out: Path, calibration: Calibration, rig: Rig, observations: Observations, command: str, echo_json: bool = False
) -> None:
    """All four outputs, or none of them. Raises InputError."""
    document = result_document(calibration, rig, command=command)
    write_together(
        {
            out / CALIBRATION: calibration_text(calibration, rig),
            out / TRAJECTORY: trajectory_text(calibration),
            out / RESULT: result_text(document),
            out / REPORT: build_report(calibration, rig, observations, command),
        }
    )
    if echo_json:
        print(json.dumps(document, allow_nan=False))
    else:
        print_summary(calibration, out)
        weak = {
            name: ""
            for name, camera in calibration.cameras.items()
            if camera.time_offset_std > _WEAK_S or name in calibration.refused
        }
        print_advice(rig, observations, {**weak, **calibration.refused})


def print_advice(rig: Rig, observations: Observations, cameras: Mapping[str, str] | None = None) -> None:
    """Where to wave the marker next time, in a line or two; nothing where nothing is lacking.

    cameras: only these; None = all.
    """
    from hub.calibration.coverage import advice_for

    for advice in advice_for(rig, observations, cameras):
        print(f"hint: {advice.text}")


def write_refusal(
    out: Path,
    refusal: Refused,
    rig: Rig,
    observations: Observations,
    command: str,
    *,
    solver: str = "joint",
    cpu_seconds: float = 0.0,
    warnings: tuple[str, ...] = (),
    echo_json: bool = False,
) -> None:
    """result.json and report.html of a session that has no answer; an earlier answer is removed."""
    remove_outputs(out)
    document = refusal_document(
        refusal.reason,
        refusal.cameras,
        rig,
        command=command,
        solver=solver,
        cpu_seconds=cpu_seconds,
        pairs=refusal.pairs,
        warnings=(*warnings, *refusal.warnings),
    )
    write_together(
        {out / RESULT: result_text(document), out / REPORT: build_report(refusal, rig, observations, command)}
    )
    if echo_json:
        print(json.dumps(document, allow_nan=False))
        return
    for warning in (*warnings, *refusal.warnings):
        print(f"warning: {warning}")
    print_advice(rig, observations)


def wide_console(markup: bool = False) -> Any:
    """A console that never squeezes a table below what its figures need.

    markup: off, so that "[ms]" in a heading and brackets in a user's names are shown and not obeyed.
    """
    from rich.console import Console

    class _Console(Console):
        def on_broken_pipe(self) -> None:
            """Let the command line end it quietly: whoever read our output went away."""
            raise BrokenPipeError

    return _Console(file=sys.stdout, highlight=False, markup=markup, width=None if sys.stdout.isatty() else 140)


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
