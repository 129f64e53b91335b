"""HTML of the view's panels: status, cameras, pictures; readable without colour."""

from __future__ import annotations

import base64
import html
import math

from hub.calibration.coverage import MIN_COVERAGE
from hub.report.measures import COLUMNS, ROWS
from hub.report.svg import at, drawing
from hub.view.lag_history import lag_of
from hub.view.state import STALE_S, AgentView, CameraState, CameraView, PathView, ViewState
from protocols.core.jpeg import jpeg_fits

SIGNS: dict[CameraState, str] = {
    "calibrated": "✓",
    "degraded": "▲",
    "searching": "…",
    "collecting": "…",
    "refused": "✗",
    "silent": "!",
    "gone": "–",
}
"""Sign before a camera's name, so that its state can be read without colour."""

TRACK_SIGNS = {"confirmed": "●", "tentative": "◐", "coasting": "◌", "stale": "–"}
_MAX_TRACKS = 8  # in words
_STALE_PICTURE_S = 5.0  # a picture older than that is said to be

_STYLE = (
    "<style>.sl{font:12px/1.35 system-ui,sans-serif;padding:0 .75em .5em;overflow-x:auto}"
    ".sl table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}"
    ".sl th{text-align:right;font-weight:600;padding:1px 4px;border-bottom:1px solid #888;white-space:nowrap}"
    ".sl td{text-align:right;padding:1px 4px;white-space:nowrap}"
    ".sl td:first-child,.sl th:first-child{text-align:left;white-space:normal;overflow-wrap:anywhere}"
    ".sl th:first-child{min-width:5em}.sl .clock td{white-space:normal;padding:0 4px 3px 1.6em;color:#444}"
    ".sl .bad{font-weight:700}.sl p{margin:.35em 0}.sl .grid{font-family:monospace;line-height:1;white-space:pre}"
    ".sl .headline{font-size:15px}.sl .tiles{display:grid;grid-template-columns:repeat(auto-fill,minmax(130px,1fr));"
    "gap:6px}.sl figure{margin:0}.sl .frame{position:relative;background:#e8e8e8;aspect-ratio:4/3;display:flex;"
    "align-items:center;justify-content:center;text-align:center;color:#444}.sl .frame img,.sl .frame svg{position:"
    "absolute;inset:0;width:100%;height:100%}.sl .tiles circle{fill:none;stroke:#fff;stroke-width:2;vector-effect:"
    "non-scaling-stroke}.sl .tiles circle.under{stroke:#000;stroke-width:4}"
    "</style>"
)


def overview(state: ViewState, now: float) -> str:
    """The hub's state, what is wrong, what to do, the tracks, and the results of requested actions."""
    word, colon, rest = state.headline().partition(":")
    headline = f"<b class='headline'>{html.escape(word)}</b>{html.escape(colon + rest)}"
    lines = [f"<p data-syncline='headline' data-hub='{html.escape(state.hub_state, quote=True)}'>{headline}"]
    if problems := state.problems(now):
        listed = "<br>▲ ".join(html.escape(problem) for problem in problems)
        lines.append(f"<br><b data-syncline='health'>▲ degraded: {listed}</b>")
    lines.append("</p>")
    if needs_guidance(state):
        lines += [f"<p data-syncline='guide'>☞ {html.escape(step)}</p>" for step in state.next_steps()]
    lines.append(waiting_html(state))
    for path in list(state.paths.values())[: -_MAX_TRACKS - 1 : -1]:
        words = html.escape(f"{TRACK_SIGNS.get(path.state(now), '?')} {track_text(path, now)}")
        label = html.escape(path.label, quote=True)
        lines.append(f"<p data-track='{label}' data-state='{html.escape(path.state(now), quote=True)}'>{words}</p>")
    for agent in state.of_role("hub"):
        # The result of a requested action is the last part of the hub's message.
        if any(name.startswith("asked.") for name in agent.status.counters):
            result = agent.status.message.rpartition("; ")[2]
            lines.append(f"<p>{html.escape(f'{agent.status.agent}: {result}')}</p>")
    return f"{_STYLE}<div class='sl'>{''.join(lines)}</div>"


def waiting_html(state: ViewState) -> str:
    """While nothing is solved: what each camera is waited for, with how far it is; "" once something is."""
    if state.solved is not None:
        return ""
    rows = []
    for camera in state.cameras.values():
        progress, share = camera.progress, state.guidance.coverage(camera.name)
        parts = [camera.reason[:120]] if camera.reason else []
        if progress is not None and (progress.shared_motion_s > 0.0 or state.guidance.target != "person"):
            parts.append(f"{progress.shared_motion_s:.0f} s of motion shared with another camera")
        wanted = f"{100 * MIN_COVERAGE:.0f} % wanted"
        parts.append(f"{state.guidance.target} seen in {100 * share:.0f} % of its view, {wanted}")
        name = html.escape(camera.name, quote=True)
        bar = f"<progress max='1' value='{min(share / MIN_COVERAGE, 1.0):.2f}'></progress>"
        words = html.escape(f"{camera.verdict}: {' · '.join(parts)}")
        rows.append(f"<p data-waiting='{name}'>{SIGNS[camera.verdict]} {name} {bar}<br>{words}</p>")
    return "".join(rows)


