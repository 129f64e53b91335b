"""What users did to it: broken clocks, contradicting surveys, full disks, odd names; each once went wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.cli import run
from deploy.config.agents import HubConfig
from deploy.config.file import load
from hub.calibration.pipeline import calibrate
from protocols.core.errors import InputError
from protocols.core.files import completed_file, write_together
from protocols.geometry.types import Floats
from protocols.log.write.writer import LogWriter
from protocols.session.folder import write_observations
from protocols.session.observations import Observations
from protocols.session.rig import read_rig
from tests.support.rigs import Session, simulate


@pytest.fixture(scope="module")
def filmed() -> Session:
    return simulate(91, 3, 20)


def test_a_clock_that_is_set_while_recording_costs_its_shorter_side(filmed: Session) -> None:
    """From uptime to Unix time in the middle of a recording: once asked for 253 GiB of memory."""
    seen = filmed.observations()
    tracks = dict(seen.tracks)
    track = tracks["cam1", "marker"]
    late = track.time > track.time[0] + 12.0
    tracks["cam1", "marker"] = type(track)(
        track.camera, track.label, track.frame, track.time + np.where(late, 1.7e9, 0.0), track.pixels, track.size
    )
    found = calibrate(filmed.rig, Observations(tracks))
    assert any("cam1" in text and "clock step" in text for text in found.warnings)
    for name, camera in found.cameras.items():
        if name != "cam1":
            assert abs(filmed.clock_error(name, found.reference, camera.time_map)) < 1e-3
    # The middle of the span that was used, not of the one that jumps.
    middle = float(np.median(track.time[~late]))
    shown = found.cameras["cam1"].time_map
    reference = shown.clock_rate * middle + shown.time_offset
    assert filmed.true_time("cam1", middle) == pytest.approx(filmed.true_time(found.reference, reference), abs=1e-3)


def test_a_pause_of_a_day_is_no_clock_step(filmed: Session) -> None:
    tracks = {}
    for (name, label), track in filmed.observations().tracks.items():
        late = track.time > track.time[0] + 12.0
        day = round(86_400.0 * filmed.rig.cameras[name].fps)
        interval = float(np.median(np.diff(track.time) / np.diff(track.frame)))
        tracks[name, label] = replace(
            track, frame=track.frame + np.where(late, day, 0), time=track.time + np.where(late, day * interval, 0.0)
        )
    found = calibrate(filmed.rig, Observations(tracks))
    assert len([text for text in found.warnings if "by its frame numbers it pauses for" in text]) == 3
    assert not [text for text in found.warnings if "its clock steps by" in text]


def test_lengths_without_an_end_are_named_and_a_readout_is_no_longer_than_a_frame(
    filmed: Session, tmp_path: Path
) -> None:
    rig = replace(filmed.rig, distances=(("cam0", "cam9", 3.0),), scale_bars=(("a", "b", 0.5),))
    told = calibrate(rig, filmed.observations()).warnings
    assert "the distance cam0–cam9 was not used: no solution has cam9" in told
    assert "the scale bar (wand) a–b was not used: no solution has a and b" in told
    (tmp_path / "rig.toml").write_text("[cam0]\nsize = [640, 480]\nfps = 50.0\nreadout = 0.05\n")
    with pytest.raises(InputError, match="longer than the 20 ms between two frames"):
        read_rig(tmp_path / "rig.toml")


def test_contradicting_distances_are_refused(
    filmed: Session, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metadata = 'distances = [["cam0", "cam1", 1.0], ["cam0", "cam2", 1000.0]]'
    folder = filmed.write(tmp_path / "session", metadata)
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 3
    assert "contradict" in capsys.readouterr().err
    assert run(["calibrate", str(folder), "--solver", "distributed", "--seed", "-1", "--out", str(tmp_path / "o")]) == 2


def test_an_answer_with_distances_is_plain_toml_in_the_rigs_units(filmed: Session, tmp_path: Path) -> None:
    apart = float(np.linalg.norm(filmed.poses["cam0"].position - filmed.poses["cam1"].position))
    metadata = f'units = "cm"\ndistances = [["cam0", "cam1", {100 * apart}]]'
    folder = filmed.write(tmp_path / "session", metadata)
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 0
    found = tomllib.loads((tmp_path / "out" / "calibration.toml").read_text())
    assert "distances" not in found["metadata"]
    assert (found["metadata"]["units"], found["metadata"]["scale"]) == ("cm", "metric")
    assert np.linalg.norm(found["cam1"]["translation"]) == pytest.approx(100 * apart, rel=1e-3)


def test_known_poses_keep_their_own_scale_and_units(filmed: Session, tmp_path: Path) -> None:
    folder = filmed.write(tmp_path / "session")
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "first")]) == 0
    known = tmp_path / "first" / "calibration.toml"
    assert run(["calibrate", str(folder), "--from-known", str(known), "--out", str(tmp_path / "again")]) == 0
    assert tomllib.loads((tmp_path / "again" / "calibration.toml").read_text())["metadata"]["scale"] == "arbitrary"


def test_an_earlier_answer_as_rig_brings_no_old_refusals(filmed: Session, tmp_path: Path) -> None:
    folder = filmed.write(tmp_path / "session", 'refused = { cam7 = "long ago" }\nscale = "metric"')
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 0
    metadata = tomllib.loads((tmp_path / "out" / "calibration.toml").read_text())["metadata"]
    assert "refused" not in metadata
    assert metadata["scale"] == "arbitrary"


@pytest.mark.parametrize("reference", ['"camX"', "7", '["cam0"]'])
def test_a_reference_that_is_no_camera_is_bad_input(filmed: Session, tmp_path: Path, reference: str) -> None:
    folder = filmed.write(tmp_path / "session", f"reference = {reference}")
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 2


def test_brackets_in_a_path_are_no_markup(filmed: Session, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = filmed.write(tmp_path / "session")
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "o[bold]")]) == 0
    shown = capsys.readouterr().out
    assert "o[bold]" in shown
    assert "[ms]" in shown


def test_one_file_that_cannot_be_written_leaves_none(tmp_path: Path) -> None:
    (tmp_path / "second").mkdir()
    with pytest.raises(InputError, match="second"):
        write_together({tmp_path / "first": "1", tmp_path / "second": "2", tmp_path / "third": "3"})
    assert [path.name for path in tmp_path.iterdir()] == ["second"]


def test_an_output_goes_through_links_and_never_takes_the_place_of_a_device(tmp_path: Path) -> None:
    """A renamed file takes the place of a link; root's took that of /dev/null."""
    shared, link, pipe = tmp_path / "shared.csv", tmp_path / "link.csv", tmp_path / "pipe.csv"
    shared.write_text("old")
    link.symlink_to("shared.csv")
    os.mkfifo(pipe)
    write_together({link: "new"})
    assert (link.is_symlink(), shared.read_text()) == (True, "new")
    with completed_file(link) as part:
        part.write_text("newer")
    assert (link.is_symlink(), shared.read_text()) == (True, "newer")
    with pytest.raises(InputError, match="is a device or a pipe"):
        write_together({pipe: "new"})
    with pytest.raises(InputError, match="is a device or a pipe"), completed_file(pipe):
        pass
    assert pipe.is_fifo()


