"""From a folder of videos to 3-D: detect, calibrate, sync and triangulate, each through the command line."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w

from deploy.cli import run
from deploy.offline.video_folder import list_videos
from edge.devices.playback.video_reader import VideoReader
from edge.offline.detections import HEADER
from edge.scenes.marker.scene import MarkerScene
from protocols.core.acceptance import PairReport
from protocols.core.errors import InputError, Refused
from protocols.geometry.types import Floats
from tests.support.sounds import add_sound, heard, sound_events
from tests.support.videos import Image, numbered_image, read_number, record_scene_videos, write_video

Capture = pytest.CaptureFixture[str]


@dataclass(frozen=True)
class RecordedVideos:
    """Two videos of a waved marker, their ground truth, and the result of `calibrate`."""

    folder: Path
    out: Path
    scene: MarkerScene
    times: dict[str, Floats]
    printed: str

    def true_time(self, camera: str, video_time: Floats) -> Floats:
        """True time [s] of a time on a video's clock."""
        return np.asarray(self.times[camera][0] + video_time / self.scene.camera(camera).clock.rate)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedVideos:
    folder = tmp_path_factory.mktemp("folders")
    scene, times = record_scene_videos(folder / "videos", 6.0, 2, 4)
    # Other files in such a folder: a copy, a file that is no video, a video of something else.
    shutil.copy(folder / "videos" / "cam0.mp4", folder / "videos" / "copy of cam0.mp4")
    (folder / "videos" / "broken.mp4").write_text("no video")
    write_video(folder / "videos" / "wall.mp4", [numbered_image(i) for i in range(20)], np.arange(20) / 20)
    arguments = ["calibrate", str(folder / "videos"), "--out", str(folder / "out"), "--json"]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert run(arguments) == 0
    return RecordedVideos(folder / "videos", folder / "out", scene, times, printed.getvalue())


def toml(file: Path) -> dict[str, Any]:
    return tomllib.loads(file.read_text())


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_a_folder_of_videos_is_calibrated_to_the_true_clocks(recorded: RecordedVideos) -> None:
    found = toml(recorded.out / "calibration.toml")
    for name in ("cam0", "cam1"):
        own = 2.5
        reference = found[name]["clock_rate"] * own + found[name]["time_offset"]
        expected = recorded.true_time(name, np.array(own))
        assert abs(recorded.true_time("cam0", np.array(reference)) - expected) < 5e-4


def test_warnings_name_the_videos_that_cannot_be_used(recorded: RecordedVideos) -> None:
    result = json.loads(recorded.printed)
    warnings = "\n".join(result["warnings"])
    assert "copy of cam0.mp4 is the same video as cam0.mp4" in warnings
    assert "broken.mp4: no frame can be read" in warnings
    assert "wall.mp4: no ball" in warnings
    assert toml(recorded.out / "calibration.toml")["metadata"]["refused"]["wall"] == "no observations"


@pytest.mark.parametrize("names", [("GH010042", "GH020042"), ("GOPR0042", "GP010042")])
def test_chapters_of_one_recording_are_no_cameras(names: tuple[str, str], tmp_path: Path) -> None:
    """Each was taken for a camera, and of the longest recordings most was left out for want of a common time."""
    for name in ("GH010041", "GX010042", *names):
        (tmp_path / f"{name}.MP4").write_bytes(name.encode())
    with pytest.raises(InputError, match=f"{names[0]}.MP4 and {names[1]}.MP4 are chapters of one recording; join"):
        list_videos(tmp_path)
    (tmp_path / f"{names[1]}.MP4").unlink()
    assert len(list_videos(tmp_path)[0]) == len(list(tmp_path.iterdir()))


