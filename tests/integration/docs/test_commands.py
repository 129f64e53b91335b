"""The commands of the documentation: those of a tutorial run as written, and every option on a page exists."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from deploy.cli import COMMANDS, build_app, run
from protocols.session.calibration import read_calibration

ROOT = Path(__file__).parents[3]
PAGES = sorted(
    page.relative_to(ROOT).as_posix()
    for pattern in ("*.md", "*/README.md", "*/*/README.md", "docs/**/*.md")
    for page in ROOT.glob(pattern)
)
NAMES = {name for name, _, _ in COMMANDS}
_SPAN = re.compile(r"`(syncline [^`]+)`")


def command_lines(text: str) -> list[str]:
    """Every `syncline …` of a page: prompts in blocks and spans in sentences, without comments."""
    found = []
    for line in text.splitlines():
        prompt = re.match(r"\$ (syncline .*)", line.strip())
        found += [prompt[1]] if prompt else _SPAN.findall(line)
    return [re.split(r"\s+#|\s+&&?\s*$|\s+>|\s+\|", line)[0].strip() for line in found]


@cache
def help_of(*words: str) -> str:
    """What `syncline WORDS --help` prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert run([*words, "--help"]) == 0
    return printed.getvalue()


def in_pages() -> list[tuple[str, str]]:
    return [(file, line) for file in PAGES for line in command_lines((ROOT / file).read_text(encoding="utf-8"))]


def test_the_documentation_names_commands() -> None:
    assert len(in_pages()) > 20


def test_commands_print_json_and_accept_a_seed() -> None:
    """As docs/reference/commands.md says, also those that draw nothing at random."""
    groups = {name: re.findall(r"^│ ([a-z]+) ", help_of(name), re.MULTILINE) for name in ("keys", "site")}
    every = [(name,) for name, _, _ in COMMANDS if name not in groups]
    every += [(name, part) for name, parts in groups.items() for part in parts]
    assert len(every) > 40
    for option in ("--json", "--seed", "Example: "):
        assert [words for words in every if option not in help_of(*words)] == []


