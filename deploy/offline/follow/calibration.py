"""The calibration that `syncline follow` is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, read_calibration, stated_calibration, stated_up
from protocols.session.rig import Rig

_ANY_SIZE = 1_000_000  # px: larger than any image, so that none is refused for its size


@dataclass(frozen=True, slots=True, eq=False)
class GivenCalibration:
    """A calibration.toml. rig: its tables. up: (3,) in its world; None = not given."""

    file: Path
    rig: Rig
    calibration: Calibration
    up: Floats | None

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """(width, height) of each calibrated camera's image [px]."""
        return {name: (c.intrinsics.width, c.intrinsics.height) for name, c in self.calibration.cameras.items()}

    @property
    def file_sizes(self) -> dict[str, tuple[int, int]]:
        """The same of all cameras that the calibration knows; a refused one has no table, and any size."""
        return {**dict.fromkeys(self.calibration.refused, (_ANY_SIZE, _ANY_SIZE)), **self.sizes}

    @property
    def names(self) -> list[str]:
        """The cameras that the calibration knows, refused ones included."""
        return [*self.calibration.cameras, *self.calibration.refused]


def read_given_calibration(file: Path) -> GivenCalibration:
    """Read calibration.toml. Raises InputError."""
    rig, cameras = read_calibration(file)
    calibration = stated_calibration(rig, cameras)
    return GivenCalibration(file, rig, calibration, stated_up(rig, cameras))
