"""Output of a calibration: result files, summary table and capture advice."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hub.api import CALIBRATION, REPORT, RESULT, TRAJECTORY, CalibrationResult, save_refusal
from protocols.core.errors import InputError, Refused
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from protocols.session.session import Session

_ADVICE_OFFSET_STD_S = 0.002  # clock offset std above which advice is printed


def report_result(result: CalibrationResult, out: Path, command: str, echo_json: bool = False) -> None:
    """Write all four outputs, or none, and print the summary, or result.json. Raises InputError."""
    calibration = result.calibration
    try:
        document = result.save(out, command)
    except InputError:
        if not echo_json:
            print_summary(calibration)  # a full disk costs the files, not what a hub found
        raise
    if echo_json:
        print(json.dumps(document, allow_nan=False))
        return
    print_summary(calibration)
    print(f"written: {', '.join(str(out / name) for name in (CALIBRATION, TRAJECTORY, RESULT, REPORT))}")
    imprecise = {
        name: ""
        for name, camera in calibration.cameras.items()
        if camera.lag_std > _ADVICE_OFFSET_STD_S or name in calibration.refused
    }
    print_advice(result.session.rig, result.session.observations, {**imprecise, **calibration.refused})


def print_advice(rig: Rig, observations: Observations, cameras: Mapping[str, str] | None = None) -> None:
    """Print where to wave the marker in the next recording, in a line or two; nothing if coverage is sufficient.

    cameras: only these; None = all.
    """
    from hub.calibration.coverage import session_advice

    for advice in session_advice(rig, observations, cameras):
        print(f"hint: {advice.text}")


def report_refusal(
    refusal: Refused, session: Session, out: Path, command: str, solver: str = "joint", echo_json: bool = False
) -> None:
    """Write result.json and report.html of a refused session, and print warnings and advice, or result.json."""
    document = save_refusal(out, refusal, session, command, solver)
    if echo_json:
        print(json.dumps(document, allow_nan=False))
        return
    for warning in refusal.warnings:
        print(f"warning: {warning}")
    lags = [pair for pair in refusal.pairs if pair.lag_s is not None]
    for pair in lags:
        print(f"timing of {pair.cameras[0]}–{pair.cameras[1]}: lag {pair.lag_s:+.4f} s")
    if lags:
        print(f"the lags are usable without poses: syncline sync VIDEOS --calibration {out / RESULT} --out DIR")
    if not getattr(session, "people", ()):
        print_advice(session.rig, session.observations)


def wide_console(markup: bool = False) -> Any:
    """A console that is wide enough for all table columns when the output is not a terminal.

    markup: off by default, so that "[ms]" in a heading and brackets in user-defined names are printed literally.
    """
    from rich.console import Console

    class _Console(Console):
        def on_broken_pipe(self) -> None:
            """Raise BrokenPipeError, which the command line handles: the reader of our output has closed the pipe."""
            raise BrokenPipeError

    return _Console(file=sys.stdout, highlight=False, markup=markup, width=None if sys.stdout.isatty() else 140)


def print_summary(calibration: Calibration) -> None:
    """Print a table of the cameras, the refused cameras and warnings."""
    unit = calibration.units if calibration.scale == "metric" else "baselines"
    table = [("camera", "lag [s]", "± [ms]", "rate [ppm]", "±", f"position [{unit}]", "±", "rms [px]")]
    table += [
        (
            name + (" (reference)" if name == calibration.reference else ""),
            f"{camera.lag:.6f}",
            f"{1e3 * camera.lag_std:.3f}",
            f"{1e6 * (camera.time_map.clock_rate - 1.0):+.1f}",
            f"{1e6 * camera.clock_rate_std:.1f}",
            " ".join(f"{value:.3f}" for value in camera.pose.position),
            f"{float(max(camera.position_std)):.2g}",
            f"{camera.rms_px:.2f}",
        )
        for name, camera in calibration.cameras.items()
    ]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    spent = calibration.cpu_seconds  # 0: a hub's, which solves again and again
    print(f"{len(calibration.cameras)} cameras" + (f", {spent:.1f} s of CPU" if spent else ""))
    for name, *cells in table:  # plain: to import rich would cost a fiftieth of the whole command
        print("  ".join((name.ljust(widths[0]), *map(str.rjust, cells, widths[1:]))))
    if any(camera.lag_std > 0.0 for camera in calibration.cameras.values()):
        print(f"lag: {calibration.reference}'s time less the camera's, in the middle of their common span")
    for name, reason in calibration.refused.items():
        print(f"refused {name}: {reason}")
    for warning in calibration.warnings:
        print(f"warning: {warning}")
