"""`syncline quick` with its page: marked detections, a click that trains the detector, and a calibration."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("playwright")

from playwright.sync_api import Error

from protocols.session.calibration import read_calibration
from tests.browser.conftest import Tab


def test_two_simulated_webcams_from_the_page_to_a_calibration(tab: Tab, tmp_path: Path) -> None:
    words = ["quick", "--simulated", "--port", "0", "--out", str(tmp_path / "out"), "--seconds", "240"]
    process = subprocess.Popen(
        [sys.executable, "-m", "deploy", *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[-1]
        assert address.startswith("http://127.0.0.1:")
        page = tab.page
        page.goto(address)
        for name in ("cam0", "cam1"):
            page.wait_for_selector(f"[data-camera={name}]")
        page.wait_for_function("Array.from(document.images).some(image => image.naturalWidth >= 300)")
        page.wait_for_timeout(1000)
        tab.shot("quick")
        page.wait_for_function("document.querySelectorAll('[data-state=calibrated]').length === 2")
        with contextlib.suppress(Error):  # it may have ended already
            page.get_by_role("button", name="Finish").click(timeout=10_000)
        rest, _ = process.communicate(timeout=120)
        assert process.returncode == 0, rest
        assert "written: " in rest
        assert sorted(read_calibration(tmp_path / "out" / "calibration.toml")[1]) == ["cam0", "cam1"]
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
        # The page's server has ended: the socket error is expected.
        tab.errors = [text for text in tab.errors if "WebSocket" not in text and "ERR_CONNECTION" not in text]