def test_an_interrupt_while_modules_are_imported_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "cyclopts.py").write_text("raise KeyboardInterrupt")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-m", "deploy"], env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (130, b"syncline: interrupted\n")


@pytest.mark.parametrize("out", ["file", "file/below", "x" * 300, "locked", "locked/below"])
def test_an_output_folder_that_cannot_be_is_told_before_the_work(
    filmed: Session, tmp_path: Path, out: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = filmed.write(tmp_path / "session")
    (tmp_path / "file").write_text("")
    (tmp_path / "locked").mkdir()
    # Who runs the tests may have all rights.
    monkeypatch.setattr("protocols.core.files.os.access", lambda place, mode: Path(place).name != "locked")
    assert run(["calibrate", str(folder), "--out", str(tmp_path / out)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "rig",
    ["size = [1" + "0" * 400 + ", 480]", "a = " + "[" * 5000, "fps = 1" + "0" * 5000, "position = [1e300, 0, 0]"],
)
def test_toml_beyond_all_measure_is_bad_input(tmp_path: Path, rig: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.toml").write_text(f"[cam0]\nsize = [640, 480]\n{rig}\n".replace("size = [640, 480]\nsize", "size"))
    (tmp_path / "observations.csv").write_text("camera,frame,time,u,v\ncam0,0,0,1,1\n")
    assert run(["calibrate", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize("row", ["cam0,0,1e300,1,1", "cam0,0,1e12,1,1", "cam0,0,0,1e9,1"])
def test_a_time_or_pixel_beyond_all_measure_is_bad_input(tmp_path: Path, row: str) -> None:
    (tmp_path / "rig.toml").write_text("[cam0]\nsize = [640, 480]\n")
    (tmp_path / "observations.csv").write_text(f"camera,frame,time,u,v\n{row}\n")
    assert run(["calibrate", str(tmp_path), "--out", str(tmp_path / "out")]) == 2


@pytest.mark.parametrize(
    ("change", "status", "report"),
    [
        (lambda pixels: pixels[:, ::-1], 2, "swap u and v"),
        (lambda pixels: pixels / [1280, 720], 2, "they are fractions of it; multiply u by its width"),
        (lambda pixels: 1.5 * pixels, 2, "pixels of a larger one"),
        (lambda pixels: 0.5 * pixels, 3, "pictures of 1/2 the size that rig.toml states, the rows place 4 cameras"),
        (lambda pixels: pixels / 3, 3, "pictures of 1/3 the size"),
        (lambda pixels: [1279, 0] - pixels * [1, -1], 3, "picture is mirrored: the measured lenses are refuted"),
        (lambda pixels: [0, 719] - pixels * [-1, 1], 3, "give v from the other side, height - 1 - v"),
    ],
)
def test_pixels_of_another_convention_are_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Floats], Floats],
    status: int,
    report: str,
) -> None:
    """All these gave an answer, of another world or a mirrored one, with warnings at most."""
    session = simulate(3, 4, 30.0)
    folder = session.write(tmp_path / "session")
    seen = session.observations()
    tracks = {key: replace(track, pixels=change(track.pixels)) for key, track in seen.tracks.items()}
    write_observations(folder / "observations.csv", Observations(tracks))
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == status
    assert report in capsys.readouterr().err


def test_the_demo_takes_its_agents_along_when_it_is_ended(tmp_path: Path) -> None:
    out = tmp_path / "demo-out"
    demo = subprocess.Popen(
        [sys.executable, "-m", "deploy", "demo", "--seconds", "60", "--out", str(out)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ},
    )
    try:
        deadline = time.monotonic() + 60.0
        while len(agents_of(out)) < 5 and time.monotonic() < deadline:
            time.sleep(0.1)
        assert len(agents_of(out)) == 5
        demo.send_signal(signal.SIGTERM)
        demo.wait(30.0)
        assert agents_of(out) == []
    finally:
        demo.kill()


def agents_of(out: Path) -> list[str]:
    """Command lines of processes that were given a configuration in ``out``."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdecimal():
            try:
                line = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if f"{out}/config/" in line:
                found.append(line)
    return found


COMMANDS = {
    "log": ["info", "X.mcap"],
    "video": ["detect", "marker", "X.mp4", "--out", "OUT"],
    "flight": ["track", "X.mp4", "--target", "1,1,9,9", "--out", "OUT"],
    "configuration": ["hub", "X.toml", "--print-config"],
    "rig": ["detect", "marker", "images", "--rig", "X.toml", "--out", "OUT"],
    "observations": ["calibrate", "session", "--observations", "X.csv", "--out", "OUT"],
    "calibration": ["export", "X.toml", "--to", "opencv", "--out", "OUT"],
    "trajectory": ["export", "X.csv", "--to", "trc", "--out", "OUT"],
    "telemetry": ["track", "images", "--target", "1,1,9,9", "--telemetry", "X.csv", "--out", "OUT"],
    "tlog": ["track", "images", "--target", "1,1,9,9", "--telemetry", "X.tlog", "--out", "OUT"],
    "yaml": ["import", "X.yaml", "--out", "OUT"],
    "points": ["import", "X.csv", "--out", "OUT"],
}


@pytest.mark.parametrize("what", COMMANDS)
@pytest.mark.parametrize("kind", ["pipe", "device", "binary"])
def test_what_is_no_file_of_its_kind_is_refused(
    filmed: Session, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, what: str
) -> None:
    """A pipe that nobody writes to was waited for; /dev/zero was read until the memory was full."""
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images/0.png"), np.zeros((48, 64, 3), np.uint8))
    filmed.write(tmp_path / "session")
    command = [str(tmp_path / word) if word[0].isupper() or "/" in word else word for word in COMMANDS[what]]
    command = [str(tmp_path / word) if word in ("images", "session") else word for word in command]
    file = Path(next(word for word in command if word.startswith(str(tmp_path / "X."))))
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "device":
        file.symlink_to("/dev/zero")
    else:
        file.write_bytes(bytes(5000))

    def too_long(*_: object) -> None:
        raise AssertionError("it waits")

    signal.signal(signal.SIGALRM, too_long)
    signal.alarm(30)
    try:
        assert run(command) == 2
    finally:
        signal.alarm(0)
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "OUT").exists() or not list((tmp_path / "OUT").iterdir())


_LENS = "[cam0]\nsize = [640, 480]\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (".".join(["a"] * 50_000) + " = 1\n", "more than 32 parts"),
        ("[" + ".".join(['"!"'] * 50_000) + "]\n", "more than 32 parts"),
        ("x = { " + " . ".join(["a" * 150] * 9_000) + " = 1 }\n", "more than 32 parts"),
        ("".join(f"[cam{number}]\nsize = [640, 480]\n" for number in range(2_000)), "2000 cameras, at most 1024"),
        (f"{_LENS}fps = 0x{'F' * 5000}\n", ":3: a number too large"),
        ("#" * 5_000_000, "more than 4194304 bytes"),
    ],
    ids=["dotted", "quoted", "inline", "cameras", "digits", "size"],
)
def test_a_rig_that_takes_long_to_read_is_refused_at_once(tmp_path: Path, text: str, words: str) -> None:
    """Time was quadratic: 38 s for a key of 50,000 parts, also of a configuration; a hexadecimal number of 5,000
    digits could not be printed in the message about it."""
    file = tmp_path / "rig.toml"
    file.write_text(text)
    began = time.process_time()
    with pytest.raises(InputError, match=words):
        read_rig(file)
    if "cameras" not in words:
        with pytest.raises(InputError, match=words):
            load(file, HubConfig)
    assert time.process_time() - began < 10.0


def test_what_a_terminal_would_obey_is_shown_as_an_escape(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "\x1b[2Jgone"
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "\x1b" not in (shown := capsys.readouterr().err)
    assert "\\x1b[2Jgone" in shown
    log = tmp_path / "log.mcap"
    with LogWriter(log) as writer:
        writer.attach("\x1b]0;owned\x07[/red]", "text/plain", b"", 0)
    assert run(["info", str(log)]) == 0
    assert "\x1b]0;" not in capsys.readouterr().out


def test_a_terminal_without_unicode_gets_escapes_and_no_traceback(tmp_path: Path, filmed: Session) -> None:
    filmed.write(tmp_path / "session")
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-m", "deploy", "info", str(tmp_path / "session")],
        env=environment,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0
    assert b"Traceback" not in done.stderr


@pytest.mark.parametrize("closed", ["stdin", "stdout", "stderr"])
def test_a_stream_that_is_closed_from_the_start_is_no_error(tmp_path: Path, filmed: Session, closed: str) -> None:
    """Python has None in its place."""
    filmed.write(tmp_path / "session")
    place = {"stdin": 0, "stdout": 1, "stderr": 2}[closed]
    command = f'exec "$0" -m deploy info "$1" {place}>&-'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable, str(tmp_path / "session")], capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_reader_that_closes_the_pipe_is_no_error() -> None:
    command = '"$0" -m deploy --help 2>&1; echo "status $?" >&2'
    done = subprocess.run(["sh", "-c", f"({command}) | true", sys.executable], capture_output=True, check=False)
    assert done.stderr.strip() == b"status 0"


def test_names_that_are_no_unicode_or_not_in_the_locale_are_no_bug(tmp_path: Path, filmed: Session) -> None:
    folder = filmed.write(tmp_path / "session\udcff")
    assert run(["calibrate", str(folder), "--out", str(tmp_path / "out\udcff")]) == 0
    text = (tmp_path / "out\udcff/calibration.toml").read_text().replace("cam1", "cämera 日")
    calibration = tmp_path / "calibration.toml"
    calibration.write_text(text.replace("[cämera 日]", '["cämera 日"]'), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "deploy", "export", str(calibration), "--to", "opencv", "--out", str(tmp_path / "cv")],
        env={**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1), done.stderr
    assert not list((tmp_path / "cv").iterdir())


@pytest.mark.parametrize("megabytes", [120, 300, 400])
def test_little_memory_is_one_line(tmp_path: Path, filmed: Session, megabytes: int) -> None:
    """Libraries that cannot be loaded, and OpenBLAS, which waits for ever."""
    filmed.write(tmp_path / "session")
    command = f'ulimit -v {megabytes * 1000}; exec "$0" -m deploy calibrate "$1" --out "$1/out"'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable, str(tmp_path / "session")], capture_output=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1), done.stderr


def test_out_of_memory_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def fails(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr("deploy.logs.info.describe_log", fails)
    monkeypatch.setattr("deploy.commands.data.logs.describe_log", fails, raising=False)
    monkeypatch.setattr("protocols.log.read.reader.LogReader.__init__", fails)
    assert run(["info", "log.mcap"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
