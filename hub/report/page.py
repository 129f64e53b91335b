"""The HTML page of report.html: quality assessment, figures and tables, provenance. One file that opens offline."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from hub.report import image_maps, measures, pair_graph, rig_figure, tables, time_figures
from hub.report.measures import RowUsage
from hub.report.quality_assessment import (
    UNIT_WORDS,
    QualityAssessment,
    assess_quality,
    assess_refusal,
    capital,
    half_interval_ms,
)
from hub.report.style import STYLE
from hub.report.svg import THIN, esc, number, short, whole
from hub.report.time_figures import OffsetStdSample
from hub.report.wording import in_words_of
from protocols.core.errors import Refused
from protocols.core.version import VERSION
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

# The page forbids loading any resource: it is self-contained.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'unsafe-eval'; "
    "img-src data: blob:; font-src data:; worker-src blob:"
)

_TESTS = (
    "What an answer must pass, each with its value, its limit and where the limit comes from. Where another test "
    "decided in its stead, that one is named."
)
_GLOSSARY = (
    (
        "Clock offset and rate",
        "Reference time = rate × camera time + offset. A rate 100 ppm above 1 gains 6 ms a minute.",
    ),
    (
        "± (95 %)",
        "95 % interval: the true value is within this of the estimate in 95 of 100 cases, if the noise model holds.",
    ),
    (
        "Lag of a pair",
        "The first camera’s clock minus the second’s, in the middle of the time in which both saw the point.",
    ),
    (
        "Residual",
        "Reprojection error: the image distance between a detection and the projection of the trajectory.",
    ),
    ("rms", "Root mean square."),
    (
        "First baseline",
        "The distance between the first two cameras; the unit of length if no distance or position was given.",
    ),
)


def build_report(
    outcome: Calibration | Refused,
    rig: Rig,
    observations: Observations,
    command: str = "",
    history: tuple[OffsetStdSample, ...] = (),
) -> str:
    """report.html: one file, no more than 6 MB, that loads nothing; the same input gives the same bytes.

    outcome: the calibration, or the refusal that was raised instead. command: the command line. history: the offset
    stds of a live hub's calibrations over a log.
    """
    if isinstance(outcome, Refused):
        page = _refusal_page(outcome, rig, observations, command)
    else:
        page = _calibration_page(outcome, rig, observations, command, history)
    return in_words_of(page, rig, observations.labels)


def _calibration_page(
    calibration: Calibration, rig: Rig, observations: Observations, command: str, history: tuple[OffsetStdSample, ...]
) -> str:
    used = measures.row_usage(calibration, rig, observations)
    assessment = assess_quality(calibration, rig, observations, used)
    drawn = rig_figure.build_rig_figure(calibration, rig)
    counts = {name: len(measures.camera_rows(observations, name)) for name in calibration.refused}
    several = f" over {len(calibration.trajectories)} points" if len(calibration.trajectories) > 1 else ""
    parts = [
        _assessment_section(assessment, _key_figures(calibration, rig, observations, used)),
        section("Cameras", "", tables.cameras(calibration, used)),
        section(
            "What errors of given values would do",
            "The answer follows the given references and lenses. A larger error than these cannot always be seen in "
            "the observations; its effect grows in proportion.",
            tables.sensitivities(calibration),
        ),
        section(
            "Refused cameras",
            "These have no table in calibration.toml; the other cameras are not affected.",
            tables.refused(calibration.refused, counts) if calibration.refused else "",
        ),
        section(
            "Clock offsets",
            "Uncertainty of each camera’s time offset: the dot is the estimate, the bar its 95 % interval.",
            "" if rig.shared_clock else time_figures.offset_intervals(calibration, used),
        ),
        section(
            "Convergence",
            "",
            _convergence(calibration, rig, history),
        ),
        section(
            "Pairs",
            "Every pair of cameras is solved separately, then checked for consistency with the others around loops.",
            _pairs(calibration),
        ),
        section(
            "Scene",
            f"Camera poses and the trajectory of the point{several}. Drag to rotate, scroll to zoom; "
            "the trajectory starts at the circle and ends at the diamond.",
            f'<div class="frame screen"><div id="{rig_figure.DIV}"></div></div>{rig_figure.plan_and_side(drawn)}',
        ),
        section(
            "Residuals in the image",
            "Arrows in random directions are noise; neighbouring arrows that agree indicate inaccurate intrinsics.",
            image_maps.residual_maps(calibration),
        ),
        section(
            "Residuals over time",
            "The line is the median in pixels, the band the 10 to 90 % range. A step indicates a moved camera, "
            "a slope a clock whose rate changes.",
            time_figures.residuals_over_time(calibration),
        ),
        section(
            "Visibility of the point",
            "Only times at which two or more cameras see the point contribute to the calibration.",
            time_figures.time_line(calibration, observations),
        ),
        _glossary(),
    ]
    facts = {
        "Syncline": calibration.version,
        "Solver": calibration.solver,
        "Reference clock": calibration.reference,
        "Lengths": calibration.units if calibration.scale == "metric" else "arbitrary: the first baseline is 1",
    }
    parts.append(section("Acceptance tests", _TESTS, tables.acceptance(calibration)))
    parts.append(section("Provenance", "", tables.provenance(facts, rig, command)))
    return html_page("Calibration report", assessment.headline, parts, rig_figure.rig_figure_script(drawn))


def _refusal_page(refused: Refused, rig: Rig, observations: Observations, command: str) -> str:
    assessment = assess_refusal(refused, rig)
    rows = {name: measures.camera_rows(observations, name) for name in rig.cameras}
    sizes = {name: camera.size for name, camera in rig.cameras.items()}
    reasons_by_camera = {name: refused.cameras.get(name, "") for name in rig.cameras}
    reasons = {name: reason or "no separate reason: see above" for name, reason in reasons_by_camera.items()}
    seen = {name: part for name, part in rows.items() if len(part)}
    parts = [
        _assessment_section(assessment, ""),
        section(
            "Cameras",
            "The rows of each camera, why it could not be connected to another, and what to do.",
            tables.refused(reasons, {name: len(part) for name, part in rows.items()}),
        ),
        section(
            "Pairs",
            "Results of camera pairs: these lags are valid, only poses and trajectories are missing.",
            tables.pairs(refused) if any(pair.status == "ok" for pair in refused.pairs) else "",
        ),
        section(
            "When each camera saw the point",
            "The clocks are unknown, so each row starts at the camera’s own first observation.",
            time_figures.own_time_lines(rows),
        ),
        section(
            "Where each camera saw the point",
            "Motion across most of every image, at different depths, constrains the calibration best.",
            image_maps.seen_maps(seen, sizes) if seen else "",
        ),
        section("Acceptance tests", _TESTS, tables.acceptance(refused)),
        section("Provenance", "", tables.provenance({"Syncline": VERSION}, rig, command)),
    ]
    return html_page("Calibration refused", assessment.headline, parts)


def _key_figures(calibration: Calibration, rig: Rig, observations: Observations, used: dict[str, RowUsage]) -> str:
    total = len(calibration.cameras) + len(calibration.refused)
    others = [camera for name, camera in calibration.cameras.items() if name != calibration.reference]
    share, seconds = measures.trajectory_coverage(calibration, observations)
    keys = [(f"{len(calibration.cameras)}{THIN}/{THIN}{total}", "cameras solved")]
    if others and not rig.shared_clock:
        worst = max(others, key=half_interval_ms)
        keys.append(
            (
                f"± {short(half_interval_ms(worst), figures=2)}{THIN}ms",
                f"largest time offset interval ({worst.name}, 95{THIN}%)",
            )
        )
    rows = sum(part.used for part in used.values())
    if rows:
        square = sum(used[name].used * camera.rms_px**2 for name, camera in calibration.cameras.items())
        keys.append((f"{number((square / rows) ** 0.5, 2)}{THIN}px", f"rms residual of {whole(rows)} rows"))
    if seconds > 0:
        time = f"the {short(seconds)} s" if len(calibration.trajectories) < 2 else "the time"
        keys.append((f"{100 * share:.0f}{THIN}%", f"of {time} that two cameras saw has a 3-D trajectory"))
    keys.append(
        (
            UNIT_WORDS.get(calibration.units, calibration.units),
            "unit of length, from the rig’s control points or distances",
        )
        if calibration.scale == "metric"
        else ("arbitrary", "scale (timing is not affected)")
    )
    return (
        '<div class="keys">' + "".join(f"<div><b>{esc(a)}</b><span>{esc(b)}</span></div>" for a, b in keys) + "</div>"
    )


def _assessment_section(assessment: QualityAssessment, keys: str) -> str:
    def listed(level: str) -> str:
        items = [f'<li class="{f.level}">{tables.code(f.text)}</li>' for f in assessment.findings if f.level == level]
        return "".join(items)

    not_good, good = listed("attention") + listed("note"), listed("good")
    columns = []
    if good:
        columns.append(f'<div><h3>Good</h3><ul class="findings">{good}</ul></div>')
    heading = "Why" if assessment.level == "refused" else "Problems" if listed("attention") else "Notes"
    if not_good:
        columns.append(f'<div><h3>{heading}</h3><ul class="findings">{not_good}</ul></div>')
    todo = "".join(f"<li>{tables.code(capital(text))}</li>" for text in assessment.actions)
    todo = f'<h3>What to do</h3><ol class="todo">{todo}</ol>' if todo else "<h3>What to do</h3><p>Nothing.</p>"
    if assessment.level == "refused":
        columns.append(f"<div>{todo}</div>")
        todo = ""
    return (
        f'<section class="assessment {assessment.level}"><h1>{esc(assessment.headline)}</h1>'
        f'<p class="lead">{esc(assessment.summary)}</p>{keys}'
        f'<div class="columns">{"".join(columns)}</div>{todo}</section>'
    )


def _pairs(calibration: Calibration) -> str:
    listed = tables.pairs(calibration)
    drawn = pair_graph.draw_pair_graph(calibration)
    if not drawn:
        return listed
    legend = pair_graph.legend(calibration)
    if pair_graph.is_matrix(calibration):
        return f"{legend}{drawn}{listed}"
    return f'{legend}<div class="graph"><div>{drawn}</div><div>{listed}</div></div>'


def _convergence(calibration: Calibration, rig: Rig, history: tuple[OffsetStdSample, ...]) -> str:
    steps = time_figures.adjustment_history(calibration.convergence)
    clocks = "" if rig.shared_clock else time_figures.offset_std_history(history, calibration.reference)
    return "".join(
        f'<p class="lead">{lead}</p>{figure}'
        for lead, figure in (
            (
                "Residual after each step of the bundle adjustment in pixels; it should fall and level off. Where it "
                "jumps between steps, rows and noise were reweighted.",
                steps,
            ),
            ("Std of each camera’s time offset after every calibration of the hub, over the recording.", clocks),
        )
        if figure
    )


def _glossary() -> str:
    items = "".join(f"<dt>{esc(word)}</dt><dd>{esc(meaning)}</dd>" for word, meaning in _GLOSSARY)
    inner = f'<details><summary>Glossary</summary><dl class="words">{items}</dl></details>'
    return f'<section class="screen">{inner}</section>'


def section(title: str, lead: str, content: str) -> str:
    """A section, or "" without content."""
    if not content:
        return ""
    lead = f'<p class="lead">{esc(lead)}</p>' if lead else ""
    return f"<section><h2>{esc(title)}</h2>{lead}{content}</section>"


def html_page(title: str, headline: str, parts: list[str], script: str = "") -> str:
    """A page that loads nothing. parts: its sections; script: JavaScript that uses plotly, "" = none."""
    scripts = ""
    if script:
        spec = find_spec("plotly")  # read as its get_plotlyjs does; the package's import costs 50 ms
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError("plotly")
        library = (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text(encoding="utf-8")
        scripts = f"<script>{library}</script>\n<script>{script}</script>\n"
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{esc(headline)} · Syncline</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f'<header class="top"><b>Syncline</b><span>{esc(title)}</span></header>\n'
        f"<main>\n{body}\n</main>\n{scripts}</body>\n</html>\n"
    )
