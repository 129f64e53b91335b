"""The shipped scenes: reproducible, plausible, and rendered where the ground truth is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge import scenes
from edge.scenes import renderer_for
from edge.scenes.common.base import SimulatedClock
from edge.scenes.marker import renderer as rendering
from edge.scenes.marker.scene import simulate_tracks
from protocols.core.clocks import CameraTime
from protocols.core.errors import InputError

NAMES = scenes.MARKER_SCENES


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_is_a_function_of_its_name_and_seed(name: str) -> None:
    a, b, other = scenes.get_marker_scene(name, 5), scenes.get_marker_scene(name, 5), scenes.get_marker_scene(name, 6)
    t = np.linspace(0.0, 50.0, 30)
    assert (a.marker_position(t) == b.marker_position(t)).all()
    assert np.abs(a.marker_position(t) - other.marker_position(t)).max() > 0.1
    for one, two in zip(a.cameras, b.cameras, strict=True):
        assert (one.pose.rotation == two.pose.rotation).all()
        assert (one.intrinsics.matrix == two.intrinsics.matrix).all()
        assert one.clock == two.clock


def test_simulated_detections_and_images_are_functions_of_their_seed() -> None:
    scene = scenes.get_marker_scene("marker", 2)
    a, b = simulate_tracks(scene, 5.0, 3), simulate_tracks(scene, 5.0, 3)
    assert (a["cam1"].pixels == b["cam1"].pixels).all()
    assert (a["cam1"].time == b["cam1"].time).all()
    one, two = (renderer_for(scene, "cam1", np.random.default_rng(4)).render(1.0) for _ in range(2))
    assert (one == two).all()


@pytest.mark.parametrize("cameras", [2, 3, 20])
def test_any_number_of_cameras_is_separated_and_sees_the_marker(cameras: int) -> None:
    scene = scenes.get_marker_scene("marker", 1, cameras=cameras)
    assert [camera.name for camera in scene.cameras] == [f"cam{i}" for i in range(cameras)]
    centres = np.array([camera.pose.position for camera in scene.cameras])
    separation = np.linalg.norm(centres[:, None] - centres, axis=2) + 10.0 * np.eye(cameras)
    assert separation.min() > 0.2
    for track in simulate_tracks(scene, 30.0, 0).values():
        assert len(track) > 400


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(3))
def test_the_path_is_smooth_three_dimensional_and_does_not_repeat(name: str, seed: int) -> None:
    scene = scenes.get_marker_scene(name, seed)
    t = np.arange(0.0, 120.0, 0.01)
    p = scene.marker_position(t)
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / 0.01
    extent = np.linalg.svd(p - p.mean(axis=0), compute_uv=False) / np.sqrt(len(p))
    assert extent[2] > 0.2 * extent[0]  # a volume, not a plane
    assert np.abs(p - scene.path.centre).max(axis=0) == pytest.approx(scene.path.extent, rel=0.35)
    # Smooth: a cubic through samples 33 ms apart predicts the middle to a small part of the marker.
    middle = (-p[:-9:3] + 9 * p[3:-6:3] + 9 * p[6:-3:3] - p[9::3])[:, :] / 16.0
    exact = scene.marker_position(t[:-9:3] + 0.045)
    assert np.abs(middle - exact).max() < 0.02
    # No later part of the trajectory repeats the first 5 s.
    first = p[:500] - p[:500].mean(axis=0)
    for start in range(500, len(p) - 500, 50):
        later = p[start : start + 500]
        assert np.sqrt(np.mean((later - later.mean(axis=0) - first) ** 2)) > 0.05
    if name == "marker":
        assert 0.8 < np.median(speed) < 3.0
        assert speed.max() < 6.0
    else:
        assert np.percentile(speed, 2) < 1.5 < 5.0 < np.percentile(speed, 95)  # hovers, and flies


def test_outdoor_cameras_run_at_mixed_rates() -> None:
    assert {camera.fps for camera in scenes.get_marker_scene("marker-outdoor", 0).cameras} == {25.0, 29.97, 30.0, 50.0}
    assert {camera.fps for camera in scenes.get_marker_scene("marker", 0).cameras} == {30.0}
    assert len({camera.fps for camera in scenes.get_marker_scene("marker", 0, mixed_fps=True).cameras}) == 3


def test_unknown_scenes_and_single_cameras_are_refused() -> None:
    with pytest.raises(InputError, match="no scene"):
        scenes.get_marker_scene("ballroom", 0)
    with pytest.raises(InputError, match="at least 2"):
        scenes.get_marker_scene("marker", 0, cameras=1)
    with pytest.raises(InputError, match="no camera"):
        scenes.get_marker_scene("marker", 0).camera("cam9")


@given(
    epoch=st.integers(-(10**12), 2 * 10**18),
    rate=st.floats(0.999, 1.001),
    moment=st.floats(-1000.0, 100_000.0),
)
def test_a_clock_is_inverted_to_a_nanosecond(epoch: int, rate: float, moment: float) -> None:
    clock = SimulatedClock(epoch, rate)
    assert clock.true_time(clock.device_time_ns(moment)) == pytest.approx(moment, abs=2e-9)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), moment=st.floats(-100.0, 1000.0))
def test_time_maps_agree_with_the_clocks(seed: int, moment: float) -> None:
    scene = scenes.get_marker_scene("marker", seed)
    for camera in scene.cameras:
        for reference in scene.cameras:
            mapped = scene.true_time_map(camera.name, reference.name).reference_from_camera(
                CameraTime(camera.clock.device_time_ns(moment) / 1e9)
            )
            assert mapped == pytest.approx(reference.clock.device_time_ns(moment) / 1e9, abs=2e-6)  # float at Unix time


def test_clocks_differ_in_epoch_and_drift() -> None:
    clocks = [camera.clock for camera in scenes.get_marker_scene("marker", 0).cameras]
    epochs = sorted(clock.epoch_ns for clock in clocks)
    assert epochs[0] < 200e9 < 1e18 < epochs[2]  # one starts near 0, one is Unix time
    assert all(0 < abs(clock.rate - 1.0) <= 1e-4 for clock in clocks)


def test_the_rendered_ball_has_the_true_position_and_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coverage is read from a black ball on white without noise or highlight."""
    for light, value in (("_GLINT", 0.0), ("_DIFFUSE", 0.0), ("_AMBIENT", 1.0)):
        monkeypatch.setattr(rendering, light, value)
    scene = dataclasses.replace(scenes.get_marker_scene("marker", 3), marker_bgr=(20.0, 20.0, 20.0))
    renderer = rendering.MarkerRenderer(scene, "cam0", np.random.default_rng(0), noise_std=0.0)
    renderer._dimmed[:] = 215
    rows, columns = np.mgrid[:480, :640]
    checked = 0
    for moment in np.linspace(0.0, 40.0, 60):
        pixels, size = scene.seen_by("cam0", np.array([moment]))
        if not (40 < pixels[0, 0] < 600 and 40 < pixels[0, 1] < 440):
            continue
        cover = (235.0 - renderer.render(moment)[..., 0]) / 215.0
        total = cover.sum()
        centroid = np.array([(cover * columns).sum(), (cover * rows).sum()]) / total
        shift = 0.02 + 1.2 * np.hypot(*(pixels[0] - 320)) * (0.5 * size[0] / 450) ** 2  # perspective of a sphere
        assert np.hypot(*(centroid - pixels[0])) < shift
        assert 2.0 * np.sqrt(total / np.pi) == pytest.approx(size[0], rel=0.012)
        checked += 1
    assert checked > 30


