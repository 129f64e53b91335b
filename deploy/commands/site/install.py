"""`syncline install` and `uninstall`: agents as systemd services."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from deploy.commands.common import Flag, Json, Role, answer
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
