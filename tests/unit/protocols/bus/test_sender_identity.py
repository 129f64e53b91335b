"""Sender checks without a bus: ids in use twice, boots that publish over another connection."""

from __future__ import annotations

import pytest

from protocols.bus.base import AgentEvent, Received, Refusal
from protocols.bus.security.sender_identity import SOURCE_TIMEOUT_S, SenderCheckedBus, SenderValidator
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION
from protocols.validation.codec import decode
from protocols.validation.rules import Rejected, RejectionReason
from tests.support.samples import observation


def message(boot: str, source: str = "a") -> Received:
    return Received(OBSERVATION, "cam0", observation("cam0", 0, boot), 0, source)


def alive(boot: str, yes: bool = True) -> AgentEvent:
    return AgentEvent("camera", "cam0", boot, yes)


def reason(guard: SenderValidator, received: Received, now: float = 0.0) -> RejectionReason | None:
    why = guard.refuse(received, now)
    return None if why is None else why[0]


def test_without_an_announcement_everyone_is_believed() -> None:
    assert reason(SenderValidator(), message("boot-1")) is None


def test_the_first_of_two_is_heard_until_it_is_gone() -> None:
    guard = SenderValidator()
    guard.handle(alive("boot-1"))
    guard.handle(alive("boot-2"))
    assert reason(guard, message("boot-1")) is None
    assert reason(guard, message("boot-2", "b")) is RejectionReason.SECOND_AGENT
    assert len(guard.alarms()) == 1
    guard.handle(alive("boot-1", False))
    assert reason(guard, message("boot-2", "b")) is None
    assert reason(guard, message("boot-1")) is None, "what it said before may still come, recovered"
    assert guard.alarms() == []


def test_two_hubs_of_one_site_are_an_alarm_unless_they_share_it() -> None:
    guard = SenderValidator()
    guard.handle(AgentEvent("hub", "one", "boot-1", True))
    assert guard.alarms() == []
    guard.handle(AgentEvent("hub", "two", "boot-2", True))
    assert guard.alarms() == ["hubs one, two each publish a calibration, in worlds of their own: stop all but one"]
    guard.handle(AgentEvent("shard", "two", "boot-2", True))
    assert guard.alarms() == []
    guard.handle(AgentEvent("shard", "two", "boot-2", False))
    guard.handle(AgentEvent("hub", "one", "boot-1", False))
    assert guard.alarms() == []


def test_a_run_that_nobody_announced_is_refused_while_its_agent_lives() -> None:
    guard = SenderValidator()
    guard.handle(alive("boot-1"))
    assert reason(guard, message("boot-9", "b")) is RejectionReason.WRONG_SOURCE


def test_a_run_speaks_through_one_connection_until_that_is_silent() -> None:
    guard = SenderValidator()
    assert reason(guard, message("boot-1", "a"), 0.0) is None
    assert reason(guard, message("boot-1", "b"), 1.0) is RejectionReason.WRONG_SOURCE
    assert reason(guard, message("boot-1", "a"), 2.0) is None
    assert reason(guard, message("boot-1", "b"), 2.0 + SOURCE_TIMEOUT_S) is None


def test_a_plain_publisher_does_not_speak_for_another_s_run() -> None:
    guard = SenderValidator()
    assert reason(guard, message("boot-1", "a"), 0.0) is None
    assert reason(guard, message("boot-1", ""), 1.0) is RejectionReason.WRONG_SOURCE
    assert reason(guard, message("boot-2", ""), 1.0) is None
    assert reason(guard, message("boot-2", "a"), 2.0) is RejectionReason.WRONG_SOURCE


def test_a_flood_of_invented_runs_does_not_fill_the_memory() -> None:
    guard = SenderValidator()
    for number in range(10_000):
        reason(guard, message(f"boot-{number}"), 0.0)
    assert len(guard._sources) <= 4096


def test_who_sends_only_what_cannot_be_used_is_named_with_the_reason_while_it_lasts() -> None:
    now = 100.0
    bus = SenderCheckedBus(MemoryBus(MemoryHub(), "local"), lambda: now)
    status = pb.AgentStatus(agent="hub", role="hub", state="running", message="2 cameras calibrated")
    assert bus.with_diagnostics(status) == status
    old = observation("cam0", 0)
    old.schema_version = 99
    anonymous = observation("cam1", 0, boot_id="")
    for message in (old, anonymous):
        with pytest.raises(Rejected) as found:
            decode(OBSERVATION, message.SerializeToString())
        bus.record_refusal(Refusal(found.value.reason.value, message.camera, "key", found.value.detail))
    bus.record_refusal(Refusal("wrong_source", "cam2", "key", "a camera that was restarted"))
    told = bus.with_diagnostics(status)
    assert told.state == "degraded"
    assert "messages of cam0 are not used: schema version 99, this build reads 1" in told.message
    assert "messages of cam1 are not used: boot id '' is not usable: use 1 to 63" in told.message
    assert "cam2" not in told.message
    for number in range(9):
        bus.record_refusal(Refusal("unknown_key", "", f"syncline/local/camera/cam%2C{number}/info", "no topic"))
    told = bus.with_diagnostics(status)
    assert "messages of syncline/local/camera/cam%2C0/info are not used: no topic;" in told.message
    assert "messages of 8 more are not used" in told.message
    now += 2 * SOURCE_TIMEOUT_S
    assert bus.with_diagnostics(status).state == "running"
