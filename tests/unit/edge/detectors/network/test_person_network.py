"""The small network that the project trains on rendered rooms: people of a room that it has not seen, end to end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from edge import scenes
from edge.detectors.base import Detection
from edge.detectors.plugins import load_detector
from edge.scenes.people.renderer import PeopleRenderer
from edge.scenes.people.scene import PeopleScene
from protocols.geometry.types import Bools, Floats
from protocols.session.observations import read_detections
from tests.support.people_boxes import overlap, score_boxes, truth
from tests.support.videos import Image, write_video

pytest.importorskip("onnxruntime", reason="the extra `onnx` is not installed")

NETWORK = Path(__file__).parents[4] / "support" / "networks" / "person.toml"
TIMES = np.arange(0.0, 24.0, 2.0)


@pytest.fixture(scope="module")
def scene() -> PeopleScene:
    return scenes.get_people_scene(760, 2, 4)


@pytest.fixture(scope="module")
def filmed(scene: PeopleScene) -> list[tuple[Image, tuple[Floats, Bools]]]:
    """Images of a camera and the true boxes in them."""
    name = scene.cameras[0].name
    renderer = PeopleRenderer(scene, name, np.random.default_rng(3), 4.0)
    drawn = [renderer.render_with_owners(float(moment)) for moment in TIMES]
    return [
        (image, truth(scene, name, float(moment), owners)) for moment, (image, owners) in zip(TIMES, drawn, strict=True)
    ]


def score(boxes: Sequence[tuple[Floats, Bools]], found: Sequence[Sequence[Floats]]) -> tuple[float, float]:
    """Precision and recall at an overlap of 0.5."""
    total = [score_boxes(*true, seen) for true, seen in zip(boxes, found, strict=True)]
    right, wrong, missed = (sum(int(one[part]) for one in total) for part in range(3))
    return right / (right + wrong), right / (right + missed)


def test_the_command_finds_the_people_of_a_clip(
    filmed: list[tuple[Image, tuple[Floats, Bools]]], scene: PeopleScene, tmp_path: Path
) -> None:
    video, out = tmp_path / "cam0.mp4", tmp_path / "people.csv"
    write_video(video, [image for image, _ in filmed], TIMES)
    assert run(["detect", "person", str(video), "--detector", str(NETWORK), "--out", str(out)]) == 0
    rows = read_detections(out, {"cam0": (640, 480)})
    found = [rows.box[rows.frame == frame] for frame in range(len(TIMES))]
    precision, recall = score([true for _, true in filmed], [list(boxes) for boxes in found])
    assert precision > 0.9
    assert recall > 0.9
    assert set(rows.kind) == {"person"}
    heads, feet = (scene.seen_by(scene.cameras[0].name, points(TIMES)) for points in (scene.heads, scene.feet))
    errors = []
    for row in np.flatnonzero(np.isfinite(rows.size) & (rows.score > 0.5)):
        moment = int(rows.frame[row])
        boxes = scene.boxes(scene.cameras[0].name, float(TIMES[moment]))
        who = int(np.nanargmax([overlap(box, rows.box[row]) if np.isfinite(box).all() else np.nan for box in boxes]))
        if overlap(boxes[who], rows.box[row]) > 0.6:
            ends = (rows.head[row] - heads[moment, who], rows.foot[row] - feet[moment, who])
            errors.append([np.hypot(*end) / rows.size[row] for end in ends])
    assert len(errors) > 20
    assert (np.median(errors, axis=0) < [0.05, 0.08]).all()


def test_both_runtimes_find_the_same_people(filmed: list[tuple[Image, tuple[Floats, Bools]]], tmp_path: Path) -> None:
    text = NETWORK.read_text().replace('"person.onnx"', f'"{NETWORK.with_name("person.onnx")}"')
    by_backend: list[list[Detection]] = []
    for backend in ("onnxruntime", "opencv"):
        file = tmp_path / f"{backend}.toml"
        file.write_text(f'{text}\nbackend = "{backend}"\n')
        detector = load_detector(file)
        by_backend.append([one for image, _ in filmed[:6] for one in detector.detect(image)])
    first, second = by_backend
    assert len(first) == len(second) > 6
    for one, other in zip(first, second, strict=True):
        assert one.box == pytest.approx(other.box, abs=0.05)
        assert one.score == pytest.approx(other.score, abs=1e-3)
        assert one.foot == (None if other.foot is None else pytest.approx(other.foot, abs=0.05))
