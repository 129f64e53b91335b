"""`syncline demo`: the whole line on one machine, ending with recovered against true."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from protocols.errors import EXIT_DONE, EXIT_REFUSED, InputError

if TYPE_CHECKING:
    from rich.live import Live as RichLive

    from deploy.demo import Live


def demo(
    *,
    seconds: float = 30.0,
    cameras: int = 3,
    scene: Literal["marker", "people", "town"] = "marker",
    out: Path = Path("demo-out"),
    view: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 1,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Film a simulated marker with cameras that share no clock, find clocks and places, compare with the truth.

    Cameras, hub and recorder are processes that talk over Zenoh on this machine. Ends with a table of recovered against
    true, the log demo.mcap and report.html in --out. Exit status 3 if the errors are larger than promised.

    Example: syncline demo --cameras 4 --seconds 40 --out demo-out

    Parameters
    ----------
    seconds
        How long to film.
    cameras
        How many cameras, 2 to 20.
    scene
        marker: a marker waved in a room. people and town come with later versions.
    out
        Folder for the results.
    view
        Open the live view (comes with a later version).
    seed
        Of the simulated world: same seed, same cameras and motion.
    json
        Print the table as JSON.
    """
    if scene != "marker":
        raise InputError(f"--scene {scene} is not in this version", remedy="use --scene marker")
    if view:
        raise InputError("--view is not in this version", remedy="open report.html in --out when the demo has ended")
    if seed < 0:
        raise InputError(f"--seed {seed} is negative", remedy="give 0 or more")
    if not 2 <= cameras <= 20:
        raise InputError(f"--cameras {cameras} is out of range", remedy="give 2 to 20")
    if not 5.0 <= seconds <= 3600.0:
        raise InputError(f"--seconds {seconds:g} is out of range", remedy="give 5 to 3600")
    from deploy.comparison import compare_with_truth
    from deploy.demo import DemoSettings, Fleet

    fleet = Fleet(DemoSettings(scene, seed, cameras, seconds, out))
    with _display(seconds, fleet.names, quiet=json) as show:
        live = fleet.run(show)
    comparison = compare_with_truth(out, scene, seed, cameras)
    if json:
        print(comparison.as_json(live.first_calibration_s))
    else:
        comparison.print(live.first_calibration_s, out)
    return EXIT_DONE if comparison.good else EXIT_REFUSED


class _display:
    """Live progress: a bar, and what each camera has seen. On a terminal it redraws, elsewhere it prints lines."""

    def __init__(self, seconds: float, names: list[str], quiet: bool) -> None:
        self._seconds, self._names, self._quiet = seconds, names, quiet
        self._printed = -10.0
        self._live: RichLive | None = None

    def __enter__(self):  # type: ignore[no-untyped-def]
        if not self._quiet and sys.stdout.isatty():
            from rich.console import Console
            from rich.live import Live as RichLive

            self._live = RichLive(console=Console(), refresh_per_second=4, transient=True)
            self._live.__enter__()
        return self.show

    def __exit__(self, *details: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def show(self, live: Live) -> None:
        """Draw the state."""
        if self._quiet:
            return
        seen = "  ".join(
            f"{name} {live.detections.get(name, 0)}/{live.observations.get(name, 0)}" for name in self._names
        )
        if self._live is None:
            if live.elapsed - self._printed >= 5.0:
                self._printed = live.elapsed
                print(f"{live.elapsed:5.1f} s  {seen}  {live.status}", flush=True)
            return
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.text import Text

        self._live.update(
            Group(
                Text(f"filming {live.elapsed:4.0f} of {self._seconds:.0f} s"),
                ProgressBar(total=self._seconds, completed=min(live.elapsed, self._seconds), width=60),
                Text(f"marker seen / frames: {seen}"),
                Text(live.status),
            )
        )
