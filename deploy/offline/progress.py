"""Progress bar on standard error, so that standard output stays usable for pipes and --json."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float], None]
"""Called with what is done now and the share, 0..1, of the whole."""


@contextmanager
def progress_bar(title: str, quiet: bool = False) -> Iterator[Progress]:
    """A bar moved by the yielded ``move(text, share)``, share 0..1; not drawn if standard error is not a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda text, share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(title, total=1.0)

        def move(text: str, share: float) -> None:
            progress.update(task, completed=share, description=f"{title}: {text}")

        yield move
