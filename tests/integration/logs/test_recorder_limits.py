"""Limits of a recording: a full disk, the size and age of a file, and kill -9."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from datetime import datetime
from pathlib import Path

import pytest

from deploy.agents import recorder
from deploy.agents.recorder import RecorderResult, count_missing, record_on_command, run_recorder
from deploy.agents.retention import Retention, Space, free_bytes, unused_log_path
from deploy.cli import run
from deploy.commands.agents import run as agents
from deploy.config.agents import RecorderConfig
from protocols.bus.base import Bus
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError
from protocols.log.read.reader import LogReader
from protocols.log.read.recovery import recover
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, OBSERVATION, STATUS
from tests.integration.logs.test_record_replay import RECORDER
from tests.support.samples import eventually, observation
from tests.support.threads import running


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


def test_all_that_has_arrived_when_it_is_stopped_is_in_the_log(tmp_path: Path) -> None:
    """A queue gives 4,096 messages at once, and the rest of a fetched history was not written."""
    hub, stop = MemoryHub(), threading.Event()
    with MemoryBus(hub) as sending, MemoryBus(hub) as bus:
        camera = sending.publisher(OBSERVATION, "cam0")

        def send_and_stop() -> None:
            for number in range(10_000):
                camera.put(observation("cam0", number))
            stop.set()

        result = run_recorder(RecorderConfig(out=tmp_path / "a.mcap"), bus, stop, beat=send_and_stop)
    assert sum(item.topic is OBSERVATION for item in LogReader(result.path).messages()) == 10_000


def test_older_statuses_are_not_missed_but_images_of_a_flight_are() -> None:
    """Of statuses only the newest counts: over a slow link the recorder was degraded for them."""
    bus, topics = MemoryBus(MemoryHub()), (OBSERVATION, STATUS, FLIGHT_IMAGE)
    subscriptions = [bus.subscribe(topic) for topic in topics]
    for subscription, (lost, skipped) in zip(subscriptions, ((2, 0), (0, 50), (0, 7)), strict=True):
        subscription.inbox.count_lost(lost)
        subscription.inbox.count_skipped(skipped)
    assert count_missing(subscriptions, topics) == 9


def test_a_recording_does_not_start_on_a_full_disk(tmp_path: Path) -> None:
    with (
        MemoryBus(MemoryHub()) as bus,
        pytest.raises(InputError, match=r"not recorded: 5 MB are free .* make room, or lower min_free_mb"),
    ):
        run_recorder(RecorderConfig(out=tmp_path / "a.mcap"), bus, threading.Event(), free=lambda folder: 5_000_000)
    assert list(tmp_path.iterdir()) == []
    assert free_bytes(tmp_path / "not" / "there" / "yet") == pytest.approx(free_bytes(tmp_path), rel=0.01)


def test_a_recorder_waits_for_space_and_goes_on_in_a_new_log(tmp_path: Path) -> None:
    hub = MemoryHub()
    room = [500_000_000]
    with MemoryBus(hub) as sending, MemoryBus(hub) as bus:
        statuses = sending.subscribe(STATUS, "recorder")
        camera = sending.publisher(OBSERVATION, "cam0")

        def reported(state: str, text: str) -> bool:
            last = [one.message for one in statuses.drain()][-1:]
            return bool(last) and last[0].state == state and text in last[0].message  # type: ignore[attr-defined]

        config = RecorderConfig(out=tmp_path / "logs")
        with running(lambda stop: record_on_command(config, bus, stop, free=lambda _: room[0])):
            assert eventually(lambda: reported("running", "messages"))
            room[0] = 150_000_000
            assert eventually(lambda: reported("degraded", "not recording: 150 MB are free"))
            room[0] = 210_000_000
            time.sleep(0.3)
            assert eventually(lambda: reported("degraded", "not recording")), "a little more is no reason to begin"
            room[0] = 400_000_000
            assert eventually(lambda: reported("running", "messages"))
            camera.put(observation("cam0", 7))
            assert eventually(lambda: reported("running", "messages"))
            assert eventually(lambda: reported("running", "messages")), "the status after it, so that it is on the disk"
    first, second = sorted((tmp_path / "logs").glob("*.mcap"))
    assert [one.message.sequence for one in LogReader(second).messages([OBSERVATION])] == [7]  # type: ignore[attr-defined]
    assert LogReader(first).damage == LogReader(second).damage == ""


def test_a_disk_that_fails_at_every_try_is_told_between_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without limits of space a full disk was tried again without a pause, and no status said so."""
    hub = MemoryHub()
    statuses_before: list[list[pb.AgentStatus]] = []
    with MemoryBus(hub) as sending, MemoryBus(hub) as bus:
        statuses = sending.subscribe(STATUS, "recorder")

        def failing(config: RecorderConfig, bus: Bus, stop: threading.Event, **more: object) -> RecorderResult:
            statuses_before.append([one.message for one in statuses.drain() if isinstance(one.message, pb.AgentStatus)])
            if len(statuses_before) == 3:
                stop.set()
            return RecorderResult(config.out, 0, {}, 0, "no space left on the disk")

        monkeypatch.setattr(recorder, "run_recorder", failing)
        config = RecorderConfig(out=tmp_path, min_free_mb=0.0, min_free_percent=0.0)
        record_on_command(config, bus, threading.Event())
    for said in statuses_before[1:]:
        assert [(one.state, one.message) for one in said] == [("degraded", "not recording: no space left on the disk")]


