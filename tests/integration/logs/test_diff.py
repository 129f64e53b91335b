"""`replay --compare` finds what differs, and only that; a replay through the hub gives equal bytes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from google.protobuf.message import Message

from deploy.cli import run
from deploy.logs.replay import replay
from deploy.logs.replay_hub import replay_through_hub
from hub.live.live_hub import LiveSettings
from hub.view.player import LogRecording
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.clocks import NANOSECONDS
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, STATUS, TRACK, Topic
from tests.integration.live.test_live_hub import messages as session_messages
from tests.support.command_line import refusal
from tests.support.rigs import simulate
from tests.support.samples import calibration, camera_info, observation, status, track

Item = tuple[Topic, str, Message]


def items() -> list[Item]:
    out: list[Item] = [(CAMERA_INFO, "cam0", camera_info()), (CALIBRATION, "hub", calibration())]
    for index in range(20):
        out += [(OBSERVATION, "cam0", observation("cam0", index)), (TRACK, "hub", track(index))]
    return [*out, (STATUS, "hub", status("hub"))]


def write(path: Path, content: list[Item], site: str = "local", later_ns: int = 0) -> Path:
    path.unlink(missing_ok=True)
    with LogWriter(path) as log:
        for number, (topic, agent, message) in enumerate(content):
            log.write(topic, agent, site, message, number * 1000 + later_ns)
    return path


def compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[list[Item]], object], *options: str
) -> tuple[int, dict[str, object]]:
    """Exit status and the JSON of comparing the original with a changed copy."""
    content = items()
    change(content)
    write(tmp_path / "a.mcap", items())
    other = write(tmp_path / "b.mcap", content)
    code = run(["replay", str(tmp_path / "a.mcap"), "--compare", str(other), "--json", *options])
    return code, json.loads(capsys.readouterr().out)


def test_equal_messages_are_equal_whenever_and_wherever_they_were_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = write(tmp_path / "a.mcap", items()), write(tmp_path / "b.mcap", items(), "yard", 777)
    assert run(["replay", str(a), "--compare", str(b)]) == 0
    assert "equal: 43 messages compared" in capsys.readouterr().out


def test_missing_and_extra_messages_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = compared(tmp_path, capsys, lambda content: content.pop(10))
    assert code == 3
    assert found["missing"] == {"camera/cam0/observation": 1}
    assert (found["extra"], found["order"], found["fields"]) == ({}, "", [])
    code, found = compared(tmp_path, capsys, lambda content: content.append((TRACK, "hub", track(99))))
    assert (code, found["extra"], found["compared"]) == (3, {"hub/hub/track": 1}, 43)


def test_a_different_order_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = compared(tmp_path, capsys, lambda content: content.insert(9, content.pop(8)))
    assert code == 3
    assert found["order"] == "differs from message 8 on: camera/cam0/observation 3 against hub/hub/track 3"
    assert (found["fields"], found["missing"]) == ([], {})


def test_fields_are_reported_with_their_largest_difference_and_the_first_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(content: list[Item]) -> None:
        content[4][2].detections[0].u += 0.25  # type: ignore[attr-defined]
        content[8][2].detections[0].u -= 0.5  # type: ignore[attr-defined]
        content[5][2].position[2] += 1e-9  # type: ignore[attr-defined]
        content[5][2].state = "coasting"  # type: ignore[attr-defined]
        content[-1][2].gauges["fps"] = 30.0  # type: ignore[attr-defined]

    code, found = compared(tmp_path, capsys, change)
    assert code == 3
    fields = {entry["field"]: entry for entry in found["fields"]}  # type: ignore[attr-defined]
    assert set(fields) == {"observation.detections.u", "track.position", "track.state", "status.gauges"}
    u = fields["observation.detections.u"]
    assert (u["messages"], u["largest"]) == (2, 0.5)
    assert u["first"] == "camera/cam0/observation 1: 320.5 against 320.75"
    assert fields["track.state"]["largest"] is None
    assert fields["status.gauges"]["largest"] == pytest.approx(0.03)


def test_a_tolerance_applies_to_its_field_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def change(content: list[Item]) -> None:
        content[4][2].detections[0].u += 0.25  # type: ignore[attr-defined]
        content[4][2].detections[0].v += 0.25  # type: ignore[attr-defined]

    _, found = compared(tmp_path, capsys, change, "--tolerance", "observation.detections.u=0.25")
    assert [entry["field"] for entry in found["fields"]] == ["observation.detections.v"]  # type: ignore[attr-defined]
    both = ("--tolerance", "observation.detections.u=0.25", "--tolerance", "observation.detections.v=0.3")
    assert compared(tmp_path, capsys, change, *both)[0] == 0
    assert compared(tmp_path, capsys, change, "--topics", "track")[0] == 0
    assert compared(tmp_path, capsys, change, "--topics", "track", "observation")[0] == 3
    assert compared(tmp_path, capsys, change, "--topics", "track", "status")[0] == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--compare", "b.mcap"], "No such file"),
        (["--compare", "a.mcap", "--tolerance", "track.place=1"], "there is no number 'track.place'"),
        (["--compare", "a.mcap", "--tolerance", "track.position=near"], "is not field=number"),
        (["--compare", "a.mcap", "--loop"], "--compare publishes nothing"),
        (["--compare", "a.mcap", "--topics", "tracks"], "there is no topic 'tracks'"),
        (["--tolerance", "track.position=1"], "--tolerance goes with --compare"),
        (["--through", "hub"], "--through and --out go together"),
        (["--through", "hub", "--out", "a.mcap"], "exists already"),
        (["--through", "hub", "--out", "new.mcap"], "no observation in this log"),
        (["--start", "nan"], "--start nan is out of range"),
    ],
)
def test_invalid_options_are_one_line_and_status_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write(Path("a.mcap"), [(CAMERA_INFO, "cam0", camera_info()), (TRACK, "hub", track())])
    assert said in refusal(capsys, ["replay", "a.mcap", *options])
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_loop_replays_the_log_with_new_boot_ids(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", items())
    hub = MemoryHub(clock_ns=time.monotonic_ns)
    with MemoryBus(hub) as sending, MemoryBus(hub) as receiving:
        replayed, solved = receiving.subscribe(OBSERVATION), receiving.subscribe(CALIBRATION)

        def enough(count: int, at_s: float) -> None:
            if count >= 2 * 43 + 5:
                stop.set()

        stop = threading.Event()
        sent = replay(path, sending, rate=0.0, loop=True, wait_s=0.0, stop=stop, progress=enough)
        boots = [item.message.boot_id for item in replayed.drain()]  # type: ignore[attr-defined]
        cameras = [item.message.cameras[0].boot_id for item in solved.drain()]  # type: ignore[attr-defined]
    assert sent == 2 * 43 + 5
    assert boots[:40] == ["boot-1"] * 20 + ["boot-1-1"] * 20
    assert set(boots[40:]) == {"boot-1-2"}
    assert cameras == ["boot-1", "boot-1-1", "boot-1-2"]


def test_an_empty_log_is_not_looped_forever(tmp_path: Path) -> None:
    with MemoryBus(MemoryHub()) as bus:
        assert replay(write(tmp_path / "a.mcap", []), bus, loop=True, wait_s=0.0) == 0


def test_a_replay_through_the_hub_gives_equal_bytes(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        stream = session_messages(simulate(71, 3, 20))
        for number, message in enumerate(stream):
            topic = CAMERA_INFO if isinstance(message, pb.CameraInfo) else OBSERVATION
            log.write(topic, message.camera, "yard", message, number * 20 * NANOSECONDS // len(stream))  # type: ignore[attr-defined]
    settings = LiveSettings(interval_s=12.0)
    counts = [replay_through_hub(tmp_path / "a.mcap", tmp_path / name, settings) for name in ("b.mcap", "c.mcap")]
    assert counts[0] == counts[1] > 100
    assert (tmp_path / "b.mcap").read_bytes() == (tmp_path / "c.mcap").read_bytes()
    solved = [item.message for item in LogReader(tmp_path / "b.mcap").messages([CALIBRATION])]
    assert [message.status for message in solved] == ["collecting", "solved", "solved"]  # type: ignore[attr-defined]


def test_a_damaged_log_is_named_by_every_reader(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = write(tmp_path / "whole.mcap", items()).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:-100])
    for name, damaged in (("whole", False), ("cut", True)):
        path = tmp_path / f"{name}.mcap"
        assert run(["replay", str(path), "--through", "hub", "--out", str(tmp_path / f"{name}-hub.mcap")]) == 0
        assert ("cut.mcap: damaged: " in capsys.readouterr().err) == damaged
        assert bool(LogRecording(path).damage) == damaged
