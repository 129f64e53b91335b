"""HTML of the view's panels: status tables, readable without colour."""

from __future__ import annotations

import html
import math

from hub.calibration.coverage import MIN_COVERAGE
from hub.report.measures import COLUMNS, ROWS
from hub.view.state import CameraState, CameraView, ViewState

SIGNS: dict[CameraState, str] = {"solved": "✓", "refused": "✗", "collecting": "…", "silent": "!", "gone": "–"}
"""Sign before a camera's name, so that its state can be read without colour."""

_STYLE = (
    "<style>.sl{font:12px/1.35 system-ui,sans-serif;padding:0 .75em .5em;overflow-x:auto}"
    ".sl table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}"
    ".sl th{text-align:right;font-weight:600;padding:1px 4px;border-bottom:1px solid #888;white-space:nowrap}"
    ".sl td{text-align:right;padding:1px 4px;white-space:nowrap}"
    ".sl td:first-child,.sl th:first-child{text-align:left}"
    ".sl .clock td{white-space:normal;padding:0 4px 3px 1.6em;color:#444}"
    ".sl .bad{font-weight:700}.sl p{margin:.35em 0}.sl .grid{font-family:monospace;line-height:1;white-space:pre}"
    "</style>"
)


def overview(state: ViewState, now: float) -> str:
    """The state of the site in one line, and advice."""
    lines = [f"<p><b data-syncline='headline'>{html.escape(state.headline())}</b></p>"]
    if state.cameras and needs_guidance(state):
        lines += [f"<p data-syncline='guide'>☞ {html.escape(one.text)}</p>" for one in state.guidance.advice()]
    for agent in state.of_role("record"):
        stale = " (silent)" if now - agent.at > 5.0 else ""
        sign = "●" if agent.status.gauges.get("recording", 1.0) else "○"
        lines.append(f"<p>{sign} {html.escape(f'{agent.status.agent}: {agent.status.message}{stale}')}</p>")
    for agent in state.of_role("hub"):
        # The result of a requested action is the last part of the hub's message.
        if any(name.startswith("asked.") for name in agent.status.counters):
            result = agent.status.message.rpartition("; ")[2]
            lines.append(f"<p>{html.escape(f'{agent.status.agent}: {result}')}</p>")
    return f"{_STYLE}<div class='sl'>{''.join(lines)}</div>"


def needs_guidance(state: ViewState) -> bool:
    """Whether to show advice: a camera is not solved, or its image coverage is too low."""
    found = state.calibration
    if found is None or found.status != "solved" or found.refused:
        return True
    return any(state.guidance.coverage(name) < MIN_COVERAGE for name in state.cameras)


def camera_table(state: ViewState, now: float) -> str:
    """Two rows per camera: frame rate, last detection, coverage and counts; below, its clock and residual."""
    heads = ("camera", "fps", "seen", "view", "lost", "refused")
    rows = "".join(_camera_row(state, camera, now) for camera in state.cameras.values())
    titles = "".join(f"<th>{head}</th>" for head in heads)
    return f"{_STYLE}<div class='sl'><table><tr>{titles}</tr>{rows}</table></div>"


def _camera_row(state: ViewState, camera: CameraView, now: float) -> str:
    status = camera.state(now)
    cells = [
        f"{camera.fps(now):.1f}",
        ago(camera.last_seen, now),
        f"{100 * state.guidance.coverage(camera.name):.0f}\u2009%",
        str(camera.lost),
        str(camera.refusals) if camera.refusals else "–",
    ]
    title = html.escape(camera.refused or status, quote=True)
    name = f"<td title='{title}'>{SIGNS[status]} {html.escape(camera.name)}</td>"
    kind = "" if status == "solved" else " class='bad'"
    texts = "".join(f"<td>{cell}</td>" for cell in cells)
    attributes = f"data-camera='{html.escape(camera.name)}' data-state='{status}'"
    return f"<tr{kind} {attributes}>{name}{texts}</tr>{_clock_row(camera)}"


def _clock_row(camera: CameraView) -> str:
    found = camera.calibration
    if found is None:
        return f"<tr class='clock'><td colspan=6>{html.escape(camera.refused[:90])}</td></tr>" if camera.refused else ""
    if found.time_offset_std == 0.0 and found.time_offset == 0.0:
        text = f"reference clock · {found.rms_px:.2f} px"
        return f"<tr class='clock'><td colspan=6 data-clock='{html.escape(camera.name)}'>{text}</td></tr>"
    text = (
        f"{found.time_offset:+.6f} s ± {1e3 * found.time_offset_std:.3f} ms · "
        f"{1e6 * (found.clock_rate - 1.0):+.1f} ppm · {found.rms_px:.2f} px"
    )
    return f"<tr class='clock'><td colspan=6 data-clock='{html.escape(camera.name)}'>{text}</td></tr>"


def camera_details(state: ViewState, camera: CameraView, now: float) -> str:
    """All data of one camera, and the coverage of its image by the marker."""
    status = camera.state(now)
    info = camera.info
    lines = [f"<b>{SIGNS[status]} {html.escape(camera.name)}: {status}</b>"]
    if camera.refused:
        lines.append(f"refused: {html.escape(camera.refused)}")
    if info is not None:
        lens = "intrinsics known" if len(info.matrix) == 9 else "no intrinsics: timing only"
        lines.append(f"{info.width}×{info.height}, {info.fps:g} fps nominal, {html.escape(info.driver)}, {lens}")
    lines.append(f"{camera.frames} frames, marker in {camera.seen}, {camera.lost} lost, {camera.restarts} restarts")
    pose, found = camera.pose, camera.calibration
    if pose is not None and found is not None:
        x, y, z = pose.position
        std = max(found.position_std, default=math.nan)
        lines.append(f"at {x:.3f}, {y:.3f}, {z:.3f} ± {std:.2g} {_unit(state)}")
    covered = state.guidance.covered_cells(camera.name)
    grid = "\n".join("".join("■" if covered[row, column] else "□" for column in range(COLUMNS)) for row in range(ROWS))
    share = 100 * state.guidance.coverage(camera.name)
    lines.append(f"marker seen in {share:.0f} % of the image:<div class='grid'>{grid}</div>")
    return f"{_STYLE}<div class='sl'>{''.join(f'<p>{line}</p>' for line in lines)}</div>"


def _unit(state: ViewState) -> str:
    solved = state.solved
    return "" if solved is None else solved.units if solved.scale == "metric" else "baselines"


def ago(moment: float | None, now: float) -> str:
    """Time since ``moment`` as a short text."""
    if moment is None:
        return "never"
    seconds = max(0.0, now - moment)
    if seconds < 1.0:
        return "now"
    return f"{seconds:.0f}\u2009s" if seconds < 120 else f"{seconds / 60:.0f}\u2009min"
