"""One hub's process with 10, 100 and 1,000 cameras at 5 observations a second each, through a router."""

from __future__ import annotations

from pathlib import Path

from tests.bench import load
from tests.bench.speed.rows import Limit, Row, Section

_EACH_HZ = 5.0


def measure(quick: bool, data: Path) -> Section:
    """p99 from put to the hub's loop; CPU an observation against the number of cameras."""
    del data
    found = Section()
    cost: dict[int, float] = {}
    for cameras in (10, 100, 1000):
        figures = load.measure(cameras, _EACH_HZ * cameras, 6.0 if quick else 30.0)
        cost[cameras] = figures["hub_cpu_us"]
        found.rows.append(
            Row(f"hub, {cameras:,} cameras at 5 obs/s: p99", figures["p99_ms"], "ms", must=Limit("ours", 50.0),
                reach=Limit("ours", 20.0),
                note=f"{figures['rate']:,.0f}/s, {figures['lost']} lost, p50 {figures['p50_ms']:.1f} ms, "
                f"{figures['hub_cpu_us']:.0f} µs CPU an observation, {100 * figures['hub_cpu']:.0f} % of a core, "
                f"{figures['hub_mb']:.0f} MB")
        )  # fmt: skip
    found.rows.append(
        Row("hub, CPU an observation: 1,000 cameras", cost[1000], "µs", "100 cameras", cost[100],
            must=Limit("ratio", 0.8), note="linear in observations: no dearer with more cameras")
    )  # fmt: skip
    return found
