"""Whatever one camera sends past the gate, the hub answers or refuses, and the other cameras' answer stays as it is."""

from __future__ import annotations

import random
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from google.protobuf.message import Message
from hypothesis import given, settings
from hypothesis import strategies as st

from hub.live.agent import status_message
from hub.live.live_hub import LiveHub, LiveSettings
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, OBSERVATION, STATUS, TOPICS_BY_NAME, Topic
from protocols.validation.codec import admit, decode, encode
from protocols.validation.rules import Rejected
from tests.faults.fuzz import spoiled
from tests.integration.live.test_live_hub import feed, messages
from tests.support import samples
from tests.support.rigs import simulate

EVIL = "cam2"
FUZZING = settings.get_current_profile_name() == "fuzz"
_TOPICS: dict[type[Message], Topic] = {pb.CameraInfo: CAMERA_INFO, pb.Observation: OBSERVATION, pb.AgentStatus: STATUS}
_PUBLISHED = {"Calibration": "calibration", "Track": "track", "SolverEvent": "solver_event", "Prediction": "prediction"}


@cache
def stream() -> tuple[Message, ...]:
    """Twelve seconds of three cameras."""
    return tuple(messages(simulate(71, 3, 12)))


@cache
def undisturbed() -> pb.Calibration:
    """The answer of the two good cameras alone."""
    hub = LiveHub(LiveSettings(window_s=60.0, track=False))
    alone = [one for one in stream() if getattr(one, "camera", "") != EVIL]
    published = feed(hub, alone, batch=10**9)
    return [one for one in published if isinstance(one, pb.Calibration)][-1]


def admissible(seed: int, count: int) -> Iterator[Message]:
    """Messages of the hostile camera that pass the gate: its own, with numbers and texts made extreme."""
    rng = random.Random(seed)
    own = [one for one in stream() if getattr(one, "camera", "") == EVIL]
    status = samples.status(EVIL)
    status.boot_id = "boot0"
    for name in ("clock_synchronised", "unix_minus_camera_s", "clock_error_s"):
        status.gauges[name] = rng.choice((1.0, 0.0, -1e-9, 1e9, 1e308))
    sent: list[Message] = [
        *own,
        *[status] * len(own),
        samples.camera_info(EVIL),
        samples.observation(EVIL, 3, points=5),
        samples.observation(EVIL, 4, "boot-2", 300),
    ]
    for number in range(count):
        sample = own[number % len(own)] if rng.random() < 0.7 else rng.choice(sent)
        payload = sample.SerializeToString() if rng.random() < 0.5 else spoiled(rng, sample)
        try:
            yield admit(_TOPICS[type(sample)].key_for("local", EVIL), payload)[1]
        except Rejected:
            continue


def assert_publishable(published: list[Message], hub: LiveHub) -> None:
    """What the hub publishes passes the gate of who receives it."""
    for message in published:
        topic = TOPICS_BY_NAME[_PUBLISHED[message.DESCRIPTOR.name]]
        decode(topic, encode(message))
    decode(STATUS, encode(status_message(hub, "hub", "b0", 0, [], 1e6)))


@settings(max_examples=100 if FUZZING else 1, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_hostile_camera_does_not_change_the_others_answer(seed: int) -> None:
    good = [one for one in stream() if getattr(one, "camera", "") != EVIL]
    evil = list(admissible(seed, len(good) // 2))
    rng = random.Random(seed)
    places = sorted(rng.randrange(len(good)) for _ in evil)
    mixed: list[Message] = []
    for index, message in enumerate(good):
        mixed.append(message)
        while places and places[0] == index:
            mixed.append(evil[len(evil) - len(places)])
            places.pop(0)
    hub = LiveHub(LiveSettings(window_s=60.0))
    published = feed(hub, mixed, batch=10**9)
    assert_publishable(published, hub)
    assert hub.calibration is not None, hub.state(0.0)
    alone = {one.camera: one for one in undisturbed().cameras}
    assert set(alone) <= set(hub.calibration.cameras), hub.calibration.refused
    reference, other = sorted(alone)
    found = hub.calibration.cameras
    # The clock of one good camera against the other's, at the middle of what was seen.
    at = alone[other].lag_time_s
    expected = lag(at, alone[other].clock_rate, alone[other].time_offset)
    expected = (expected - alone[reference].time_offset) / alone[reference].clock_rate
    maps = {name: found[name].time_map for name in alone}
    there = lag(at, maps[other].clock_rate, maps[other].time_offset)
    there = (there - maps[reference].time_offset) / maps[reference].clock_rate
    std = float(np.hypot(found[other].time_offset_std, alone[other].time_offset_std))
    assert abs(there - expected) <= 3.0 * std + 1e-4, (seed, there - expected, std)


def lag(time: float, rate: float, offset: float) -> float:
    return rate * time + offset


EXTREMES = {
    "distortions": [[1e9, -1e9, 1e9, -1e9, 1e9], [-1e9] * 4, [1e-300] * 5],
    "matrix": [[1.0, 1e7, -1e7, 0.0, 1.0, 1e7, 0.0, 0.0, 1.0], [1e7, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]],
    "position": [[1e11, -1e11, 1e11], [0.0, 0.0, 0.0]],
    "rotation": [[100.0, -100.0, 100.0], [1e-300, 0.0, 0.0]],
    "position_std": [[1e-9, 1e11, 0.0], [1e11] * 3],
    "fps": [1e5, 1e-300],
    "width": [1, 65_535],
    "readout_s": [10.0],
}


@settings(max_examples=100 if FUZZING else 2, deadline=None)
@given(data=st.data())
def test_extreme_lenses_and_surveys_are_answered_or_refused(data: st.DataObject) -> None:
    """All that a CameraInfo may say at the ends of its ranges, for one camera and for all of them."""
    names = data.draw(st.sampled_from([(EVIL,), ("cam0", "cam1", EVIL)]))
    chosen = {name: data.draw(st.sampled_from(values)) for name, values in EXTREMES.items() if data.draw(st.booleans())}
    changed: list[Message] = []
    for message in stream():
        if isinstance(message, pb.CameraInfo) and message.camera in names:
            copy = pb.CameraInfo()
            copy.CopyFrom(message)
            for name, value in chosen.items():
                set_field(copy, name, value)
            copy.fisheye = len(copy.distortions) == 4
            message = admit(CAMERA_INFO.key_for("local", copy.camera), copy.SerializeToString())[1]
        changed.append(message)
    hub = LiveHub(LiveSettings(window_s=60.0))
    assert_publishable(feed(hub, changed, batch=10**9), hub)
    assert hub.counters["faults"] == 0, hub.links.notices
    if names == (EVIL,):
        assert hub.calibration is not None, (chosen, hub.state(0.0))


def set_field(message: Any, name: str, value: Any) -> None:
    if isinstance(value, list):
        del getattr(message, name)[:]
        getattr(message, name).extend(value)
    else:
        setattr(message, name, value)
