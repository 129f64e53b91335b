"""The receive queue in front of an agent's loop."""

from __future__ import annotations

import random
from collections import Counter, deque

import pytest

from protocols.bus.transport.inbox import Arrived, Inbox
from protocols.topics import FLIGHT_IMAGE, OBSERVATION, Topic
from protocols.validation.codec import MAX_PAYLOAD
from tests.support.samples import observation


def test_what_is_decoded_at_once_is_bounded_in_bytes_and_nobody_is_left_out() -> None:
    """Twenty cameras with hundreds of detections a frame: decoding what had arrived took seconds."""
    inbox, clock = Inbox(OBSERVATION, lambda: 0), range(100)
    for number in clock:
        for camera in range(20):
            message = observation(f"evil{camera}", number, points=150)
            inbox.push(OBSERVATION.key_for("local", message.camera), message.SerializeToString())
    good = observation("good", 0)
    inbox.push(OBSERVATION.key_for("local", "good"), good.SerializeToString())
    first = inbox.drain()
    assert sum(len(one.message.SerializeToString()) for one in first) < 1_500_000
    assert len({one.agent for one in first}) > 15
    assert "good" in {one.agent for one in first}
    rest = [one for _ in range(60) for one in inbox.drain()]
    numbers = [one.message.sequence for one in (*first, *rest) if one.agent == "evil3"]  # type: ignore[attr-defined]
    assert numbers == sorted(numbers)
    assert len(first) + len(rest) + inbox.counters["dropped"] == 2001


def test_of_very_many_senders_of_large_messages_each_has_its_turn() -> None:
    inbox = Inbox(OBSERVATION, lambda: 0)
    names = [f"cam{number}" for number in range(60)]
    for number in range(3):
        for name in names:
            inbox.push(OBSERVATION.key_for("local", name), observation(name, number, points=500).SerializeToString())
    turns = [{one.agent for one in inbox.drain()} for _ in range(12)]
    assert set.union(*turns) == set(names)


@pytest.mark.parametrize("topic", [OBSERVATION, FLIGHT_IMAGE])
@pytest.mark.parametrize("seed", range(5))
def test_many_at_once_are_queued_as_if_they_came_one_by_one(topic: Topic, seed: int) -> None:
    """Order, refusals of what is too large, and what is dropped of a sender that sends too much."""
    rng, now = random.Random(seed), [0]
    single, several = Inbox(topic, lambda: now[0]), Inbox(topic)
    sizes = [10, 1000, 700_000, 900_000, MAX_PAYLOAD + 1]
    for _ in range(60):
        now[0] += rng.choice([0, 10**7, 3 * 10**8])
        batch: deque[Arrived] = deque()
        for _ in range(rng.randint(0, 9)):
            key, payload = topic.key_for("local", f"cam{rng.choice([0, 0, 0, 1])}"), bytes(rng.choice(sizes))
            batch.append((key, payload, now[0], "source", bool(rng.randrange(2))))
        for key, payload, _, source, numbered in batch:
            single.push(key, payload, source, numbered=numbered)
        several.push_all(batch)
        assert not batch
        assert (several._queues, several._sizes) == (single._queues, single._sizes)
        assert several.counters == single.counters
        if rng.random() < 0.02:
            assert several.drain() == single.drain() == []  # nothing of it is a message
    assert single.counters["dropped"] > 0
    assert Counter(single.refusals()) == Counter(several.refusals())
