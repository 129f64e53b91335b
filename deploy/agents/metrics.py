"""An agent's status as Prometheus metrics: base units, one metric a quantity, labels for what varies.

A status has counters and gauges by name. The names become metrics by rule, ``syncline_<role>_<name>`` with the unit in
full, so that a new counter of an agent is a new metric without a word here. What a status does not hold any more, such
as the clock rate of a camera that is gone, has no series.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from typing import TYPE_CHECKING

from protocols.messages import syncline_pb2 as pb

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

STATES = ("starting", "running", "degraded", "stopping")
LABELS = ("site", "role", "agent")
_BY_CAMERA = ("over_budget", "fault", "ppm", "frame_age_s", "offset_std_s")
"""Names that are followed by a camera's id."""
_UNITS = {"s": ("seconds", 1.0), "c": ("celsius", 1.0), "fps": ("frame_rate_hertz", 1.0), "ppm": ("clock_ratio", 1e6)}
"""Last words of names that are units, in full, and how many of them are a base unit."""
_MESSAGES = ("received", "lost", "dropped", "skipped")
"""Counters of an agent's subscriptions; ``dropped`` of a camera and a UAV are frames."""
_SITE_WIDE = ("certificate_expiry_timestamp_s", "disk_free_bytes")
"""Gauges that every agent may have: their metrics are not named by the role."""
_HELP = {
    "syncline_messages_rejected_total": "Messages that were rejected, by reason and by the id in their key.",
    "syncline_certificate_expiry_timestamp_seconds": "Unix time at which this agent's certificate expires.",
    "syncline_hub_camera_offset_std_seconds": "Standard deviation of a calibrated camera's time offset.",
    "syncline_hub_camera_frame_age_seconds": "Time since the hub received a camera's last frame.",
    "syncline_hub_camera_clock_ratio": "Rate of the hub's clock relative to a camera's, less 1.",
    "syncline_hub_calibration_age_seconds": "Time since the present calibration was estimated.",
    "syncline_hub_calibrated_cameras": "Cameras in the present calibration.",
    "syncline_camera_clock_synchronised": "1 if a time service disciplines the clock of the camera's machine.",
}
Value = tuple[dict[str, str], float]


def status_metrics(status: pb.AgentStatus, site: str) -> Iterator[Metric]:
    """The metrics of a status."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    who = dict(zip(LABELS, (site, status.role, status.agent), strict=True))
    if status.role in ("camera", "uav"):
        who["camera"] = status.agent
    for kind, found in (
        (GaugeMetricFamily, _gauges(status)),
        (CounterMetricFamily, _counters(status)),
    ):
        for name, values in found.items():
            extra = sorted({label for labels, _ in values for label in labels})
            total = "_total" if kind is CounterMetricFamily else ""
            made = kind(name, _HELP.get(name + total, _help(status.role, name)), labels=[*who, *extra])
            for labels, value in values:
                made.add_metric([*who.values(), *(labels.get(label, "") for label in extra)], value)
            yield made


def _gauges(status: pb.AgentStatus) -> dict[str, list[Value]]:
    found: dict[str, list[Value]] = {
        "syncline_info": [({"version": status.version}, 1.0)],
        "syncline_state": [({"state": state}, float(state == status.state)) for state in STATES],
    }
    for name, value in status.gauges.items():
        first, camera = _split(name)
        metric, scale = _metric(status.role, first, bool(camera))
        found.setdefault(metric, []).append(({"camera": camera} if camera else {}, value / scale))
    return found


def _counters(status: pb.AgentStatus) -> dict[str, list[Value]]:
    found: dict[str, list[Value]] = {}
    rejected: dict[tuple[str, str], float] = defaultdict(float)
    for name, value in status.counters.items():
        if name.startswith("rejected."):
            reason, _, source = name.removeprefix("rejected.").partition("@")
            rejected[reason, source] += value
            if source:  # of the sum over all sources, what is left has none
                rejected[reason, ""] -= value
            continue
        metric, labels = _counter(status.role, name)
        found.setdefault(metric, []).append((labels, value))
    for values in found.values():
        _leave_rest(values)
    reasons = {reason for reason, _ in rejected}
    found["syncline_messages_rejected"] = [
        ({"reason": reason, "source": source}, max(value, 0.0))
        for (reason, source), value in sorted(rejected.items())
        if source or value > 0.0 or not any(other for one, other in rejected if one == reason)
    ]
    return (
        found if reasons else {name: values for name, values in found.items() if name != "syncline_messages_rejected"}
    )


def _leave_rest(values: list[Value]) -> None:
    """A counter that has a total beside its parts: the total becomes what the parts leave."""
    parts = sum(value for labels, value in values if labels)
    if parts:
        values[:] = [(labels, value if labels else max(value - parts, 0.0)) for labels, value in values]


def _counter(role: str, name: str) -> tuple[str, dict[str, str]]:
    first, camera = _split(name)
    if camera:
        return _metric(role, {"fault": "faults"}.get(first, first), False)[0], {"camera": camera}
    if name in _MESSAGES:
        frames = name == "dropped" and role in ("camera", "uav")
        return (f"syncline_{_role(role)}_frames_dropped" if frames else f"syncline_messages_{name}"), {}
    head, _, tail = name.rpartition(".")
    if head == "asked" or (head.endswith("refused") and head != "refused"):
        label = "action" if head == "asked" else "reason"
        return _metric(role, head, False)[0], {label: tail}
    return _metric(role, name, False)[0], {}


def _split(name: str) -> tuple[str, str]:
    """(name, camera) of a counter or gauge of one camera."""
    first, _, camera = name.partition(".")
    return (first, camera) if first in _BY_CAMERA else (name, "")


def _metric(role: str, name: str, of_camera: bool) -> tuple[str, float]:
    """A metric's name without _total, and how many of its units are a base unit."""
    words = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_").split("_")
    unit, scale = _UNITS.get(words[-1], (words[-1], 1.0))
    stem = "_".join([*words[:-1], unit])
    if name in _SITE_WIDE:
        return f"syncline_{stem}", scale
    return f"syncline_{_role(role)}_{'camera_' if of_camera else ''}{stem}", scale


def _role(role: str) -> str:
    return {"record": "recorder"}.get(role, re.sub(r"[^a-z0-9]", "_", role))


def _help(role: str, name: str) -> str:
    text = name.removeprefix("syncline_").removeprefix(f"{_role(role)}_").replace("_", " ")
    return f"{text[:1].upper()}{text[1:]}, of a {_role(role)}'s status."
