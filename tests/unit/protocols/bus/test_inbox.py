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
    assert sum(len(one.message.SerializeToString()) for one in first) < 6_000_000
    assert {one.agent for one in first} >= {"good", "evil0", "evil19"}
    rest = [one for _ in range(20) for one in inbox.drain()]
    numbers = [one.message.sequence for one in (*first, *rest) if one.agent == "evil3"]  # type: ignore[attr-defined]
    assert numbers == sorted(numbers)
    assert len(first) + len(rest) + inbox.counters["dropped"] == 2001
