"""Two agents with one id, a forger, a plain publisher: reported, refused, counted; counters reach the operator."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.security.sender_identity import SenderCheckedBus
from protocols.bus.settings import BusConfig
from protocols.bus.transport.session import open_session
from protocols.bus.transport.zenoh_bus import ZenohBus, open_bus
from protocols.topics import OBSERVATION, STATUS
from tests.faults.matrix import measured
from tests.faults.processes import Process, wait_until
from tests.support.receiving import collect, http_get, matched, sequences
from tests.support.samples import observation


class Site:
    """A router, a guarded receiver, and buses to publish from."""

    def __init__(self, stack: ExitStack) -> None:
        self.stack, self.endpoint = stack, free_endpoint()
        stack.enter_context(Router(self.endpoint))
        self.receiving = SenderCheckedBus(self.bus(), time.monotonic)
        self.subscription = self.receiving.subscribe(OBSERVATION)

    def bus(self) -> ZenohBus:
        config = BusConfig(mode="client", connect=(self.endpoint,))
        return self.stack.enter_context(open_bus("local", config, timeout_s=10.0))

    def agent(self, boot: str) -> None:
        """cam0 comes alive under a boot id."""
        bus = self.bus()
        self.stack.enter_context(bus.announce("camera", "cam0", boot))
        self.publisher = matched(bus.publisher(OBSERVATION, "cam0"))


@pytest.fixture
def site() -> Iterator[Site]:
    with ExitStack() as stack:
        yield Site(stack)


def test_of_two_agents_with_one_id_the_first_is_accepted(site: Site) -> None:
    site.agent("boot-1")
    first = site.publisher
    first.put(observation("cam0", 0, "boot-1"))
    assert sequences(collect(site.subscription, 1)) == [0]
    site.agent("boot-2")
    began = time.monotonic()
    for index in range(1, 21):
        site.publisher.put(observation("cam0", index, "boot-2"))
        first.put(observation("cam0", index, "boot-1"))
    received = collect(site.subscription, 20)
    wait_until(lambda: site.subscription.drain() is None or site.receiving.guard.alarms())
    alarm_delay = time.monotonic() - began
    wait_until(
        lambda: site.subscription.drain() is None or site.subscription.counters.get("rejected.second_agent") == 20
    )
    assert {item.message.boot_id for item in received} == {"boot-1"}  # type: ignore[attr-defined]
    assert site.receiving.guard.alarms() == [
        "camera cam0 runs 2 times; only the first is heard: give each an id of its own"
    ]
    measured("two agents with one id", "alarm, refused, counted", f"alarm after {alarm_delay:.2f} s, 20 of 20 refused")


def test_a_forger_and_a_plain_publisher_are_refused(site: Site) -> None:
    site.agent("boot-1")
    site.publisher.put(observation("cam0", 0, "boot-1"))
    assert sequences(collect(site.subscription, 1)) == [0]
    forging = matched(site.bus().publisher(OBSERVATION, "cam0"))
    forging.put(observation("cam0", 1, "boot-1"))  # a copied boot id, from another connection
    forging.put(observation("cam0", 2, "boot-9"))  # a run that nobody has announced
    plain = open_session(BusConfig(mode="client", connect=(site.endpoint,)), timeout_s=5.0)
    plain.put(OBSERVATION.key_for("local", "cam0"), observation("cam0", 3, "boot-1").SerializeToString())

    def refused() -> bool:
        assert site.subscription.drain() == []
        counters = site.subscription.counters
        return counters.get("rejected.wrong_source") == 3

    wait_until(refused)
    site.publisher.put(observation("cam0", 1, "boot-1"))
    assert sequences(collect(site.subscription, 1)) == [1]
    assert site.receiving.refusals_by_source() == {("wrong_source", "cam0"): 3}
    plain.close()
    measured(
        "forged or plain publisher on a camera's key", "alarm, refused, counted", "3 of 3 refused and counted by source"
    )


def test_every_refusal_is_a_counter_on_metrics_and_in_the_status(tmp_path: Path) -> None:
    """The recorder as a process: hostile messages on its bus, then what HTTP, status and log say."""
    endpoint = free_endpoint()
    port = int(free_endpoint().rpartition(":")[2])
    config, errors = tmp_path / "recorder.toml", tmp_path / "errors.txt"
    config.write_text(
        f'out = "log.mcap"\n[bus]\nmode = "client"\nconnect = ["{endpoint}"]\n[health]\nlisten = "127.0.0.1:{port}"\n',
        encoding="utf-8",
    )
    get = partial(http_get, f"127.0.0.1:{port}")
    client = BusConfig(mode="client", connect=(endpoint,))
    with Router(endpoint), open_bus("local", client, timeout_s=5.0) as bus:
        with Process("-m", "deploy", "record", str(config), stderr=errors):
            statuses = bus.subscribe(STATUS)
            wait_until(lambda: get("readyz")[0] == 200)
            publisher = matched(bus.publisher(OBSERVATION, "cam7"))
            began = time.monotonic()
            bad = observation("cam7", 17)
            bad.detections[0].u = float("nan")
            publisher.put(bad)
            line = 'agent="recorder",reason="not_finite",role="record",site="local",source="cam7"} 1.0'
            seconds = wait_until(lambda: line in get("metrics")[1])
            wait_until(
                lambda: any(item.message.counters.get("rejected.not_finite@cam7") == 1 for item in statuses.drain())  # type: ignore[attr-defined]
            )
            in_status = time.monotonic() - began
            assert get("livez") == (200, "ok\n")
            assert get("elsewhere")[0] == 404
        lines = [json.loads(line) for line in errors.read_text(encoding="utf-8").splitlines() if line.startswith("{")]
    refused = next(line for line in lines if line["event"] == "refused")
    assert (refused["camera"], refused["sequence"], refused["reason"]) == ("cam7", 17, "not_finite")
    measured(
        "every refusal is reported",
        "on /metrics and in the status ≤ 5 s; a log line with camera and sequence",
        f"/metrics {seconds:.2f} s, status {in_status:.2f} s",
        max(seconds, in_status) <= 5.0,
    )
