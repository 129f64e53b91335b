"""Opening any camera or recording by one string or number, for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.devices.base import Device, Frame, WrappedDevice
from edge.devices.settings import OakSettings, PiSettings, UsbSettings
from protocols.core.closing import Closing
from protocols.core.errors import InputError

if TYPE_CHECKING:
    from protocols.geometry.camera import Intrinsics

_URL_SCHEMES = ("rtsp", "rtsps", "http", "https", "rtp", "srt", "udp")
_REMEDY = (
    'give 0 or "/dev/video0", "rtsp://…" or "http://…", "oak", "picamera2", "simulated", a video file, a folder of '
    'images, or "LOG.mcap#CAMERA"'
)


class Camera(WrappedDevice, Closing):
    """An open device as a context manager and an iterator over its frames.

    Iteration ends with the recording; on a live camera it waits for the next frame, also while the camera reconnects.
    device: the driver behind it. ``reconnections`` and ``temperature`` are 0 and None where a driver has none.
    """

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.device = device
        device.open()

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        """The next frame; None if none came within ``timeout_s`` or the source has ended."""
        return super().read(timeout_s)

    def __iter__(self) -> Iterator[Frame]:
        while not self.ended:
            frame = self.read()
            if frame is not None:
                yield frame


def open_camera(
    source: int | str | Path,
    *,
    fps: float | None = None,
    size: tuple[int, int] | None = None,
    intrinsics: Intrinsics | None = None,
) -> Camera:
    """Open a camera or a recording; the returned ``Camera`` delivers frames at once.

    source: one of
        0 or "/dev/video0"             USB camera: V4L2 through linuxpy where it is installed, otherwise OpenCV
        "rtsp://…", "http://…"         network camera
        "oak" or "oak:DEVICE"          OAK board: the only one, or by device id, IP address or USB path
        "picamera2"                    Raspberry Pi camera
        "simulated[:SCENE[/CAMERA]]"   simulated camera in real time; "simulated" is "simulated:marker/cam0"
        a video file, an image folder  played as fast as possible
        "LOG.mcap#CAMERA"              the images of one camera in a log, played as fast as possible
    fps: requested rate of a live camera [Hz]; replaces the time stamps of a video or image folder.
    size: requested (width, height) [px] of a USB, OAK or Pi camera (through OpenCV: not set); of a simulated camera the
    width, with the height following from the scene. intrinsics: of this camera at its image size.

    with open_camera(0) as camera:
        for frame in camera:
            print(frame.device_time_ns, frame.image.shape)

    Raises InputError for an unknown source, an option that it does not support, or a source that cannot be opened.
    """
    return Camera(_device(source, fps, size, intrinsics))


def _device(
    source: int | str | Path, fps: float | None, size: tuple[int, int] | None, intrinsics: Intrinsics | None
) -> Device:
    """The device for a source, not yet open. Drivers are imported here: each needs only its own packages."""
    text = str(source)
    if isinstance(source, bool) or not isinstance(source, int | str | Path) or not text:
        raise InputError(f"{source!r} is not a camera", remedy=_REMEDY)
    if fps is not None and not fps > 0.0:
        raise InputError(f"fps is {fps}", remedy="give a rate above 0")
    if size is not None and (len(size) != 2 or min(size) < 1):
        raise InputError(f"size is {size}", remedy="give (width, height) in pixels")
    if isinstance(source, Path):
        return _playback(text, fps, size, intrinsics)
    if text.removeprefix("-").isdecimal() or text.startswith("/dev/"):
        return _usb(text, fps, size, intrinsics)
    if "://" in text:
        if text.partition("://")[0].lower() not in _URL_SCHEMES:
            raise InputError(f"{text.partition('://')[0]}:// is not a network camera", remedy=_REMEDY)
        _refuse_size(size, "a network camera")
        from edge.devices.live.network import open_network

        return open_network(text, fps=fps, intrinsics=intrinsics)
    kind, _, rest = text.partition(":")
    given: dict[str, Any] = {key: value for key, value in (("fps", fps), ("size", size)) if value is not None}
    if kind == "oak":
        from edge.devices.live.oak import OakCamera

        return OakCamera(OakSettings(device=rest, **given), intrinsics=intrinsics)
    if text == "picamera2":
        from edge.devices.live.picamera import PiCamera

        return PiCamera(PiSettings(**given), intrinsics=intrinsics)
    if kind == "simulated":
        from edge.devices.simulated.camera import open_simulated

        if intrinsics is not None:
            raise InputError("a simulated camera has its own intrinsics", remedy="leave intrinsics out")
        scene, _, name = rest.partition("/")
        return open_simulated(scene or "marker", name or "cam0", width=None if size is None else size[0], fps=fps)
    return _playback(text, fps, size, intrinsics)


def _usb(text: str, fps: float | None, size: tuple[int, int] | None, intrinsics: Intrinsics | None) -> Device:
    if text.startswith("-"):
        raise InputError(f"there is no camera {text}", remedy="count USB cameras from 0")
    if text.isdecimal() and find_spec("linuxpy") is None:  # OpenCV takes the number on every operating system
        from edge.devices.playback.video_file import open_video

        return open_video(int(text), fps=fps, intrinsics=intrinsics)
    from edge.devices.live.usb import open_usb

    return open_usb(UsbSettings(device=text, size=size, fps=fps), intrinsics=intrinsics)


def _playback(text: str, fps: float | None, size: tuple[int, int] | None, intrinsics: Intrinsics | None) -> Device:
    log, marker, camera = text.rpartition("#")
    if marker and not Path(text).exists():
        from edge.devices.playback.log_playback import LogPlayback

        _refuse_size(size, "a log")
        if fps is not None:
            raise InputError("images of a log have their own time stamps", file=log, remedy="leave fps out")
        return LogPlayback(Path(log), camera, intrinsics=intrinsics)
    path = Path(text)
    if path.suffix == ".mcap":
        raise InputError("a log has several cameras", file=path, remedy=f'give "{path.name}#CAMERA"')
    if not path.exists():
        raise InputError(f"{text!r} is not a camera, and no such file exists", remedy=_REMEDY)
    from edge.devices.playback.video_file import VideoPlayback

    _refuse_size(size, "a recording")
    return VideoPlayback(path, fps=fps, intrinsics=intrinsics)


def _refuse_size(size: tuple[int, int] | None, what: str) -> None:
    if size is not None:
        raise InputError(f"the image size of {what} cannot be set", remedy="leave size out")
