"""report.html in a browser: offline, without errors, readable without colour, printable."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deploy.cli import run
from tests.browser.conftest import Tab
from tests.support.crowds import boxes_csv, write_calibration

SIZE_LIMIT = 6 * 1024 * 1024


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A report of a good session, of the same cut short, and of one that is refused."""
    folder = tmp_path_factory.mktemp("reports")
    assert run(["simulate", "marker", "--out", str(folder / "good"), "--cameras", "3", "--seconds", "15"]) == 0
    lines = (folder / "good" / "observations.csv").read_text(encoding="utf-8").splitlines()
    starts: dict[str, float] = {}
    for name, seconds in (("weak", 8.0), ("refused", 0.5)):
        (folder / name).mkdir()
        (folder / name / "rig.toml").write_bytes((folder / "good" / "rig.toml").read_bytes())
        kept = [lines[0]]
        for line in lines[1:]:
            camera, _, time, *_ = line.split(",")
            if float(time) - starts.setdefault(camera, float(time)) < seconds:
                kept.append(line)
        (folder / name / "observations.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    codes = {name: run(["calibrate", str(folder / name), "--out", str(folder / f"{name}-out")]) for name in NAMES}
    assert codes["good"] == 0
    assert codes["refused"] == 3
    return {name: folder / f"{name}-out" / "report.html" for name in NAMES}


NAMES = ("good", "weak", "refused")


@pytest.mark.parametrize("name", NAMES)
def test_a_report_opens_offline_without_requests(name: str, reports: dict[str, Path], tab: Tab) -> None:
    tab.context.set_offline(True)
    tab.page.goto(reports[name].as_uri())
    heading = tab.page.inner_text("h1")
    assert heading.startswith("Refused" if name == "refused" else ("Good", "Usable"))
    assert tab.page.locator("section").first.locator("h1").count() == 1, "the quality assessment comes first"
    if name != "refused":
        tab.page.wait_for_selector("#scene-3d .main-svg, #scene-3d canvas")
    tab.shot(f"report-{name}", full_page=True)
    assert [url for url in tab.requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert reports[name].stat().st_size <= SIZE_LIMIT


def test_the_report_of_followed_people_opens_offline(tmp_path: Path, tab: Tab) -> None:
    (tmp_path / "boxes.csv").write_text(boxes_csv(), encoding="utf-8")
    calibration = str(write_calibration(tmp_path / "calibration.toml"))
    assert run(["follow", str(tmp_path), "--calibration", calibration, "--out", str(tmp_path)]) == 0
    tab.context.set_offline(True)
    tab.page.goto((tmp_path / "report.html").as_uri())
    assert tab.page.inner_text("h1") == "3 people followed through 3 cameras"
    assert tab.page.locator("polyline.walk").count() >= 3
    plan = tab.page.locator("svg[aria-label='Paths from above']").bounding_box()
    assert plan is not None
    assert plan["width"] > 300
    tab.shot("report-follow", full_page=True)
    assert [url for url in tab.requests if not url.startswith("file:")] == []


def test_figures_are_distinguished_without_colour(reports: dict[str, Path], tab: Tab) -> None:
    """Marks of findings keep their letters, and lines of pairs their dashes, without colour."""
    page = tab.page
    page.goto(reports["weak"].as_uri())
    marks = page.evaluate(
        "Array.from(document.querySelectorAll('.findings li')).map(li => "
        "[li.className, getComputedStyle(li, '::before').content])"
    )
    by_level: dict[str, set[str]] = {}
    for level, mark in marks:
        by_level.setdefault(level, set()).add(mark)
    assert len(by_level) > 1
    assert len(set.union(*by_level.values())) == len(by_level), "each level has a mark of its own"
    dashes = page.evaluate(
        "Object.fromEntries(['agrees','contradicts','refused'].map(kind => {"
        "const line = document.createElementNS('http://www.w3.org/2000/svg', 'line');"
        "line.setAttribute('class', 'edge ' + kind);"
        "document.querySelector('svg').append(line);"
        "const dash = getComputedStyle(line).strokeDasharray; line.remove(); return [kind, dash]}))"
    )
    assert len(set(dashes.values())) == 3


def test_a_report_prints_on_paper_without_its_scripts(reports: dict[str, Path], tab: Tab) -> None:
    tab.page.goto(reports["good"].as_uri())
    tab.page.emulate_media(media="print")
    assert tab.page.locator("#scene-3d").is_hidden(), "the interactive figure is not printed"
    assert tab.page.get_by_text("From above").is_visible()
    file = tab.page.pdf(format="A4")
    assert file.startswith(b"%PDF")
    image = cv2.imdecode(np.frombuffer(tab.shot("report-print", full_page=True), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert 0.005 < float((image < 128).mean()) < 0.5


def test_the_page_forbids_network_access(reports: dict[str, Path], chromium: Any) -> None:
    tab = Tab(chromium)
    try:
        tab.page.goto(reports["good"].as_uri())
        outcome = tab.page.evaluate("fetch('https://example.org/').then(() => 'sent', () => 'refused')")
        assert outcome == "refused"
        assert any("Content Security Policy" in text for text in tab.errors)
    finally:
        tab.context.close()
