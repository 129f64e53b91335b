"""Message validation: invalid messages are rejected with the right reason, valid ones pass unchanged."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.messages import syncline_pb2 as pb
from protocols.topics import (
    CALIBRATION,
    CAMERA_INFO,
    FLIGHT_IMAGE,
    OBSERVATION,
    RIG_INFO,
    ROAD_MAP,
    STATUS,
    TARGET,
    TARGET_CLOUD,
    TARGET_COMMAND,
    TELEMETRY,
    TOPICS,
    TRACK,
    Topic,
)
from protocols.validation.codec import MAX_PAYLOAD, admit, admit_all, decode, encode, parse_key
from protocols.validation.rules import Rejected, RejectionReason
from tests.support.samples import SAMPLES, camera_info, observation, status


def doubles(message: Message, path: str = "") -> Iterator[tuple[str, Callable[[float], None], int]]:
    """(path, setter, count of values) of every double field of a message, nested ones too."""
    for field in message.DESCRIPTOR.fields:
        here = f"{path}{field.name}"
        value: Any = getattr(message, field.name)
        entry = field.message_type
        if entry is not None and entry.GetOptions().map_entry:
            if entry.fields_by_name["value"].type == FieldDescriptor.TYPE_DOUBLE:
                yield (
                    here,
                    lambda number, value=value: value.__setitem__(next(iter(value)), number),
                    len(value),
                )
        elif entry is not None:
            inner = value if field.is_repeated else [value]
            assert len(inner), f"the sample leaves {here} empty"
            yield from doubles(inner[-1], f"{here}.")
        elif field.type == FieldDescriptor.TYPE_DOUBLE and field.is_repeated:
            yield here, lambda number, value=value: value.__setitem__(len(value) - 1, number), len(value)
        elif field.type == FieldDescriptor.TYPE_DOUBLE:
            yield here, lambda number, message=message, name=field.name: setattr(message, name, number), 1


def reason_for(topic: Topic, payload: bytes) -> RejectionReason:
    with pytest.raises(Rejected) as rejected:
        decode(topic, payload)
    return rejected.value.reason


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_kind_of_message_comes_back_equal(topic: Topic) -> None:
    message = SAMPLES[topic]()
    assert decode(topic, encode(message)) == message


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_no_number_of_any_message_may_be_anything_but_finite(topic: Topic, number: float) -> None:
    """Walks the descriptors, so that a field added to the schema is covered or fails here."""
    paths = [path for path, _, count in doubles(SAMPLES[topic]()) if count]
    assert len(paths) == len(list(doubles(SAMPLES[topic]()))), "the sample leaves a number unset"
    for index, path in enumerate(paths):
        message = SAMPLES[topic]()
        list(doubles(message))[index][1](number)
        assert reason_for(topic, encode(message)) is RejectionReason.NOT_FINITE, path


@pytest.mark.parametrize("version", [0, 2, 4_000_000_000])
@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_another_schema_version_is_rejected(topic: Topic, version: int) -> None:
    message: Any = SAMPLES[topic]()
    message.schema_version = version
    assert reason_for(topic, encode(message)) is RejectionReason.SCHEMA_VERSION


Change = Callable[[Any], object]
BAD: list[tuple[str, Topic, Change, RejectionReason]] = [
    ("size below 0", OBSERVATION, lambda m: setattr(m.detections[0], "size", -1.0), RejectionReason.OUT_OF_RANGE),
    ("score above 1", OBSERVATION, lambda m: setattr(m.detections[0], "score", 1.01), RejectionReason.OUT_OF_RANGE),
    ("unheard-of kind", OBSERVATION, lambda m: setattr(m.detections[0], "kind", "ghost"), RejectionReason.BAD_TEXT),
    ("half a head", OBSERVATION, lambda m: m.detections[0].head.pop(), RejectionReason.BAD_LENGTH),
    ("foot in three dimensions", OBSERVATION, lambda m: m.detections[0].foot.append(1.0), RejectionReason.BAD_LENGTH),
    ("head far outside", OBSERVATION, lambda m: m.detections[0].head.__setitem__(0, 1e7), RejectionReason.OUT_OF_RANGE),
    ("box of three numbers", OBSERVATION, lambda m: m.detections[0].box.pop(), RejectionReason.BAD_LENGTH),
    ("box inside out", OBSERVATION, lambda m: m.detections[0].box.__setitem__(2, -1.0), RejectionReason.OUT_OF_RANGE),
    (
        "target breaks lines",
        OBSERVATION,
        lambda m: setattr(m.detections[0], "target", "a\nb"),
        RejectionReason.BAD_TEXT,
    ),
    ("u far outside", OBSERVATION, lambda m: setattr(m.detections[0], "u", 1e7), RejectionReason.OUT_OF_RANGE),
    ("exposure below 0", OBSERVATION, lambda m: setattr(m, "exposure_ns", -1), RejectionReason.OUT_OF_RANGE),
    ("colour 256", OBSERVATION, lambda m: setattr(m.detections[0].colour, "red", 256), RejectionReason.OUT_OF_RANGE),
    ("covariance of 2", OBSERVATION, lambda m: m.detections[0].covariance.pop(), RejectionReason.BAD_LENGTH),
    (
        "covariance of 4",
        OBSERVATION,
        lambda m: m.detections[0].covariance.append(1.0),
        RejectionReason.BAD_LENGTH,
    ),
    (
        "variance below 0",
        OBSERVATION,
        lambda m: m.detections[0].covariance.__setitem__(0, -0.1),
        RejectionReason.OUT_OF_RANGE,
    ),
    (
        "correlation above 1",
        OBSERVATION,
        lambda m: m.detections[0].covariance.__setitem__(1, 9.0),
        RejectionReason.OUT_OF_RANGE,
    ),
    ("label too long", OBSERVATION, lambda m: setattr(m.detections[0], "label", "x" * 65), RejectionReason.BAD_TEXT),
    (
        "line break in label",
        OBSERVATION,
        lambda m: setattr(m.detections[0], "label", "a\nb"),
        RejectionReason.BAD_TEXT,
    ),
    ("no camera", OBSERVATION, lambda m: m.ClearField("camera"), RejectionReason.BAD_ID),
    ("camera with a slash", OBSERVATION, lambda m: setattr(m, "camera", "cam/0"), RejectionReason.BAD_ID),
    ("wildcard camera", OBSERVATION, lambda m: setattr(m, "camera", "*"), RejectionReason.BAD_ID),
    ("camera with a line end", OBSERVATION, lambda m: setattr(m, "camera", "cam0\n"), RejectionReason.BAD_ID),
    ("no boot id", OBSERVATION, lambda m: m.ClearField("boot_id"), RejectionReason.BAD_ID),
    ("width 0", CAMERA_INFO, lambda m: setattr(m, "width", 0), RejectionReason.OUT_OF_RANGE),
    ("fps below 0", CAMERA_INFO, lambda m: setattr(m, "fps", -30.0), RejectionReason.OUT_OF_RANGE),
    ("matrix of 8", CAMERA_INFO, lambda m: m.matrix.pop(), RejectionReason.BAD_LENGTH),
    ("focal length 0", CAMERA_INFO, lambda m: m.matrix.__setitem__(0, 0.0), RejectionReason.OUT_OF_RANGE),
    ("3 distortions", CAMERA_INFO, lambda m: m.distortions.__delitem__(slice(2)), RejectionReason.BAD_LENGTH),
    ("fisheye with 5", CAMERA_INFO, lambda m: setattr(m, "fisheye", True), RejectionReason.BAD_LENGTH),
    ("focal length of 1e9 px", CAMERA_INFO, lambda m: m.matrix.__setitem__(0, 1e9), RejectionReason.OUT_OF_RANGE),
    ("no camera matrix", CAMERA_INFO, lambda m: m.matrix.__setitem__(8, 0.0), RejectionReason.OUT_OF_RANGE),
    ("distortions of 1e308", CAMERA_INFO, lambda m: m.distortions.__setitem__(0, 1e308), RejectionReason.OUT_OF_RANGE),
    ("1e12 frames a second", CAMERA_INFO, lambda m: setattr(m, "fps", 1e12), RejectionReason.OUT_OF_RANGE),
    ("centre at 1e300", CAMERA_INFO, lambda m: m.position.__setitem__(0, 1e300), RejectionReason.OUT_OF_RANGE),
    ("turned 1e300 times", CAMERA_INFO, lambda m: m.rotation.__setitem__(0, 1e300), RejectionReason.OUT_OF_RANGE),
    ("std of 1e-300", CAMERA_INFO, lambda m: m.position_std.__setitem__(0, 1e-300), RejectionReason.OUT_OF_RANGE),
    ("time of 2⁶³", OBSERVATION, lambda m: setattr(m, "device_time_ns", 2**63 - 1), RejectionReason.OUT_OF_RANGE),
    ("frame of 2⁶⁴", OBSERVATION, lambda m: setattr(m, "frame", 2**64 - 1), RejectionReason.OUT_OF_RANGE),
    ("exposed for years", OBSERVATION, lambda m: setattr(m, "exposure_ns", 2**60), RejectionReason.OUT_OF_RANGE),
    (
        "variance of 1e300",
        OBSERVATION,
        lambda m: m.detections[0].covariance.__setitem__(0, 1e300),
        RejectionReason.OUT_OF_RANGE,
    ),
    (
        "offset of 1e300",
        CALIBRATION,
        lambda m: setattr(m.cameras[0], "time_offset", 1e300),
        RejectionReason.OUT_OF_RANGE,
    ),
    ("std below 0", CAMERA_INFO, lambda m: m.position_std.__setitem__(2, -1.0), RejectionReason.OUT_OF_RANGE),
    ("unknown units", RIG_INFO, lambda m: setattr(m, "units", "ft"), RejectionReason.BAD_TEXT),
    ("distance 0", RIG_INFO, lambda m: setattr(m.distances[0], "distance", 0.0), RejectionReason.OUT_OF_RANGE),
    ("distance to itself", RIG_INFO, lambda m: setattr(m.distances[0], "camera_b", "cam0"), RejectionReason.BAD_ID),
    ("up is 0", RIG_INFO, lambda m: m.up.__setitem__(2, 0.0), RejectionReason.OUT_OF_RANGE),
    ("unknown status", CALIBRATION, lambda m: setattr(m, "status", "fine"), RejectionReason.BAD_TEXT),
    ("rotation of 2", CALIBRATION, lambda m: m.cameras[0].rotation.pop(), RejectionReason.BAD_LENGTH),
    ("clock rate 0", CALIBRATION, lambda m: setattr(m.cameras[0], "clock_rate", 0.0), RejectionReason.OUT_OF_RANGE),
    ("solved and refused", CALIBRATION, lambda m: setattr(m.refused[0], "camera", "cam0"), RejectionReason.BAD_ID),
    ("1025 refused", CALIBRATION, lambda m: m.refused.extend([m.refused[0]] * 1024), RejectionReason.TOO_MANY),
    ("unknown state", TRACK, lambda m: setattr(m, "state", "gone"), RejectionReason.BAD_TEXT),
    ("no position", TRACK, lambda m: m.ClearField("position"), RejectionReason.BAD_LENGTH),
    ("covariance of 6", TRACK, lambda m: m.position_covariance.__delitem__(slice(3)), RejectionReason.BAD_LENGTH),
    ("variance below 0", TRACK, lambda m: m.position_covariance.__setitem__(4, -1.0), RejectionReason.OUT_OF_RANGE),
    ("unknown agent state", STATUS, lambda m: setattr(m, "state", "asleep"), RejectionReason.BAD_TEXT),
    ("escape in message", STATUS, lambda m: setattr(m, "message", "\x1b[2J"), RejectionReason.BAD_TEXT),
    ("no rotation", TELEMETRY, lambda m: m.ned_from_body.__setitem__(0, 2.0), RejectionReason.OUT_OF_RANGE),
    ("origin beyond the pole", TELEMETRY, lambda m: m.origin.__setitem__(0, 91.0), RejectionReason.OUT_OF_RANGE),
    ("position of 2", TELEMETRY, lambda m: m.position.pop(), RejectionReason.BAD_LENGTH),
    ("select without a box", TARGET_COMMAND, lambda m: m.ClearField("box"), RejectionReason.BAD_LENGTH),
    ("stop with a box", TARGET_COMMAND, lambda m: setattr(m, "kind", "stop"), RejectionReason.BAD_LENGTH),
    ("box without width", TARGET_COMMAND, lambda m: m.box.__setitem__(2, 0.0), RejectionReason.OUT_OF_RANGE),
    ("station 256", TARGET_COMMAND, lambda m: setattr(m, "by", 256), RejectionReason.OUT_OF_RANGE),
    ("lost and somewhere", TARGET, lambda m: setattr(m, "state", "lost"), RejectionReason.BAD_LENGTH),
    ("unknown target state", TARGET, lambda m: setattr(m, "state", "gone"), RejectionReason.BAD_TEXT),
    ("std below 0", TARGET, lambda m: setattr(m, "std_m", -1.0), RejectionReason.OUT_OF_RANGE),
    ("half a particle", TARGET_CLOUD, lambda m: m.pixels.pop(), RejectionReason.BAD_LENGTH),
    ("4097 particles", TARGET_CLOUD, lambda m: m.pixels.extend([1.0] * 8192), RejectionReason.TOO_MANY),
    ("road of two lengths", ROAD_MAP, lambda m: m.ground.extend([1.0, 2.0]), RejectionReason.BAD_LENGTH),
    ("picture 0 wide", FLIGHT_IMAGE, lambda m: setattr(m, "width", 0), RejectionReason.OUT_OF_RANGE),
    (
        "300 counters",
        STATUS,
        lambda m: [m.counters.__setitem__(f"c{i}", 1.0) for i in range(300)],
        RejectionReason.TOO_MANY,
    ),
]


@pytest.mark.parametrize(
    ("topic", "change", "reason"), [case[1:] for case in BAD], ids=[f"{c[1].name}: {c[0]}" for c in BAD]
)
def test_a_message_out_of_its_bounds_is_rejected_for_the_right_reason(
    topic: Topic, change: Change, reason: RejectionReason
) -> None:
    message = SAMPLES[topic]()
    change(message)
    assert reason_for(topic, encode(message)) is reason


def test_as_many_detections_as_allowed_pass_and_one_more_does_not() -> None:
    assert len(decode(OBSERVATION, encode(observation(points=4096))).detections) == 4096  # type: ignore[attr-defined]
    assert reason_for(OBSERVATION, encode(observation(points=4097))) is RejectionReason.TOO_MANY


def test_optional_parts_may_be_absent() -> None:
    bare = pb.CameraInfo(schema_version=1, camera="cam0", boot_id="b", width=1, height=1)
    assert decode(CAMERA_INFO, encode(bare)) == bare
    collecting = pb.Calibration(schema_version=1, status="collecting", reason="too little was seen")
    assert decode(CALIBRATION, encode(collecting)) == collecting


def test_an_oversized_payload_is_not_even_parsed() -> None:
    assert reason_for(OBSERVATION, b"\xff" * (MAX_PAYLOAD + 1)) is RejectionReason.OVERSIZED
    with pytest.raises(Rejected, match="oversized"):
        encode(observation(points=20_000))


def test_the_key_says_who_speaks() -> None:
    key = OBSERVATION.key_for("local", "cam0")
    address, message = admit(key, encode(observation("cam0")))
    assert (address.site, address.topic, address.agent) == ("local", OBSERVATION, "cam0")
    assert message == observation("cam0")
    for foreign, topic in ((observation("cam1"), OBSERVATION), (camera_info("cam1"), CAMERA_INFO)):
        with pytest.raises(Rejected) as rejected:
            admit(topic.key_for("local", "cam0"), encode(foreign))
        assert rejected.value.reason is RejectionReason.WRONG_SENDER
    with pytest.raises(Rejected, match="wrong_sender"):
        admit(STATUS.key_for("local", "hub"), encode(status("cam0")))


def test_who_was_admitted_once_is_known_by_key_name_and_run_together() -> None:
    """The names of a known sender are not looked up again, and nobody else gains by it."""
    own, payload = OBSERVATION.key_for("local", "cam0"), encode(observation("cam0"))
    assert admit(own, payload) == admit(own, payload)
    for key in (OBSERVATION.key_for("local", "cam1"), CAMERA_INFO.key_for("local", "cam0"), "syncline/local/cam0"):
        with pytest.raises(Rejected):
            admit(key, payload)
    for camera, boot in (("cam1", "boot-1"), ("cam0", "boot/1"), ("", "boot-1")):
        with pytest.raises(Rejected):
            admit(own, observation(camera, boot_id=boot).SerializeToString())


def test_several_at_once_are_admitted_or_refused_like_each_of_them() -> None:
    """A valid shape under another's key, with a wrong name, damaged, or too large among those that match a layout."""
    own, other = (OBSERVATION.key_for("local", camera) for camera in ("cam0", "cam1"))
    nan = observation("cam0")
    nan.detections[0].u = math.nan
    good = [(own, encode(observation("cam0", index))) for index in range(20)]
    bad = [(key, good[3][1]) for key in (other, "x", CAMERA_INFO.key_for("local", "cam0"))]
    bad += [(own, nan.SerializeToString()), (own, b""), (own, b"\xff" * (MAX_PAYLOAD + 1)), (own, good[3][1][:-3])]
    bad += [(own, observation("cam0", boot_id="boot/1").SerializeToString())]
    messages = [one for pair in zip(good, bad * 3, strict=False) for one in pair]
    found = admit_all(*zip(*messages, strict=True))
    for (key, payload), one in zip(messages, found, strict=True):
        if isinstance(one, Rejected):
            with pytest.raises(Rejected) as alone:
                admit(key, payload)
            assert (one.reason, one.detail, one.sequence) == (
                alone.value.reason,
                alone.value.detail,
                alone.value.sequence,
            )
        else:
            assert one == admit(key, payload)
    assert [isinstance(one, Rejected) for one in found] == [False, True] * 20


