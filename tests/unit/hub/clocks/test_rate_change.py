"""A clock whose rate changes: its new time stamps are expressed on the clock before the change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.clocks.change_detector import ClockChange
from hub.clocks.segments import RateChange, RateChanges
from hub.live.live_hub import LiveHub, LiveSettings
from protocols.messages import syncline_pb2 as pb
from tests.bench.live_clocks import CHANGED, CHANGES_AT_S, Change, stream
from tests.support import rigs

EPOCH_S = 1_700_000_000.0
DRIFT = ClockChange(
    "cam1", "drift", "boot-1", "boot-1-e1", step_s=9e-4, step_std_s=1e-4, rate_change=2e-4, detected_at_s=EPOCH_S + 34.5
)
STEP = replace(
    DRIFT,
    kind="step",
    previous_segment="boot-1-e1",
    segment="boot-1-e2",
    step_s=3.0,
    rate_change=0.0,
    detected_at_s=0.0,
)


def shown(true: float) -> float:
    """A clock that runs 200 ppm fast from the 30th second on."""
    return EPOCH_S + true + 2e-4 * max(true - 30.0, 0.0)


def shown_at(true: np.ndarray) -> np.ndarray:
    return np.array([shown(float(t)) for t in true])


def test_the_onset_is_where_the_previous_line_was_left() -> None:
    change = RateChange.of(DRIFT)
    assert change.onset_s == pytest.approx(EPOCH_S + 30.0, abs=1e-6)
    assert (change.previous_segment, change.segment, change.detected_at_s) == (
        "boot-1",
        "boot-1-e1",
        DRIFT.detected_at_s,
    )


def test_new_time_stamps_are_converted_to_the_previous_clock_within_microseconds() -> None:
    change = RateChange.of(DRIFT)
    for true in (34.6, 40.0, 60.0):
        old_ns = change.to_previous_clock(round(shown(true) * 1e9))
        assert abs(old_ns * 1e-9 - EPOCH_S - true) < 5e-6


def test_only_rows_between_onset_and_detection_are_corrected() -> None:
    true = np.array([10.0, 29.9, 31.0, 34.0])
    times = np.array([shown(t) for t in true])
    np.testing.assert_allclose(RateChange.of(DRIFT).corrected(times) - EPOCH_S, true, atol=5e-6)
    later = np.array([EPOCH_S + 35.0])  # was converted on arrival
    np.testing.assert_array_equal(RateChange.of(DRIFT).corrected(later), later)


def test_rows_converted_by_the_first_estimate_are_corrected_by_the_refined_one() -> None:
    """Frames before, at and after the detection all come to lie on the previous clock."""
    first = replace(DRIFT, step_s=6e-4, rate_change=1.6e-4)
    refined = RateChange.of(first).refined(DRIFT)
    assert refined.refined(None) == refined
    true = np.array([20.0, 31.0, 34.4])
    np.testing.assert_allclose(refined.corrected(shown_at(true)) - EPOCH_S, true, atol=5e-6)
    later = shown_at(np.array([34.4992, 40.0, 60.0]))
    converted = np.array([refined.to_previous_clock(round(time * 1e9)) * 1e-9 for time in later])
    assert np.abs(converted - EPOCH_S - [34.4992, 40.0, 60.0]).max() > 2e-4
    np.testing.assert_allclose(refined.corrected(converted) - EPOCH_S, [34.4992, 40.0, 60.0], atol=5e-6)


def test_a_rate_change_is_active_until_the_new_segment_is_in_use_and_a_step_ends_it() -> None:
    changes = RateChanges()
    changes.handle(DRIFT)
    assert changes.to_previous_clock("cam1", "boot-1-e1", 0) is not None
    assert changes.to_previous_clock("cam1", "boot-1", 0) is None
    assert changes.to_previous_clock("cam0", "boot-1-e1", 0) is None
    assert changes.active("cam1", "boot-1") is not None
    assert changes.active("cam1", "boot-1-e1") is None
    assert changes.cameras == []
    changes.handle(DRIFT)
    changes.handle(STEP)
    assert changes.cameras == []
    with pytest.raises(ValueError, match="rate"):
        RateChange.of(STEP)


@pytest.mark.parametrize("rate", [2e-4, -2e-4])
def test_the_time_map_is_accurate_seconds_after_a_rate_change_was_detected(rate: float) -> None:
    """Rate change at 30 s; calibrated once, 23 s later, when the previous segment would be extrapolated by 18 s."""
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
