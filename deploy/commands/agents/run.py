"""`syncline camera`, `uav`, `hub` and `record`: run an agent from its configuration file."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from deploy.agents.processes import stop_on_signals
from deploy.commands.common import PrintConfig, StatusJson, UnusedSeed, answer_config, check_seed, status_lines
from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig, SimulatedConfig
from deploy.config.file import load
from protocols.bus.settings import BusConfig
from protocols.core.errors import EXIT_BUG, EXIT_DONE, InputError

if TYPE_CHECKING:
    from deploy.agents.systemd_notify import Notifier

SimulatedSeed = Annotated[
    int | None, Parameter(help="Of the simulated world, instead of the configuration's; all its agents need the same.")
]
_PROGRESS_S = 5.0  # between two lines of an agent that waits


def camera(
    config: Path, /, *, print_config: PrintConfig = False, json: StatusJson = False, seed: SimulatedSeed = None
) -> int:
    """Run a camera agent: open the device, detect, and publish time-stamped observations.

    Example: syncline camera cam0.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus], driver ("simulated", "video", "usb", "picamera2", "rtsp", "oak" or "log") with its
        table, detector, [marker], rig.
    """
    settings = _seeded(load(config, CameraConfig), SimulatedConfig, seed)
    return _run(settings, print_config, json, "deploy.agents.assembly", "start_camera")


def uav(
    config: Path, /, *, print_config: PrintConfig = False, json: StatusJson = False, seed: SimulatedSeed = None
) -> int:
    """Run the UAV agent: track the car that a ground station selects, also out of view, and report it over MAVLink.

    Example: syncline uav drone.toml

    No command is sent to the vehicle unless [control] enables it.

    Parameters
    ----------
    config
        TOML file: id, site, [bus], rig, driver ("simulated", "video" or "oak") with its table, mount, [mavlink],
        [control], [video_out], [images].
    """
    from deploy.config.uav import SimulatedFlightConfig, UavConfig

    settings = _seeded(load(config, UavConfig), SimulatedFlightConfig, seed)
    return _run(settings, print_config, json, "deploy.agents.uav", "start_uav")


def hub(config: Path, /, *, print_config: PrintConfig = False, json: StatusJson = False, seed: UnusedSeed = 0) -> int:
    """Run the hub: collect the cameras' observations, estimate their clock offsets and poses, and publish them.

    Example: syncline hub hub.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus], rig (optional rig.toml), out (optional folder), window_s, interval_s.
    """
    return _run(load(config, HubConfig), print_config, json, "deploy.agents.assembly", "start_hub")


def record(
    config: Path, /, *, print_config: PrintConfig = False, json: StatusJson = False, seed: UnusedSeed = 0
) -> int:
    """Record all messages on the site's bus to an MCAP log.

    Example: syncline record recorder.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus], out (a .mcap file, or a folder for files named by start time), part_s, part_mb,
        keep_days, keep_mb, keep_free_mb, min_free_mb, foxglove.
    """
    return _run(load(config, RecorderConfig), print_config, json, "deploy.agents.recorder", "start_recorder")


def _seeded(settings: Any, kind: type[Any], seed: int | None) -> Any:
    """The settings with another seed of the simulated world. Raises InputError where there is none."""
    if seed is None:
        return settings
    check_seed(seed)
    if settings.driver != "simulated":
        raise InputError("--seed is of a simulated world", remedy='leave it out, or take driver = "simulated"')
    from msgspec.structs import replace

    return replace(settings, simulated=replace(settings.simulated or kind(), seed=seed))


def _run(settings: Any, print_config: bool, json: bool, module: str, start: str) -> int:
    """Run an agent from its configuration; ``start`` is imported late, so that errors in it are reported fast."""
    if print_config:
        return answer_config(settings, json)
    return _with_bus(settings, lambda *given: getattr(import_module(module), start)(settings, *given), json)


def _with_bus(settings: Any, start: Any, json: bool) -> int:
    """Open the bus, run until a signal arrives, and close the bus; a signal while opening is a clean end.

    If the bus fails, the process ends with one line and status 1, so that its supervisor restarts it.
    """
    from deploy.agents.health import Health
    from deploy.agents.malloc_tuning import limit_heap_growth
    from deploy.agents.startup_checks import Conditions, check_startup, role_of, serve_health
    from deploy.agents.systemd_notify import Notifier
    from protocols.bus.base import BusDead, BusStopped
    from protocols.bus.security.sender_identity import SenderCheckedBus
    from protocols.bus.transport.zenoh_bus import open_bus

    limit_heap_growth(release_large_blocks=isinstance(settings, HubConfig | RecorderConfig))
    check_startup(settings)
    stop = stop_on_signals()
    notifier = Notifier.from_environment()
    health = Health(site=settings.site, role=role_of(settings), agent=settings.id)
    try:
        with (
            serve_health(settings, health),
            status_lines(health.seen, health.report) if json else nullcontext(_progress_lines(health.seen)) as show,
            open_bus(settings.site, settings.bus, stop=_stop_condition(stop, settings.bus, notifier)) as bus,
        ):
            amend = Conditions(settings, bus.connected).amend
            guarded = SenderCheckedBus(bus, time.monotonic, amend=amend, seen=show, refused=health.refused)
            try:
                return int(start(guarded, stop, lambda: notifier.beat(ending=stop.is_set())))
            except BusDead as error:
                print(f"syncline: the bus has died: {error}; start this agent again", file=sys.stderr, flush=True)
                os._exit(EXIT_BUG)  # closing a session that has panicked may hang
    except BusStopped:
        return EXIT_DONE
    finally:
        notifier.stopping()


def _progress_lines(seen: Callable[[Any], None]) -> Callable[[Any], None]:
    """Passes statuses on; prints what an agent that ends waits for, and every few seconds what one that starts does."""
    printed, text = -_PROGRESS_S, ""

    def show(status: Any) -> None:
        nonlocal printed, text
        seen(status)
        now = time.monotonic()
        waits = status.state == "starting" and now - printed >= _PROGRESS_S
        if status.message != text and (waits or (status.state == "stopping" and status.role == "hub")):
            printed, text = now, status.message
            print(text, flush=True)

    return show


def _stop_condition(stop: threading.Event, bus: BusConfig, notifier: Notifier) -> Callable[[], bool]:
    """The stop condition that is polled while a client waits for its router; after 2 s it reports that, once."""
    began, warned = time.monotonic(), False

    def stopped() -> bool:
        nonlocal warned
        notifier.waiting(f"a router at {', '.join(bus.endpoints()[0])}")
        if not warned and time.monotonic() - began > 2.0:
            warned = True
            print(f"syncline: waiting for a router at {', '.join(bus.endpoints()[0])}", file=sys.stderr, flush=True)
        return stop.is_set()

    return stopped
