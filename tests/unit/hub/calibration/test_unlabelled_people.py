"""Unlabelled people: the ground by their sizes, cameras by where they stand, the whole calibration."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

from hub.calibration.people.ground_plane import Bodies, GroundPlane, estimate_ground_plane
from hub.calibration.people.registration import GroundPoints, lag_grid, register, rotation
from hub.calibration.people.unlabelled import _check_upright, calibrate_people
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig, RigCamera
from tests.support import crowds

OFFSETS = {"left": 0.0, "right": -37.3, "back": 1200.85}


def bodies(name: str, noise: float, seed: int = 0) -> Bodies:
    """People all over a camera's picture, of heights that differ by 4 %. noise: of both ends, of the body's size."""
    rng = np.random.default_rng(seed)
    feet = np.column_stack([rng.uniform(-4.0, 4.0, (300, 2)), np.zeros(300)])
    tall = np.column_stack([np.zeros((300, 2)), rng.normal(crowds.HEIGHT, 0.07, 300)])
    pose = crowds.poses()[name]
    head, foot = (
        crowds.lens().unproject(crowds.lens().project(pose.camera_from_world(at))) for at in (feet + tall, feet)
    )
    size = foot[:, 1] - head[:, 1]
    top, bottom = head[:, 1] + noise * size * rng.normal(size=300), foot[:, 1] + noise * size * rng.normal(size=300)
    return Bodies(0.5 * (head + foot), top, bottom)


@pytest.mark.parametrize("name", crowds.NAMES)
def test_sizes_of_upright_people_give_the_vertical_and_the_cameras_height(name: str) -> None:
    found = estimate_ground_plane(bodies(name, 0.03))
    assert found is not None
    pose = crowds.poses()[name]
    assert np.rad2deg(np.arccos(found.up @ pose.rotation[:, 2])) < 1.0
    assert found.height * crowds.HEIGHT == pytest.approx(pose.position[2], rel=0.04)


def test_children_among_adults_turn_no_vertical_where_it_is_known_who_is_who() -> None:
    rng = np.random.default_rng(2)
    person = rng.integers(0, 6, 300)
    feet = np.column_stack([rng.uniform(-4.0, 4.0, (300, 2)), np.zeros(300)])
    feet[:, 1] += np.where(person < 3, 1.5, -1.5)  # the children play in one part of the picture
    tall = np.column_stack([np.zeros((300, 2)), np.where(person < 3, 1.15, 1.72)])
    pose = crowds.poses()["left"]
    head, foot = (
        crowds.lens().unproject(crowds.lens().project(pose.camera_from_world(at))) for at in (feet + tall, feet)
    )
    noise = 0.03 * (foot - head)[:, 1] * rng.normal(size=(2, 300))
    both = Bodies(0.5 * (head + foot), head[:, 1] + noise[0], foot[:, 1] + noise[1])
    found = estimate_ground_plane(both, person)
    assert found is not None
    assert np.rad2deg(np.arccos(found.up @ pose.rotation[:, 2])) < 1.0


def test_people_in_one_place_give_no_ground() -> None:
    rng = np.random.default_rng(0)
    one = bodies("left", 0.03)
    near = np.flatnonzero(np.linalg.norm(one.centre - one.centre[0], axis=1) < 0.05)
    many = rng.choice(near, 300)
    noise = 0.03 * (one.bottom - one.top)[many] * rng.normal(size=(2, 300))
    assert (
        estimate_ground_plane(Bodies(one.centre[many], one.top[many] + noise[0], one.bottom[many] + noise[1])) is None
    )


def walkers(seed: int, people: int, seconds: float, fps: float = 5.0) -> tuple[Floats, Floats]:
    """Times (t,) and places (t, n, 2) [heights] of people who wander."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * fps)) / fps
    phase, rate = rng.uniform(0.0, 6.0, (2, 3, people)), rng.uniform(0.1, 0.5, (2, 3, people))
    places = 2.0 * np.sin(rate[:, :, :, None] * time + phase[:, :, :, None]).sum(axis=1)
    return time, np.moveaxis(places, (0, 1, 2), (2, 1, 0))


