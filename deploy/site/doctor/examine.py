"""Which checks make sense for a machine or an agent, in the order in which one thing needs the other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deploy.site.doctor import agent as agents
from deploy.site.doctor import machine
from deploy.site.doctor.finding import Finding, missing, skip, wrong
from deploy.site.install import units
from deploy.site.rig_folder import role_of
from protocols.core.errors import InputError


def examine(file: Path | None, role: str | None = None) -> Iterator[Finding]:
    """All findings, each as soon as it is known. file: an agent's configuration; None = the machine alone."""
    yield machine.python()
    yield machine.cpu()
    if file is None:
        yield machine.packages(())
        yield machine.disk(Path.cwd())
        yield machine.clock(certificates=False)
        yield machine.crash("syncline-*")
        return
    kind = role or told_role(file)
    found, config = agents.configuration(file, kind)
    yield found
    if config is None:
        return
    driver = getattr(config, "driver", "")
    yield machine.packages((kind, driver))
    yield machine.disk(getattr(config, "out", None) or Path.cwd(), getattr(config, "min_free_mb", 0.0))
    yield machine.clock(certificates=config.bus.tls is not None)
    yield from _sight(config, driver)
    yield agents.certificates(config.bus, kind, config.id)
    yield agents.bus_path(config.bus, config.site, kind, config.id)
    yield agents.rights(config.bus, config.site, kind, config.id)
    if kind == "uav":
        yield _vehicle(config)
    yield machine.crash(f"syncline-{kind}-{config.id}.service")


def told_role(file: Path) -> str:
    """The role by the file's name, or by its folder's as `syncline install` makes it."""
    folder = file.absolute().parent.name.partition("-")[0]
    return folder if file.name == "config.toml" and folder in units.ROLES else role_of(file)


def _sight(config: Any, driver: str) -> Iterator[Finding]:
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
            return  # a whole flight, not only its camera
        config = CameraConfig(id=config.id, driver=config.driver, video=config.video, oak=config.oak)
    try:
        device = make_device(config, None)
    except InputError as error:
        yield missing("camera", error.what, error.remedy or "correct the configuration")
        return
    except ImportError as error:
        yield skip("camera", f"not tried: {error.name or error} is missing")
        return
    yield agents.camera(device)


def _vehicle(config: Any, patience_s: float = 3.0) -> Finding:
    try:
        from edge.mavlink.dialect import CAMERA, mavlink
        from edge.mavlink.link.connection import Link
        from edge.mavlink.link.transport import parse

        url = parse(config.mavlink.url)
    except InputError as error:
        return wrong("mavlink", error.what, error.remedy)
    # Unsigned: only whether somebody is there is asked. As the vehicle's camera and never as a ground station (255):
    # an autopilot that hears one, and then no more, takes it for a lost link and flies home.
    link = Link(url, system=None, component=CAMERA, allowed=("HEARTBEAT",))
    hello = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )
    try:
        return agents.mavlink(link, hello if url.kind == "udpout" else None, patience_s)
    finally:
        link.close()
