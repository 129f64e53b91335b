"""Networks in folders of videos and in messages: the same numbers in the session and on the bus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from deploy.offline import video_folder
from deploy.offline.video_folder import session_from_videos
from edge.agents.camera import detection_message
from edge.detectors.plugins import load_detector
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import read_detections
from protocols.validation.rules import SCHEMA_VERSION, check
from tests.support.command_line import refusal
from tests.support.networks import constant_model, write_network
from tests.support.videos import write_video

pytest.importorskip("onnxruntime", reason="the extra `onnx` is not installed")

BLACK = np.zeros((96, 128, 3), np.uint8)  # twice the network's input
ONE = [[15.0, 9.0, 25.0, 39.0, 0.9, 0.0]]
TWO = [*ONE, [45.0, 9.0, 55.0, 39.0, 0.8, 0.0]]


def network(folder: Path, boxes: list[list[float]]) -> Path:
    folder.mkdir(exist_ok=True)
    return write_network(folder, constant_model({"o": [boxes]}), 'layout = "end2end"')


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    folder.mkdir()
    for index, camera in enumerate(("a", "b")):
        write_video(folder / f"{camera}.mp4", [BLACK + index] * 5, np.arange(5) / 10)
    return folder


def test_a_folder_of_videos_is_a_session_until_the_network_changes(videos: Path, tmp_path: Path) -> None:
    file = network(tmp_path / "net", ONE)
    made = session_from_videos(videos, tmp_path / "session", detector=str(file))
    assert made.summaries == ("a.mp4: target in 5 of 5 frames", "b.mp4: target in 5 of 5 frames")
    assert list(made.observations.tracks) == [("a", "person"), ("b", "person")]
    rows = read_detections(tmp_path / "session" / "observations.csv", {"a": (128, 96), "b": (128, 96)})
    assert rows.box[0].tolist() == pytest.approx([30.0, 18.0, 20.0, 60.0], abs=1e-3)
    assert rows.size.tolist() == pytest.approx([60.0] * 10, abs=1e-3)
    again = session_from_videos(videos, tmp_path / "session", detector=str(file))
    assert all("kept from before" in line for line in again.summaries)
    network(tmp_path / "net", TWO)
    changed = session_from_videos(videos, tmp_path / "session", detector=str(file))
    assert not changed.observations.tracks  # two people, and who is who in two videos is not known
    assert {len(message.detections) for message in changed.people} == {2}


def test_another_version_of_a_detector_detects_again(
    videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = str(network(tmp_path / "net", ONE))
    source = tmp_path / "program" / "base.py"
    source.parent.mkdir()
    monkeypatch.setattr(video_folder.detector_base, "__file__", str(source))
    for text, kept in (("a = 1", False), ("a = 1", True), ("a = 2", False)):
        source.write_text(text)
        video_folder._program.cache_clear()
        made = session_from_videos(videos, tmp_path / "session", detector=file)
        assert ["kept from before" in line for line in made.summaries] == [kept, kept]
    video_folder._program.cache_clear()


def test_calibrate_refuses_what_is_no_detector(
    videos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, message in (
        ("yolo", "there is no detector 'yolo'; use one of charuco, chessboard, tag"),
        ("yolo.onnx", "there is no detector 'yolo.onnx'; give the .toml file that describes the network"),
        (str(tmp_path / "none.toml"), "this network's file does not exist"),
    ):
        assert message in refusal(
            capsys, ["calibrate", str(videos), "--detector", name, "--out", str(tmp_path / "out")]
        )


def test_a_camera_whose_file_names_no_detector_is_told_all_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cam0.toml").write_text('id = "cam0"\ndriver = "simulated"\ndetector = "ball"\n')
    assert "'ball'; use one of marker, person, vehicle, or a network's" in refusal(
        capsys, ["camera", str(tmp_path / "cam0.toml")]
    )


def test_what_a_network_detects_is_a_valid_message_and_matches_predictions(tmp_path: Path) -> None:
    from edge.detectors.base import Prediction

    detector = load_detector(network(tmp_path / "net", TWO), prefix="cam1-")
    here = Prediction(39.5, 40.0, (4.0, 0.0, 4.0), "target-7", size=60.0)
    found = detector.detect(BLACK, 0.5, [here])
    assert [one.target for one in found] == ["target-7", ""]
    message = pb.Observation(
        schema_version=SCHEMA_VERSION, camera="cam1", boot_id="b", detections=[detection_message(one) for one in found]
    )
    check(message)
    person = message.detections[0]
    assert (person.kind, person.label, len(person.head), len(person.foot)) == ("person", "cam1-p0", 2, 2)
    assert (person.colour.red, len(person.covariance), len(person.box)) == (0, 3, 4)


def test_advice_names_the_person_that_a_network_detects(
    videos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = network(tmp_path / "net", ONE)
    assert run(["calibrate", str(videos), "--detector", str(file), "--out", str(tmp_path / "out")]) == 3
    printed = capsys.readouterr().out
    assert "has seen the person in" in printed
    assert "walk at the" in printed
    assert "marker" not in printed
