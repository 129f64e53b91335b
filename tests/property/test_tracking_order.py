"""Tracks depend on the observations, not on their order of arrival."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from edge import scenes
from hub.tracking.filter.target_states import MultiTargetState
from hub.tracking.parameters import TrackerParameters
from hub.tracking.tracker import Tracker
from protocols.messages import syncline_pb2 as pb
from tests.support.people_traffic import cameras_of, film

LAG_S = 0.5
SCENE = scenes.get_people_scene(3, 3, 2)


@cache
def stream() -> tuple[pb.Observation, ...]:
    """Two seconds of two people in three cameras, in the order of capture."""
    traffic = film(SCENE, 2.0, 3)
    true = [(SCENE.camera(m.camera).clock.true_time(m.device_time_ns), m) for m in traffic.messages()]
    return tuple(message for _, message in sorted(true, key=lambda one: one[0]))


@cache
def in_order() -> tuple[int, list[bytes]]:
    """The number of confirmed people, and every bit of the state, with all frames in order."""
    tracker = run(list(stream()), [1] * len(stream()))
    assert tracker.counters["track.reordered"] == 0
    return int(tracker.targets.confirmed.sum()), bits(tracker.state)


def run(messages: list[pb.Observation], batches: list[int]) -> Tracker:
    tracker = Tracker(TrackerParameters(up=np.array([0.0, 0.0, 1.0])), LAG_S)
    tracker.calibrate(cameras_of(SCENE, "cam0"))
    waits = set(np.cumsum(batches).tolist())
    for number, message in enumerate(messages):
        tracker.handle(message)
        if number in waits:
            tracker.advance()
    tracker.advance()
    return tracker


def bits(state: MultiTargetState) -> list[bytes]:
    """Every number of the targets, to the last bit."""
    targets = state.targets
    return [getattr(targets, name).tobytes() for name in targets.__slots__ if name != "seen_by"] + [
        str(sorted(zip(state.cameras, targets.seen_by.T.tolist(), strict=True))).encode(),
        str((state.time_ns, state.next_initiation_number, state.next_number)).encode(),
    ]


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), late_s=st.sampled_from([0.02, 0.1, 0.3, 0.45]), data=st.data())
def test_order_of_arrival_within_the_lag_changes_nothing(seed: int, late_s: float, data: st.DataObject) -> None:
    messages = list(stream())
    rng = np.random.default_rng(seed)
    moment = [SCENE.camera(m.camera).clock.true_time(m.device_time_ns) for m in messages]
    arrival = np.array(moment) + rng.uniform(0.0, late_s, len(messages))
    shuffled = [messages[i] for i in np.argsort(arrival, kind="stable")]
    batches = data.draw(st.lists(st.integers(1, 40), min_size=1, max_size=30))
    mixed = run(shuffled, batches)
    people, plain = in_order()
    assert people == 2
    assert mixed.counters["track.late"] == 0
    assert bits(mixed.state) == plain


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_duplicate_frames_have_no_effect(seed: int) -> None:
    messages = list(stream())
    rng = np.random.default_rng(seed)
    doubled = [m for m in messages for _ in range(1 + int(rng.random() < 0.3))]
    assert bits(run(doubled, [7, 1, 30]).state) == in_order()[1]
