"""An agent's health as others ask for it: /metrics, /livez, /readyz over HTTP, and lines of JSON on standard error.

Everything is read from the status that the agent publishes anyway, so that no agent knows of this.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

from deploy.config.agents import HealthConfig
from protocols.bus.base import Refusal
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

LIVE_S = 5.0
"""An agent publishes its status each second; after this without one it does not live."""
_LINES_S = 10.0
_LINES = 5


class Health:
    """The last status and what was refused. seen and refused may be called from any thread.

    now: a monotonic clock [s].
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._status: pb.AgentStatus | None = None
        self._at = self._began = now()
        self._log: Any = None
        self._said = ""
        self._unheard = 0
        self._told: dict[tuple[str, str], tuple[float, int]] = {}

    def seen(self, status: pb.AgentStatus) -> None:
        """The agent has published its status."""
        with self._lock:
            self._status, self._at = status, self._now()
        unheard = "heard" in status.gauges and status.gauges["heard"] == 0.0
        if unheard and self._unheard == 1:  # at the start the first look may come too early
            self._line("warning", "unheard", role=status.role, agent=status.agent, message=status.message)
        self._unheard = self._unheard + 1 if unheard else 0
        said = f"{status.state}: {status.message}" if status.state == "degraded" else status.state
        if said != self._said and (status.state == "degraded" or self._said):
            self._line(
                "warning" if status.state == "degraded" else "info",
                status.state,
                role=status.role,
                agent=status.agent,
                sequence=status.sequence,
                message=status.message,
            )
        self._said = said

    def refused(self, refusal: Refusal) -> None:
        """A message was not let in: a few lines a reason and source, all of them counted."""
        now, key = self._now(), (refusal.reason, refusal.agent)
        began, lines = self._told.get(key, (now, 0))
        if now - began > _LINES_S:
            began, lines = now, 0
        if len(self._told) > 1024:
            self._told.clear()
        self._told[key] = (began, lines + 1)
        if lines < _LINES:
            self._line(
                "warning",
                "refused",
                reason=refusal.reason,
                camera=refusal.agent,
                sequence=refusal.sequence,
                key=refusal.key,
                detail=refusal.detail,
                more="further ones are only counted for 10 s" if lines == _LINES - 1 else None,
            )

    def live(self) -> tuple[bool, str]:
        """Whether the agent's loop turns, and a word about it."""
        with self._lock:
            silent, status = self._now() - self._at, self._status
        if silent > LIVE_S:
            return False, f"no status for {silent:.0f} s"
        return True, "starting" if status is None else "ok"

    def ready(self) -> tuple[bool, str]:
        """Whether it does what it is there for."""
        alive, text = self.live()
        with self._lock:
            status = self._status
        if not alive or status is None:
            return False, text
        return status.state == "running", f"{status.state}: {status.message}".rstrip(": ")

    def collect(self) -> Iterator[Metric]:
        """The status as Prometheus' metrics: counters by name, refusals by reason and source, gauges, age."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        with self._lock:
            status, age = self._status, self._now() - self._at
        yield GaugeMetricFamily("syncline_up_seconds", "Since the start.", value=self._now() - self._began)
        yield GaugeMetricFamily("syncline_status_age_seconds", "Since the last status.", value=age)
        if status is None:
            return
        names = ["role", "agent"]
        who = [status.role, status.agent]
        state = GaugeMetricFamily("syncline_state", "1 for the present state.", labels=[*names, "state"])
        state.add_metric([*who, status.state], 1.0)
        yield state
        rejected = CounterMetricFamily("syncline_rejected", "Messages that were not let in.", labels=[*names, "reason"])
        sources = CounterMetricFamily(
            "syncline_rejected_by_source", "The same, by the id in the key.", labels=[*names, "reason", "source"]
        )
        events = CounterMetricFamily("syncline_events", "What the agent counts.", labels=[*names, "name"])
        for name, value in status.counters.items():
            if name.startswith("rejected."):
                reason, _, source = name.removeprefix("rejected.").partition("@")
                if source:
                    sources.add_metric([*who, reason, source], value)
                else:
                    rejected.add_metric([*who, reason], value)
            else:
                events.add_metric([*who, name], value)
        yield from (rejected, sources, events)
        gauges = GaugeMetricFamily("syncline_gauge", "What the agent measures.", labels=[*names, "name"])
        for name, value in status.gauges.items():
            gauges.add_metric([*who, name], value)
        yield gauges

    def _line(self, level: str, event: str, **values: Any) -> None:
        if self._log is None:
            self._log = _logger()
        getattr(self._log, level)(event, **{name: value for name, value in values.items() if value is not None})


def _logger() -> Any:
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
    """Answers over HTTP while the context is open. Raises InputError where the address is taken."""

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
            else:
                self._answer(404, b"/metrics, /livez, /readyz\n", "text/plain; charset=utf-8")

        def _answer(self, status: int, body: bytes, kind: str) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    return Handler
