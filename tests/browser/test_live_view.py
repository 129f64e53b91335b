"""The live view of a running demo, in a browser: figures of the hub, frusta, pictures, buttons."""

from __future__ import annotations

import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hub.view.lag_history import lag_of
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import read_calibration
from protocols.topics import CALIBRATION, STATUS
from tests.browser.conftest import Tab
from tests.support.samples import eventually

NAMES = ("cam0", "cam1", "cam2")


@dataclass
class Demo:
    """A running demo: the address of its view, and its bus."""

    out: Path
    address: str
    endpoint: str


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory, chromium: Any) -> Iterator[Demo]:
    out = tmp_path_factory.mktemp("demo") / "out"
    words = ["demo", "--view", "--view-port", "0", "--seconds", "600", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-m", "deploy", *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("live view: open http://127.0.0.1:"), line
        config = tomllib.loads((out / "config" / "cam0.toml").read_text(encoding="utf-8"))
        yield Demo(out, line.split()[-1], config["bus"]["connect"][0])
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


def test_the_view_of_a_running_demo(demo: Demo, tab: Tab) -> None:
    page = tab.page
    with open_bus("demo", BusConfig(mode="client", connect=(demo.endpoint,)), timeout_s=20.0) as bus:
        answers, statuses = bus.subscribe(CALIBRATION), bus.subscribe(STATUS)
        page.goto(demo.address)
        for name in NAMES:
            page.wait_for_selector(f"[data-camera={name}]")
        page.wait_for_selector("[data-state=calibrated]")
        page.wait_for_function("document.querySelectorAll('[data-state=calibrated]').length === 3")
        page.wait_for_timeout(1500)
        tab.shot("live")
        assert "calibrated: 3 cameras" in page.inner_text("[data-syncline=headline]")

        # The panel shows of each camera what the hub has published.
        shown: dict[str, set[str]] = {}

        def panel(name: str) -> str:
            return page.inner_text(f"[data-clock={name}]")

        def same() -> bool:
            for received in answers.drain():
                assert isinstance(received.message, pb.Calibration)
                for found in received.message.cameras:
                    lag = f"{lag_of(found):+.6f} s ± {1e3 * found.time_offset_std:.3f} ms"
                    rate = f"{1e6 * (found.clock_rate - 1.0):+.1f} ppm"
                    # Any camera may be the reference: where cam0 came late, cam1 is.
                    is_reference = found.camera == received.message.reference_camera
                    clock = "reference clock" if is_reference else f"{lag} · {rate}"
                    shown.setdefault(found.camera, set()).add(f"{clock} · {found.rms_px:.2f} px")
            return all(panel(name) in shown.get(name, set()) for name in NAMES)

        assert eventually(same, 30.0), ([panel(name) for name in NAMES], shown)
        rate = float(page.locator("[data-camera=cam1] td").nth(1).inner_text())
        assert 0.0 < rate < 60.0, "frames arrive; the rate depends on the machine"

        # The camera's image arrives while a browser is open.
        page.wait_for_function("Array.from(document.images).some(image => image.naturalWidth >= 300)")

        # Export: a file for the browser, and the hub's own files.
        with page.expect_download() as download:
            page.get_by_role("button", name="Export").click()
        file = Path(download.value.path())
        assert sorted(read_calibration(file)[1]) == list(NAMES)
        assert eventually((demo.out / "result.json").exists, 30.0)

        # Stop: the log is complete. Start: a new log.
        page.get_by_role("button", name="Stop recording").click()
        page.get_by_text("paused after demo.mcap").wait_for()
        reader = LogReader(demo.out / "demo.mcap")
        assert sum(1 for _ in reader.messages()) > 100
        assert reader.damage == ""
        page.get_by_role("button", name="Start recording").click()
        assert eventually((demo.out / "demo-2.mcap").exists, 30.0)

        page.get_by_role("button", name="Recalibrate").click()

        def asked() -> bool:
            return any(
                received.agent == "hub" and received.message.counters["asked.recalibrate"] == 1  # type: ignore[attr-defined]
                for received in statuses.drain()
            )

        assert eventually(asked, 30.0)
    outside = [url for url in tab.requests if not url.startswith((demo.address, "data:", "blob:"))]
    assert outside == [], "the page sends no requests elsewhere"
