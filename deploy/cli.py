"""The `syncline` command line: the table of subcommands and the mapping from exceptions to exit statuses.

Subcommands are imported when they are called, so that `--help` takes a fraction of a second.
"""

from __future__ import annotations

import difflib
import gc
import io
import os
import resource
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn

# One BLAS thread per process: the solvers' matrices are small, agents share the cores of one board, and summation
# orders that don't depend on the number of cores give identical bytes everywhere. Must run before numpy is imported.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
# 400 MB: the header of a small file may claim eight times as many. Must be set before cv2 is imported.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet: what is wrong with a video is said in one line

EXIT_INTERRUPTED, _INTERRUPTED = 130, "syncline: interrupted"
gc.disable()  # nothing of what is imported is garbage: to search it took a thirtieth of a short command's time
try:
    from cyclopts import App, CycloptsError
    from cyclopts.exceptions import UnknownCommandError

    from protocols.core.errors import EXIT_BUG, EXIT_DONE, EXIT_INPUT, SynclineError
    from protocols.core.version import VERSION
except KeyboardInterrupt:  # the imports are a short command's longest part
    print(_INTERRUPTED, file=sys.stderr)
    raise SystemExit(EXIT_INTERRUPTED) from None
gc.freeze()
gc.enable()

# Name, module below deploy.commands and function, one-line summary for the overview.
COMMANDS: tuple[tuple[str, str, str], ...] = (
    ("demo", "agents.demo:demo", "Calibrate simulated cameras on this machine and compare with the ground truth."),
    ("simulate", "offline.simulate:simulate", "Write a session of a simulated scene with its ground truth."),
    (
        "calibrate",
        "offline.calibrate:calibrate",
        "Estimate clock offsets and poses of all cameras of a session or log.",
    ),
    ("follow", "offline.follow:follow", "Follow people or vehicles through all cameras, offline."),
    ("triangulate", "offline.triangulate:triangulate", "Triangulate labelled points with a given calibration."),
    ("detect", "offline.detect:detect", "Run one detector on one video."),
    ("intrinsics", "offline.intrinsics:intrinsics", "Calibrate a camera's intrinsics from a video of a board."),
    ("sync", "offline.sync:sync", "Reference times of all frames, and synchronised copies of the videos."),
    ("export", "data.export:export", "Write calibrations and trajectories in other tools' formats."),
    ("import", "data.import_:import_", "Read other tools' calibrations and tracks, or convert a session to a log."),
    ("track", "offline.track:track", "Track one target from the air, also while it is out of view."),
    ("report", "offline.report:report", "Write a self-contained HTML report on the quality of a calibration."),
    ("quick", "agents.quick:quick", "Calibrate two webcams without a configuration."),
    ("view", "agents.view:view", "Show a rig in a browser: live, or a log with a timeline."),
    ("camera", "agents.run:camera", "Camera agent: detect and publish."),
    ("uav", "agents.run:uav", "UAV agent: track a car and report it over MAVLink."),
    ("hub", "agents.run:hub", "Hub agent: collect observations, calibrate, track."),
    ("record", "agents.run:record", "Recorder: write all bus messages to a log."),
    ("router", "agents.router:router", "Router: relay messages between agents, with a self-test."),
    ("replay", "data.logs:replay", "Play a log back onto the bus, or compare two."),
    ("recover", "data.logs:recover", "Recover a damaged log."),
    ("info", "data.logs:info", "Show the contents of a log or a session."),
    ("keys", "site.keys:KEYS", "Certificates and access rules of a site."),
    ("install", "site.machine:install", "Install an agent as a systemd service."),
    ("uninstall", "site.machine:uninstall", "Remove the agents' systemd services."),
    ("site", "site.site:SITE", "Enrol, update, renew and watch all boards of a site."),
    ("fleet", "site.fleet:fleet", "Run all agents of a rig on this machine."),
    ("bundle", "site.machine:bundle", "Collect wheels and an install script for a board without a network."),
    ("doctor", "site.machine:doctor", "Diagnose this machine and its agents, with a remedy for each problem."),
)

_NO_MEMORY = ("failed to map segment", "cannot allocate memory", "Cannot allocate memory", "can't start new thread")
"""What the loader of libraries and the threads say of it."""
_LEAST_ADDRESS_SPACE = 768 << 20
"""Bytes of a limit (`ulimit -v`) for commands that compute: with 350 to 500 MB, OpenBLAS waits for memory for ever or
ends the process."""
_COMPUTING = frozenset(
    ("calibrate", "camera", "demo", "detect", "follow", "hub", "intrinsics", "quick", "sync", "track", "triangulate")
    + ("replay", "uav")
)
_SPREADABLE = ("detect", "calibrate", "follow", "track")
_AGENTS = ("camera", "uav", "hub", "record", "router")


