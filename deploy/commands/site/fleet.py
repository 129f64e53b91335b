"""`syncline fleet`: runs all agents of a rig on one machine."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from deploy.commands.common import Flag, Json, answer, check_range, check_seed
from protocols.core.errors import EXIT_DONE, EXIT_REFUSED, InputError

if TYPE_CHECKING:
    from deploy.site.fleet import Fleet


def fleet(
    action: Literal["up", "status", "down"],
    rig: str | None = None,
    /,
    *,
    simulated: Flag = False,
    seconds: float | None = None,
    out: Path = Path("fleet-out"),
    json: Json = False,
    seed: int | None = None,
) -> int:
    """Start all agents of a rig on this machine, supervise them, restart those that exit, and stop them in order.

    A rig is a folder with rig.toml, one TOML file per agent, and fleet.toml. Shipped rigs are given by name:
    webcams-room, drone-cage, oak-array, companion. Ctrl-C, or `fleet down` from elsewhere, stops the cameras first,
    then hubs, recorder and router. With --seconds, exit status 3 if a camera never delivered a frame or an agent was
    down at the end.

    Example: syncline fleet up webcams-room --simulated --seconds 20

    Parameters
    ----------
    action
        up: start, and run until stopped. status: show the state of the fleet in --out. down: stop it.
    rig
        The rig's folder or name, for `up`.
    simulated
        Simulated cameras instead of the real ones, in the scene that fleet.toml names.
    seconds
        Stop this long after the first frames of all cameras; without it, run until stopped.
    out
        Folder for logs, recordings, calibrations and the fleet's state file.
    seed
        Of the simulated world, instead of fleet.toml's.
    """
    if action == "up":
        if rig is None:
            raise InputError("`fleet up` needs a rig", remedy="give its folder, or a shipped one's name")
        check_range("--seconds", seconds, 0.1, 1e7, "give a positive number")
        if seed is not None and not simulated:
            raise InputError("--seed is of a simulated world", remedy="leave it out, or give --simulated")
        check_seed(seed or 0)
        return _up(rig, simulated, seconds, out, json, seed)
    if rig is not None or simulated or seconds is not None or seed is not None:
        raise InputError(f"`fleet {action}` takes only --out and --json", remedy="give the --out of `fleet up`")
    if action == "down":
        from deploy.site.fleet import stop_fleet

        done = stop_fleet(out)
        return answer({"done": done}, done, json)
    return _status(out, json)


def _up(name: str, simulated: bool, seconds: float | None, out: Path, json: bool, seed: int | None) -> int:
    import msgspec

    from deploy.agents.processes import stop_on_signals
    from deploy.site.fleet import Fleet
    from deploy.site.rig_folder import find_rig, read_rig_folder
    from protocols.bus.base import BusStopped

    rig = read_rig_folder(find_rig(name))
    if seed is not None:
        rig = replace(rig, world=msgspec.structs.replace(rig.world, seed=seed))
    stop = stop_on_signals()

    def report(line: str) -> None:
        print(line, file=sys.stderr if json else sys.stdout, flush=True)

    fleet = Fleet(rig, out, simulated=simulated, report=report)
    if not json:
        numbers = {role: len(rig.of(role)) for role in ("camera", "uav", "hub", "recorder", "router")}
        counts = ", ".join(f"{number} {role}" for role, number in numbers.items() if number)
        print(f"{rig.name}: {counts}{', simulated' if simulated else ''}; logs in {out}/logs", flush=True)
    try:
        fleet.run(seconds, stop, _lines(quiet=json))
    except BusStopped:
        return EXIT_DONE
    silent = [a.name for a in (*rig.of("camera"), *rig.of("uav")) if not fleet.seen[a.name].counters.get("frames")]
    failed = [name for name, seen in fleet.seen.items() if seen.state in ("down", "failed")]
    _summary(fleet, json, silent, failed)
    return EXIT_REFUSED if seconds is not None and (silent or failed) else EXIT_DONE


def _summary(fleet: Fleet, json: bool, silent: list[str], failed: list[str]) -> None:
    from dataclasses import asdict

    if json:
        document = {
            "rig": fleet.rig.name,
            "simulated": fleet.simulated,
            "seconds": round(fleet.elapsed, 1),
            "agents": {name: asdict(seen) for name, seen in fleet.seen.items()},
            "calibrations": fleet.calibrations,
            "silent": silent,
            "failed": failed,
        }
        answer(document, (), json)
        return
    _table({name: asdict(seen) for name, seen in fleet.seen.items()})
    for hub, text in fleet.calibrations.items():
        print(f"{hub}: {text}")
    print(f"written below {fleet.out}")
    for name in silent:
        print(f"{name} never gave a frame; see {fleet.out}/logs/{name}.txt")
    for name in failed:
        print(f"{name} failed: {fleet.seen[name].message}")


def _status(out: Path, json: bool) -> int:
    from deploy.site.fleet import is_running, read_state

    state = read_state(out)
    if state is None:
        raise InputError("no fleet was started here", file=out, remedy="give the --out of `syncline fleet up`")
    state["up"] = is_running(state["pid"], state["started"])
    for seen in state["agents"].values():
        seen["runs"] = is_running(seen["pid"], seen["started"])
    if json:
        answer(state, (), json)
    else:
        print(f"{state['rig']}: " + (f"up for {state['elapsed_s']:.0f} s" if state["up"] else "down"))
        _table(state["agents"])
        for hub, text in state["calibrations"].items():
            print(f"{hub}: {text}")
    return EXIT_DONE


def _table(agents: dict[str, dict[str, object]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table("agent", "role", "state", "restarts", "frames", "detections", "message")
    table.columns[-1].overflow = "fold"  # an address that is cut short is of no use
    for name, seen in agents.items():
        counters = seen["counters"]
        assert isinstance(counters, dict)
        figures = [str(counters.get(key, "")) for key in ("frames", "detections")]
        words = [str(seen[key]) for key in ("role", "state", "restarts")]
        table.add_row(name, *words, *figures, escape(str(seen["message"])))
    Console().print(table)


def _lines(quiet: bool) -> Callable[[Fleet], None]:
    """A function that prints one status line every five seconds."""
    printed = -10.0

    def show(fleet: Fleet) -> None:
        nonlocal printed
        if quiet or time.monotonic() - printed < 5.0:
            return
        printed = time.monotonic()
        cameras = [seen for seen in fleet.seen.values() if seen.role in ("camera", "uav")]
        active = sum(bool(seen.counters.get("frames")) for seen in cameras)
        frames = sum(seen.counters.get("frames", 0) for seen in cameras)
        hubs = "; ".join(f"{hub} {text}" for hub, text in fleet.calibrations.items())
        print(f"{fleet.elapsed:6.1f} s  {active}/{len(cameras)} cameras, {frames} frames  {hubs[:300]}", flush=True)

    return show
