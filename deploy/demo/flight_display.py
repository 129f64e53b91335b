"""The flight demo while it runs: on a terminal a bar that redraws, elsewhere a line now and then."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.live import Live

    from deploy.demo.flight import Progress

_EVERY_S = 2.0


class Display:
    """Use as a context; entering gives what is to be told of the progress."""

    def __init__(self, seconds: float, *, quiet: bool) -> None:
        self._seconds, self._quiet = seconds, quiet
        self._printed = -_EVERY_S
        self._line = ""
        self._live: Live | None = None

    def __enter__(self) -> Callable[[Progress], None]:
        if not self._quiet and sys.stdout.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(), refresh_per_second=4, transient=True)
            self._live.__enter__()
        return self.show

    def __exit__(self, *details: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def show(self, progress: Progress) -> None:
        """Draw the state."""
        if self._quiet:
            return
        states = "  ".join(f"{name} {progress.states[name]}" for name in ("visible", "coasting", "lost"))
        if self._live is None:
            fresh = progress.elapsed == 0.0 and progress.line != self._line
            if fresh or progress.elapsed - self._printed >= _EVERY_S:
                self._printed, self._line = progress.elapsed, progress.line
                print(f"{progress.elapsed:5.1f} s  {progress.line}  [{states}]", flush=True)
            return
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.text import Text

        self._live.update(
            Group(
                Text(f"following {progress.elapsed:4.0f} of {self._seconds:.0f} s"),
                ProgressBar(total=self._seconds, completed=min(progress.elapsed, self._seconds), width=60),
                Text(f"the camera says: {progress.line}"),
                Text(f"frames: {states}"),
            )
        )
