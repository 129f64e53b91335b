"""When a hub's solver gets its next job, how much that searches, and which camera is left out of it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from hub.live.solver import SolverJob

_SEARCH_LOAD, _UPDATE_LOAD = 0.6, 0.2
"""CPU seconds of the solver per second before the first answer, and after it: a longer job is followed by a longer
pause."""
_SEARCH_EVERY_S = 4.0
"""Between two searches for cameras that are not tied."""
_FULL_EVERY_S, _FULL_GROWTH = 30.0, 1.5
"""Between two searches over all lags, and the growth of rows from which lenses are decided again."""
_FIRST_FULL_S = 60.0
"""Until the first search over all lags where times of arrival bound them: it takes several seconds, and at a right
arrival it finds nothing more."""
_LEFT_OUT_S = 60.0
"""How long a camera is left out without which the solver does not fail."""


@dataclass(slots=True)
class JobSchedule:
    """next: hub time [s] of the next job. solved_at: messages received at the last one. left_out: a camera without
    which the solver does not fail, or ""."""

    next: float = 0.0
    solved_at: int = -1
    left_out: str = ""
    _next_search: float = 0.0
    _next_full: float = 0.0
    _full_rows: int = 0
    _left_out_until: float = 0.0
    _suspects: list[str] = field(default_factory=list)

    def plan(
        self, now: float, *, final: bool, first: bool, untied: bool, rows: int, has_arrivals: bool
    ) -> tuple[bool, bool]:
        """Whether the job searches for cameras, and over all lags.

        final: the last job. first: no camera is tied yet; untied: some are not. rows: of the job. has_arrivals: times
        of arrival bound the lags.
        """
        search = untied and (final or now >= self._next_search)
        if first and has_arrivals and not self._next_full:
            self._next_full = now + _FIRST_FULL_S
        full = (search and (final or now >= self._next_full)) or (not first and rows > _FULL_GROWTH * self._full_rows)
        if search:
            self._next_search = now + _SEARCH_EVERY_S
        if full:
            self._next_full, self._full_rows = now + _FULL_EVERY_S, rows
        return search or first, full or (first and not has_arrivals)

    def pause(self, submitted_at: float, cpu_s: float, *, calibrated: bool) -> None:
        """Put the next job off after one that took so much CPU [s]."""
        self.next = max(self.next, submitted_at + cpu_s / (_UPDATE_LOAD if calibrated else _SEARCH_LOAD))

    def suspect(self, job: SolverJob, tied: Collection[str], now: float) -> None:
        """Leave one camera of a job that failed out, first those that are not tied, each in turn."""
        if not self._suspects:
            self._suspects = (
                sorted(job.rig.cameras, key=lambda name: name in tied) if len(job.rig.cameras) > 2 else [""]
            )
        self.left_out, self._left_out_until = self._suspects.pop(0), now + _LEFT_OUT_S

    def clear_suspects(self) -> None:
        """After a job that did not fail."""
        self._suspects = []

    def readmit(self, now: float) -> None:
        """Give a camera that was left out long enough another try."""
        if self.left_out and now >= self._left_out_until:
            self.left_out = ""
