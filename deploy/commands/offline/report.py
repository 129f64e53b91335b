"""`syncline report`: quality report of a calibration as one HTML file."""

from __future__ import annotations

from pathlib import Path

from deploy.commands.common import Flag, Json, UnusedSeed, answer, closing_lines, command_line, open_browser
from protocols.core.errors import EXIT_DONE, InputError, Refused


def report(
    source: Path,
    /,
    *,
    out: Path | None = None,
    session: Path | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
    browser: Flag = False,
) -> int:
    """Write report.html for a result folder, a session or a log: the quality assessment first, then the evidence.

    The report is one self-contained file for viewing offline and printing. A folder that `syncline calibrate`, `hub`
    or `demo` wrote is reported as it is; a log or a session is calibrated first. If the calibration was refused, the
    report explains why.

    Example: syncline report demo-out/demo.mcap --out report.html

    Example: syncline report out

    Parameters
    ----------
    source
        A folder with result.json, a session folder, or a .mcap log.
    out
        The file to write. Default: report.html in the result folder, else in the current folder.
    session
        The session of a result folder, if it has been moved since the calibration.
    browser
        Open the report in a browser.
    """
    from deploy.offline.progress import progress_bar
    from deploy.offline.report_input import load_report_input
    from hub.report import build_report
    from hub.report.measures import row_usage
    from hub.report.quality_assessment import assess_quality, assess_refusal
    from hub.report.wording import in_words_of
    from protocols.core.files import write_atomically

    file = out or (source / "report.html" if (source / "result.json").is_file() else Path("report.html"))
    if file.suffix.lower() not in (".html", ".htm"):
        raise InputError("a report is an .html file", file=file, remedy="choose another --out")
    with progress_bar(f"solving {source.name}", quiet=json) as progress:
        report_input = load_report_input(source, session, progress)
    command = report_input.command or command_line()
    outcome = report_input.outcome
    write_atomically(
        file, build_report(outcome, report_input.rig, report_input.observations, command, report_input.history)
    )
    if isinstance(outcome, Refused):
        assessment = assess_refusal(outcome, report_input.rig)
    else:
        assessment = assess_quality(
            outcome,
            report_input.rig,
            report_input.observations,
            row_usage(outcome, report_input.rig, report_input.observations),
        )
    rig, labels = report_input.rig, report_input.observations.labels
    todo = [in_words_of(line, rig, labels) for line in assessment.actions]
    marked = [(in_words_of(one.text, rig, labels), one.action) for one in assessment.of("attention")]
    summary = {
        "report": str(file),
        "level": assessment.level,
        "verdict": assessment.headline,
        "attention": [text for text, _ in marked],
        "todo": todo,
    }
    checks = [f"check: {text}" for text, action in marked if not action]  # an action names its cause
    closing = closing_lines([report_input.missing] if report_input.missing else [], [file])
    answer(summary, [assessment.headline, *checks, *(f"to do: {line}" for line in todo), *closing], json)
    if browser:
        open_browser(file.resolve().as_uri())
    return EXIT_DONE
