"""Health endpoints of an agent: /metrics, /livez, /readyz and /status over HTTP, and JSON log lines on standard error.

All values come from the status messages that the agent publishes anyway, so agents do not depend on this module.
"""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

from deploy.agents.metrics import LABELS, status_metrics
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
