"""Installation and removal plans: files to write and commands to run, complete and checked before any change."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from deploy.config.file import KnownName, Source, load
from deploy.site.install import units
from protocols.core.errors import InputError, Refused
from protocols.core.files import read_toml, write_private
from protocols.core.names import key_segment
from protocols.session.rig import read_rig

CONFIG, STATE, UNITS = "/etc/syncline", "/var/lib/syncline", "/etc/systemd/system"
SHARED = {
    "/etc/sysusers.d/syncline.conf": units.sysusers,
    "/etc/tmpfiles.d/syncline.conf": units.tmpfiles,
    "/etc/udev/rules.d/70-syncline.rules": units.udev_rules,
}
_SIGNING_TIMES = ("mavlink", "key_state")
_CREDENTIAL_BYTES = 256 * 1024
"""systemd allows 1 MB of credentials per unit; a larger file is read from its place in /etc/syncline."""


@dataclass(slots=True)
class Plan:
    """Files and links by their path in the target system, file modes, and commands to run afterwards."""

    name: str
    files: dict[str, bytes] = field(default_factory=dict)
    modes: dict[str, int] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    remove: list[str] = field(default_factory=list)
    commands: list[list[str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, place: str, content: bytes | str, mode: int = 0o644) -> None:
        """Add a file to write."""
        self.files[place] = content.encode() if isinstance(content, str) else content
        self.modes[place] = mode


def config_type(role: str) -> type[msgspec.Struct]:
    """The configuration struct of a role. Raises InputError for an unknown role."""
    from deploy.config import agents

    if role == "uav":
        from deploy.config.uav import UavConfig

        return UavConfig
    kinds: dict[str, type[msgspec.Struct]] = {
        "camera": agents.CameraConfig,
        "hub": agents.HubConfig,
        "recorder": agents.RecorderConfig,
        "router": agents.RouterConfig,
    }
    if role not in kinds:
        raise InputError(f"there is no role {role!r}", remedy=f"use one of {', '.join(units.ROLES)}")
    return kinds[role]


def plan_install(role: str, file: Path, program: str | None = None) -> Plan:
    """Read and check everything that the installation of an agent needs.

    program: path of `syncline` on the target; None = that of the running program. Raises InputError for a configuration
    that the agent would refuse, and for paths that a service cannot access.
    """
    kind = config_type(role)
    config = load(file, kind)
    table = read_toml(file)[0]
    # A unit's name allows ASCII letters, digits and a few marks; `%` is an escape character in unit files.
    name = f"{role}-{key_segment(getattr(config, 'id', role)).replace('%', '.')}"
    plan = Plan(name)
    folder = f"{CONFIG}/{name}"
    credentials = [("config.toml", f"{folder}/config.toml")]
    taken = {"config.toml"}
    for path, value in _paths(config):
        own = _get(table, path)
        if own is None and path != ("out",):
            continue
        if path == ("out",):
            _set(table, path, _state_path(own, name, file))
        elif path == _SIGNING_TIMES:
            continue
        elif isinstance(value, Source):
            _set(table, path, _source(value, file, path))
        else:
            place, content = _referenced(value, file, path, folder, taken)
            secret = value.suffix in (".key", ".pem") or "key" in value.stem
            plan.add(place, content, 0o600 if secret else 0o640)
            base = place.rpartition("/")[2]
            small = len(content) <= _CREDENTIAL_BYTES
            if small:
                credentials.append((base, place))
            else:
                plan.modes[place] = 0o644
            _set(table, path, base if small else place)
    if _get(table, ("mavlink", "key")) is not None:
        # Signing time stamps are written at run time, and the folder of the key is read-only for the service.
        _set(table, _SIGNING_TIMES, f"{STATE}/{name}/signing-times.json")
    if getattr(config, "rig", None) is not None:
        read_rig(config.rig)  # type: ignore[attr-defined]
    runs = program or _running_program()
    _check_program(runs, given=program is not None)
    plan.add(f"{folder}/config.toml", tomli_w.dumps(table), 0o640)
    unit = f"syncline-{name}.service"
    plan.add(f"{UNITS}/{unit}", units.service(name, role, runs, credentials))
    for place, text in SHARED.items():
        plan.add(place, text())
    plan.links[f"{UNITS}/multi-user.target.wants/{unit}"] = f"../{unit}"
    plan.commands = [
        ["systemd-sysusers", "/etc/sysusers.d/syncline.conf"],
        ["systemd-tmpfiles", "--create", "/etc/tmpfiles.d/syncline.conf"],
        ["udevadm", "control", "--reload"],
        ["udevadm", "trigger", "--subsystem-match=video4linux", "--subsystem-match=usb"],
        ["systemctl", "daemon-reload"],
        ["systemctl", "restart", unit],
    ]
    return plan


def plan_uninstall(names: list[str], root: Path, purge: bool) -> Plan:
    """Plan the removal of the named agents (``camera-cam0``), or of all. State is never removed.

    Raises InputError for an agent that is not installed.
    """
    folder = _in(root, UNITS)
    there = sorted(
        path.name.removeprefix("syncline-").removesuffix(".service") for path in folder.glob("syncline-*.service")
    )
    for name in names:
        if name not in there:
            raise InputError(f"{name} is not installed", remedy=f"installed: {', '.join(there) or 'nothing'}")
    gone = names or there
    plan = Plan(", ".join(gone))
    for name in gone:
        unit = f"syncline-{name}.service"
        plan.commands.append(["systemctl", "disable", "--now", unit])
        plan.remove += [f"{UNITS}/multi-user.target.wants/{unit}", f"{UNITS}/{unit}"]
        if purge:
            plan.remove.append(f"{CONFIG}/{name}")
    if set(gone) >= set(there):
        plan.remove += list(SHARED)
        if purge:
            plan.remove.append(CONFIG)
    plan.remove = [place for place in plan.remove if os.path.lexists(_in(root, place))]
    if not purge and (kept := [name for name in gone if _in(root, f"{CONFIG}/{name}").exists()]):
        plan.notes.append(f"kept: {', '.join(f'{CONFIG}/{name}' for name in kept)} (--purge takes them away)")
    if _in(root, STATE).exists():
        plan.notes.append(f"kept: {STATE} with all recordings")
    return plan


def apply(plan: Plan, root: Path) -> list[str]:
    """Carry out a plan below ``root``; returns descriptions of the changes. Unchanged files are not rewritten.

    Files are replaced atomically. Raises InputError if the target cannot be written, Refused if a command fails.
    Commands are executed on the running system only.
    """
    changes: list[str] = []
    live = root == Path("/") and Path("/run/systemd/system").is_dir()
    now: Path = root
    try:
        if plan.remove and live:
            _run([command for command in plan.commands if command[0] == "systemctl"], changes)
        for place in plan.remove:
            now = _in(root, place)
            if now.is_dir() and not now.is_symlink():
                shutil.rmtree(now)
            else:
                now.unlink(missing_ok=True)
            changes.append(f"removed {place}")
        for place, content in plan.files.items():
            now = _in(root, place)
            if now.is_file() and now.read_bytes() == content and now.stat().st_mode & 0o777 == plan.modes[place]:
                continue
            now.parent.mkdir(parents=True, exist_ok=True)
            write_private(now, content, plan.modes[place])
            changes.append(f"wrote {place}")
        for place, target in plan.links.items():
            now = _in(root, place)
            if now.is_symlink() and str(now.readlink()) == target:
                continue
            now.parent.mkdir(parents=True, exist_ok=True)
            now.unlink(missing_ok=True)
            now.symlink_to(target)
            changes.append(f"linked {place}")
    except OSError as error:
        remedy = "run it as root (sudo), or give --root of an image that you may write"
        raise InputError(f"cannot be changed: {error.strerror}", file=now, remedy=remedy) from None
    if live:
        _run(_commands(plan, changed=bool(changes)), changes)
    elif root == Path("/") and plan.files:
        changes.append("systemd does not run here: the agent starts at the next boot of a machine that has it")
    return changes


def _commands(plan: Plan, *, changed: bool) -> list[list[str]]:
    """Commands to run after the files are written; an agent whose files have not changed is not restarted."""
    if not plan.files:
        return [["systemctl", "daemon-reload"]] if plan.remove else []
    if changed:
        return plan.commands
    return [
        ["systemctl", "start", *command[2:]] for command in plan.commands if command[:2] == ["systemctl", "restart"]
    ]


def _run(commands: list[list[str]], changes: list[str]) -> None:
    for command in commands:
        if shutil.which(command[0]) is None:
            changes.append(f"left out: {' '.join(command)} ({command[0]} is not here)")
            continue
        ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        if ended.returncode:
            lines = (ended.stderr or ended.stdout).strip().splitlines()
            if (
                command[0] == "udevadm"
            ):  # a container, or a system without udev: its rules are for names of cameras only
                changes.append(f"left out: {' '.join(command)} ({lines[-1] if lines else 'udev does not run here'})")
                continue
            raise Refused(f"`{' '.join(command)}` failed: {lines[-1] if lines else f'status {ended.returncode}'}")
        changes.append(f"ran {' '.join(command)}")


def _in(root: Path, place: str) -> Path:
    return root / place.lstrip("/")


def _paths(config: msgspec.Struct) -> Iterator[tuple[tuple[str, ...], Path | Source]]:
    """Every file that a configuration refers to, with its key path."""
    for item in msgspec.structs.fields(config):
        value = getattr(config, item.name)
        if isinstance(value, msgspec.Struct):
            yield from (((item.encode_name, *path), inner) for path, inner in _paths(value))
        elif isinstance(value, Path | Source):
            yield (item.encode_name,), value
        elif isinstance(value, KnownName) and value != "last":
            yield (item.encode_name,), Path(value)
        elif value is None and item.name == "out":
            yield ("out",), Path()


def _get(table: dict[str, Any], path: tuple[str, ...]) -> Any:
    for key in path:
        if not isinstance(table, dict) or key not in table:
            return None
        table = table[key]
    return table


def _set(table: dict[str, Any], path: tuple[str, ...], value: str) -> None:
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = value


def _state_path(given: str | None, name: str, file: Path) -> str:
    """The output path of an agent: below its own state folder, the only one that it may write to."""
    state = f"{STATE}/{name}"
    if given is None:
        return state
    if Path(given).is_absolute() or given.startswith("~") or ".." in Path(given).parts:
        if Path(given).is_relative_to(state) and ".." not in Path(given).parts:
            return given
        raise InputError(
            f"out = {given!r}: a service may write below {state} only",
            file=file,
            remedy=f"leave out away or make it relative, and mount a larger disk at {STATE}",
        )
    return str(Path(state) / given)


def _source(value: Source, file: Path, path: tuple[str, ...]) -> str:
    if "://" in value or value.isdigit() or value.startswith("/dev/"):
        return str(value)
    place = Path(value).resolve()
    if any(place.is_relative_to(home) for home in ("/home", "/root", "/tmp")):
        raise InputError(
            f"{'.'.join(path)} = {str(place)!r}: a service may not read /home, /root and /tmp",
            file=file,
            remedy="put it elsewhere, for example below /srv",
        )
    return str(place)


def _referenced(value: Path, file: Path, path: tuple[str, ...], folder: str, taken: set[str]) -> tuple[str, bytes]:
    """(path, content) of a file that is installed with the configuration."""
    key = ".".join(path)
    try:
        content = value.read_bytes()
    except OSError as error:
        raise InputError(
            f"{key} = {str(value)!r} cannot be read: {error.strerror}", file=file, remedy="correct the path"
        ) from None
    base = value.name if value.name not in taken else f"{'-'.join(path)}-{value.name}"
    taken.add(base)
    return f"{folder}/{base}", content


def _running_program() -> str:
    folder = Path(sys.executable).parent
    # Of two versions side by side, the link to the present one: an update changes only that.
    current = folder.parent.with_name("current")
    if current.is_symlink() and current.resolve() == folder.parent.resolve():
        folder = current / folder.name
    beside = folder / "syncline"
    found = str(beside) if beside.is_file() else shutil.which("syncline")
    if not found:
        raise InputError("the program `syncline` is not found", remedy="install it (pip install .), or give --program")
    return found


def _check_program(program: str, given: bool) -> None:
    if not program.startswith("/"):
        raise InputError(f"--program {program!r} is not an absolute path", remedy="give it as it is on the target")
    if any(program.startswith(f"{home}/") for home in ("/home", "/root", "/tmp", "/run/user")):
        where = "--program" if given else "syncline"
        raise InputError(
            f"{where} {program} lies where a service may not read (/home, /root, /tmp)",
            remedy="make its environment in /opt/syncline, or give --program with its path on the target",
        )
