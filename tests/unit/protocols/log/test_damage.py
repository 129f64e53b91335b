"""Damaged logs: undamaged records are read, losses are reported, and recover writes a complete log."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from mcap.reader import make_reader

from deploy.cli import run
from protocols.core.errors import InputError, Refused
from protocols.log.read import recovery as recover_module
from protocols.log.read.mcap_records import Damage, McapRecord, open_log, read_records
from protocols.log.read.reader import LogMessage, LogReader
from protocols.log.read.recovery import recover
from protocols.log.write.writer import LogWriter
from protocols.topics import OBSERVATION
from tests.support.samples import observation

CHUNK, MESSAGE_INDEX, METADATA = 0x06, 0x07, 0x0C
CHUNKS, PER_CHUNK = 12, 20


def write_log(path: Path, close: bool = True) -> list[LogMessage]:
    """Twelve chunks of two cameras' observations, a description in the first; log times in ms."""
    written: list[LogMessage] = []
    log = LogWriter(path, {"syncline": {"seed": "7"}})
    log.attach("rig.toml", "application/toml", b"[cam0]\n" * 40)
    for index in range(CHUNKS * PER_CHUNK):
        camera = f"cam{index % 2}"
        item = LogMessage(OBSERVATION, camera, "local", observation(camera, index // 2), index * 1_000_000)
        log.write(item.topic, item.agent, item.site, item.message, item.log_time_ns)
        written.append(item)
        if index % PER_CHUNK == PER_CHUNK - 1:
            log.sync()
    if close:
        log.close()
    else:
        log._file.close()
    return written


def frames_of(path: Path, opcode: int) -> list[McapRecord]:
    with open_log(path) as stream:
        return [frame for frame in read_records(stream, Damage()) if frame.opcode == opcode]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[LogMessage]]:
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    return path, write_log(path)


def changed(original: Path, target: Path, offset: int, data: bytes) -> Path:
    content = bytearray(original.read_bytes())
    content[offset : offset + len(data)] = data
    target.write_bytes(content)
    return target


def is_in_order_part_of(part: list[LogMessage], whole: list[LogMessage]) -> bool:
    rest = iter(whole)
    return all(any(item == other for other in rest) for item in part)


def read_by_others(path: Path) -> int:
    """Messages that mcap's own reader finds by the index, all checksums verified."""
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False))


def test_the_length_of_a_chunk_may_be_damaged_and_the_rest_is_read(
    tmp_path: Path, original: tuple[Path, list[LogMessage]]
) -> None:
    """Every later record used to be lost with it: nothing says where the next one begins but the next one itself."""
    path, written = original
    chunk = frames_of(path, CHUNK)[4]
    for length in (b"\xff" * 8, (len(chunk.content) + 3).to_bytes(8, "little"), (5).to_bytes(8, "little"), bytes(8)):
        reader = LogReader(changed(path, tmp_path / "b.mcap", chunk.offset + 1, length))
        messages = list(reader.messages())
        assert messages == written[: 4 * PER_CHUNK] + written[5 * PER_CHUNK :]
        assert f"bytes from byte {chunk.offset} on are damaged and were left out" in reader.damage


@pytest.mark.parametrize("garbage", [b"\x00", b"\xff", b"\x06", b"\x07"])
def test_a_block_of_garbage_costs_what_stood_there(
    tmp_path: Path, original: tuple[Path, list[LogMessage]], garbage: bytes
) -> None:
    path, written = original
    chunks = frames_of(path, CHUNK)
    begin, end = chunks[3].offset + 100, chunks[6].offset + 20
    reader = LogReader(changed(path, tmp_path / "b.mcap", begin, garbage * (end - begin)))
    assert list(reader.messages()) == written[: 3 * PER_CHUNK] + written[7 * PER_CHUNK :]
    assert reader.damage


