"""Clocks whose rate changes: the curve beside an even clock, and lags that hold with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from hub.bundle.noise.clock_wander import Wander, fit_wander
from hub.bundle.noise.timestamp_jitter import _FrameRows, _is_path_held, _wanders
from hub.bundle.problem import AdjustmentState, CameraState, Problem, TrackObservations
from hub.calibration.incremental import update_calibration
from hub.calibration.pipeline import calibrate
from protocols.core.clocks import CameraTime
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Bools, Floats
from tests.bench import clock_models
from tests.support import rigs

_WORLD = clock_models.World(60.0, 0.4, (30.0, 25.0, 29.97, 50.0), 0.7, 0.0, 1)


@given(st.integers(0, 10**6))
def test_an_even_clock_in_white_noise_does_not_wander(seed: int) -> None:
    random = np.random.default_rng(seed)
    time = np.sort(random.uniform(0.0, 60.0, 900))
    even = 1e-3 * random.normal() + 1e-4 * random.normal() * time
    found = fit_wander(0, time, even + random.normal(0.0, 1e-3, 900), np.full(900, 1e6), 30.0)
    assert found is not None
    assert found.gain < 25.0  # one in four million
    assert abs(float(found.at(np.array([30.0]))[0])) < 1e-9


def test_a_slew_is_followed_within_its_noise_and_agrees_with_the_clock_at_the_instant() -> None:
    random, time = np.random.default_rng(1), np.linspace(0.0, 60.0, 1800)
    slew = 5e-4 * (np.maximum(time - 20.0, 0.0) - np.maximum(time - 40.0, 0.0))
    found = fit_wander(0, time, slew + random.normal(0.0, 1e-3, 1800), np.full(1800, 1e6), 50.0)
    assert found is not None
    assert found.gain > 1000.0
    off = found.at(time) - (slew - 0.01)  # 10 ms at 50 s, and no rate there
    assert np.abs(off[np.abs(time - 50.0) < 2.0]).max() < 3e-4
    assert np.abs(off - np.polyval(np.polyfit(time, off, 1), time)).max() < 1e-3
    assert abs(np.polyfit(time, off, 1)[0]) < 3.0 * found.rate_std < 2e-4
    assert 2e-5 < found.std < 3e-4


def test_a_clock_that_was_known_to_wander_is_even_once_nothing_is_gained() -> None:
    """It remained in the answer, "off by up to 4.7e-07 ms"."""
    random, stamp = np.random.default_rng(3), np.linspace(0.0, 60.0, 900)
    rows = _FrameRows(np.arange(900), stamp, np.zeros((900, 2)), random.normal(size=(900, 2)), np.full((900, 2), 300.0))
    camera = CameraState(Intrinsics(640, 480, np.eye(3)), Pose.identity(), 1.0, 0.0, 0.0)
    state, known = (
        AdjustmentState((camera,), (), np.ones(1)),
        {0: Wander(0, 30.0, stamp[:2], np.zeros(2), 9.0, 0.0, 0.0)},
    )
    assert _wanders([rows], state, np.zeros(1), np.array([30.0]), known, further=False) == {}


@pytest.mark.parametrize("seed", [9103, 9105])
def test_a_clock_that_a_service_slews_is_told_and_every_lag_holds(seed: int) -> None:
    rig, observations, clocks = clock_models.session(seed, "slew500", _WORLD)
    found = calibrate(rig, observations)
    for name, true in clocks.items():
        said = clock_models.reported(found, name, clocks)
        assert said is not None
        assert bool(said.slews) == bool(true.slews)
        assert abs(said.lag_z) < 4.0


def test_correlated_errors_are_no_wander() -> None:
    session = rigs.simulate(41, 5, 40.0)
    random, pixels = np.random.default_rng(41), session.pixels.copy()
    for name in session.rig.cameras:
        mine = np.flatnonzero(session.of_camera(name))
        white = random.normal(0.0, 0.7 * np.sqrt(1.0 - 0.97**2), (len(mine), 2))
        pixels[mine] += lfilter([1.0], [1.0, -0.97], white, axis=0)
    found = calibrate(session.rig, replace(session, pixels=pixels).observations())
    assert not [text for text in found.warnings if "rate changes" in text]


@pytest.mark.parametrize("seed", [2, 12])
def test_a_path_extrapolated_where_one_camera_sees_the_target_is_no_wander(seed: int) -> None:
    session, random = rigs.simulate(seed, 2, 60.0, noise=2.0), np.random.default_rng(seed)
    keep, camera = np.ones(len(session.time), dtype=np.bool_), np.array(session.camera)
    for name in session.rig.cameras:  # out of view half of the time, two seconds each on average
        time = session.time[camera == name]
        keep[camera == name] = np.searchsorted(np.cumsum(random.exponential(2.0, 99)), time - time.min()) % 2 == 0
    found = calibrate(session.rig, session.observations(np.flatnonzero(keep)))
    assert not [text for text in found.warnings if "rate changes" in text]
    assert abs(session.clock_error("cam1", "cam0", found.cameras["cam1"].time_map)) < 4e-3


@pytest.mark.parametrize("slewed", ["cam0", "cam2"])
def test_a_clock_that_is_slewed_live_is_followed_also_as_the_reference(slewed: str) -> None:
    session = rigs.simulate(60, 5, 45.0)
    mine = session.of_camera(slewed)

    def added(true: Floats) -> Floats:
        """What the service has added to the clock at true times."""
        return np.asarray(5e-4 * (np.maximum(true - 15.0, 0.0) - np.maximum(true - 35.0, 0.0)))

    times = session.time.copy()
    times[mine] += added(np.array([session.true_time(slewed, time) for time in session.time[mine]]))
    found = update_calibration(session.rig, replace(session, time=times).observations(), None).calibration
    assert [text for text in found.warnings if text.startswith(f"{slewed}: its clock's rate changes")]
    for name, camera in found.cameras.items():
        at = camera.lag_time - (added(np.array([40.0]))[0] if name == slewed else 0.0)
        true = session.true_time(name, at)
        assert true > 40.0 or name != slewed
        shown = session.shown("cam0", true) + (added(np.array([true]))[0] if slewed == "cam0" else 0.0)
        error = float(camera.time_map.reference_from_camera(CameraTime(camera.lag_time))) - shown
        assert abs(error) < 4.0 * camera.lag_std + 1e-6


@pytest.mark.parametrize("interval", [0.04, 0.5])
def test_rows_are_shifted_where_others_hold_the_path_of_their_label(interval: float) -> None:
    times = np.arange(0.0, 20.0, interval)
    camera = CameraState(Intrinsics(640, 480, np.eye(3)), Pose.identity(), 1.0, 0.0, 0.0)

    def rows(number: int, label: int, seen: Bools) -> TrackObservations:
        time = times[seen]
        return TrackObservations(number, label, time, np.zeros((len(time), 2)), np.ones(len(time), np.bool_))

    every, early = times >= 0.0, (times < 8.0) | (times > 15.0)
    parts = (rows(0, 0, every), rows(1, 0, every), rows(0, 1, every), rows(1, 1, early), rows(2, 1, times < 5.0))
    problem = Problem(parts, (camera.intrinsics,) * 3, 0, (0, 1))
    state = AdjustmentState((camera,) * 3, (), np.ones(3))
    held = [_is_path_held(problem, state, part) for part in parts]
    assert held[0].all()
    assert held[1].all()
    np.testing.assert_array_equal(held[2], (times < 8.0 - 1e-9) | (times > 15.0))
    assert held[3].all()
