"""What stands in an agent's configuration file, and how it is read, checked and printed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from deploy.config.file import Source, effective_toml, load
from protocols.bus.settings import BusConfig
from protocols.core.errors import InputError
from protocols.topics import valid_id

__all__ = [
    "BusConfig",
    "CameraConfig",
    "HealthConfig",
    "HubConfig",
    "LogConfig",
    "MarkerConfig",
    "MovingConfig",
    "OakConfig",
    "PiConfig",
    "RecorderConfig",
    "RouterConfig",
    "RtspConfig",
    "SimulatedConfig",
    "Source",
    "UsbConfig",
    "VideoConfig",
    "ViewConfig",
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


class HealthConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[health]: /metrics, /livez and /readyz over HTTP at ``listen``, "address:port".

    beyond_loopback: whether others than this machine may ask; nobody is asked for a password.
    """

    listen: str = "127.0.0.1:9100"
    beyond_loopback: bool = False

    def __post_init__(self) -> None:
        host, _, port = self.listen.rpartition(":")
        if not host or not port.isdigit() or int(port) > 65_535:
            raise ValueError(f'listen {self.listen!r} is no address; write it like "127.0.0.1:9100"')
        if not (self.beyond_loopback or host in ("localhost", "[::1]") or host.startswith("127.")):
            raise ValueError(
                f"listen {self.listen!r} is open to the network; take 127.0.0.1, or set beyond_loopback = true"
            )