def test_a_damaged_first_chunk_does_not_make_an_unclosed_log_nameless(tmp_path: Path) -> None:
    """It introduces the channels, and without a closing index nothing in MCAP repeats them."""
    written = write_log(tmp_path / "a.mcap", close=False)
    chunk = frames_of(tmp_path / "a.mcap", CHUNK)[0]
    reader = LogReader(changed(tmp_path / "a.mcap", tmp_path / "b.mcap", chunk.offset + 60, b"\xaa" * 8))
    assert list(reader.messages()) == written[PER_CHUNK:]


def test_a_changed_byte_in_the_index_is_found(tmp_path: Path, original: tuple[Path, list[LogMessage]]) -> None:
    path, written = original
    (end,) = frames_of(path, 0x0F)
    content = path.read_bytes()
    for offset in random.Random(5).sample(range(end.offset + 13 + 9, len(content)), 40):
        reader = LogReader(changed(path, tmp_path / "b.mcap", offset, bytes([content[offset] ^ 0x10])))
        assert list(reader.messages()) == written
        assert reader.damage, offset


def test_a_log_cut_anywhere_becomes_whole(tmp_path: Path, original: tuple[Path, list[LogMessage]]) -> None:
    path, written = original
    content = path.read_bytes()
    begin = frames_of(path, MESSAGE_INDEX)[1].offset  # the first chunk is whole
    counts = []
    for length in sorted(random.Random(3).sample(range(begin, len(content)), 60)):
        (tmp_path / "cut.mcap").write_bytes(content[:length])
        out = tmp_path / f"fixed-{length}.mcap"
        recovery = recover(tmp_path / "cut.mcap", out)
        reader = LogReader(out)
        messages = list(reader.messages())
        assert reader.damage == ""
        assert messages == written[: len(messages)]
        assert recovery.messages == len(messages) == read_by_others(out)
        assert recovery.cut or "end mark" in recovery.damage
        assert recovery.missing == {}
        assert reader.metadata() == {"syncline": {"seed": "7"}}
        assert [item.name for item in reader.attachments()] == ["rig.toml"]
        counts.append(len(messages))
    assert counts == sorted(counts)
    assert counts[0] < counts[-1] == len(written)


def test_flipped_bytes_cost_their_chunks_and_recover_counts_them(
    tmp_path: Path, original: tuple[Path, list[LogMessage]]
) -> None:
    """Nothing is read that was not written; what the numbering misses is exactly what is lost."""
    path, written = original
    content = path.read_bytes()
    begin, end = frames_of(path, CHUNK)[0].offset, frames_of(path, 0x0F)[0].offset
    last = {item.agent: item for item in written}
    generator = random.Random(4)
    for case in range(60):
        damaged = bytearray(content)
        for offset in generator.sample(range(begin, end), generator.choice((1, 3))):
            damaged[offset] ^= 1 << generator.randrange(8)
        (tmp_path / "b.mcap").write_bytes(damaged)
        out = tmp_path / f"fixed-{case}.mcap"
        recovery = recover(tmp_path / "b.mcap", out)
        messages = list(LogReader(out).messages())
        assert LogReader(out).summary().reason == ""
        assert recovery.damage
        assert is_in_order_part_of(messages, written), case
        assert len(messages) >= len(written) - 3 * PER_CHUNK, case
        assert recovery.messages == len(messages) == read_by_others(out)
        if all(item in messages for item in last.values()):
            assert sum(recovery.missing.values()) == len(written) - len(messages), case


def test_recover_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "a.mcap", close=False)
    chunk = frames_of(tmp_path / "a.mcap", CHUNK)[4]
    changed(tmp_path / "a.mcap", tmp_path / "b.mcap", chunk.offset + 1, b"\xff" * 8)
    assert run(["recover", str(tmp_path / "b.mcap"), "--out", str(tmp_path / "fixed.mcap")]) == 0
    said = capsys.readouterr().out
    assert "220 messages, 0.2 s" in said
    assert "verified" in said
    assert "lost: 10 messages of syncline/local/camera/cam1/observation" in said
    assert "not yet brought to the disk" in said
    assert run(["info", str(tmp_path / "b.mcap")]) == 0
    assert "damaged: " in capsys.readouterr().out
    assert run(["recover", str(tmp_path / "fixed.mcap"), "--out", str(tmp_path / "again.mcap")]) == 0
    said = capsys.readouterr().out
    assert "damage:" not in said
    assert "lost: 10 messages of syncline/local/camera/cam0/observation" in said


