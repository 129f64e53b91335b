"""The receive queue in front of an agent's loop."""

from __future__ import annotations

from protocols.bus.transport.inbox import Inbox
from protocols.topics import OBSERVATION
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
