"""`syncline track` as a command: outputs, their format, overlay, scores, and one line on bad input."""

from __future__ import annotations

import csv
import json
import struct
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.cli import run
from deploy.offline import telemetry_files
from deploy.offline.track import TelemetryFile, check_clock, corners_for_a_box, parse_target
from deploy.simulation.flight import write_simulated_flight
from edge.mavlink.dialect import mavlink
from edge.uav.base import Telemetry
from edge.uav.navigation import rotation_from_euler
from edge.uav.timing.ground_motion import RelativeRotations
from protocols.core.errors import InputError
from protocols.core.jpeg import encode_jpeg
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, TELEMETRY, UAV_INFO
from tests.support.samples import flight_image, uav_info
from tests.support.videos import TICKS, write_video

Checked = tuple[tuple[Telemetry, ...], list[str], bool]
SIZE = (320, 240)
FRAMES = 45
TARGET = "92,118,36,16"
_ENU, _FLU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1.0, -1, -1])


def render_frame(
    i: int, background: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
) -> tuple[np.ndarray, tuple[float, float]]:
    """Frame i of a car that moves 6 px a frame to the right and out of view; and its centre."""
    image = background.copy()
    x = 92 + 6 * i
    image[118:134, x : x + 36] = (40, 40, 210)
    image[120:132, x + 22 : x + 27] = (40, 30, 30)
    noise = np.random.default_rng(i).integers(0, 5, (SIZE[1], SIZE[0], 3), np.uint8)
    return image[:240, :320] + noise, (x + 17.5, 125.5)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder: pictures/000.png …, film.mp4, truth.csv, rig.toml, telemetry.csv."""
    folder = tmp_path_factory.mktemp("film")
    (folder / "pictures").mkdir()
    rng = np.random.default_rng(3)
    background = cv2.GaussianBlur(rng.uniform(0, 250, (240, 800, 3)).astype(np.float32), (0, 0), 2.0) * 2.0 - 125.0
    background[100:150] = background[100:150] * 0.2 + 80.0
    flat = np.clip(background, 0, 240).astype(np.uint8)
    writer = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, SIZE)
    truth = ["frame,x,y,width,height,inside"]
    for i in range(FRAMES):
        image, (x, y) = render_frame(i, flat)
        cv2.imwrite(str(folder / "pictures" / f"{i:03d}.png"), image)
        writer.write(image)
        truth.append(f"{i},{x},{y},36,16,{min(max((320 - (x - 18)) / 36, 0), 1)}")
    writer.release()
    (folder / "truth.csv").write_text("\n".join(truth) + "\n")
    (folder / "rig.toml").write_text(
        "[drone]\nname = 'drone'\nsize = [320, 240]\nfps = 20.0\n"
        "matrix = [[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]]\n"
        "body_from_camera = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]\n"
    )
    rows = ["time,qw,qx,qy,qz,north,east,down"] + [f"{k / 10},1,0,0,0,0,0,-30" for k in range(60)]
    rows[20] = "nan,1,0,0,0,0,0,-30"
    (folder / "telemetry.csv").write_text("\n".join(rows) + "\n")
    return folder


def table(file: Path) -> list[dict[str, str]]:
    with file.open() as stream:
        return list(csv.DictReader(stream))


def test_a_folder_of_images_is_tracked_until_out_of_view(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["track", str(recording / "pictures"), "--target", TARGET, "--out", str(tmp_path), "--json"]
    assert run([*arguments, "--csv-truth", str(recording / "truth.csv")]) == 0
    output = json.loads(capsys.readouterr().out)
    header = (tmp_path / "track.csv").read_text().splitlines()[0]
    assert header == "frame,time,state,x,y,width,height,heading,std,basis"
    rows = table(tmp_path / "track.csv")
    assert [int(row["frame"]) for row in rows] == list(range(FRAMES))
    assert float(rows[30]["time"]) == pytest.approx(1.0)
    assert rows[20]["state"] == "visible"
    assert rows[-1]["state"] == "coasting"
    assert float(rows[-1]["x"]) == pytest.approx(92 + 6 * 44 + 17.5, abs=18)
    assert float(rows[-1]["x"]) > 320
    assert len(rows[10]["x"].replace(".", "")) >= 16
    assert (tmp_path / "hypotheses.csv").read_text().splitlines()[0] == "frame,rank,weight,x,y"
    assert output["frames"] == FRAMES
    assert sum(entry["frames"] for entry in output["basis"].values()) == FRAMES
    assert all(entry["reason"] for entry in output["basis"].values())
    assert output["visible"] + output["coasting"] + output["lost"] == FRAMES
    assert output["scores"]["visible_while_out"] == 0.0
    assert output["scores"]["in_frame_20px"] == 1.0
    assert output["scores"]["out_one_length"] == 1.0


def test_telemetry_adds_ground_columns_and_start_selects_the_frame(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    extra = ["--rig", str(recording / "rig.toml"), "--telemetry", str(recording / "telemetry.csv"), "--start", "5"]
    place = ["--target", "122,118,36,16", "--out", str(tmp_path)]
    assert run(["track", str(recording / "pictures"), *place, *extra]) == 0
    assert "1 rows hold no sample" in capsys.readouterr().out
    rows = table(tmp_path / "track.csv")
    assert list(rows[0])[-6:] == ["north", "east", "speed", "course", "std_m", "basis"]
    assert {row["basis"] for row in rows} == {"ground"}
    assert int(rows[0]["frame"]) == 5
    assert float(rows[0]["time"]) == pytest.approx(0.25)  # 20 fps, as rig.toml says
    assert float(rows[20]["speed"]) == pytest.approx(12.0, abs=1.0)
    assert float(rows[20]["course"]) == pytest.approx(np.pi / 2, abs=0.1)


def test_positions_may_come_less_often_than_attitudes_and_times_that_go_back_are_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With every fifth row's position none was used, and it was said that they are in no metres."""
    lines = (recording / "telemetry.csv").read_text().splitlines()
    sparse = [",".join([*line.split(",")[:5], "", "", ""]) if i % 5 else line for i, line in enumerate(lines[1:])]
    (tmp_path / "telemetry.csv").write_text("\n".join([lines[0], *sparse[30:], *sparse[:30]]) + "\n")
    extra = ["--rig", str(recording / "rig.toml"), "--telemetry", str(tmp_path / "telemetry.csv")]
    assert run(["track", str(recording / "pictures"), "--target", TARGET, "--out", str(tmp_path / "out"), *extra]) == 0
    output = capsys.readouterr().out
    assert "positions were used in no frame" not in output
    assert "its times go back 1 times" in output
    assert float(table(tmp_path / "out" / "track.csv")[20]["speed"]) == pytest.approx(12.0, abs=1.0)


