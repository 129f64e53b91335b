"""One command over many inputs on a dask scheduler: `syncline detect … --scheduler`, also calibrate, follow and track.

Each job is the ordinary command with one input and an --out of its own, in a process of its own on some worker, so its
files are those of one machine. The workers see the same folders under the same paths. What has ended is kept in
jobs.json of --out: the same call again does the rest, and what had failed.
"""

from __future__ import annotations

import importlib
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.offline.progress import progress_bar
from protocols.core.errors import EXIT_DONE, EXIT_INPUT, EXIT_REFUSED, InputError
from protocols.core.files import check_folder, read_text, write_atomically
from protocols.core.names import check_name

_WORDS_BEFORE = {"detect": 1}
"""By command, how many words stand before its input."""
_STATE = "jobs.json"
_CONNECT_S = 20.0  # s: a scheduler on the same network answers within one
_RETRIES = 1
"""Of a job whose worker was lost."""
_MAX_JOBS = 100_000  # of one command: a day of recordings of a thousand cameras
_TEXT = 300  # characters of a failure that are kept


@dataclass(frozen=True, slots=True)
class Job:
    """One run of a command. out: what it writes; words: of its command line."""

    name: str
    out: Path
    words: tuple[str, ...]


def run_jobs(words: Sequence[str], parse: Callable[[Sequence[str]], object]) -> int:
    """Run a command line with --scheduler; the exit status: 0, 3 if some were refused, 2 if some failed.

    parse: checks the words of one job and raises what the command line raises for them.
    """
    jobs, out = make_jobs(words)
    for job in jobs:
        parse(job.words)
    check_folder(out)
    done = {name: entry for name, entry in _read_state(out / _STATE).items() if name in {job.name for job in jobs}}
    left = [job for job in jobs if not _is_done(job, done.get(job.name))]
    quiet = "--json" in words
    if left:
        out.mkdir(parents=True, exist_ok=True)
        with progress_bar(words[0], quiet) as move, _client(_value(words, "--scheduler") or "") as client:
            move(f"{len(jobs) - len(left)} of {len(jobs)}", 1.0 - len(left) / len(jobs))
            for job, status, text in _finished(client, left):
                done[job.name] = {"status": status, "text": text, "command": list(job.words)}
                write_atomically(out / _STATE, json.dumps(done, indent=1, sort_keys=True, ensure_ascii=False) + "\n")
                if status != EXIT_DONE:
                    word = "refused" if status == EXIT_REFUSED else "failed"
                    print(f"{job.name}: {word}: {text}", file=sys.stderr)
                move(f"{len(done)} of {len(jobs)}", len(done) / len(jobs))
    statuses = [done[job.name]["status"] for job in jobs]
    counts = {word: statuses.count(status) for status, word in ((EXIT_DONE, "done"), (EXIT_REFUSED, "refused"))}
    counts["failed"] = len(jobs) - sum(counts.values())
    if quiet:
        print(json.dumps({"counts": counts, "jobs": done}, indent=1, sort_keys=True))
    else:
        again = f", {len(jobs) - len(left)} of them earlier" if len(left) < len(jobs) else ""
        print(f"{len(jobs)} jobs{again}: " + ", ".join(f"{count} {word}" for word, count in counts.items() if count))
    return EXIT_INPUT if counts["failed"] else EXIT_REFUSED if counts["refused"] else EXIT_DONE


def make_jobs(words: Sequence[str]) -> tuple[list[Job], Path]:
    """The jobs of a command line with --scheduler, by name, and the folder of --out."""
    command, given = words[0], _value(words, "--out")
    rest = _without(_without(words, "--scheduler"), "--out")
    before = _WORDS_BEFORE.get(command, 0)
    place = 1 + before
    if given is None or len(rest) <= place or any(word.startswith("-") for word in rest[1 : place + 1]):
        raise InputError(
            "--scheduler needs the inputs first, and --out",
            remedy=f"syncline {command} {'marker ' * before}INPUTS --out FOLDER --scheduler 4",
        )
    out, inputs = Path(given), _inputs(command, Path(rest[place]))
    jobs: dict[str, Job] = {}
    for path, options in inputs:
        name = check_name(path.stem if path.suffix else path.name, "name of an input", file=path)
        if name in jobs:
            raise InputError(f"two inputs are named {name}", file=path, remedy="rename one, or give them another --out")
        target = out / (f"{name}.csv" if command == "detect" else name)
        given_options = [word for word in (*rest[place + 1 :], *options) if word != "--json"]
        own = [word.replace("{name}", name) for word in given_options]
        jobs[name] = Job(name, target, (*rest[:place], str(path), *own, "--out", str(target)))
    return list(jobs.values()), out


