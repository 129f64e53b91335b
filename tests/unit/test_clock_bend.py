"""A clock that bends: what it stamps from then on is put on the line on which it ran before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.clocks.change_detector import ClockEvent
from hub.clocks.rate_change import Bend, Bends
from hub.live.live_hub import LiveHub, LiveSettings
from protocols.messages import syncline_pb2 as pb
from tests import rigs
from tests.bench.live_clocks import CHANGED, CHANGES_AT_S, Change, stream

EPOCH_S = 1_700_000_000.0
DRIFT = ClockEvent("cam1", "drift", "boot-1", "boot-1-e1", step_s=9e-4, std_s=1e-4, rate=2e-4, at_s=EPOCH_S + 34.5)
STEP = replace(DRIFT, kind="step", before="boot-1-e1", boot="boot-1-e2", step_s=3.0, rate=0.0, at_s=0.0)


def shown(true: float) -> float:
    """A clock that runs 200 ppm fast from the 30th second on."""
    return EPOCH_S + true + 2e-4 * max(true - 30.0, 0.0)


def shown_at(true: np.ndarray) -> np.ndarray:
    return np.array([shown(float(t)) for t in true])


def test_a_bend_begins_where_the_old_line_was_left() -> None:
    bend = Bend.of(DRIFT)
    assert bend.at_s == pytest.approx(EPOCH_S + 30.0, abs=1e-6)
    assert (bend.before, bend.after, bend.told_s) == ("boot-1", "boot-1-e1", DRIFT.at_s)


def test_what_the_new_clock_shows_is_put_on_the_old_one_to_the_microsecond() -> None:
    bend = Bend.of(DRIFT)
    for true in (34.6, 40.0, 60.0):
        old_ns = bend.on_old_clock(round(shown(true) * 1e9))
        assert abs(old_ns * 1e-9 - EPOCH_S - true) < 5e-6


def test_only_rows_between_the_bend_and_its_alarm_are_straightened() -> None:
    true = np.array([10.0, 29.9, 31.0, 34.0])
    times = np.array([shown(t) for t in true])
    np.testing.assert_allclose(Bend.of(DRIFT).straightened(times) - EPOCH_S, true, atol=5e-6)
    later = np.array([EPOCH_S + 35.0])  # put right as it came
    np.testing.assert_array_equal(Bend.of(DRIFT).straightened(later), later)


def test_what_was_put_by_the_first_guess_is_put_right_by_the_last() -> None:
    """Frames from before and after the alarm, and the one with which it was told, all on the old clock's line."""
    first = replace(DRIFT, step_s=6e-4, rate=1.6e-4)
    amended = Bend.of(first).amended(DRIFT)
    assert amended.amended(None) == amended
    true = np.array([20.0, 31.0, 34.4])
    np.testing.assert_allclose(amended.straightened(shown_at(true)) - EPOCH_S, true, atol=5e-6)
    later = shown_at(np.array([34.4992, 40.0, 60.0]))
    put = np.array([amended.on_old_clock(round(time * 1e9)) * 1e-9 for time in later])
    assert np.abs(put - EPOCH_S - [34.4992, 40.0, 60.0]).max() > 2e-4
    np.testing.assert_allclose(amended.straightened(put) - EPOCH_S, [34.4992, 40.0, 60.0], atol=5e-6)


def test_a_bend_serves_until_its_new_epoch_does_and_a_step_ends_it() -> None:
    bends = Bends()
    bends.handle(DRIFT)
    assert bends.on_old_clock("cam1", "boot-1-e1", 0) is not None
    assert bends.on_old_clock("cam1", "boot-1", 0) is None
    assert bends.on_old_clock("cam0", "boot-1-e1", 0) is None
    assert bends.serving("cam1", "boot-1") is not None
    assert bends.serving("cam1", "boot-1-e1") is None
    assert bends.cameras == []
    bends.handle(DRIFT)
    bends.handle(STEP)
    assert bends.cameras == []
    with pytest.raises(ValueError, match="rate"):
        Bend.of(STEP)


@pytest.mark.parametrize("rate", [2e-4, -2e-4])
def test_the_map_holds_seconds_after_a_drift_was_told(rate: float) -> None:
    """A drift at 30 s; solved once, 23 s later, when the epoch before it would have to be carried on for 18 s."""
    session = rigs.simulate(70011, 3, CHANGES_AT_S + 23.0, late=2.0, fps=(30.0,))
    change = Change(rate=rate)
    hub = LiveHub(LiveSettings(window_s=30.0, interval_s=1e9, track=False))
    true = 0.0
    for true, message in stream(session, change, 70011):
        hub.handle(message, true + 2e-3)
    assert hub.counters["clock_drifts"] == 1
    solved = [out for out in hub.tick(true, final=True) if isinstance(out, pb.Calibration)]
    (camera,) = [camera for camera in solved[-1].cameras if camera.camera == CHANGED]
    now = change.shown(session.shown(CHANGED, true), true)
    off = camera.clock_rate * now + camera.time_offset - session.shown(solved[-1].reference_camera, true)
    assert abs(off) < 1e-3
