"""What went over the bus is in the log, and what is in the log goes over the bus again."""

from __future__ import annotations

import io
import itertools
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest
from rich.console import Console

from deploy.agents.recorder import RecorderResult, log_path, run_recorder
from deploy.config.agents import RecorderConfig
from deploy.logs.info import as_table, describe_log
from deploy.logs.replay import replay
from protocols.bus.base import AgentEvent, Bus, Received, agent_status
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError
from protocols.log.read.reader import LogMessage, LogReader
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, OBSERVATION, PICTURE, STATUS, TOPICS, TRACK
from tests.support.samples import SAMPLES, camera_info, eventually, observation
from tests.support.threads import running

SECOND = 1_000_000_000


@contextmanager
def recording(path: Path, bus: Bus) -> Iterator[list[RecorderResult]]:
    """A recorder on its own thread; its result is in the list once the context is left."""
    results: list[RecorderResult] = []
    config = RecorderConfig(out=path)
    with running(lambda stop: results.append(run_recorder(config, bus, stop))):
        yield results


def observations(path: Path) -> list[LogMessage]:
    return list(LogReader(path).messages([OBSERVATION]))


def sequences(path: Path) -> list[int]:
    return [item.message.sequence for item in observations(path)]  # type: ignore[attr-defined]


RECORDED = [topic for topic in TOPICS if topic.recorded]


def source_log(path: Path, count: int = 100, hz: float = 50.0) -> Path:
    """Two cameras: a description each, then observations at ``hz``."""
    with LogWriter(path) as log:
        for camera in ("cam0", "cam1"):
            log.write(CAMERA_INFO, camera, "yard", camera_info(camera), 5 * SECOND)
        for index in range(count):
            for camera in ("cam0", "cam1"):
                time_ns = 5 * SECOND + round(index / hz * SECOND)
                log.write(OBSERVATION, camera, "yard", observation(camera, index), time_ns)
    return path


def test_every_recorded_topic_is_in_the_log_and_the_recorder_is_seen(tmp_path: Path) -> None:
    hub = MemoryHub()
    path = tmp_path / "a.mcap"
    with MemoryBus(hub) as agents, MemoryBus(hub) as bus:
        watch = agents.watch_agents()
        with recording(path, bus) as results:
            assert eventually(lambda: len(hub.subscriptions) == len(RECORDED))
            for topic in RECORDED:
                agents.publisher(topic, "cam0").put(SAMPLES[topic]())
        (result,) = results
        alive, gone = watch.drain()
        assert (alive.role, alive.agent, alive.alive) == ("record", "recorder", True)
        assert gone == AgentEvent("record", "recorder", alive.boot_id, False)
    reader = LogReader(path)
    logged = [item for item in reader.messages() if item.agent == "cam0"]
    assert {item.topic: item.message for item in logged} == {topic: SAMPLES[topic]() for topic in RECORDED}
    assert {item.site for item in logged} == {"local"}
    assert reader.damage == ""
    assert result.path == path
    assert result.messages == result.counters["recorded"] == sum(1 for _ in reader.messages())
    assert result.counters["dropped"] == result.counters["lost"] == 0
    assert reader.metadata()["syncline"]["boot_id"] == alive.boot_id


@pytest.mark.parametrize(("hz", "kept"), [(2.0, [0, 10, 20, 30]), (30.0, list(range(40))), (0.0, [])])
def test_pictures_are_thinned_and_not_even_asked_for_at_rate_0(tmp_path: Path, hz: float, kept: list[int]) -> None:
    """Forty pictures, 20 a second by the bus's clock."""
    now = iter(range(0, 1_000_000_000_000, 50_000_000))
    hub = MemoryHub(clock_ns=lambda: next(now))
    with MemoryBus(hub) as agents, MemoryBus(hub) as bus:
        publisher = agents.publisher(PICTURE, "cam0")
        config = RecorderConfig(out=tmp_path / "a.mcap", pictures_hz=hz)
        with running(lambda stop: run_recorder(config, bus, stop)):
            wanted = len(RECORDED) - (not kept)
            assert eventually(lambda: len(hub.subscriptions) == wanted)
            assert publisher.wait_matched(0.0) == bool(kept), "a camera sends only what somebody wants"
            for index in range(40):
                message = SAMPLES[PICTURE]()
                message.frame = index
                publisher.put(message)
    frames = [item.message.frame for item in LogReader(tmp_path / "a.mcap").messages([PICTURE])]  # type: ignore[attr-defined]
    if hz == 2.0:  # the recorder's own messages take some ticks of this clock
        assert 3 <= len(frames) <= 6
        assert min(b - a for a, b in itertools.pairwise(frames)) >= 8
    else:
        assert frames == kept


