"""What every status says of the agent's surroundings: router, clock, certificate."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from deploy.agents.startup_checks import Conditions
from deploy.config.agents import CameraConfig, RecorderConfig
from protocols.bus.security.tls import check_files
from protocols.bus.settings import BusConfig, TlsConfig
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb

ROUTER = BusConfig(mode="client", connect=("tcp/10.0.0.5:7447",))


class Machine:
    """An agent's machine on simulated clocks."""

    def __init__(self, settings: CameraConfig | RecorderConfig, unix: float = 1.8e9) -> None:
        self.now, self.unix, self.connected = 100.0, unix, True
        self.conditions = Conditions(settings, lambda: self.connected, now=lambda: self.now, unix=lambda: self.unix)

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.unix += seconds

    def status(self, state: str = "running") -> pb.AgentStatus:
        status = pb.AgentStatus(agent="a", role="camera", state=state, message="12 messages")
        self.conditions.amend(status)
        return status


def test_a_lost_router_is_a_reason_with_its_duration_until_it_is_back() -> None:
    machine = Machine(CameraConfig(id="cam0", bus=ROUTER))
    assert machine.status().state == "running"
    machine.connected = False
    machine.status()
    machine.wait(7.0)
    status = machine.status()
    assert (status.state, status.message) == ("degraded", "no router at tcp/10.0.0.5:7447 for 7 s; 12 messages")
    assert machine.status("starting").state == "degraded"
    assert machine.status("stopping").state == "stopping"
    machine.connected = True
    assert machine.status().state == "running"


@pytest.mark.parametrize(
    ("bus", "text"),
    [
        (BusConfig(connect=("tcp/127.0.0.1:9",)), "no other agent is reached at tcp/127.0.0.1:9 for 7 s; 12 messages"),
        (BusConfig(listen=("tcp/127.0.0.1:9",)), "no other agent is reached for 7 s; 12 messages"),
    ],
)
def test_a_peer_without_others_is_given_time_to_meet_them(bus: BusConfig, text: str) -> None:
    machine = Machine(CameraConfig(id="cam0", bus=bus))
    machine.connected = False
    assert machine.status().state == "running"
    machine.wait(7.0)
    assert machine.status().message == text


def test_a_recorders_clock_that_was_never_set_or_that_jumps_is_a_reason() -> None:
    recorder = RecorderConfig(bus=ROUTER)
    unset = Machine(recorder, unix=1000.0)
    assert "this machine's clock was never set: it says 1970-01-01 00:16:40 UTC" in unset.status().message
    machine = Machine(recorder)
    assert machine.status().state == "running"
    machine.unix -= 3600.0
    assert "was set back by 3600 s" in machine.status().message
    machine.wait(61.0)
    assert machine.status().state == "running", "a step is over after a minute"
    assert Machine(CameraConfig(id="cam0", bus=ROUTER), unix=1000.0).status().state == "running"


@pytest.fixture
def tls(tmp_path: Path) -> TlsConfig:
    keys = pytest.importorskip("deploy.site.keys", reason="the extra `keys` is not installed")
    keys.make_site(tmp_path / "keys", "yard")
    own = tmp_path / "own"
    own.mkdir()
    begin = datetime.now(UTC) + timedelta(days=100)
    keys.sign(tmp_path / "keys", own, "camera.cam0", begin, begin + timedelta(days=30), ())
    return TlsConfig(ca=own / "ca.pem", certificate=own / "certificate.pem", key=own / "key.pem")


def test_a_certificate_before_its_begin_is_a_clock_that_is_behind_and_no_expiry(tls: TlsConfig) -> None:
    with pytest.raises(InputError) as caught:
        check_files(tls)
    assert "not valid yet" in caught.value.what
    assert f"this machine's clock says {datetime.now(UTC):%Y-%m-%d}" in caught.value.what
    assert "expired" not in str(caught.value)
    assert "renew" not in str(caught.value)
    assert "clock" in caught.value.remedy


def test_the_certificates_end_is_measured_and_its_expiry_a_reason(tls: TlsConfig) -> None:
    bus = BusConfig(mode="client", connect=("tls/10.0.0.5:7447",), tls=tls)
    machine = Machine(CameraConfig(id="cam0", bus=bus), unix=datetime.now(UTC).timestamp())
    assert "not valid yet" in machine.status().message
    machine.wait(110 * 86_400.0)
    status = machine.status()
    assert status.state == "running"
    left = status.gauges["certificate_expiry_timestamp_s"] - machine.unix
    assert left == pytest.approx(20 * 86_400.0, abs=60.0)
    machine.wait(30 * 86_400.0)
    assert "expired 10.0 days ago" in machine.status().message
