"""Health endpoints of an agent: /metrics, /livez, /readyz and /status over HTTP, and JSON log lines on standard error.

All values come from the status messages that the agent publishes anyway, so agents do not depend on this module. A
status has counters and gauges by name. The names become metrics by rule, ``syncline_<role>_<name>`` with the unit in
full and labels for what varies, so that a new counter of an agent is a new metric without a word here. What a status
does not hold any more, such as the clock rate of a camera that is gone, has no series.
"""

from __future__ import annotations

import json
import re
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

from deploy.config.agents import HealthConfig
from protocols.bus.base import Refusal
from protocols.core.errors import InputError
from protocols.core.version import VERSION
from protocols.messages import syncline_pb2 as pb

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

STATUS_TIMEOUT_S = 5.0
"""Time without a status message after which an agent counts as not live [s]; it publishes one each second."""
_REFUSAL_WINDOW_S = 10.0
"""Period over which log lines of refused messages are limited [s]."""
_REFUSALS_PER_WINDOW = 5
"""Log lines per reason and source within one period."""
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


class Health:
    """The last status of an agent and its refused messages; ``seen`` and ``refused`` are thread-safe.

    now: a monotonic clock [s]. site, role, agent: whose health it is.
    """

    def __init__(
        self, now: Callable[[], float] = time.monotonic, *, site: str = "local", role: str = "", agent: str = ""
    ) -> None:
        self._now = now
        self._who = (site, role, agent)
        self._lock = threading.Lock()
        self._status: pb.AgentStatus | None = None
        self._status_at = self._started_at = now()
        self._logger: Any = None
        self._reported_state = ""
        self._unheard_statuses = 0
        self._refusal_counts: dict[tuple[str, str], tuple[float, int]] = {}

    def seen(self, status: pb.AgentStatus) -> None:
        """Handle a status message that the agent has published."""
        with self._lock:
            self._status, self._status_at = status, self._now()
        unheard = "heard" in status.gauges and status.gauges["heard"] == 0.0
        if unheard and self._unheard_statuses == 1:  # the first status after the start may precede any subscriber
            self._log_event("warning", "unheard", role=status.role, agent=status.agent, message=status.message)
        self._unheard_statuses = self._unheard_statuses + 1 if unheard else 0
        # Without numbers: "silent for 4 s" is no other state than "silent for 5 s".
        text = re.sub(r"[0-9]+(\.[0-9]+)?", "#", status.message)
        description = f"{status.state}: {text}" if status.state == "degraded" else status.state
        if description != self._reported_state and (status.state == "degraded" or self._reported_state):
            self._log_event(
                "warning" if status.state == "degraded" else "info",
                status.state,
                role=status.role,
                agent=status.agent,
                sequence=status.sequence,
                message=status.message,
            )
        self._reported_state = description

    def refused(self, refusal: Refusal) -> None:
        """Log a refused message: a few lines per reason and source; the agent counts all of them."""
        now, key = self._now(), (refusal.reason, refusal.agent)
        began, lines = self._refusal_counts.get(key, (now, 0))
        if now - began > _REFUSAL_WINDOW_S:
            began, lines = now, 0
        if len(self._refusal_counts) > 1024:
            self._refusal_counts.clear()
        self._refusal_counts[key] = (began, lines + 1)
        if lines < _REFUSALS_PER_WINDOW:
            self._log_event(
                "warning",
                "refused",
                reason=refusal.reason,
                camera=refusal.agent,
                sequence=refusal.sequence,
                key=refusal.key,
                detail=refusal.detail,
                more="further ones are only counted for 10 s" if lines == _REFUSALS_PER_WINDOW - 1 else None,
            )

    def live(self) -> tuple[bool, str]:
        """Whether the agent's main loop runs, and a short description."""
        with self._lock:
            silent, status = self._now() - self._status_at, self._status
        if silent > STATUS_TIMEOUT_S:
            return False, f"no status for {silent:.0f} s"
        return True, "starting" if status is None else "ok"

    def ready(self) -> tuple[bool, str]:
        """Whether the agent is running normally, and a short description."""
        alive, text = self.live()
        with self._lock:
            status = self._status
        if not alive or status is None:
            return False, text
        return status.state == "running", f"{status.state}: {status.message}".rstrip(": ")

    def report(self) -> dict[str, Any]:
        """State, reasons and identity, for machines; see /status."""
        live, ready = self.live(), self.ready()
        with self._lock:
            status, age = self._status, self._now() - self._status_at
        return {
            **dict(zip(LABELS, self._who, strict=True)),
            "version": VERSION,
            "live": live[0],
            "ready": ready[0],
            "state": "starting" if status is None else status.state if live[0] else "degraded",
            "message": live[1] if status is None or not live[0] else status.message,
            "status_age_s": round(age, 1),
            "counters": {} if status is None else dict(status.counters),
            "gauges": {} if status is None else dict(status.gauges),
        }

    def collect(self) -> Iterator[Metric]:
        """The status as Prometheus metrics; of an agent whose status is old, only that."""
        from prometheus_client.core import GaugeMetricFamily

        live, ready = self.live()[0], self.ready()[0]
        with self._lock:
            status, age = self._status, self._now() - self._status_at
        for name, text, value in (
            ("syncline_uptime_seconds", "Time since the start.", self._now() - self._started_at),
            ("syncline_status_age_seconds", "Time since the last status.", age),
            ("syncline_live", "1 while the agent publishes its status, as /livez.", float(live)),
            ("syncline_ready", "1 while the agent does its job, as /readyz.", float(ready)),
        ):
            made = GaugeMetricFamily(name, text, labels=LABELS)
            made.add_metric(self._who, value)
            yield made
        if status is not None and live:
            yield from status_metrics(status, self._who[0])

    def _log_event(self, level: str, event: str, **values: Any) -> None:
        if self._logger is None:
            self._logger = _json_logger()
        getattr(self._logger, level)(event, **{name: value for name, value in values.items() if value is not None})