def test_recovering_a_whole_log_loses_nothing_and_is_repeatable(
    tmp_path: Path, original: tuple[Path, list[LogMessage]], capsys: pytest.CaptureFixture[str]
) -> None:
    path, written = original
    for name in ("b.mcap", "c.mcap"):
        assert run(["recover", str(path), "--out", str(tmp_path / name)]) == 0
    assert "nothing was lost" in capsys.readouterr().out
    assert (tmp_path / "b.mcap").read_bytes() == (tmp_path / "c.mcap").read_bytes()
    assert list(LogReader(tmp_path / "b.mcap").messages()) == written


def test_what_cannot_be_recovered_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "none.mcap").write_bytes(b"time,u,v\n")
    (tmp_path / "there.mcap").write_bytes(b"precious")
    write_log(tmp_path / "a.mcap")
    head = frames_of(tmp_path / "a.mcap", CHUNK)[0].offset + 50
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[:head])
    for log, out, status, said in (
        ("none", "out", 2, "is not an MCAP log"),
        ("missing", "out", 2, "No such file"),
        ("a", "there", 2, "exists already"),
        ("cut", "out", 3, "no whole message in it: the record at byte"),
        ("a", "no/such/folder/out", 0, ""),
    ):
        assert run(["recover", str(tmp_path / f"{log}.mcap"), "--out", str(tmp_path / f"{out}.mcap")]) == status
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == (status != 0)
        assert not (tmp_path / "out.mcap").exists()
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"
    assert not [item for item in tmp_path.iterdir() if item.name.startswith(".")]


def test_a_result_that_reads_back_wrong_is_not_left_behind(
    tmp_path: Path, original: tuple[Path, list[LogMessage]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a disk that loses what it was given."""
    verify = recover_module._verify

    def spoilt(file: Path, out: Path, written: object) -> None:
        content = bytearray(file.read_bytes())
        content[frames_of(file, CHUNK)[0].offset + 200] ^= 1
        file.write_bytes(content)
        verify(file, out, written)  # type: ignore[arg-type]

    monkeypatch.setattr(recover_module, "_verify", spoilt)
    with pytest.raises(InputError, match=r"out\.mcap: reads back wrong"):
        recover(original[0], tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_log_of_nothing_is_refused_only_if_it_is_damaged(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.attach("rig.toml", "application/toml", b"x")
    assert recover(tmp_path / "a.mcap", tmp_path / "b.mcap").messages == 0
    (tmp_path / "c.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[:-3])
    with pytest.raises(Refused, match="no whole message"):
        recover(tmp_path / "c.mcap", tmp_path / "d.mcap")


def test_a_start_is_sought_by_the_index_and_found_without_one(
    tmp_path: Path, original: tuple[Path, list[LogMessage]]
) -> None:
    """The byte that is damaged stands before the start: with an index nobody looks there."""
    path, written = original
    chunk = frames_of(path, CHUNK)[2]
    reader = LogReader(changed(path, tmp_path / "b.mcap", chunk.offset + 60, b"\xaa" * 8))
    for start in (0, 7, 100, 239):
        expected = [item for item in written if item.log_time_ns >= start * 1_000_000]
        assert list(LogReader(path).messages(start_ns=start * 1_000_000)) == expected
    assert list(reader.messages(start_ns=100_000_000)) == written[100:]
    assert reader.damage == ""
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-1])
    assert list(LogReader(tmp_path / "cut.mcap").messages(start_ns=100_000_000)) == written[100:]
    assert list(LogReader(path).messages(start_ns=10**12)) == []
