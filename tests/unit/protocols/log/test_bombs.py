"""Files that are small and say that they are large: memory and reading stay in proportion to the file."""

from __future__ import annotations

import io
import struct
import time
import tracemalloc
import zlib
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.opcode import Opcode

from protocols.log.read.mcap_records import MAGIC, Damage, McapRecord, chunk_records, read_index, read_records
from protocols.log.read.reader import LogReader
from protocols.log.write.foxglove import FoxgloveConverter
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION
from tests.support.samples import observation

ZEROS = bytes(64 * 1024 * 1024)


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(compression: bytes, data: bytes, says: int) -> bytes:
    head = struct.pack("<QQQII", 0, 0, says, 0, len(compression)) + compression
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(data)) + data)


FOOTER = record(Opcode.DATA_END, bytes(4)) + record(Opcode.FOOTER, bytes(20)) + MAGIC
PACKED = {b"zstd": zstandard.ZstdCompressor().compress(ZEROS), b"lz4": lz4.frame.compress(ZEROS)}


@pytest.mark.parametrize("says", [1000, len(ZEROS), 2**31, 2**63])
@pytest.mark.parametrize("compression", [b"zstd", b"lz4"])
def test_a_chunk_is_unpacked_no_further_than_it_says(tmp_path: Path, compression: bytes, says: int) -> None:
    """A file of 61 kB whose chunk said 1 kB took 2 GB and 100 s."""
    file = tmp_path / "bomb.mcap"
    file.write_bytes(MAGIC + chunk(compression, PACKED[compression], says) + FOOTER)
    tracemalloc.start()
    try:
        summary = LogReader(file).summary()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert summary.damaged
    assert "chunk" in summary.reason
    # What lz4 says may be within the ratio that telemetry has; it is then unpacked, and no more.
    assert peak < (4 << 20 if says == 1000 or compression == b"zstd" else 3 * len(ZEROS))


def test_a_chunk_of_empty_records_ends_at_the_first() -> None:
    frame = McapRecord(0, Opcode.CHUNK, chunk(b"", bytes(60_000), 60_000)[9:])
    damage = Damage()
    assert list(chunk_records(frame, damage)) == []
    assert damage.flaws == 1


def test_a_length_of_2_to_the_64_is_damage(tmp_path: Path) -> None:
    """Found by fuzzing: the library reads as many bytes as a record says, which no system can."""
    file = tmp_path / "long.mcap"
    inside = struct.pack("<QQQII", 0, 0, 1000, 0, 4) + b"zstd" + struct.pack("<Q", 2**64 - 1) + b"data"
    file.write_bytes(MAGIC + record(Opcode.CHUNK, inside) + FOOTER)
    assert LogReader(file).summary().damaged


def test_a_format_record_that_is_cut_off_is_damage(tmp_path: Path) -> None:
    """Found by fuzzing: the record that is read first was read without a check."""
    file = tmp_path / "cut.mcap"
    file.write_bytes(MAGIC + record(Opcode.METADATA, b"\x02\x00") + FOOTER)
    assert LogReader(file).summary().messages == 0


def test_metadata_in_a_chunk_is_read_once(tmp_path: Path) -> None:
    """Each record of metadata inside a chunk was parsed from the whole chunk: quadratic, hours for 12 MB."""
    inside = record(Opcode.METADATA, b"") * 100_000
    head = struct.pack("<QQQII", 600_000, 0, len(inside), 0, 0) + struct.pack("<Q", len(inside))
    file = tmp_path / "nested.mcap"
    file.write_bytes(MAGIC + record(Opcode.CHUNK, head + inside) + FOOTER)
    began = time.process_time()
    assert LogReader(file).summary().messages == 0
    assert time.process_time() - began < 10.0