def _inputs(command: str, given: Path) -> list[tuple[Path, list[str]]]:
    """Inputs with options of their own: the lines of a text file, or what a folder holds."""
    if given.suffix == ".txt":
        found = []
        for number, line in enumerate(read_text(given, "list of inputs").splitlines(), 1):
            try:
                words = shlex.split(line, comments=True)
            except ValueError as error:
                raise InputError(f"{error}", file=given, line=number, remedy="close the quotation") from None
            if words:
                found.append((Path(words[0]), words[1:]))
    elif given.is_dir():
        from edge.devices.playback.video_reader import VIDEO_SUFFIXES

        files = {".mcap"} if command in ("calibrate", "follow") else VIDEO_SUFFIXES
        paths = sorted(path for path in given.iterdir() if not path.name.startswith("."))
        found = [(path, []) for path in paths if path.is_dir() or path.suffix.lower() in files]
    else:
        raise InputError("neither a folder of inputs nor a list of them", file=given, remedy="name them in a .txt file")
    if not 0 < len(found) <= _MAX_JOBS:
        raise InputError(
            f"{len(found)} inputs", file=given, remedy=f"give 1 to {_MAX_JOBS}, a line each, in a .txt file"
        )
    return found


def _run_one(words: Sequence[str], folder: str) -> tuple[int, str]:
    """On a worker: exit status of one command and the last line that it said."""
    command = [sys.executable, "-m", "deploy", *words]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    lines = [line for line in result.stderr.splitlines() if line.strip()]
    status = result.returncode
    text = lines[-1].removeprefix("syncline: ") if lines and status != EXIT_DONE else ""
    return status, (text or (f"exit status {status}" if status else ""))[:_TEXT]


def _finished(client: Any, jobs: Sequence[Job]) -> Iterator[tuple[Job, int, str]]:
    """Jobs as they end, with exit status and the last line of what they said."""
    folder = str(Path.cwd())
    futures = {client.submit(_run_one, job.words, folder, pure=False, retries=_RETRIES): job for job in jobs}
    for future in _dask().as_completed(list(futures)):
        job = futures[future]
        if future.status == "finished":
            status, text = future.result()
        else:
            error = future.exception()
            status, text = 1, f"{type(error).__name__}: {' '.join(str(error).split())}"[:_TEXT]
        future.release()
        yield job, status, text


@contextmanager
def _client(given: str) -> Iterator[Any]:
    """A client of a scheduler: its address, its file, or a number of processes on this machine."""
    dask = _dask()
    if given.isdecimal():
        if not 1 <= int(given) <= 1024:
            raise InputError(f"--scheduler {given}", remedy="give 1 to 1024 processes, or an address")
        options = {"n_workers": int(given), "threads_per_worker": 1, "dashboard_address": ":0"}
        with dask.LocalCluster(**options) as cluster, dask.Client(cluster) as client:
            yield client
        return
    file = Path(given) if given.endswith(".json") else None
    try:
        client = dask.Client(timeout=_CONNECT_S, **({"scheduler_file": given} if file else {"address": given}))
    except (OSError, ValueError, TimeoutError) as error:
        what = f"no scheduler at {given}: {type(error).__name__}"
        raise InputError(what, remedy="give tcp://HOST:8786, a scheduler file, or a number of processes") from None
    with client:
        yield client


def _dask() -> Any:
    """dask.distributed, whose functions have no types."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        raise InputError("--scheduler needs dask.distributed", remedy="pip install 'syncline[cluster]'") from None


def _read_state(file: Path) -> dict[str, Any]:
    """What earlier calls have done; of a damaged file nothing."""
    if not file.is_file():
        return {}
    try:
        found = json.loads(read_text(file, "state of the jobs"))
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _is_done(job: Job, entry: Any) -> bool:
    """Whether an earlier call has run the same command to its end, and its files are there."""
    if not isinstance(entry, dict) or entry.get("command") != list(job.words):
        return False
    return entry.get("status") == EXIT_REFUSED or (entry.get("status") == EXIT_DONE and job.out.exists())


def _value(words: Sequence[str], option: str) -> str | None:
    for index, word in enumerate(words):
        if word == option:
            return words[index + 1] if index + 1 < len(words) else None
        if word.startswith(f"{option}="):
            return word.partition("=")[2]
    return None


def _without(words: Sequence[str], option: str) -> list[str]:
    out, skip = [], False
    for word in words:
        if skip:
            skip = False
        elif word == option:
            skip = True
        elif not word.startswith(f"{option}="):
            out.append(word)
    return out
