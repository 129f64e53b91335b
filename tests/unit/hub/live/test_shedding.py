"""A hub that is behind leaves out predictions first, counts what it leaves out, and says so."""

from __future__ import annotations

import itertools
import time

import pytest

from hub.live import agent
from hub.live.fair_share import FairShare, Shedding
from hub.live.live_hub import LiveHub
from hub.view.state import ViewState
from protocols.bus.base import Received
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION, STATUS
from tests.support.samples import eventually, observation
from tests.support.threads import running


def test_predictions_go_first_then_smoothed_tracks_and_the_status_says_how_late() -> None:
    shedding = Shedding()
    shedding.see(0.1, 0.0)
    assert not shedding.sheds_predictions
    assert shedding.text(0.0) == ""
    shedding.see(0.4, 1.0)
    assert shedding.sheds_predictions
    assert not shedding.sheds_smoothed
    shedding.see(1.5, 1.1)
    assert shedding.sheds_smoothed
    shedding.see(0.0, 1.2)
    assert not shedding.sheds_predictions
    assert shedding.text(1.3) == "up to 1.5 s behind its messages: predictions and smoothed tracks are left out"
    assert shedding.text(4.0) == ""


def test_one_who_sends_too_much_makes_the_hub_late_for_nobody_else() -> None:
    shares = FairShare(lambda one: None, lambda: 0.0, 0.4)

    def received(camera: str, age_s: float) -> Received:
        return Received(OBSERVATION, camera, pb.Observation(camera=camera), -round(age_s * 1e9))

    flooded = [received("flood", 9.0), *(received(camera, 0.01) for camera in "abc")]
    shares.take(flooded)
    assert shares.age_s(0) == pytest.approx(0.01)
    shares.take([received(camera, 0.7) for camera in "abc"])
    assert shares.age_s(0) == pytest.approx(0.7)
    shares.take([])
    assert shares.age_s(0) == 0.0


def test_a_late_hub_is_degraded_on_the_page_until_it_has_caught_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "_BACKLOG_S", 0.0)
    monkeypatch.setattr(agent, "_STATUS_S", 0.05)
    monkeypatch.setattr("hub.live.fair_share._STATED_S", 0.3)
    monkeypatch.setattr(LiveHub, "state", lambda self, now: ("calibrated", ""))
    late_s, view = [5.0], ViewState()
    network = MemoryHub(clock_ns=lambda: time.time_ns() - round(late_s[0] * 1e9))
    with MemoryBus(network) as bus:
        statuses, camera = bus.subscribe(STATUS), bus.publisher(OBSERVATION, "cam0")

        numbers = itertools.count()

        def says_it_is_late() -> bool | None:
            camera.put(observation("cam0", next(numbers)))
            for received in statuses.drain():
                view.handle(received.message, 0.0)
            return any("behind its messages" in text for text in view.problems(0.0)) if view.of_role("hub") else None

        with running(lambda stop: agent.run_hub(LiveHub(), MemoryBus(network), "hub", stop)):
            assert eventually(lambda: says_it_is_late() is True)
            late_s[0] = 0.0
            assert eventually(lambda: says_it_is_late() is False)
