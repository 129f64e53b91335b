"""Cameras whose clock is set while they record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from hub.calibration.resection.set_clocks import SetClock, set_clocks
from protocols.session.observations import Observations, gather_tracks
from tests.support import rigs

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


@pytest.mark.parametrize(("at", "turn"), [(26.0, 0.02), (34.0, 0.1), (26.0, 0.1)])
def test_a_camera_that_was_turned_while_it_paused_was_moved(at: float, turn: float) -> None:
    """Its frames are not counted while it pauses: the rows after it are those of another pose, not of another clock."""
    session = rigs.simulate(41, 4, 40.0).turned("cam2", at, turn)
    mine = session.of_camera("cam2")
    lost = mine & (session.true > at) & (session.true < at + 2.0)
    frame = session.frame.copy()
    frame[mine & (session.true >= at + 2.0)] -= len(np.unique(frame[lost]))
    found = calibrate(session.rig, replace(session, frame=frame).where(~lost).observations(), thorough=True)
    assert ["cam2" in text and "moved" in text for text in found.warnings] == [True]


def test_the_few_rows_that_are_known_after_a_pause_are_used() -> None:
    session = rigs.simulate(43, 4, 40.0)
    mine = session.of_camera("cam2")
    lost, away = (session.true > 24.0) & (session.true < 30.0), (session.true > 30.4) & ~mine
    frame = session.frame.copy()
    frame[mine & (session.true >= 30.0)] -= len(np.unique(frame[mine & lost]))
    seen = replace(session, frame=frame).where(~(mine & lost) & ~away).observations()
    found = calibrate(session.rig, seen, thorough=True)
    assert found.warnings == ()
    assert np.ptp(found.residuals["cam2"][:, 0]) > 29.5


def test_a_part_in_the_middle_that_is_left_out_is_named() -> None:
    assert (
        SetClock(((0, 399), (700, 958)), 3.0, 300)
        .warning("cam1")
        .endswith("only frames 0 to 399, 700 to 958 were used, 300 others left out")
    )


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
