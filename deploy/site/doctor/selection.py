"""Selection of the checks for a machine or an agent, in the order of their dependencies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from deploy.site.doctor import agent as agents
from deploy.site.doctor import autopilot, machine
from deploy.site.doctor.check_result import CheckResult, skip, unavailable
from deploy.site.install import units
from deploy.site.rig_folder import role_of
from protocols.core.errors import InputError


def run_checks(file: Path | None, role: str | None = None) -> Iterator[CheckResult]:
    """Yield the result of each check as soon as it is known. file: an agent's configuration; None = machine only.

    A check that cannot be made, as of a folder that this user may not read, is one failed line, and the others go on.
    """
    yield machine.python()
    yield from _one("cpu", machine.cpu)
    if file is None:
        yield machine.packages(())
        yield from _one("disk", lambda: machine.disk(Path.cwd()))
        yield machine.clock(certificates=False)
        yield from _one("last crash", lambda: machine.crash("syncline-*"))
        return
    kind = role or role_from_path(file)
    found, config = agents.configuration(file, kind)
    yield found
    if config is None:
        return
    driver = getattr(config, "driver", "")
    yield machine.packages((kind, driver))
    out, least_mb = getattr(config, "out", None) or Path.cwd(), getattr(config, "min_free_mb", 0.0)
    yield from _one("disk", lambda: machine.disk(out, least_mb))
    yield machine.clock(certificates=config.bus.tls is not None)
    yield from _all("camera", lambda: _check_camera(config, driver))
    yield from _one("certificates", lambda: agents.certificates(config.bus, kind, config.id))
    yield from _one("bus", lambda: agents.bus_path(config.bus, config.site, kind, config.id))
    yield from _one("access rules", lambda: agents.access_rights(config.bus, config.site, kind, config.id))
    yield from _one("agents", lambda: agents.others(config.bus, config.site, kind))
    if kind == "uav":
        yield from _all("mavlink", lambda: autopilot.check(config))
    yield from _one("health", lambda: agents.running_agent(config))
    yield from _one("last crash", lambda: machine.crash(f"syncline-{kind}-{config.id}.service"))


def _one(name: str, check: Callable[[], CheckResult]) -> Iterator[CheckResult]:
    return _all(name, lambda: iter((check(),)))


def _all(name: str, checks: Callable[[], Iterator[CheckResult]]) -> Iterator[CheckResult]:
    try:
        yield from checks()
    except (OSError, InputError) as error:
        yield agents.guarded(name, error)


def role_from_path(file: Path) -> str:
    """The role by the file's name, or by its folder's name as `syncline install` creates it."""
    folder = file.absolute().parent.name.partition("-")[0]
    return folder if file.name == "config.toml" and folder in units.ROLES else role_of(file)


def _check_camera(config: Any, driver: str) -> Iterator[CheckResult]:
    if not driver:
        return
    if driver == "oak" and not (config.oak and config.oak.device):
        yield machine.oak_usb()
    source = str(config.video.source) if driver == "video" and config.video else ""
    if driver == "usb":
        source = str(config.usb.device) if config.usb else "/dev/video0"
    if source.startswith("/dev/") or source.isdecimal():
        yield machine.usb(source)
    from deploy.agents.assembly import make_device
    from deploy.config.agents import CameraConfig

    if not isinstance(config, CameraConfig):
        if driver == "simulated":
            return  # a simulated flight cannot be started only for its camera
        config = CameraConfig(id=config.id, driver=config.driver, video=config.video, oak=config.oak)
    try:
        device = make_device(config, None)
    except InputError as error:
        yield unavailable("camera", error.what, error.remedy or "correct the configuration")
        return
    except ImportError as error:
        yield skip("camera", f"not tried: {error.name or error} is missing")
        return
    yield agents.camera(device)