def test_log_times_are_the_times_of_arrival(tmp_path: Path) -> None:
    times = iter(range(1_000, 100_000_000))
    hub = MemoryHub(clock_ns=lambda: next(times))
    with MemoryBus(hub) as agents, MemoryBus(hub) as bus:
        publishers = [agents.publisher(OBSERVATION, camera) for camera in ("cam0", "cam1")]
        information = agents.publisher(CAMERA_INFO, "cam0")
        with recording(tmp_path / "a.mcap", bus):
            assert eventually(lambda: len(hub.subscriptions) == len(RECORDED))
            for index in range(50):
                for camera, publisher in enumerate(publishers):
                    publisher.put(observation(f"cam{camera}", index))
                information.put(camera_info("cam0"))
    logged = [item for item in LogReader(tmp_path / "a.mcap").messages() if item.topic is not STATUS]
    assert [item.agent for item in logged] == ["cam0", "cam1", "cam0"] * 50
    assert [item.topic.name for item in logged[:3]] == ["observation", "observation", "camera_info"]
    stamps = [item.log_time_ns for item in logged]
    assert stamps == sorted(set(stamps))


def test_the_recorder_tells_how_it_is(tmp_path: Path) -> None:
    hub = MemoryHub()
    with MemoryBus(hub) as agents, MemoryBus(hub) as bus:
        statuses = agents.subscribe(STATUS, "recorder")
        publisher = agents.publisher(OBSERVATION, "cam0")
        publisher.put(observation("cam1"))
        with recording(tmp_path / "a.mcap", bus):
            received: list[Received] = []
            assert eventually(lambda: bool(received.extend(statuses.drain()) or received))
    status = received[0].message
    assert isinstance(status, pb.AgentStatus)
    assert (status.role, status.state, status.sequence) == ("record", "running", 0)
    assert status.counters["rejected.wrong_sender"] == 1
    assert status.counters["recorded"] == 0


def test_recording_ends_when_the_condition_says_so(tmp_path: Path) -> None:
    hub = MemoryHub()
    with MemoryBus(hub) as agents, MemoryBus(hub) as bus:
        publisher = agents.publisher(OBSERVATION, "cam0")
        for index in range(10):
            publisher.put(observation("cam0", index))
        config = RecorderConfig(out=tmp_path / "a.mcap")
        result = run_recorder(config, bus, threading.Event(), stop_when=lambda messages: messages >= 10)
    assert sequences(result.path) == list(range(10))


def test_a_folder_gets_a_file_named_by_the_time(tmp_path: Path) -> None:
    now = datetime(2031, 2, 3, 4, 5, 6, tzinfo=UTC)
    assert log_path(tmp_path, now) == tmp_path / "syncline-20310203T040506Z.mcap"
    assert log_path(tmp_path / "x.mcap", now) == tmp_path / "x.mcap"


def test_an_existing_log_is_not_recorded_over(tmp_path: Path) -> None:
    path = source_log(tmp_path / "a.mcap")
    before = path.read_bytes()
    with MemoryBus(MemoryHub()) as bus, pytest.raises(InputError, match="exists already"):
        run_recorder(RecorderConfig(out=path), bus, threading.Event())
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", ["memory", "zenoh"])
def test_a_replayed_log_recorded_again_holds_the_same(tmp_path: Path, kind: str) -> None:
    source = source_log(tmp_path / "a.mcap", count=5000)
    endpoint = free_endpoint()
    hub = MemoryHub()
    config = BusConfig(mode="client", connect=(endpoint,))

    def connect() -> Bus:
        return MemoryBus(hub) if kind == "memory" else open_bus("local", config, timeout_s=10.0)

    with Router(endpoint), connect() as sending, connect() as receiving:
        # Memory has no link that slows the sender down, so it gets a source that fits the queue.
        if kind == "memory":
            source = source_log(tmp_path / "small.mcap", count=1000)
        with recording(tmp_path / "b.mcap", receiving) as results:
            count = replay(source, sending, rate=0.0)
            last = max(sequences(source))
            assert eventually(lambda: sequences_reach(tmp_path / "b.mcap", last))
    assert results[0].counters["dropped"] == results[0].counters["lost"] == 0
    assert count == sum(1 for _ in LogReader(source).messages())
    for camera in ("cam0", "cam1"):
        again = [item.message for item in observations(tmp_path / "b.mcap") if item.agent == camera]
        assert again == [item.message for item in observations(source) if item.agent == camera]
    infos = {item.agent: item.message for item in LogReader(tmp_path / "b.mcap").messages([CAMERA_INFO])}
    assert infos == {camera: camera_info(camera) for camera in ("cam0", "cam1")}


