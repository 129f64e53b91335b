"""`syncline report`: what an answer is worth, as one file."""

from __future__ import annotations

import json as json_module
import shlex
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from protocols.core.errors import EXIT_DONE, InputError, Refused


def report(
    source: Path,
    /,
    *,
    out: Path | None = None,
    session: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
    browser: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write report.html of results, of a session or of a log: the verdict first, then the evidence.

    One file that opens offline and prints. A folder that `syncline calibrate`, `hub` or `demo` wrote is reported as
    it is; a log or a session is solved first. What has no answer has a report too, of why.

    Example: syncline report demo-out/demo.mcap --out report.html

    Example: syncline report out

    Parameters
    ----------
    source
        A folder with result.json, a session folder, or a .mcap log.
    out
        The file to write. Default: report.html in the folder of results, else in the present one.
    session
        Where the session of a folder of results is, if it is not where it was when it was solved.
    json
        Print file and verdict as JSON.
    browser
        Open it.
    """
    from deploy.offline.progress import progress_bar
    from deploy.offline.report import load_answer
    from hub.report import build_report
    from hub.report.measures import usage
    from hub.report.quality_assessment import judge, judge_refusal
    from protocols.core.files import write_atomically

    file = out or (source / "report.html" if (source / "result.json").is_file() else Path("report.html"))
    if file.suffix.lower() not in (".html", ".htm"):
        raise InputError("a report is an .html file", file=file, remedy="choose another --out")
    with progress_bar(f"solving {source.name}", quiet=json) as tell:
        answer = load_answer(source, session, tell)
    command = answer.command or shlex.join(["syncline", *sys.argv[1:]])
    outcome = answer.outcome
    write_atomically(file, build_report(outcome, answer.rig, answer.observations, command, answer.history))
    if isinstance(outcome, Refused):
        verdict = judge_refusal(outcome, answer.rig)
    else:
        verdict = judge(outcome, answer.rig, answer.observations, usage(outcome, answer.rig, answer.observations))
    if json:
        told = {"report": str(file), "level": verdict.level, "verdict": verdict.headline, "todo": verdict.todo}
        print(json_module.dumps(told, ensure_ascii=False))
    else:
        print(verdict.headline)
        for line in verdict.todo:
            print(f"to do: {line}")
        print(f"written: {file}")
    if browser:
        import webbrowser

        if not webbrowser.open(file.resolve().as_uri()):
            print("syncline: no browser could be opened here", file=sys.stderr)
    return EXIT_DONE
