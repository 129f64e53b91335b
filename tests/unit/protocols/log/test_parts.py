"""A log in several files reads as one; missing parts are reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.cli import run
from protocols.core.errors import InputError
from protocols.log.read.reader import LogMessage, LogReader, find_parts
from protocols.log.read.recovery import recover
from protocols.log.read.session import load_session
from protocols.log.write.rotation import RotatingWriter
from protocols.log.write.writer import LogWriter
from protocols.topics import CAMERA_INFO, OBSERVATION
from tests.support.samples import camera_info, observation

SECOND = 1_000_000_000


def write_parts(path: Path, count: int = 50, session: str = "s1", **bounds: float) -> list[LogMessage]:
    """One camera at 1 Hz; synced after each message, so that sizes are the file's."""
    written = []
    with RotatingWriter(path, {"syncline": {"seed": "7"}}, session, **bounds) as log:  # type: ignore[arg-type]
        log.attach("rig.toml", "application/toml", b"x = 1")
        for index in range(count):
            item = LogMessage(OBSERVATION, "cam0", "local", observation("cam0", index), index * SECOND)
            log.write(item.topic, item.agent, item.site, item.message, item.log_time_ns)
            log.sync()
            written.append(item)
    return written


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_new_part_begins_when_the_last_is_old_enough(tmp_path: Path) -> None:
    written = write_parts(tmp_path / "a.mcap", max_s=20.0)
    assert names(tmp_path) == ["a-000.mcap", "a-001.mcap", "a-002.mcap"]
    for path in (tmp_path, tmp_path / "a-000.mcap"):
        reader = LogReader(path)
        assert list(reader.messages()) == written
        assert reader.damage == ""
        assert [item.name for item in reader.attachments()] == ["rig.toml"]
        assert reader.metadata() == {"syncline": {"seed": "7"}}
    alone = LogReader(tmp_path / "a-001.mcap")
    assert [item.log_time_ns // SECOND for item in alone.messages()] == list(range(20, 40))
    assert alone.format["part"] == "1"


def test_a_new_part_begins_when_the_last_is_large_enough(tmp_path: Path) -> None:
    written = write_parts(tmp_path / "a.mcap", max_bytes=5_000)
    sizes = [path.stat().st_size for path in LogReader(tmp_path).paths]
    assert len(sizes) > 2
    # The closing index of each part comes on top: a line for every chunk, of which there is one a message here.
    assert all(5_000 < size < 20_000 for size in sizes[:-1])
    assert list(LogReader(tmp_path).messages()) == written


def test_parts_of_another_recording_are_not_mixed_in(tmp_path: Path) -> None:
    written = write_parts(tmp_path / "a.mcap", count=30, max_s=20.0)
    write_parts(tmp_path / "later" / "a.mcap", session="s2", max_s=20.0)
    (tmp_path / "later" / "a-002.mcap").rename(tmp_path / "a-002.mcap")
    assert list(LogReader(tmp_path / "a-000.mcap").messages()) == written
    with pytest.raises(InputError, match="3 logs in this folder; give one of them"):
        find_parts(tmp_path)
    with LogWriter(tmp_path / "b-000.mcap") as log:
        log.write(OBSERVATION, "cam0", "local", observation(), 1)
    assert find_parts(tmp_path / "b-000.mcap").paths == (tmp_path / "b-000.mcap",)
    with pytest.raises(InputError, match=r"2 logs in this folder \(a, b\); give one of them"):
        find_parts(tmp_path)


def test_a_missing_and_a_damaged_part_are_told_and_the_rest_is_read(tmp_path: Path) -> None:
    written = write_parts(tmp_path / "a.mcap", max_s=10.0)
    (tmp_path / "a-001.mcap").unlink()
    cut = (tmp_path / "a-003.mcap").read_bytes()
    (tmp_path / "a-003.mcap").write_bytes(cut[: len(cut) // 3])
    reader = LogReader(tmp_path)
    messages = list(reader.messages())
    assert messages[:20] == written[:10] + written[20:30]
    assert messages[-10:] == written[40:]
    assert "1 of its parts are missing (a-001.mcap) (and 1 more)" in reader.damage
    (tmp_path / "a-000.mcap").unlink()
    assert "its first parts are missing (it begins with a-002.mcap)" in LogReader(tmp_path).summary().reason


def test_parts_are_recovered_into_one_log(tmp_path: Path) -> None:
    written = write_parts(tmp_path / "parts" / "a.mcap", max_s=20.0)
    recovery = recover(tmp_path / "parts", tmp_path / "one.mcap")
    assert (recovery.parts, recovery.messages, recovery.missing) == (3, 50, {})
    assert list(LogReader(tmp_path / "one.mcap").messages()) == written
    assert recover(tmp_path / "one.mcap", tmp_path / "again.mcap").missing == {}


def test_parts_are_not_written_over_anything(tmp_path: Path) -> None:
    write_parts(tmp_path / "a.mcap", count=3)
    with pytest.raises(InputError, match=r"a-000\.mcap: exists already"):
        write_parts(tmp_path / "a.mcap")
    (tmp_path / "b.mcap").write_bytes(b"precious")
    with pytest.raises(InputError, match=r"b\.mcap: exists already"):
        write_parts(tmp_path / "b.mcap")


def test_a_folder_of_parts_is_a_session_and_has_an_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RotatingWriter(tmp_path / "a.mcap", {}, "s1", max_s=20.0) as log:
        for index in range(60):
            for camera in ("cam0", "cam1"):
                if index % 10 == 0:
                    log.write(CAMERA_INFO, camera, "local", camera_info(camera), index * SECOND)
                log.write(OBSERVATION, camera, "local", observation(camera, index), index * SECOND)
    session = load_session(tmp_path)
    assert list(session.rig.cameras) == ["cam0", "cam1"]
    assert len(session.observations) == 120
    assert not any("damaged" in text for text in session.warnings)
    assert run(["info", str(tmp_path)]) == 0
    assert "132 messages" in capsys.readouterr().out
