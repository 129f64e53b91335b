"""`syncline camera`, `hub` and `record`: the agents, each from one configuration file."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from deploy.agents.signals import stop_on_signals
from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig, effective_toml, load
from protocols.bus.settings import BusConfig
from protocols.core.errors import EXIT_BUG, EXIT_DONE, EXIT_INPUT

if TYPE_CHECKING:
    from deploy.agents.systemd_notify import Notifier

PrintConfig = Annotated[bool, Parameter(negative="")]


def camera(config: Path, /, *, print_config: PrintConfig = False) -> int:
    """Run a camera agent: open the device, detect, publish time-stamped observations.

    Example: syncline camera cam0.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus], driver ("simulated", "video", "usb", "picamera2", "rtsp", "oak" or "log") with its
        table, detector, [marker], rig.
    print_config
        Show the configuration with all defaults filled in, and stop.
    """
    settings = load(config, CameraConfig)
    if print_config:
        print(effective_toml(settings), end="")
        return EXIT_DONE

    def start(bus: Any, stop: Any, beat: Any) -> int:
        from deploy.agents.assembly import start_camera  # a refusal does not wait for it

        return start_camera(settings, bus, stop, beat)

    return _with_bus(settings, start)


def uav(config: Path, /, *, print_config: PrintConfig = False) -> int:
    """Run the UAV agent: follow the car that a ground station selects, also out of the picture, and tell it by MAVLink.

    Example: syncline uav drone.toml

    Nothing is commanded to the vehicle unless [control] switches it on.

    Parameters
    ----------
    config
        TOML file: id, site, [bus], rig, driver ("simulated", "video" or "oak") with its table, mount, [mavlink],
        [control], [video_out], [images].
    print_config
        Show the configuration with all defaults filled in, and stop.
    """
    from deploy.config.uav import UavConfig

    settings = load(config, UavConfig)
    if print_config:
        print(effective_toml(settings), end="")
        return EXIT_DONE
    from deploy.agents.uav import start_uav

    return _with_bus(settings, lambda bus, stop, beat: start_uav(settings, bus, stop, beat))


def hub(config: Path, /, *, print_config: PrintConfig = False) -> int:
    """Run the hub: gather what the cameras see, find when they fired and where they stand, publish it.

    Example: syncline hub hub.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus], rig (optional rig.toml), out (optional folder), window_s, interval_s.
    print_config
        Show the configuration with all defaults filled in, and stop.
    """
    settings = load(config, HubConfig)
    if print_config:
        print(effective_toml(settings), end="")
        return EXIT_DONE

    def start(bus: Any, stop: Any, beat: Any) -> int:
        from deploy.agents.assembly import start_hub

        return start_hub(settings, bus, stop, beat)

    return _with_bus(settings, start)


def record(config: Path, /, *, print_config: PrintConfig = False) -> int:
    """Record everything on the site's bus into an MCAP log.

    Example: syncline record recorder.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus], out (a .mcap file, or a folder for files named by time), part_s, part_mb,
        min_free_mb, foxglove.
    print_config
        Show the configuration with all defaults filled in, and stop.
    """
    settings = load(config, RecorderConfig)
    if print_config:
        print(effective_toml(settings), end="")
        return EXIT_DONE
    from deploy.agents.recorder_commands import record_as_asked

    def start(bus: Any, stop: Any, beat: Any) -> int:
        result = record_as_asked(settings, bus, stop, beat=beat, tell=lambda line: print(line, flush=True))
        print(f"recorded {result.messages} messages to {result.path}" + _more_parts(result.parts))
        if result.stopped:
            print(f"syncline: recording ended: {result.stopped}; the log is whole; make room", file=sys.stderr)
            return EXIT_INPUT
        return EXIT_DONE

    return _with_bus(settings, start)


def _more_parts(parts: int) -> str:
    return f" and {parts - 1} more parts" if parts > 1 else ""


def _with_bus(settings: Any, start: Any) -> int:
    """Open the bus, run until a signal, close it; a signal while opening is a clean end.

    A bus that has died ends the process with one line and status 1, for its supervisor to start it again.
    """
    from deploy.agents.health import Health
    from deploy.agents.malloc_tuning import steady_heap
    from deploy.agents.startup_checks import checked, serve_health
    from deploy.agents.systemd_notify import Notifier
    from protocols.bus.base import BusDead, BusStopped
    from protocols.bus.security.sender_identity import GuardedBus
    from protocols.bus.transport.zenoh_bus import open_bus

    steady_heap(give_back=isinstance(settings, HubConfig | RecorderConfig))
    checked(settings)
    stop = stop_on_signals()
    notifier = Notifier.from_environment()
    health = Health()
    try:
        with (
            serve_health(settings, health),
            open_bus(settings.site, settings.bus, stop=_told_waiting(stop, settings.bus, notifier)) as bus,
        ):
            guarded = GuardedBus(bus, time.monotonic, seen=health.seen, refused=health.refused)
            try:
                return int(start(guarded, stop, lambda: notifier.beat(ending=stop.is_set())))
            except BusDead as error:
                print(f"syncline: the bus has died: {error}; start this agent again", file=sys.stderr, flush=True)
                os._exit(EXIT_BUG)  # closing a session that has panicked may hang
    except BusStopped:
        return EXIT_DONE
    finally:
        notifier.stopping()


def _told_waiting(stop: threading.Event, bus: BusConfig, notifier: Notifier) -> Callable[[], bool]:
    """The stop condition that is asked while a client waits for its router; after 2 s it says so, once."""
    began, told = time.monotonic(), False

    def stopped() -> bool:
        nonlocal told
        notifier.waiting(f"a router at {', '.join(bus.endpoints()[0])}")
        if not told and time.monotonic() - began > 2.0:
            told = True
            print(f"syncline: waiting for a router at {', '.join(bus.endpoints()[0])}", file=sys.stderr, flush=True)
        return stop.is_set()

    return stopped