@pytest.mark.parametrize("name", ["agent_2", "CVLab1", "GoPro 2", "Kamera.Süd"])
@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_key_of_the_catalogue_is_read_back(topic: Topic, name: str) -> None:
    address = parse_key(topic.key_for("site-1", name))
    assert address is not None
    assert (address.site, address.topic, address.agent) == ("site-1", topic, name)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "syncline/local/camera/cam0/observation/",
        "syncline/local/camera/cam0/observation\n",
        "x/syncline/local/camera/cam0/observation",
        "syncline/local/camera/cam%/observation",
        "syncline/local/camera/cam%2f0/observation",
        "syncline/local/camera/%63am0/observation",
        "syncline/local/camera/GoPro 2/observation",
        "syncline/Local/camera/cam0/observation",
        "syncline/local/camera/*/observation",
        "syncline/local/camera/cam0/secret",
        "syncline/a/b/camera/cam0/observation",
    ],
)
def test_other_keys_are_unknown(key: str) -> None:
    assert parse_key(key) is None
    with pytest.raises(Rejected, match="unknown_key"):
        admit(key, encode(observation()))


TOPIC = st.sampled_from(TOPICS)


def assert_harmless(topic: Topic, payload: bytes) -> None:
    """Rejected, or a message that stays the same when it is sent on."""
    try:
        message = decode(topic, payload)
    except Rejected:
        return
    assert decode(topic, encode(message)) == message


@settings(max_examples=300, deadline=None)
@given(topic=TOPIC, payload=st.binary(max_size=200))
def test_no_bytes_do_harm(topic: Topic, payload: bytes) -> None:
    assert_harmless(topic, payload)


@settings(max_examples=300, deadline=None)
@given(topic=TOPIC, data=st.data())
def test_no_changed_message_does_harm(topic: Topic, data: st.DataObject) -> None:
    payload = bytearray(encode(SAMPLES[topic]()))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    assert_harmless(topic, bytes(payload))


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_no_cut_off_message_does_harm(topic: Topic) -> None:
    payload = encode(SAMPLES[topic]())
    for length in range(len(payload)):
        assert_harmless(topic, payload[:length])


def test_a_message_cut_inside_a_field_is_garbled() -> None:
    assert reason_for(OBSERVATION, encode(observation())[:-3]) is RejectionReason.GARBLED
