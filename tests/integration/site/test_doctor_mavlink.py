"""`syncline doctor` on real MAVLink links: without a peer, with garbage, and with a simulated autopilot."""

from __future__ import annotations

import json
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pymavlink", reason="the extra `uav` is not installed: DOCTOR IS NOT TESTED ON MAVLINK")
from deploy.agents.processes import free_udp_port
from deploy.config.uav import MavlinkConfig, UavConfig
from deploy.site.doctor import autopilot
from deploy.site.doctor.check_result import CheckResult
from edge.mavlink.dialect import mavlink as M
from edge.mavlink.link.signing import Signing
from edge.mavlink.link.transport import Udp, Url
from tests.support.threads import looping
from tests.support.vehicle_link import autopilot as simulated_autopilot


def examine(url: str, patience_s: float = 0.5, **options: Any) -> list[CheckResult]:
    config = UavConfig(id="drone", mavlink=MavlinkConfig(url=url, **options))
    return list(autopilot.check(config, patience_s, listen_s=1.2))


def examine_link(url: str) -> CheckResult:
    (found,) = examine(url)
    return found


def test_of_an_autopilot_that_does_not_forward_the_parameter_is_named() -> None:
    with simulated_autopilot(system=7, firmware=M.MAV_AUTOPILOT_PX4) as (simulated, port):
        simulated.parameters["MAV_1_FORWARD"] = 0.0
        heartbeat, telemetry, station = examine(f"udpout:127.0.0.1:{port}", 20.0, rate_hz=4.0)
    assert (heartbeat.verdict, heartbeat.text) == ("ok", "heartbeat of system 7")
    assert telemetry.verdict == "ok", telemetry.text
    assert "of 4 requested" in telemetry.text
    assert (station.verdict, station.text) == ("warn", "none is heard; MAV_1_FORWARD = 0")


def test_without_the_key_of_an_autopilot_that_signs_this_is_named(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    with simulated_autopilot(signing=Signing(key.read_bytes())) as (_, port):
        heartbeat, telemetry, _ = examine(f"udpout:127.0.0.1:{port}", 20.0)
    assert heartbeat.verdict == "ok"
    assert "signs its messages" in telemetry.text
    assert telemetry.remedy == "set key in [mavlink]"


def test_a_missing_serial_port_is_a_failure() -> None:
    found = examine_link("serial:/dev/ttyNOPE:921600")
    assert (found.verdict, found.exit_status) == ("fail", 3)
    assert "No such file" in found.text
    assert "check device, baud rate and rights" in found.remedy


def test_a_silent_link_is_a_failure() -> None:
    found = examine_link(f"udpin:127.0.0.1:{free_udp_port()}")
    assert (found.verdict, found.exit_status) == ("fail", 3)
    assert "TX to RX" in found.remedy


def test_a_port_held_by_the_agent_itself_is_a_failure() -> None:
    taken = Udp(Url("udpin", "127.0.0.1", 0), bound=True)
    found = examine_link(f"udpin:127.0.0.1:{taken.port}")
    taken.close()
    assert found.verdict == "fail"
    assert "stop the agent" in found.remedy


def test_garbage_is_reported_as_a_wrong_baud_rate() -> None:
    port = free_udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:

        def send_garbage() -> None:
            with suppress(OSError):
                line.sendto(b"\xfd\x09\x00\x00\x17\x01\x01\x00\x00\x00garbled bytes\xfe\x03", ("127.0.0.1", port))

        with looping(send_garbage):
            found = examine_link(f"udpin:127.0.0.1:{port}")
    assert found.verdict == "fail"
    assert "baud rate, MAVLink 2" in found.remedy, found.text


def test_the_command_reports_the_failed_link(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from deploy.cli import run

    file = tmp_path / "uav.toml"
    file.write_text(
        'id = "drone"\n[mavlink]\nurl = "tcp:127.0.0.1:1"\n[bus]\nmode = "peer"\nlisten = ["tcp/127.0.0.1:0"]\n'
    )
    assert run(["doctor", str(file), "--json"]) in (2, 3)
    found = {one["check"]: one for one in json.loads(capsys.readouterr().out)}
    assert found["mavlink"]["verdict"] == "fail"
    assert found["mavlink"]["exit_status"] == 3
    assert "refused" in found["mavlink"]["text"]
