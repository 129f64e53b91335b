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
from protocols.validation.codec import RejectionReason


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
        try:
            with urllib.request.urlopen(f"http://{self.server.address}/{path}", timeout=5.0) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()


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
    assert 'syncline_state{agent="hub",role="hub",state="degraded"} 1.0' in agent.get("metrics")[1]


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
        who = f'agent="hub",reason="{reason.value}",role="hub"'
        assert f"syncline_rejected_total{{{who}}} {number}.0" in text
        assert f'syncline_rejected_by_source_total{{{who},source="cam7"}} {number}.0' in text


def test_a_refusal_is_logged_as_json_with_camera_and_sequence(agent: Agent, capfd: pytest.CaptureFixture[str]) -> None:
    for sequence in range(20):
        agent.health.refused(
            Refusal("not_finite", "cam7", "syncline/local/camera/cam7/observation", "u is nan", sequence)
        )
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    assert [line["sequence"] for line in lines] == [0, 1, 2, 3, 4], "a flood of them does not fill the log"
    assert {(line["camera"], line["reason"], line["event"]) for line in lines} == {("cam7", "not_finite", "refused")}