@pytest.mark.parametrize("header", ["north,east,height", "lat,lon,alt"])
def test_columns_of_positions_that_are_not_used_are_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], header: str
) -> None:
    text = (recording / "telemetry.csv").read_text().replace("north,east,down", header)
    (tmp_path / "telemetry.csv").write_text(text)
    extra = ["--rig", str(recording / "rig.toml"), "--telemetry", str(tmp_path / "telemetry.csv")]
    assert run(["track", str(recording / "pictures"), "--target", TARGET, "--out", str(tmp_path / "out"), *extra]) == 0
    names = header.removesuffix(",height")
    assert f"its positions are not used, as it has {names} but not north,east,down" in capsys.readouterr().out


@pytest.mark.parametrize(("pictured", "remedy"), [(True, "syncline track"), (False, "record with [images]")])
def test_the_log_of_a_flight_is_no_session_but_can_be_tracked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], pictured: bool, remedy: str
) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write(UAV_INFO, "uav0", "site", uav_info("uav0"), 1)
        if pictured:
            log.write(FLIGHT_IMAGE, "uav0", "site", flight_image("uav0"), 2)
    for command in ("report", "calibrate", "export"):
        out = tmp_path / ("r.html" if command == "report" else "out")
        assert run([command, str(tmp_path / "a.mcap"), "--out", str(out)]) == 2
        assert remedy in capsys.readouterr().err


