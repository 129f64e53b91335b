"""Interactive calibration of the cameras of this machine in one process: cameras, marker teaching, advice, hub."""

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
from edge.detectors.marker.ball import InteractiveMarkerDetector, MarkerModel, learn_marker_at, learn_marker_model
from edge.devices.base import Device, DeviceInfo, Frame, WrappedDevice
from edge.lens.solve import intrinsics_from_field_of_view
from hub.calibration.coverage import MIN_COVERAGE
from hub.live.agent import run_hub
from hub.live.live_hub import LiveHub, LiveSettings
from hub.live.worker import WorkerSolver
from hub.view.image_planes import ImagePlanes
from hub.view.server import ViewServer, run_view
from hub.view.state import ViewState
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.session.rig import Rig

WINDOW_S = 600.0  # of observations: longer than any run of `quick` waves a marker
_TARGET_OFFSET_STD_S = 0.0005  # clock offset std of every camera at which the calibration is sufficient
_ADVICE_INTERVAL_S = 3.0  # shortest time between two lines of advice
_MIN_CONSECUTIVE_GOOD = 3  # sufficient calibrations in a row before it ends
_HUB_START_S = 10.0  # s: longest wait for the hub to subscribe, before cameras are started


class LastFrameDevice(WrappedDevice):
    """A device that keeps its last frame for other threads, with assumed intrinsics where it has none.

    field_of_view: assumed horizontal field of view [degrees].
    """

    def __init__(self, device: Device, field_of_view: float) -> None:
        super().__init__(device)
        self._field_of_view = field_of_view
        self.frame: Frame | None = None
        self.lens_assumed = False
        self.done = False

    @property
    def info(self) -> DeviceInfo:
        """The device's information, with intrinsics."""
        info = super().info
        if info.intrinsics is not None:
            return info
        self.lens_assumed = True
        lens = intrinsics_from_field_of_view((info.width, info.height), self._field_of_view, False)
        return replace(info, intrinsics=lens)

    def read(self, timeout_s: float) -> Frame | None:
        frame = super().read(timeout_s)
        self.frame = frame or self.frame
        return frame

    def close(self) -> None:
        super().close()
        self.done = True


@dataclass(slots=True, eq=False)
class QuickSettings:
    """Settings of a run. devices: by camera. out: folder. live: cameras; False = recordings, which end by themselves.

    field_of_view: assumed where a lens is not known [degrees]. seconds: longest duration [s]. rig: known intrinsics
    and control points. target: a box x, y, w, h [px] around the marker in the first frame of the first camera.
    """

    devices: dict[str, Device]
    out: Path
    field_of_view: float = 65.0
    live: bool = True
    seconds: float = 300.0
    rig: Rig | None = None
    marker: MarkerModel | None = None
    target: tuple[float, float, float, float] | None = None
    report: Callable[[str], None] = field(default=lambda text: None)


