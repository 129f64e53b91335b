"""`syncline doctor`: diagnostics of a machine and its agents, with remedies."""

from __future__ import annotations

from pathlib import Path

from deploy.commands.common import Json, Role, answer


def doctor(
    config: Path | None = None,
    /,
    *,
    role: Role | None = None,
    json: Json = False,
) -> int:
    """Check this machine and, with a configuration, its agent: one line per check, with a remedy.

    Checks Python, processor, packages, disk, clock, USB speed, the camera and its frames, certificates, the round trip
    through the router, access rules, an autopilot's heartbeat, and the last crash. Exit status 0: no failure (there may
    be warnings); 2: something is misconfigured; 3: the configuration is correct, but something does not respond.

    Example: syncline doctor cam0.toml

    Parameters
    ----------
    config
        An agent's TOML file; without it only the machine is checked.
    role
        Role of the agent, if it does not follow from the file's name (hub*.toml, recorder*.toml, router*.toml,
        uav*.toml; any other is a camera).
    """
    from dataclasses import asdict

    from deploy.site.doctor.check_result import exit_status
    from deploy.site.doctor.selection import run_checks

    results = []
    for result in run_checks(config, role):
        results.append(result)
        if not json:
            print(
                f"{result.verdict:<5}{result.check}: {result.text}" + (f"; {result.remedy}" if result.remedy else ""),
                flush=True,
            )
    if json:
        answer([asdict(result) for result in results], (), json)
    return exit_status(results)
