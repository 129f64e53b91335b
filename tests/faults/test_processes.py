"""Processes that are killed, frozen, or alive without doing their work."""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.session import open_session
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError
from protocols.topics import OBSERVATION
from tests.faults.matrix import measured
from tests.faults.processes import Process, flow, publisher, receiver, router, wait_until
from tests.support.links import poisoned, through_a_link
from tests.support.receiving import collect, matched
from tests.support.samples import observation


def arrivals(receiving: Process) -> list[float]:
    return sorted(arrival for boot in receiving.ask()["arrivals"].values() for arrival in boot)


def flowing_again(receiving: Process, after: float, timeout_s: float = 20.0) -> float:
    """Seconds from ``after`` until the next observation arrived."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        later = [arrival for arrival in arrivals(receiving) if arrival > after]
        if later:
            return later[0] - after
        time.sleep(0.05)
    raise AssertionError("nothing flows any more")


def test_a_router_that_is_killed_is_missed_for_half_a_second(tmp_path: Path) -> None:
    with ExitStack() as stack:
        endpoint, first, receiving, sending = stack.enter_context(flow(tmp_path))
        flows = []
        for _ in range(3):
            time.sleep(1.0)
            os.kill(first.child.pid, signal.SIGKILL)
            first.child.wait()
            time.sleep(1.0)
            first = stack.enter_context(router(tmp_path, endpoint))
            flows.append(flowing_again(receiving, time.monotonic()))
        time.sleep(1.0)
        put = sending.ask("stop")["put"]
        time.sleep(2.0)
        answer = receiving.ask()
        (sequences,) = answer["sequences"].values()
        measured(
            "router killed -9, three times",
            "flow back ≤ 0.5 s after restart, nothing lost",
            f"{max(flows):.2f} s at most, {put - len(set(sequences))} of {put} lost",
            max(flows) <= 0.5,
        )
        assert sequences == list(range(put))


def test_a_hub_that_is_killed_finds_everything_again(tmp_path: Path) -> None:
    """The receiver, started anew, gets what it missed from the cameras' caches; each observation once."""
    with ExitStack() as stack:
        endpoint, _, first, sending = stack.enter_context(flow(tmp_path))
        time.sleep(3.0)
        os.kill(first.child.pid, signal.SIGKILL)
        first.child.wait()
        time.sleep(2.0)
        began = time.monotonic()
        second = stack.enter_context(receiver(endpoint))
        second.ready()
        flowing = flowing_again(second, began)
        put = sending.ask("stop")["put"]
        time.sleep(1.5)
        (sequences,) = second.ask()["sequences"].values()
        measured(
            "hub killed -9",
            "back ≤ 2 s, nothing lost, duplicates removed",
            f"{flowing:.2f} s, {put - len(set(sequences))} of {put} lost, {len(sequences) - len(set(sequences))} twice",
            flowing <= 2.0,
        )
        assert sequences == list(range(put))


@pytest.mark.parametrize(("number", "limit_s"), [(signal.SIGKILL, 0.1), (signal.SIGSTOP, 2.0)])
def test_an_agent_that_is_killed_or_frozen_is_seen(tmp_path: Path, number: signal.Signals, limit_s: float) -> None:
    endpoint, times = free_endpoint(), []
    with ExitStack() as stack:
        stack.enter_context(router(tmp_path, endpoint))
        receiving = stack.enter_context(receiver(endpoint))
        receiving.ready()
        for camera in ("cam0", "cam1", "cam2"):
            sending = stack.enter_context(publisher(endpoint, camera))
            sending.ready()
            time.sleep(0.5)
            began = time.monotonic()
            os.kill(sending.child.pid, number)
            gone: list[float] = []
            while not gone and time.monotonic() < began + 10.0:
                time.sleep(0.05)
                gone = [at for at, agent, _, alive in receiving.ask()["events"] if agent == camera and not alive]
            times.append(gone[0] - began)
    what = "killed" if number == signal.SIGKILL else "frozen"
    measured(
        f"agent {what}, three times", f"seen ≤ {limit_s:g} s", f"{max(times):.3f} s at most", max(times) <= limit_s
    )
    assert max(times) < 5.0