def track_text(path: PathView, now: float) -> str:
    """What a track is doing, in words."""
    status, last = path.state(now), path.last
    if status == "stale":
        return f"{path.label}: nothing heard of it for {now - path.at:.0f} s"
    if status == "coasting":
        return f"{path.label}: coasting, unseen for {last.unseen_s:.1f} s"
    seen = f", seen by {last.cameras} camera{'' if last.cameras == 1 else 's'}" if last.cameras else ""
    return f"{path.label}: {status}{seen}"


def recording_html(state: ViewState, now: float) -> str:
    """What each recorder of the site does now."""
    lines = [_recording_line(agent, now) for agent in state.of_role("record")]
    if not lines:
        lines = ["<p data-recording='none'>○ no recorder on this site: syncline record recorder.toml</p>"]
    return f"{_STYLE}<div class='sl'>{''.join(lines)}</div>"


def _recording_line(agent: AgentView, now: float) -> str:
    status = agent.status
    seconds = now - agent.since
    span = f"{'' if agent.change_seen else 'more than '}{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
    parts = [f"recording for {span}" if agent.recording else "not recording", status.message]
    size = status.gauges.get("log_bytes", 0.0)
    if agent.recording and size > 0.0:
        parts.append(f"{size / 1e6:.1f} MB")
    if now - agent.at > STALE_S:
        parts.append(f"no status for {now - agent.at:.0f} s")
    words = html.escape(f"{status.agent}: {', '.join(part for part in parts if part)}")
    sign, word = ("●", "on") if agent.recording else ("○", "off")
    return f"<p data-recording='{word}'><b>{sign}</b> {words}</p>"


def needs_guidance(state: ViewState) -> bool:
    """Whether to show advice: a camera is not solved, or its image coverage is too low."""
    found = state.calibration
    if found is None or state.hub_state != "calibrated" or found.refused:
        return True
    return any(state.guidance.coverage(name) < MIN_COVERAGE for name in state.cameras)


def camera_table(state: ViewState, now: float) -> str:
    """For each camera frame rate, last detection, coverage and lost frames; below, its progress, clock and residual."""
    heads = ("camera", "fps", "seen", "view", "lost")
    rows = "".join(_camera_row(state, camera, now) for camera in state.cameras.values())
    titles = "".join(f"<th>{head}</th>" for head in heads)
    return f"{_STYLE}<div class='sl'><table><tr>{titles}</tr>{rows}</table></div>"


def _camera_row(state: ViewState, camera: CameraView, now: float) -> str:
    status = camera.state(now)
    covered = f"{100 * state.guidance.coverage(camera.name):.0f}\u2009%"
    cells = [f"{camera.fps(now):.1f}", ago(camera.last_seen, now), covered, str(camera.lost)]
    if camera.is_static:
        cells = [""] * len(cells)  # a calibration holds no frames
    title = html.escape(camera.reason or status, quote=True)
    name = f"<td title='{title}'>{SIGNS[status]} {html.escape(camera.name)}</td>"
    kind = " class='bad'" if status in ("refused", "degraded", "silent", "gone") else ""
    texts = "".join(f"<td>{cell}</td>" for cell in cells)
    attributes = f"data-camera='{html.escape(camera.name)}' data-state='{status}'"
    return f"<tr{kind} {attributes}>{name}{texts}</tr>{_clock_row(camera)}"


def _clock_row(camera: CameraView) -> str:
    """How far a camera is, if it is not calibrated, and its clock and residual, if they are known."""
    found, name = camera.calibration, html.escape(camera.name, quote=True)
    rows = []
    if camera.refused or (camera.progress is not None and camera.verdict != "calibrated"):
        rows.append(f"<td colspan=5 data-progress='{name}'>{html.escape(progress_text(camera))}</td>")
    if found is not None:
        reference = found.time_offset_std == 0.0 and found.time_offset == 0.0
        std = f" ± {1e3 * found.time_offset_std:.3f} ms" if found.time_offset_std > 0.0 else ""
        lag = f"{lag_of(found):+.6f} s{std} · {1e6 * (found.clock_rate - 1.0):+.1f} ppm"
        clock = "reference clock" if reference else lag
        rows.append(f"<td colspan=5 data-clock='{name}'>{clock} · {found.rms_px:.2f} px</td>")
    return "".join(f"<tr class='clock'>{row}</tr>" for row in rows)


