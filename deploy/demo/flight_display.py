"""Progress display of the flight demo: a live bar on a terminal, otherwise periodic lines."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.live import Live

    from deploy.demo.flight import FlightProgress

_PRINT_INTERVAL_S = 2.0


class FlightDisplay:
    """Context manager that returns the function to call with the progress."""

    def __init__(self, seconds: float, *, quiet: bool) -> None:
        self._seconds, self._quiet = seconds, quiet
        self._printed = -_PRINT_INTERVAL_S
        self._line = ""
        self._live: Live | None = None

    def __enter__(self) -> Callable[[FlightProgress], None]:
        if not self._quiet and sys.stdout.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(), refresh_per_second=4, transient=True)
            self._live.__enter__()
        return self.show

    def __exit__(self, *details: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def show(self, progress: FlightProgress) -> None:
        """Display the current progress."""
        if self._quiet:
            return
        states = "  ".join(f"{name} {progress.states[name]}" for name in ("visible", "coasting", "lost"))
        if self._live is None:
            fresh = progress.elapsed == 0.0 and progress.line != self._line
            if fresh or progress.elapsed - self._printed >= _PRINT_INTERVAL_S:
                self._printed, self._line = progress.elapsed, progress.line
                print(f"{progress.elapsed:5.1f} s  {progress.line}  [{states}]", flush=True)
            return
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.text import Text

        self._live.update(
            Group(
                Text(f"tracking {progress.elapsed:4.0f} of {self._seconds:.0f} s"),
                ProgressBar(total=self._seconds, completed=min(progress.elapsed, self._seconds), width=60),
                Text(f"camera status: {progress.line}"),
                Text(f"frames: {states}"),
            )
        )
