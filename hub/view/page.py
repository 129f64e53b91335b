"""The view's panels: site status, cameras, pictures, lags, buttons, options, drones, and a replay's timeline."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

from hub.live.messages import calibration_from_message
from hub.view.lag_chart import lag_charts
from hub.view.panels import camera_details, camera_table, overview, picture_tiles, recording_html
from hub.view.scene_renderer import DisplayOptions, decode_rgb
from hub.view.state import CameraView, ViewState
from hub.view.uav_overlay import UavView, draw_uav, pad_to_aspect, uav_panel_html
from protocols.session.builder import rig_camera_from_info
from protocols.session.calibration import calibration_text
from protocols.session.rig import Rig

if TYPE_CHECKING:
    import viser

    from hub.view.player import Player

ACTIONS = {
    "start_recording": "Start recording",
    "stop_recording": "Stop recording",
    "recalibrate": "Recalibrate",
    "forget": "Forget silent cameras",
    "export": "Export",
}
_HINTS = {
    "start_recording": "Every recorder of the site starts a new log.",
    "stop_recording": "Every recorder of the site closes its log.",
    "recalibrate": "The hub discards its observations and starts again, for example after a camera was moved.",
    "forget": "The hub no longer waits for cameras that were taken away or renamed. One that returns is located anew.",
    "export": "The hub writes its files now, and your browser downloads calibration.toml.",
}


def calibration_file(state: ViewState) -> str:
    """The text of calibration.toml; "" if nothing is solved yet."""
    solved = state.solved
    if solved is None:
        return ""
    infos = {name: camera.info for name, camera in state.cameras.items() if camera.info is not None}
    rig = Rig({name: rig_camera_from_info(info) for name, info in infos.items()}, solved.units)
    return calibration_text(calibration_from_message(solved, infos), rig)


class ViewPage:
    """Panels of one server.

    requested_actions: actions that were clicked, to be sent by the loop. allowed: whether buttons are enabled. actions:
    the buttons to show.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        options: DisplayOptions,
        *,
        allowed: bool,
        player: Player | None = None,
        actions: tuple[str, ...] = tuple(ACTIONS),
    ) -> None:
        self.requested_actions: deque[str] = deque(maxlen=32)
        self.options = options
        self._server = server
        self._player = player
        self._state = ViewState()
        self._now = 0.0
        self._texts: dict[int, str] = {}
        gui = server.gui
        # Viser's sharing uses an external server: a rig's images stay local.
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label("Syncline")
        self._overview = gui.add_html("")
        if player is not None:
            self._add_timeline(player)
        self._uavs: dict[str, _UavPanel] = {}
        self._filled = False
        self._table = gui.add_html("")
        self._note: Any = None
        self._recording: Any = None
        self._buttons: dict[str, Any] = {}
        if player is None:
            self._add_actions(allowed, actions)
        with gui.add_folder("Pictures"):
            self._tiles = gui.add_html("")
        with gui.add_folder("Lags"):
            self._lags = gui.add_html("")
        with gui.add_folder("Camera", expand_by_default=False):
            self._choice: Any = gui.add_dropdown("camera", ("–",))
            self._details = gui.add_html("")
        self._add_options()

    def update(self, state: ViewState, now: float) -> None:
        """Update the panels."""
        self._state, self._now = state, now
        names = tuple(state.cameras) or ("–",)
        if tuple(self._choice.options) != names:
            chosen = self._choice.value
            self._choice.options = names
            if chosen in names:
                self._choice.value = chosen
        self._set(self._overview, overview(state, now))
        self._set(self._table, camera_table(state, now))
        camera = state.cameras.get(self._choice.value)
        if camera is not None:
            self._set(self._details, camera_details(state, camera, now))
        self._set(self._tiles, picture_tiles(state, now, wanted=self.options.pictures))
        self._set(self._lags, lag_charts(state, now))
        if self._recording is not None:
            self._show_recording(state, now)
        if self._player is not None:
            self._show_time(self._player)

    def update_uavs(self, state: ViewState, now: float) -> None:
        """Update the drones' panels."""
        for name in [name for name in self._uavs if name not in state.uavs]:
            self._uavs.pop(name).remove()
        for name, uav in state.uavs.items():
            if name not in self._uavs:
                self._uavs[name] = _UavPanel(self._server, name, self._overview.order + 0.5)
            drawn = self._uavs[name].update(uav, now)
            if drawn is not None and not state.cameras:
                self._fill(drawn)
        if self._filled and (state.cameras or not state.uavs):
            self._fill(None)

    def _fill(self, drawn: Any) -> None:
        """Show a drone's image on the whole page if there is no rig to show in 3-D; None removes it."""
        self._filled = drawn is not None
        for client in self._server.get_clients().values():
            # A browser stretches the background image to its window.
            image = None if drawn is None else pad_to_aspect(drawn, client.camera.aspect)
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=75)

    def _set(self, handle: Any, text: str) -> None:
        if self._texts.get(id(handle)) != text:
            self._texts[id(handle)] = text
            handle.content = text

    def _show_recording(self, state: ViewState, now: float) -> None:
        """Say what the recorders do, and offer only what would change it."""
        self._set(self._recording, recording_html(state, now))
        recording = [agent.recording for agent in state.of_role("record")]
        for action, visible in (("start_recording", not all(recording)), ("stop_recording", any(recording))):
            if action in self._buttons:
                self._buttons[action].visible = visible

    def _add_actions(self, allowed: bool, actions: tuple[str, ...]) -> None:
        gui = self._server.gui
        with gui.add_folder("Actions"):
            if "start_recording" in actions:
                self._recording = gui.add_html("")
            for action in actions:
                button = gui.add_button(ACTIONS[action], hint=_HINTS[action], disabled=not allowed)
                button.on_click(partial(self._clicked, action))
                self._buttons[action] = button
            text = "" if allowed else "Read-only: start the view without --look-only to enable the buttons."
            self._note = gui.add_markdown(text)

    def _clicked(self, action: str, event: Any) -> None:
        self.requested_actions.append(action)
        client = event.client
        if action == "export" and client is not None:
            text = calibration_file(self._state)
            if text:
                client.send_file_download("calibration.toml", text.encode(), save_immediately=True)

    def show_result(self, text: str) -> None:
        """Show the result of a click."""
        if self._note is not None:
            self._note.content = text

    def _add_options(self) -> None:
        gui, options = self._server.gui, self.options
        with gui.add_folder("Show", expand_by_default=False):
            for name, label in (
                ("pictures", "pictures"),
                ("rays", "rays to the target"),
                ("paths", "paths"),
                ("uncertainty", "uncertainty (3 std)"),
            ):
                box = gui.add_checkbox(label, True)
                box.on_update(partial(self._switched, name))
            uncertainty_scale = gui.add_slider("uncertainty ×", 1, 100, 1, int(options.uncertainty_scale))
            uncertainty_scale.on_update(partial(self._switched, "uncertainty_scale"))

    def _switched(self, name: str, event: Any) -> None:
        setattr(self.options, name, event.target.value)

    def _add_timeline(self, player: Player) -> None:
        gui = self._server.gui
        with gui.add_folder("Replay"):
            # At least 0.1 s: a slider of no length is not shown.
            self._time: Any = gui.add_slider("time [s]", 0.0, max(round(player.duration, 1), 0.1), 0.1, 0.0)
            self._play = gui.add_button("Pause" if player.playing else "Play")
            self._speed = gui.add_dropdown("speed", ("0.25", "0.5", "1", "2", "5", "10"), initial_value="1")

        self._time_shown = 0.0

        @self._time.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # moved by the user, not by the replay
                self._time_shown = player.seek_to = float(self._time.value)

        @self._play.on_click
        def _(event: Any) -> None:
            player.playing = not player.playing
            if player.playing and player.position >= player.duration:
                player.seek_to = 0.0
            self._show_time(player)

        @self._speed.on_update
        def _(event: Any) -> None:
            player.speed = float(self._speed.value)

    def _show_time(self, player: Player) -> None:
        # The time before the button: who reads "Play" and types a time must not have it overwritten by a late one.
        self._show_position(player)
        label = "Pause" if player.playing else "Play"
        if self._play.label != label:
            self._play.label = label

    def _show_position(self, player: Player) -> None:
        value = min(round(player.position, 1), self._time.max)
        if player.seek_to is not None:
            return
        if self._time.value != self._time_shown:
            # The replay did not set it, so the user did; the callback is late, or two of them overtook each other.
            self._time_shown = player.seek_to = float(self._time.value)
        elif abs(self._time_shown - value) >= 0.1:
            self._time.value = self._time_shown = value


