"""Clock quality from the real output of chrony, PTP and the kernel, and without any of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pytest

from edge.agents.clock_quality import (
    ClockMonitor,
    ClockQuality,
    chrony_error,
    kernel_clock,
    ptp_error,
    query_clock_quality,
)

CHRONY_SYNCHRONISED = (
    "C0A80A01,192.168.10.1,3,1763758812.084,0.000012345,-0.000004,0.000021,-12.3,0.001,0.02,0.0012,0.0003,64.5,Normal\n"
)
CHRONY_UNSYNCHRONISED = "00000000,,0,0.000000000,0.000000000,0.0,0.0,0.0,0.0,0.0,1.0,1.0,0.0,Not synchronised\n"
PTP = "sending: GET TIME_STATUS_NP\n\tmaster_offset              -250\n\tgmPresent                  true\n"


def replies(**answers: str) -> object:
    def run(command: Sequence[str]) -> tuple[int, str]:
        return (0, answers[command[0]]) if command[0] in answers else (127, "")

    return run


def test_chronys_bound_is_its_correction_dispersion_and_half_the_delay() -> None:
    assert chrony_error(CHRONY_SYNCHRONISED) == pytest.approx(0.000012345 + 0.0003 + 0.0006)
    assert chrony_error(CHRONY_UNSYNCHRONISED) is None
    for odd in (
        "",
        "506 Cannot talk to daemon\n",
        CHRONY_SYNCHRONISED.replace("0.0003", "x"),
        CHRONY_SYNCHRONISED.replace("0.0003", "nan"),
    ):
        assert chrony_error(odd) is None


def test_the_ptp_error_is_the_offset_from_the_grandmaster() -> None:
    assert ptp_error(PTP) == pytest.approx(250e-9)
    assert ptp_error(PTP.replace("true", "false")) is None
    assert ptp_error("\tgmPresent true\n") is None


def test_the_first_service_with_a_valid_reply_is_used(tmp_path: Path) -> None:
    def kernel() -> tuple[bool, float]:
        return True, 0.016

    (tmp_path / "dev").mkdir()
    both = replies(chronyc=CHRONY_SYNCHRONISED, pmc=PTP)
    assert query_clock_quality(both, kernel, tmp_path).source == "chrony"
    late = replies(chronyc=CHRONY_UNSYNCHRONISED, pmc=PTP)
    assert query_clock_quality(late, kernel, tmp_path) == ClockQuality("kernel", 0.016), "no PTP clock in this machine"
    (tmp_path / "dev" / "ptp0").touch()
    assert query_clock_quality(late, kernel, tmp_path).source == "ptp"
    unsynchronised = query_clock_quality(replies(), lambda: (False, 16.0), tmp_path)
    assert unsynchronised.gauges() == {"clock_synchronised": 0.0}


def test_the_real_kernel_clock_can_be_queried() -> None:
    synchronised, error = kernel_clock()
    assert isinstance(synchronised, bool)
    assert error >= 0.0
    assert query_clock_quality().source in ("chrony", "ptp", "kernel", "none")


def test_a_camera_on_the_hosts_clock_reports_its_offset_to_unix_time() -> None:
    with ClockMonitor(lambda: ClockQuality("chrony", 0.001)) as watcher:
        watcher._thread.join(0.5)
        known = watcher.gauges("monotonic")
        assert known["clock_error_s"] == 0.001
        assert known["unix_minus_camera_s"] > 1e9
        assert "unix_minus_camera_s" not in watcher.gauges("device")
    assert math.isinf(ClockQuality("none", math.inf).error_s)