def test_registration_finds_rotation_shift_and_lag() -> None:
    time, places = walkers(3, 5, 60.0)
    rng = np.random.default_rng(1)
    angle, shift, lag = 2.0, np.array([4.0, -7.0]), 12.34
    theirs = (places - shift) @ rotation(angle)
    a = GroundPoints(time, list(places + rng.normal(0.0, 0.08, places.shape)))
    part = slice(80, None)  # b is switched on 16 s later, and numbers nobody
    seen = [one[rng.permutation(5)[:4]] for one in theirs[part] + rng.normal(0.0, 0.08, theirs[part].shape)]
    b = GroundPoints(time[part] - lag, seen)
    found = register(a, b, lag_grid(a, b, 20.0), np.random.default_rng(0))
    assert found is not None
    assert found.accepted
    assert found.lag == pytest.approx(lag, abs=0.1)
    assert abs(np.angle(np.exp(1j * (found.angle - angle)))) < 0.02
    assert found.shift == pytest.approx(shift, abs=0.15)


def test_recordings_that_share_a_small_part_of_them_are_registered_by_all_of_it() -> None:
    time, places = walkers(3, 5, 218.0, fps=2.5)
    rng, half = np.random.default_rng(1), 300
    noise = rng.normal(0.0, 0.08, (2, *places.shape))
    a = GroundPoints(time[:half], list((places + noise[0])[:half]))
    b = GroundPoints(time[-half:] - 12.3, list((places + noise[1])[-half:] @ rotation(2.0)))
    lags = lag_grid(a, b, 20.0)
    found = register(a, b, lags[np.abs(lags - 12.3) < 35.0], np.random.default_rng(0))
    assert found is not None
    assert found.lag == pytest.approx(12.3, abs=0.1)
    assert found.meetings > 200  # of five people at 55 instants in 22 s


def test_other_people_are_no_registration() -> None:
    (time, ours), (_, others) = walkers(3, 4, 40.0), walkers(4, 4, 40.0)
    a, b = GroundPoints(time, list(ours)), GroundPoints(time, list(others))
    found = register(a, b, lag_grid(a, b, 20.0), np.random.default_rng(0))
    assert found is not None
    assert not found.accepted
    assert found.meetings < 1.5 * found.rivals


def session(seconds: float, offsets: dict[str, float]) -> tuple[Rig, list[pb.Observation]]:
    """The boxes of the made-up crowd, without labels."""
    frames: dict[tuple[str, int], pb.Observation] = {}
    for row in csv.DictReader(io.StringIO(crowds.boxes_csv(seconds, 5.0, offsets, noise=2.0))):
        frame = int(row["frame"])
        stamp = round(float(row["time"]) * NANOSECONDS)
        message = frames.setdefault(
            (row["camera"], frame),
            pb.Observation(camera=row["camera"], frame=frame, sequence=frame, device_time_ns=stamp, schema_version=1),
        )
        x, y, width, height = (float(row[key]) for key in ("x", "y", "width", "height"))
        u = x + 0.5 * width
        message.detections.add(
            kind="person", u=u, v=y + 0.5 * height, size=height, score=1.0, head=[u, y], foot=[u, y + height],
            box=[x, y, width, height],
        )  # fmt: skip
    cameras = {name: RigCamera(name=name, size=crowds.SIZE, fps=5.0, intrinsics=crowds.lens()) for name in crowds.NAMES}
    return Rig(cameras), list(frames.values())


def errors(found: Calibration) -> tuple[Floats, Floats]:
    """Of positions [m] after one similarity, and of rotations [rad]."""
    true = crowds.poses()
    names = list(found.cameras)
    ours = np.array([found.cameras[name].pose.position for name in names])
    theirs = np.array([true[name].position for name in names])
    x, y = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    turns = [found.cameras[name].pose.rotation.T @ true[name].rotation for name in names]
    world = turns[0]
    scale = float((y * (x @ world)).sum() / (x**2).sum())
    rotations = [float(np.linalg.norm(so3.log(world.T @ turn))) for turn in turns]
    return np.linalg.norm(scale * x @ world - y, axis=1), np.array(rotations)