def build_app(called: str = "") -> App:
    """Build the command line application.

    called: the subcommand about to run. Its help is its docstring; the others are only listed in the overview with
    their one-line summary and are not imported.
    """
    app = App(
        name="syncline",
        help="Calibrate and synchronise cameras that share no clock, and track with them.\n\n"
        "Try `syncline demo`, or `syncline calibrate SESSION --out out`.",
        version=VERSION,
        help_format="markdown",
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for name, place, text in COMMANDS:
        app.command(f"deploy.commands.{place}", name=name, **({} if name == called else {"help": text}))
    return app


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand and return its exit status: 0 done, 1 bug, 2 wrong usage or input, 3 refused."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if words[:1] and words[0] in _COMPUTING and limit != resource.RLIM_INFINITY and limit < _LEAST_ADDRESS_SPACE:
            raise MemoryError
        app = build_app(words[0] if words else "")
        if "--scheduler" in {word.partition("=")[0] for word in words[1:]} and words[0] in _SPREADABLE:
            from deploy.cluster import run_jobs

            return run_jobs(words, lambda one: app.parse_args(list(one), exit_on_error=False, print_error=False))
        result = app(words, exit_on_error=False, print_error=False)
    except SynclineError as error:
        print(f"syncline: {error}", file=sys.stderr)
        return error.exit_status
    except CycloptsError as error:
        if isinstance(error, UnknownCommandError):
            text = _unknown_command(words)
        else:
            text = " ".join(str(error).split()).rstrip(".")
        command = "" if isinstance(error, UnknownCommandError) else _command_of(words)
        print(f"syncline: {text}; see `syncline {command}--help`", file=sys.stderr)
        return EXIT_INPUT
    except KeyboardInterrupt:
        print(_INTERRUPTED, file=sys.stderr)
        return EXIT_INTERRUPTED
    except (BrokenPipeError, SystemExit):
        # The reader of our output has closed the pipe (a pager, head): not an error. Rich exits for it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_DONE
    except UnicodeEncodeError as error:
        name = error.object.encode(errors="backslashreplace").decode()
        print(f"syncline: {name}: not a file name in this locale; set LC_ALL=C.UTF-8", file=sys.stderr)
        return EXIT_INPUT
    except (MemoryError, ImportError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not any(words in str(error) for words in _NO_MEMORY):
            raise
        print("syncline: out of memory; give it more, or less to do", file=sys.stderr)
        return EXIT_INPUT
    except OSError as error:
        # A full disk, a file name that is too long, missing permissions: the state of the machine, not a bug.
        place = f"{error.filename}: " if error.filename else ""
        print(f"syncline: {place}{error.strerror or error}; check path, disk and permissions", file=sys.stderr)
        return EXIT_INPUT
    return result if isinstance(result, int) else EXIT_DONE


def _unknown_command(arguments: Sequence[str]) -> str:
    # Cyclopts would import every subcommand to suggest one.
    words = [word for word in arguments if not word.startswith("-")]
    known = {name for name, _, _ in COMMANDS}
    if words and words[0] in known:  # a command of commands, as `keys`
        unknown = words[1] if len(words) > 1 else ""
        return f"there is no command {unknown!r} of `{words[0]}`; see syncline {words[0]} --help"
    word = words[0] if words else ""
    close = difflib.get_close_matches(word, known, 1)
    return f"there is no command {word!r}" + (f": did you mean {close[0]}?" if close else "")


def _command_of(words: Sequence[str]) -> str:
    return f"{words[0]} " if words and words[0] in {name for name, _, _ in COMMANDS} else ""


def main() -> NoReturn:
    """Entry point of the console script."""
    for name, place in (("stdin", 0), ("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:  # closed by who started it; the next file opened would take its place
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, open(place, "r" if place == 0 else "w", encoding="utf-8", closefd=False))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal without UTF-8 shows what it cannot print as an escape
        sys.stdout.reconfigure(errors="backslashreplace")
    status = run()
    command = sys.argv[1] if len(sys.argv) > 1 else ""
    if command in (*_AGENTS, "calibrate"):
        # A thread that blocks in the transport during interpreter shutdown aborts the process: an agent that has
        # stopped cleanly would look as if it had crashed. And taking all modules apart costs a twentieth of a second.
        with suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    if command in _AGENTS:
        os._exit(status)
    sys.exit(status)


__all__ = ["EXIT_BUG", "build_app", "main", "run"]
