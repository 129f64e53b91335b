"""The `syncline` command: the table of commands, and how errors leave the process.

Commands are imported when they are called, so that `--help` costs a fraction of a second.
"""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn

# One thread a process: the solvers' matrices are small, agents share a board's cores, and sums that
# don't depend on the number of cores make the same bytes everywhere. Must stand before numpy is loaded.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from cyclopts import App, CycloptsError  # noqa: E402
from cyclopts.exceptions import UnknownCommandError  # noqa: E402

from protocols.core.errors import EXIT_BUG, EXIT_DONE, EXIT_INPUT, SynclineError  # noqa: E402
from protocols.core.version import VERSION  # noqa: E402

# name, where it lives, one line for the overview
COMMANDS: tuple[tuple[str, str, str], ...] = (
    ("demo", "deploy.commands.agents.demo:demo", "The main job on one machine, on simulated cameras."),
    ("simulate", "deploy.commands.offline.simulate:simulate", "Write a session of a shipped scene."),
    (
        "calibrate",
        "deploy.commands.offline.calibrate:calibrate",
        "Timing and poses of all cameras of a session or log.",
    ),
    (
        "triangulate",
        "deploy.commands.offline.triangulate:triangulate",
        "3-D of labelled points with a given calibration.",
    ),
    ("detect", "deploy.commands.offline.detect:detect", "One detector over one video."),
    ("intrinsics", "deploy.commands.offline.intrinsics:intrinsics", "A camera's lens from a video of a board."),
    ("sync", "deploy.commands.offline.sync:sync", "Reference times of all frames; videos that line up."),
    ("export", "deploy.commands.data.export:export", "Calibrations and paths in other tools' formats."),
    ("import", "deploy.commands.data.import_:import_", "Other tools' calibrations and tracks; a session as a log."),
    ("track", "deploy.commands.offline.track:track", "Follow one car from the air, also out of the picture."),
    ("report", "deploy.commands.offline.report:report", "One offline page on what an answer is worth."),
    ("quick", "deploy.commands.agents.quick:quick", "Calibrate two webcams without a configuration."),
    ("view", "deploy.commands.agents.view:view", "A rig in a browser: live, or a log with a timeline."),
    ("camera", "deploy.commands.agents.run:camera", "Camera agent: detect and publish."),
    ("uav", "deploy.commands.agents.run:uav", "UAV agent: follow a car, tell it by MAVLink."),
    ("hub", "deploy.commands.agents.run:hub", "Hub agent: gather, calibrate, track."),
    ("record", "deploy.commands.agents.run:record", "Recorder: everything on the bus into a log."),
    ("router", "deploy.commands.agents.router:router", "Router: relays between agents, and watches itself."),
    ("replay", "deploy.commands.data.logs:replay", "Play a log back onto the bus, or compare two."),
    ("recover", "deploy.commands.data.logs:recover", "Make a whole log of a damaged one."),
    ("info", "deploy.commands.data.logs:info", "What is in a log or a session."),
    ("keys", "deploy.commands.site.keys:KEYS", "Certificates: who may say and hear what."),
    ("install", "deploy.commands.site.install:install", "An agent as a systemd service."),
    ("uninstall", "deploy.commands.site.install:uninstall", "Take agents' services away."),
    ("fleet", "deploy.commands.site.fleet:fleet", "All agents of a rig on this machine."),
    ("bundle", "deploy.commands.site.bundle:bundle", "Wheels and a script for a board without a network."),
    ("doctor", "deploy.commands.site.doctor:doctor", "What is wrong with this machine, and what to do."),
)

_AGENTS = ("camera", "uav", "hub", "record", "router")


def build_app(called: str = "") -> App:
    """The command line application.

    called: the command about to run: its help is its docstring, while the others, which the overview only
    lists, keep their one line here and are not imported.
    """
    app = App(
        name="syncline",
        help="Turn cameras that share no clock into one measuring instrument.\n\n"
        "Try `syncline demo`, or `syncline calibrate SESSION --out out`.",
        version=VERSION,
        help_format="plaintext",
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    for name, place, text in COMMANDS:
        if name == called:
            app.command(place, name=name)
        else:
            app.command(place, name=name, help=text)
    return app


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 1 bug, 2 bad use or input, 3 refused."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        result = build_app(words[0] if words else "")(words, exit_on_error=False, print_error=False)
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
        print("syncline: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (a pager, head): nothing is wrong.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_DONE
    except OSError as error:
        # A full disk, a name that is too long, rights: the machine's state, not a bug.
        place = f"{error.filename}: " if error.filename else ""
        print(f"syncline: {place}{error.strerror or error}; check the path, the disk and its rights", file=sys.stderr)
        return EXIT_INPUT
    return result if isinstance(result, int) else EXIT_DONE


def _unknown_command(arguments: Sequence[str]) -> str:
    # Cyclopts' own text would import every command to suggest one.
    word = next((word for word in arguments if not word.startswith("-")), "")
    close = difflib.get_close_matches(word, [name for name, _, _ in COMMANDS], 1)
    return f"there is no command {word!r}" + (f": did you mean {close[0]}?" if close else "")


def _command_of(words: Sequence[str]) -> str:
    return f"{words[0]} " if words and words[0] in {name for name, _, _ in COMMANDS} else ""


def main() -> NoReturn:
    """Entry point of the console script."""
    status = run()
    if len(sys.argv) > 1 and sys.argv[1] in _AGENTS:
        # A thread that is stuck in the transport when the interpreter is taken down aborts the process: an agent
        # that ended in order would look as if it had crashed.
        with suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


__all__ = ["EXIT_BUG", "build_app", "main", "run"]
