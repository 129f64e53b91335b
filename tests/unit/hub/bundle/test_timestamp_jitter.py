"""Timestamp jitter is detected, reported and removed from the poses; exact timestamps are left unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hub.calibration.final_adjustment
from hub.bundle.preprocessing import _typical_std
from hub.bundle.problem import CameraState, Column, TrackObservations
from hub.calibration.pipeline import calibrate
from protocols.session.calibration import Calibration
from tests.support import rigs
from tests.support.bundles import linearise, pixels_of, spline_of

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
        if name in JITTERING:  # n frames that err independently tell no offset better; it was said to be 0.7 of that
            frames = len(np.unique(session.frame[np.array(session.camera) == name]))
            assert camera.lag_std > 0.95 * std / np.sqrt(frames)
    monkeypatch.setattr(
        hub.calibration.final_adjustment, "estimate_frame_times", lambda problem, state, *_, **__: (problem, state)
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
        hub.calibration.final_adjustment, "estimate_frame_times", lambda problem, state, *_, **__: (problem, state)
    )
    uncorrected = calibrate(session.rig, session.observations())
    assert not reported_jitters(found)
    for name, camera in found.cameras.items():
        assert camera.time_map == uncorrected.cameras[name].time_map
        assert (camera.pose.position == uncorrected.cameras[name].pose.position).all()


@pytest.mark.parametrize("ratio", [10.0, 20.0])
def test_rows_of_alternating_stated_noise_are_not_jitter(ratio: float) -> None:
    """Half of the rows are ``ratio`` times noisier, and all of one camera's, as stated: jitter of 9 ms was found."""
    session = jittery(SEED + 3, 0.0, 1)
    clean, rng = session.observations(), np.random.default_rng(SEED)
    tracks = {}
    for key, track in clean.tracks.items():
        std = np.where(np.arange(len(track)) % 2, 0.3, 0.3 * ratio) * (3.0 if key[0] == "cam3" else 1.0)
        noise = std[:, None] * rng.normal(size=(len(track), 2))
        tracks[key] = replace(track, pixels=track.pixels + noise, std=np.hypot(std, 0.5))
    found = calibrate(session.rig, replace(clean, tracks=tracks))
    assert not reported_jitters(found)
    assert not [text for text in found.warnings if "residuals" in text]
    for name, camera in found.cameras.items():
        assert abs(session.clock_error(name, "cam0", camera.time_map)) <= 3.5 * camera.time_offset_std
        assert camera.detector_z == pytest.approx(1.0, abs=0.15)


def test_stated_stds_hide_no_camera_that_is_worse_than_the_others() -> None:
    """Where all state 1 px, one with 1.5 px among those with 0.2 px was within what it states."""
    session = jittery(SEED + 3, 0.0, 1)
    clean, rng, tracks = session.observations(), np.random.default_rng(SEED), {}
    for key, track in clean.tracks.items():
        noise = (2.0 if key[0] == "cam3" else 0.05) * rng.normal(size=(len(track), 2))
        tracks[key] = replace(track, pixels=track.pixels + noise, std=np.full(len(track), 2.0))
    found = calibrate(session.rig, replace(clean, tracks=tracks))
    assert [text[:4] for text in found.warnings if "times the others" in text] == ["cam3"]


def test_a_std_that_means_unknown_leaves_the_others_as_stated() -> None:
    track = next(iter(jittery(SEED + 3, 0.0, 1).observations().tracks.values()))
    unknown = np.arange(len(track)) % 5 == 0
    some = replace(track, std=np.where(unknown, 1e5, 0.5))
    assert 0.5 <= _typical_std([some]) < 0.8
    assert _typical_std([replace(track, std=np.where(unknown, np.inf, 0.5))]) == _typical_std([some])


def test_correlated_errors_are_not_reported_as_jitter() -> None:
    session = jittery(SEED + 7, 0.0, 1)
    names = np.array(session.camera)
    pixels, mine = session.pixels.copy(), names == "cam2"
    # Along the motion only, as timestamp errors are, but correlated over a second: a detector that lags behind.
    time = session.time[mine]
    late = 0.02 * np.sin(2 * np.pi * (time - time[0]) / 1.5)
    label = session.label[int(np.flatnonzero(mine)[0])]
    lens = session.lens("cam2")
    moved = [
        lens.project(session.poses["cam2"].camera_from_world(session.truth_at(label, "cam2", at)))
        for at in (time, time + late)
    ]
    pixels[mine] += moved[1] - moved[0]
    shifted = replace(session, pixels=pixels)
    assert not reported_jitters(calibrate(shifted.rig, shifted.observations()))


def test_rows_with_jitter_have_its_covariance_along_their_motion() -> None:
    """Whitened residuals and Jacobians against the inverse of noise² (1 + (along² - 1) u uᵀ)."""
    rng = np.random.default_rng(SEED)
    camera = CameraState(rigs.random_lens(rng), rigs.random_poses(rng, 1)[0], 1.0, 5.0, 5.0)
    path = spline_of(rigs.random_path(rng), 0.0, 10.0, 0.25)
    time = rng.uniform(0.5, 9.5, 40)
    seen = pixels_of(camera, path, time)
    rows = TrackObservations(0, 0, time, seen + rng.normal(0.0, 2.0, seen.shape), np.ones(40, dtype=np.bool_))
    along = rng.uniform(1.0, 9.0, 40)
    plain, white = linearise(rows, camera, path), linearise(replace(rows, along_std=along), camera, path)
    velocity = plain.camera_jacobian[:, :, Column.OFFSET]
    unit = velocity / np.linalg.norm(velocity, axis=1)[:, None]
    inverse = np.linalg.inv(np.eye(2) + (along**2 - 1.0)[:, None, None] * unit[:, :, None] * unit[:, None, :])
    jacobians = [(one.camera_jacobian, one.point_jacobian) for one in (plain, white)]
    for before, after in zip(*jacobians, strict=True):
        expected = before.transpose(0, 2, 1) @ inverse @ before
        np.testing.assert_allclose(after.transpose(0, 2, 1) @ after, expected, rtol=1e-9, atol=1e-9 * expected.max())
        gradient = before.transpose(0, 2, 1) @ inverse @ plain.residual[:, :, None]
        got = after.transpose(0, 2, 1) @ white.residual[:, :, None]
        np.testing.assert_allclose(got, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())
