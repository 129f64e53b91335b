"""Sphere contour bias: corrected at once with a measured lens, otherwise after self-calibration of the lens."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hub.bundle.preprocessing import prepare
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics, outline_to_centre
from protocols.geometry.types import Floats
from protocols.session.observations import Observations
from protocols.session.rig import read_rig
from tests.support.rigs import Session, simulate

MATRIX = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
LENSES = {
    "pinhole": Intrinsics(1280, 720, MATRIX),
    "barrel": Intrinsics(1280, 720, MATRIX, np.array([-0.2, 0.04, 0.0, 0.0, 0.0])),
    "fisheye": Intrinsics(1280, 720, MATRIX, np.array([0.01, -0.004, 0.0, 0.0]), True),
}


def outlines(points: Floats, radius: float, lens: Intrinsics) -> tuple[Floats, Floats]:
    """Centres (n, 2) and sizes (n,) [px] of the outlines of balls at points (n, 3) in camera axes: 720 rays each."""
    turn = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    centres, sizes = [], []
    for point in points:
        distance = np.linalg.norm(point)
        towards, sine = point / distance, radius / distance
        across = np.linalg.svd(towards[None])[2][1:]
        rim = np.sqrt(1.0 - sine**2) * towards + sine * (
            np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
        )
        # About the ball's own pixel, and scaled up, because OpenCV's contours are single precision.
        about = lens.project(point[None])[0]
        moments = cv2.moments(((lens.project(rim) - about) * 100.0).astype(np.float32))
        centres.append(about + np.array([moments["m10"], moments["m01"]]) / moments["m00"] / 100.0)
        sizes.append(np.sqrt(4.0 * moments["m00"] / np.pi) / 100.0)
    return np.array(centres), np.array(sizes)


@pytest.mark.parametrize("name", LENSES)
def test_the_centre_is_found_from_the_outline(name: str) -> None:
    lens = LENSES[name]
    points = np.array([[0.0, 0.0, 2.0], [1.0, -0.5, 2.5], [-1.4, 0.7, 2.2], [0.3, 0.7, 1.9]])
    truth = lens.project(points)
    centres, sizes = outlines(points, 0.1, lens)
    found = outline_to_centre(centres, sizes, lens)
    assert np.abs(found - truth).max() < 0.02
    if name == "pinhole":
        assert np.abs(centres - truth).max() > 1.0


def test_what_has_no_size_or_no_ray_stays() -> None:
    lens = LENSES["barrel"]
    seen = np.array([[1100.0, 600.0], [1100.0, 600.0], [1e7, 5.0], [np.nan, 5.0], [1100.0, 600.0]])
    found = outline_to_centre(seen, np.array([np.nan, 40.0, 40.0, 40.0, 1e5]), lens)
    assert np.array_equal(np.delete(found, 1, axis=0), np.delete(seen, 1, axis=0), equal_nan=True)
    assert np.abs(found[1] - seen[1]).max() > 0.05
    assert outline_to_centre(np.zeros((0, 2)), np.zeros(0), lens).shape == (0, 2)


def ball_session(radius: float) -> tuple[Session, Observations]:
    """Three cameras that saw the outlines of a ball, to a hundredth of a pixel."""
    full = simulate(73, 3, 20, noise=0.01)
    tracks = {}
    for key, track in full.observations().tracks.items():
        camera = full.rig.cameras[track.camera]
        lens, pose = camera.intrinsics, full.poses[track.camera]
        assert lens is not None
        points = pose.camera_from_world(full.truth_at(track.label, track.camera, track.time))
        centres, sizes = outlines(points, radius, lens)
        noise = track.pixels - lens.project(points)
        tracks[key] = replace(track, pixels=centres + noise, size=sizes)
    cameras = {name: replace(camera, ball_outline=True) for name, camera in full.rig.cameras.items()}
    return replace(full, rig=replace(full.rig, cameras=cameras)), Observations(tracks)


def test_a_measured_lens_moves_the_rows_at_once_and_a_missing_one_later() -> None:
    full, seen = ball_session(0.25)
    rig = replace(full.rig, cameras=full.rig.cameras | {"cam1": replace(full.rig.cameras["cam1"], intrinsics=None)})
    ready = prepare(rig, seen)
    track = seen.of_camera("cam0")[0]
    truth = full.observations().of_camera("cam0")[0].pixels
    assert np.abs(track.pixels - truth).max() > 0.3
    assert np.abs(ready.rows["cam0"][0].pixels - truth).max() < 0.05
    assert np.array_equal(ready.rows["cam1"][0].pixels, seen.of_camera("cam1")[0].pixels)
    lens = full.rig.cameras["cam1"].intrinsics
    assert lens is not None
    again = ready.rows_through("cam1", lens)[0].pixels
    assert np.abs(again - full.observations().of_camera("cam1")[0].pixels).max() < 0.05


def test_the_key_is_true_or_false(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text("[cam0]\nsize = [640, 480]\nball_outline = true\n")
    assert read_rig(file).cameras["cam0"].ball_outline
    file.write_text('[cam0]\nsize = [640, 480]\nball_outline = "yes"\n')
    with pytest.raises(InputError, match="ball_outline"):
        read_rig(file)