class QuickCalibration:
    """One run. ``finish`` may be set from any thread; ``run`` returns the hub with its last calibration or refusal."""

    def __init__(self, settings: QuickSettings, view: ViewServer | None) -> None:
        self.settings = settings
        self.finish = threading.Event()
        self._view = view
        self._network = MemoryHub()
        self._stop_cameras, self._stop_hub = threading.Event(), threading.Event()
        self._devices = {
            name: LastFrameDevice(device, settings.field_of_view) for name, device in settings.devices.items()
        }
        self._detectors = {name: InteractiveMarkerDetector(self._lens(name), settings.marker) for name in self._devices}
        rig = settings.rig
        self.hub = LiveHub(LiveSettings(WINDOW_S, 2.0), rig, solver=WorkerSolver())
        self._errors: list[BaseException] = []
        self._reset_requested, self._hub_listens = threading.Event(), threading.Event()
        self._consecutive_good = 0
        self._revision = -1
        self._reported, self._reported_at = "", 0.0
        self._planes: ImagePlanes | None = None
        if view is not None:
            self._planes = ImagePlanes(view.server, self._on_click)
            with view.server.gui.add_folder("Your cameras", order=-1.0):
                self._note = view.server.gui.add_markdown("Click on the ball in an image if it has no ring yet.")
                button = view.server.gui.add_button("Finish", color="green")
                button.on_click(lambda event: self.finish.set())

    def run(self, stop: threading.Event) -> LiveHub:
        """Run until the calibration is sufficient, ``finish`` or ``stop`` is set, the sources end or time is up.

        Raises InputError if a camera does not respond.
        """
        hub = self._thread("hub", self._run_hub)
        self._hub_listens.wait(_HUB_START_S)  # a short film would be over before
        cameras = [self._thread(f"camera {name}", self._run_camera, name) for name in self._devices]
        started = time.monotonic()
        try:
            if self.settings.target is not None:
                self._teach_target(*self.settings.target)
            with MemoryBus(self._network) as bus, ExitStack() as stack:
                done = threading.Event()

                def each(state: ViewState) -> None:
                    self._update(state, cameras, started)
                    if self._errors or stop.is_set() or self.finish.is_set():
                        done.set()

                if self._view is None:
                    self._run_headless(bus, done, each)
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
    def lens_assumed(self) -> list[str]:
        """Cameras whose intrinsics are assumed from the field of view."""
        return [name for name, device in self._devices.items() if device.lens_assumed]

    def _lens(self, name: str) -> Intrinsics | None:
        """The measured intrinsics of a camera: the centre of a ball's outline is not corrected with assumed ones."""
        known = None if self.settings.rig is None else self.settings.rig.cameras.get(name)
        return None if known is None else known.intrinsics

    def _thread(self, name: str, work: Callable[..., None], *arguments: str) -> threading.Thread:
        def guarded() -> None:
            try:
                work(*arguments)
            except Exception as error:  # noqa: BLE001 - raised again in the thread that waits for this one
                self._errors.append(error)

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        thread.start()
        return thread

    def _run_camera(self, name: str) -> None:
        device = self._devices[name]
        known = None if self.settings.rig is None else self.settings.rig.cameras.get(name)
        with MemoryBus(self._network) as bus:
            CameraAgent(device, self._detectors[name], bus, name, known=known, pictures_hz=5.0, target="ball").run(
                self._stop_cameras
            )

    def _run_hub(self) -> None:
        with MemoryBus(self._network) as bus:
            run_hub(self.hub, bus, "hub", self._stop_hub, rig=self.settings.rig, beat=self._beat)

    def _beat(self) -> None:
        self._hub_listens.set()
        if self._reset_requested.is_set():
            self._reset_requested.clear()
            self.hub.reset()

    def _run_headless(self, bus: MemoryBus, done: threading.Event, each: Callable[[ViewState], None]) -> None:
        """The view's loop without a browser."""
        from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION

        state = ViewState()
        subscriptions = [bus.subscribe(topic) for topic in (CAMERA_INFO, OBSERVATION, CALIBRATION)]
        while not done.wait(0.1):
            for subscription in subscriptions:
                for received in subscription.drain():
                    state.handle(received.message, time.monotonic())
            each(state)

    def _update(self, state: ViewState, cameras: list[threading.Thread], started: float) -> None:
        """Show images until a calibration exists, report advice, and decide whether the calibration is sufficient."""
        if self._planes is not None and self._view is not None:
            if state.solved is None:
                self._planes.update(state)
            else:
                self._planes.clear()
        advice = state.guidance.advice(1)
        line = f"{state.headline()}" + (f"; {advice[0].text}" if advice and not self._is_sufficient(state) else "")
        revision = state.calibration.revision if state.calibration else -1
        if line != self._reported and (
            revision != self._revision or time.monotonic() - self._reported_at > _ADVICE_INTERVAL_S
        ):
            self._reported, self._reported_at = line, time.monotonic()
            self.settings.report(line)
        if all(not thread.is_alive() for thread in cameras) or time.monotonic() - started > self.settings.seconds:
            self.finish.set()
        latest = state.calibration
        if latest is not None and latest.revision != self._revision:
            self._revision = latest.revision
            self._consecutive_good = self._consecutive_good + 1 if self._is_sufficient(state) else 0
        if self.settings.live and self._consecutive_good >= _MIN_CONSECUTIVE_GOOD:
            self.finish.set()

    def _is_sufficient(self, state: ViewState) -> bool:
        latest = state.calibration
        if latest is None or latest.status != "solved" or len(latest.cameras) < len(self._devices):
            return False
        precise = all(camera.time_offset_std <= _TARGET_OFFSET_STD_S for camera in latest.cameras)
        return precise and all(state.guidance.coverage(name) >= MIN_COVERAGE for name in self._devices)

    def _on_click(self, camera: str, u: float, v: float) -> None:
        frame = self._devices[camera].frame
        if frame is None:
            return
        try:
            model, box = learn_marker_at(frame.image, u, v)
        except InputError as error:
            self._show_message(f"{camera}: {error}")
            return
        self._set_marker_model(model)
        self._show_message(
            f"ball learned from {camera}, a box of {box[2]}×{box[3]} pixels: now wave it through all images"
        )

    def _teach_target(self, *box: float) -> None:
        first = next(iter(self._devices.values()))
        deadline = time.monotonic() + 20.0
        while first.frame is None and time.monotonic() < deadline and not self._errors and not first.done:
            time.sleep(0.01)
        if first.frame is None:
            return  # the camera's thread reports the error
        self._set_marker_model(learn_marker_model(first.frame.image, (box[0], box[1], box[2], box[3])))

    def _set_marker_model(self, model: MarkerModel) -> None:
        for detector in self._detectors.values():
            detector.set_model(model)
        self._reset_requested.set()  # the hub's own thread discards observations of the former marker

    def _show_message(self, text: str) -> None:
        if self._view is not None:
            self._note.content = text
        self.settings.report(text)


def show_report(file: Path) -> bool:
    """Open a file in this machine's browser; False without a display."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    return webbrowser.open(file.resolve().as_uri())
