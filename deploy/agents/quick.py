"""Two or more cameras on this machine, in one process and without configuration: show, teach, guide, calibrate."""

from __future__ import annotations

import os
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from edge.agents.camera import CameraAgent
from edge.detectors.marker.ball import MarkerModel, teach
from edge.detectors.marker.teach import TaughtDetector, teach_at
from edge.devices.base import Device, DeviceInfo, Frame
from edge.lens.solve import lens_from_angle
from hub.calibration.coverage import ENOUGH
from hub.live.agent import run_hub
from hub.live.live_hub import LiveHub, LiveSettings
from hub.view.image_planes import PicturePlanes
from hub.view.server import ViewServer, run_view
from hub.view.state import ViewState
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.session.rig import Rig

WINDOW_S = 600.0
_GOOD_STD_S = 0.0005  # every clock known so well: enough
_QUIET_S = 3.0  # between two lines of advice
_STEADY = 3  # calibrations in a row that are


class Tapped:
    """A device whose last frame can be looked at from elsewhere, with a first guess of the lens where it has none.

    angle: how wide its picture is [degrees].
    """

    def __init__(self, device: Device, angle: float) -> None:
        self._device, self._angle = device, angle
        self.frame: Frame | None = None
        self.guessed = False
        self.done = False

    @property
    def info(self) -> DeviceInfo:
        """The device's own, with a lens."""
        info = self._device.info
        if info.intrinsics is not None:
            return info
        self.guessed = True
        return replace(info, intrinsics=lens_from_angle((info.width, info.height), self._angle, False))

    @property
    def ended(self) -> bool:
        """As the device says."""
        return self._device.ended

    def open(self) -> None:
        """Raises InputError where the device does not answer."""
        self._device.open()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame."""
        frame = self._device.read(timeout_s)
        self.frame = frame or self.frame
        return frame

    def close(self) -> None:
        """Release the device."""
        self._device.close()
        self.done = True


@dataclass(slots=True, eq=False)
class QuickSettings:
    """What to run. devices: by camera. out: folder. live: somebody waves; else the sources end by themselves.

    rig: lenses and references that are known. target: a box x, y, w, h [px] in the first camera's first picture.
    """

    devices: dict[str, Device]
    out: Path
    angle: float = 65.0
    live: bool = True
    seconds: float = 300.0
    rig: Rig | None = None
    marker: MarkerModel | None = None
    target: tuple[float, float, float, float] | None = None
    tell: Callable[[str], None] = field(default=lambda text: None)


class Quick:
    """One run. ``finish`` may be set by anyone; ``run`` returns the hub with its last answer or refusal."""

    def __init__(self, settings: QuickSettings, view: ViewServer | None) -> None:
        self.settings = settings
        self.finish = threading.Event()
        self._view = view
        self._network = MemoryHub()
        self._stop_cameras, self._stop_hub = threading.Event(), threading.Event()
        self._devices = {name: Tapped(device, settings.angle) for name, device in settings.devices.items()}
        self._detectors = {name: TaughtDetector(self._lens(name), settings.marker) for name in self._devices}
        rig = settings.rig
        self.hub = LiveHub(LiveSettings(WINDOW_S, 2.0), rig)
        self._errors: list[BaseException] = []
        self._anew = threading.Event()
        self._steady = 0
        self._revision = -1
        self._told, self._told_at = "", 0.0
        self._planes: PicturePlanes | None = None
        if view is not None:
            self._planes = PicturePlanes(view.server, self._clicked)
            with view.server.gui.add_folder("Your cameras", order=-1.0):
                self._note = view.server.gui.add_markdown("Click on the marker in a picture if it has no ring yet.")
                button = view.server.gui.add_button("Finish", color="green")
                button.on_click(lambda event: self.finish.set())

    def run(self, stop: threading.Event) -> LiveHub:
        """Film until it is enough, ``finish`` or ``stop`` is set, the sources end or the time is over.

        Raises InputError where a camera does not answer.
        """
        cameras = [self._thread(f"camera {name}", self._run_camera, name) for name in self._devices]
        hub = self._thread("hub", self._run_hub)
        began = time.monotonic()
        try:
            if self.settings.target is not None:
                self._teach_target(*self.settings.target)
            with MemoryBus(self._network) as bus, ExitStack() as stack:
                done = threading.Event()

                def each(state: ViewState) -> None:
                    self._look(state, cameras, began)
                    if self._errors or stop.is_set() or self.finish.is_set():
                        done.set()

                if self._view is None:
                    self._watch_alone(bus, done, each)
                else:
                    stack.callback(self._view.close)
                    run_view(bus, self._view, done, each=each)
        finally:
            self._stop_cameras.set()
            for thread in cameras:
                thread.join(10.0)
            self._stop_hub.set()
            hub.join(120.0)
        if self._errors:
            raise self._errors[0]
        return self.hub

    @property
    def guessed(self) -> list[str]:
        """Cameras whose lens is only a guess."""
        return [name for name, device in self._devices.items() if device.guessed]

    def _lens(self, name: str) -> Intrinsics | None:
        """What corrects a ball's outline must be a measured lens, not a guess."""
        known = None if self.settings.rig is None else self.settings.rig.cameras.get(name)
        return None if known is None else known.intrinsics

    def _thread(self, name: str, work: Callable[..., None], *arguments: str) -> threading.Thread:
        def guarded() -> None:
            try:
                work(*arguments)
            except Exception as error:  # noqa: BLE001 - it belongs to the thread that waits for this one
                self._errors.append(error)

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        thread.start()
        return thread

    def _run_camera(self, name: str) -> None:
        device = self._devices[name]
        known = None if self.settings.rig is None else self.settings.rig.cameras.get(name)
        with MemoryBus(self._network) as bus:
            CameraAgent(device, self._detectors[name], bus, name, known=known, pictures_hz=5.0).run(self._stop_cameras)

    def _run_hub(self) -> None:
        with MemoryBus(self._network) as bus:
            run_hub(self.hub, bus, "hub", self._stop_hub, rig=self.settings.rig, beat=self._forget)

    def _forget(self) -> None:
        if self._anew.is_set():
            self._anew.clear()
            self.hub.start_anew()

    def _watch_alone(self, bus: MemoryBus, done: threading.Event, each: Callable[[ViewState], None]) -> None:
        """The same loop without a browser."""
        from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION

        state = ViewState()
        subscriptions = [bus.subscribe(topic) for topic in (CAMERA_INFO, OBSERVATION, CALIBRATION)]
        while not done.wait(0.1):
            for subscription in subscriptions:
                for received in subscription.drain():
                    state.handle(received.message, time.monotonic())
            each(state)

    def _look(self, state: ViewState, cameras: list[threading.Thread], began: float) -> None:
        """Pictures until something is solved, advice, and whether it is enough."""
        if self._planes is not None and self._view is not None:
            if state.solved is None:
                self._planes.update(state)
            else:
                self._planes.clear()
        advice = state.guidance.advice(1)
        line = f"{state.headline()}" + (f"; {advice[0].text}" if advice and not self._enough(state) else "")
        revision = state.calibration.revision if state.calibration else -1
        if line != self._told and (revision != self._revision or time.monotonic() - self._told_at > _QUIET_S):
            self._told, self._told_at = line, time.monotonic()
            self.settings.tell(line)
        if all(not thread.is_alive() for thread in cameras) or time.monotonic() - began > self.settings.seconds:
            self.finish.set()
        found = state.calibration
        if found is not None and found.revision != self._revision:
            self._revision = found.revision
            self._steady = self._steady + 1 if self._enough(state) else 0
        if self.settings.live and self._steady >= _STEADY:
            self.finish.set()

    def _enough(self, state: ViewState) -> bool:
        found = state.calibration
        if found is None or found.status != "solved" or len(found.cameras) < len(self._devices):
            return False
        sharp = all(camera.time_offset_std <= _GOOD_STD_S for camera in found.cameras)
        return sharp and all(state.guidance.coverage(name) >= ENOUGH for name in self._devices)

    def _clicked(self, camera: str, u: float, v: float) -> None:
        frame = self._devices[camera].frame
        if frame is None:
            return
        try:
            model, box = teach_at(frame.image, u, v)
        except InputError as error:
            self._say(f"{camera}: {error}")
            return
        self._use(model)
        self._say(f"taught from {camera}, a box of {box[2]}×{box[3]} pixels: now wave it through all pictures")

    def _teach_target(self, *box: float) -> None:
        first = next(iter(self._devices.values()))
        deadline = time.monotonic() + 20.0
        while first.frame is None and time.monotonic() < deadline and not self._errors and not first.done:
            time.sleep(0.01)
        if first.frame is None:
            return  # its error is told by the camera's thread
        self._use(teach(first.frame.image, (box[0], box[1], box[2], box[3])))

    def _use(self, model: MarkerModel) -> None:
        for detector in self._detectors.values():
            detector.teach(model)
        self._anew.set()  # what was seen of another thing is forgotten, by the hub's own thread

    def _say(self, text: str) -> None:
        if self._view is not None:
            self._note.content = text
        self.settings.tell(text)


def show_report(file: Path) -> bool:
    """Open a file in this machine's browser, where there is a screen."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    return webbrowser.open(file.resolve().as_uri())
