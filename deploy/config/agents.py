"""Schemas of the agents' configuration files: common, camera, hub, recorder, router and view settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from deploy.config.file import DetectorName, KnownName, Source
from edge.devices.settings import Byte, Hertz, OakSettings, PiSettings, UsbSettings
from protocols.bus.settings import BusConfig
from protocols.core.errors import InputError
from protocols.core.names import check_identifier, check_name

Seconds = Annotated[float, Meta(gt=0.0, le=86_400.0)]
Pixels = Annotated[float, Meta(gt=0.0, le=65_535.0)]
Seed = Annotated[int, Meta(ge=0)]


class StrictConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all tables. Unknown keys are errors: a misspelt setting would otherwise silently have no effect."""


def check_address(key: str, value: str, example: int, *, beyond_loopback: bool = True, least: int = 0) -> str:
    """The host of "address:port". Raises ValueError if it is none, or if others could reach it and may not.

    example, least: a port to propose, and the smallest that is allowed.
    """
    host, _, port = value.rpartition(":")
    if not host or not port.isdigit() or not least <= int(port) <= 65_535:
        raise ValueError(f'{key} {value!r} is no address; write it like "127.0.0.1:{example}"')
    if not (beyond_loopback or host in ("localhost", "[::1]") or host.startswith("127.")):
        raise ValueError(f"{key} {value!r} is open to the network; take 127.0.0.1, or set beyond_loopback = true")
    return host


class HealthConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[health]: /metrics, /livez and /readyz over HTTP at ``listen``, "address:port".

    beyond_loopback: whether other machines may connect; there is no authentication.
    """

    listen: str = "127.0.0.1:9100"
    beyond_loopback: bool = False

    def __post_init__(self) -> None:
        check_address("listen", self.listen, 9100, beyond_loopback=self.beyond_loopback)


class AgentConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of every agent. site: agents see only agents of the same site. health: None = no HTTP."""

    site: str = "local"
    bus: BusConfig = msgspec.field(default_factory=BusConfig)
    health: HealthConfig | None = None

    def __post_init__(self) -> None:
        try:
            check_identifier(self.site, "site")
            check_name(getattr(self, "id", "ok"), "id")
            self.bus.endpoints()
        except InputError as error:
            raise ValueError(f"{error.what}; {error.remedy}") from None


