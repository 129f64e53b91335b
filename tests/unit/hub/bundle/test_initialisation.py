"""Initial poses from a fraction of the rows where there are very many."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hub.bundle import initialisation
from hub.bundle.initialisation import CameraInput, _subsampled, knot_spacing
from hub.bundle.problem import AdjustmentState, Problem
from hub.calibration.pipeline import calibrate
from hub.trajectory.image_tracks import SmoothTrack, smooth_track
from protocols.geometry.camera import Intrinsics
from tests.support.rigs import Path, simulate
from tests.unit.hub.bundle.test_adjustment import simulated_problem


def test_all_of_few_rows_are_used() -> None:
    problem, state, _ = simulated_problem(1)
    assert _subsampled(problem, state) is problem


def test_a_fraction_of_many_rows_is_used_with_enough_per_knot(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state, _ = simulated_problem(1)
    rows = []
    for part in problem.rows:
        time = np.arange(0.8, 5.2, 0.01)
        pixels = np.column_stack([time, time])
        rows.append(replace(part, time=time, pixels=pixels, use=np.ones(len(time), dtype=bool), stamp=time + 7.0))
    problem = replace(problem, rows=tuple(rows))
    total = sum(len(part.time) for part in rows)
    for many, every in ((total / 4.0, 4), (total / 1e4, 20)):  # knots are 0.4 s apart: 40 rows
        monkeypatch.setattr(initialisation, "_MAX_INITIAL_ROWS", many * 0.999)
        for before, after in zip(rows, _subsampled(problem, state).rows, strict=True):
            assert len(after.time) == pytest.approx(len(before.time) / every, rel=0.15)
            assert np.isin(after.time, before.time).all()
            np.testing.assert_array_equal(after.pixels[:, 0], after.time)
            np.testing.assert_allclose(after.stamps, after.time + 7.0)


def test_a_path_is_triangulated_again_only_where_one_of_its_cameras_has_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def triangulated(names: list[str], states: object, cameras: object, label: str) -> tuple[str, ...]:
        made.append(label)
        return (label, *names)

    monkeypatch.setattr(initialisation, "triangulate_label", triangulated)
    _, state, _ = simulated_problem(3)
    one, other, third = state.cameras
    seen = {"a": ("x",), "b": ("x", "y"), "c": ("y",)}
    cameras = {name: SimpleNamespace(tracks=dict.fromkeys(labels)) for name, labels in seen.items()}
    kept = initialisation._Triangulated(cameras, ["x", "y"])  # type: ignore[arg-type]
    placed = {"a": one, "b": other}
    assert [kept.path(label, placed) for label in "xy"] == [("x", "a", "b"), ("y", "b")]
    assert [kept.path(label, placed | {"c": third}) for label in "xy"] == [("x", "a", "b"), ("y", "b", "c")]
    assert made == ["x", "y", "y"]
    assert kept.path("x", {"a": replace(one, offset=one.offset + 1.0), "b": other}) == ("x", "a", "b")
    assert made == ["x", "y", "y", "x"]


def test_a_sample_in_one_place_does_not_end_a_resection(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV 5 raises an error where the points that RANSAC draws lie in one place, as of a marker that hovers."""
    solve, refused = cv2.solvePnPRansac, []

    def degenerate(*arguments: Any, flags: int, **options: Any) -> Any:
        if flags == cv2.SOLVEPNP_SQPNP:
            refused.append(flags)
            raise cv2.error("point_coordinate_variance >= POINT_VARIANCE_THRESHOLD")
        return solve(*arguments, flags=flags, **options)

    monkeypatch.setattr(cv2, "solvePnPRansac", degenerate)
    session = simulate(3, 4, 20.0)
    assert len(calibrate(session.rig, session.observations()).cameras) == 4
    assert refused


@pytest.mark.parametrize(("fps", "share"), [(12.0, 0.5), (60.0, 1.0)])
def test_a_path_of_few_frames_a_knot_has_denser_knots(fps: float, share: float) -> None:
    """Its cameras together see more of the motion than the frames of one, which limit that camera's own track."""
    time = np.arange(0.0, 20.0, 1.0 / fps)
    moved = np.column_stack([0.3 * np.sin(3.0 * time), 0.2 * np.sin(6.0 * time)])
    track = smooth_track(time, moved + np.random.default_rng(1).normal(0.0, 2e-3, moved.shape), 1000.0)
    assert isinstance(track, SmoothTrack)
    lens = Intrinsics(1000, 1000, np.array([[1000.0, 0.0, 500.0], [0.0, 1000.0, 500.0], [0.0, 0.0, 1.0]]))
    cameras = [CameraInput(name, lens, {"joint": track}) for name in "abcd"]
    assert knot_spacing(cameras, "joint") == share * track.basis.spacing
    assert knot_spacing(cameras[:2], "joint") == track.basis.spacing  # two have too few rows for so many knots
    body = [replace(camera, tracks=dict.fromkeys(["joint", *"0123456"], track)) for camera in cameras]
    assert knot_spacing(body, "joint") == 0.5 * track.basis.spacing  # what the path does not follow, all joints do
    slow = [replace(camera, least_spacing=0.28) for camera in body]
    assert knot_spacing(slow, "joint") == 0.28  # nor do errors that last so long pass for motion


@pytest.mark.parametrize("seed", [1, 4])
def test_a_path_has_more_rows_than_unknowns(seed: int) -> None:
    """Of two cameras at 5 frames a second the prior said where the path was: they turned by 0.01 rad, at 12 stds."""
    rng = np.random.default_rng(seed)
    path = Path(rng.uniform(0.05, 0.6, (14, 3)), rng.uniform(0, 2 * np.pi, (14, 3)), rng.normal(0, 0.3, (14, 3)))
    session = simulate(seed, 2, 240.0, fps=(5.0, 5.0), drops=0.0, ppm=10.0, path=path)
    found = calibrate(session.rig, session.observations()).cameras
    assert session.turn_error({name: one.pose for name, one in found.items()}) < 3e-3


def test_while_a_large_network_grows_only_new_cameras_are_adjusted() -> None:
    """A street of a thousand was adjusted from its first camera to its last each time that it had grown by a third."""
    problem, state, _ = simulated_problem(2, lens=False, perturbation=1e-3)
    found = initialisation._adjusted_among(problem, replace(state, sigma=np.full(3, 2.0)), {1})
    assert found.cameras[0] is state.cameras[0]
    assert found.cameras[2] is state.cameras[2]
    assert np.linalg.norm(found.cameras[1].pose.position - state.cameras[1].pose.position) > 1e-5
    assert all(
        after.basis is before.basis for after, before in zip(found.trajectories, state.trajectories, strict=True)
    )


def test_several_cameras_are_placed_at_once_where_a_network_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each camera of a street was placed by itself, which triangulated what it saw once more for each of them."""
    session, made = simulate(4, 7, 30.0), []
    one = calibrate(session.rig, session.observations())
    monkeypatch.setattr(initialisation, "LARGE_NETWORK", 2)
    adjust = initialisation._adjusted_among

    def counted(problem: Problem, state: AdjustmentState, moving: set[int]) -> AdjustmentState:
        made.append(len(moving))
        return adjust(problem, state, moving)

    monkeypatch.setattr(initialisation, "_adjusted_among", counted)
    both = calibrate(session.rig, session.observations())
    assert list(both.cameras) == list(one.cameras)
    assert len(made) < len(one.cameras) - 2, "fewer adjustments than cameras that were added"
    for name, camera in both.cameras.items():
        np.testing.assert_allclose(camera.pose.position, one.cameras[name].pose.position, atol=1e-3)
