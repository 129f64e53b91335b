"""/metrics, /livez and /readyz over HTTP, as an agent's status changes."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from deploy.agents.health import STATUS_TIMEOUT_S, Health, HealthServer
from deploy.config.agents import HealthConfig
from protocols.bus.base import Refusal
from protocols.messages import syncline_pb2 as pb
from protocols.validation.rules import RejectionReason
from tests.support.receiving import http_get


class Agent:
    """An agent's health server, on a simulated clock."""

    def __init__(self) -> None:
        self.now = 100.0
        self.health = Health(lambda: self.now)
        self.server = HealthServer(HealthConfig(listen="127.0.0.1:0"), self.health)

    def publish(self, state: str, message: str = "", **counters: float) -> None:
        status = pb.AgentStatus(schema_version=1, agent="hub", role="hub", boot_id="b", state=state, message=message)
        for name, count in counters.items():
            status.counters[name] = count
        self.health.seen(status)

    def get(self, path: str) -> tuple[int, str]:
        return http_get(self.server.address, path)


@pytest.fixture
def agent() -> Iterator[Agent]:
    made = Agent()
    with made.server:
        yield made


def test_a_starting_agent_is_live_and_not_ready(agent: Agent) -> None:
    assert agent.get("livez") == (200, "starting\n")
    assert agent.get("readyz") == (503, "starting\n")
    assert agent.get("metrics")[0] == 200


def test_a_running_agent_is_ready_and_a_degraded_one_is_not(agent: Agent) -> None:
    agent.publish("running", "3 cameras calibrated")
    assert agent.get("livez") == (200, "ok\n")
    assert agent.get("readyz") == (200, "running: 3 cameras calibrated\n")
    agent.publish("degraded", "camera cam0 runs 2 times; only the first is heard")
    assert agent.get("livez") == (200, "ok\n")
    assert agent.get("readyz") == (503, "degraded: camera cam0 runs 2 times; only the first is heard\n")
    assert 'syncline_state{agent="hub",role="hub",site="local",state="degraded"} 1.0' in agent.get("metrics")[1]


def test_an_agent_whose_loop_hangs_is_not_live(agent: Agent) -> None:
    agent.publish("running")
    agent.now += STATUS_TIMEOUT_S + 1.0
    assert agent.get("livez") == (503, "no status for 6 s\n")
    assert agent.get("readyz")[0] == 503
    agent.publish("running")
    assert agent.get("livez")[0] == 200


def test_refusals_are_counted_by_reason_and_by_source(agent: Agent) -> None:
    counters = {f"rejected.{reason.value}": number for number, reason in enumerate(RejectionReason, 1)}
    agent.publish("running", **counters, **{f"{name}@cam7": number for name, number in counters.items()})
    text = agent.get("metrics")[1]
    for number, reason in enumerate(RejectionReason, 1):
        who = f'agent="hub",reason="{reason.value}",role="hub",site="local",source="cam7"'
        assert f"syncline_messages_rejected_total{{{who}}} {number}.0" in text


def test_a_refusal_is_logged_as_json_with_camera_and_sequence(agent: Agent, capfd: pytest.CaptureFixture[str]) -> None:
    for sequence in range(20):
        agent.health.refused(
            Refusal("not_finite", "cam7", "syncline/local/camera/cam7/observation", "u is nan", sequence)
        )
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    assert [line["sequence"] for line in lines] == [0, 1, 2, 3, 4], "a flood of them does not fill the log"
    assert {(line["camera"], line["reason"], line["event"]) for line in lines} == {("cam7", "not_finite", "refused")}


def test_a_condition_that_lasts_is_logged_once(agent: Agent, capfd: pytest.CaptureFixture[str]) -> None:
    agent.publish("running")
    for seconds in range(3, 9):
        agent.publish("degraded", f"no frames from cam2 ({seconds} s)")
    agent.publish("running")
    events = [json.loads(line)["event"] for line in capfd.readouterr().err.splitlines()]
    assert events == ["degraded", "running"]


def test_metrics_are_of_base_units_with_labels_for_what_varies(agent: Agent) -> None:
    status = pb.AgentStatus(schema_version=1, agent="hub", role="hub", boot_id="b", state="running")
    status.gauges.update({"ppm.cam1": -12.5, "frame_age_s.cam1": 0.25, "offset_std_s.cam1": 2e-5, "tracks": 3.0})
    status.counters.update({"over_budget": 5.0, "over_budget.cam1": 4.0, "asked.export": 1.0, "received": 7.0})
    agent.health.seen(status)
    text = agent.get("metrics")[1]
    who = 'agent="hub"', 'role="hub",site="local"'
    for line in (
        f'syncline_hub_camera_clock_ratio{{{who[0]},camera="cam1",{who[1]}}} -1.25e-05',
        f'syncline_hub_camera_frame_age_seconds{{{who[0]},camera="cam1",{who[1]}}} 0.25',
        f'syncline_hub_camera_offset_std_seconds{{{who[0]},camera="cam1",{who[1]}}} 2e-05',
        f"syncline_hub_tracks{{{who[0]},{who[1]}}} 3.0",
        f'syncline_hub_over_budget_total{{{who[0]},camera="cam1",{who[1]}}} 4.0',
        f'syncline_hub_asked_total{{action="export",{who[0]},{who[1]}}} 1.0',
        f"syncline_messages_received_total{{{who[0]},{who[1]}}} 7.0",
    ):
        assert line in text.splitlines()


def test_values_of_what_is_gone_have_no_series(agent: Agent) -> None:
    agent.publish("running", frames=5)
    assert "syncline_hub_frames_total" in agent.get("metrics")[1]
    agent.now += STATUS_TIMEOUT_S + 1.0
    text = agent.get("metrics")[1]
    assert "syncline_hub_frames_total" not in text
    assert 'syncline_live{agent="",role="",site="local"} 0.0' in text


def test_head_is_answered(agent: Agent) -> None:
    agent.publish("running")
    request = urllib.request.Request(f"http://{agent.server.address}/metrics", method="HEAD")
    with urllib.request.urlopen(request, timeout=5.0) as answer:
        assert (answer.status, answer.read()) == (200, b"")
        assert int(answer.headers["Content-Length"]) > 0