def test_a_ball_behind_or_beside_the_camera_is_not_drawn() -> None:
    scene = scenes.get_marker_scene("marker", 0)
    camera = scene.cameras[0]
    behind = camera.pose.world_from_camera(np.array([[0.0, 0.0, -2.0]]))[0]
    hidden = dataclasses.replace(scene, path=dataclasses.replace(scene.path, centre=behind, extent=np.full(3, 1e-3)))
    assert np.isnan(hidden.seen_by(camera.name, np.zeros(1))[0]).all()
    renderer = rendering.MarkerRenderer(hidden, camera.name, np.random.default_rng(0), noise_std=0.0)
    assert (renderer.render(0.0) == renderer._dimmed + np.uint8(20)).all()


def test_a_rolling_shutter_sees_upper_rows_earlier() -> None:
    scene = scenes.get_marker_scene("marker", 0)
    rolling = dataclasses.replace(
        scene, cameras=tuple(dataclasses.replace(camera, readout_s=0.02) for camera in scene.cameras)
    )
    t = np.linspace(0.0, 20.0, 200)
    for name in ("cam0", "cam1"):
        pixels, _ = rolling.seen_by(name, t)
        row = pixels[:, 1]
        lag = (np.clip(row, 0, 479) / 479 - 0.5) * 0.02
        expected, _ = scene.seen_by(name, t + lag)
        good = np.isfinite(row) & (row > 0) & (row < 479)
        assert np.abs(expected - pixels)[good].max() < 0.02


def test_a_session_has_the_noise_outliers_and_drops_it_was_asked_for() -> None:
    scene = scenes.get_marker_scene("marker", 4)
    tracks = simulate_tracks(scene, 60.0, 1, pixel_noise=0.5, size_noise=0.05, outlier_fraction=0.1, drop_fraction=0.3)
    for camera in scene.cameras:
        track = tracks[camera.name]
        truth, size = scene.seen_by(camera.name, track.true_time)
        inlier = ~track.is_outlier
        assert np.std((track.pixels - truth)[inlier]) == pytest.approx(0.5, rel=0.05)
        assert np.std((track.size / size)[inlier]) == pytest.approx(0.05, rel=0.1)
        assert track.is_outlier.mean() == pytest.approx(0.1, abs=0.03)
        assert np.median(np.linalg.norm((track.pixels - truth)[track.is_outlier], axis=1)) > 100
        assert len(track) / (60.0 - camera.start_s) / camera.fps < 0.75
        assert (np.diff(track.frame) > 0).all()
        assert (np.diff(track.time) > 0).all()
        # Jitter is in the capture; only the time stamp has an error.
        expected = np.array([camera.clock.device_time_ns(t) for t in track.true_time]) / 1e9
        assert np.std(track.time - expected) == pytest.approx(50e-6, rel=0.1)
        assert np.std(np.diff(track.true_time)[np.diff(track.frame) == 1]) > 0.3 * camera.jitter_s
        position = scene.marker_position((track.time - camera.clock.epoch_ns / 1e9) / camera.clock.rate)
        assert np.abs(position - scene.marker_position(track.true_time)).max() < 2e-3
