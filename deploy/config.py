"""What stands in an agent's configuration file, and how it is read, checked and printed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from deploy.config_file import Source, effective_toml, load
from protocols.bus.settings import BusConfig
from protocols.catalogue import valid_id
from protocols.errors import InputError

__all__ = [
    "BusConfig",
    "CameraConfig",
    "HubConfig",
    "MarkerConfig",
    "RecorderConfig",
    "SimulatedConfig",
    "Source",
    "VideoConfig",
    "effective_toml",
    "load",
]

Seconds = Annotated[float, Meta(gt=0.0, le=86_400.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Hertz = Annotated[float, Meta(gt=0.0, le=1000.0)]
Pixels = Annotated[float, Meta(gt=0.0, le=65_535.0)]
Byte = Annotated[int, Meta(ge=0, le=255)]
Seed = Annotated[int, Meta(ge=0)]


class _Strict(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An unknown key is an error: else a misspelt one would be a setting that silently does nothing."""


class _Agent(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every agent has. site: agents see only those of their own site."""

    site: str = "local"
    bus: BusConfig = msgspec.field(default_factory=BusConfig)

    def __post_init__(self) -> None:
        _check_id(self.site, "site")
        _check_id(getattr(self, "id", "ok"), "id")
        try:
            self.bus.endpoints()
        except InputError as error:
            raise ValueError(f"{error.what}; {error.remedy}") from None


class RecorderConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The recorder. out: the log to write; a folder gets a file named by the time of its start.

    part_s, part_mb: begin a new file, name-000.mcap, name-001.mcap, …, when the present one is so old or so large
    [MB]; None = one file. min_free_mb: recording ends, with a whole log, before less than this is free on the disk.
    foxglove: also write calibration, transforms, scene and annotations as Foxglove and rerun know them.
    """

    id: str = "recorder"
    out: Path = Path("recordings")
    part_s: Seconds | None = None
    part_mb: Annotated[float, Meta(ge=0.1, le=1e6)] | None = None
    min_free_mb: Annotated[float, Meta(ge=0.0, le=1e9)] = 200.0
    foxglove: bool = True


class SimulatedConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[simulated]: a camera of a shipped world.

    cameras: how many the world has, which also decides where they stand. duration_s: None = endless.
    start_unix_s: the Unix time of the world's true time 0; agents of one world must share it. None = the
    machine's start of the day, which agents on one machine share without being told.
    """

    scene: str = "marker"
    seed: Seed = 0
    cameras: Annotated[int, Meta(ge=2, le=64)] = 4
    duration_s: Seconds | None = None
    start_unix_s: Annotated[float, Meta(ge=0.0)] | None = None


class VideoConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[video]: a file, a stream or a USB camera through OpenCV. fps: None = what the source says."""

    source: Source
    fps: Hertz | None = None
    loop: bool = False


class MarkerConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[marker]: what the marker looks like; what is absent is taken from the picture.

    colour: sRGB, 0..255. min_size, max_size: diameter in the image [px].
    """

    label: Annotated[str, Meta(min_length=1, max_length=64)] = "marker"
    colour: tuple[Byte, Byte, Byte] | None = None
    min_size: Pixels | None = None
    max_size: Pixels | None = None


class CameraConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera agent. rig: a rig.toml to take this camera's intrinsics and known pose from."""

    id: str
    rig: Path | None = None
    driver: Literal["simulated", "video"] = "simulated"
    detector: Literal["marker"] = "marker"
    simulated: SimulatedConfig | None = None
    video: VideoConfig | None = None
    marker: MarkerConfig = msgspec.field(default_factory=MarkerConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.driver == "video" and self.video is None:
            raise ValueError('driver = "video" needs a [video] table with source = "…"')


class HubConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The hub. rig: what is known of the rig; out: where calibrations are written.

    window_s: how much of the past is solved together; interval_s: how often it is solved again. solve: false = this
    hub seeks no timing itself. nodes: cameras whose pose nodes run here whoever else is there; the others are shared
    out among all hubs. pose_nodes: false = none run here. leave_after_s: when a camera that has gone is forgotten.
    """

    id: str = "hub"
    rig: Path | None = None
    out: Path | None = None
    window_s: Seconds = 60.0
    interval_s: Seconds = 2.0
    solve: bool = True
    pose_nodes: bool = True
    nodes: tuple[str, ...] = ()
    leave_after_s: Seconds = 30.0


def _check_id(text: str, what: str) -> None:
    try:
        valid_id(text, what)
    except InputError as error:
        raise ValueError(f"{error.what}; {error.remedy}") from None
