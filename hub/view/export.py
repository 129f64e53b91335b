"""calibration.toml from the messages of the bus, for download in the browser."""

from __future__ import annotations

from hub.live.messages import calibration_from_message
from hub.view.state import ViewState
from protocols.session.builder import rig_camera_from_info
from protocols.session.calibration import calibration_text
from protocols.session.rig import Rig


def calibration_file(state: ViewState) -> str:
    """The text of calibration.toml; "" if nothing is solved yet."""
    solved = state.solved
    if solved is None:
        return ""
    infos = {name: camera.info for name, camera in state.cameras.items() if camera.info is not None}
    rig = Rig({name: rig_camera_from_info(info) for name, info in infos.items()}, solved.units)
    return calibration_text(calibration_from_message(solved, infos), rig)
