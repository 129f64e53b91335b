"""One command over many inputs on a local cluster of processes: the bytes of one machine, failures by name, resumed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from deploy.cluster import make_jobs
from tests.support.videos import record_scene_videos, write_video


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball that moves before three cameras, a picture in which nothing does, and a file that is no video."""
    folder = tmp_path_factory.mktemp("recorded") / "day"
    record_scene_videos(folder, 1.0, 3, seed=4)
    write_video(folder / "empty.mp4", [np.full((120, 160, 3), 90, np.uint8)] * 4, np.arange(4) / 10.0)
    (folder / "broken.mp4").write_text("no video", encoding="utf-8")
    return folder


def test_jobs_on_a_cluster(videos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "seen"
    words = ["detect", "marker", str(videos), "--out", str(out), "--scheduler", "2"]
    assert run(words) == 2, "one of them has failed"
    said = capsys.readouterr()
    assert said.out.strip() == "5 jobs: 3 done, 1 refused, 1 failed"
    assert {line.partition(":")[0] for line in said.err.splitlines()} == {"broken", "empty"}
    for number in range(3):
        alone = tmp_path / f"alone{number}.csv"
        assert run(["detect", "marker", str(videos / f"cam{number}.mp4"), "--out", str(alone)]) == 0
        assert (out / f"cam{number}.csv").read_bytes() == alone.read_bytes()
    capsys.readouterr()
    # Again, with one result taken away: that one and the failed one are done, the others are not touched.
    before = (out / "cam1.csv").stat().st_mtime_ns
    (out / "cam0.csv").unlink()
    assert run(words) == 2
    assert capsys.readouterr().out.strip() == "5 jobs, 3 of them earlier: 3 done, 1 refused, 1 failed"
    assert (out / "cam1.csv").stat().st_mtime_ns == before
    assert (out / "cam0.csv").exists()
    assert set(json.loads((out / "jobs.json").read_text(encoding="utf-8"))) == {
        "broken",
        "cam0",
        "cam1",
        "cam2",
        "empty",
    }


def test_a_list_gives_each_input_options_of_its_own(tmp_path: Path) -> None:
    listed = tmp_path / "flights.txt"
    listed.write_text("a.mp4 --target 1,2,3,4  # the red one\n\n'b c.mp4' --target 5,6,7,8\n", encoding="utf-8")
    jobs, _ = make_jobs(["track", str(listed), "--out=x", "--overlay", "--rig", "{name}.toml", "--scheduler", "h:1"])
    assert jobs[1].words == (
        *("track", "b c.mp4", "--overlay", "--rig", "b c.toml", "--target", "5,6,7,8", "--out", "x/b c"),
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "x"], "neither a folder of inputs nor a list of them"),
        ([], "--scheduler needs the inputs first, and --out"),
        (["--out", "x", "--nonsense", "3"], "--nonsense"),
    ],
)
def test_bad_use_is_one_line(words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listed = tmp_path / ("a.txt" if "--nonsense" in words else "a.mp4")
    listed.write_text("a.mp4\n", encoding="utf-8")
    assert run(["detect", "marker", str(listed), *words, "--scheduler", "2"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_two_inputs_of_one_name_and_no_scheduler_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    listed = tmp_path / "a.txt"
    listed.write_text("a/v.mp4\nb/v.mp4\n", encoding="utf-8")
    assert run(["detect", "marker", str(listed), "--out", str(tmp_path / "o"), "--scheduler", "2"]) == 2
    assert "two inputs are named v" in capsys.readouterr().err
    listed.write_text("a/v.mp4\n", encoding="utf-8")
    words = ["detect", "marker", str(listed), "--out", str(tmp_path / "o"), "--scheduler", "tcp://127.0.0.1"]
    assert run(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "no scheduler at tcp://127.0.0.1" in line
