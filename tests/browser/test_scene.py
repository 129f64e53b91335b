"""The 3-D scene in a browser: published poses are drawn, a log replays, access needs the token."""

from __future__ import annotations

import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("viser")

from hub.view.player import LogRecording
from hub.view.server import ViewServer, run_replay, run_view
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, PICTURE, TARGET, UAV_INFO
from tests.browser.conftest import Tab
from tests.integration.live.test_view_server import TOKEN, solved
from tests.support.samples import camera_info, eventually, observation, picture, target_state, uav_info
from tests.support.threads import running
from tests.unit.hub.view.test_state import log_of

_BLUE = np.array([190, 110, 30])  # BGR of a camera that is solved


def blue(tab: Tab, name: str) -> tuple[int, np.ndarray[Any, Any]]:
    """Number and mean position of the pixels with the frusta's colour; waits for fade-in."""
    for _ in range(40):
        tab.page.wait_for_timeout(1200)
        count, place = _blue(tab, name)
        if count > 100:
            break
    return count, place


def _blue(tab: Tab, name: str) -> tuple[int, np.ndarray[Any, Any]]:
    image = cv2.imdecode(np.frombuffer(tab.shot(name), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    scene = image[:, :700].astype(np.int64)  # beside the panel
    near = (scene[..., 0] - scene[..., 2] > 60) & (np.abs(scene - _BLUE).max(axis=2) < 70)
    places = np.argwhere(near)
    return len(places), places.mean(axis=0) if len(places) else np.zeros(2)


def test_a_frustum_moves_when_its_camera_has_moved(tab: Tab) -> None:
    network, view = MemoryHub(), ViewServer(port=0)
    with (
        MemoryBus(network) as agents,
        MemoryBus(network) as bus,
        closing(view),
        running(lambda stop: run_view(bus, view, stop), lambda stop: film(agents, stop)),
    ):
        hub = agents.publisher(CALIBRATION, "hub")
        hub.put(solved((0, 0, 0), (2, 0, 0)))
        tab.page.goto(view.address)
        tab.page.wait_for_function("document.querySelectorAll('[data-state=calibrated]').length === 2")
        count, place = blue(tab, "frusta-before")
        assert count > 100, "the frusta are in view"
        hub.put(solved((0, 0, 0), (2, 0.6, 0), revision=2))
        assert eventually(lambda: np.allclose(view.scene._frusta["cam1"].position, [2, 0.6, 0]))
        moved, elsewhere = blue(tab, "frusta-after")
        assert moved > 100
        assert float(np.linalg.norm(elsewhere - place)) > 3.0


def film(agents: MemoryBus, stop: threading.Event) -> None:
    """Two cameras with detections, 20 times a second."""
    publishers = {name: agents.publisher(OBSERVATION, name) for name in ("cam0", "cam1")}
    infos = {name: agents.publisher(CAMERA_INFO, name) for name in publishers}
    index = 0
    while not stop.wait(0.05):
        for name, publisher in publishers.items():
            if index % 20 == 0:
                infos[name].put(camera_info(name))
            publisher.put(observation(name, index))
        index += 1


def test_a_drone_with_the_target_outside_its_image(tab: Tab) -> None:
    """The panel describes it, and the page draws the estimate to the right of the image."""
    network, view = MemoryHub(), ViewServer(port=0)
    good, data = cv2.imencode(".jpg", np.full((240, 320, 3), 128, np.uint8))
    assert good
    with MemoryBus(network) as agents, MemoryBus(network) as bus:
        publishers = {topic: agents.publisher(topic, "drone") for topic in (UAV_INFO, TARGET, PICTURE)}

        def fly(state: str, x: float, sequence: int) -> None:
            target, shown = target_state("drone", sequence), picture("drone")
            target.frame = shown.frame = sequence
            target.state, target.centre[:], target.std_px = state, [x, 240.0], 5.0
            shown.width, shown.height, shown.jpeg = 640, 480, data.tobytes()
            publishers[TARGET].put(target)
            publishers[PICTURE].put(shown)

        with closing(view), running(lambda stop: run_view(bus, view, stop)):
            tab.page.goto(view.address)
            assert eventually(lambda: publishers[PICTURE].wait_matched(0.0)), (
                "images are subscribed to while a browser is open"
            )
            publishers[UAV_INFO].put(uav_info("drone"))
            for number, (state, x) in enumerate((("visible", 100.0), ("coasting", 780.0))):
                fly(state, x, number)
                tab.page.wait_for_selector(f"[data-flight=drone][data-target={state}]")
            assert "right of the picture" in tab.page.inner_text("[data-flight=drone]")
            assert "no picture" not in tab.page.inner_text("[data-flight=drone]")
            tab.page.wait_for_timeout(2500)
            image = cv2.imdecode(np.frombuffer(tab.shot("drone"), dtype=np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            scene = image[200:, :700].astype(np.int64)
            orange = np.argwhere(np.abs(scene - (50, 175, 255)).max(axis=2) < 60)
            grey = np.argwhere(np.abs(scene - 128).max(axis=2) < 8)
            assert len(orange) > 50
            assert len(grey) > 10_000
            assert orange[:, 1].min() > grey[:, 1].max(), "outside, on the right"


def test_without_the_token_the_browser_has_no_access(chromium: Any) -> None:
    view = ViewServer(port=0, token=TOKEN)
    tab = Tab(chromium)
    try:
        answer = tab.page.goto(f"http://127.0.0.1:{view.port}/")
        assert answer is not None
        assert answer.status == 403
        assert "token" in tab.page.inner_text("body")
        tab.page.goto(view.address)
        tab.page.get_by_role("button", name="Recalibrate").wait_for()
        assert view.watched
    finally:
        tab.context.close()
        view.close()


def test_a_log_can_be_moved_along_its_timeline(tab: Tab, tmp_path: Path) -> None:
    views: list[ViewServer] = []

    def serve(player: Any) -> ViewServer:
        views.append(ViewServer(port=0, player=player))
        return views[0]

    with running(lambda stop: run_replay(LogRecording(log_of(tmp_path / "a.mcap")), serve, stop)):
        assert eventually(lambda: bool(views))
        page = tab.page
        page.goto(views[0].address)
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Play").wait_for()
        page.wait_for_selector("[data-state=collecting]")
        guide = page.inner_text("[data-syncline=guide]")
        assert "cam0" in guide, "what to do next, while it is not solved"
        assert "%" in guide, "with how much of its view has seen the target"
        time = page.get_by_role("textbox").first
        time.fill("30")
        time.press("Enter")
        page.wait_for_selector("[data-state=calibrated]")
        tab.shot("replay")
        time.fill("1")
        time.press("Enter")
        page.wait_for_selector("[data-state=collecting]")
        assert page.get_by_role("button", name="Recalibrate").count() == 0, "a recording accepts no commands"
