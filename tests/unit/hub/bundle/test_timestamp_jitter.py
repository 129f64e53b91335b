"""Timestamp jitter is detected, reported and removed from the poses; exact timestamps are left unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hub.calibration.final_adjustment
from hub.calibration.pipeline import calibrate
from protocols.session.calibration import Calibration
from tests.support import rigs

SEED = 5120
JITTERING = ("cam1", "cam2")


def jittery(
    seed: int, std: float, labels: int, cameras: tuple[str, ...] = JITTERING, outliers: float = 0.0
) -> rigs.Session:
    """A session in which the timestamps of some cameras have independent errors in every frame."""
    fps = (30.0, 25.0, 29.97, 50.0) if labels == 1 else (10.0, 10.0, 12.0, 15.0)
    seen = {f"p{i}": range(4) for i in range(labels)}
    session = rigs.simulate(seed, 4, 20.0, fps=fps, labels=seen, outliers=outliers)
    rng, names, time = np.random.default_rng(seed), np.array(session.camera), session.time.copy()
    for camera in cameras:
        mine = names == camera
        frames = session.frame[mine]
        time[mine] += rng.normal(0.0, std, int(frames.max()) + 1)[frames]
    return replace(session, time=time)


def turn_error(session: rigs.Session, found: Calibration) -> float:
    return float(np.degrees(session.turn_error({name: one.pose for name, one in found.cameras.items()})))


def reported_jitters(found: Calibration) -> dict[str, float]:
    """Jitter [ms] by camera, from the warnings."""
    reported = [text.split(": its stamps jitter by ") for text in found.warnings if "jitter" in text]
    return {name: float(rest.split()[0]) for name, rest in reported}


@pytest.mark.parametrize(("labels", "std", "outliers"), [(1, 0.02, 0.0), (1, 0.01, 0.05), (4, 0.03, 0.0)])
def test_jitter_is_reported_and_affects_neither_poses_nor_stds(
    labels: int, std: float, outliers: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = jittery(SEED + labels, std, labels, outliers=outliers)
    found = calibrate(session.rig, session.observations())
    reported = reported_jitters(found)
    assert tuple(reported) == JITTERING
    assert list(reported.values()) == pytest.approx([1e3 * std] * 2, rel=0.15)
    for name, camera in found.cameras.items():
        off = abs(session.clock_error(name, "cam0", camera.time_map))
        assert off <= 3.5 * camera.time_offset_std
        assert camera.time_offset_std < 0.15 * std
    monkeypatch.setattr(
        hub.calibration.final_adjustment, "estimate_frame_times", lambda problem, state, *_: (problem, state)
    )
    uncorrected = calibrate(session.rig, session.observations())
    assert turn_error(session, found) < 0.6 * turn_error(session, uncorrected)
    assert turn_error(session, found) < 0.2
    # Rows are reported with their original timestamps.
    mine = session.time[np.array(session.camera) == "cam1"]
    assert np.isin(np.round(found.residuals["cam1"][:, 0], 6), np.round(mine, 6)).all()


@pytest.mark.parametrize("labels", [1, 4])
def test_exact_timestamps_change_nothing(labels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    session = jittery(SEED, 0.0, labels, outliers=0.03)
    found = calibrate(session.rig, session.observations())
    monkeypatch.setattr(
        hub.calibration.final_adjustment, "estimate_frame_times", lambda problem, state, *_: (problem, state)
    )
    uncorrected = calibrate(session.rig, session.observations())
    assert not reported_jitters(found)
    for name, camera in found.cameras.items():
        assert camera.time_map == uncorrected.cameras[name].time_map
        assert (camera.pose.position == uncorrected.cameras[name].pose.position).all()


def test_correlated_errors_are_not_reported_as_jitter() -> None:
    session = jittery(SEED + 7, 0.0, 1)
    names = np.array(session.camera)
    pixels, mine = session.pixels.copy(), names == "cam2"
    # Along the motion only, as timestamp errors are, but correlated over a second: a detector that lags behind.
    time = session.time[mine]
    late = 0.02 * np.sin(2 * np.pi * (time - time[0]) / 1.5)
    label = session.label[int(np.flatnonzero(mine)[0])]
    lens = session.rig.cameras["cam2"].intrinsics
    assert lens is not None
    moved = [
        lens.project(session.poses["cam2"].camera_from_world(session.truth_at(label, "cam2", at)))
        for at in (time, time + late)
    ]
    pixels[mine] += moved[1] - moved[0]
    shifted = replace(session, pixels=pixels)
    assert not reported_jitters(calibrate(shifted.rig, shifted.observations()))
