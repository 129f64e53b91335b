"""Files for Prometheus and Grafana: a target for each agent of a site, alert rules, a dashboard."""

from __future__ import annotations

import json
from pathlib import Path

from deploy.site.boards.site_file import Site
from protocols.core.files import write_together

SHIPPED = Path(__file__).parents[1] / "monitoring"
RULES, DASHBOARD, PROMETHEUS = "alerts.yaml", "dashboard.json", "prometheus.yaml"


def write_monitoring(site: Site, out: Path) -> list[str]:
    """Write the files; returns a line for each, and one for agents that only their own machine can ask."""
    targets, hidden = [], []
    for agent in site.agents:
        health = agent.config.get("health", {})
        host, _, port = str(health.get("listen", "")).rpartition(":")
        if not port:
            continue
        address = agent.host.rpartition("@")[2]
        if host in ("0.0.0.0", "[::]"):
            host = address
        elif host in ("127.0.0.1", "localhost", "[::1]"):
            hidden.append(agent.name)
        targets.append({"targets": [f"{host}:{port}"], "labels": {"board": address}})
    jobs = {
        "global": {"scrape_interval": "5s"},
        "rule_files": [RULES],
        "scrape_configs": [{"job_name": "syncline", "static_configs": targets}],
    }
    files = {name: (SHIPPED / name).read_text(encoding="utf-8") for name in (RULES, DASHBOARD)}
    # JSON is YAML: no writer of its own is needed.
    files[PROMETHEUS] = "# Written by `syncline site monitoring`.\n" + json.dumps(jobs, indent=1) + "\n"
    write_together({out / name: text for name, text in files.items()})
    lines = [f"{out / name}" for name in files]
    if hidden:
        lines.append(
            f"on loopback, for their own machine or a tunnel only: {', '.join(hidden[:8])}"
            + (f" and {len(hidden) - 8} more" if len(hidden) > 8 else "")
            + '; listen = "0.0.0.0:9100" and beyond_loopback = true in [health] let others ask'
        )
    return lines