class _UavPanel:
    """One drone: its image with the estimated target, and the estimate as text."""

    def __init__(self, server: viser.ViserServer, name: str, order: float) -> None:
        gui = server.gui
        self._folder: Any = gui.add_folder(f"Drone {name}", order=order)
        with self._folder:
            self._picture: Any = gui.add_image(draw_uav(UavView(name), None), format="jpeg", jpeg_quality=75)
            self._words: Any = gui.add_html("")
        self._drawn: tuple[int, ...] = ()
        self._decoded_image: tuple[int, Any] = (0, None)
        self._text = ""

    def update(self, uav: UavView, now: float) -> Any:
        """Draw new data; returns the drawing, None if it is unchanged."""
        drawing = None
        target, particles, _ = uav.at_image()
        # By identity too: after a seek in a replay the counts restart.
        key = (
            id(uav),
            uav.pictures,
            -1 if target is None else target.sequence,
            -1 if particles is None else particles.sequence,
        )
        if key != self._drawn:
            self._drawn = key
            if uav.picture is None:
                self._decoded_image = (0, None)
            elif self._decoded_image[0] != id(uav.picture):
                self._decoded_image = (id(uav.picture), decode_rgb(uav.picture.jpeg))
            drawing = self._picture.image = draw_uav(uav, self._decoded_image[1])
        text = uav_panel_html(uav, now)
        if text != self._text:
            self._text = self._words.content = text
        return drawing

    def remove(self) -> None:
        """Remove the panel."""
        self._folder.remove()


def draw_detections(image: Any, camera: CameraView) -> Any:
    """An image (H, W, 3) RGB with circles around the detections of its own frame."""
    import cv2

    picture = camera.picture
    assert picture is not None
    scale = image.shape[1] / picture.width
    out = image.copy()
    for u, v, size in camera.detections_in_image()[:64]:
        centre = (round((u + 0.5) * scale), round((v + 0.5) * scale))
        radius = max(8, round(0.5 * size * scale) + 5)
        for colour, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.circle(out, centre, radius, colour, width, cv2.LINE_AA)
    return out
