"""Cameras whose clock is set while they record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from hub.calibration.resection.set_clocks import set_clocks
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