def progress_text(camera: CameraView) -> str:
    """The hub's word for a camera, the reason, and how much motion it shares with another camera."""
    parts, progress = [camera.reason[:120]], camera.progress
    if progress is not None and progress.shared_motion_s > 0.0:
        parts.append(f"{progress.shared_motion_s:.0f} s of motion shared with another camera")
    if progress is not None and progress.margin > 0.0:
        parts.append(f"best lag {progress.margin:.1f} times as likely as the next")
    return f"{camera.verdict}: " + (" · ".join(part for part in parts if part) or "no reason given")


def picture_tiles(state: ViewState, now: float, *, wanted: bool) -> str:
    """The newest picture of every camera, with the detections of its own frame. wanted: pictures are asked for."""
    if any(camera.is_static for camera in state.cameras.values()):
        return f"{_STYLE}<div class='sl'><p>A calibration holds no pictures: play its log to see them.</p></div>"
    tiles = "".join(_tile(camera, now, wanted=wanted) for camera in state.cameras.values())
    return f"{_STYLE}<div class='sl'><div class='tiles'>{tiles}</div></div>"


def _tile(camera: CameraView, now: float, *, wanted: bool) -> str:
    picture, status = camera.picture, camera.state(now)
    words, shown = [f"{SIGNS[status]} {camera.name}"], ""
    if picture is not None and jpeg_fits(picture.jpeg) and picture.width and picture.height:
        found = camera.detections_in_image()
        rings = (
            f"<circle{kind} cx='{at(u + 0.5)}' cy='{at(v + 0.5)}' r='{at(0.5 * size + 0.02 * picture.width)}'/>"
            for u, v, size in found[:64]
            for kind in (" class='under'", "")
        )
        # decoding: otherwise the tile is blank until the next frame of the browser.
        image = f"<img decoding='sync' alt='' src='data:image/jpeg;base64,{base64.b64encode(picture.jpeg).decode()}'>"
        shown = image + drawing(picture.width, picture.height, rings, f"what {camera.name} sees")
        words.append(f"{len(found)} detection{'' if len(found) == 1 else 's'}" if found else "nothing detected")
        age = 0.0 if camera.last_picture is None else now - camera.last_picture
        if age > _STALE_PICTURE_S:
            words.append(f"picture {age:.0f} s old")
    elif not wanted:
        shown = "pictures are switched off"
    elif status in ("silent", "gone"):
        shown = "sends no frames"
    else:
        shown = "sends no pictures (pictures_hz in its file)" if camera.frames > 90 else "no picture yet"
    aspect = f" style='aspect-ratio:{picture.width}/{picture.height}'" if picture is not None and picture.height else ""
    name = html.escape(camera.name, quote=True)
    caption = html.escape(" · ".join(words))
    return (
        f"<figure data-picture='{name}'><div class='frame'{aspect}>{shown}</div>"
        f"<figcaption>{caption}</figcaption></figure>"
    )


def camera_details(state: ViewState, camera: CameraView, now: float) -> str:
    """All data of one camera, and the coverage of its image by the target."""
    status = camera.state(now)
    info = camera.info
    lines = [f"<b>{SIGNS[status]} {html.escape(camera.name)}: {status}</b>"]
    if camera.reason:
        lines.append(html.escape(progress_text(camera)))
    if info is not None:
        lens = "intrinsics known" if len(info.matrix) == 9 else "no intrinsics: timing only"
        lines.append(f"{info.width}×{info.height}, {info.fps:g} fps nominal, {html.escape(info.driver)}, {lens}")
    if camera.refusals:
        lines.append(f"refused {camera.refusals} times so far")
    pose, found = camera.pose, camera.calibration
    if pose is not None and found is not None:
        x, y, z = pose.position
        std = max(found.position_std, default=math.nan)
        lines.append(f"at {x:.3f}, {y:.3f}, {z:.3f} ± {std:.2g} {_unit(state)}")
    if not camera.is_static:
        seen = f"{state.guidance.target} in {camera.seen}"
        lines.append(f"{camera.frames} frames, {seen}, {camera.lost} lost, {camera.restarts} restarts")
        covered = state.guidance.covered_cells(camera.name)
        rows = ("".join("■" if covered[row, column] else "□" for column in range(COLUMNS)) for row in range(ROWS))
        grid, share = "\n".join(rows), 100 * state.guidance.coverage(camera.name)
        lines.append(f"{state.guidance.target} seen in {share:.0f} % of the image:<div class='grid'>{grid}</div>")
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
