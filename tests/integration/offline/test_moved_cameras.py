"""A camera that is moved during a recording: named with time and angle, one side used, the others as without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.core.clocks import CameraTime
from protocols.geometry import so3
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from tests.support.rigs import Session, simulate


def turned(session: Session, name: str, since: float, angle: float) -> Session:
    """The session with a camera turned about its vertical axis from a true time on [s, rad]."""
    lens = session.rig.cameras[name].intrinsics
    assert lens is not None
    pixels, clock = session.pixels.copy(), session.clocks[name]
    for row in np.flatnonzero(np.array(session.camera) == name):
        if float(clock.reference_from_camera(CameraTime(float(session.time[row])))) > since:
            ray = np.append(lens.unproject(pixels[row : row + 1])[0], 1.0)
            pixels[row] = lens.project((so3.exp(np.array([0.0, angle, 0.0])) @ ray)[None])[0]
    return replace(session, pixels=pixels)


@pytest.mark.parametrize(("cameras", "since", "angle"), [(4, 8.0, 0.03), (5, 20.0, 0.1), (3, 21.0, 0.3)])
def test_a_turned_camera_is_named_and_its_longer_side_is_used(cameras: int, since: float, angle: float) -> None:
    session = simulate(5, cameras, 30)
    found = calibrate(*_given(turned(session, "cam2", since, angle)), thorough=True)
    (warning,) = [text for text in found.warnings if "it was moved" in text]
    assert warning.startswith("cam2: ")
    assert ("rows before that" in warning) == (since < 15.0)
    assert 0.5 < float(warning.split("turned by about ")[1].split("°")[0]) / np.degrees(angle) < 2.0
    clock = session.clocks["cam2"]
    shown = (since - clock.time_offset) / clock.clock_rate
    assert float(warning.split("at its time ")[1].split(" s")[0]) == pytest.approx(shown, abs=0.5)
    still = calibrate(*_given(session), thorough=True)
    for name in still.cameras.keys() - {"cam2"}:
        off = found.cameras[name].pose.position - still.cameras[name].pose.position
        assert np.linalg.norm(off) < 3.0 * np.linalg.norm(found.cameras[name].position_std) + 1e-9
    error = session.clock_error("cam2", found.reference, found.cameras["cam2"].time_map)
    assert abs(error) < 1e-3


def test_a_moved_camera_is_named_though_the_path_follows_it_where_only_one_other_sees_the_target() -> None:
    windows = [(0.0, 60.0)] * 2 + [(0.0, 27.0), (14.0, 60.0)]
    session = turned(simulate(16, 4, 60, outliers=0.02, windows=windows), "cam1", 21.0, 0.08)
    (warning,) = [text for text in calibrate(*_given(session), thorough=True).warnings if "it was moved" in text]
    assert warning.startswith("cam1: ")


def test_cameras_that_stand_still_are_not_moved() -> None:
    for seed in range(3):
        found = calibrate(*_given(simulate(seed, 4, 20)), thorough=True)
        assert not [text for text in found.warnings if "moved" in text]


def _given(session: Session) -> tuple[Rig, Observations]:
    return session.rig, session.observations()