class RouterConfig(AgentConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The router. bus: its mode is always "router"; `syncline keys` adds access and [bus.tls]."""

    id: str = "router"

    def __post_init__(self) -> None:
        if self.bus.mode == "client":
            raise ValueError('bus.mode of a router is "router"; remove the line')
        msgspec.structs.force_setattr(self, "bus", msgspec.structs.replace(self.bus, mode="router"))
        super().__post_init__()


class RecorderConfig(AgentConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The recorder. out: the log to write; in a folder, the file is named by its start time.

    part_s, part_mb: start a new file, name-000.mcap, name-001.mcap, …, when the current one reaches this age or size
    [MB]; None = one file. keep_days, keep_mb, keep_free_mb: the oldest closed files are deleted where they are older,
    together larger, or where less is free on the disk; None = never. min_free_mb, min_free_percent: where less than
    this is free, the log is completed, and the recorder waits for space.
    foxglove: also write images, calibration, transforms, scene and annotations in Foxglove's schemas, which rerun
    reads too. pictures_hz: largest rate at which thumbnails of each camera are recorded, 8 kB each; 0 = none, and none
    are requested from the cameras.
    """

    id: str = "recorder"
    out: Path = Path("recordings")
    part_s: Seconds | None = None
    part_mb: Annotated[float, Meta(ge=0.1, le=1e6)] | None = None
    keep_days: Annotated[float, Meta(gt=0.0, le=36_500.0)] | None = None
    keep_mb: Annotated[float, Meta(ge=1.0, le=1e9)] | None = None
    keep_free_mb: Annotated[float, Meta(gt=0.0, le=1e9)] | None = None
    min_free_mb: Annotated[float, Meta(ge=0.0, le=1e9)] = 200.0
    min_free_percent: Annotated[float, Meta(ge=0.0, le=100.0)] = 5.0
    foxglove: bool = True
    pictures_hz: Annotated[float, Meta(ge=0.0, le=30.0)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        keeps = [name for name in ("keep_days", "keep_mb", "keep_free_mb") if getattr(self, name) is not None]
        if keeps and self.part_s is None and self.part_mb is None:
            raise ValueError(
                f"{keeps[0]} needs parts, because the file that is being written is never deleted; add part_mb = 100.0"
            )
        if self.keep_mb is not None and self.part_mb is not None and self.part_mb > self.keep_mb:
            raise ValueError("keep_mb is less than one part; make part_mb smaller")


class SimulatedConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[simulated]: a camera of a simulated scene.

    cameras: number of cameras in the scene, which also determines their poses. duration_s: None = endless.
    start_unix_s: the Unix time of true time 0 in the scene; agents of one scene must share it. None = the start of
    the current day, which agents on one machine share without configuration. camera: which camera of the scene this
    is; None = the one named like the agent's id. width, fps: of all its images [px, Hz], instead of the scene's.
    """

    scene: str = "marker"
    seed: Seed = 0
    cameras: Annotated[int, Meta(ge=2, le=64)] = 4
    duration_s: Seconds | None = None
    start_unix_s: Annotated[float, Meta(ge=0.0)] | None = None
    camera: str | None = None
    width: Annotated[int, Meta(ge=64, le=7680)] | None = None
    fps: Hertz | None = None


class VideoConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[video]: a file, a stream or a USB camera through OpenCV. fps: None = the rate that the source reports."""

    source: Source
    fps: Hertz | None = None
    loop: bool = False


class UsbConfig(UsbSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[usb]: a V4L2 camera; see there. device: relative paths are the file's own folder's."""

    device: Source = Source("/dev/video0")


class RtspConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[rtsp]: a network camera: RTSP, or motion JPEG over HTTP.

    url: rtsp://user:password@address/path or http://…. transport: tcp loses no packets, udp has a little less latency.
    fps: None = the rate that the stream reports.
    """

    url: Annotated[str, Meta(pattern=r"^[a-z0-9]+://[^\s]+$", max_length=2048)]
    transport: Literal["tcp", "udp"] = "tcp"
    fps: Hertz | None = None


class LogConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[log]: the images of one camera in a recorded log.

    file: the log, or the folder of its parts. camera: its name in the log; None = the agent's id. fast: play as fast
    as images can be read; otherwise at the rate at which they were taken.
    """

    file: Path
    camera: Annotated[str, Meta(min_length=1, max_length=64)] | None = None
    fast: bool = False


class MarkerConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[marker]: appearance of the marker; values that are absent are estimated from the image.

    mode: "colour", one ball of a uniform colour; "bright", an LED or a retro-reflector beside a lamp; "tag", AprilTags
    or ArUco tags, each labelled by its number, as in tag7. colour: sRGB of the ball, 0..255. threshold: grey level that
    a bright marker exceeds. dictionary: family of the tags. min_size, max_size: diameter, or side of a tag [px].
    """

    label: Annotated[str, Meta(min_length=1, max_length=64)] = "marker"
    mode: Literal["colour", "bright", "tag"] = "colour"
    colour: tuple[Byte, Byte, Byte] | None = None
    threshold: Annotated[int, Meta(ge=30, le=254)] = 200
    dictionary: Annotated[str, Meta(pattern=r"^[0-9a-z_]{1,32}\Z")] = "apriltag_36h11"
    min_size: Pixels | None = None
    max_size: Pixels | None = None


class MovingConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[moving]: background subtraction for people and vehicles.

    background: the background model. camera: for vehicles, whether the camera is fixed or moving; people need a fixed
    one.
    """

    background: Literal["mog2", "knn"] = "mog2"
    camera: Literal["auto", "fixed", "moving"] = "auto"


class CameraConfig(AgentConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera agent. rig: a rig.toml with this camera's intrinsics and known pose.

    detector: marker, person, vehicle, the .toml file of an ONNX network, or a detector that another package registers.

    pictures_hz: rate of thumbnails on the bus while a view or a recorder subscribes to them; 0 = never.
    picture_width: width of the thumbnails [px].
    """

    id: str
    rig: Path | None = None
    pictures_hz: Annotated[float, Meta(ge=0.0, le=30.0)] = 2.0
    picture_width: Annotated[int, Meta(ge=64, le=640)] = 320
    driver: Literal["simulated", "video", "usb", "picamera2", "rtsp", "oak", "log"] = "simulated"
    detector: DetectorName = DetectorName("marker")
    simulated: SimulatedConfig | None = None
    video: VideoConfig | None = None
    usb: UsbConfig | None = None
    picamera2: PiSettings | None = None
    rtsp: RtspConfig | None = None
    oak: OakSettings | None = None
    log: LogConfig | None = None
    marker: MarkerConfig = msgspec.field(default_factory=MarkerConfig)
    moving: MovingConfig = msgspec.field(default_factory=MovingConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.driver == "video" and self.video is None:
            raise ValueError('driver = "video" needs a [video] table with source = "…"')
        if self.driver == "rtsp" and self.rtsp is None:
            raise ValueError('driver = "rtsp" needs an [rtsp] table with url = "rtsp://…"')
        if self.driver == "log" and self.log is None:
            raise ValueError('driver = "log" needs a [log] table with file = "….mcap"')


class HubConfig(AgentConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The hub. rig: a rig.toml with what is known of the rig; out: folder in which calibrations are written.

    state: folder in which the last ``history`` answers are kept, so that a hub that was killed goes on from the last
    one; default: in ``out``, else in the user's state folder. window_s: total duration of the kept observations;
    interval_s: least time between two solves. solve:
    false = this hub does not estimate timing itself. nodes: cameras whose pose nodes always run on this hub; the others
    are distributed among all hubs. pose_nodes: whether pose nodes run here; default:
    where this hub does not solve, or ``nodes`` names some. leave_after_s: time after which a camera that has
    disappeared is removed. known: a calibration.toml whose poses, intrinsics and clocks are kept fixed; nothing is
    solved then. known = "last": the last answer of this hub, however old, is used until the rows give a new one, also
    where cameras were restarted since. track: whether people, vehicles and unlabelled markers are tracked.
    refine_lenses: whether measured lenses may change, as `calibrate --refine-lenses`. sharded: whether this hub shares
    the site's cameras with all others that say so, by their overlap.
    """

    id: str = "hub"
    rig: Path | None = None
    out: Path | None = None
    state: Path | None = None
    history: Annotated[int, Meta(ge=1, le=100_000)] = 200
    window_s: Seconds = 180.0
    interval_s: Seconds = 2.0
    solve: bool = True
    pose_nodes: bool | None = None
    nodes: tuple[str, ...] = ()
    leave_after_s: Seconds = 30.0
    known: KnownName | None = None
    track: bool = True
    refine_lenses: bool = False
    sharded: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sharded and (not self.solve or self.known is not None):
            raise ValueError("sharded hubs calibrate their groups themselves; remove solve = false and known")


class ViewConfig(AgentConfig, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """The part of any agent's file that a view uses: its site and the bus settings; all other keys are ignored."""
