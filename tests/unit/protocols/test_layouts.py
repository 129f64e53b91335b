"""Observations that the layout of an earlier one validates: only valid ones, and nearly all of a detector's."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable

import pytest
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION
from protocols.validation.codec import decode
from protocols.validation.layouts import Layouts
from protocols.validation.rules import Rejected, check

Change = Callable[[pb.Detection], object]


def whole(seed: int, points: int = 3) -> pb.Observation:
    """An observation with every field of a detection, of a shape that does not depend on the seed."""
    rng = random.Random(seed)
    message = pb.Observation(schema_version=1, camera=f"cam{seed % 10}", boot_id="b0", exposure_ns=4_000 + seed % 9)
    message.sequence, message.frame, message.device_time_ns = 300 + seed % 99, 400 + seed % 99, -(10**15) - seed
    for _ in range(points):
        found = message.detections.add(u=rng.uniform(-9, 9), v=rng.uniform(0, 1e6), size=rng.uniform(1, 9), score=0.7)
        found.label, found.target, found.kind = f"p {seed % 10}", f"t{seed % 10}", "person"
        found.colour.red, found.colour.green = rng.randint(1, 127), rng.randint(1, 127)
        found.covariance[:] = [4.0 + rng.random(), rng.uniform(-2, 2), 2.0]
        found.head[:], found.foot[:], found.box[:] = [1.0, -2.0], [rng.random(), 4.0], [-1.0, -2.0, 3.0, rng.random()]
    return message


def learnt(*messages: pb.Observation) -> Layouts:
    layouts = Layouts()
    for message in messages:
        check(message)
        layouts.learn(message.SerializeToString())
    return layouts


def is_valid(payload: bytes) -> bool:
    """Whether an observation passes every rule, or is not even parsed; names aside, which are always looked up."""
    try:
        message = pb.Observation.FromString(payload)
        message.camera, message.boot_id = "cam0", "b0"
        check(message)
    except DecodeError:
        return True
    except Rejected:
        return False
    return True


def test_a_detector_s_next_observations_match_the_first() -> None:
    layouts = learnt(whole(0))
    assert all(layouts.match(whole(seed).SerializeToString()) for seed in range(1, 200))
    assert not layouts.match(whole(1, points=2).SerializeToString())


@pytest.mark.parametrize(
    "change",
    [
        lambda d: setattr(d, "u", math.nan),
        lambda d: setattr(d, "u", math.nextafter(1e6, 2e6)),
        lambda d: setattr(d, "v", -math.inf),
        lambda d: setattr(d, "size", -1e-300),
        lambda d: setattr(d, "score", math.nextafter(1.0, 2.0)),
        lambda d: setattr(d, "label", "p\x1f9"),
        lambda d: setattr(d, "target", "\x7f3"),
        lambda d: setattr(d, "kind", "pers0n"),
        lambda d: d.covariance.__setitem__(0, -4.0),
        lambda d: d.covariance.__setitem__(1, 9.0),
        lambda d: d.box.__setitem__(2, -3.0),
        lambda d: d.foot.__setitem__(1, -1.1e6),
    ],
)
def test_one_number_out_of_bounds_does_not_match(change: Change) -> None:
    layouts, message = learnt(whole(0)), whole(1)
    assert layouts.match(message.SerializeToString())
    change(message.detections[1])
    with pytest.raises(Rejected):
        check(message)
    assert not layouts.match(message.SerializeToString())


def test_bounds_themselves_match() -> None:
    layouts, message = learnt(whole(0)), whole(1)
    message.detections[0].u, message.detections[1].v, message.detections[2].score = -1e6, 1e6, 1.0
    message.detections[2].label = " ~~"
    check(message)
    assert layouts.match(message.SerializeToString())


def test_a_negative_zero_teaches_no_sign() -> None:
    """Its layout's sign let every negative size pass."""
    first, second = whole(0), whole(1)
    first.detections[0].size, second.detections[0].size = -0.0, -5.0
    assert not learnt(first).match(second.SerializeToString())


def test_names_are_checked_whatever_matches() -> None:
    for payload in (whole(number).SerializeToString() for number in range(3)):
        decode(OBSERVATION, payload)
    wrong = whole(1)
    wrong.camera = "cam\x00"
    with pytest.raises(Rejected, match="bad_id"):
        decode(OBSERVATION, wrong.SerializeToString())


def test_an_empty_covariance_is_not_read() -> None:
    bare = pb.Observation(schema_version=1, camera="c", boot_id="b").SerializeToString() + b"\x42\x02\x3a\x00"
    layouts = Layouts()
    layouts.learn(bare)
    assert layouts.match(bare)


def test_shapes_that_never_come_again_are_not_learnt_for_ever() -> None:
    layouts = Layouts()
    for points in range(400):
        layouts.learn(whole(0, points % 20).SerializeToString() + b"\x20\x01" * points)
    assert layouts._made == 64


NASTY_NUMBERS = (0.0, -0.0, 1.0, 1e6, -1e6, math.nan, -math.nan, math.inf, 5e-324, -5e-324, 1e12, -1e308)
NASTY = st.sampled_from(NASTY_NUMBERS)


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 10**6), st.data())
def test_whatever_matches_is_valid(model: int, seed: int, data: st.DataObject) -> None:
    """Single bytes, runs of them and whole numbers changed, of another message of the shape."""
    layouts = learnt(whole(model % 1000))
    payload = bytearray(whole(seed).SerializeToString())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(payload) - 8))
        new = data.draw(st.one_of(st.binary(min_size=1, max_size=8), NASTY.map(lambda x: struct.pack("<d", x))))
        payload[at : at + len(new)] = new
    assert is_valid(bytes(payload)) or not layouts.match(bytes(payload))


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_whatever_matches_is_valid_where_the_model_was_changed_too(data: st.DataObject) -> None:
    """Models of odd wire forms: overlong varints, fields twice, other orders."""
    payload = bytearray(whole(0, 1).SerializeToString())
    for _ in range(data.draw(st.integers(0, 2))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        check(pb.Observation.FromString(bytes(payload)))
    except (DecodeError, Rejected):
        return  # none is learnt of it
    layouts = Layouts()
    layouts.learn(bytes(payload))
    for at in range(0, len(payload) - 7, 3):
        changed = bytearray(payload)
        changed[at : at + 8] = struct.pack("<d", data.draw(NASTY))
        assert is_valid(bytes(changed)) or not layouts.match(bytes(changed))
