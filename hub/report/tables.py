"""The report's tables: cameras, pairs, refused cameras, provenance."""

from __future__ import annotations

import platform
import sys

import numpy as np

from hub.report.measures import RowUsage
from hub.report.pair_graph import edge_kind
from hub.report.quality_assessment import capital, half_interval_ms
from hub.report.svg import THIN, esc, number, short, whole
from hub.report.wording import remedy_for
from protocols.core.errors import Refused
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration
from protocols.session.rig import Rig

_LIBRARIES = {"numpy": "numpy", "scipy": "scipy", "OpenCV": "cv2"}
_MAX_TESTS = 1000  # rows of the table of tests, of a hundred pairs
_MAX_UNFOLDED = 30  # more pairs than this are folded away
_SIGNS = {"agrees": "✓ consistent", "contradicts": "≠ contradicts the others", "refused": "✕"}


def table(head: list[str], rows: list[list[str]], *, numeric: int = 0, kind: str = "") -> str:
    """An HTML table of HTML cells; the columns from ``numeric`` on are right-aligned (0: none)."""
    top = "".join(f"<th{_numeric(i, numeric)}>{cell}</th>" for i, cell in enumerate(head))
    body = "".join(
        "<tr>" + "".join(f"<td{_numeric(i, numeric)}>{cell}</td>" for i, cell in enumerate(row)) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _numeric(column: int, first: int) -> str:
    return ' class="n"' if 0 < first <= column else ""


def cameras(calibration: Calibration, used: dict[str, RowUsage]) -> str:
    """One row per camera: clock, position, residual, rows used."""
    unit = calibration.units if calibration.scale == "metric" else "first baseline = 1"
    head = [
        "Camera",
        "Lag <small>s at mid-overlap, ± ms (95 %)</small>",
        "Clock rate <small>ppm, ± std</small>",
        f"Position <small>{esc(unit)}, ± std</small>",
        "Residual <small>px rms</small>",
        "Rows used",
    ]
    rows = []
    for name, camera in calibration.cameras.items():
        reference = name == calibration.reference
        half = half_interval_ms(camera)
        offset = number(camera.lag, 6, sign=not reference)
        uncertainty = '<small class="quiet">reference</small>' if reference else f"± {short(half, figures=2)}"
        ppm = 1e6 * (camera.time_map.clock_rate - 1.0)
        total = used[name].total
        rows.append(
            [
                f"<b>{esc(name)}</b>",
                f'{offset} <span class="pm">{uncertainty}</span>',
                number(ppm, 1, sign=not reference)
                + ("" if reference else f' <span class="pm">± {short(1e6 * camera.clock_rate_std, figures=2)}</span>'),
                _position(camera.pose.position, camera.position_std),
                number(camera.rms_px, 2),
                f"{whole(used[name].used)} / {whole(total)} <small>({100 * used[name].share:.0f}{THIN}%)</small>",
            ]
        )
    return table(head, rows, numeric=1, kind="cameras")


def sensitivities(calibration: Calibration) -> str:
    """One row for each given value: what an error of one std of it would do to the answer; "" without any."""
    unit = calibration.units if calibration.scale == "metric" else "baselines"
    rows = []
    for name, camera in calibration.cameras.items():
        for one in camera.sensitivities:
            error = {"lens": f"{100 * one.std:.2g} % of focal length", "rotation": f"{one.std:.2g} rad"}
            moves = f"{short(one.position, figures=2)} {esc(unit)} ({esc(one.camera)})"
            rows.append(
                [
                    f"<b>{esc(name)}</b>",
                    one.given,
                    error.get(one.given, f"{one.std:.2g} {esc(unit)}"),
                    moves,
                    short(1e3 * one.lag, figures=2),
                ]
            )
    head = ["Camera", "Given", "Error of one std", "Moves a camera by up to", "Moves a lag by up to <small>ms</small>"]
    return table(head, rows, numeric=3) if rows else ""


def _position(position: Floats, std: Floats) -> str:
    worst = float(np.max(std))
    size = float(np.linalg.norm(position))
    if not np.isfinite(worst) or worst < 1e-9 * max(size, 1.0):
        digits, uncertainty = 3, "fixed"
    else:
        # Two significant figures of the uncertainty, and the position with as many decimals.
        digits = int(np.clip(1 - np.floor(np.log10(worst)), 0, 6))
        uncertainty = f"± {worst:.{digits}f}"
    place = ", ".join(number(value, digits) for value in position)
    return f'{place} <span class="pm">{uncertainty}</span>'


def pairs(outcome: Calibration | Refused) -> str:
    """One row per pair: result, lag at the middle of the overlap, clock rate, inliers, noise."""
    if not outcome.pairs:
        return ""
    head = [
        "Pair",
        "Result",
        "Lag <small>s</small>",
        "Rate <small>ppm</small>",
        "Inliers <small>%</small>",
        "Noise <small>px</small>",
    ]
    rows, why = [], []
    for pair in outcome.pairs:
        kind = edge_kind(outcome, pair)
        assessment = _SIGNS[kind] + (" not connected" if kind == "refused" else "")
        if kind == "refused":
            why.append(f"<li><b>{esc(pair.cameras[0])}–{esc(pair.cameras[1])}</b>: {esc(pair.status)}</li>")
        ppm = None if pair.clock_rate is None else 1e6 * (pair.clock_rate - 1.0)
        rows.append(
            [
                f"{esc(pair.cameras[0])}–{esc(pair.cameras[1])}",
                assessment,
                number(pair.lag_s, 4, sign=True),
                number(ppm, 1, sign=True),
                number(None if pair.inliers is None else 100 * pair.inliers, 0),
                number(pair.rms_px, 2),
            ]
        )
    inner = table(head, rows, numeric=2, kind="pairs")
    # Reasons are sentences, too long for a table cell.
    inner += f'<ul class="why">{"".join(why)}</ul>' if why else ""
    if len(rows) <= _MAX_UNFOLDED:
        return inner
    return f"<details><summary>All {len(rows)} pairs</summary>{inner}</details>"


def acceptance(outcome: Calibration | Refused) -> str:
    """One row per acceptance test of each camera and pair: value, limit, and where the limit comes from; folded."""
    tested = [(name, tests) for name, tests in outcome.acceptance.items()]
    tested += [("–".join(pair.cameras), pair.acceptance) for pair in outcome.pairs]
    rows = [
        [
            f"<b>{esc(name)}</b>",
            esc(test.name),
            f"{short(test.value)} {'≤' if test.sense == '<=' else '≥'} {short(test.limit)} {esc(test.unit)}",
            "✓" if test.passed and not test.alternative else esc(test.alternative) or "✕",
            esc(test.source),
        ]
        for name, tests in tested
        for test in tests
    ]
    if not rows:
        return ""
    head = ["Of", "Test", "Value and limit", "Passed", "Where the limit comes from"]
    return f"<details><summary>All {len(rows)} tests</summary>{table(head, rows[:_MAX_TESTS])}</details>"


def refused(reasons: dict[str, str], counts: dict[str, int]) -> str:
    """One row per refused camera: number of rows, reason, what to do."""
    rows = [
        [f"<b>{esc(name)}</b>", whole(counts.get(name, 0)), esc(reason), code(capital(remedy_for(reason)))]
        for name, reason in reasons.items()
    ]
    return table(["Camera", "Rows", "Why", "What to do"], rows, kind="refused")


def code(text: str) -> str:
    """Escaped text with the parts between backticks set as code."""
    parts = esc(text).split("`")
    return "".join(f"<code>{part}</code>" if index % 2 else part for index, part in enumerate(parts))


def provenance(facts: dict[str, str], rig: Rig, command: str) -> str:
    """Provenance: command, input, versions."""
    # Of the modules, as far as they are loaded: importlib.metadata costs 15 ms, most of it for the e-mail parser.
    loaded = ((name, sys.modules.get(module)) for name, module in _LIBRARIES.items())
    versions = [f"{name} {module.__version__}" for name, module in loaded if module is not None]
    versions.insert(0, f"Python {platform.python_version()}")
    rows = {
        **({"Command": f"<code>{esc(command)}</code>"} if command else {}),
        **{key: esc(value) for key, value in facts.items() if value},
        **({"Rig": f"<code>{esc(rig.file)}</code>"} if rig.file is not None else {}),
        "Made with": esc(", ".join(versions)),
    }
    items = "".join(f"<dt>{esc(key)}</dt><dd>{value}</dd>" for key, value in rows.items())
    return f'<dl class="facts">{items}</dl>'
