"""The live page of a scripted site: from an empty scene to a moving track, and what it says when something is wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from tests.browser.conftest import Tab
from tests.browser.scripted_site import scripted_site
from tests.support.samples import eventually

SMALL = (700, 500)  # drawn in software


def test_an_empty_page_says_how_to_start(tab: Tab) -> None:
    with scripted_site(publishing=False) as (_, view):
        tab.page.goto(view.address)
        tab.page.get_by_text("syncline camera camera.toml").first.wait_for()
        tab.page.get_by_text("syncline hub hub.toml").first.wait_for()
        tab.page.wait_for_selector("[data-recording=none]")
        assert tab.page.get_by_role("button", name="Start recording").count() == 0
        tab.shot("empty")


def test_from_waiting_to_lags_and_pictures(tab: Tab) -> None:
    page = tab.page
    with scripted_site() as (site, view):
        site.state = "searching"
        page.goto(view.address)
        page.wait_for_selector("[data-hub=searching]")
        page.wait_for_selector("[data-camera=cam2][data-state=searching]")
        page.get_by_text("s of motion shared with another camera").first.wait_for()
        assert "refused" not in page.inner_text("body"), "the hub has not said so, though its status is"
        page.wait_for_selector("[data-picture=cam0] circle")
        page.wait_for_function("document.querySelector('[data-picture=cam0] img').naturalWidth === 320")
        page.locator("[data-picture=cam2]").get_by_text("sends no pictures").wait_for()
        tab.shot("searching")

        site.state, site.reasons = "calibrated", {"cam2": "its motion is too slow"}
        page.wait_for_selector("[data-camera=cam0][data-state=calibrated]")
        page.wait_for_function("document.querySelector('[data-lag=cam1]')?.dataset.revisions > 3")
        assert "ms" in page.inner_text("[data-lag=cam1]")
        assert page.locator(".lags svg .band").count() == 2, "of each camera but the reference"
        assert page.locator(".lags svg .rms").count() == 3
        site.state = "refused"
        page.wait_for_selector("[data-hub=refused]")
        assert "its motion is too slow" in page.inner_text("[data-progress=cam2]")


def test_a_track_moves_coasts_and_is_lost(chromium: Any) -> None:
    tab = Tab(chromium, SMALL)
    page = tab.page
    frames: list[Any] = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda payload: frames.append(payload)))
    try:
        with scripted_site() as (site, view):
            site.state, site.reasons, site.track = "calibrated", {}, "confirmed"
            page.goto(view.address)
            page.wait_for_selector("[data-track=marker][data-state=confirmed]")
            head, trail = (view.scene._paths[f"/paths/0{part}"] for part in ("/head", ""))
            places, before = set(), len(frames)
            for _ in range(600):
                page.wait_for_timeout(50)  # meanwhile events of the browser are heard
                places.add(tuple(head.position))
                if len(places) > 30 and len(frames) - before > 30:
                    break
            assert len(places) > 30
            assert len(frames) - before > 30, "the browser is sent what moves"
            assert len(trail.points) > 10
            assert not head.wireframe

            site.track = "coasting"
            page.wait_for_selector("[data-track=marker][data-state=coasting]")
            assert "coasting, unseen for 0.8 s" in page.inner_text("[data-track=marker]")
            assert eventually(lambda: bool(head.wireframe)), "hollow"
            assert "coasting" in view.scene._paths["/paths/0/label"].text
            assert view.scene._paths["/paths/0/head"] is head, "objects are moved, not rebuilt"
            assert view.scene._paths["/paths/0"] is trail
            ends = np.array(trail.points)[:, 1]
            assert np.linalg.norm(ends - head.position, axis=1).min() < 3.0, "the trail ends near the head"
            tab.shot("coasting")

            site.track = "lost"
            page.wait_for_selector("[data-track=marker]", state="detached")
            assert eventually(lambda: "/paths/0/head" not in view.scene._paths)
        tab.errors = [text for text in tab.errors if "WebSocket" not in text]  # the server has ended
        assert tab.errors == []
    finally:
        tab.context.close()


def test_ill_health_and_the_recording_are_said(tab: Tab) -> None:
    page = tab.page
    with scripted_site() as (site, view):
        site.state, site.reasons = "calibrated", {}
        page.goto(view.address)
        page.wait_for_selector("[data-recording=on]")
        stop, start = (page.get_by_role("button", name=f"{word} recording") for word in ("Stop", "Start"))
        stop.wait_for()
        assert start.count() == 0
        site.recording = False
        page.wait_for_selector("[data-recording=off]")
        assert "paused after a.mcap" in page.inner_text("[data-recording=off]")
        start.wait_for()
        stop.wait_for(state="detached")

        assert page.locator("[data-syncline=health]").count() == 0
        site.recorder_state, site.recorder_message = "degraded", "12 messages are missing from the log"
        health = page.locator("[data-syncline=headline] [data-syncline=health]")
        health.get_by_text("recorder: 12 messages are missing").wait_for()
        site.filming = ("cam0", "cam1")
        health.get_by_text("cam2 has sent no frames").wait_for()
        site.filming, site.recorder_state = ("cam0", "cam1", "cam2"), "running"
        health.wait_for(state="detached")


def test_the_page_fits_a_phone(chromium: Any) -> None:
    tab = Tab(chromium, (390, 844))
    try:
        with scripted_site() as (site, view):
            site.state, site.reasons, site.track = "calibrated", {}, "confirmed"
            tab.page.goto(view.address)
            tab.page.wait_for_selector("[data-lag=cam1]")
            tab.page.wait_for_selector("[data-picture=cam0] img")
            wide = tab.page.evaluate(
                "Array.from(document.querySelectorAll('.sl, .lags')).filter(e => e.scrollWidth > e.clientWidth + 1)"
                ".map(e => e.innerText)"
            )
            assert wide == [], "nothing is cut off at the side"
            tab.shot("phone")
    finally:
        tab.context.close()