class _Agent(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every agent has. site: agents see only those of their own site. health: None = no HTTP."""

    site: str = "local"
    bus: BusConfig = msgspec.field(default_factory=BusConfig)
    health: HealthConfig | None = None

    def __post_init__(self) -> None:
        _check_id(self.site, "site")
        _check_id(getattr(self, "id", "ok"), "id")
        try:
            self.bus.endpoints()
        except InputError as error:
            raise ValueError(f"{error.what}; {error.remedy}") from None


class RouterConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A router. bus: its mode is "router" without saying so; with `syncline keys`, access and [bus.tls] too."""

    id: str = "router"

    def __post_init__(self) -> None:
        if self.bus.mode == "client":
            raise ValueError('bus.mode of a router is "router"; remove the line')
        msgspec.structs.force_setattr(self, "bus", msgspec.structs.replace(self.bus, mode="router"))
        super().__post_init__()


class RecorderConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The recorder. out: the log to write; a folder gets a file named by the time of its start.

    part_s, part_mb: begin a new file, name-000.mcap, name-001.mcap, …, when the present one is so old or so large
    [MB]; None = one file. min_free_mb, min_free_percent: recording ends, with a whole log, before less than this is
    free on the disk.
    foxglove: also write pictures, calibration, transforms, scene and annotations as Foxglove and rerun know them.
    pictures_hz: at most so many small pictures of each camera are recorded a second, 8 kB each; 0 = none, and none are
    asked of the cameras.
    """

    id: str = "recorder"
    out: Path = Path("recordings")
    part_s: Seconds | None = None
    part_mb: Annotated[float, Meta(ge=0.1, le=1e6)] | None = None
    min_free_mb: Annotated[float, Meta(ge=0.0, le=1e9)] = 200.0
    min_free_percent: Annotated[float, Meta(ge=0.0, le=100.0)] = 5.0
    foxglove: bool = True
    pictures_hz: Annotated[float, Meta(ge=0.0, le=30.0)] = 1.0


class SimulatedConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[simulated]: a camera of a shipped world.

    cameras: how many the world has, which also decides where they stand. duration_s: None = endless.
    start_unix_s: the Unix time of the world's true time 0; agents of one world must share it. None = the
    machine's start of the day, which agents on one machine share without being told. camera: which of the world's
    cameras this is; None = the one of the agent's id. width, fps: of all its pictures [px, Hz], instead of the world's.
    """

    scene: str = "marker"
    seed: Seed = 0
    cameras: Annotated[int, Meta(ge=2, le=64)] = 4
    duration_s: Seconds | None = None
    start_unix_s: Annotated[float, Meta(ge=0.0)] | None = None
    camera: str | None = None
    width: Annotated[int, Meta(ge=64, le=7680)] | None = None
    fps: Hertz | None = None


class OakConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[oak]: one sensor of an OAK board, through depthai.

    device: IP address, device id or USB path; "" = the only one there is. size: [w, h]. exposure_us, iso: fixed, so
    that mid-exposure and brightness keep still. focus: lens position 0..255, fixed; None = a lens that cannot move.
    nn: archive of a detection network (.tar.xz) that then runs on the board in place of a detector on the host. labels:
    which of its classes are told; none = all. confidence: the least of a detection.
    """

    device: str = ""
    socket: Literal["CAM_A", "CAM_B", "CAM_C"] = "CAM_A"
    size: tuple[Annotated[int, Meta(ge=64, le=8192)], Annotated[int, Meta(ge=64, le=8192)]] = (1280, 800)
    fps: Hertz = 30.0
    exposure_us: Annotated[int, Meta(ge=1, le=500_000)] = 5000
    iso: Annotated[int, Meta(ge=100, le=6400)] = 400
    focus: Byte | None = None
    nn: Path | None = None
    labels: tuple[Annotated[str, Meta(min_length=1, max_length=64)], ...] = ()
    confidence: Fraction = 0.5

    def __post_init__(self) -> None:
        if self.labels and self.nn is None:
            raise ValueError("labels are of a network; give its archive as nn")


class VideoConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[video]: a file, a stream or a USB camera through OpenCV. fps: None = what the source says."""

    source: Source
    fps: Hertz | None = None
    loop: bool = False


Size = tuple[Annotated[int, Meta(ge=16, le=16_384)], Annotated[int, Meta(ge=16, le=16_384)]]
Microseconds = Annotated[int, Meta(ge=1, le=1_000_000)]
Readout = Annotated[float, Meta(ge=0.0, le=1.0)]


class UsbConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[usb]: a V4L2 camera with the kernel's stamps. What is absent stays as the camera is set.

    device: /dev/video0, a stable name of udev's, or a number. size: [w, h]. exposure_us: fixed, so that mid-exposure
    keeps still. gain: the camera's own units. readout_s: first to last row of a rolling shutter; 0 = not known.
    """

    device: Source = Source("/dev/video0")
    size: Size | None = None
    fps: Hertz | None = None
    pixels: Literal["MJPG", "YUYV", "GREY"] = "MJPG"
    exposure_us: Microseconds | None = None
    gain: Annotated[int, Meta(ge=0, le=1_000_000)] | None = None
    readout_s: Readout = 0.0


class PiConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[picamera2]: a camera on a Raspberry Pi's ribbon cable.

    camera: its number. size: [w, h]. exposure_us, gain: fixed; without exposure_us the camera chooses. readout_s: first
    to last row; None = the shortest frame that this mode of the sensor can take.
    """

    camera: Annotated[int, Meta(ge=0, le=15)] = 0
    size: Size = (1280, 720)
    fps: Hertz = 30.0
    exposure_us: Microseconds | None = 5000
    gain: Annotated[float, Meta(ge=1.0, le=64.0)] | None = None
    readout_s: Readout | None = None


class RtspConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[rtsp]: a network camera: RTSP, or motion JPEG over HTTP.

    url: rtsp://user:password@address/path or http://…. transport: tcp loses nothing, udp is a little faster. fps:
    None = what the stream says.
    """

    url: Annotated[str, Meta(pattern=r"^[a-z0-9]+://[^\s]+$", max_length=2048)]
    transport: Literal["tcp", "udp"] = "tcp"
    fps: Hertz | None = None


class LogConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[log]: the pictures of one camera in a recorded log.

    file: the log, or the folder of its parts. camera: as the log names it; None = the agent's id. fast: as fast as they
    are read; else by the times at which they were taken.
    """

    file: Path
    camera: Annotated[str, Meta(min_length=1, max_length=64)] | None = None
    fast: bool = False


class MarkerConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[marker]: what the marker looks like; what is absent is taken from the picture.

    mode: "colour", one ball of a colour; "bright", an LED or a retro-reflector beside a lamp; "tag", AprilTags or
    ArUco tags, each labelled by its number, as in tag7. colour: sRGB, 0..255, of a ball. threshold: grey level that a
    bright marker exceeds. dictionary: family of the tags. min_size, max_size: diameter, of a tag its side [px].
    """

    label: Annotated[str, Meta(min_length=1, max_length=64)] = "marker"
    mode: Literal["colour", "bright", "tag"] = "colour"
    colour: tuple[Byte, Byte, Byte] | None = None
    threshold: Annotated[int, Meta(ge=30, le=254)] = 200
    dictionary: Annotated[str, Meta(pattern=r"^[0-9a-z_]{1,32}\Z")] = "apriltag_36h11"
    min_size: Pixels | None = None
    max_size: Pixels | None = None


class MovingConfig(_Strict, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[moving]: how people and vehicles are told from what stands still.

    background: the model of the background. camera: of vehicles, whether it stands or moves; people need one that
    stands.
    """

    background: Literal["mog2", "knn"] = "mog2"
    camera: Literal["auto", "fixed", "moving"] = "auto"


class CameraConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera agent. rig: a rig.toml to take this camera's intrinsics and known pose from.

    pictures_hz: small pictures a second on the bus while a view or a recorder wants them; 0 = none, ever.
    picture_width: of these [px].
    """

    id: str
    rig: Path | None = None
    pictures_hz: Annotated[float, Meta(ge=0.0, le=30.0)] = 2.0
    picture_width: Annotated[int, Meta(ge=64, le=640)] = 320
    driver: Literal["simulated", "video", "usb", "picamera2", "rtsp", "oak", "log"] = "simulated"
    detector: Literal["marker", "person", "vehicle"] = "marker"
    simulated: SimulatedConfig | None = None
    video: VideoConfig | None = None
    usb: UsbConfig | None = None
    picamera2: PiConfig | None = None
    rtsp: RtspConfig | None = None
    oak: OakConfig | None = None
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


class HubConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The hub. rig: what is known of the rig; out: where calibrations are written.

    window_s: how much of the past is solved together; interval_s: how often it is solved again. solve: false = this
    hub seeks no timing itself. nodes: cameras whose pose nodes run here whoever else is there; the others are shared
    out among all hubs. pose_nodes: false = none run here. leave_after_s: when a camera that has gone is forgotten.
    known: a calibration.toml that is kept as it is: poses, lenses and clocks; nothing is solved then. track: whether
    people, vehicles and markers without a name are followed.
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
    known: Path | None = None
    track: bool = True


class ViewConfig(_Agent, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """What a view takes from any agent's file: its site and how to reach the bus; the rest is that agent's own."""


def _check_id(text: str, what: str) -> None:
    try:
        valid_id(text, what)
    except InputError as error:
        raise ValueError(f"{error.what}; {error.remedy}") from None
