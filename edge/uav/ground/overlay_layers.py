"""Overlay geometry that is computed only when it is read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from protocols.geometry.types import Floats


class LazyLayers(Mapping[str, Floats]):
    """Named points (n, 2) in image pixels. Valid until the tracker's next frame: read later, they show that frame."""

    def __init__(self, factories: Mapping[str, Callable[[], Floats]]) -> None:
        self._factories = dict(factories)

    def __getitem__(self, name: str) -> Floats:
        return self._factories[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._factories)

    def __len__(self) -> int:
        return len(self._factories)