def part(folder: Path, name: str, megabytes: float = 1.0, age_days: float = 0.0) -> Path:
    path = folder / name
    path.write_bytes(bytes(round(megabytes * 1e6)))
    written = time.time() - 86_400.0 * age_days
    os.utime(path, (written, written))
    return path


@pytest.mark.parametrize(
    ("keep", "left"),
    [
        ({"keep_mb": 2.5}, ["000002Z-001", "000002Z-002"]),
        ({"keep_days": 3.0}, ["000002Z-000", "000002Z-001", "000002Z-002"]),
        ({"keep_free_mb": 12.0}, ["000002Z-000", "000002Z-001", "000002Z-002"]),
        ({"keep_free_mb": 1000.0}, ["000002Z-002"]),
        ({}, ["000001Z-000", "000001Z-001", "000002Z-000", "000002Z-001", "000002Z-002"]),
    ],
)
def test_the_oldest_closed_files_go_first_and_the_present_one_never(
    tmp_path: Path, keep: dict[str, float], left: list[str]
) -> None:
    for number, name in enumerate(("000001Z-000", "000001Z-001", "000002Z-000", "000002Z-001", "000002Z-002")):
        part(tmp_path, f"syncline-20260101T{name}.mcap", age_days=4.0 if number < 2 else 1.0)
    other = part(tmp_path, "somebody-elses.mcap", age_days=1000.0)
    config = RecorderConfig(out=tmp_path, part_mb=1.0, min_free_mb=0.0, **keep)  # type: ignore[arg-type]

    def free(folder: Path) -> int:
        return 15_000_000 - sum(path.stat().st_size for path in folder.glob("syncline-*.mcap"))

    Retention(config, Space(config, free)).clean(tmp_path / "syncline-20260101T000002Z-002.mcap")
    assert [path.stem.partition("T")[2] for path in sorted(tmp_path.glob("syncline-*.mcap"))] == left
    assert other.exists()


def test_a_file_of_a_clock_that_was_never_set_has_no_age(tmp_path: Path) -> None:
    unset = part(tmp_path, "syncline-19700101T000010Z-000.mcap", age_days=20_000.0)
    part(tmp_path, "syncline-19700101T000010Z-001.mcap")
    config = RecorderConfig(out=tmp_path, part_mb=1.0, keep_days=1.0)
    Retention(config, Space(config)).clean(None)
    assert unset.exists()


def test_what_another_process_writes_is_not_deleted(tmp_path: Path) -> None:
    path = tmp_path / "syncline-20260101T000001Z-000.mcap"
    config = RecorderConfig(out=tmp_path, part_mb=1.0, keep_free_mb=1e9)
    with LogWriter(path):
        Retention(config, Space(config)).clean(None)
        assert path.exists()
    Retention(config, Space(config)).clean(None)
    assert not path.exists()


def test_names_are_unique_and_in_order_without_a_clock(tmp_path: Path) -> None:
    names = []
    for moment in ("1970-01-01T00:00:10", "1970-01-01T00:00:10", "2026-05-01T12:00:00", "1970-01-01T00:00:10") * 2:
        path = unused_log_path(tmp_path, datetime.fromisoformat(f"{moment}+00:00"))
        assert not path.exists()
        path.touch()
        names.append(path.stem)
    assert names == [
        "syncline-19700101T000010Z",
        "syncline-19700101T000010Z-after0001",
        "syncline-20260501T120000Z",
        *(f"syncline-20260501T120000Z-after{number:04d}" for number in range(1, 6)),
    ]
    assert names == sorted(names)


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