def sequences_reach(path: Path, last: int) -> bool:
    """Whether both cameras' last observation is in a log that is still being written."""
    ends = {item.agent: item.message.sequence for item in observations(path)}  # type: ignore[attr-defined]
    return ends == {"cam0": last, "cam1": last}


def test_replay_keeps_the_pace_that_it_is_asked_for(tmp_path: Path) -> None:
    source = source_log(tmp_path / "a.mcap", count=51, hz=50.0)
    hub = MemoryHub(clock_ns=time.monotonic_ns)
    with MemoryBus(hub) as sending, MemoryBus(hub) as receiving:
        subscription = receiving.subscribe(OBSERVATION, "cam0")
        assert replay(source, sending, rate=5.0, wait_s=0.0) == 104
        received = subscription.drain()
    assert [item.message.sequence for item in received] == list(range(51))  # type: ignore[attr-defined]
    first = received[0].arrival_ns
    late = [(item.arrival_ns - first) / SECOND - index / 250.0 for index, item in enumerate(received)]
    assert min(late) > -0.005, "nothing comes before its time"
    assert min(late[25:]) < 0.3, "at a rate of one they would be 0.4 s late and more"


def test_replay_can_choose_where_to_begin_and_what_to_send(tmp_path: Path) -> None:
    source = source_log(tmp_path / "a.mcap")
    hub = MemoryHub()
    with MemoryBus(hub) as sending, MemoryBus(hub) as receiving:
        everything = receiving.subscribe(OBSERVATION)
        information = receiving.subscribe(CAMERA_INFO)
        sent = replay(source, sending, rate=0.0, start_s=1.0, topics=["observation"], wait_s=0.0)
        received = everything.drain()
        assert sent == len(received) == 100
        assert min(item.message.sequence for item in received) == 50  # type: ignore[attr-defined]
        assert information.drain() == []
        assert replay(source, sending, rate=0.0, site="hall", wait_s=0.0) == 0
        assert replay(source, sending, rate=0.0, site="yard", wait_s=0.0) == 202


def test_replay_stops_when_told_to(tmp_path: Path) -> None:
    source = source_log(tmp_path / "a.mcap", count=500, hz=10.0)
    stop = threading.Event()
    with MemoryBus(MemoryHub()) as bus:
        began = time.monotonic()
        sent = replay(source, bus, stop=stop, wait_s=0.0, progress=lambda n, at: stop.set() if n >= 6 else None)
    assert sent == 6
    assert time.monotonic() - began < 5.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rate": -1.0}, "rate -1.0 is out of range"),
        ({"rate": float("nan")}, "rate nan is out of range"),
        ({"start_s": -2.0}, "start -2.0 s is out of range"),
        ({"topics": ["images"]}, "no topic 'images'"),
    ],
)
def test_a_replay_that_makes_no_sense_is_refused(tmp_path: Path, arguments: dict[str, float], message: str) -> None:
    source = source_log(tmp_path / "a.mcap", count=1)
    with MemoryBus(MemoryHub()) as bus, pytest.raises(InputError, match=message):
        replay(source, bus, **arguments)  # type: ignore[arg-type]


def test_a_log_is_described_with_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path, {"syncline": {"seed": "7"}}) as log:
        log.attach("rig.toml", "application/toml", b"x = 1")
        for boot in ("boot-1", "boot-2"):
            for index in (0, 1, 2, 5):
                log.write(OBSERVATION, "cam0", "local", observation("cam0", index, boot, points=2), index * SECOND)
    description = describe_log(path)
    (topic,) = description.topics
    assert (topic.topic, topic.agent, topic.count, topic.last_s) == ("observation", "cam0", 8, 5.0)
    assert topic.rate_hz == pytest.approx(30 * 3 / 5), "of the cameras' own times: 4 of 6 frames at 30 Hz"
    assert [(camera.boot_id, camera.observations, camera.missing) for camera in description.cameras] == [
        ("boot-1", 4, 2),
        ("boot-2", 4, 2),
    ]
    assert description.cameras[0].detections == 8
    assert (description.duration_s, description.messages, description.damage) == (5.0, 8, "")
    assert description.metadata == {"syncline": {"seed": "7"}}
    assert [(item.name, item.bytes) for item in description.attachments] == [("rig.toml", 5)]


