"""A step, a readout and jitter of a camera's clock are distinguished, whatever the motion and the frame rate."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hub.calibration.pipeline import calibrate
from tests.bench.clock_models import World, reported, session
from tests.unit.hub.bundle.test_timestamp_jitter import jittery

USUAL = World(seconds=40.0, noise=0.5, fps=(30.0, 25.0, 29.97, 50.0), fastest=0.7, focal_error=0.0, labels=1)
FAST = replace(USUAL, fps=(10.0, 12.0, 10.0, 15.0), fastest=2.5)


@pytest.mark.parametrize(
    ("effect", "world"),
    [
        ("readout+jitter5", USUAL),  # the estimated frame times took the readout up
        ("readout+jitter5", replace(USUAL, fps=FAST.fps)),
        ("readouts", FAST),  # were jitter
        ("step15", FAST),  # residuals that change sign from frame to frame were taken for white
        ("step30+jitter10", FAST),
        ("jitter20", replace(USUAL, focal_error=0.01)),
        ("step15", replace(USUAL, noise=1.5, seconds=20.0)),
    ],
)
def test_what_a_clock_does_is_reported_and_nothing_else(effect: str, world: World) -> None:
    rig, observations, clocks = session(7001, effect, world)
    found = calibrate(rig, observations)
    for name, true in clocks.items():
        said = reported(found, name)
        assert said is not None
        assert len(said.steps) == len(true.steps)
        for (at, size, _), (when, estimate, std) in zip(true.steps, said.steps, strict=True):
            assert abs(when - at) < 1.0
            assert abs(estimate - size) < 4.0 * std < 0.02
        assert (said.jitter > 1e-4) == (true.jitter > 0.0)
        assert said.readout == pytest.approx(true.readout, abs=4.5 * said.readout_std)
        assert said.readout_std < 0.003


@pytest.mark.parametrize("seed", [5125, 5126, 5129])
def test_jitter_that_several_labels_share_is_no_step(seed: int) -> None:
    """Taken for independent, the rows of a frame say four times as much of it."""
    one = jittery(seed, 0.03, labels=4)
    found = calibrate(one.rig, one.observations())
    assert not any(camera.clock_steps for camera in found.cameras.values())
