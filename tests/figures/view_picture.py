"""Screenshots of the live view and of the report for the README: a running demo in a headless Chromium.

`python -m tests.figures.view_picture` writes view.jpg and report.jpg into docs/pictures.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from tests.browser.conftest import FLAGS, chromium_path

PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"
_QUALITY = 82


def main() -> int:
    """Make both screenshots."""
    path = chromium_path()
    if not path:
        print("no chromium here: apt-get install chromium", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        out = Path(folder) / "demo"
        words = ["demo", "--cameras", "4", "--seconds", "600", "--view", "--view-port", "0", "--out", str(out)]
        process = subprocess.Popen([sys.executable, "-m", "deploy", *words], stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[-1]
            page = browser.new_page(viewport={"width": 1400, "height": 1000})
            page.set_default_timeout(180_000)
            page.goto(address)
            page.wait_for_function("document.querySelectorAll('[data-state=calibrated]').length === 4")
            page.wait_for_timeout(15_000)  # part of the path, and images in every frustum
            notice = page.locator(".mantine-Notification-closeButton")
            if notice.count():
                notice.first.click()  # that this machine renders in software is nobody's business
            page.wait_for_timeout(1_000)
            page.screenshot(path=str(PICTURES / "view.jpg"), type="jpeg", quality=_QUALITY)
            page.get_by_role("button", name="Export").click()
            page.get_by_text("exported to").wait_for()
            page.close()
            report = browser.new_page(viewport={"width": 1100, "height": 1250})
            report.goto((out / "report.html").as_uri())
            report.wait_for_timeout(2_000)
            report.screenshot(path=str(PICTURES / "report.jpg"), type="jpeg", quality=_QUALITY)
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=120)
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
