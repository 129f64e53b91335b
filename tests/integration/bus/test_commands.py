"""Buttons: what a view asks for is done once, by the run that it was asked of."""

from __future__ import annotations

import threading
from pathlib import Path

from deploy.agents.recorder import record_on_command, with_unused_log_path
from deploy.config.agents import RecorderConfig
from hub.live.agent import run_hub
from hub.live.live_hub import LiveHub
from protocols.bus.base import CommandSubscription
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, COMMAND, OBSERVATION, STATUS
from tests.support.samples import camera_info, eventually, observation
from tests.support.threads import running


def command(action: str, agent: str, agent_boot: str, sequence: int = 0) -> pb.Command:
    return pb.Command(
        schema_version=1,
        sender="view-1",
        boot_id="view-boot",
        sequence=sequence,
        action=action,
        agent=agent,
        agent_boot=agent_boot,
    )


class Site:
    """A memory bus with a view's publisher and the last status of every agent."""

    def __init__(self) -> None:
        self.network = MemoryHub()
        self.bus = MemoryBus(self.network)
        self.commands = self.bus.publisher(COMMAND, "view-1")
        self._statuses = self.bus.subscribe(STATUS)
        self._last: dict[str, pb.AgentStatus] = {}
        self._sequence = 0

    def status(self, agent: str) -> pb.AgentStatus | None:
        for received in self._statuses.drain():
            assert isinstance(received.message, pb.AgentStatus)
            self._last[received.message.agent] = received.message
        return self._last.get(agent)

    def said(self, agent: str, text: str) -> bool:
        found = self.status(agent)
        return found is not None and text in found.message

    def ask(self, action: str, agent: str) -> None:
        found = self.status(agent)
        assert found is not None
        self.commands.put(command(action, agent, found.boot_id, self._sequence))
        self._sequence += 1


def test_an_order_is_obeyed_once_and_only_by_the_run_that_was_meant() -> None:
    with MemoryBus(MemoryHub()) as bus:
        orders = CommandSubscription(bus, "hub", "boot-2", ("recalibrate", "export"))
        publisher = bus.publisher(COMMAND, "view-1")
        publisher.put(command("recalibrate", "hub", "boot-1", 0))  # of its run before
        publisher.put(command("recalibrate", "hub-b", "boot-2", 1))  # of another
        publisher.put(command("stop_recording", "hub", "boot-2", 2))  # not its business
        publisher.put(command("export", "hub", "boot-2", 3))
        publisher.put(command("export", "hub", "boot-2", 3))  # received twice
        publisher.put(command("recalibrate", "hub", "boot-2", 4))
        assert orders.take() == ["export", "recalibrate"]
        assert orders.take() == []


def test_the_hub_forgets_when_asked_and_says_what_it_exported() -> None:
    site, hub = Site(), LiveHub()
    exported: list[str] = []

    def export(asked: LiveHub) -> str:
        exported.append("now")
        return "exported to somewhere"

    def work(stop: threading.Event) -> None:
        with MemoryBus(site.network) as bus:
            run_hub(hub, bus, "hub", stop, export=export)

    cameras = {name: site.bus.publisher(OBSERVATION, name) for name in ("cam0", "cam1")}
    with running(work):
        assert eventually(lambda: site.status("hub") is not None)
        for name in cameras:
            site.bus.publisher(CAMERA_INFO, name).put(camera_info(name))
        for index in range(60):
            for name, publisher in cameras.items():
                message = observation(name, index)
                message.detections[0].kind = "marker"
                publisher.put(message)
        assert eventually(lambda: "cam1 60" in hub.missing())
        site.ask("recalibrate", "hub")
        assert eventually(lambda: site.said("hub", "recalibrating, as requested"))
        assert "cam1 60" not in hub.missing()
        site.ask("export", "hub")
        assert eventually(lambda: site.said("hub", "exported to somewhere"))
        assert exported == ["now"]


def test_a_recorder_stops_and_starts_and_every_log_is_whole(tmp_path: Path) -> None:
    site = Site()
    config = RecorderConfig(out=tmp_path / "a.mcap", min_free_mb=0.0)

    def work(stop: threading.Event) -> None:
        with MemoryBus(site.network) as bus:
            record_on_command(config, bus, stop)

    camera = site.bus.publisher(OBSERVATION, "cam0")
    with running(work):
        assert eventually(lambda: site.status("recorder") is not None)
        camera.put(observation("cam0", 0))
        assert eventually(lambda: site.said("recorder", " messages"))
        site.ask("stop_recording", "recorder")
        assert eventually(lambda: site.said("recorder", "paused after a.mcap"))
        paused = site.status("recorder")
        assert paused is not None
        assert paused.gauges["recording"] == 0.0
        reader = LogReader(tmp_path / "a.mcap")
        assert [item.message.sequence for item in reader.messages([OBSERVATION])] == [0]  # type: ignore[attr-defined]
        assert reader.damage == ""
        camera.put(observation("cam0", 1))
        site.ask("start_recording", "recorder")
        assert eventually((tmp_path / "a-2.mcap").exists)
        assert eventually(lambda: site.said("recorder", " messages"))
        camera.put(observation("cam0", 2))
    again = LogReader(tmp_path / "a-2.mcap")
    numbers = [item.message.sequence for item in again.messages([OBSERVATION])]  # type: ignore[attr-defined]
    # What came during the pause may be had from the camera's cache; nothing may be missing after it.
    assert numbers[-1] == 2
    assert again.damage == ""


def test_each_recording_gets_a_name_of_its_own(tmp_path: Path) -> None:
    config = RecorderConfig(out=tmp_path / "a.mcap")
    for taken, expected in (("a.mcap", "a-2.mcap"), ("a-2.mcap", "a-3.mcap"), ("a-3-000.mcap", "a-4.mcap")):
        (tmp_path / taken).touch()
        assert with_unused_log_path(config).out.name == expected
    assert with_unused_log_path(RecorderConfig(out=tmp_path)).out == tmp_path
