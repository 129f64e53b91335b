"""The page: verdict first, then the evidence, then where it comes from. One file that opens offline."""

from __future__ import annotations

from hub.report import convergence, image_maps, measures, pair_graph, scene, tables, time_figures
from hub.report.convergence import Step
from hub.report.measures import Usage
from hub.report.quality_assessment import UNIT_WORDS, Verdict, half_interval_ms, judge, judge_refusal
from hub.report.style import STYLE
from hub.report.svg import THIN, esc, number, short, whole
from protocols.core.errors import Refused
from protocols.core.version import VERSION
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

# The page forbids itself to load anything: what it needs is in it.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'unsafe-eval'; "
    "img-src data: blob:; font-src data:; worker-src blob:"
)

_WORDS = (
    (
        "Clock offset and rate",
        "Reference time = rate × camera time + offset. A rate 100 ppm above 1 gains 6 ms a minute.",
    ),
    (
        "± (95 %)",
        "The true value lies within this of the told one in 95 of 100 cases, if the residuals are what they seem.",
    ),
    (
        "Lag of a pair",
        "The first camera’s clock less the second’s at one instant, in the middle of the time both saw the point.",
    ),
    (
        "Residual",
        "The distance in the image between where the point was seen and where the solved path and camera put it.",
    ),
    ("rms", "Root mean square: the size that counts large residuals more."),
    (
        "First baseline",
        "The distance between the first two cameras; the unit of length where nothing of known size was given.",
    ),
)


def build_report(
    outcome: Calibration | Refused,
    rig: Rig,
    observations: Observations,
    command: str = "",
    history: tuple[Step, ...] = (),
) -> str:
    """report.html: one file, no more than 6 MB, that loads nothing; the same input gives the same bytes.

    outcome: the calibration, or the refusal that was raised instead of one. command: as it was typed. history: what a
    live hub answered on the way, of a log.
    """
    if isinstance(outcome, Refused):
        return _refusal_page(outcome, rig, observations, command)
    return _calibration_page(outcome, rig, observations, command, history)


def _calibration_page(
    calibration: Calibration, rig: Rig, observations: Observations, command: str, history: tuple[Step, ...]
) -> str:
    used = measures.usage(calibration, rig, observations)
    verdict = judge(calibration, rig, observations, used)
    drawn = scene.build_scene(calibration, rig)
    counts = {name: len(measures.rows_of(observations, name)) for name in calibration.refused}
    several = f" over {len(calibration.trajectories)} points" if len(calibration.trajectories) > 1 else ""
    parts = [
        _verdict(verdict, _key_figures(calibration, rig, observations, used)),
        _section("Cameras", "", tables.cameras(calibration, used)),
        _section(
            "Refused cameras",
            "These have no table in calibration.toml; the others do not suffer from it.",
            tables.refused(calibration.refused, counts) if calibration.refused else "",
        ),
        _section(
            "Clock offsets",
            "How sharply each camera’s clock is known: the dot is the estimate, the bar its 95 % interval.",
            "" if rig.shared_clock else time_figures.offset_intervals(calibration, used),
        ),
        _section(
            "Convergence",
            "",
            _convergence(calibration, rig, history),
        ),
        _section(
            "Pairs",
            "Every pair of cameras is solved by itself first, then checked against the others round every loop.",
            _pairs(calibration),
        ),
        _section(
            "Scene",
            f"Where the cameras stand and how the point moved{several}. Drag to turn, scroll to come nearer; "
            "the path begins at the circle and ends at the diamond.",
            f'<div class="frame screen"><div id="{scene.DIV}"></div></div>{scene.plan_and_side(drawn)}',
        ),
        _section(
            "Residuals in the image",
            "Arrows that point every way are noise; neighbours that agree tell of a lens that is not quite known.",
            image_maps.residual_maps(calibration),
        ),
        _section(
            "Residuals over time",
            "The line is the median in pixels, the band holds the middle 80 %. A step tells of a bumped camera, "
            "a slope of a clock that changes its rate.",
            time_figures.residuals_over_time(calibration),
        ),
        _section(
            "Who saw the point when",
            "Only where two or more cameras see the point at once is there anything to measure.",
            time_figures.time_line(calibration, observations),
        ),
        _words(),
    ]
    facts = {
        "Syncline": calibration.version,
        "Solver": calibration.solver,
        "Reference clock": calibration.reference,
        "Lengths": calibration.units if calibration.scale == "metric" else "arbitrary: the first baseline is 1",
    }
    parts.append(_section("Where this comes from", "", tables.provenance(facts, rig, command)))
    return _document("Calibration report", verdict, parts, scene.scene_script(drawn))


def _refusal_page(refused: Refused, rig: Rig, observations: Observations, command: str) -> str:
    verdict = judge_refusal(refused, rig)
    rows = {name: measures.rows_of(observations, name) for name in rig.cameras}
    sizes = {name: camera.size for name, camera in rig.cameras.items()}
    told = {name: refused.cameras.get(name, "") for name in rig.cameras}
    reasons = {name: reason or "no reason of its own: see above" for name, reason in told.items()}
    seen = {name: part for name, part in rows.items() if len(part)}
    parts = [
        _verdict(verdict, ""),
        _section(
            "Cameras",
            "What each camera gave, why it could not be tied to another, and what helps.",
            tables.refused(reasons, {name: len(part) for name, part in rows.items()}),
        ),
        _section(
            "Pairs",
            "What could be told of two cameras by themselves: these lags hold, only places and paths are missing.",
            tables.pairs(refused) if any(pair.status == "ok" for pair in refused.pairs) else "",
        ),
        _section(
            "When each camera saw the point",
            "The clocks are not known, so each row starts at the camera’s own first observation.",
            time_figures.own_time_lines(rows),
        ),
        _section(
            "Where each camera saw the point",
            "Motion that crosses much of every image, at different depths, ties cameras together best.",
            image_maps.seen_maps(seen, sizes) if seen else "",
        ),
        _section("Where this comes from", "", tables.provenance({"Syncline": VERSION}, rig, command)),
    ]
    return _document("Calibration refused", verdict, parts, "")