def test_what_a_camera_says_that_it_published_is_missing_too(tmp_path: Path) -> None:
    """As where a link was cut until the recording ended: no later number shows that anything is missing."""
    path = tmp_path / "a.mcap"
    with LogWriter(path, {}) as log:
        for index in range(4):
            log.write(OBSERVATION, "cam0", "local", observation("cam0", index, "boot-1"), index * SECOND)
        for camera, published in (
            ("cam0", 3),
            ("cam0", 9),
            ("cam1", 5),
            ("cam1", 8),
        ):
            counters = {"published": published, "unpublished": 1}
            status = agent_status("camera", camera, "boot-1", 0, "running", "", counters)
            log.write(STATUS, camera, "local", status, published * SECOND)
        hub = agent_status("hub", "hub", "h", 0, "running", "", {"published": 7})
        log.write(STATUS, "hub", "local", hub, 9 * SECOND)
    missing = [(camera.camera, camera.observations, camera.missing) for camera in describe_log(path).cameras]
    assert missing == [("cam0", 4, 6), ("cam1", 0, 4)]


def test_what_was_fetched_at_once_has_the_rate_of_its_cameras(tmp_path: Path) -> None:
    """A history's messages arrive within microseconds: 2,000,000 Hz. A step of the clock is no time that passed."""
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        for index in range(300):
            message = observation("cam0", index, "boot-1")
            message.device_time_ns += 5000 * SECOND if index >= 150 else 0
            log.write(OBSERVATION, "cam0", "local", message, SECOND + 500 * index)
            log.write(TRACK, "hub", "local", pb.Track(schema_version=1, label="marker"), SECOND + 500 * index)
    rates = {one.topic: one.rate_hz for one in describe_log(path).topics}
    assert rates == {"observation": pytest.approx(30.0, rel=0.01), "track": 0.0}


def test_the_table_shows_damage_and_counts(tmp_path: Path) -> None:
    whole = source_log(tmp_path / "a.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:-20])
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(as_table(describe_log(tmp_path / "cut.mcap")))
    text = console.export_text()
    assert "damaged: the record at byte" in text
    assert "syncline/yard/camera/cam1/observation" in text
    assert "202 messages" in text


RECORDER = """
import sys
from pathlib import Path
from deploy.config.agents import RecorderConfig
from deploy.agents.recorder import run_recorder
from deploy.agents.processes import stop_on_signals
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
stop = stop_on_signals()
config = RecorderConfig(out=Path(sys.argv[2]), bus=BusConfig(mode="client", connect=(sys.argv[1],)))
with open_bus(config.site, config.bus, stop=stop.is_set) as bus:
    print(run_recorder(config, bus, stop).messages)
"""


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_however_a_recorder_ends_its_log_can_be_read(tmp_path: Path, end: signal.Signals) -> None:
    """After kill -9 everything up to the last report is there, in order and without a gap."""
    endpoint, path = free_endpoint(), tmp_path / "a.mcap"
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as bus:
        statuses = bus.subscribe(STATUS, "recorder")
        publisher = bus.publisher(OBSERVATION, "cam0")
        process = subprocess.Popen(
            [sys.executable, "-c", RECORDER, endpoint, str(path)], stdout=subprocess.PIPE, text=True
        )
        sent = 0
        reported: list[float] = []

        def enough() -> bool:
            nonlocal sent
            publisher.put(observation("cam0", sent))
            sent += 1
            reported.extend(
                item.message.counters["recorded"]  # type: ignore[attr-defined]
                for item in statuses.drain()
            )
            return bool(reported) and reported[-1] > 50

        try:
            assert eventually(enough, 20.0), reported
            process.send_signal(end)
            output, _ = process.communicate(timeout=10.0)
        finally:
            process.kill()
            process.wait()
    reader = LogReader(path)
    messages = list(reader.messages())
    recorded = [item.message.sequence for item in messages if item.topic is OBSERVATION]  # type: ignore[attr-defined]
    assert recorded == list(range(len(recorded)))
    assert len(messages) >= reported[-1]
    if end == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL
        assert "its writer did not close it" in reader.damage
    else:
        assert process.returncode == 0
        assert reader.damage == ""
        assert int(output) == len(messages)
