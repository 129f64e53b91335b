"""Progress display of the demos: a live bar on a terminal, otherwise a line every few seconds."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from rich.live import Live

_PRINT_INTERVAL_S = 5.0  # between two lines where there is no terminal to redraw


class ProgressDisplay:
    """Shows how far a demo of ``seconds`` has got. title: what it does. quiet: only the view's address is printed."""

    def __init__(self, title: str, seconds: float, *, quiet: bool) -> None:
        self._title, self._seconds, self._quiet = title, seconds, quiet
        self._printed, self._status = -_PRINT_INTERVAL_S, ""
        self._live: Live | None = None

    def __enter__(self) -> Self:
        if not self._quiet and sys.stdout.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(), refresh_per_second=4, transient=True)
            self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def announce(self, address: str) -> None:
        """Print where the live view is."""
        print(f"live view: open {address}", file=sys.stderr if self._quiet else sys.stdout, flush=True)

    def show(self, elapsed: float, status: str, counts: str = "") -> None:
        """Show the time [s] since the first frame, what happens now, and the counts so far."""
        if self._quiet:
            return
        if self._live is None:
            if elapsed - self._printed >= _PRINT_INTERVAL_S or (elapsed == 0.0 and status != self._status):
                self._printed, self._status = elapsed, status
                print(f"{elapsed:5.1f} s", *filter(None, (counts, status)), sep="  ", flush=True)
            return
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.text import Text

        bar = ProgressBar(total=self._seconds, completed=min(elapsed, self._seconds), width=60)
        title = Text(f"{self._title} {elapsed:4.0f} of {self._seconds:.0f} s")
        self._live.update(Group(title, bar, Text(counts), Text(status)))
