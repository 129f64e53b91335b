"""Commands of Syncline as child processes, each with a log, stopped in order; termination of a process on signals."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import tomli_w

from protocols.core.errors import Refused
from protocols.core.files import check_folder

START_TIMEOUT_S, STOP_TIMEOUT_S = 60.0, 40.0
"""A board that is busy takes half a minute to start an agent; a hub solves once more before it stops."""


def start_process(words: Sequence[str], log: Path, *, new_session: bool = False) -> subprocess.Popen[bytes]:
    """Start ``syncline words...`` with its output appended to ``log``. new_session: Ctrl-C does not reach it."""
    with log.open("ab") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "deploy", *words],
            stdout=out,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=new_session,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )


def last_line(log: Path) -> str:
    """The last line that a process has written."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1].removeprefix("syncline: ") if lines else "no output"


def free_udp_port() -> int:
    """A UDP port of this machine that is free at this moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def kill_all(processes: Mapping[str, subprocess.Popen[bytes]]) -> None:
    """End what still runs, at once."""
    for process in processes.values():
        if process.poll() is None:
            process.kill()
            process.wait()


class AgentProcesses:
    """The agents of a demo in the folder ``out``: configurations in config/, output in logs/.

    outputs: files and folders of an earlier demo, which are removed. Raises InputError where ``out`` cannot be made.
    """

    def __init__(self, out: Path, outputs: Sequence[str], interruption: Interruption) -> None:
        self.logs, self._configs = out / "logs", out / "config"
        self._interruption = interruption
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        check_folder(out)
        for name in ("config", "logs", *outputs):
            if (out / name).is_dir():
                shutil.rmtree(out / name)
            else:
                (out / name).unlink(missing_ok=True)
        self._configs.mkdir(parents=True)
        self.logs.mkdir()

    def start(self, name: str, role: str, table: Mapping[str, Any]) -> None:
        """Start an agent with a configuration file, as a user would."""
        file = self._configs / f"{name}.toml"
        file.write_text(tomli_w.dumps(table), encoding="utf-8")
        self._run(name, [role, str(file)])

    def open_view(self, endpoint: str, port: int) -> str:
        """Start the live view; returns its address. Raises Refused if it does not come up."""
        self._run("view", ["view", "--connect", endpoint, "--site", "demo", "--port", str(port)])
        log, deadline = self.logs / "view.txt", time.monotonic() + 3.0 * START_TIMEOUT_S
        while time.monotonic() < deadline and self._running["view"].poll() is None:
            for line in log.read_text(encoding="utf-8").splitlines():
                if line.startswith("open http") and len(line.split()) > 1:
                    return line.split()[1]
            time.sleep(0.05)
        raise Refused(f"the view did not start: {last_line(log)}")

    def stop(self, *names: str) -> None:
        """Stop these one after the other. Raises Refused if one does not end, or ends with an error."""
        for name in names:
            process, log = self._running[name], self.logs / f"{name}.txt"
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            try:
                process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                raise Refused(f"{name} did not stop within {STOP_TIMEOUT_S:.0f} s; see {log}") from None
            self._check(name, ended=lambda status: status != 0)

    def check(self) -> None:
        """Raise KeyboardInterrupt if the demo was interrupted, and Refused if an agent has ended."""
        if self._interruption.is_set():
            raise KeyboardInterrupt
        for name in self._running:
            self._check(name, ended=lambda status: status is not None)

    def kill(self) -> None:
        """End what still runs."""
        kill_all(self._running)

    def _check(self, name: str, ended: Callable[[int | None], bool]) -> None:
        status = self._running[name].poll()
        if ended(status):
            raise Refused(f"{name} ended with status {status}: {last_line(self.logs / f'{name}.txt')}")

    def _run(self, name: str, words: Sequence[str]) -> None:
        with self._interruption.deferred():
            self._running[name] = start_process(words, self.logs / f"{name}.txt")


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and SIGINT set; a second signal terminates the process immediately.

    Call it on the main thread.
    """
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    return stop


class Interruption:
    """A termination request, and sections of code in which it is deferred."""

    def __init__(self) -> None:
        self._requested, self._deferring = False, False

    def is_set(self) -> bool:
        """Whether termination was requested."""
        return self._requested

    def request(self) -> None:
        """Record the request, and raise KeyboardInterrupt unless it is deferred."""
        self._requested = True
        if not self._deferring:
            raise KeyboardInterrupt

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Defer a request to the end of the block, so that a child process started in it is not orphaned."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        if self._requested:
            raise KeyboardInterrupt


def interrupt_on_signals() -> Interruption:
    """The interruption that SIGTERM, SIGHUP and SIGINT request as they raise KeyboardInterrupt; long waits poll it.

    Python discards an exception that is raised while an object is deleted, so the exception alone could be lost.
    """
    interruption = Interruption()

    def handle(number: int, frame: FrameType | None) -> None:
        interruption.request()

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, handle)
    return interruption