@pytest.fixture(scope="module", name="calibrated")
def _calibrated() -> tuple[Calibration, Observations]:
    return calibrate_people(*session(40.0, OFFSETS))


def test_unlabelled_people_calibrate_cameras_that_share_no_clock(
    calibrated: tuple[Calibration, Observations],
) -> None:
    found, observations = calibrated
    assert not found.refused
    positions, rotations = errors(found)
    assert positions.max() < 0.15
    assert np.rad2deg(rotations).max() < 1.0
    for name, camera in found.cameras.items():
        assert camera.lag == pytest.approx(OFFSETS[name], abs=max(4.0 * camera.lag_std, 1e-6))
        assert camera.lag_std < 0.01
    assert {label.rpartition("-")[2] for label in observations.labels} == {"head", "foot"}
    assert found.scale == "arbitrary"
    assert not any("focal length" in warning for warning in found.warnings)


def test_a_wrong_lens_is_warned_of() -> None:
    rig, messages = session(25.0, OFFSETS)
    matrix = np.diag([1.1, 1.1, 1.0]) @ crowds.lens().matrix + np.outer([-48.0, -36.0, 0.0], [0.0, 0.0, 1.0])
    rig.cameras["back"] = replace(rig.cameras["back"], intrinsics=Intrinsics(*crowds.SIZE, matrix))
    found, _ = calibrate_people(rig, messages)
    assert any("with a focal length -" in warning for warning in found.warnings)


def test_cameras_that_are_apart_on_a_shared_clock_are_refused() -> None:
    rig, messages = session(40.0, {"left": 0.0, "right": 0.0, "back": 0.8})
    with pytest.raises(Refused, match="share no clock"):
        calibrate_people(Rig(rig.cameras, clock="shared"), messages)


def test_people_who_would_lean_are_refused(calibrated: tuple[Calibration, Observations]) -> None:
    def planes(lean_deg: float) -> dict[str, GroundPlane]:
        up = so3.exp(np.array([np.deg2rad(lean_deg), 0.0, 0.0])) @ np.array([0.0, 0.0, 1.0])
        return {name: GroundPlane(pose.rotation @ up, 1.7) for name, pose in crowds.poses().items()}

    found = calibrated[0]
    _check_upright(found, planes(0.0))
    first, *others = found.trajectories
    position, std = first.position.copy(), first.std.copy()
    camera = found.cameras["left"]
    position[-20:] += 3.0 * (camera.pose.rotation.T @ planes(0.0)["left"].up)  # an end that one camera sees
    std[-20:] = 3.0
    _check_upright(replace(found, trajectories=(replace(first, position=position, std=std), *others)), planes(0.0))
    with pytest.raises(Refused, match=r"people would lean by [34]"):
        _check_upright(found, planes(4.0))


def test_a_camera_without_a_measured_lens_is_refused_by_name() -> None:
    rig, messages = session(25.0, OFFSETS)
    rig.cameras["back"] = RigCamera(name="back", size=crowds.SIZE, fps=5.0)
    found, _ = calibrate_people(rig, messages)
    assert "no intrinsics" in found.refused["back"]
    assert list(found.cameras) == ["left", "right"]


def test_people_who_are_not_the_same_are_refused() -> None:
    rig, messages = session(25.0, OFFSETS)
    rng = np.random.default_rng(0)
    for message in messages:  # everybody is somewhere else in each frame
        for one in message.detections:
            move = float(rng.uniform(-200.0, 200.0))
            one.u, one.head[0], one.foot[0] = one.u + move, one.head[0] + move, one.foot[0] + move
    with pytest.raises(Refused) as refusal:
        calibrate_people(rig, messages)
    assert set(refusal.value.cameras) == set(crowds.NAMES)
