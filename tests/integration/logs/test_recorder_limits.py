"""Limits of a recording: a full disk, the size and age of a file, and kill -9."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from deploy.agents.recorder import free_bytes, run_recorder
from deploy.cli import run
from deploy.commands.agents import run as agents
from deploy.config.agents import RecorderConfig
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError
from protocols.log.read.reader import LogReader
from protocols.log.read.recovery import recover
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION, STATUS
from tests.integration.logs.test_record_replay import RECORDER
from tests.support.samples import eventually, observation


def test_recording_ends_with_a_complete_log_before_the_disk_is_full(tmp_path: Path) -> None:
    hub = MemoryHub()
    room = iter([500_000_000, 300_000_000, 199_000_000])
    with MemoryBus(hub) as sending, MemoryBus(hub) as bus:
        statuses = sending.subscribe(STATUS, "recorder")
        sending.publisher(OBSERVATION, "cam0").put(observation("cam0"))
        config = RecorderConfig(out=tmp_path / "a.mcap")
        deadline = time.monotonic() + 10.0
        result = run_recorder(
            config,
            bus,
            threading.Event(),
            stop_when=lambda messages: time.monotonic() > deadline,
            free=lambda folder: next(room),
        )
        last = statuses.drain()[-1].message
    assert result.stopped == "199 MB are free on the disk, min_free_mb is 200"
    assert isinstance(last, pb.AgentStatus)
    assert (last.state, last.message) == ("stopping", f"recording ended: {result.stopped}")
    reader = LogReader(result.path)
    assert [item.topic for item in reader.messages()][:1] == [OBSERVATION]
    assert reader.damage == ""


def test_a_recording_does_not_start_on_a_full_disk(tmp_path: Path) -> None:
    with (
        MemoryBus(MemoryHub()) as bus,
        pytest.raises(InputError, match=r"not recorded: 5 MB are free .* make room, or lower min_free_mb"),
    ):
        run_recorder(RecorderConfig(out=tmp_path / "a.mcap"), bus, threading.Event(), free=lambda folder: 5_000_000)
    assert list(tmp_path.iterdir()) == []
    assert free_bytes(tmp_path / "not" / "there" / "yet") == pytest.approx(free_bytes(tmp_path), rel=0.01)


def test_a_recorder_writes_parts_that_form_one_session(tmp_path: Path) -> None:
    times = iter(range(10**9, 10**13, 10**7))  # 10 ms from message to message
    hub = MemoryHub(clock_ns=lambda: next(times))
    with MemoryBus(hub) as sending, MemoryBus(hub) as bus:
        publisher = sending.publisher(OBSERVATION, "cam0")
        for index in range(500):
            publisher.put(observation("cam0", index))
        config = RecorderConfig(out=tmp_path / "a.mcap", part_s=2.0)
        result = run_recorder(config, bus, threading.Event(), stop_when=lambda messages: messages >= 500)
    assert result.path == tmp_path / "a-000.mcap"
    assert result.parts == len(list(tmp_path.iterdir())) == 3
    reader = LogReader(result.path)
    numbers = [item.message.sequence for item in reader.messages([OBSERVATION])]  # type: ignore[attr-defined]
    assert numbers == list(range(500))
    assert "recorder.toml" in reader.metadata()["configuration"]
    keys = {item.key for item in reader.raw()}
    assert "foxglove/local/cam0/annotations" in keys, "viewers get theirs unless they are turned off"


def test_channels_for_viewers_can_be_disabled(tmp_path: Path) -> None:
    with MemoryBus(hub := MemoryHub()) as sending, MemoryBus(hub) as bus:
        sending.publisher(OBSERVATION, "cam0").put(observation("cam0"))
        config = RecorderConfig(out=tmp_path / "a.mcap", foxglove=False)
        run_recorder(config, bus, threading.Event(), stop_when=lambda messages: messages >= 1)
    assert not [item for item in LogReader(tmp_path / "a.mcap").raw() if item.key.startswith("foxglove/")]


def test_kill_9_loses_less_than_a_second(tmp_path: Path) -> None:
    """A real recorder behind a router: what it received more than a second before is in the log.

    The messages are so small that two seconds of them do not fill a chunk: only syncing brings them to the disk.
    """
    endpoint, path = free_endpoint(), tmp_path / "a.mcap"
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as bus:
        statuses = bus.subscribe(STATUS, "recorder")
        publisher = bus.publisher(OBSERVATION, "cam0")
        process = subprocess.Popen([sys.executable, "-c", RECORDER, endpoint, str(path)])
        try:
            assert eventually(lambda: bool(statuses.drain()), 20.0)
            sent_at = []
            while len(sent_at) < 200:
                publisher.put(observation("cam0", len(sent_at), points=0))
                sent_at.append(time.time())
                time.sleep(0.01)
            process.send_signal(signal.SIGKILL)
            killed_at = time.time()
        finally:
            process.kill()
            process.wait()
    reader = LogReader(path)
    recorded = [item.message.sequence for item in reader.messages([OBSERVATION])]  # type: ignore[attr-defined]
    assert recorded == list(range(len(recorded)))
    assert reader.cut
    # The bound is the sync's half second, the tick and the link; a busy machine adds to the delay in sent_at.
    behind = sum(1 for at in sent_at if at < killed_at - 1.0) - len(recorded)
    assert behind <= 0, f"{behind} messages older than a second are lost"
    fixed = recover(path, tmp_path / "fixed.mcap")
    assert fixed.cut
    assert LogReader(tmp_path / "fixed.mcap").summary().messages == fixed.messages >= len(recorded)


def test_the_command_reports_a_full_disk_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(agents, "stop_on_signals", threading.Event)  # pytest's own handlers stay
    config = tmp_path / "recorder.toml"
    endpoint = free_endpoint()
    config.write_text(
        f'out = "{tmp_path}/a.mcap"\nmin_free_mb = 1e9\n[bus]\nmode = "client"\nconnect = ["{endpoint}"]\n',
        encoding="utf-8",
    )
    with Router(endpoint):
        assert run(["record", str(config)]) == 2
    error = capsys.readouterr().err
    assert "a.mcap: not recorded: " in error
    assert "min_free_mb is 1e+09; make room, or lower min_free_mb" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a.mcap").exists()
