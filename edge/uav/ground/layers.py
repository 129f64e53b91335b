"""What an overlay may draw, computed only if somebody asks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from protocols.geometry.types import Floats


class Layers(Mapping[str, Floats]):
    """Named points (n, 2) in image pixels. Good until the tracker's next frame: later it tells of that one."""

    def __init__(self, makers: Mapping[str, Callable[[], Floats]]) -> None:
        self._makers = dict(makers)

    def __getitem__(self, name: str) -> Floats:
        return self._makers[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)
