"""`syncline camera`, `hub` and `record`: the agents, each from one configuration file."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from deploy.config import CameraConfig, HubConfig, RecorderConfig, effective_toml, load
from deploy.signals import stop_on_signals
from protocols.bus.settings import BusConfig
from protocols.errors import EXIT_DONE, EXIT_INPUT

PrintConfig = Annotated[bool, Parameter(negative="")]


def camera(config: Path, /, *, print_config: PrintConfig = False) -> int:
    """Run a camera agent: open the device, detect, publish time-stamped observations.

    Example: syncline camera cam0.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus], driver ("simulated" or "video") with its table, detector, rig.
    print_config
        Show the configuration with all defaults filled in, and stop.
    """
    settings = load(config, CameraConfig)
    if print_config:
        print(effective_toml(settings), end="")
        return EXIT_DONE
    from deploy.agents import start_camera

    return _with_bus(settings, lambda bus, stop: start_camera(settings, bus, stop))


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
    from deploy.agents import start_hub

    return _with_bus(settings, lambda bus, stop: start_hub(settings, bus, stop))


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
    from deploy.record import run_recorder

    def start(bus: Any, stop: Any) -> int:
        result = run_recorder(settings, bus, stop)
        print(f"recorded {result.messages} messages to {result.path}" + _more_parts(result.parts))
        if result.stopped:
            print(f"syncline: recording ended: {result.stopped}; the log is whole; make room", file=sys.stderr)
            return EXIT_INPUT
        return EXIT_DONE

    return _with_bus(settings, start)


def _more_parts(parts: int) -> str:
    return f" and {parts - 1} more parts" if parts > 1 else ""


def _with_bus(settings: Any, start: Any) -> int:
    """Open the bus, run until a signal, close it; a signal while opening is a clean end."""
    from protocols.bus.base import BusStopped
    from protocols.bus.zenoh_bus import open_bus

    stop = stop_on_signals()
    try:
        with open_bus(settings.site, settings.bus, stop=_told_waiting(stop, settings.bus)) as bus:
            return int(start(bus, stop))
    except BusStopped:
        return EXIT_DONE


def _told_waiting(stop: threading.Event, bus: BusConfig) -> Callable[[], bool]:
    """The stop condition that is asked while a client waits for its router; after 2 s it says so, once."""
    began, told = time.monotonic(), False

    def stopped() -> bool:
        nonlocal told
        if not told and time.monotonic() - began > 2.0:
            told = True
            print(f"syncline: waiting for a router at {', '.join(bus.endpoints()[0])}", file=sys.stderr, flush=True)
        return stop.is_set()

    return stopped
