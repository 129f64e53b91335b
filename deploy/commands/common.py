"""What the subcommands share: options, checks of their values, and the result as text or as JSON."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from protocols.core.errors import EXIT_DONE, InputError
from protocols.core.files import destination

Flag = Annotated[bool, Parameter(negative="")]
Json = Annotated[bool, Parameter(negative="", help="Print the result as JSON.")]
PrintConfig = Annotated[
    bool, Parameter(negative="", help="Print the configuration with all defaults filled in, and exit.")
]
StatusJson = Annotated[
    bool, Parameter(negative="", help="Print each status, or the configuration, as a line of JSON; all else on stderr.")
]
UnusedSeed = Annotated[int, Parameter(help="Accepted for consistency; this command uses no random numbers.")]
Scheduler = Annotated[
    str | None,
    Parameter(
        help="Runs this command over many inputs on dask: an address, a scheduler's file, or a number of processes on "
        "this machine. The input is then a folder of videos or sessions, or a .txt file with one and its own options a "
        "line; --out is a folder. Called again, it does what is left."
    ),
]
NumberList = Annotated[str, Parameter(allow_leading_hyphen=True)]  # "-3,9" is a value
Role = Literal["camera", "uav", "hub", "recorder", "router"]
Names = Annotated[list[str] | None, Parameter(negative="", help="Only these agents, by id or ROLE-ID.")]


def command_line() -> str:
    """This command as it was typed, for results to state."""
    return shlex.join(["syncline", *sys.argv[1:]])


def check_range(option: str, value: float | None, low: float, high: float, remedy: str = "") -> None:
    """Raise InputError unless low <= value <= high; None is no value."""
    if value is not None and not low <= value <= high:
        raise InputError(f"{option} {value:g} is out of range", remedy=remedy or f"give {low:g} to {high:g}")


def check_rate(fps: float | None) -> None:
    """Raise InputError for a frame rate [Hz] that no camera has."""
    check_range("--fps", fps, 0.1, 10_000.0, "give the frame rate in Hz")


def check_seed(seed: int) -> None:
    """Raise InputError for a negative seed."""
    if seed < 0:
        raise InputError(f"--seed {seed} is negative", remedy="give 0 or more")


def check_file(out: Path, name: str, *inputs: Path | None, option: str = "--out") -> None:
    """Raise InputError if ``out`` is a folder, a device, or one of the ``inputs``. name: of what it has to be."""
    if out.is_dir():
        raise InputError("this is a folder, but a file is needed", file=out, remedy=f"give {option} the name of {name}")
    if destination(out).resolve() in [given.resolve() for given in inputs if given is not None]:
        raise InputError("this file is read, and would be lost", file=out, remedy=f"give {option} another name")


def refuse(options: Mapping[str, object], what: str) -> None:
    """Raise InputError for the first option that is given (not None) and cannot be used with ``what``."""
    for option, value in options.items():
        if value is not None:
            raise InputError(f"{option} cannot be used with {what}", remedy="leave it out")


def parse_size(option: str, text: str, remedy: str, least: int = 1, most: int = 99_999) -> tuple[int, int]:
    """(width, height) of an option like 1920x1080, each from ``least`` to ``most``. Raises InputError."""
    found = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text.strip())
    if found is None or not all(least <= int(side) <= most for side in found.groups()):
        raise InputError(f"{option} {text} is no size", remedy=remedy)
    return int(found[1]), int(found[2])


def answer(document: Mapping[str, Any] | list[Any], lines: Iterable[str], as_json: bool) -> int:
    """Print the result of a command, as JSON or in lines; returns EXIT_DONE."""
    if as_json:
        print(json.dumps(document, allow_nan=False), flush=True)
    else:
        for line in lines:
            print(line, flush=True)
    return EXIT_DONE


def answer_config(config: Any, as_json: bool) -> int:
    """Print an agent's configuration with every default filled in; returns EXIT_DONE."""
    from deploy.config.file import effective_toml

    text = effective_toml(config)
    return answer(tomllib.loads(text), [text.removesuffix("\n")], as_json)


@contextmanager
def status_lines(
    seen: Callable[[Any], None], report: Callable[[], Mapping[str, Any]]
) -> Iterator[Callable[[Any], None]]:
    """Passes statuses on to ``seen``, and prints ``report`` after each as a line of JSON; all else goes to stderr."""
    out = sys.stdout

    def show(status: Any) -> None:
        seen(status)
        try:
            print(json.dumps(report(), allow_nan=False), file=out, flush=True)
        except BrokenPipeError:  # nobody reads any more, which does not end an agent
            os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())

    with redirect_stdout(sys.stderr):
        yield show


def closing_lines(warnings: Iterable[str], written: Iterable[object]) -> list[str]:
    """The last lines of a result: warnings, and the files that were written."""
    return [*(f"warning: {warning}" for warning in warnings), f"written: {', '.join(map(str, written))}"]


def parse_box(text: str) -> tuple[float, float, float, float]:
    """A bounding box ``x,y,w,h`` of --target [px]. Raises InputError."""
    from deploy.offline.track import parse_target

    box = parse_target(text)
    return box.x, box.y, box.width, box.height


def open_browser(address: str) -> None:
    """Open a browser, or say that there is none."""
    import webbrowser

    if not webbrowser.open(address):
        print("syncline: no browser could be opened here", file=sys.stderr)
