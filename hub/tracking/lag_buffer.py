"""Fixed-lag buffer for out-of-sequence rows: a late row is inserted in order and the later ones are reprocessed."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

Key = tuple[int, str, str, int]
"""Reference time [ns], camera, boot id, sequence: the order of processing, whatever the order of arrival."""


class HasKey(Protocol):
    """A row or frame with its place in the order of processing."""

    @property
    def key(self) -> Key:
        """Reference time [ns], camera, boot id, sequence."""


Row = TypeVar("Row", bound=HasKey)
State = TypeVar("State")


class LagBuffer(Generic[Row, State]):
    """The newest rows, and the state after each.

    process: the state after one more row, a pure function. lag_ns: how far behind the newest row a row may be and still
    be used: the present state depends only on these rows, not on their order of arrival. keep_ns >= lag_ns: how long
    rows and states are kept.
    """

    def __init__(self, base: State, process: Callable[[State, Row], State], lag_ns: int, keep_ns: int) -> None:
        self.base = base
        self.rows: list[Row] = []
        self.counts: Counter[str] = Counter()
        """Rows by camera."""
        self.states: list[State] = []
        self._process, self._lag_ns, self._keep_ns = process, lag_ns, keep_ns
        self._keys: list[Key] = []
        self._base_key: Key | None = None

    @property
    def state(self) -> State:
        """The state after all processed rows."""
        return self.states[-1] if self.states else self.base

    @property
    def newest_ns(self) -> int | None:
        """Reference time of the newest row, processed or not."""
        if self._keys:
            return self._keys[-1][0]
        return None if self._base_key is None else self._base_key[0]

    def count_until(self, time_ns: int) -> int:
        """How many rows are older than a reference time."""
        return bisect_left(self._keys, (time_ns, "", "", 0))

    def insert(self, row: Row) -> str:
        """Insert a row; "rows" or "reordered" if it is used, else "late" or "duplicates". `advance` processes it."""
        key, newest = row.key, self.newest_ns
        late = newest is not None and key[0] < newest - self._lag_ns
        if late or (self._base_key is not None and key <= self._base_key):
            return "late"
        position = bisect_left(self._keys, key)
        if position < len(self._keys) and self._keys[position] == key:
            return "duplicates"
        self._keys.insert(position, key)
        self.rows.insert(position, row)
        self.counts[key[1]] += 1
        del self.states[position:]
        return "rows" if position == len(self._keys) - 1 else "reordered"

    def advance(self) -> int:
        """Process all pending rows in order; the number of processed rows."""
        begun = len(self.states)
        for row in self.rows[begun:]:
            self.states.append(self._process(self.state, row))
        return len(self.rows) - begun

    def forget(self) -> None:
        """Drop the processed rows that are older than ``keep_ns``."""
        if self._keys:
            self._drop(self.count_until(self._keys[-1][0] - self._keep_ns))

    def commit(self) -> None:
        """Make the present state the base: the processed rows will not be processed again."""
        self._drop(len(self.states))

    def _drop(self, count: int) -> None:
        count = min(count, len(self.states))
        if count:
            self.base, self._base_key = self.states[count - 1], self._keys[count - 1]
            self.counts -= Counter(key[1] for key in self._keys[:count])
            del self._keys[:count], self.rows[:count], self.states[:count]

    def restart(self, base: State, rows: Iterable[Row]) -> None:
        """Process other rows from another base at the same time; those before it are dropped."""
        self.base, self.states = base, []
        after = self._base_key
        self.rows = sorted((row for row in rows if after is None or row.key > after), key=lambda row: row.key)
        self._keys = [row.key for row in self.rows]
        self.counts = Counter(key[1] for key in self._keys)

    def clear(self, base: State) -> None:
        """Forget all rows and begin with a base at any time."""
        self._base_key = None
        self.restart(base, ())
