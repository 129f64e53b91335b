"""`syncline install`, `uninstall`, `bundle` and `doctor`: what one machine gets, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from deploy.commands.common import Flag, Json, Role, UnusedSeed, answer
from protocols.core.errors import InputError

if TYPE_CHECKING:
    from deploy.site.install.plan import Plan


def install(
    role: Role,
    /,
    *,
    config: Path,
    root: Path = Path("/"),
    program: str | None = None,
    dry_run: Flag = False,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Install an agent as a systemd service that starts at boot and is always restarted.

    Writes its unit, /etc/syncline/ROLE-ID with the configuration and the files it refers to, and sysusers, tmpfiles and
    udev rules; its state is below /var/lib/syncline. A repeated installation changes only what differs. A configuration
    that the agent would refuse is refused here, before anything is changed.

    Example: sudo syncline install camera --config cam0.toml

    Parameters
    ----------
    role
        The kind of agent to install.
    config
        The agent's TOML file, as for `syncline camera FILE`.
    root
        Root folder of a system image that is being built; nothing is started then.
    program
        Path of `syncline` on the target; by default that of the running program.
    dry_run
        Print what would be written and run (with --json, the contents of all files), and change nothing.
    """
    from deploy.site.install.plan import apply, plan_install

    _check_root(root)
    plan = plan_install(role, config, program)
    if dry_run:
        return _show(plan, root, json)
    return _done(plan, apply(plan, root), json)


def uninstall(
    names: list[str] | None = None,
    /,
    *,
    root: Path = Path("/"),
    purge: Flag = False,
    dry_run: Flag = False,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Stop agents and remove their services. Recordings and other state are kept.

    Example: sudo syncline uninstall camera-cam0

    Parameters
    ----------
    names
        Agents as ROLE-ID; none = all, with the shared rules.
    root
        Root folder of a system image.
    purge
        Also remove the configuration below /etc/syncline.
    dry_run
        Print what would be removed, and change nothing.
    """
    from deploy.site.install.plan import apply, plan_uninstall

    _check_root(root)
    plan = plan_uninstall(list(names or []), root, purge)
    if dry_run:
        return _show(plan, root, json)
    return _done(plan, [*apply(plan, root), *plan.notes], json)


def _check_root(root: Path) -> None:
    if not root.is_dir():
        raise InputError("--root is not a folder", file=root, remedy="give the folder in which the image is mounted")


def _show(plan: Plan, root: Path, as_json: bool) -> int:
    document = {
        "name": plan.name,
        "files": {place: text.decode(errors="replace") for place, text in plan.files.items()},
        "links": plan.links,
        "remove": plan.remove,
        "commands": plan.commands,
        "notes": plan.notes,
    }
    aside = "" if root == Path("/") else " (not with --root)"
    lines = [
        *(f"write {place} ({len(text)} bytes, mode {plan.modes[place]:o})" for place, text in plan.files.items()),
        *(f"link {place} -> {target}" for place, target in plan.links.items()),
        *(f"remove {place}" for place in plan.remove),
        *(f"run {' '.join(command)}{aside}" for command in plan.commands),
        *plan.notes,
    ]
    return answer(document, lines, as_json)


def _done(plan: Plan, changes: list[str], as_json: bool) -> int:
    return answer({"name": plan.name, "done": changes}, changes or ["nothing to change"], as_json)


def bundle(
    *,
    platform: Literal["aarch64", "x86_64"] = "aarch64",
    python: Literal["3.11", "3.12", "3.13"] = "3.11",
    role: Role = "camera",
    extra: list[str] | None = None,
    out: Path | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Collect the wheels that a board without a network needs, and a script that installs them there.

    Only packages that the role imports are included. Prints the installed size; more than 350 MB for a camera (without
    OAK) or 450 MB for a UAV is refused. On the board: sh install.sh

    Example: syncline bundle --platform aarch64 --python 3.11 --role camera --out camera-bundle

    Parameters
    ----------
    platform
        The board's architecture (`uname -m`).
    python
        The board's Python (`python3 --version`).
    role
        The agent that the board will run.
    extra
        Additional extras: oak, v4l2 (driver "usb"), video (driver "rtsp"), view; or a package, such as scipy for the
        detectors of people and vehicles. May be given several times.
    out
        Folder to write and copy to the board; by default named by version, role and platform.
    """
    from deploy.site.bundle import Target, default_folder, make_bundle

    target = Target(platform, python)
    made = make_bundle(role, target, out or default_folder(role, target), extra or ())
    document = {
        "role": role,
        "platform": platform,
        "python": python,
        "out": str(made.out),
        "carried_mb": round(made.carried_mb, 1),
        "installed_mb": round(made.installed_mb, 1),
        "wheels": {name: round(size / 1e6, 1) for name, size in sorted(made.sizes.items())},
    }
    largest = sorted(made.sizes.items(), key=lambda item: -item[1])[:5]
    largest_mb = ", ".join(f"{name.partition('-')[0]} {size / 1e6:.0f}" for name, size in largest)
    installed = f"{made.installed_mb:.0f} MB installed ({largest_mb}), {len(made.sizes)} wheels"
    lines = (
        f"{role}, {platform}, Python {python}: {installed}",
        f"{made.carried_mb:.0f} MB to carry over in {made.out}; there: sh install.sh",
    )
    return answer(document, lines, json)


def doctor(
    config: Path | None = None,
    /,
    *,
    role: Role | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
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
