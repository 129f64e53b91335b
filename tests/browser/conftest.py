"""A headless Chromium (Debian's), and its screenshots."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PICTURES = Path(os.environ.get("BROWSER_OUT", Path(__file__).parents[2] / "browser-out"))
_HARMLESS = ("GPU stall due to ReadPixels", "software WebGL", "Automatic fallback to software")


def chromium_path() -> str:
    """Path of Chromium; "" if there is none."""
    return next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), ""
    )


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """The browser."""
    path = chromium_path()
    if not path:
        pytest.skip("NO BROWSER: install chromium (apt-get install chromium) to test the view and the report")
    api = pytest.importorskip("playwright.sync_api", reason="NO PLAYWRIGHT: pip install playwright")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        yield browser
        browser.close()


class Tab:
    """One page, its errors and requests, and its screenshots."""

    def __init__(self, browser: Any, size: tuple[int, int] = (1100, 700)) -> None:
        self.context = browser.new_context(viewport={"width": size[0], "height": size[1]}, accept_downloads=True)
        self.page = self.context.new_page()
        self.page.set_default_timeout(300_000)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))

    def _heard(self, message: Any) -> None:
        # An image that is replaced before the browser has loaded it is not found: a newer one is shown.
        replaced = str(message.location.get("url", "")).startswith("blob:") and "ERR_FILE_NOT_FOUND" in message.text
        if message.type == "error" and not replaced and not any(text in message.text for text in _HARMLESS):
            self.errors.append(f"{message.text} {message.location.get('url', '')}".strip())

    def shot(self, name: str, **options: Any) -> bytes:
        """A screenshot, kept as browser-out/NAME.png."""
        PICTURES.mkdir(parents=True, exist_ok=True)
        return bytes(self.page.screenshot(path=str(PICTURES / f"{name}.png"), **options))


@pytest.fixture
def tab(chromium: Any) -> Iterator[Tab]:
    """A new page; the test fails if the page had an error."""
    one = Tab(chromium)
    yield one
    one.context.close()
    assert one.errors == []
