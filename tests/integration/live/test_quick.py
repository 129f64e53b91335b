"""`syncline quick` without a page: simulated cameras and videos instead of webcams; marker learned from a click."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.cli import run
from edge import scenes
from edge.detectors.marker.ball import InteractiveMarkerDetector, learn_marker_at
from edge.scenes import renderer_for
from protocols.core.errors import InputError
from tests.support.command_line import refusal
from tests.support.videos import record_scene_videos

pytest.importorskip("viser")


@pytest.fixture(autouse=True)
def _own_signals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deploy.agents.processes.stop_on_signals", threading.Event)


def test_two_videos_are_calibrated_without_any_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, times = record_scene_videos(tmp_path / "films", 8.0, 2, 3)
    sources = [word for name in times for word in ("--source", str(tmp_path / "films" / f"{name}.mp4"))]
    words = ["quick", *sources, "--headless", "--out", str(tmp_path / "out"), "--json"]
    assert run(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["status"] == "solved"
    # Film time 0 is the first frame: what cam1's clock must be set by is known from the true times.
    first, second = (scene_camera.clock.rate for scene_camera in scene.cameras)
    rate = first / second
    camera = document["cameras"]["cam1"]
    middle = float(np.median(times["cam1"]) - times["cam1"][0]) * second
    true = (middle / second + times["cam1"][0] - times["cam0"][0]) * first
    assert abs(camera["clock_rate"] * middle + camera["time_offset"] - true) < 2e-3, "on a guessed lens"
    assert camera["clock_rate"] == pytest.approx(rate, abs=5e-4)
    assert any("a field of view of 65 degrees is assumed" in text for text in document["warnings"])
    assert (tmp_path / "out" / "report.html").stat().st_size < 6 * 1024 * 1024


def test_videos_without_a_marker_are_refused_with_a_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "grey"
    for camera in ("a", "b"):
        (folder / camera).mkdir(parents=True)
        for index in range(5):
            cv2.imwrite(str(folder / camera / f"{index}.png"), np.full((48, 64, 3), 128, np.uint8))
    words = ["quick", "--source", str(folder / "a"), "--source", str(folder / "b"), "--headless"]
    assert run([*words, "--out", str(tmp_path / "out")]) == 3
    captured = capsys.readouterr()
    assert "has not seen the ball yet" in captured.out
    assert captured.err.count("\n") == 1


def picture_of(colour: tuple[int, int, int]) -> np.ndarray:
    """A ball of a colour (BGR) at (60, 40), radius 12, before a textured wall (120, 160, 3)."""
    rng = np.random.default_rng(1)
    image = np.clip(rng.normal(120, 6, (120, 160, 3)), 0, 255).astype(np.uint8)
    cv2.circle(image, (60, 40), 12, colour, -1, cv2.LINE_AA)
    return image


@pytest.mark.parametrize("colour", [(20, 200, 40), (220, 40, 30), (30, 30, 230)])
def test_a_ball_of_any_colour_is_learned_from_one_click(colour: tuple[int, int, int]) -> None:
    image = picture_of(colour)
    detector = InteractiveMarkerDetector()
    model, box = learn_marker_at(image, 63.0, 44.0)
    assert box == pytest.approx((47, 27, 27, 27), abs=3)
    detector.set_model(model)
    (found,) = detector.detect(np.roll(image, 30, axis=1))
    assert (found.u, found.v) == pytest.approx((90.0, 40.0), abs=0.3)


def test_a_click_on_the_wall_or_outside_the_image_is_reported() -> None:
    image = picture_of((20, 200, 40))
    with pytest.raises(InputError, match="as large as a wall"):
        learn_marker_at(image, 140.0, 100.0)
    with pytest.raises(InputError, match="not in the picture"):
        learn_marker_at(image, 500.0, 10.0)


def test_the_ball_of_the_simulated_scene_is_learned_from_a_click() -> None:
    scene = scenes.get_marker_scene("marker", 1, 2)
    rng = np.random.default_rng(0)
    renderer = renderer_for(scene, "cam0", rng)
    for moment in (1.0, 2.0, 3.0):
        image = renderer.render(moment)
        found = InteractiveMarkerDetector().detect(image)
        if found:
            model, _ = learn_marker_at(image, found[0].u, found[0].v)
            again = InteractiveMarkerDetector(model=model).detect(image)
            assert (again[0].u, again[0].v) == pytest.approx((found[0].u, found[0].v), abs=0.5)
            return
    pytest.fail("the ball was in no picture")


@pytest.mark.parametrize(
    ("words", "expected_text"),
    [
        (["--cameras", "0"], "names 1 of at least 2 cameras"),
        (["--cameras", "0,0"], "names a camera twice"),
        (["--cameras", "front,back"], "'front' is no camera"),
        (["--source", "a.mp4", "--source", "b.mp4"], "a.mp4: this video does not exist"),
        (["--target", "1,2"], "is not four"),
        (["--target", "1,2,0,5"], "has no width or height"),
        (["--simulated", "--source", "a.mp4"], "exclude each other"),
        (["--field-of-view", "0"], "is out of range"),
        (["--seconds", "nan"], "is out of range"),
        (["--simulated", "--rig", "rig.toml"], "rig.toml: knows cameras left, none of cam0, cam1"),
    ],
)
def test_bad_use_is_reported_in_one_line(
    words: list[str],
    expected_text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('[left]\nname = "left"\nsize = [640, 480]\n')
    earlier = tmp_path / "quick-out" / "calibration.toml"
    earlier.parent.mkdir()
    earlier.write_text("[cam0]\n")
    assert expected_text in refusal(capsys, ["quick", *words])
    assert earlier.exists(), "a run that did not begin costs no calibration"
