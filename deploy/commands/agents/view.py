"""`syncline view`: shows a rig in a browser, live or from a log."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deploy.commands.common import Flag, Json, UnusedSeed, answer, open_browser
from protocols.bus.settings import BusConfig
from protocols.core.errors import EXIT_BUG, EXIT_DONE, InputError
from protocols.core.files import read_toml

if TYPE_CHECKING:
    from hub.view.server import ViewServer


def view(
    source: Path | None = None,
    /,
    *,
    connect: tuple[str, ...] = (),
    site: str = "",
    port: int = 8080,
    listen: str = "127.0.0.1",
    token: str = "",
    look_only: Flag = False,
    browser: Flag = False,
    rerun: Path | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Show a rig in a browser: cameras, trajectories, uncertainty, and missing coverage of each camera.

    Without a source, or with an agent's TOML file (its site and [bus] table), it shows the live bus. A .mcap log is
    played with a timeline. A folder that `syncline calibrate` wrote, or its calibration.toml, shows its cameras and
    trajectory. Prints the address to open.

    If it serves other machines (--listen), the address contains a token that is required for all access. The
    connection is not encrypted: over a shared network use a tunnel, ssh -L 8080:127.0.0.1:8080 HOST.

    Example: syncline view --connect tcp/192.168.1.5:7447

    Example: syncline view demo-out/demo.mcap

    Example: syncline view out --rerun out.rrd

    Parameters
    ----------
    source
        An agent's TOML file, a .mcap log, or the folder of a calibration. Default: the bus on this machine.
    connect
        Endpoints of the site's router or agents.
    site
        The site to show. Default: the file's, or "local".
    port
        Port of the page; 0 = any free port.
    listen
        Address to serve on; 0.0.0.0 = every interface.
    token
        Access token, instead of a new one each time.
    look_only
        Read-only: all buttons are disabled.
    browser
        Also open the browser.
    rerun
        Write a .rrd file for the rerun viewer from a log or a calibration instead of serving (needs rerun-sdk).
    """
    live = source is None or (source.suffix == ".toml" and not _is_calibration(source))
    recording = None if source is None or live else _recording(source)
    if rerun is not None:
        if recording is None:
            raise InputError("--rerun goes with a log or a calibration", remedy="name a .mcap file or a folder")
        from deploy.logs.rerun_export import write_rrd

        count = write_rrd(recording, rerun)
        print(f"{rerun}: {count} messages")
        return EXIT_DONE
    if recording is not None and connect:
        raise InputError("--connect goes with the bus, not with a recording", remedy="leave one of the two out")
    serve = _server(listen, port, token, look_only)
    from deploy.agents.processes import stop_on_signals

    if recording is not None:
        from hub.view.server import run_replay

        def serve_replay(player: Any) -> ViewServer:
            return _announce(serve(player), browser, json)

        run_replay(recording, serve_replay, stop_on_signals())
        return EXIT_DONE
    settings, wanted_site = _bus(source, connect, site)
    return _serve_live(settings, wanted_site, serve, browser, json)


def _serve_live(settings: BusConfig, site: str, serve: Callable[[Any], ViewServer], browser: bool, json: bool) -> int:
    from deploy.agents.processes import stop_on_signals
    from hub.view.server import run_view
    from protocols.bus.base import BusDead, BusStopped
    from protocols.bus.transport.zenoh_bus import open_bus

    stop = stop_on_signals()
    shown = _announce(serve(None), browser, json)
    try:
        with open_bus(site, settings, stop=stop.is_set) as bus:
            run_view(bus, shown, stop)
    except BusStopped:
        pass
    except BusDead as error:
        print(f"syncline: the bus has died: {error}; start the view again", file=sys.stderr)
        return EXIT_BUG
    finally:
        shown.close()
    return EXIT_DONE


def _is_calibration(file: Path) -> bool:
    """Whether a TOML file has the pose of a camera, which no agent's has. Raises InputError."""
    tables = read_toml(file, "configuration")[0].values()
    return any(isinstance(table, dict) and "translation" in table for table in tables)


def _recording(source: Path) -> Any:
    """The recording at a path. Raises InputError."""
    if not source.exists():
        raise InputError("there is no such file or folder", file=source, remedy="name a log, a folder or a TOML file")
    from hub.view.player import CalibrationRecording, LogRecording

    if source.suffix == ".toml" or (source.is_dir() and (source / "calibration.toml").exists()):
        return CalibrationRecording(source)
    if source.suffix == ".mcap" or (source.is_dir() and any(source.glob("*.mcap"))):
        log = LogRecording(source)
        if log.damage:
            print(f"syncline: {source}: damaged: {log.damage}; only its intact part is shown", file=sys.stderr)
        return log
    remedy = "name a .mcap log, a folder with calibration.toml, or an agent's .toml file"
    raise InputError("neither a log nor a calibration", file=source, remedy=remedy)


def _bus(source: Path | None, connect: tuple[str, ...], site: str) -> tuple[BusConfig, str]:
    """The bus configuration and the site to show. Raises InputError."""
    if source is None:
        if not connect:
            return BusConfig(), site or "local"
        config = BusConfig(mode="client", connect=connect)
        config.endpoints()
        return config, site or "local"
    from deploy.config.agents import ViewConfig
    from deploy.config.file import load

    settings = load(source, ViewConfig)
    bus = _local_bus(settings.bus) if not connect else BusConfig(mode="client", connect=connect)
    bus.endpoints()
    return bus, site or settings.site


def _local_bus(bus: BusConfig) -> BusConfig:
    """The bus configuration for a second process on an agent's machine: it connects to where the agent listens."""
    if bus.mode == "router" or (bus.listen and not bus.connect):
        announced = bus.endpoints()[1]
        here = tuple(re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", place) for place in announced)
        return BusConfig(mode="client" if bus.mode == "router" else "peer", connect=here, tls=bus.tls)
    return bus


def _server(listen: str, port: int, token: str, look_only: bool) -> Callable[[Any], ViewServer]:
    if token and len(token) < 12:
        raise InputError("--token is too short to keep anyone out", remedy="give 12 letters or more, or leave it out")
    if not token.isascii() or any(letter in token for letter in "; ,&#+%") or not token.isprintable():
        raise InputError("--token may not stand in an address", remedy="use letters, digits, '-' and '_'")
    try:
        from hub.view.server import ViewServer
    except ImportError:
        raise InputError(
            "the view needs viser",
            remedy='pip install "syncline[view]"; without a network: the bundle of a hub, or --extra view of another',
        ) from None
    return lambda player: ViewServer(listen, port, token=token, look_only=look_only, player=player)


def _announce(shown: ViewServer, browser: bool, json: bool) -> ViewServer:
    """Print the address of the page, and open a browser if requested."""
    answer({"address": shown.address, "port": shown.port}, [f"open {shown.address}   (Ctrl-C ends it)"], json)
    if browser:
        open_browser(shown.address)
    return shown
