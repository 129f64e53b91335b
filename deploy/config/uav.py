"""Schema of the UAV agent's configuration file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from deploy.config.agents import AgentConfig, Seconds, Seed, StrictConfig, VideoConfig, check_address
from deploy.config.file import DetectorName
from edge.devices.settings import OakSettings
from edge.mavlink.settings import GuidanceLimits
from protocols.core.errors import InputError

SystemId = Annotated[int, Meta(ge=1, le=255)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class MavlinkConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[mavlink]: the connection to the autopilot.

    url: "udpin:0.0.0.0:14550", "udpout:host:port", "tcp:host:port" or "serial:/dev/ttyAMA0:921600". vehicle: the only
    system id whose messages are accepted; None = the first autopilot received. system: the camera's own system id;
    None = that of its vehicle. stations: system ids that may send commands; () = any. rate_hz: requested rate of
    attitude and position. key: file of the signing key, 32 bytes or 64 hexadecimal digits; with it, unsigned messages
    are rejected. key_state: file of the last signing time stamps; None = beside the key.
    """

    url: str = "udpin:127.0.0.1:14550"
    vehicle: SystemId | None = None
    system: SystemId | None = None
    stations: tuple[SystemId, ...] = ()
    rate_hz: Annotated[float, Meta(ge=1.0, le=100.0)] = 30.0
    key: Path | None = None
    key_state: Path | None = None

    def __post_init__(self) -> None:
        from edge.mavlink.link.transport import parse_url

        try:
            parse_url(self.url)
        except InputError as error:
            raise ValueError(f"url: {error.what}; {error.remedy}") from None
        if self.key_state is not None and self.key is None:
            raise ValueError("key_state goes with key; add key, or remove it")


class VideoOutConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[video_out]: video stream of the frames with the estimate drawn on them.

    stream: "rtsp" = H.264, which ground stations open by themselves (needs the extra video), "mjpeg" = motion JPEG over
    HTTP, for browsers. listen: "address:port". beyond_loopback: whether other machines may connect; there is no
    authentication. uri: the address announced to ground stations; None = rtsp://<listen>/overlay or
    http://<listen>/stream.mjpg. quality: of the JPEGs. kbps: largest bit rate of the H.264.
    """

    stream: Literal["mjpeg", "rtsp"] = "mjpeg"
    listen: str = "127.0.0.1:8560"
    beyond_loopback: bool = False
    uri: Annotated[str, Meta(max_length=159)] | None = None
    quality: Annotated[int, Meta(ge=20, le=95)] = 75
    kbps: Annotated[int, Meta(ge=100, le=20_000)] = 2000

    def __post_init__(self) -> None:
        host = check_address("listen", self.listen, 8560, beyond_loopback=self.beyond_loopback)
        if self.uri is None and host in ("0.0.0.0", "[::]"):
            raise ValueError(
                f"listen {self.listen!r} is not an address that can be opened; add the uri that ground stations open"
            )
        if self.uri is not None and not self.uri.startswith(("rtsp://", "http://", "https://")):
            raise ValueError(f"uri {self.uri!r} cannot be opened by ground stations; begin it with rtsp:// or http://")


class ImagesConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[images]: full images on the bus, so that a recorder stores them and `replay --through uav` is possible.

    The tracker then uses the compressed images that were sent. quality: of the JPEGs.
    """

    quality: Annotated[int, Meta(ge=30, le=100)] = 90


class SimulatedFlightConfig(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[simulated]: an aircraft over the simulated town, with its autopilot and camera, in the agent's process.

    autopilot: where the autopilot listens, "host:port"; the agent's url must be "udpout:" to it. seconds: duration of
    the flight. flies: "path" = a fixed path on which the car leaves the view every 12 s; "follow" = hovers, and obeys
    FOLLOW_TARGET. gimbal: whether the camera is on a gimbal. start_unix_s: Unix time of world time 0; None = when the
    agent starts. boot_s: autopilot uptime at world time 0. camera_ahead_s: offset of the camera's clock from world
    time. drop, duplicate, garble: fractions of the autopilot's messages that are lost, duplicated and corrupted.
    delay_s, jitter_s: of their transmission. reboot_at: world times at which the autopilot reboots [s].
    """

    autopilot: str = "127.0.0.1:14551"
    seed: Seed = 1
    seconds: Annotated[float, Meta(ge=1.0, le=3600.0)] = 60.0
    flies: Literal["path", "follow"] = "path"
    gimbal: bool = False
    start_unix_s: Annotated[float, Meta(ge=0.0)] | None = None
    boot_s: Annotated[float, Meta(ge=0.0, le=4e6)] = 123.4
    camera_ahead_s: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0
    drop: Share = 0.0
    duplicate: Share = 0.0
    garble: Share = 0.0
    delay_s: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    jitter_s: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    reboot_at: tuple[Seconds, ...] = ()

    def __post_init__(self) -> None:
        check_address("autopilot", self.autopilot, 14551, least=1)


class UavConfig(AgentConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The UAV agent. rig: a rig.toml with this camera's matrix and body_from_camera, looked up by the agent's id.

    mount: "fixed" = on the airframe, "gimbal" = the attitude is the gimbal's, and body_from_camera refers to the gimbal
    axes (default: the camera looks along the x axis). model, seed: of the tracker. detector: the .toml file of an ONNX
    network, or a detector that another package registers; a point that the operator selects then selects the object
    detected there. pictures_hz, picture_width: rate of
    thumbnails on the bus while a view or a recorder subscribes to them, and their width [px]; 0 = never.
    """

    id: str
    rig: Path | None = None
    driver: Literal["simulated", "video", "oak"] = "simulated"
    simulated: SimulatedFlightConfig | None = None
    video: VideoConfig | None = None
    oak: OakSettings | None = None
    mount: Literal["fixed", "gimbal"] = "fixed"
    model: Literal["ground", "paper", "plain"] = "ground"
    seed: Seed = 0
    detector: DetectorName | None = None
    mavlink: MavlinkConfig = msgspec.field(default_factory=MavlinkConfig)
    control: GuidanceLimits = msgspec.field(default_factory=GuidanceLimits)
    video_out: VideoOutConfig | None = None
    images: ImagesConfig | None = None
    pictures_hz: Annotated[float, Meta(ge=0.0, le=30.0)] = 2.0
    picture_width: Annotated[int, Meta(ge=64, le=640)] = 320

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.driver == "video" and self.video is None:
            raise ValueError('driver = "video" needs a [video] table with source = "…"')
        if self.oak is not None and self.oak.nn is not None:
            raise ValueError("oak.nn is for camera agents: a UAV agent uses its own tracker; remove nn")
        if self.control.gimbal and self.mount != "gimbal":
            raise ValueError('control.gimbal needs a camera on a gimbal; set mount = "gimbal", or switch it off')
        if self.driver == "simulated" and (self.simulated or SimulatedFlightConfig()).gimbal != (
            self.mount == "gimbal"
        ):
            raise ValueError("mount and simulated.gimbal contradict each other; correct one")
