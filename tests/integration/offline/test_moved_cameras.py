"""A camera that is moved during a recording: named with time and angle, one side used, the others as without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from tests.support.rigs import Session, simulate


@pytest.mark.parametrize(("cameras", "since", "angle"), [(4, 8.0, 0.03), (5, 20.0, 0.1), (3, 21.0, 0.3)])
def test_a_turned_camera_is_named_and_its_longer_side_is_used(cameras: int, since: float, angle: float) -> None:
    session = simulate(5, cameras, 30)
    found = calibrate(*_given(session.turned("cam2", since, angle)), thorough=True)
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


@pytest.mark.parametrize("times", [(17.0, 43.0), (15.0, 30.0), (12.0, 24.0, 40.0)])
def test_a_camera_that_was_moved_several_times_is_placed_by_its_longest_part(times: tuple[float, ...]) -> None:
    session = simulate(8, 3, 60)
    clock = session.clocks["cam2"]
    turned = [session]
    for since, angle in zip(times, (0.1, -0.06, 0.15), strict=False):
        turned.append(turned[-1].turned("cam2", since, angle))
    found = calibrate(*_given(turned[-1]), thorough=True)
    (text,) = [text for text in found.warnings if "moved" in text]
    assert text.startswith("cam2: it was moved")
    named = [float(number) for number in text.split("at its time ")[1].split(" s")[0].split(" and ")]
    assert named == pytest.approx([(since - clock.time_offset) / clock.clock_rate for since in times], abs=0.5)
    longest = int(np.diff([0.0, *times, 60.0]).argmax())
    as_kept = replace(session, poses=turned[longest].poses)
    assert as_kept.turn_error({name: camera.pose for name, camera in found.cameras.items()}) < 0.01
    assert abs(session.clock_error("cam2", found.reference, found.cameras["cam2"].time_map)) < 1e-3


def test_a_moved_camera_is_named_though_the_path_follows_it_where_only_one_other_sees_the_target() -> None:
    windows = [(0.0, 60.0)] * 2 + [(0.0, 27.0), (14.0, 60.0)]
    session = simulate(16, 4, 60, outliers=0.02, windows=windows).turned("cam1", 21.0, 0.08)
    (warning,) = [text for text in calibrate(*_given(session), thorough=True).warnings if "it was moved" in text]
    assert warning.startswith("cam1: ")


@pytest.mark.parametrize(("seed", "since", "angle"), [(3, 12.0, 0.03), (4, 26.0, 0.2)])
def test_a_move_of_one_of_two_cameras_is_named_and_the_longer_side_is_used(
    seed: int, since: float, angle: float
) -> None:
    session = simulate(seed, 2, 40)
    found = calibrate(*_given(session.turned("cam1", since, angle)), thorough=True)
    (warning,) = [text for text in found.warnings if "was moved" in text]
    shown = session.shown("cam0", since)
    assert warning.startswith("one of cam0, cam1 was moved at cam0's time ")
    assert float(warning.split("time ")[1].split(" s")[0]) == pytest.approx(shown, abs=0.5)
    assert ("rows before that" in warning) == (since < 20.0)
    pose = session.poses["cam1"]
    true = so3.exp(np.array([0.0, angle, 0.0])) @ pose.rotation if since < 20.0 else pose.rotation
    after = replace(session, poses={**session.poses, "cam1": replace(pose, rotation=true)})
    assert after.turn_error({name: camera.pose for name, camera in found.cameras.items()}) < 0.01
    assert abs(session.clock_error("cam1", found.reference, found.cameras["cam1"].time_map)) < 1e-3


def test_of_two_cameras_a_clock_that_steps_or_a_wrong_lens_is_no_move() -> None:
    session = simulate(6, 2, 40)
    late = (np.array(session.camera) == "cam1") & (session.time > session.middle("cam1"))
    stepped = replace(session, time=session.time + 0.05 * late)
    lens = session.lens("cam1")
    longer = replace(lens, matrix=lens.matrix @ np.diag([1.02, 1.02, 1.0]))
    wrong = {**session.rig.cameras, "cam1": replace(session.rig.cameras["cam1"], intrinsics=longer)}
    for given in (stepped, replace(session, rig=replace(session.rig, cameras=wrong))):
        try:
            found = calibrate(*_given(given), thorough=True).warnings
        except Refused as refusal:
            found = (refusal.reason,)
        assert not [text for text in found if "moved" in text]


def test_cameras_that_stand_still_are_not_moved() -> None:
    for seed in range(3):
        found = calibrate(*_given(simulate(seed, 4, 20)), thorough=True)
        assert not [text for text in found.warnings if "moved" in text]


def _given(session: Session) -> tuple[Rig, Observations]:
    return session.rig, session.observations()
