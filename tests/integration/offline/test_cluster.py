"""One command over many inputs on a local cluster of processes: the bytes of one machine, failures by name, resumed."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import distributed
import numpy as np
import pytest

from deploy.cli import run
from deploy.cluster import make_jobs
from tests.support.crowds import boxes_csv, truth_csv, write_calibration
from tests.support.samples import eventually
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


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """The address of a cluster of one worker process, which is started again where it ends."""
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster:
        yield cluster.scheduler_address


def test_follow_and_track_give_the_bytes_of_one_machine(scheduler: str, tmp_path: Path) -> None:
    offsets = {"left": 0.0, "right": 12.5, "back": -3.25}
    session, listed = tmp_path / "yard" / "monday", tmp_path / "cars.txt"
    session.mkdir(parents=True)
    (session / "boxes.csv").write_text(boxes_csv(3.0, 5.0, offsets), encoding="utf-8")
    (session / "truth.csv").write_text(truth_csv(3.0, 5.0), encoding="utf-8")
    write_calibration(tmp_path / "calibration.toml", offsets=offsets)
    rng = np.random.default_rng(3)
    ground = rng.integers(60, 200, (120, 160, 3), dtype=np.uint8)
    frames = [ground.copy() for _ in range(12)]
    for number, image in enumerate(frames):
        image[50:66, 20 + 4 * number : 56 + 4 * number] = (40, 40, 210)
    write_video(tmp_path / "car.mp4", frames, np.arange(12) / 25.0)
    listed.write_text(f"{tmp_path / 'car.mp4'} --target 20,50,36,16\n", encoding="utf-8")
    follow = ["--calibration", str(tmp_path / "calibration.toml")]
    for command, together, alone, file in (
        ("follow", [str(session.parent), *follow], [str(session), *follow], "monday/tracks.csv"),
        ("track", [str(listed)], [str(tmp_path / "car.mp4"), "--target", "20,50,36,16"], "car/track.csv"),
    ):
        out, own = tmp_path / command, tmp_path / f"{command}-alone"
        assert run([command, *together, "--out", str(out), "--scheduler", scheduler]) == 0
        assert run([command, *alone, "--out", str(own)]) == 0
        assert (out / file).read_bytes() == (own / Path(file).name).read_bytes()


def test_the_job_of_a_lost_worker_is_done_by_another(videos: Path, scheduler: str, tmp_path: Path) -> None:
    listed, killed = tmp_path / "one.txt", list[int]()
    listed.write_text(f"{videos / 'cam0.mp4'}\n", encoding="utf-8")

    def kill_the_worker() -> None:
        with distributed.Client(scheduler) as client:
            (process,) = client.run(os.getpid).values()
            if eventually(lambda: any(client.processing().values()), 30.0):
                killed.append(process)
                os.kill(process, signal.SIGKILL)

    killer = threading.Thread(target=kill_the_worker)
    killer.start()
    out = tmp_path / "seen"
    assert run(["detect", "marker", str(listed), "--out", str(out), "--scheduler", scheduler]) == 0
    killer.join(60.0)
    assert killed, "the job ended before its worker could be killed"
    alone = tmp_path / "alone.csv"
    assert run(["detect", "marker", str(videos / "cam0.mp4"), "--out", str(alone)]) == 0
    assert (out / "cam0.csv").read_bytes() == alone.read_bytes()


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