def test_detections_of_unchanged_videos_are_reused(recorded: RecordedVideos, tmp_path: Path, capsys: Capture) -> None:
    folder, out = tmp_path / "videos", tmp_path / "out"
    shutil.copytree(recorded.folder, folder)
    shutil.copytree(recorded.out, out)
    (folder / "broken.mp4").unlink()
    (folder / "copy of cam0.mp4").unlink()
    os.utime(folder / "wall.mp4", (1e9, 1e9))
    before = (out / "session" / "observations.csv").read_bytes()
    assert run(["calibrate", str(folder), "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert next(line for line in lines if "cam0.mp4" in line).endswith("(kept from before)")
    assert next(line for line in lines if "wall.mp4" in line).endswith("0 of 20 frames")
    assert (out / "session" / "observations.csv").read_bytes() == before


def test_the_stored_session_can_be_calibrated_again(recorded: RecordedVideos, tmp_path: Path) -> None:
    assert run(["calibrate", str(recorded.out / "session"), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "trajectory.csv").read_bytes() == (recorded.out / "trajectory.csv").read_bytes()


@pytest.fixture(scope="module")
def without_lenses(recorded: RecordedVideos, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """The two videos without rig.toml, the output of `calibrate` and what it said on both streams."""
    folder = tmp_path_factory.mktemp("without_lenses") / "videos"
    folder.mkdir()
    for name in ("cam0", "cam1"):
        shutil.copy2(recorded.folder / f"{name}.mp4", folder)
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        assert run(["calibrate", str(folder), "--out", str(folder.parent / "out")]) == 3
    return folder, folder.parent / "out", said.getvalue()


def test_without_intrinsics_only_the_timing_is_estimated_and_the_rest_refused(
    recorded: RecordedVideos, without_lenses: tuple[Path, Path, str]
) -> None:
    _, out, said = without_lenses
    assert "no intrinsics" in said
    assert "timing of cam0–cam1: lag" in said
    result = json.loads((out / "result.json").read_text())
    (pair,) = result["pairs"]
    assert abs(pair["lag_s"] - (recorded.times["cam1"][0] - recorded.times["cam0"][0])) < 5e-3
    assert all("syncline intrinsics" in reason for reason in result["metadata"]["refused"].values())
    assert not (out / "calibration.toml").exists()


def test_intrinsics_for_another_image_size_are_ignored_with_a_warning(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    for k, name in enumerate(("a", "b")):
        write_video(folder / f"{name}.mp4", [numbered_image(i + 9 * k) for i in range(10)], np.arange(10) / 20)
    lens = {"matrix": [[100, 0, 15], [0, 100, 79], [0, 0, 1]], "size": [32, 160]}
    (folder / "rig.toml").write_text(tomli_w.dumps({"a": {"name": "a", **lens}, "metadata": {"units": "cm"}}))
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out"), "--json"]) == 3
    warnings = "\n".join(json.loads(capsys.readouterr().out)["warnings"])
    assert "a.mp4 is 160x32, its lens in rig.toml is for 32x160 (portrait and landscape mixed?)" in warnings
    rig = toml(tmp_path / "out" / "session" / "rig.toml")
    assert rig["a"]["size"] == [160, 32]
    assert "matrix" not in rig["a"]
    assert rig["metadata"] == {"units": "cm"}
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 3
    assert "warning: a.mp4 is 160x32" in capsys.readouterr().out  # also without --json


def test_an_empty_folder_is_refused_with_what_belongs_in_it(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "videos").mkdir()
    assert run(["calibrate", str(tmp_path / "videos"), "--out", str(tmp_path / "out")]) == 2
    assert "neither videos nor a session" in capsys.readouterr().err


def test_a_single_video_is_refused_at_once(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "videos").mkdir()
    write_video(tmp_path / "videos" / "a.mp4", [numbered_image(0)] * 3, np.arange(3) / 20)
    assert run(["calibrate", str(tmp_path / "videos"), "--out", str(tmp_path / "out")]) == 2
    assert "a.mp4" in capsys.readouterr().err
    shutil.copy(tmp_path / "videos" / "a.mp4", tmp_path / "videos" / "b.mp4")
    assert run(["calibrate", str(tmp_path / "videos"), "--out", str(tmp_path / "out")]) == 2
    assert "b.mp4 is the same video as a.mp4" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_no_marker_in_any_video_is_refused_with_a_result(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "videos").mkdir()
    for k, name in enumerate(("a", "b")):
        write_video(
            tmp_path / "videos" / f"{name}.mp4", [numbered_image(i + 9 * k) for i in range(10)], np.arange(10) / 20
        )
    assert run(["calibrate", str(tmp_path / "videos"), "--out", str(tmp_path / "out")]) == 3
    message = capsys.readouterr().err
    assert "tried: ArUco and AprilTag tags of all dictionaries" in message
    assert all(name in message for name in ("chessboards", "ball", "light", "person", "vehicle"))
    assert json.loads((tmp_path / "out" / "result.json").read_text())["status"] == "refused"


def test_videos_in_which_nothing_changes_are_refused_whatever_colours_they_show(
    tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "videos").mkdir()
    rng = np.random.default_rng(2)
    for name in ("a", "b"):
        scene = np.kron(rng.integers(0, 255, (6, 8, 3)), np.ones((20, 20, 1)))
        images = [np.clip(scene + rng.normal(0.0, 3.0, scene.shape), 0, 255).astype(np.uint8) for _ in range(20)]
        write_video(tmp_path / "videos" / f"{name}.mp4", images, np.arange(20) / 20)
    assert run(["calibrate", str(tmp_path / "videos"), "--out", str(tmp_path / "out")]) == 3
    assert "tried: what changes between some frames" in capsys.readouterr().err


def test_detections_of_a_video_carry_its_frame_times_and_lie_on_the_ball(
    recorded: RecordedVideos, tmp_path: Path
) -> None:
    out = tmp_path / "observations.csv"
    assert run(["detect", "marker", str(recorded.folder / "cam1.mp4"), "--camera", "left", "--out", str(out)]) == 0
    table = rows(out)
    assert list(table[0]) == HEADER.split(",")
    assert (table[0]["kind"], table[0]["head_u"]) == ("marker", "")
    assert all(float(row["cov_uu"]) > 0.0 for row in table)
    assert {row["camera"] for row in table} == {"left"}
    times = recorded.times["cam1"]
    frames = [int(row["frame"]) for row in table]
    assert len(frames) > 0.9 * len(times)
    stamps = np.array([float(row["time"]) for row in table])
    np.testing.assert_allclose(recorded.true_time("cam1", stamps), times[frames], atol=2e-5)
    seen, _ = recorded.scene.seen_by("cam1", times[frames])
    errors = np.linalg.norm(np.array([[float(row["u"]), float(row["v"])] for row in table]) - seen, axis=1)
    assert np.median(errors) < 0.3


def test_a_learnt_marker_is_detected_where_the_default_one_is_not(tmp_path: Path, capsys: Capture) -> None:
    noise = np.random.default_rng(3)
    pictures: list[Image] = []
    for i in range(12):
        picture = noise.normal(110, 8, (120, 160, 3))
        disc = np.hypot(*(np.mgrid[:120, :160] - np.array([60, 40 + 5 * i])[:, None, None])) < 12
        picture[disc] += [110, -20, -90]
        pictures.append(cv2.GaussianBlur(np.clip(picture, 0, 255).astype(np.uint8), (3, 3), 0))  # type: ignore[arg-type]
    video, out = tmp_path / "blue.mp4", tmp_path / "out.csv"
    write_video(video, pictures, np.arange(12) / 10)
    assert run(["detect", "marker", str(video), "--out", str(out)]) == 3
    assert not out.exists()
    assert "--teach" in capsys.readouterr().err
    taught = ["--teach", "--target", "71,46,28,28", "--start", "9"]
    assert run(["detect", "marker", str(video), "--out", str(out), *taught]) == 0
    by_frame = {int(row["frame"]): float(row["u"]) for row in rows(out)}
    assert len(by_frame) >= 10
    assert all(abs(u - (40 + 5 * i)) < 0.5 for i, u in by_frame.items())
    again = tmp_path / "again.csv"
    assert run(["detect", "marker", str(video), "--out", str(again), "--marker", str(tmp_path / "marker.toml")]) == 0
    assert again.read_bytes() == out.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["detect", "marker", "VIDEO", "--teach"], "--target"),
        (["detect", "marker", "VIDEO", "--colour", "1,2"], "--colour"),
        (["detect", "marker", "nowhere.mp4"], "nowhere.mp4"),
        (["detect", "marker", "VIDEO", "--teach", "--target", "1,1,9,9", "--start", "99"], "frame 99"),
    ],
)
def test_wrong_use_of_detect_gives_one_line_of_error(
    tmp_path: Path, capsys: Capture, arguments: list[str], expected: str
) -> None:
    video = tmp_path / "a.mp4"
    write_video(video, [numbered_image(i) for i in range(5)], np.arange(5) / 10)
    words = [str(video) if word == "VIDEO" else word for word in arguments]
    assert run([*words, "--out", str(tmp_path / "out.csv")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert expected in line
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize("options", [["--out", "VIDEO"], ["--out", "OUT", "--overlay", "VIDEO"]])
def test_detect_does_not_overwrite_its_video(tmp_path: Path, capsys: Capture, options: list[str]) -> None:
    video = tmp_path / "a.mp4"
    write_video(video, [numbered_image(i) for i in range(5)], np.arange(5) / 10)
    before = video.read_bytes()
    words = [{"VIDEO": str(video), "OUT": str(tmp_path / "out.csv")}.get(word, word) for word in options]
    assert run(["detect", "marker", str(video), *words]) == 2
    assert "a.mp4: this file is read, and would be lost" in capsys.readouterr().err
    assert video.read_bytes() == before


# Numbered videos on two clocks: reference = 1.0 t for a, 1.0001 t + 0.25 for b.
MAPS = {"a": (1.0, 0.0), "b": (1.0001, 0.25)}


def numbered_videos(folder: Path, offset: float = 0.25) -> tuple[Path, dict[str, Floats]]:
    """Two videos of irregular frames that carry their numbers; the calibration and true reference times."""
    folder.mkdir()
    rng = np.random.default_rng(1)
    references, tables = {}, {}
    for name, period in (("a", 1 / 30), ("b", 1 / 50)):
        rate, start = MAPS[name][0], offset if name == "b" else 0.0
        times = np.cumsum(np.r_[0.0, rng.uniform(0.6, 1.4, 59) * period])
        write_video(folder / f"{name}.mp4", [numbered_image(i) for i in range(60)], times)
        references[name] = rate * np.round(times * 90_000) / 90_000 + start
        lens = {"matrix": [[100, 0, 80], [0, 100, 16], [0, 0, 1]], "rotation": [0, 0, 0], "translation": [0, 0, 0]}
        tables[name] = {"name": name, "size": [160, 32], "clock_rate": rate, "time_offset": start, **lens}
    tables["metadata"] = {"reference": "a"}
    file = folder.parent / "calibration.toml"
    file.write_text(tomli_w.dumps(tables))
    return file, references


def test_resampled_videos_show_the_frames_nearest_in_time(tmp_path: Path) -> None:
    calibration, references = numbered_videos(tmp_path / "videos")
    out = tmp_path / "out"
    arguments = ["sync", str(tmp_path / "videos"), "--calibration", str(calibration), "--out", str(out)]
    assert run([*arguments, "--fps", "40"]) == 0
    table = rows(out / "synchronised.csv")
    begin = max(times[0] for times in references.values())
    end = min(times[-1] for times in references.values())
    grid = np.array([float(row["reference_time"]) for row in table])
    np.testing.assert_allclose(np.diff(grid), 1 / 40, atol=1e-9)
    assert begin <= grid[0] < begin + 1 / 40
    assert end - 1 / 40 < grid[-1] <= end
    for name, times in references.items():
        shots = list(VideoReader(out / f"{name}.mp4"))
        np.testing.assert_allclose([shot.time for shot in shots], grid - grid[0], atol=1e-5)
        shown = np.array([read_number(shot.image()) for shot in shots])
        assert [int(row[name]) for row in table] == shown.tolist()
        best = np.abs(times[:, None] - grid).min(axis=0)
        np.testing.assert_allclose(np.abs(times[shown] - grid), best, atol=1e-9)
        each = np.loadtxt(out / f"{name}.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(each[:, 2], times, atol=1e-6)


def test_trimmed_videos_hold_every_frame_of_the_common_span_once_at_its_time(tmp_path: Path) -> None:
    calibration, references = numbered_videos(tmp_path / "videos")
    out = tmp_path / "out"
    arguments = ["sync", str(tmp_path / "videos"), "--calibration", str(calibration), "--out", str(out)]
    assert run([*arguments, "--videos", "trim"]) == 0
    begin = max(times[0] for times in references.values())
    end = min(times[-1] for times in references.values())
    for name, times in references.items():
        inside = np.flatnonzero((times >= begin - 1e-6) & (times <= end + 1e-6))
        assert len(inside) > 20
        shots = list(VideoReader(out / f"{name}.mp4"))
        assert [read_number(shot.image()) for shot in shots] == inside.tolist()
        np.testing.assert_allclose([shot.time for shot in shots], times[inside] - begin, atol=2e-5)


def test_videos_without_a_common_time_are_refused_and_nothing_is_written(tmp_path: Path, capsys: Capture) -> None:
    calibration, _ = numbered_videos(tmp_path / "videos", offset=1000.0)
    out = tmp_path / "out"
    assert run(["sync", str(tmp_path / "videos"), "--calibration", str(calibration), "--out", str(out)]) == 3
    assert "no time in common" in capsys.readouterr().err
    assert not out.exists()


def test_videos_are_synchronised_triangulated_and_exported_to_every_format(
    recorded: RecordedVideos, tmp_path: Path
) -> None:
    """At one instant the marker has one position, which both resampled videos show."""
    known = str(recorded.out / "calibration.toml")
    out = tmp_path / "sync"
    assert run(["sync", str(recorded.folder), "--calibration", known, "--out", str(out), "--fps", "12.5"]) == 0
    table = rows(out / "synchronised.csv")
    apart = [recorded.times["cam0"][int(row["cam0"])] - recorded.times["cam1"][int(row["cam1"])] for row in table]
    assert np.median(np.abs(apart)) < 0.5 / 25
    assert [VideoReader(out / f"cam{i}.mp4").info.frames for i in (0, 1)] == [len(table)] * 2
    track = tmp_path / "track.csv"
    assert run(["triangulate", str(recorded.out / "session"), "--calibration", known, "--out", str(track)]) == 0
    again, before = (
        np.genfromtxt(file, delimiter=",", skip_header=1, usecols=range(5))
        for file in (track, recorded.out / "trajectory.csv")
    )
    shared, here, there = np.intersect1d(again[:, 0].round(6), before[:, 0].round(6), return_indices=True)
    assert len(shared) > 0.9 * len(before)
    assert np.median(np.abs(again[here, 1:4] - before[there, 1:4])) < 1e-3
    names = {"aniposelib": "a.toml", "caliscope": "c.toml", "pose2sim": "p.toml", "freemocap": "f.toml"}
    names |= {"kalibr": "k.yaml", "opencv": "yml", "colmap": "model"}
    for to, name in names.items():
        assert run(["export", known, "--to", to, "--out", str(tmp_path / name)]) == 0
        assert run(["import", str(tmp_path / name), "--out", str(tmp_path / f"{to}.toml")]) == 0
        back = toml(tmp_path / f"{to}.toml")
        for camera in ("cam0", "cam1"):
            matrix = toml(Path(known))[camera]["matrix"]
            np.testing.assert_allclose(back[camera]["matrix"], matrix, rtol=1e-12, atol=1e-9)
    assert run(["export", str(track), "--to", "trc", "--out", str(tmp_path / "track.trc")]) == 0
    assert len((tmp_path / "track.trc").read_text().splitlines()) > len(again)


def test_a_video_that_cannot_be_read_is_left_out_of_the_synchronised_ones_with_a_word(
    recorded: RecordedVideos, tmp_path: Path, capsys: Capture
) -> None:
    shutil.copytree(recorded.folder, tmp_path / "videos")
    (tmp_path / "videos" / "cam0.mp4").write_bytes((recorded.folder / "cam0.mp4").read_bytes()[:3000])
    arguments = ["sync", str(tmp_path / "videos"), "--calibration", str(recorded.out / "calibration.toml")]
    assert run([*arguments, "--videos", "none", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "warning: cam0.mp4: no frame can be read from this file" in printed
    assert "warning: wall.mp4: no observations; left out" in printed  # why the calibration refused it


def test_nothing_of_an_earlier_run_is_left_among_the_tables_of_synchronised_videos(
    recorded: RecordedVideos, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "videos").mkdir()
    shutil.copy(recorded.folder / "cam0.mp4", tmp_path / "videos")
    out, known = tmp_path / "out", ["--calibration", str(recorded.out / "calibration.toml")]
    assert run(["sync", str(recorded.folder), *known, "--out", str(out)]) == 0
    (out / "notes.csv").write_text("my own\n")
    capsys.readouterr()
    assert run(["sync", str(tmp_path / "videos"), *known, "--videos", "trim", "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["cam0.csv", "cam0.mp4", "cam1.mp4", "notes.csv"]
    assert f"warning: {out / 'cam1.mp4'} is of an earlier run" in capsys.readouterr().out


def test_nothing_in_a_video_that_is_cut_off_says_that_it_is(tmp_path: Path, capsys: Capture) -> None:
    write_video(tmp_path / "a.mkv", [numbered_image(i) for i in range(80)], np.arange(80) / 10)
    content = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "a.mkv").write_bytes(content[: len(content) // 2])
    assert run(["detect", "marker", str(tmp_path / "a.mkv"), "--out", str(tmp_path / "a.csv")]) == 3
    assert "its container says 7.9 s: the file seems to be cut off; use a brightly" in capsys.readouterr().err


def test_two_cameras_without_lenses_are_synchronised_by_timing_alone(
    recorded: RecordedVideos, without_lenses: tuple[Path, Path, str], tmp_path: Path, capsys: Capture
) -> None:
    folder, out, _ = without_lenses
    arguments = ["sync", str(folder), "--videos", "none", "--json"]
    assert run([*arguments, "--calibration", str(out / "result.json"), "--out", str(tmp_path / "sync")]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["reference"] == "cam0"
    assert 0.0 < report["time_offset_std"]["cam1"] < 0.002
    shutil.copytree(out / "session", tmp_path / "again" / "session")  # what `calibrate` detected
    assert run([*arguments, "--out", str(tmp_path / "again")]) == 0  # without a calibration: it is made
    with_poses = toml(recorded.out / "calibration.toml")["cam1"]
    for made in ("sync", "again"):
        for row in rows(tmp_path / made / "cam1.csv"):
            expected = with_poses["clock_rate"] * float(row["time"]) + with_poses["time_offset"]
            assert abs(float(row["reference_time"]) - expected) < 0.005


def test_lags_that_are_not_known_are_refused_as_such_and_not_for_want_of_lenses(
    without_lenses: tuple[Path, Path, str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out, _ = without_lenses
    shutil.copytree(out / "session", tmp_path / "sync" / "timing" / "session")

    def refuse(*_: object, **__: object) -> None:
        pairs = (PairReport(("cam0", "cam1"), "two alignments are about as good"),)
        raise Refused("fewer than two cameras can be placed; give their intrinsics", pairs=pairs)

    monkeypatch.setattr("hub.api.calibrate", refuse)
    assert run(["sync", str(folder), "--videos", "none", "--out", str(tmp_path / "sync")]) == 3
    message = capsys.readouterr().err
    assert "the lag of no pair of these videos is known (cam0 and cam1: two alignments are about as good)" in message
    assert "intrinsics" not in message


def test_a_video_whose_lag_is_not_known_is_left_out_for_that_and_not_for_want_of_a_lens(
    without_lenses: tuple[Path, Path, str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a phone that was held by hand it said to run `syncline intrinsics`."""
    folder, out, _ = without_lenses
    shutil.copytree(out / "session", tmp_path / "sync" / "timing" / "session")
    videos = tmp_path / "videos"
    shutil.copytree(folder, videos)
    write_video(videos / "hand.mp4", [np.full((64, 96, 3), 90, np.uint8)] * 20, np.arange(20) / 10)

    def refuse(*_: object, **__: object) -> None:
        pairs = (PairReport(("cam0", "cam1"), "ok", 0.1, 1.0), PairReport(("cam1", "hand"), "too little agrees"))
        raise Refused("fewer than two cameras", {"hand": "no intrinsics: run `syncline intrinsics`"}, pairs=pairs)

    monkeypatch.setattr("hub.api.calibrate", refuse)
    assert run(["sync", str(videos), "--videos", "none", "--out", str(tmp_path / "sync")]) == 0
    printed = capsys.readouterr().out
    assert "warning: hand.mp4: its lag is not known (with cam1: too little agrees); left out" in printed
    assert "intrinsics" not in printed


def test_videos_in_which_nothing_moves_are_synchronised_by_their_sounds(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    still = np.full((64, 96, 3), 90, np.uint8)
    for name, lag, seed in (("a", 0.0, 1), ("b", 3.7, 2)):
        write_video(tmp_path / "silent.mp4", [still] * 60, np.arange(60) / 3.0)
        sound = heard(sound_events(30.0, 5), lag, np.random.default_rng(seed), 20.0, 0.3)
        add_sound(tmp_path / "silent.mp4", sound, folder / f"{name}.mp4")
    assert run(["sync", str(folder), "--videos", "none", "--out", str(tmp_path / "out")]) == 0
    assert "b: lag +3.7" in capsys.readouterr().out
    for row in rows(tmp_path / "out" / "b.csv"):
        assert float(row["reference_time"]) - float(row["time"]) == pytest.approx(3.7, abs=0.05)


@pytest.mark.parametrize("late", [0.0, 2.0])
def test_lags_of_the_images_are_compared_with_those_of_the_sounds(
    recorded: RecordedVideos, tmp_path: Path, late: float
) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    shutil.copy(recorded.folder / "rig.toml", folder)
    clocks = toml(recorded.out / "calibration.toml")
    seconds = float(recorded.times["cam0"][-1])
    for seed, name in enumerate(("cam0", "cam1")):
        behind = float(clocks[name]["time_offset"]) + late * seed
        sound = heard(sound_events(seconds + 10.0, 5) - [5.0, 0.0], behind, np.random.default_rng(seed), seconds, 0.1)
        add_sound(recorded.folder / f"{name}.mp4", sound, folder / f"{name}.mp4")
    assert run(["calibrate", str(folder), "--detector", "marker", "--out", str(tmp_path / "out")]) == 0
    warnings = json.loads((tmp_path / "out" / "result.json").read_text())["warnings"]
    line = next(text for text in warnings if text.startswith("lags by the images less those by the sound tracks"))
    assert ("more than sound explains" in line) == (late > 0.0)
