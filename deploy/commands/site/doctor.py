"""`syncline doctor`: what is wrong, and what to do."""

from __future__ import annotations

import json as jsons
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter


def doctor(
    config: Path | None = None,
    /,
    *,
    role: Literal["camera", "uav", "hub", "recorder", "router"] | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Check this machine, and with a configuration the agent: one line a check, with the remedy.

    Python, processor, packages, disk, clock, USB speed, the camera and its frames, certificates, the way through the
    router and back, access rules, an autopilot's heartbeat, the last crash. Exit status 0: nothing failed (warnings
    may be there); 2: something is set up wrongly; 3: all is set up, but something does not answer.

    Example: syncline doctor cam0.toml

    Parameters
    ----------
    config
        An agent's TOML file; without it only the machine is checked.
    role
        What the file is of, if its name does not tell (hub*.toml, recorder*.toml, router*.toml, uav*.toml; else a
        camera).
    json
        Print a list of check, verdict, text, remedy and exit_status.
    """
    from dataclasses import asdict

    from deploy.site.doctor.examine import examine
    from deploy.site.doctor.finding import exit_status

    findings = []
    for finding in examine(config, role):
        findings.append(finding)
        if not json:
            print(
                f"{finding.verdict:<5}{finding.check}: {finding.text}"
                + (f"; {finding.remedy}" if finding.remedy else ""),
                flush=True,
            )
    if json:
        print(jsons.dumps([asdict(finding) for finding in findings]))
    return exit_status(findings)
