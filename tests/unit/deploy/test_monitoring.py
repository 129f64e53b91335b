"""Alert rules, dashboard and metrics, against each other and with Prometheus' own tool."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from prometheus_client import CollectorRegistry, generate_latest

from deploy.agents.health import Health
from protocols.messages import syncline_pb2 as pb

FOLDER = Path(__file__).resolve().parents[3] / "deploy" / "site" / "monitoring"
PROMTOOL = shutil.which("promtool")
needs_promtool = pytest.mark.skipif(PROMTOOL is None, reason="promtool (Debian: prometheus) is not here: NOT CHECKED")

STATUSES = {
    "camera": (
        {"frames": 9, "dropped": 1, "published": 8, "unpublished": 1, "detections": 4, "reconnections": 1},
        {"fps": 30.0, "latency_s": 0.01, "exposure_s": 0.001, "temperature_c": 60.0, "heard": 1.0},
    ),
    "hub": (
        {"received": 9, "lost": 1, "dropped": 0, "skipped": 0, "observations": 8, "solved": 2, "solver_failures": 1,
         "over_budget": 3, "over_budget.cam1": 2, "fault.cam1": 1, "faults": 1, "asked.export": 1, "track.frames": 7,
         "rejected.wrong_source": 2, "rejected.wrong_source@cam1": 2, "nodes.taken_over": 1, "alarms": 1},
        {"ppm.cam1": 12.0, "frame_age_s.cam1": 0.1, "offset_std_s.cam1": 1e-4, "calibrated_cameras": 3.0, "nodes": 2.0,
         "calibration_age_s": 5.0, "calibration_verified": 1.0, "tracks": 1.0},
    ),
    "record": (
        {"recorded": 5, "lost": 0, "dropped": 0, "skipped": 0, "deleted_files": 2},
        {"log_bytes": 4e5, "recording": 1.0, "disk_free_bytes": 1e10, "certificate_expiry_timestamp_s": 1.8e9},
    ),
    "router": ({"restarts": 1, "canary": 9}, {"canary_s": 0.001, "sessions": 3.0}),
    "uav": (
        {"frames": 9, "link.refused.identity": 1, "camera.selections": 1, "link.garbled_bytes": 3, "sent.pointed": 1},
        {"time_std_s": 0.01, "latency_p99_s": 0.1},
    ),
}  # fmt: skip


def metrics(role: str) -> str:
    counters, gauges = STATUSES[role]
    health = Health(site="yard", role=role, agent=f"{role}-1")
    status = pb.AgentStatus(agent=f"{role}-1", role=role, state="running", version="0.1.0")
    status.counters.update(counters)
    status.gauges.update(gauges)
    health.seen(status)
    registry = CollectorRegistry(auto_describe=False)
    registry.register(health)  # type: ignore[arg-type]
    return generate_latest(registry).decode()


@needs_promtool
@pytest.mark.parametrize("role", sorted(STATUSES))
def test_promtool_finds_nothing_to_say_about_the_metrics(role: str) -> None:
    ended = subprocess.run(
        [str(PROMTOOL), "check", "metrics"],
        input=metrics(role),
        capture_output=True,
        text=True,
        check=False,
        timeout=30,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


@pytest.mark.parametrize("role", sorted(STATUSES))
def test_every_metric_stands_once_and_names_its_agent_and_site(role: str) -> None:
    lines = metrics(role).splitlines()
    names = [line.split()[2] for line in lines if line.startswith("# TYPE")]
    assert len(names) == len(set(names))
    samples = [line for line in lines if not line.startswith("#")]
    assert all(f'agent="{role}-1"' in line and 'site="yard"' in line for line in samples)
    assert not [line for line in samples if "cam1" in line.partition("{")[0]], "ids are labels"


@needs_promtool
def test_the_alerts_fire_when_they_should(tmp_path: Path) -> None:
    shutil.copy(FOLDER / "alerts.yaml", tmp_path)
    shutil.copy(Path(__file__).with_name("alerts_test.yaml"), tmp_path)
    for words in (["check", "rules", "alerts.yaml"], ["test", "rules", "alerts_test.yaml"]):
        ended = subprocess.run(
            [str(PROMTOOL), *words], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
        )
        assert ended.returncode == 0, ended.stdout + ended.stderr
    for file in ("prometheus.yaml",):
        shutil.copy(FOLDER / file, tmp_path)
        ended = subprocess.run(
            [str(PROMTOOL), "check", "config", file],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        assert ended.returncode == 0, ended.stdout + ended.stderr


def test_every_alert_has_a_test() -> None:
    rules = yaml.safe_load((FOLDER / "alerts.yaml").read_text(encoding="utf-8"))["groups"][0]["rules"]
    tested = Path(__file__).with_name("alerts_test.yaml").read_text(encoding="utf-8")
    assert [rule["alert"] for rule in rules if f"alertname: {rule['alert']}\n" not in tested] == []


@pytest.mark.parametrize("file", ["alerts.yaml", "dashboard.json"])
def test_rules_and_dashboard_ask_for_metrics_that_exist(file: str) -> None:
    there = {line.partition("{")[0] for role in STATUSES for line in metrics(role).splitlines()}
    text = (FOLDER / file).read_text(encoding="utf-8")
    expressions = (
        [panel_target["expr"] for panel in json.loads(text)["panels"] for panel_target in panel["targets"]]
        if file.endswith(".json")
        else [rule["expr"] for rule in yaml.safe_load(text)["groups"][0]["rules"]]
    )
    asked = {name for expression in expressions for name in re.findall(r"\bsyncline_\w+", expression)}
    assert len(asked) > 5
    assert asked <= there
