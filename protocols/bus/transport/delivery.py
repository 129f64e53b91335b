"""How much a publisher keeps for those who come late or were cut off."""

from __future__ import annotations

import math

from protocols.topics import Delivery, Topic

OUTAGE_S = 60.0
"""The longest cut of a link that loses nothing, unless the configuration says another."""
_MARGIN = 1.5


def cache_size(topic: Topic, rate_hz: float | None = None, outage_s: float = OUTAGE_S) -> int:
    """Messages that a publisher of ``topic`` caches: the last one, or an outage's worth and a margin."""
    if topic.delivery is Delivery.LATEST:
        return 1
    return max(1, math.ceil(max(topic.rate_hz, rate_hz or 0.0) * outage_s * _MARGIN))
