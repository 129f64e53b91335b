"""Resources that a ``with`` block closes."""

from __future__ import annotations

from typing import Self


class Closing:
    """Base of what is opened when it is made, and closed at the end of a ``with`` block."""

    def close(self) -> None:
        """Release it."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
