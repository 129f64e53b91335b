"""A step, a readout and jitter of a camera's clock are distinguished, whatever the motion and the frame rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from hub.calibration.result import _rounding_std
from protocols.geometry.camera import Intrinsics
from protocols.session.observations import Observations
from tests.bench.clock_models import World, reported, session
from tests.support.rigs import simulate
from tests.unit.hub.bundle.test_timestamp_jitter import jittery

USUAL = World(seconds=40.0, noise=0.5, fps=(30.0, 25.0, 29.97, 50.0), fastest=0.7, focal_error=0.0, labels=1)
FAST = replace(USUAL, fps=(10.0, 12.0, 10.0, 15.0), fastest=2.5)


@pytest.mark.parametrize(
    ("effect", "world"),
    [
        ("readout+jitter5", USUAL),  # the estimated frame times took the readout up
        ("readout+jitter5", replace(USUAL, fps=FAST.fps)),
        ("readouts", FAST),  # were jitter
        ("reversed", USUAL),  # other cameras had readouts, or clocks whose rate changes
        ("readouts+reversed", USUAL),
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
        said = reported(found, name, clocks)
        assert said is not None
        assert len(said.steps) == len(true.steps)
        for (at, size, _), (when, estimate, std) in zip(true.steps, said.steps, strict=True):
            assert abs(when - at) < 1.0
            assert abs(estimate - size) < 4.0 * std < 0.02
        assert (said.jitter > 1e-4) == (true.jitter > 0.0)
        assert said.readout == pytest.approx(true.readout, abs=4.5 * said.readout_std)
        assert said.readout_std < 0.003


def test_the_readout_of_a_portrait_picture_runs_along_its_columns() -> None:
    """It was taken for clocks whose rate changes, and lags were 2 ms off."""
    rig, observations, clocks = session(7001, "readouts", USUAL)
    cameras, tracks = {}, {}
    for name, camera in rig.cameras.items():  # held upright and turned by 90°: (u, v) is now (h - 1 - v, u)
        lens, height = camera.intrinsics, camera.size[1]
        assert lens is not None
        (fx, _, cx), (_, fy, cy), _ = lens.matrix
        k1, k2, p1, p2, k3 = lens.distortions
        matrix = np.array([[fy, 0.0, height - 1 - cy], [0.0, fx, cx], [0.0, 0.0, 1.0]])
        turned = Intrinsics(height, camera.size[0], matrix, np.array([k1, k2, p2, -p1, k3]))
        cameras[name] = replace(camera, size=(height, camera.size[0]), intrinsics=turned)
        for track in observations.of_camera(name):
            pixels = np.column_stack([height - 1 - track.pixels[:, 1], track.pixels[:, 0]])
            tracks[name, track.label] = replace(track, pixels=pixels)
    found = calibrate(replace(rig, cameras=cameras), Observations(tracks))
    for name, true in clocks.items():
        said = reported(found, name, clocks)
        assert said is not None
        assert abs(said.lag_z) < 4.0
        assert said.readout == pytest.approx(-true.readout, abs=4.5 * said.readout_std)
        assert said.readout_std < 0.003


SHORT = World(seconds=15.0, noise=1.0, fps=(10.0, 30.0, 15.0, 25.0), fastest=1.0, focal_error=0.0, labels=1)
LONGER = replace(SHORT, seconds=30.0, noise=0.5, fps=(25.0, 30.0, 50.0))


@pytest.mark.parametrize(
    ("effect", "seed", "world"),
    [
        ("step60", 7003, SHORT),  # a false frame rate explained most of it
        ("step60", 7001, SHORT),  # fitted at no lag
        ("step100", 7001, LONGER),
    ],
)
def test_a_clock_step_is_neither_a_frame_rate_nor_a_refused_camera(effect: str, seed: int, world: World) -> None:
    rig, observations, clocks = session(seed, effect, world)
    found = calibrate(rig, observations, thorough=True)
    assert len(found.cameras) == len(clocks)
    assert not any("frame rate" in text for text in found.warnings)
    for name, camera in found.cameras.items():
        assert len(camera.clock_steps) == len(clocks[name].steps)
        for (at, size, _), (when, estimate, _) in zip(clocks[name].steps, camera.clock_steps, strict=True):
            assert abs(when - at) < 0.2
            assert abs(estimate - size) < 0.005


def test_a_rate_beside_a_step_is_less_certain() -> None:
    """Two halves of a recording with a free step between them give a rate a quarter of its information: it had a std
    as of one whole, and was off by twice it (rms of twelve simulated rigs)."""
    usual = simulate(5, 3, 80.0, fps=(30.0, 30.0, 30.0))
    tracks = usual.observations().tracks
    middle = usual.middle("cam2")
    stepped = {
        key: replace(track, time=track.time + 0.05 * (track.time >= middle)) if key[0] == "cam2" else track
        for key, track in tracks.items()
    }
    even, found = (calibrate(usual.rig, Observations(one)).cameras["cam2"] for one in (tracks, stepped))
    assert len(found.clock_steps) == 1
    assert found.clock_rate_std / even.clock_rate_std == pytest.approx(2.0, rel=0.2)


def test_coarse_stamps_of_an_even_clock_make_a_lag_less_certain() -> None:
    """At 30 frames a second and 10 ms each third rounding error is the same: lags were 1.3 ms off at stds of 0.1 ms.

    A clock that drifts goes through all errors, though slowly; those of uneven frames have nothing in common.
    """
    rng = np.random.default_rng(1)
    for drift in (0.0, 2e-5):
        even = np.delete((np.arange(900) + 0.2) / 30.0 * (1.0 + drift), rng.integers(0, 900, 90))
        assert _rounding_std([np.asarray(np.round(even, 2))])[0] == pytest.approx(0.01 / 3.0 / 12.0**0.5, rel=0.05)
        assert _rounding_std([np.asarray(1.7e9 + np.round(even, 3))])[0] == pytest.approx(
            1e-3 / 3.0 / 12.0**0.5, rel=0.15
        )
        assert _rounding_std([np.asarray(np.round(even + rng.normal(0.0, 3e-3, len(even)), 2))]) == (0.0, 0.0)
        assert _rounding_std([even]) == (0.0, 0.0)
        few = np.sort(rng.choice(even, 400, replace=False))  # seen in fewer than half of the frames
        assert _rounding_std([np.asarray(np.round(few, 2))])[0] == pytest.approx(0.01 / 3.0 / 12.0**0.5, rel=0.2)
    whole = np.arange(900) / 25.0
    for step in (0.0, 0.13, 0.14, 5.01):  # of the clock, or a pause of its camera
        assert _rounding_std([whole + step * (whole >= 16.0)]) == (0.0, 0.0)
    assert _rounding_std([]) == (0.0, 0.0)


def test_jitter_of_few_frames_is_no_step() -> None:
    rig, observations, _ = session(9008, "jitters5", World(15.0, 0.5, (6.0, 10.0, 15.0, 10.0), 0.7, 0.01, 3))
    assert not any(camera.clock_steps for camera in calibrate(rig, observations).cameras.values())


def test_a_reference_that_runs_at_another_frame_rate_is_named_itself() -> None:
    rig, observations, _ = session(7001, "none", USUAL)
    late = {
        key: replace(track, time=1.004 * track.time) if key[0] == "cam0" else track
        for key, track in observations.tracks.items()
    }
    (said,) = [text for text in calibrate(rig, Observations(late)).warnings if "frame rate" in text]
    assert said.startswith("cam0")


@pytest.mark.parametrize("seed", [5125, 5126, 5129])
def test_jitter_that_several_labels_share_is_no_step(seed: int) -> None:
    """Taken for independent, the rows of a frame say four times as much of it."""
    one = jittery(seed, 0.03, labels=4)
    found = calibrate(one.rig, one.observations())
    assert not any(camera.clock_steps for camera in found.cameras.values())