def _json_logger() -> Any:
    import sys

    import structlog

    return structlog.wrap_logger(
        structlog.PrintLogger(sys.stderr),
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.JSONRenderer(serializer=json.dumps),
        ],
    )


class HealthServer:
    """Serves the health endpoints over HTTP while the context is open. Raises InputError if the address is in use."""

    def __init__(self, config: HealthConfig, health: Health) -> None:
        host, _, port = config.listen.rpartition(":")
        try:
            self._server = ThreadingHTTPServer((host.strip("[]"), int(port)), _handler(health))
        except OSError as error:
            raise InputError(
                f"health: {config.listen}: {error.strerror or error}", remedy="take another port for [health] listen"
            ) from None
        self._server.daemon_threads = True
        self.address = f"{host}:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="health", daemon=True)
        self._thread.start()

    def __enter__(self) -> HealthServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()


def _handler(health: Health) -> type[BaseHTTPRequestHandler]:
    class Collector:
        def collect(self) -> Iterable[Metric]:
            return health.collect()

    from prometheus_client import CollectorRegistry, generate_latest

    registry = CollectorRegistry(auto_describe=False)
    registry.register(Collector())

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0
        server_version = "syncline"
        sys_version = ""

        def do_GET(self) -> None:
            if self.path == "/metrics":
                self._answer(200, generate_latest(registry), "text/plain; version=0.0.4; charset=utf-8")
            elif self.path in ("/livez", "/readyz"):
                good, text = health.live() if self.path == "/livez" else health.ready()
                self._answer(200 if good else 503, f"{text}\n".encode(), "text/plain; charset=utf-8")
            elif self.path == "/status":
                self._answer(200, json.dumps(health.report()).encode(), "application/json")
            else:
                self._answer(404, b"/metrics, /livez, /readyz, /status\n", "text/plain; charset=utf-8")

        do_HEAD = do_GET

        def _answer(self, status: int, body: bytes, kind: str) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    return Handler