def _key_figures(calibration: Calibration, rig: Rig, observations: Observations, used: dict[str, Usage]) -> str:
    total = len(calibration.cameras) + len(calibration.refused)
    others = [camera for name, camera in calibration.cameras.items() if name != calibration.reference]
    share, seconds = measures.path_share(calibration, observations)
    keys = [(f"{len(calibration.cameras)}{THIN}/{THIN}{total}", "cameras solved")]
    if others and not rig.shared_clock:
        worst = max(others, key=half_interval_ms)
        keys.append(
            (
                f"± {short(half_interval_ms(worst), figures=2)}{THIN}ms",
                f"widest clock interval ({worst.name}, 95{THIN}%)",
            )
        )
    rows = sum(part.used for part in used.values())
    if rows:
        square = sum(used[name].used * camera.rms_px**2 for name, camera in calibration.cameras.items())
        keys.append((f"{number((square / rows) ** 0.5, 2)}{THIN}px", f"rms residual of {whole(rows)} rows"))
    if seconds > 0:
        time = f"the {short(seconds)} s" if len(calibration.trajectories) < 2 else "the time"
        keys.append((f"{100 * share:.0f}{THIN}%", f"of {time} that two cameras saw has a 3-D path"))
    keys.append(
        (UNIT_WORDS.get(calibration.units, calibration.units), "unit of length, from the rig’s references")
        if calibration.scale == "metric"
        else ("arbitrary", "scale (timing is not affected)")
    )
    return (
        '<div class="keys">' + "".join(f"<div><b>{esc(a)}</b><span>{esc(b)}</span></div>" for a, b in keys) + "</div>"
    )


def _verdict(verdict: Verdict, keys: str) -> str:
    def listed(level: str) -> str:
        items = [f'<li class="{f.level}">{tables.code(f.text)}</li>' for f in verdict.findings if f.level == level]
        return "".join(items)

    not_good, good = listed("attention") + listed("note"), listed("good")
    columns = []
    if good:
        columns.append(f'<div><h3>What is good</h3><ul class="findings">{good}</ul></div>')
    heading = "Why" if verdict.level == "refused" else "What to know" if not listed("attention") else "What isn’t"
    if not_good:
        columns.append(f'<div><h3>{heading}</h3><ul class="findings">{not_good}</ul></div>')
    todo = "".join(f"<li>{tables.code(_capital(text))}</li>" for text in verdict.todo)
    todo = f'<h3>What to do</h3><ol class="todo">{todo}</ol>' if todo else "<h3>What to do</h3><p>Nothing.</p>"
    if verdict.level == "refused":
        columns.append(f"<div>{todo}</div>")
        todo = ""
    return (
        f'<section class="verdict {verdict.level}"><h1>{esc(verdict.headline)}</h1>'
        f'<p class="lead">{esc(verdict.summary)}</p>{keys}<div class="columns">{"".join(columns)}</div>{todo}</section>'
    )


def _pairs(calibration: Calibration) -> str:
    listed = tables.pairs(calibration)
    drawn = pair_graph.pair_graph(calibration)
    if not drawn:
        return listed
    legend = pair_graph.legend(calibration)
    if pair_graph.is_matrix(calibration):
        return f"{legend}{drawn}{listed}"
    return f'{legend}<div class="graph"><div>{drawn}</div><div>{listed}</div></div>'


def _convergence(calibration: Calibration, rig: Rig, history: tuple[Step, ...]) -> str:
    steps = convergence.adjustment(calibration.convergence)
    clocks = "" if rig.shared_clock else convergence.convergence(history, calibration.reference)
    return "".join(
        f'<p class="lead">{lead}</p>{figure}'
        for lead, figure in (
            (
                "The misfit after every step of the adjustment, in pixels: it falls, and ends level. Where it jumps "
                "between steps, rows and noise were weighed anew.",
                steps,
            ),
            ("The std of each clock after every answer of the hub, as the recording went on.", clocks),
        )
        if figure
    )


def _words() -> str:
    items = "".join(f"<dt>{esc(word)}</dt><dd>{esc(meaning)}</dd>" for word, meaning in _WORDS)
    inner = f'<details><summary>What the words mean</summary><dl class="words">{items}</dl></details>'
    return f'<section class="screen">{inner}</section>'


def _section(title: str, lead: str, content: str) -> str:
    """A section, or nothing where it has no content."""
    if not content:
        return ""
    lead = f'<p class="lead">{esc(lead)}</p>' if lead else ""
    return f"<section><h2>{esc(title)}</h2>{lead}{content}</section>"


def _capital(text: str) -> str:
    # A camera's name stays as it is written.
    return text if ":" in text.split(" ")[0] else text[:1].upper() + text[1:]


def _document(title: str, verdict: Verdict, parts: list[str], script: str) -> str:
    scripts = ""
    if script:
        from plotly.offline import get_plotlyjs  # 50 ms and 5 MB that only a report needs

        scripts = f"<script>{get_plotlyjs()}</script>\n<script>{script}</script>\n"
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{esc(verdict.headline)} · Syncline</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f'<header class="top"><b>Syncline</b><span>{esc(title)}</span></header>\n'
        f"<main>\n{body}\n</main>\n{scripts}</body>\n</html>\n"
    )
