"""clock = "shared": rows of equal time correspond, no smooth motion is assumed, only poses are estimated."""

from __future__ import annotations

import numpy as np
import pytest

from edge import scenes
from edge.scenes.marker.scene import MarkerScene
from hub.calibration.pipeline import calibrate
from protocols.geometry import so3
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig, RigCamera


def scattered(
    scene: MarkerScene, count: int, views: int, noise: float, outliers: float, seed: int = 0
) -> tuple[Rig, Observations]:
    """Random points, each seen by ``views`` random cameras at one time."""
    rng = np.random.default_rng(seed)
    points = np.array([0.0, 0.0, 1.3]) + rng.uniform(-0.75, 0.75, (count, 3))
    rows: list[tuple[str, int, float, float]] = []
    for i, point in enumerate(points):
        for k in rng.permutation(len(scene.cameras))[:views]:
            camera = scene.cameras[k]
            pixel = camera.intrinsics.project(camera.pose.camera_from_world(point[None]))[0]
            pixel = pixel + rng.normal(size=2) * (60.0 if rng.random() < outliers else noise)
            if np.isfinite(pixel).all():
                rows.append((camera.name, i, *pixel))
    frame = np.array([row[1] for row in rows])
    observations = gather_tracks(
        [row[0] for row in rows],
        ["marker"] * len(rows),
        frame,
        1000.0 + 0.1 * frame,
        np.array([row[2:] for row in rows]),
        np.full(len(rows), np.nan),
        order=[camera.name for camera in scene.cameras],
    )
    cameras = {c.name: RigCamera(c.name, (640, 480), 30.0, c.intrinsics) for c in scene.cameras}
    return Rig(cameras, clock="shared"), observations


def errors(scene: MarkerScene, found: Calibration) -> tuple[float, float]:
    """Largest rotation [deg] and position [m] error in the first camera's frame, at the true first baseline."""
    base, truth = found.cameras["cam0"].pose, scene.cameras[0].pose
    scale = float(np.linalg.norm(scene.cameras[1].pose.position - truth.position))
    rotation_errors, position_errors = [], []
    for name, camera in found.cameras.items():
        true = scene.camera(name).pose
        rotation_errors.append(
            so3.angle_between(camera.pose.rotation @ base.rotation.T, true.rotation @ truth.rotation.T)
        )
        apart = base.rotation @ (camera.pose.position - base.position) * scale
        position_errors.append(np.linalg.norm(apart - truth.rotation @ (true.position - truth.position)))
    return float(np.degrees(max(rotation_errors))), float(max(position_errors))


@pytest.mark.parametrize(("views", "outliers"), [(2, 0.0), (2, 0.03), (4, 0.03)])
def test_poses_are_estimated_from_scattered_points(views: int, outliers: float) -> None:
    scene = scenes.get_marker_scene("marker", 3, 5)
    found = calibrate(*scattered(scene, 1500, views, 1.0, outliers))
    assert not found.refused
    rotation_error, position_error = errors(scene, found)
    assert rotation_error < 0.4
    assert position_error < 0.02
    for camera in found.cameras.values():
        assert (camera.time_map.clock_rate, camera.time_map.time_offset) == (1.0, 0.0)
        assert camera.time_offset_std == 0.0


def test_the_trajectory_has_a_row_for_every_instant_that_two_cameras_saw() -> None:
    scene = scenes.get_marker_scene("marker", 3, 3)
    rig, observations = scattered(scene, 400, 3, 0.5, 0.0)
    (path,) = calibrate(rig, observations).trajectories
    times = [set(track.time) for track in observations.tracks.values()]
    both = {t for t in set.union(*times) if sum(t in seen for seen in times) >= 2}
    assert set(np.round(path.time, 6)) <= {round(t, 6) for t in both}
    assert len(path.time) > 0.95 * len(both)


def test_a_camera_without_common_rows_is_refused_by_name() -> None:
    scene = scenes.get_marker_scene("marker", 5, 4)
    rig, observations = scattered(scene, 600, 4, 0.5, 0.0)
    tracks = dict(observations.tracks)
    track = tracks["cam3", "marker"]
    tracks["cam3", "marker"] = type(track)(
        track.camera, track.label, track.frame, track.time + 0.05, track.pixels, track.size
    )
    found = calibrate(rig, Observations(tracks))
    assert list(found.refused) == ["cam3"]
    assert "same time" in found.refused["cam3"]
