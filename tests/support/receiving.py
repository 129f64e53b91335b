"""Helpers of the tests that receive from a bus."""

from __future__ import annotations

from protocols.bus.base import Publisher, Received, Subscription
from tests.support.samples import eventually


def collect(subscription: Subscription, count: int, timeout_s: float = 10.0) -> list[Received]:
    """Drain until ``count`` messages are there or the time is up."""
    received: list[Received] = []

    def enough() -> bool:
        received.extend(subscription.drain())
        return len(received) >= count

    eventually(enough, timeout_s)
    return received


def sequences(received: list[Received]) -> list[int]:
    return [item.message.sequence for item in received]  # type: ignore[attr-defined]


def matched(publisher: Publisher) -> Publisher:
    assert publisher.wait_matched(10.0), "nobody subscribed"
    return publisher
