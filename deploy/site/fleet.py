"""Supervisor of all agents of a rig on one machine: starts, monitors, restarts and stops their processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

from deploy.agents.processes import kill_all, last_line, start_process
from deploy.site.rig_folder import ROLES, Agent, RigFolder, client_bus, write_agent_configs
from protocols.bus.base import Bus, BusStopped
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import LOOPBACK_ROUTER, BusConfig, is_loopback
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError, Refused
from protocols.core.files import check_folder, completed_file
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, STATUS

STATE = "fleet.json"
COMMANDS = {"recorder": "record"}
_MIN_RESTART_DELAY_S, _MAX_RESTART_DELAY_S, _STABLE_S = 1.0, 10.0, 30.0  # doubled up to; reset after
_STOP_TIMEOUT_S = {"camera": 15.0, "uav": 15.0, "hub": 300.0, "recorder": 30.0, "router": 10.0}
_TICK_S = 0.2  # between two looks at the processes


@dataclass(slots=True)
class AgentRecord:
    """State of one agent. pid, started: process id and start time in /proc; pid 0 = no process runs."""

    role: str
    pid: int = 0
    started: int = 0
    restarts: int = 0
    state: str = "starting"
    message: str = ""
    counters: dict[str, int] = field(default_factory=dict)


class Fleet:
    """The supervised processes of one rig.

    out: folder for logs, configurations and all outputs of the agents. report: called with each message for the user.
    """

    def __init__(self, rig: RigFolder, out: Path, *, simulated: bool, report: Callable[[str], None]) -> None:
        self.rig, self.out, self.simulated, self._report = rig, out.resolve(), simulated, report
        self.seen = {agent.name: AgentRecord(agent.role) for agent in rig.agents}
        self.calibrations: dict[str, str] = {}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._restart_at: dict[str, float] = {}
        self._backoff_s: dict[str, float] = {}
        self._started_at: dict[str, float] = {}
        self._drain: Callable[[], None] = lambda: None
        self.elapsed = 0.0

    def run(self, seconds: float | None, stop: Event, show: Callable[[Fleet], None]) -> None:
        """Run until ``stop`` is set, or for ``seconds`` after the first frames of all cameras; then stop in order.

        show: called five times a second. Raises Refused if a fleet is already running in ``out``, InputError.
        """
        self._prepare_folder()
        own_router = not self.rig.of("router")
        endpoint = free_endpoint() if self.simulated else None
        agents = write_agent_configs(self.rig, self.out, simulated=self.simulated, endpoint=endpoint)
        (self.out / "logs").mkdir(exist_ok=True)
        with ExitStack() as stack:
            if own_router:
                self._host_router(stack, endpoint or LOOPBACK_ROUTER)
            stack.callback(kill_all, self._processes)
            self._save()
            try:
                for agent in agents:
                    if agent.role == "router":
                        self._start(agent)
                bus = stack.enter_context(self._open_bus(agents, endpoint, stop))
                for agent in agents:
                    if agent.role != "router":
                        self._start(agent)
                self._watch(bus, agents, seconds, stop, show)
            except KeyboardInterrupt:
                stop.set()
            self._stop(agents, show)
        self._save()

    def _watch(
        self, bus: Bus, agents: tuple[Agent, ...], seconds: float | None, stop: Event, show: Callable[[Fleet], None]
    ) -> None:
        self._drain = self._listener(bus)
        cameras = [agent.name for agent in agents if agent.role in ("camera", "uav")]
        began, cameras_ready_at, saved = time.monotonic(), None, 0.0
        # Twenty agents on two cores take long to start; a camera that never starts must not block the others.
        start_timeout_s = 20.0 + 3.0 * len(agents)
        while not stop.is_set():
            now = time.monotonic()
            self._drain()
            self._restart_dead(agents, now)
            missing = [name for name in cameras if not self.seen[name].counters.get("frames")]
            if cameras_ready_at is None and (not missing or now - began > start_timeout_s):
                cameras_ready_at = now
                if missing:
                    self._report(f"no frame yet from {', '.join(missing)}; see {self.out}/logs")
            self.elapsed = 0.0 if cameras_ready_at is None else now - cameras_ready_at
            if now - saved > 1.0:
                saved = now
                self._save()
            show(self)
            if seconds is not None and cameras_ready_at is not None and self.elapsed >= seconds:
                return
            stop.wait(_TICK_S)

    def _listener(self, bus: Bus) -> Callable[[], None]:
        statuses, calibrations = bus.subscribe(STATUS), bus.subscribe(CALIBRATION)

        def drain() -> None:
            for received in statuses.drain():
                self._handle_status(received.message)
            for received in calibrations.drain():
                self._handle_calibration(received.agent, received.message)

        return drain

    def _handle_status(self, message: object) -> None:
        assert isinstance(message, pb.AgentStatus)
        seen = self.seen.get(message.agent)
        if seen is not None and seen.pid:
            seen.state, seen.message = message.state, message.message
            seen.counters = {name: round(count) for name, count in message.counters.items()}

    def _handle_calibration(self, hub: str, message: object) -> None:
        assert isinstance(message, pb.Calibration)
        solved = message.status == "solved"
        progress = [f"{one.camera} {one.shared_motion_s:.0f} s" for one in message.progress[:16]]
        shared = f"; motion shared with another camera: {', '.join(progress)}" if progress else ""
        self.calibrations[hub] = (
            f"{len(message.cameras)} cameras calibrated" if solved else f"{message.status}: {message.reason}{shared}"
        )

    def _start(self, agent: Agent) -> None:
        # Ctrl-C goes to the whole process group, but agents must be stopped in order.
        words = [COMMANDS.get(agent.role, agent.role), str(agent.file)]
        process = start_process(words, self._log(agent.name), new_session=True)
        self._processes[agent.name] = process
        self._started_at[agent.name] = time.monotonic()
        seen = self.seen[agent.name]
        seen.pid, seen.started, seen.state = process.pid, start_time(process.pid), "starting"

    def _restart_dead(self, agents: tuple[Agent, ...], now: float) -> None:
        for agent in agents:
            name = agent.name
            process = self._processes.get(name)
            if name in self._restart_at:
                if now >= self._restart_at[name]:
                    del self._restart_at[name]
                    self.seen[name].restarts += 1
                    self._start(agent)
            elif process is not None and process.poll() is not None:
                if now - self._started_at[name] > _STABLE_S:
                    self._backoff_s.pop(name, None)
                pause = self._backoff_s.get(name, _MIN_RESTART_DELAY_S)
                self._backoff_s[name] = min(2.0 * pause, _MAX_RESTART_DELAY_S)
                self._restart_at[name] = now + pause
                seen = self.seen[name]
                seen.pid, seen.state, seen.message = 0, "down", last_line(self._log(name))
                code = process.returncode
                how = f"status {code}" if code >= 0 else signal.Signals(-code).name
                self._report(f"{name} ended ({how}): {seen.message}; again in {pause:g} s")

    def _stop(self, agents: tuple[Agent, ...], show: Callable[[Fleet], None]) -> None:
        """Stop cameras first, so that hubs and recorders receive everything; then these, and the router last."""
        for group in (("camera", "uav"), ("hub",), ("recorder",), ("router",)):
            members = [agent for agent in agents if agent.role in group and agent.name in self._processes]
            for agent in members:
                if self._processes[agent.name].poll() is None:
                    self._processes[agent.name].send_signal(signal.SIGTERM)
            for agent in members:
                process, seen = self._processes[agent.name], self.seen[agent.name]
                dead_already = agent.name in self._restart_at
                try:
                    status = process.wait(_STOP_TIMEOUT_S[agent.role])
                except subprocess.TimeoutExpired:
                    process.kill()
                    status = process.wait()
                    self._report(f"{agent.name} did not stop within {_STOP_TIMEOUT_S[agent.role]:.0f} s and was ended")
                self._drain()  # the final calibration of a hub
                if not dead_already:
                    seen.state = "stopped" if status == 0 else "failed"
                    seen.message = last_line(self._log(agent.name)) if status else ""
                seen.pid = 0
                show(self)

    def _host_router(self, stack: ExitStack, endpoint: str) -> None:
        """Run a router in this process, for a rig that has none."""
        try:
            stack.enter_context(Router(endpoint))
        except InputError:
            if self.simulated:
                raise
            self._report(f"a router listens at {endpoint} already: it is used")

    def _open_bus(self, agents: Iterable[Agent], endpoint: str | None, stop: Event) -> Bus:
        """The supervisor's own bus connection: to the simulated rig's router, or where the first agent connects."""
        site = next(iter(agents)).config.site
        if endpoint is None:
            others = [agent.config.bus for agent in agents if agent.role != "router"]
            connect = others[0].endpoints()[0] if others else (LOOPBACK_ROUTER,)
            endpoints = connect or (LOOPBACK_ROUTER,)
            config = BusConfig(mode="client", connect=endpoints, tls=others[0].tls if others else None)
        else:
            config = client_bus(endpoint)
        if not all(is_loopback(one) for one in config.connect):
            self._report(f"waiting for the router at {', '.join(config.connect)}")

        def ended() -> list[str]:
            return [name for name, router in self._processes.items() if router.poll() is not None]

        try:
            bus = open_bus(site, config, stop=lambda: stop.is_set() or bool(ended()), timeout_s=30.0)
        except BusStopped:
            if stop.is_set():
                raise
        else:
            if not ended():
                return bus
            bus.close()  # of another router, which has the port of one that ended
        name = ended()[0]
        raise InputError(f"{name} ended: {last_line(self._log(name))}")

    def _prepare_folder(self) -> None:
        """Create the folder; refuse if a fleet is running in it, and stop processes orphaned by a killed one."""
        check_folder(self.out)
        self.out.mkdir(parents=True, exist_ok=True)
        state = read_state(self.out)
        if state is None:
            return
        if is_running(state["pid"], state["started"]):
            raise Refused(f"a fleet is up in {self.out} (pid {state['pid']}); `syncline fleet down --out …` stops it")
        for name in stop_orphaned_agents(state):
            self._report(f"{name} was left over from a fleet that was killed, and was ended")

    def _save(self) -> None:
        """Write the state for `fleet status` and `fleet down`; no fsync, because a machine crash ends the fleet too."""
        state = {
            "rig": self.rig.name,
            "pid": os.getpid(),
            "started": start_time(os.getpid()),
            "simulated": self.simulated,
            "elapsed_s": round(self.elapsed, 1),
            "agents": {name: asdict(seen) for name, seen in self.seen.items()},
            "calibrations": self.calibrations,
        }
        with completed_file(self.out / STATE) as part:
            part.write_text(json.dumps(state, indent=1), encoding="utf-8")

    def _log(self, name: str) -> Path:
        return self.out / "logs" / f"{name}.txt"


def start_time(pid: int) -> int:
    """Start time of a process in kernel ticks, which with the pid identifies a process uniquely; 0 = none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return 0
    fields = text.rpartition(")")[2].split()
    return 0 if fields[0] == "Z" else int(fields[19])


