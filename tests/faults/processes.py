"""Processes and links for the fault tests."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from protocols.bus.router.zenoh_router import free_endpoint

ROOT = Path(__file__).resolve().parents[2]


class Process:
    """A child that speaks lines; killed at the end of the context whatever happens."""

    def __init__(self, *words: str, namespace: str = "", stderr: Path | None = None) -> None:
        prefix = ["ip", "netns", "exec", namespace] if namespace else []
        self._errors = subprocess.DEVNULL if stderr is None else stderr.open("ab")
        self.child = subprocess.Popen(
            [*prefix, sys.executable, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT), "RUST_BACKTRACE": "0"},
        )

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.child.poll() is None:
            self.child.kill()
        self.child.wait()
        for pipe in (self.child.stdin, self.child.stdout):
            if pipe is not None:
                pipe.close()
        if not isinstance(self._errors, int):
            self._errors.close()

    def line(self) -> str:
        assert self.child.stdout is not None
        return self.child.stdout.readline()

    def ready(self) -> dict[str, Any]:
        """The first line, as JSON."""
        text = self.line()
        assert text, f"{self.child.args} said nothing (status {self.child.poll()})"
        return dict(json.loads(text))

    def ask(self, word: str = "report") -> dict[str, Any]:
        """One line in, one line of JSON out."""
        assert self.child.stdin is not None
        self.child.stdin.write(f"{word}\n")
        self.child.stdin.flush()
        return self.ready()


def publisher(endpoint: str, camera: str = "cam0", hz: float = 30.0, outage_s: float = 60.0, **more: Any) -> Process:
    return Process("-m", "tests.faults.endpoints", "publish", endpoint, camera, str(hz), str(outage_s), **more)


def receiver(endpoint: str, **more: Any) -> Process:
    return Process("-m", "tests.faults.endpoints", "receive", endpoint, **more)


def router(folder: Path, endpoint: str, namespace: str = "") -> Process:
    """`syncline router`, up when its first line is read."""
    config = folder / f"router-{endpoint.rpartition(':')[2]}.toml"
    config.write_text(f'[bus]\nlisten = ["{endpoint}"]\n', encoding="utf-8")
    process = Process("-m", "deploy", "router", str(config), namespace=namespace, stderr=folder / "router.txt")
    assert process.line().startswith("relays at")
    return process


@contextmanager
def flow(folder: Path) -> Iterator[tuple[str, Process, Process, Process]]:
    """An endpoint with its router, a receiver, and a camera at 30 Hz."""
    endpoint = free_endpoint()
    with router(folder, endpoint) as routing, receiver(endpoint) as receiving, publisher(endpoint) as sending:
        receiving.ready()
        assert sending.ready()["ready"]
        yield endpoint, routing, receiving, sending


def wait_until(condition: Any, timeout_s: float = 20.0) -> float:
    """Seconds until ``condition()`` is true; fails when the time is up."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < timeout_s, "the time is up"
        time.sleep(0.01)
    return time.monotonic() - began


class Link:
    """What `tests.faults.impair` does to the packets between two namespaces."""

    def __init__(self, control: Path) -> None:
        self._control = control

    def set(self, **rules: float) -> None:
        temporary = self._control.with_suffix(".new")
        temporary.write_text(json.dumps(rules), encoding="utf-8")
        temporary.replace(self._control)


def _ip(*words: str) -> bool:
    return subprocess.run(["ip", *words], capture_output=True, check=False).returncode == 0


@contextmanager
def bad_link(folder: Path) -> Iterator[tuple[str, str, Link]]:
    """Two namespaces with a link between them; skips, loudly, where the system does not permit it."""
    names = (f"sa{os.getpid()}", f"sb{os.getpid()}")
    if not all(_ip("netns", "add", name) for name in names):
        for name in names:
            _ip("netns", "del", name)
        pytest.skip("NOT TRIED: network namespaces are not permitted here (needs root and CAP_NET_ADMIN)")
    with ExitStack() as stack:
        for name in names:
            stack.callback(_ip, "netns", "del", name)
            _ip("-n", name, "link", "set", "lo", "up")
        link = Link(folder / "link.json")
        link.set()
        process = stack.enter_context(Process("-m", "tests.faults.impair", *names, str(folder / "link.json")))
        if process.line() != "ready\n":
            pytest.skip("NOT TRIED: no TUN devices here")
        yield names[0], names[1], link


def rows(values: Sequence[float], share: float) -> float:
    """A quantile."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
