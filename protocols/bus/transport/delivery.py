"""Size of a publisher's cache for late joiners and for recovery after an outage."""

from __future__ import annotations

import math

from protocols.topics import Delivery, Topic

OUTAGE_S = 60.0
"""The longest link outage without message loss, unless configured otherwise."""
_MARGIN = 1.5  # rates vary, and an outage is noticed late


def cache_size(topic: Topic, rate_hz: float | None = None, outage_s: float = OUTAGE_S) -> int:
    """Messages that a publisher of ``topic`` caches: the last one, or those of an outage plus a margin."""
    if topic.delivery is Delivery.LATEST:
        return 1
    return max(1, math.ceil(max(topic.rate_hz, rate_hz or 0.0) * outage_s * _MARGIN))
