"""Logs of every older version can be read, and one of a newer version is refused with a remedy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from protocols.core.errors import InputError
from protocols.log import layout
from protocols.log.read.reader import LogReader
from protocols.log.write import writer
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TRACK, Topic
from protocols.validation.rules import SCHEMA_VERSION
from tests.replay.keep_log import LOGS, content
from tests.support.command_line import refusal
from tests.support.samples import track


@pytest.mark.parametrize("version", range(1, SCHEMA_VERSION + 1))
def test_the_log_of_each_version_has_its_reference_content(version: int) -> None:
    path = LOGS / f"v{version}.mcap"
    expected = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert len(expected["messages"]) >= 6
    assert content(path) == expected


def test_a_log_of_a_newer_version_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as newer:
        newer.setattr(writer, "LOG_VERSION", writer.LOG_VERSION + 1)
        LogWriter(tmp_path / "layout.mcap").close()
    LogWriter(tmp_path / "schema.mcap", schema=SCHEMA_VERSION + 1).close()
    for name in ("layout", "schema"):
        error = refusal(capsys, ["info", str(tmp_path / f"{name}.mcap")])
        assert "was written by Syncline" in error
        assert "update Syncline" in error


def test_a_damaged_version_figure_does_not_make_a_log_unreadable(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write(TRACK, "hub", "yard", track(), 5)
    content = (tmp_path / "a.mcap").read_bytes()
    place = content.index(b"schema", content.index(b"syncline.format")) + len("schema") + 4
    assert content[place : place + 1] == b"1"
    (tmp_path / "a.mcap").write_bytes(content[:place] + b"9" + content[place + 1 :])
    reader = LogReader(tmp_path / "a.mcap")
    assert [item.message for item in reader.messages()] == [track()]
    assert reader.damage


def test_old_messages_are_brought_up_to_date_step_by_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if this were version 3, with two steps from the log's version 1."""
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write(TRACK, "hub", "yard", track(), 5)

    def step(addition: str) -> layout.Upgrade:
        def upgrade(topic: Topic, payload: bytes) -> bytes:
            assert topic is TRACK
            message = pb.Track.FromString(payload)
            message.label += addition
            return message.SerializeToString()

        return upgrade

    monkeypatch.setattr(layout, "UPGRADES", {1: step("-two"), 2: step("-three")})
    monkeypatch.setattr(layout, "SCHEMA_VERSION", 3)
    (item,) = LogReader(tmp_path / "a.mcap").messages()
    assert item.message.label == "marker-two-three"  # type: ignore[attr-defined]


def test_every_step_from_every_version_is_there() -> None:
    assert set(layout.UPGRADES) == set(range(1, SCHEMA_VERSION))
    with pytest.raises(InputError, match="update Syncline"):
        layout.upgrades_for(Path("a.mcap"), {"schema": str(SCHEMA_VERSION + 1)})
