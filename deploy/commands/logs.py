"""`syncline replay` and `info`: what to do with a log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from protocols.errors import EXIT_DONE, InputError


def info(path: Path, /, *, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Show what is in a log (topics, counts, times, damage) or in a session folder.

    Example: syncline info demo-out/demo.mcap

    Parameters
    ----------
    path
        A .mcap log or a session folder.
    json
        Print it as JSON.
    """
    if path.is_dir():
        from deploy.session_info import print_session

        print_session(path, as_json=json)
        return EXIT_DONE
    from dataclasses import asdict

    from deploy.info import as_table, describe_log

    description = describe_log(path)
    if json:
        import json as json_module

        print(json_module.dumps(asdict(description)))
        return EXIT_DONE
    from deploy.outputs import wide_console

    wide_console(markup=True).print(as_table(description))
    return EXIT_DONE


def replay(
    log: Path,
    /,
    *,
    rate: str = "1",
    start: float = 0.0,
    topics: list[str] | None = None,
    site: str = "local",
    connect: list[str] | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Publish the messages of a log onto the bus again, as they came.

    Example: syncline replay demo-out/demo.mcap --rate 2

    Parameters
    ----------
    log
        The .mcap log.
    rate
        1 = as recorded, 2 = twice as fast, max = as fast as possible.
    start
        Seconds from the log's beginning to leave out.
    topics
        Only these topics of the catalogue; default: all.
    site
        Site to publish on.
    connect
        Endpoints of the bus, such as tcp/127.0.0.1:7447.
    json
        Print the count as JSON.
    """
    try:
        speed = 0.0 if rate == "max" else float(rate)
    except ValueError:
        speed = -1.0
    if not (speed > 0.0 or rate == "max") or speed > 1e6:
        raise InputError(f"--rate {rate!r} is not a speed", remedy="give 1, 2, 0.5, … or max")
    if start < 0.0:
        raise InputError("--start is negative", remedy="give seconds from the log's beginning")
    from deploy.info import describe_log
    from deploy.replay import replay as play
    from deploy.signals import stop_on_signals
    from protocols.bus.base import BusStopped
    from protocols.bus.settings import BusConfig
    from protocols.bus.zenoh_bus import open_bus

    stop = stop_on_signals()
    try:
        with open_bus(site, BusConfig(connect=tuple(connect or ())), stop=stop.is_set) as bus:
            count = play(log, bus, rate=speed, start_s=start, topics=topics, stop=stop)
    except BusStopped:
        count = 0
    damage = describe_log(log).damage
    if damage:
        print(f"syncline: {log}: damaged: {damage}; only its good part was played", file=sys.stderr)
    print(f'{{"published": {count}}}' if json else f"{count} messages published")
    return EXIT_DONE
