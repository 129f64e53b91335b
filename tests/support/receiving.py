"""Helpers of the tests that receive from a bus, or over HTTP."""

from __future__ import annotations

import urllib.error
import urllib.request

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


def http_get(address: str, path: str) -> tuple[int, str]:
    """Status and body of the answer of ``host:port``; 0 and the reason without one."""
    try:
        with urllib.request.urlopen(f"http://{address}/{path}", timeout=5.0) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()
    except OSError as error:
        return 0, str(error)
