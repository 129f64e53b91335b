"""Cameras whose clock is set while they record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from google.protobuf.message import Message

from hub.calibration.pipeline import calibrate
from hub.calibration.resection.set_clocks import set_clocks
from hub.clocks.observation_stream import session_from_messages
from protocols.session.observations import Observations, gather_tracks
from tests.support import rigs
from tests.support.session_messages import info_messages, row_messages

SECONDS = 30.0


def with_clock_set(session: rigs.Session, camera: str, size: float, at: float = 0.4) -> Observations:
    """The session's observations with ``size`` [s] added to a camera's times from this share of its frames on."""
    mine = session.of_camera(camera)
    late = session.frame >= np.quantile(session.frame[mine], at)
    time = session.time + np.where(mine & late, size, 0.0)
    return gather_tracks(session.camera, session.label, session.frame, time, session.pixels, np.full(len(time), np.nan))


@pytest.mark.parametrize("size", [-60.0, -0.5, 2.0, 3600.0])
def test_a_camera_whose_clock_was_set_is_calibrated_by_its_longest_part(size: float) -> None:
    session = rigs.simulate(41, 4, SECONDS)
    found = calibrate(session.rig, with_clock_set(session, "cam2", size), thorough=True)
    assert "cam2" in found.cameras
    assert f"cam2: its clock was set by about {size:+.1f} s" in found.warnings[-1]
    even = calibrate(session.rig, session.observations(), thorough=True).cameras["cam2"]
    np.testing.assert_allclose(found.cameras["cam2"].pose.position, even.pose.position, atol=0.01)
    assert found.cameras["cam2"].lag == pytest.approx(even.lag - size, abs=1e-3)


@pytest.mark.parametrize(("size", "at"), [(1.0, 0.9), (5.0, 0.1)])
def test_a_camera_that_is_placed_by_its_rows_on_one_side_says_so(size: float, at: float) -> None:
    """The others were rejected, or where no path is, without a word; after them the map is wrong by the setting."""
    session = rigs.simulate(43, 4, 40.0)
    found = calibrate(session.rig, with_clock_set(session, "cam2", size, at), thorough=True)
    (warning,) = found.warnings
    assert warning.startswith(f"cam2: its clock was set by about {size:+.1f} s while its frames were counted")
    time_map = found.cameras["cam2"].time_map
    late = time_map.clock_rate * size if at < 0.5 else 0.0
    assert abs(session.clock_error("cam2", found.reference, time_map) + late) < 1e-3


def _with_frames_lost(session: rigs.Session, camera: str, *begins: float) -> list[Message]:
    """The session's messages without the frames of 0.5 s from these times on, which the camera does not count."""
    lost = np.zeros(len(session.time), np.bool_)
    frame, shown = session.frame.copy(), session.time - session.time[session.of_camera(camera)][0]
    for begin in begins:
        mine = session.of_camera(camera) & (shown >= begin)
        lost |= mine & (shown < begin + 0.5)
        frame[mine] -= int((session.of_camera(camera) & (shown < begin + 0.5) & (shown >= begin)).sum())
    kept, counted = [int(i) for i in np.flatnonzero(~lost)], replace(session, frame=frame)
    boot = lambda name: "b"  # noqa: E731
    rows = row_messages(counted, boot, kept, lambda i: float(session.time[i]))
    return [*info_messages(session, boot), *rows]


def test_frames_that_a_camera_lost_and_did_not_count_are_no_step_of_its_clock_in_a_log() -> None:
    """The longest part between two of them was used of the camera, and the others were of "other boots"."""
    session = rigs.simulate(44, 3, SECONDS)
    recorded = session_from_messages(_with_frames_lost(session, "cam1", 8.0, 16.0, 23.0))
    assert recorded.warnings == ()
    found = calibrate(recorded.rig, recorded.observations, thorough=True)
    assert found.warnings == ()
    assert len(found.residuals["cam1"]) > 0.9 * len(recorded.observations.of_camera("cam1")[0])
    assert np.ptp(found.residuals["cam1"][:, 0]) > 0.9 * SECONDS


def test_pauses_shuffled_rows_and_even_clocks_are_no_settings() -> None:
    session = rigs.simulate(42, 2, SECONDS)
    assert not set_clocks(["cam0", "cam1"], session.observations())
    mine = session.of_camera("cam1")
    shuffled = replace(session, time=session.time.copy())
    shuffled.time[mine] = np.random.default_rng(1).permutation(session.time[mine])
    assert not set_clocks(["cam1"], shuffled.observations())
    # Ten pauses, while which no frame is counted.
    paused = session.time + np.where(mine, 1.0 + session.frame // 80, 0.0)
    assert not set_clocks(["cam1"], replace(session, time=paused).observations())
    assert list(set_clocks(["cam1"], with_clock_set(replace(session, time=paused), "cam1", -90.0))) == ["cam1"]
