"""A hub that is stopped ends within seconds, says so meanwhile, and keeps its last answer; one that has just begun."""

from __future__ import annotations

import time
from unittest.mock import MagicMock

import pytest

from hub.live import agent
from hub.live.live_hub import LiveHub
from hub.live.solver import InlineSolver, SolverAnswer, SolverJob
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.topics import CAMERA_INFO, STATUS
from tests.support.samples import camera_info, eventually
from tests.support.threads import running


class _NeverDone(InlineSolver):
    """A job is under way whatever happens."""

    busy = True  # type: ignore[assignment]

    def submit(self, job: SolverJob, now: float) -> None:
        raise AssertionError("it is busy")

    def poll(self, now: float) -> SolverAnswer | None:
        return None


@pytest.mark.parametrize("calibrated", [True, False])
def test_it_waits_for_a_first_answer_longer_than_for_one_more(
    monkeypatch: pytest.MonkeyPatch, calibrated: bool
) -> None:
    monkeypatch.setattr(agent, "_FINISH_S", 0.3)
    monkeypatch.setattr(agent, "_FIRST_ANSWER_S", 1.0)
    monkeypatch.setattr(agent, "_STATUS_S", 0.1)
    monkeypatch.setattr(LiveHub, "state", lambda self, now: ("calibrated", ""))
    network, hub = MemoryHub(), LiveHub(solver=_NeverDone())
    with MemoryBus(network) as bus:
        statuses = bus.subscribe(STATUS)
        with running(lambda stop: agent.run_hub(hub, MemoryBus(network), "hub", stop)):
            assert eventually(lambda: statuses.drain() != [])
            hub.calibration = MagicMock(cameras={}, refused={}) if calibrated else None
            began = time.monotonic()
        took, last = time.monotonic() - began, [one.message for one in statuses.drain()]
    assert (0.3 if calibrated else 1.0) <= took < (0.9 if calibrated else 2.5)
    said = [(one.state, one.message) for one in last if one.state == "stopping"]  # type: ignore[attr-defined]
    assert said[0] == ("stopping", f"waits {0 if calibrated else 1} s at most for a last answer")
    assert len(said) > 2, "until the end"
    assert said[-1] == ("stopping", "it was stopped")


def test_a_hub_that_has_just_begun_does_not_say_that_cameras_send_no_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restarted, it knew the cameras from their descriptions a second before their first frames."""
    monkeypatch.setattr(agent, "_STATUS_S", 0.05)
    monkeypatch.setattr(agent, "SILENT_S", 0.6)
    network, said = MemoryHub(), list[str]()
    with MemoryBus(network) as bus:
        statuses, infos = bus.subscribe(STATUS), bus.publisher(CAMERA_INFO, "cam0")
        infos.put(camera_info("cam0"))

        def complains() -> bool:
            said.extend(one.message.message for one in statuses.drain())  # type: ignore[attr-defined]
            return any("cam0 sends no frames" in text for text in said)

        began = time.monotonic()
        with running(lambda stop: agent.run_hub(LiveHub(), MemoryBus(network), "hub", stop)):
            assert eventually(complains)
    assert time.monotonic() - began > 0.6