def is_running(pid: int, started: int) -> bool:
    """Whether the process with this pid and start time still runs."""
    return pid > 0 and started > 0 and start_time(pid) == started


def read_state(out: Path) -> dict[str, Any] | None:
    """The state file of a fleet; None if there is none or it is invalid."""
    try:
        state = json.loads((out / STATE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    try:
        known = isinstance(state["pid"], int) and isinstance(state["started"], int)
        known = known and all({"role", "pid", "started"} <= seen.keys() for seen in state["agents"].values())
    except (TypeError, KeyError, AttributeError):
        return None
    return dict(state) if known else None


def stop_fleet(out: Path, timeout_s: float = 420.0) -> list[str]:
    """Stop the fleet that runs in ``out``, in order; returns what was done. Raises InputError if there is none."""
    state = read_state(out)
    if state is None:
        raise InputError("no fleet was started here", file=out, remedy="give the --out of `syncline fleet up`")
    if not is_running(state["pid"], state["started"]):
        ended = stop_orphaned_agents(state)
        return [f"the fleet was down already; ended what was left over: {', '.join(ended) or 'nothing'}"]
    os.kill(state["pid"], signal.SIGTERM)
    deadline = time.monotonic() + timeout_s
    while is_running(state["pid"], state["started"]):
        if time.monotonic() > deadline:
            raise Refused(f"the fleet did not stop within {timeout_s:.0f} s; see {out}/logs")
        time.sleep(0.1)
    return [f"stopped {len(state['agents'])} agents"]


def stop_orphaned_agents(state: dict[str, Any]) -> list[str]:
    """Stop the agents of a supervisor that no longer runs; returns their names."""
    ended = []
    for role in reversed(ROLES):
        for name, seen in state["agents"].items():
            if seen["role"] == role and is_running(seen["pid"], seen["started"]):
                os.kill(seen["pid"], signal.SIGTERM)
                deadline = time.monotonic() + _STOP_TIMEOUT_S[role]
                while is_running(seen["pid"], seen["started"]) and time.monotonic() < deadline:
                    time.sleep(0.05)
                if is_running(seen["pid"], seen["started"]):
                    os.kill(seen["pid"], signal.SIGKILL)
                ended.append(name)
    return ended
