"""A thousand cameras on one hub: nothing is lost; latency and cost are reported."""

from __future__ import annotations

from tests.bench.load import measure
from tests.faults.matrix import measured


def test_a_thousand_cameras_lose_nothing() -> None:
    found = measure(1000, 5000.0, 20.0)
    measured(
        "1,000 cameras, 5,000 obs/s on one hub",
        "p99 ≤ 50 ms",
        f"{found['rate']:.0f} obs/s, {found['lost']:.0f} of {found['sent']:.0f} lost, p50 {found['p50_ms']:.1f} ms, "
        f"p99 {found['p99_ms']:.1f} ms, {found['hub_cpu_us']:.0f} µs of CPU each, {found['hub_mb']:.0f} MB",
        found["p99_ms"] <= 50.0,
    )
    assert found["lost"] == 0
    assert found["received"] == found["sent"]
