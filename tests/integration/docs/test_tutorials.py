"""Tutorials whose code is executed as it stands on the page."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.cli import run
from protocols.session.calibration import read_calibration
from tests.support.board_session import board_world, render_videos
from tests.support.videos import record_scene_videos

DOCS = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file()) / "docs"
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def test_the_notebook_tutorial_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    blocks = PYTHON.findall((DOCS / "tutorials" / "notebook.md").read_text(encoding="utf-8"))
    assert len(blocks) > 8
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, "notebook.md", "exec"), names)
    assert len(names["result"].cameras) == 3
    assert len(names["path"]) > 100
    assert len(names["points"].to_dataframe()) > 100
    for file in ("calibrated/calibration.toml", "calibrated/report.html", "points.csv"):
        assert (tmp_path / file).is_file(), file
    assert "cam0" in capsys.readouterr().out


def run_commands_of(page: str) -> None:
    """Run every command in a tutorial's blocks, three at most."""
    text = (DOCS / "tutorials" / page).read_text(encoding="utf-8")
    commands = [shlex.split(line) for line in re.findall(r"^\$ syncline (.*)$", text, re.MULTILINE)]
    assert 0 < len(commands) <= 3
    for words in commands:
        assert run(words) == 0


def test_the_tutorial_on_boards_runs_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    render_videos(board_world(5, (10.0, 12.0), lag=1.0, squares=(8, 6), size=0.1), tmp_path / "videos", 4.0, scale=0.6)
    page = (DOCS / "tutorials" / "board.md").read_text(encoding="utf-8")
    (board,) = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "videos" / "board.toml").write_text(board)
    run_commands_of("board.md")
    rig, cameras = read_calibration(tmp_path / "out" / "calibration.toml")
    assert (rig.metadata["scale"], len(cameras)) == ("metric", 2)


def test_the_tutorial_on_keypoints_runs_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["nose", *(f"{side}_{part}" for part in ("hip", "knee", "ankle") for side in ("left", "right"))]
    heights = [-0.7, 0.0, 0.0, 0.43, 0.43, 0.86, 0.86]
    points = {
        n: np.array([0.1 * (i % 2) - 0.05, 0.4 * y, 0.02 * i])
        for i, (n, y) in enumerate(zip(names, heights, strict=True))
    }
    world = replace(board_world(3, (25.0, 25.0, 25.0)), points=points)
    body_25 = [
        "nose",
        *["."] * 8,
        *(f"{side}_{part}" for side in ("right", "left") for part in ("hip", "knee", "ankle")),
    ]
    for name, frame, _, pixels in world.views(10.0, 1):
        seen = dict(zip(points, pixels, strict=True))
        values = [[*seen[part], 0.9] if part in seen else [0.0, 0.0, 0.0] for part in [*body_25, *["."] * 10]]
        folder = tmp_path / "pose" / f"{name}_json"
        folder.mkdir(parents=True, exist_ok=True)
        document = {"people": [{"pose_keypoints_2d": np.ravel(values).tolist()}]}
        (folder / f"{name}_{frame:06d}.json").write_text(json.dumps(document))
    run_commands_of("keypoints.md")
    assert (tmp_path / "joints.trc").read_text().startswith("PathFileType")


def test_the_tutorial_on_two_phones_runs_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    record_scene_videos(tmp_path / "videos", 6.0, 2, 4)
    (tmp_path / "videos" / "rig.toml").unlink(missing_ok=True)
    run_commands_of("two-phones.md")
    assert {"cam0.csv", "cam1.csv", "cam0.mp4"} <= {file.name for file in (tmp_path / "synced").iterdir()}