@pytest.mark.parametrize("name", sorted(NAMES))
def test_paragraphs_of_a_help_fill_a_narrow_terminal(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lines of a docstring are wider than 80 columns: broken once more, every second one had a few words."""
    monkeypatch.setenv("COLUMNS", "80")
    paragraphs = help_of.__wrapped__(name).split("╭")[0].split("\n\n")
    for paragraph in paragraphs:
        lines = [line.strip() for line in paragraph.strip().splitlines()]
        full = [len(line) + 1 + len(following.split()[0]) > 76 for line, following in pairwise(lines)]
        assert all(full), paragraph


def test_every_command_and_option_in_the_documentation_exists() -> None:
    wrong = []
    for file, line in in_pages():
        words = [word for word in line.split()[1:] if word not in ("…", "...")]
        if not words or words[0].startswith(("-", "<")) or words[0].isupper():
            continue
        name = words[0].rstrip(".,;:")
        if name not in NAMES:
            wrong.append(f"{file}: no command in {line!r}")
            continue
        text = help_of(name)
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", " ".join(words[1:])):
            # A command with commands of its own lists its options one level down.
            if not re.search(rf"{option}(?![\w-])", text) and option != "--help" and "COMMAND" not in text:
                wrong.append(f"{file}: {name} has no {option} ({line!r})")
    assert wrong == []


@pytest.mark.parametrize("name", sorted(NAMES))
def test_every_command_shows_an_example_that_its_own_options_allow(name: str) -> None:
    text = " ".join(help_of(name).split())
    end = "(?= Example:| [╭┌]| Arguments| Parameters|$)"
    examples = re.findall(rf"Example: (?:sudo )?(syncline {name}\b.*?){end}", text)
    assert examples, "its help shows an example"
    for example in examples:
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", example):
            assert re.search(rf"{option}(?![\w-])", text.replace(example, "")) or "Commands" in text, option
    for paragraph in re.split(r"\n\s*\n", help_of(name)):
        found = re.fullmatch(rf"Example: (?:sudo )?syncline ({name}\b.*)", " ".join(paragraph.split()))
        if found and not found[1].endswith("."):
            build_app(name).parse_args(shlex.split(found[1]), exit_on_error=False, print_error=False)


def run_as_written(line: str, folder: Path) -> str:
    """Run one command line in a folder, with `syncline` as the environment has it; it must succeed."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    result = subprocess.run(
        ["/bin/sh", "-c", line],
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, f"{line}: {result.stderr}"
    return result.stdout


def line_with(text: str, *words: str) -> str:
    """The page's command that holds all of these words."""
    (line,) = sorted({line for line in command_lines(text) if all(word in line for word in words)}, key=len)[:1]
    return line


def test_from_the_tutorial_to_a_session_a_calibration_a_report_and_other_tools(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "tutorials" / "first-calibration.md").read_text(encoding="utf-8")
    run_as_written(line_with(text, "simulate marker", "my-session"), tmp_path)
    assert (tmp_path / "my-session" / "rig.toml").exists()
    printed = run_as_written(line_with(text, "calibrate my-session"), tmp_path)
    assert "4 cameras" in printed
    _, cameras = read_calibration(tmp_path / "out" / "calibration.toml")
    assert len(cameras) == 4
    assert "Good: all 4 cameras calibrated" in run_as_written("syncline report out", tmp_path)
    example = " ".join(help_of("export").split())
    line = re.search(r"Example: (syncline export out/trajectory\.csv \S+ \S+ \S+ \S+)", example)
    assert line is not None
    run_as_written(line[1], tmp_path)
    written = tmp_path / shlex.split(line[1])[-1]
    assert len(written.read_text(encoding="utf-8").splitlines()) > 100
    run_as_written("syncline export out/calibration.toml --to opencv --out for-opencv", tmp_path)
    assert len(list((tmp_path / "for-opencv").iterdir())) == 4


def test_from_a_folder_of_videos_to_followed_people_in_three_commands(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "tutorials" / "follow-people.md").read_text(encoding="utf-8")
    run_as_written(line_with(text, "simulate people", "--render"), tmp_path)
    printed = run_as_written(line_with(text, "follow room"), tmp_path)
    mota = re.search(r"MOTA (\S+),", printed)
    assert mota is not None
    assert float(mota[1]) > 0.6
    out = tmp_path / "followed"
    assert {file.name for file in out.iterdir()} == {
        "tracks.csv", "report.html", "result.json", "detections.mcap", "crops"
    }  # fmt: skip
    assert len(list(out.glob("crops/*/*_head.jpg"))) > 20
    run_as_written(line_with(text, "replay followed"), tmp_path)
    assert (tmp_path / "live.mcap").stat().st_size > 10_000


def test_the_overview_lists_every_command() -> None:
    app = build_app()
    result = subprocess.run(
        [sys.executable, "-m", "deploy", "--help"], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert all(re.search(rf"^[│ ]*{name}\b", result.stdout, re.MULTILINE) for name in NAMES)
    assert app is not None


def test_an_agent_prints_its_statuses_or_its_configuration_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "cam.toml"
    config.write_text('id = "cam0"\nsite = "a"\ndriver = "simulated"\n[simulated]\nseed = 3\n', encoding="utf-8")
    assert run(["camera", str(config), "--print-config", "--json", "--seed", "9"]) == 0
    assert json.loads(capsys.readouterr().out)["simulated"]["seed"] == 9
    command = [sys.executable, "-m", "deploy", "camera", str(config), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as agent:
        assert agent.stdout is not None
        report = json.loads(agent.stdout.readline())
        agent.terminate()
        rest = agent.stdout.read().splitlines()
    assert (report["role"], report["agent"], agent.returncode) == ("camera", "cam0", 0)
    assert json.loads(rest[-1])["state"] == "stopping"


def test_a_seed_is_of_a_simulated_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "cam.toml"
    config.write_text('id = "cam0"\nsite = "a"\ndriver = "video"\n[video]\nsource = "a.mp4"\n', encoding="utf-8")
    assert run(["camera", str(config), "--print-config", "--seed", "9"]) == 2
    assert "--seed is of a simulated world" in capsys.readouterr().err


def test_an_agent_outlives_the_reader_of_its_statuses(tmp_path: Path) -> None:
    """Where the pipe was closed, as by `head -1`, it ended with status 0, and no supervisor started it again."""
    config = tmp_path / "cam.toml"
    config.write_text('id = "cam0"\nsite = "a"\ndriver = "simulated"\n', encoding="utf-8")
    command = [sys.executable, "-m", "deploy", "camera", str(config), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT) as agent:
        assert agent.stdout is not None
        assert json.loads(agent.stdout.readline())["agent"] == "cam0"
        agent.stdout.close()
        with pytest.raises(subprocess.TimeoutExpired):
            agent.wait(2.5)  # a status a second
        agent.terminate()
    assert agent.returncode == 0