def test_a_video_file_gives_its_own_times_and_a_larger_overlay(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(["track", str(recording / "film.mp4"), "--target", TARGET, "--out", str(out), "--overlay"]) == 0
    rows = table(out / "track.csv")
    assert float(rows[25]["time"]) == pytest.approx(1.0, abs=1e-3)
    overlay = cv2.VideoCapture(str(out / "overlay.mp4"))
    good, image = overlay.read()
    assert good
    assert image.shape[0] > 240
    assert image.shape[1] > 320
    assert overlay.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES
    assert sorted(path.name for path in out.iterdir()) == ["hypotheses.csv", "overlay.mp4", "track.csv"]


def test_a_clip_that_a_phone_has_trimmed_is_whole(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Phones trim by an edit list; "35 of 45 frames could be decoded"."""
    images = [cv2.imread(str(file)) for file in sorted((recording / "pictures").iterdir())]
    write_video(tmp_path / "a.mp4", images, np.arange(FRAMES) / 10)
    content = bytearray((tmp_path / "a.mp4").read_bytes())
    edit = content.index(b"elst") + 12
    duration_ms, begin = struct.unpack_from(">Ii", content, edit)
    struct.pack_into(">Ii", content, edit, duration_ms - 1000, begin + TICKS)
    (tmp_path / "a.mp4").write_bytes(content)
    assert run(["track", str(tmp_path / "a.mp4"), "--target", "152,118,36,16", "--out", str(tmp_path / "out")]) == 0
    assert "warning" not in capsys.readouterr().out
    assert len(table(tmp_path / "out" / "track.csv")) == FRAMES - 10


def test_an_overlay_of_an_earlier_run_is_removed_and_inputs_are_kept(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["track", str(recording / "film.mp4"), "--target", TARGET, "--out", str(tmp_path)]
    assert run([*arguments, "--overlay"]) == 0
    assert run([arguments[0], str(tmp_path / "overlay.mp4"), *arguments[2:]]) == 2
    assert run([*arguments, "--csv-truth", str(tmp_path / "track.csv")]) == 2
    assert "this file is read, and would be lost" in capsys.readouterr().err
    assert run(arguments) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hypotheses.csv", "track.csv"]


def test_the_same_seed_writes_the_same_bytes(recording: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert run(["track", str(recording / "pictures"), "--target", TARGET, "--out", str(tmp_path / name)]) == 0
    for file in ("track.csv", "hypotheses.csv"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--target", "500,20,30,20"], "outside the image"),
        (["--target", "50,20,2,2"], "too small"),
        (["--target", "180,118,216,134"], "looks like its left, top, right and lower edge"),
        (["--target", "50,20,30"], "four"),
        (["--target", "a,b,c,d"], "four numbers"),
        (["--target", "50,20,-30,20"], "width or height"),
        (["--target", TARGET, "--start", "900"], "before --start 900"),
        (["--target", TARGET, "--start=-1"], "negative"),
        (["--target", TARGET, "--fps", "0"], "out of range"),
        (["--target", TARGET, "--telemetry", "telemetry.csv"], "body_from_camera"),
        (["--target", TARGET, "--rig", "rig.toml", "--telemetry", "other_clock.csv"], "video's clock"),
        (["--target", TARGET, "--rig", "rig.toml", "--telemetry", "all_nan.csv"], "no usable row"),
        (["--target", TARGET, "--rig", "rig.toml", "--telemetry", "degrees.csv"], "quaternions are not of length 1"),
        (["--target", TARGET, "--rig", "rig.toml", "--telemetry", "headless.csv"], "column"),
        (["--target", TARGET, "--rig", "rig.toml", "--telemetry", "words.csv"], "words.csv:2"),
        (["--target", TARGET, "--rig", "rig.toml", "--telemetry", "flight.tlog"], "tlog"),
        (["--target", TARGET, "--rig", "rig.toml", "--telemetry", "missing.csv"], "does not exist"),
        (["--target", TARGET, "--csv-truth", "headless.csv"], "column"),
    ],
)
def test_bad_input_gives_one_line_and_exit_status_2(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    header = "time,qw,qx,qy,qz\n"
    (recording / "other_clock.csv").write_text(header + "".join(f"{1.7e9 + k / 10},1,0,0,0\n" for k in range(30)))
    (recording / "all_nan.csv").write_text(header + "nan,nan,nan,nan,nan\n")
    (recording / "degrees.csv").write_text(header + "0,0,-12.5,3.1,170.2\n")
    (recording / "headless.csv").write_text("0,1,0,0,0\n")
    (recording / "words.csv").write_text(header + "0,one,0,0,0\n")
    (recording / "flight.tlog").write_bytes(b"\xfe\x00")
    words = [str(recording / word) if word.endswith((".csv", ".toml", ".tlog")) else word for word in arguments]
    assert run(["track", str(recording / "pictures"), "--out", str(tmp_path / "out"), *words]) == 2
    output = capsys.readouterr().err.strip()
    assert message in output
    assert "\n" not in output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("box", ["301,200,22,47", "10,10,44,20", "5,8,200,120"])
def test_a_box_that_may_be_two_corners_is_warned_of(box: str) -> None:
    """A quarter of the picture was followed in place of the car, without a word."""
    [warning] = corners_for_a_box(parse_target("301,200,323,247"), (640, 480))
    assert warning.endswith("give --target 301,200,22,47")
    assert not corners_for_a_box(parse_target(box), (640, 480))
    assert not corners_for_a_box(parse_target("5,5,6,6"), (16, 16))  # no box of 1x1


def test_files_that_are_no_video_are_rejected(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"not a video at all" * 50)
    for video, message in ((broken, "no frame"), (tmp_path / "log.mcap", "log"), (tmp_path / "none.mp4", "not exist")):
        assert run(["track", str(video), "--target", TARGET, "--out", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    del recording


def test_a_damaged_video_is_tracked_as_far_as_it_can_be_decoded(recording: Path, tmp_path: Path) -> None:
    whole = (recording / "film.mp4").read_bytes()
    middle = bytearray(whole)
    middle[len(whole) // 2 : len(whole) // 2 + 400] = b"\x5a" * 400
    (tmp_path / "damaged.mp4").write_bytes(bytes(middle))
    status = run(["track", str(tmp_path / "damaged.mp4"), "--target", TARGET, "--out", str(tmp_path / "out")])
    assert status in (0, 2)
    if status == 0:
        assert len(table(tmp_path / "out" / "track.csv")) <= FRAMES


def test_a_gap_in_the_telemetry_does_not_lose_the_target(recording: Path, tmp_path: Path) -> None:
    rows = (recording / "telemetry.csv").read_text().splitlines()
    (tmp_path / "gap.csv").write_text("\n".join(rows[:6] + rows[45:]) + "\n")
    extra = ["--rig", str(recording / "rig.toml"), "--telemetry", str(tmp_path / "gap.csv")]
    out = ["--target", TARGET, "--out", str(tmp_path / "out"), "--fps", "10"]
    assert run(["track", str(recording / "pictures"), *out, *extra]) == 0
    rows_out = table(tmp_path / "out" / "track.csv")
    assert float(rows_out[30]["x"]) == pytest.approx(92 + 180 + 17.5, abs=6)


@pytest.mark.parametrize(
    ("late", "down", "warning"),
    [
        (0.0, -30.0, ""),
        (0.0, -3000.0, "its positions were used in no frame"),  # centimetres
        (0.0, 30.0, "its positions were used in no frame"),  # a height in place of a depth
        (3.0, -30.0, "no sample for 2.0 s of the video: times 3.0 to 8.9 s, but the video's are 0.0 to 4.5 s"),
    ],
)
def test_telemetry_on_another_clock_or_in_other_units_is_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], late: float, down: float, warning: str
) -> None:
    """Its positions and times were left unused, or used with an error of seconds, without a word."""
    lines = [f"{late + k / 10},1,0,0,0,0,0,{down}" for k in range(60)]
    (tmp_path / "t.csv").write_text("\n".join(["time,qw,qx,qy,qz,north,east,down", *lines]) + "\n")
    extra = ["--rig", str(recording / "rig.toml"), "--telemetry", str(tmp_path / "t.csv"), "--fps", "10"]
    out = ["--target", TARGET, "--out", str(tmp_path / "out")]
    assert run(["track", str(recording / "pictures"), *out, *extra]) == 0
    printed = capsys.readouterr().out
    assert ("warning:" in printed) == bool(warning)
    assert warning in printed


def test_times_in_milliseconds_about_the_video_are_refused() -> None:
    """They lie on both sides of the video, none in it: the images were said to show no plane."""
    samples = [Telemetry(time, np.eye(3)) for time in (-50.0, 50.0)]
    with pytest.raises(InputError, match="but the video's are"):
        check_clock(samples, Path("t.csv"), 0.0, 7.2)


def test_the_subtitles_of_a_drone_are_said_to_have_no_attitude(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were asked for a first line with time,qw,qx,qy,qz."""
    subtitles = tmp_path / "DJI_0001.SRT"
    subtitles.write_text("1\n00:00:00,000 --> 00:00:00,033\n[latitude: 47.4] [longitude: 8.5] [rel_alt: 60.0]\n\n")
    out = ["--target", TARGET, "--out", str(tmp_path / "out"), "--telemetry", str(subtitles)]
    assert run(["track", str(recording / "pictures"), *out, "--rig", str(recording / "rig.toml")]) == 2
    assert ".SRT telemetry can't be read by this version: subtitles have no attitude" in capsys.readouterr().err


def test_good_positions_of_a_flat_view_are_not_said_to_be_in_other_units(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within the first second of a view 50 degrees from straight down, the ground is not trusted yet."""
    lines = [f"{k / 10},{np.cos(0.44)},0,{np.sin(0.44)},0,0,0,-30" for k in range(60)]
    (tmp_path / "t.csv").write_text("\n".join(["time,qw,qx,qy,qz,north,east,down", *lines]) + "\n")
    extra = ["--rig", str(recording / "rig.toml"), "--telemetry", str(tmp_path / "t.csv"), "--start", "30"]
    out = ["--target", "272,118,36,16", "--out", str(tmp_path / "out")]
    assert run(["track", str(recording / "pictures"), *out, *extra]) == 0
    assert "used in no frame: the images show no plane" in capsys.readouterr().out


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    write_simulated_flight("town:yaw", folder, seed=5, frames=60, size=(320, 240), rate_hz=20.0)
    return folder


def _scaled(q: Floats) -> Floats:
    """Of three turns in one, as of another flight."""
    return so3.quaternion(so3.exp(3.0 * so3.log(so3.from_quaternion(q))))


@pytest.mark.parametrize(
    ("written", "named"),
    [
        (lambda q: q, None),
        (lambda q: np.roll(q, -1), "would if they were x,y,z,w"),
        (lambda q: q * [1, -1, -1, -1], "would if they were body_from_ned"),
        (lambda q: so3.quaternion(_ENU @ so3.from_quaternion(q) @ _FLU), "would if they were ROS's enu_from_flu"),
        (_scaled, "but not as the video does: check body_from_camera"),
        (lambda q: np.array([0.9, 0.1, 0.3, 0.3]), "turn by 0.0 degrees rms, but not as the video does"),
    ],
)
def test_attitudes_that_turn_otherwise_than_the_video_are_named(
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    written: Callable[[Floats], Floats],
    named: str | None,
) -> None:
    """They were believed, with positions on the ground some 30 m off and stds of 0.1 m."""
    lines = (flight / "telemetry.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    turned = [",".join([row[0], *map(str, written(np.array(row[1:5], float))), *row[5:]]) for row in rows]
    (tmp_path / "t.csv").write_text("\n".join([lines[0], *turned]) + "\n")
    first = {name: float(value) for name, value in table(flight / "truth.csv")[0].items()}
    box = f"{first['x'] - first['width'] / 2},{first['y'] - first['height'] / 2},{first['width']},{first['height']}"
    arguments = ["track", str(flight / "video.mp4"), "--target", box, "--rig", str(flight / "rig.toml")]
    status = run([*arguments, "--telemetry", str(tmp_path / "t.csv"), "--out", str(tmp_path / "out")])
    printed = capsys.readouterr()
    assert status == (2 if named is not None and "would" in named else 0)
    assert ("its attitudes" in printed.out + printed.err) == (named is not None)
    assert (named or "") in printed.out + printed.err


@pytest.mark.parametrize(
    ("written", "named"),
    [
        (lambda p: [47.39 + p[0] / 111_320.0, 8.54 + p[1] / 75_000.0, p[2]], "not latitude and longitude"),
        (lambda p: [0.0, 0.0, p[2]], "its positions move by 0 m in a second"),
        (lambda p: [p[0], p[1], p[2] - 40.0], "not above sea level"),
    ],
)
def test_positions_that_are_no_metres_above_the_ground_are_named(
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    written: Callable[[Floats], list[float]],
    named: str,
) -> None:
    """They were believed: the target stood still with stds of 0.1 m, or was 28 m off."""
    lines = (flight / "telemetry.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    changed = [",".join([*row[:5], *map(str, written(np.array(row[5:8], float)))]) for row in rows]
    (tmp_path / "t.csv").write_text("\n".join([lines[0], *changed]) + "\n")
    arguments = ["track", str(flight / "video.mp4"), "--target", TARGET, "--rig", str(flight / "rig.toml")]
    status = run([*arguments, "--telemetry", str(tmp_path / "t.csv"), "--out", str(tmp_path / "out")])
    printed = capsys.readouterr()
    assert status == (0 if "sea level" in named else 2)
    assert named in printed.out + printed.err


@pytest.fixture
def check_swaying(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Checked]:
    """`check_attitudes` of a vehicle with some roll, pitch and yaw [rad], whose times are early and attitudes read by
    a convention."""

    def check(
        angles: Callable[[Floats], list[Floats]],
        early_s: float,
        read: Callable[[Floats], Floats] = np.asarray,
        pitch_deg: float = 90.0,
    ) -> Checked:
        times, pitch = np.arange(0.0, 14.0, 0.02), np.radians(pitch_deg)
        attitudes = [rotation_from_euler(*of) for of in zip(*angles(times), strict=True)]
        x, y = np.cos(pitch), np.sin(pitch)
        mounting = np.array([[0.0, -y, x], [1.0, 0.0, 0.0], [0.0, x, y]])
        camera = [(attitude @ mounting).T for attitude in attitudes[100:600:2]]
        turns = np.array([so3.log(after @ before.T) for before, after in pairwise(camera)])
        turns += np.random.default_rng(0).normal(0.0, 4e-4, turns.shape)
        seen = RelativeRotations(times[100:598:2] - 2.0, times[102:600:2] - 2.0, turns)
        monkeypatch.setattr(telemetry_files, "_visual_rotations", lambda _, readings: ([seen] * len(readings), 10.0))
        early = tuple(Telemetry(time - 2.0 - early_s, read(one)) for time, one in zip(times, attitudes, strict=True))
        lens = Intrinsics(640, 480, np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]]))
        footage = telemetry_files.Footage(tmp_path / "a.mp4", None, lens, mounting, lambda frame: None)
        return telemetry_files.check_attitudes(TelemetryFile(early, 0), tmp_path / "t.csv", footage)

    return check


@pytest.mark.parametrize("pitch_deg", [90.0, 45.0])
def test_of_a_vehicle_that_sways_the_clock_is_that_of_the_whole_video(
    check_swaying: Callable[..., Checked], pitch_deg: float
) -> None:
    """1 s early, positions were 18 m off at stds of 0.3 m, one period later; or the quaternions were called ROS's."""

    def angles(times: Floats) -> list[Floats]:
        return [
            0.05 * np.sin(2.5 * times) + 0.01 * np.sin(8.2 * times + 1.0),
            0.05 * np.sin(2.1 * times + 0.4),
            0.3 * np.sin(0.15 * times) + 0.02 * np.sin(4.4 * times),
        ]

    samples, [warning], aligned = check_swaying(angles, 1.0, pitch_deg=pitch_deg)
    assert aligned
    assert samples[0].time == pytest.approx(-2.0, abs=0.02)
    assert "1.00 s earlier than the video's" in warning


def _swaying(rate: float, noise: float, yaw: float) -> Callable[[Floats], list[Floats]]:
    """Roll and pitch of 3 degrees at one angular rate [rad/s]."""
    return lambda times: [
        0.05 * np.sin(rate * times) + noise * np.sin(8.2 * times + 1.0),
        0.05 * np.sin(rate * times + 0.4),
        yaw * np.sin(0.15 * times),
    ]


@pytest.mark.parametrize(("rate", "early_s"), [(5.0, 0.0), (5.0, 0.2), (5.0, -1.3), (2.5, 1.0)])
def test_a_wrong_convention_that_fits_somewhere_is_named(
    check_swaying: Callable[..., Checked], rate: float, early_s: float
) -> None:
    """Times of transposed attitudes that were 0.2 s early were corrected by 2.08 s; that were 1.3 s late, by 0.58 s."""
    with pytest.raises(InputError, match="would if they were body_from_ned"):
        check_swaying(_swaying(rate, 0.003, 0.1), early_s, np.transpose)


@pytest.mark.parametrize("early_s", [1.0, -1.0, 1.5])
def test_an_ambiguous_offset_is_no_wrong_mounting(check_swaying: Callable[..., Checked], early_s: float) -> None:
    """Of a vehicle that only sways, attitudes and mounting were called wrong."""
    samples, [warning], aligned = check_swaying(_swaying(2.5, 0.0, 0.0), early_s)
    assert not aligned
    assert samples[0].time == -2.0 - early_s
    assert "used as they are: the offset is ambiguous" in warning
    assert "body_from_camera" not in warning


@pytest.mark.parametrize("late_s", [-0.25, 0.5, 2.0])
def test_positions_do_not_suffer_from_the_offset_of_the_telemetry(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], late_s: float
) -> None:
    """The ground frame began where the vehicle was 0.2 s later, and kept it: 2 m off with stds of 0.1 m."""
    late = np.loadtxt(flight / "telemetry.csv", delimiter=",", skiprows=1)
    late[:, 0] += late_s
    header = (flight / "telemetry.csv").read_text().splitlines()[0]
    np.savetxt(tmp_path / "t.csv", late, "%.9g", ",", header=header, comments="")
    truth = table(flight / "truth.csv")
    first = {name: float(value) for name, value in truth[0].items()}
    box = f"{first['x'] - first['width'] / 2},{first['y'] - first['height'] / 2},{first['width']},{first['height']}"
    extra = ["--rig", str(flight / "rig.toml"), "--telemetry", str(tmp_path / "t.csv")]
    assert run(["track", str(flight / "video.mp4"), "--target", box, "--out", str(tmp_path / "out"), *extra]) == 0
    seen = [
        (np.hypot(*(float(row[k]) - float(true[k]) for k in ("north", "east"))), float(row["std_m"]))
        for row, true in zip(table(tmp_path / "out" / "track.csv"), truth, strict=True)
        if row["state"] == "visible"
    ]
    error, std = np.median(seen, axis=0)
    assert error < 1.0
    assert error < 3.0 * std
    assert ("s later than the video's" in capsys.readouterr().out) == (late_s > 1.0)


@pytest.mark.parametrize(("above_m", "others"), [(0.0, 0), (30.0, 0), (0.0, 1000)])
def test_a_log_whose_heights_are_not_above_the_ground_is_named(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], above_m: float, others: int
) -> None:
    """The local frame alone, which began 30 m lower: the target was 22 m off, with a std of 0.2 m.

    others: attitudes of a second vehicle. Of several, the one with the most attitudes was taken for the video's.
    """
    codec, data = mavlink.MAVLink(None, 2, 1), bytearray()
    for k in range(others):
        message = mavlink.MAVLink_attitude_message(50 * k, 0.2 * np.sin(0.1 * k), 0.1 * np.cos(0.17 * k), 0, 0, 0, 0)
        data += k.to_bytes(8, "big") + message.pack(codec)
    codec = mavlink.MAVLink(None, 1, 1)
    for time, *q, north, east, down in np.loadtxt(flight / "telemetry.csv", delimiter=",", skiprows=1):
        boot_ms = round(1e3 * (time + 100.0))
        for message in (
            mavlink.MAVLink_attitude_quaternion_message(boot_ms, *q, 0, 0, 0),
            mavlink.MAVLink_local_position_ned_message(boot_ms, north, east, down - above_m, 0, 0, 0),
        ):
            data += boot_ms.to_bytes(8, "big") + message.pack(codec)
    (tmp_path / "t.tlog").write_bytes(data)
    arguments = ["track", str(flight / "video.mp4"), "--target", TARGET, "--rig", str(flight / "rig.toml")]
    assert run([*arguments, "--telemetry", str(tmp_path / "t.tlog"), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "is not used" not in printed
    assert ("not above sea level" in printed) == (above_m > 0.0)


@pytest.mark.parametrize("of_its_own", [True, False])
def test_of_a_log_of_two_vehicles_the_telemetry_is_that_of_the_images(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], of_its_own: bool
) -> None:
    """It was that of the vehicle with more of it, 500 m away."""
    level = {"schema_version": 1, "boot_id": "b", "time_std_s": 0.01, "ned_from_body": [1.0, 0.0, 0.0, 0.0]}
    with LogWriter(tmp_path / "a.mcap") as log:
        for k, file in enumerate(sorted((recording / "pictures").iterdir())[:20]):
            moment = {"device_time_ns": k * 50_000_000, "order": 4 * k}
            image = {"frame": k, "width": 320, "height": 240, "jpeg": encode_jpeg(cv2.imread(str(file)), 95)}
            picture = pb.FlightImage(schema_version=1, agent="one", boot_id="b", **moment, **image)
            log.write(FLIGHT_IMAGE, "one", "site", picture, k)
            for agent, north in (("one", 0.0), ("two", 500.0), ("two", 500.0))[not of_its_own :]:
                moment = {"device_time_ns": moment["device_time_ns"] + 1_000_000, "order": moment["order"] + 1}
                sample = pb.VehicleTelemetry(agent=agent, position=[north, 0.0, -30.0], **moment, **level)
                log.write(TELEMETRY, agent, "site", sample, k)
    log_file = str(tmp_path / "a.mcap")
    extra = ["--rig", str(recording / "rig.toml"), "--telemetry", log_file, "--out", str(tmp_path / "out")]
    assert run(["track", log_file, "--target", TARGET, *extra]) == (0 if of_its_own else 2)
    if of_its_own:
        assert abs(float(table(tmp_path / "out" / "track.csv")[10]["north"])) < 10.0
    else:
        assert "no telemetry of the run of one that has the images" in capsys.readouterr().err


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_variable_frame_rate_is_no_loss_of_frames(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], share: float
) -> None:
    """Matroska has no number of frames."""
    images = [cv2.imread(str(file)) for file in sorted((recording / "pictures").iterdir())]
    times = np.cumsum(np.tile([0.05, 0.1, 0.15], FRAMES // 3))
    write_video(tmp_path / "a.mkv", images, times)
    content = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "a.mkv").write_bytes(content[: int(share * len(content))])
    assert run(["track", str(tmp_path / "a.mkv"), "--target", TARGET, "--out", str(tmp_path / "out")]) == 0
    assert ("seems to be cut off" in capsys.readouterr().out) == (share < 1.0)
