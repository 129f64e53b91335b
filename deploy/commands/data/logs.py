"""`syncline replay`, `recover` and `info`: commands for recorded logs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from deploy.commands.common import Flag, Json, UnusedSeed, answer
from protocols.core.errors import EXIT_DONE, EXIT_REFUSED, InputError


def info(path: Path, /, *, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Show the contents of a log (topics, counts, times, damage) or of a session folder.

    Example: syncline info demo-out/demo.mcap

    Parameters
    ----------
    path
        A .mcap log, the folder or the first part of a log in several files, or a session folder.
    """
    from protocols.log.read.session import is_log

    if path.is_dir() and not is_log(path):
        from deploy.offline.session_info import print_session

        print_session(path, as_json=json)
        return EXIT_DONE
    from dataclasses import asdict

    from deploy.logs.info import as_table, describe_log

    description = describe_log(path)
    if json:
        return answer(asdict(description), (), json)
    from deploy.offline.outputs import wide_console

    wide_console(markup=True).print(as_table(description))
    return EXIT_DONE


def recover(log: Path, /, *, out: Path, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Recover a log that is damaged, truncated or was never closed, and report what was lost.

    Example: syncline recover flight.mcap --out fixed.mcap

    The result is read back with all checksums before it is renamed to --out. Exit status 3 if no message is intact.

    Parameters
    ----------
    log
        The .mcap log; the folder or the first part of a log in several files, which are merged.
    out
        The new log; must not exist.
    """
    from protocols.log.read.recovery import recover as make_whole

    recovery = make_whole(log, out)
    from dataclasses import asdict

    parts = f" from {recovery.parts} parts" if recovery.parts > 1 else ""
    lines = [
        f"{recovery.path}: {recovery.messages} messages, {recovery.duration_s:.1f} s{parts}, "
        f"{recovery.bytes / 1e6:.2f} MB; read back and verified"
    ]
    if recovery.damage:
        lines.append(f"damage: {recovery.damage}")
    lines += [f"lost: {count} messages of {key}" for key, count in recovery.missing.items()]
    if recovery.skipped_bytes:
        lines.append(f"lost: {recovery.skipped_bytes} bytes that are no records")
    if recovery.cut:
        when = "at the end (a recorder does so twice a second)"
        lines.append(f"lost: what its writer had not yet brought to the disk {when}")
    if recovery.foreign:
        lines.append(f"left out: {recovery.foreign} messages of channels that are not Syncline's")
    if not recovery.damage and not recovery.missing:
        lines.append("nothing was lost")
    return answer(asdict(recovery), lines, json)


def replay(
    log: Path,
    /,
    *,
    rate: str = "1",
    start: float = 0.0,
    loop: Flag = False,
    topics: Annotated[list[str] | None, Parameter(consume_multiple=True, negative="")] = None,
    compare: Path | None = None,
    tolerance: list[str] | None = None,
    through: Literal["hub", "uav"] | None = None,
    out: Path | None = None,
    calibration: Path | None = None,
    site: str = "local",
    connect: list[str] | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Publish the messages of a log on the bus at their recorded times, or compare two logs.

    Example: syncline replay demo-out/demo.mcap --rate 2

    Example: syncline replay a.mcap --compare b.mcap --topics track --tolerance track.position=1e-6

    Example: syncline replay demo-out/demo.mcap --through hub --out again.mcap

    A comparison reports count, order and every field beyond its tolerance; exit status 3 if the logs differ.

    Parameters
    ----------
    log
        The .mcap log.
    rate
        1 = as recorded, 2 = twice as fast, max = as fast as possible.
    start
        Seconds to skip at the beginning of the log.
    loop
        Start again at the end, until stopped; every round has new boot ids, as if the agents had been restarted.
    topics
        Only these topics of the catalogue, one or several; default: all.
    compare
        Publish nothing; compare with this log instead.
    tolerance
        topic.field=largest difference in the field's own unit, for --compare; default: 0 for every field.
    through
        Publish nothing; pass the log through this estimator, without clock or bus, and write its output to --out. uav
        needs a log with images.
    out
        The new log for --through; must not exist.
    calibration
        For --through hub: a calibration.toml to track with, instead of calibrating.
    site
        Site to publish on.
    connect
        Endpoints of the bus, such as tcp/127.0.0.1:7447.
    """
    try:
        speed = 0.0 if rate == "max" else float(rate)
    except ValueError:
        speed = -1.0
    if not (speed > 0.0 or rate == "max") or speed > 1e6:
        raise InputError(f"--rate {rate!r} is not a speed", remedy="give 1, 2, 0.5, … or max")
    if tolerance and compare is None:
        raise InputError("--tolerance goes with --compare", remedy="leave it out, or give --compare OTHER.mcap")
    if (through is None) != (out is None):
        raise InputError("--through and --out go together", remedy="e.g. --through hub --out again.mcap")
    if calibration is not None and through != "hub":
        raise InputError("--calibration goes with --through hub", remedy="leave it out, or give --through hub")
    if (through or compare) and (rate, start, loop, connect) != ("1", 0.0, False, None):
        raise InputError(
            f"--{'through' if through else 'compare'} publishes nothing",
            remedy="leave out --rate, --start, --loop and --connect",
        )
    if through is not None and out is not None:
        if compare is not None or topics:
            raise InputError("--through processes a whole log", remedy="leave out --compare and --topics")
        _warn_of_damage(log)
        if through == "uav":
            from deploy.logs.replay_uav import replay_through_uav

            count, missing = replay_through_uav(log, out)
            if missing:
                text = f"{missing} inputs were not recorded: the output differs from the original"
                print(f"syncline: {log}: {text}", file=sys.stderr)
        else:
            from deploy.logs.replay_hub import replay_through_hub

            _check_people(log, calibration)
            count = replay_through_hub(log, out, calibration=calibration)
        return answer({"written": count}, [f"{count} messages written to {out}"], json)
    if compare is not None:
        return _compare(log, compare, topics, tolerance or [], as_json=json)
    if not 0.0 <= start < 1e9:
        raise InputError(f"--start {start} is out of range", remedy="give seconds from the log's beginning")
    from deploy.agents.processes import stop_on_signals
    from deploy.logs.replay import replay as play
    from protocols.bus.base import BusStopped
    from protocols.bus.settings import BusConfig
    from protocols.bus.transport.zenoh_bus import open_bus

    _warn_of_damage(log)
    stop = stop_on_signals()
    try:
        with open_bus(site, BusConfig(connect=tuple(connect or ())), stop=stop.is_set) as bus:
            count = play(log, bus, rate=speed, start_s=start, loop=loop, topics=topics, stop=stop)
    except BusStopped:
        count = 0
    return answer({"published": count}, [f"{count} messages published"], json)


def _check_people(log: Path, calibration: Path | None) -> None:
    """Print what is wrong with a calibration for the people in a log. Raises InputError."""
    from deploy.offline.follow.source import check_log

    for warning in check_log(log, calibration) if calibration is not None else ():
        print(f"syncline: {log}: {warning}", file=sys.stderr)


def _warn_of_damage(log: Path) -> None:
    """Print what is wrong with a log: before an hour of replay, not after it."""
    from protocols.log.read.reader import LogReader

    if damage := LogReader(log).summary().reason:
        print(f"syncline: {log}: damaged: {damage}; only its intact part is played", file=sys.stderr)


def _compare(log: Path, other: Path, topics: list[str] | None, tolerances: list[str], as_json: bool) -> int:
    from deploy.logs.diff import as_json as to_json
    from deploy.logs.diff import as_table, compare_logs, parse_tolerances

    comparison = compare_logs(log, other, parse_tolerances(tolerances), topics)
    if as_json:
        answer(to_json(comparison), (), as_json)
    else:
        from deploy.offline.outputs import wide_console

        wide_console(markup=True).print(as_table(comparison), soft_wrap=True)
    return EXIT_DONE if comparison.equal else EXIT_REFUSED
