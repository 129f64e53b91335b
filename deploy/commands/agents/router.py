"""`syncline router`: relays messages between agents on several machines."""

from __future__ import annotations

import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from deploy.agents.processes import stop_on_signals
from deploy.commands.common import PrintConfig, StatusJson, UnusedSeed, answer_config, status_lines
from deploy.config.agents import RouterConfig
from deploy.config.file import load
from protocols.core.errors import EXIT_BUG, EXIT_DONE

if TYPE_CHECKING:
    from deploy.agents.systemd_notify import Notifier
    from protocols.messages.syncline_pb2 import AgentStatus

_RESTARTS = "SYNCLINE_ROUTER_RESTARTS"
"""Environment variable that carries the restart count over an exec; informational only."""


def router(
    config: Path, /, *, print_config: PrintConfig = False, json: StatusJson = False, seed: UnusedSeed = 0
) -> int:
    """Run a router: agents in client mode connect to it, and it relays messages between them.

    It sends itself a test message four times a second. If none arrives for 0.9 s it restarts in place; agents
    reconnect within half a second, and messages published meanwhile are recovered.

    Example: syncline router router.toml

    Parameters
    ----------
    config
        TOML file: id, site, [bus] with listen (default tcp/127.0.0.1:7447), connect for other routers, and the tls and
        access settings that `syncline keys issue --role router` writes.
    """
    settings = load(config, RouterConfig)
    if print_config:
        return answer_config(settings, json)
    from deploy.agents.health import Health
    from deploy.agents.startup_checks import Conditions, check_startup, serve_health
    from protocols.bus.base import BusDead
    from protocols.bus.router.zenoh_router import RulesChanged, run_router

    check_startup(settings)
    restarts = int(os.environ.get(_RESTARTS, "0"))
    notifier = _notifier()

    def restart(reason: str) -> NoReturn:
        print(f"syncline: {reason}; starting anew", file=sys.stderr, flush=True)
        os.environ[_RESTARTS] = str(restarts + 1)
        # In place: hanging threads disappear with the old program, and the supervisor does not notice a restart.
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])

    stop = stop_on_signals()
    conditions = Conditions(settings, lambda: True)

    def seen(status: AgentStatus) -> None:
        conditions.amend(status)
        health.seen(status)

    health = Health(site=settings.site, role="router", agent=settings.id)
    try:
        lines = status_lines(seen, health.report) if json else nullcontext(seen)
        with serve_health(settings, health), lines as show:
            run_router(
                settings.bus,
                settings.site,
                settings.id,
                stop,
                died=restart,
                restarts=restarts,
                ready=lambda listen: print(f"relays at {', '.join(listen)}", flush=True),
                beat=(lambda: None) if notifier is None else notifier.beat,
                seen=show,
            )
    except RulesChanged:
        time.sleep(0.2)  # the file was renamed into place, but more files of the same `keys issue` may follow
        restart("access rules have changed")
    except BusDead as error:
        print(f"syncline: {error}; start it again", file=sys.stderr)
        return EXIT_BUG
    finally:
        if notifier is not None:
            notifier.stopping()
    return EXIT_DONE


def _notifier() -> Notifier | None:
    # Importing it takes as long as the rest of the start, and a restart must be fast.
    if "NOTIFY_SOCKET" not in os.environ and "SYNCLINE_ALIVE_FILE" not in os.environ:
        return None
    from deploy.agents.systemd_notify import Notifier

    return Notifier.from_environment()