@pytest.mark.parametrize("place", [3, 2**62, 2**64 - 1])
def test_an_index_that_leads_out_of_the_data_is_not_used(tmp_path: Path, place: int) -> None:
    """An offset beyond what a file can have raised OverflowError."""
    data = MAGIC + record(Opcode.DATA_END, bytes(4))
    summary = record(Opcode.CHUNK_INDEX, struct.pack("<QQQ", 0, 2**63, place) + bytes(40))
    footer = record(Opcode.FOOTER, struct.pack("<QQI", len(data), 0, 0))[:-4]
    footer += struct.pack("<I", zlib.crc32(footer, zlib.crc32(summary)))
    file = tmp_path / "index.mcap"
    file.write_bytes(data + summary + footer + MAGIC)
    assert list(LogReader(file).messages(start_ns=1)) == []
    with file.open("rb") as stream:
        assert read_index(stream) is None


def test_attachments_are_read_one_at_a_time(tmp_path: Path) -> None:
    """`info` held all of them, and a sparse file has as many as it says."""
    file = tmp_path / "attachments.mcap"
    with LogWriter(file) as writer:
        for number in range(20):
            writer.attach(f"a{number}", "text/plain", bytes(2_000_000), number)
    tracemalloc.start()
    try:
        assert sum(len(one.data) for one in LogReader(file).attachments()) == 40_000_000
        assert tracemalloc.get_traced_memory()[1] < 15_000_000
    finally:
        tracemalloc.stop()


def test_a_log_has_room_for_so_many_keys_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The format numbers them with 16 bits: who invented 65,536 names ended the recorder."""
    monkeypatch.setattr("protocols.log.write.writer.MAX_CHANNELS", 3)
    with LogWriter(tmp_path / "log.mcap") as writer:
        taken = [writer.write(OBSERVATION, f"a{number}", "local", observation(f"a{number}"), 1) for number in range(5)]
        assert writer.write(OBSERVATION, "a0", "local", observation("a0", 1), 2)
    assert taken == [True, True, True, False, False]
    assert LogReader(tmp_path / "log.mcap").summary().messages == 4


def test_invented_labels_do_not_fill_every_cloud_of_points() -> None:
    views = FoxgloveConverter()
    for number in range(1500):
        track = pb.Track(label=f"l{number}", state="confirmed", position=[0.0, 0.0, 1.0])
        clouds = [one.message for one in views.of("local", track, number) if isinstance(one.message, PointCloud)]
    assert len(clouds[0].data) == 12 * 1024


class Counting(io.BytesIO):
    """Counts the bytes that are read of it."""

    taken = 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self.taken += len(data)
        return data


def false_heads(opcode: int, size: int) -> bytes:
    """Heads of records that reach to the end of the file, one after the other."""
    count = size // 9
    return b"".join(struct.pack("<BQ", opcode, (count - number - 1) * 9) for number in range(count))


@pytest.mark.parametrize("opcode", [Opcode.ATTACHMENT, Opcode.CHUNK, Opcode.METADATA, Opcode.MESSAGE_INDEX, 0x90])
def test_false_heads_are_not_read_to_their_end_each(opcode: int) -> None:
    """Every false head of an attachment was read to its end: quadratic in the file."""
    stream = Counting(MAGIC + b"\xff" * 9 + false_heads(opcode, 400_000) + b"\x0b")
    damage = Damage()
    list(read_records(stream, damage))
    assert stream.taken < 20 * len(stream.getvalue())
    assert damage.flaws


def test_a_damaged_length_before_every_record_costs_no_more_than_the_file() -> None:
    """Each damaged length reached to the file's end, and was read to there before it was found to be wrong."""
    good = record(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, 0))
    body, count = b"", 10_000
    pair = 9 + len(good)
    for number in range(count):
        body += struct.pack("<BQ", Opcode.STATISTICS, (count - number) * pair - 9 - 3) + good
    stream = Counting(MAGIC + body + FOOTER)
    damage = Damage()
    assert sum(frame.opcode == Opcode.MESSAGE_INDEX for frame in read_records(stream, damage)) > 1
    # A window is searched from each place where reading resumes.
    assert stream.taken < 30 * len(stream.getvalue())