def test_a_router_that_lives_but_does_not_route_starts_itself_anew(tmp_path: Path) -> None:
    """One declaration with a `?` in its key ends all routing of Zenoh 1.10.2, while the process stays alive."""
    with flow(tmp_path) as (endpoint, routing, receiving, sending):
        time.sleep(2.0)
        poison = open_session(BusConfig(mode="client", connect=(through_a_link(endpoint, poisoned),)), timeout_s=5.0)
        began = time.monotonic()
        poison.declare_publisher("camQ/observation")
        wait_until(lambda: "nothing has passed" in (tmp_path / "router.txt").read_text(encoding="utf-8"))
        found_s = time.monotonic() - began
        assert routing.line().startswith("relays at"), "it has come back by itself, in the same process"
        found = time.monotonic() - began
        flowing = flowing_again(receiving, began + found - 0.5)
        back = found - 0.5 + flowing
        time.sleep(1.0)
        put = sending.ask("stop")["put"]
        time.sleep(2.0)
        (sequences,) = receiving.ask()["sequences"].values()
        measured(
            "routing hung by a bad declaration",
            "found ≤ 1.5 s, repaired ≤ 2 s",
            f"found after {found_s:.2f} s, ready {found:.2f} s, flow back {back:.2f} s after the declaration, "
            f"{put - len(set(sequences))} of {put} lost",
            found_s <= 1.5 and back <= 2.0,
        )
        assert routing.child.poll() is None
        assert sequences == list(range(put))


def test_a_slow_subscriber_holds_up_nobody(tmp_path: Path) -> None:
    """A receiver that is frozen while 30 Hz go to another one: the other's gaps stay short."""
    endpoint = free_endpoint()
    with ExitStack() as stack:
        stack.enter_context(router(tmp_path, endpoint))
        good, slow = (stack.enter_context(receiver(endpoint)) for _ in range(2))
        good.ready(), slow.ready()
        sending = stack.enter_context(publisher(endpoint, hz=100.0))
        assert sending.ready()["ready"]
        time.sleep(1.0)
        os.kill(slow.child.pid, signal.SIGSTOP)
        began = time.monotonic()
        time.sleep(6.0)
        times = [arrival for arrival in arrivals(good) if arrival > began]
        gaps = [b - a for a, b in pairwise(times)]
        measured(
            "slow subscriber (frozen), 100 Hz", "others' gaps ≤ 0.2 s", f"{max(gaps):.3f} s at most", max(gaps) <= 0.2
        )
        assert len(times) > 400
        assert max(gaps) < 3.0, "five seconds is what a blocking publisher would wait"


def test_a_panic_in_the_transport_ends_the_agent_with_one_line(tmp_path: Path) -> None:
    """PanicException is no Exception; the process must end all the same, and say what is to be done."""
    endpoint = free_endpoint()
    config = tmp_path / "recorder.toml"
    config.write_text(f'out = "log.mcap"\n[bus]\nmode = "client"\nconnect = ["{endpoint}"]\n', encoding="utf-8")
    code = (
        "import sys, zenoh.ext\n"
        "from protocols.bus.transport.zenoh_bus import ZenohPublisher\n"
        "panic = type('PanicException', (BaseException,), {})\n"
        "class Broken:\n"
        "    def put(self, payload): raise panic('unwrap on None')\n"
        "    def undeclare(self): raise panic('again')\n"
        "made = ZenohPublisher.__init__\n"
        "def init(self, *a, **k):\n"
        "    made(self, *a, **k)\n"
        "    self._publisher = Broken()\n"
        "ZenohPublisher.__init__ = init\n"
        "from deploy.cli import run\n"
        f"sys.exit(run(['record', {str(config)!r}]))\n"
    )
    errors = tmp_path / "errors.txt"
    with router(tmp_path, endpoint), Process("-c", code, stderr=errors) as agent:
        assert agent.child.wait(15.0) == 1
        text = errors.read_text(encoding="utf-8")
    assert "the bus has died: put syncline/local/agent/recorder/status: the transport panicked" in text
    assert "Traceback" not in text
    measured("panic in the bus", "fatal, one line, restarted", "exit 1 with one line; systemd or the fleet restarts")


def test_more_sessions_than_allowed_are_turned_away(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    config = BusConfig(mode="router", listen=(endpoint,), max_sessions=3)
    client = BusConfig(mode="client", connect=(endpoint,))
    with Router(config=config), ExitStack() as stack:
        buses = [stack.enter_context(open_bus("local", client, timeout_s=2.0)) for _ in range(3)]
        with pytest.raises(InputError, match="no router answers"):
            stack.enter_context(open_bus("local", client, timeout_s=0.5))
        subscription = buses[0].subscribe(OBSERVATION)
        matched(buses[1].publisher(OBSERVATION, "cam0")).put(observation("cam0"))
        assert len(collect(subscription, 1)) == 1, "those who are in go on"
    measured("more sessions than max_sessions", "refused, the others undisturbed", "the fourth of three refused")
