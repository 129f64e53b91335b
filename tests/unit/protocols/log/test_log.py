"""A log gives back what was written, in order; a damaged one its good part, and it says so."""

from __future__ import annotations

import errno
import random
import struct
from collections.abc import Mapping
from pathlib import Path

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message
from mcap.reader import make_reader
from mcap.writer import Writer

from protocols.core.errors import InputError
from protocols.log.read.mcap_records import Damage, open_log, read_records
from protocols.log.read.reader import LogMessage, LogReader
from protocols.log.write import writer as writer_module
from protocols.log.write.writer import CHUNK_SIZE, LogWriter
from protocols.topics import CALIBRATION, OBSERVATION, STATUS, TOPICS, Topic
from protocols.validation.codec import encode
from tests.support.samples import SAMPLES, observation, status

SECOND = 1_000_000_000


def write_log(
    path: Path, count: int = 200, metadata: Mapping[str, Mapping[str, str]] | None = None
) -> list[LogMessage]:
    """Two cameras and a status now and then; log times not in order, as clocks are set."""
    written: list[LogMessage] = []
    with LogWriter(path, metadata) as log:
        for index in range(count):
            camera = f"cam{index % 2}"
            messages: list[tuple[Topic, str, Message]] = [(OBSERVATION, camera, observation(camera, index))]
            if index % 50 == 0:
                messages.append((STATUS, "hub", status("hub", index)))
            for topic, agent, message in messages:
                time_ns = SECOND * (10 + index) - (SECOND // 2 if index == 7 else 0)
                log.write(topic, agent, "local", message, time_ns)
                written.append(LogMessage(topic, agent, "local", message, time_ns))
    return written


def offset_of(path: Path, opcode: int, which: int = 0) -> tuple[int, int]:
    """(offset, length with head) of a frame of this kind."""
    with open_log(path) as stream:
        found = [frame for frame in read_records(stream, Damage()) if frame.opcode == opcode]
    return found[which].offset, len(found[which].content) + 9


CHUNK, ATTACHMENT, METADATA, DATA_END = 0x06, 0x09, 0x0C, 0x0F


def test_messages_come_back_equal_and_in_the_order_of_the_file(tmp_path: Path) -> None:
    written = write_log(tmp_path / "a.mcap")
    reader = LogReader(tmp_path / "a.mcap")
    assert list(reader.messages()) == written
    assert list(reader.messages()) == written, "reading twice gives the same"
    assert reader.damage == ""
    assert reader.counters == {}


def test_every_kind_of_message_can_be_logged(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        for topic in TOPICS:
            log.write(topic, "cam0", "site-1", SAMPLES[topic](), 5)
    logged = list(LogReader(tmp_path / "a.mcap").messages())
    assert [(item.topic, item.site, item.message) for item in logged] == [
        (topic, "site-1", SAMPLES[topic]()) for topic in TOPICS
    ]


def test_messages_can_be_chosen_by_topic_and_time(tmp_path: Path) -> None:
    written = write_log(tmp_path / "a.mcap")
    reader = LogReader(tmp_path / "a.mcap")
    assert list(reader.messages(["status"])) == [item for item in written if item.topic is STATUS]
    first, end = 20 * SECOND, 30 * SECOND
    chosen = list(reader.messages([OBSERVATION], start_ns=first, end_ns=end))
    assert chosen == [w for w in written if w.topic is OBSERVATION and first <= w.log_time_ns < end]
    assert len(chosen) == 10
    with pytest.raises(InputError, match="no topic 'observations'; use one of observation"):
        reader.messages(["observations"])


def test_metadata_and_attachments_come_back(tmp_path: Path) -> None:
    data = bytes(range(256)) * 500
    with LogWriter(tmp_path / "a.mcap", {"syncline": {"seed": "7", "naïve": "ja"}, "empty": {}}) as log:
        log.attach("rig.toml", "application/toml", data, log_time_ns=9)
        log.write(OBSERVATION, "cam0", "local", observation(), 1)
    reader = LogReader(tmp_path / "a.mcap")
    assert reader.metadata() == {"syncline": {"seed": "7", "naïve": "ja"}, "empty": {}}
    (attachment,) = reader.attachments()
    assert (attachment.name, attachment.media_type, attachment.data) == ("rig.toml", "application/toml", data)
    assert attachment.log_time_ns == 9


def test_summary_counts_by_key(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    summary = LogReader(tmp_path / "a.mcap").summary()
    assert not summary.damaged
    assert summary.messages == 204
    assert [(entry.key, entry.count) for entry in summary.topics] == [
        ("syncline/local/camera/cam0/observation", 100),
        ("syncline/local/agent/hub/status", 4),
        ("syncline/local/camera/cam1/observation", 100),
    ]
    assert (summary.first_ns, summary.last_ns) == (10 * SECOND, 209 * SECOND)


def test_an_empty_log_is_a_log(tmp_path: Path) -> None:
    LogWriter(tmp_path / "a.mcap").close()
    summary = LogReader(tmp_path / "a.mcap").summary()
    assert (summary.messages, summary.damaged, summary.first_ns) == (0, False, 0)


def test_equal_logs_are_equal_bytes(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", metadata={"syncline": {"seed": "1"}})
    write_log(tmp_path / "b.mcap", metadata={"syncline": {"seed": "1"}})
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_chunks_are_those_of_mcap_s_own_writer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a later mcap has no place for faster ones: then its own are used."""
    write_log(tmp_path / "a.mcap", 1000)
    monkeypatch.setattr("protocols.log.write.writer._BUILDER", "none")
    with LogWriter(tmp_path / "c.mcap") as log:
        assert log._chunk is None
    write_log(tmp_path / "b.mcap", 1000)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_the_schemas_in_the_log_are_enough_to_read_it(tmp_path: Path) -> None:
    """Foxglove and others know nothing of our .proto but what the log itself holds."""
    written = write_log(tmp_path / "a.mcap", count=20)
    decoded: list[bytes] = []
    with (tmp_path / "a.mcap").open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(file)  # type: ignore[no-untyped-call]
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            decoded.append(kind.FromString(message.data).SerializeToString(deterministic=True))
            assert message.publish_time == message.log_time
    assert decoded == [encode(item.message) for item in written]


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(InputError, match=r"a\.mcap: exists already; choose another name"):
        LogWriter(path)
    assert path.read_bytes() == b"precious"


def test_a_place_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"a\.mcap: cannot write: .*; make room, or choose") as error:
        LogWriter(tmp_path / "file" / "a.mcap")
    assert "\n" not in str(error.value)


def test_a_full_disk_is_told_and_leaves_a_readable_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    log = LogWriter(path)
    for index in range(100):
        log.write(OBSERVATION, "cam0", "local", observation("cam0", index), index)
    log.sync()

    def full(self: object, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(writer_module._DirectFile, "write", full)
    log.write(OBSERVATION, "cam0", "local", observation("cam0", 100), 100)
    with pytest.raises(InputError, match=r"a\.mcap: cannot write: No space left on device; make room"):
        log.sync()
    log.close()
    reader = LogReader(path)
    assert [item.message.sequence for item in reader.messages()] == list(range(100))  # type: ignore[attr-defined]
    assert "without a footer" in reader.damage


@pytest.mark.parametrize(
    ("content", "what"),
    [(b"", "is empty"), (b"time,u,v\n1,2,3\n", "is not an MCAP log"), (b"\x89MCAP", "is not an MCAP log")],
)
def test_another_kind_of_file_is_refused_in_one_line(tmp_path: Path, content: bytes, what: str) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.mcap: {what}; give a \.mcap file"):
        LogReader(tmp_path / "a.mcap")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        LogReader(tmp_path / "none.mcap")
    with pytest.raises(InputError, match=r"no \.mcap log in this folder"):
        LogReader(tmp_path)


def test_what_was_synced_survives_the_death_of_the_writer(tmp_path: Path) -> None:
    """Nothing is written after sync, as after kill -9; only what came later is missing."""
    log = LogWriter(tmp_path / "a.mcap")
    for index in range(50):
        log.write(OBSERVATION, "cam0", "local", observation("cam0", index), index)
    log.sync()
    log.write(OBSERVATION, "cam0", "local", observation("cam0", 50), 50)
    (tmp_path / "dead.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    log.close()
    reader = LogReader(tmp_path / "dead.mcap")
    assert [item.log_time_ns for item in reader.messages()] == list(range(50))
    assert "its writer did not close it" in reader.damage
    assert reader.summary().damaged


def test_chunks_are_small_enough_to_lose_little(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", count=5000)
    with open_log(tmp_path / "a.mcap") as stream:
        sizes = [
            struct.unpack_from("<QQQ", record.content)[2]
            for record in read_records(stream, Damage())
            if record.opcode == CHUNK
        ]
    assert len(sizes) > 5
    assert max(sizes) < CHUNK_SIZE + 1000


def test_a_log_cut_at_any_byte_gives_a_beginning_of_what_was_written(tmp_path: Path) -> None:
    written = write_log(tmp_path / "a.mcap", count=1200, metadata={"syncline": {"seed": "7"}})
    whole = (tmp_path / "a.mcap").read_bytes()
    lengths = sorted({8, 9, 17, len(whole) - 1, *random.Random(1).sample(range(8, len(whole)), 60)})
    counts = []
    for length in lengths:
        (tmp_path / "cut.mcap").write_bytes(whole[:length])
        reader = LogReader(tmp_path / "cut.mcap")
        messages = list(reader.messages())
        assert messages == written[: len(messages)], length
        assert reader.damage, length
        counts.append(len(messages))
    assert counts == sorted(counts)
    assert counts[-1] == len(written), "only the end mark was missing"


def test_a_changed_byte_is_found_and_never_changes_a_message(tmp_path: Path) -> None:
    written = write_log(tmp_path / "a.mcap", count=1200)
    originals = {(item.topic.name, item.agent, item.message.sequence): item for item in written}  # type: ignore[attr-defined]
    whole = (tmp_path / "a.mcap").read_bytes()
    end, _ = offset_of(tmp_path / "a.mcap", DATA_END)
    generator = random.Random(2)
    for position in generator.sample(range(8, end), 60):
        changed = bytearray(whole)
        changed[position] ^= 1 << generator.randrange(8)
        (tmp_path / "b.mcap").write_bytes(changed)
        reader = LogReader(tmp_path / "b.mcap")
        for item in reader.messages():
            assert originals[item.topic.name, item.agent, item.message.sequence] == item  # type: ignore[attr-defined]
        assert reader.damage, position


def test_a_damaged_chunk_costs_only_its_own_messages(tmp_path: Path) -> None:
    """The first chunk also holds the channels; the index at the end of the file repeats them."""
    written = write_log(tmp_path / "a.mcap", count=2000)
    changed = bytearray((tmp_path / "a.mcap").read_bytes())
    offset, length = offset_of(tmp_path / "a.mcap", CHUNK)
    changed[offset + length // 2] ^= 0xFF
    (tmp_path / "b.mcap").write_bytes(changed)
    reader = LogReader(tmp_path / "b.mcap")
    messages = list(reader.messages())
    assert f"the chunk at byte {offset} is damaged" in reader.damage
    assert 0 < len(messages) < len(written)
    assert messages == written[-len(messages) :]


def test_a_damaged_attachment_is_left_out(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.attach("good", "text/plain", b"a" * 100)
        log.attach("bad", "text/plain", b"b" * 100)
    changed = bytearray((tmp_path / "a.mcap").read_bytes())
    offset, length = offset_of(tmp_path / "a.mcap", ATTACHMENT, which=1)
    changed[offset + length - 30] ^= 1
    (tmp_path / "b.mcap").write_bytes(changed)
    reader = LogReader(tmp_path / "b.mcap")
    assert [item.name for item in reader.attachments()] == ["good"]
    assert f"the attachment at byte {offset} is damaged" in reader.damage


def test_a_garbled_metadata_record_is_left_out(tmp_path: Path) -> None:
    LogWriter(tmp_path / "a.mcap", {"bad": {"key": "value"}, "good": {"key": "value"}}).close()
    changed = bytearray((tmp_path / "a.mcap").read_bytes())
    offset, _ = offset_of(tmp_path / "a.mcap", METADATA, which=1)
    changed[offset + 9 : offset + 13] = b"\xff\xff\xff\x7f"
    (tmp_path / "b.mcap").write_bytes(changed)
    reader = LogReader(tmp_path / "b.mcap")
    assert reader.metadata() == {"good": {"key": "value"}}
    assert f"the record at byte {offset} is garbled" in reader.damage


def test_what_does_not_pass_the_gate_is_counted_and_foreign_channels_too(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    good, bad = observation("cam0", 1), observation("cam0", 2)
    bad.detections[0].u = float("nan")
    with path.open("wb") as stream:
        log = Writer(stream)
        log.start()
        ours = log.register_channel("syncline/local/camera/cam0/observation", "protobuf", 0)
        other = log.register_channel("/imu", "cdr", 0)
        for data in (encode(bad), b"\x08", encode(observation("cam1")), encode(good)):
            log.add_message(ours, log_time=5, data=data, publish_time=5)
        log.add_message(other, log_time=6, data=b"abc", publish_time=6)
        log.finish()  # type: ignore[no-untyped-call]
    reader = LogReader(path)
    assert [item.message for item in reader.messages()] == [good]
    assert reader.counters == {
        "rejected.not_finite": 1,
        "rejected.garbled": 1,
        "rejected.wrong_sender": 1,
        "foreign": 1,
    }
    assert reader.damage == ""
    assert [(entry.key, entry.address is None) for entry in reader.summary().topics][1] == ("/imu", True)


def test_a_message_of_another_topic_is_a_programming_error(tmp_path: Path) -> None:
    with (
        LogWriter(tmp_path / "a.mcap") as log,
        pytest.raises(TypeError, match="Observation on a topic of Calibration"),
    ):
        log.write(CALIBRATION, "hub", "local", observation(), 1)


def test_a_log_that_cannot_be_begun_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk a recorder that tried again left one empty file after the other."""

    def full(self: object, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("protocols.log.write.writer._DirectFile.write", full)
    with pytest.raises(InputError, match="No space left on device"):
        LogWriter(tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []
