"""Calibrations of overlapping groups joined to one: worlds, clocks, faults at a border, what is kept, and stds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.distributed.merge import merge_calibrations
from protocols.core.clocks import TimeMap
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose, Similarity, fit_similarity
from protocols.geometry.types import Floats
from protocols.session.calibration import Calibration, CameraCalibration
from protocols.session.rig import Rig, RigCamera

LENS = Intrinsics(640, 480, np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.zeros(5))
GROUPS = {"a": [f"cam{n}" for n in range(8)], "b": [f"cam{n}" for n in range(8, 16)],
          "c": [f"cam{n}" for n in range(16, 24)]}  # fmt: skip


class World:
    """24 cameras on a ring, so that the groups close a circle, and what three hubs say of them, in worlds of theirs."""

    def __init__(self, seed: int, noise: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.poses, self.maps = {}, {}
        for number in range(24):
            angle = 2 * np.pi * number / 24
            at = np.array([10 * np.cos(angle), 10 * np.sin(angle), rng.uniform(2, 4)])
            self.poses[f"cam{number}"] = Pose(so3.exp(rng.normal(0, 1, 3)), at)
            self.maps[f"cam{number}"] = TimeMap(1.0 + 1e-5 * float(rng.normal()), float(rng.uniform(-1e5, 1e5)))
        self.rig = Rig({name: RigCamera(name, (640, 480), 30.0, LENS) for name in self.poses})
        self.parts = {}
        for hub, group in GROUPS.items():
            first = int(group[0][3:])
            names = [f"cam{(first + k) % 24}" for k in range(-3, 11)]
            world = Similarity(float(rng.uniform(0.2, 5.0)), so3.exp(rng.normal(0, 1, 3)), rng.normal(0, 10, 3))
            rate, offset = 1.0 + 1e-5 * float(rng.normal()), float(rng.uniform(-1e4, 1e4))
            cameras = {}
            for name in names:
                pose, own = self.poses[name], self.maps[name]
                moved = Pose(
                    so3.exp(rng.normal(0, noise / 10, 3)) @ pose.rotation, pose.position + rng.normal(0, noise, 3)
                )
                cameras[name] = CameraCalibration(
                    name, LENS, world.pose(moved),
                    TimeMap(rate * own.clock_rate, rate * own.time_offset + offset + float(rng.normal(0, noise))),
                    noise, np.full(3, world.scale * noise), 0.4, lag_time=(100.0 - own.time_offset) / own.clock_rate,
                )  # fmt: skip
            self.parts[hub] = Calibration(cameras, names[0], "arbitrary", "m", "joint", "1")

    def position_errors(self, found: Calibration) -> Floats:
        one = np.array([camera.pose.position for camera in found.cameras.values()])
        other = np.array([self.poses[name].position for name in found.cameras])
        return np.asarray(np.linalg.norm(fit_similarity(one, other).points(one) - other, axis=1))

    def lag_errors(self, found: Calibration) -> Floats:
        """Of times 20 s after the middle, against the first camera's clock."""
        base, true = found.cameras["cam0"].time_map, self.maps["cam0"]
        out = []
        for name, camera in found.cameras.items():
            at = camera.lag_time + 20.0
            here = (camera.time_map.clock_rate * at + camera.time_map.time_offset - base.time_offset) / base.clock_rate
            there = self.maps[name].clock_rate * at + self.maps[name].time_offset
            out.append(here - (there - true.time_offset) / true.clock_rate)
        return np.array(out)


@pytest.mark.parametrize("seed", range(5))
def test_exact_parts_give_the_exact_site(seed: int) -> None:
    world = World(seed)
    found = merge_calibrations(world.parts, GROUPS, world.rig)
    assert list(found.cameras) == list(world.rig.cameras)
    assert world.position_errors(found).max() < 1e-8
    assert np.abs(world.lag_errors(found)).max() < 1e-8
    turned = {name: camera.pose.rotation for name, camera in found.cameras.items()}
    for one, other in zip(list(turned), list(turned)[1:], strict=False):
        relative = turned[one] @ turned[other].T
        assert np.allclose(relative, world.poses[one].rotation @ world.poses[other].rotation.T, atol=1e-8)


def test_noise_is_not_made_larger_and_stds_cover_it() -> None:
    errors, lags, z = [], [], []
    for seed in range(20):
        world = World(seed, 0.01)
        found = merge_calibrations(world.parts, GROUPS, world.rig)
        errors.append(world.position_errors(found))
        stds = np.array([camera.time_offset_std for camera in found.cameras.values()])
        names, near = list(found.cameras), world.parts["a"].cameras.keys()
        true = np.array([world.poses[name].position for name in names])
        here = np.array([found.cameras[name].pose.position for name in names])
        is_near = np.array([name in near for name in names])
        off = fit_similarity(true[is_near], here[is_near]).points(true) - here
        z.append((off / [found.cameras[name].position_std for name in names])[~is_near])
        lags.append((world.lag_errors(found) / np.hypot(stds, stds[0]))[1:])
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * 0.01 * np.sqrt(3)
    assert np.sqrt(np.mean(np.square(lags))) < 1.5
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_the_answer_depends_on_no_order_of_hubs() -> None:
    world = World(1, 0.01)
    one = merge_calibrations(world.parts, GROUPS, world.rig)
    other = merge_calibrations(dict(reversed(world.parts.items())), GROUPS, world.rig)
    assert all(np.array_equal(one.cameras[n].pose.position, other.cameras[n].pose.position) for n in one.cameras)


def test_a_camera_that_was_moved_in_one_part_only_bends_nothing() -> None:
    world = World(2, 0.001)
    moved = world.parts["a"].cameras["cam8"]
    off = Pose(so3.exp(np.array([0.0, 0.3, 0.0])) @ moved.pose.rotation, moved.pose.position + 0.5)
    shifted = TimeMap(moved.time_map.clock_rate, moved.time_map.time_offset + 0.1)
    bad = replace(
        world.parts["a"], cameras=world.parts["a"].cameras | {"cam8": replace(moved, pose=off, time_map=shifted)}
    )
    found = merge_calibrations(world.parts | {"a": bad}, GROUPS, world.rig)
    assert world.position_errors(found).max() < 0.01, "cam8 is in the group of b, which has it right"
    assert np.abs(world.lag_errors(found)).max() < 0.01


def test_world_and_clock_are_held_and_what_no_part_has_is_kept() -> None:
    world = World(3, 0.001)
    last = merge_calibrations(world.parts, GROUPS, world.rig)
    other = World(3, 0.001 + 1e-9)  # other errors, and the same worlds
    left = {"a": GROUPS["a"] + GROUPS["b"][:4], "c": GROUPS["b"][4:] + GROUPS["c"]}
    found = merge_calibrations({hub: other.parts[hub] for hub in "ac"}, left, world.rig, last=last)
    assert found.cameras.keys() == last.cameras.keys()
    gone = [name for name in GROUPS["b"] if all(name not in other.parts[hub].cameras for hub in "ac")]
    assert gone
    assert all(found.cameras[name] is last.cameras[name] for name in gone)
    scale = np.linalg.norm(last.cameras["cam12"].pose.position - last.cameras["cam0"].pose.position) / 20
    for name, camera in found.cameras.items():
        assert np.linalg.norm(camera.pose.position - last.cameras[name].pose.position) < 0.02 * scale
    assert found.reference == last.reference
    assert found.cameras[found.reference].time_map == TimeMap(1.0, 0.0)


def test_a_larger_part_that_nothing_ties_to_the_site_does_not_take_its_place() -> None:
    world = World(8)

    def some(hub: str, numbers: range) -> Calibration:
        names = [f"cam{number}" for number in numbers]
        return replace(world.parts[hub], cameras={name: world.parts[hub].cameras[name] for name in names})

    last = merge_calibrations({"a": some("a", range(5))}, GROUPS, world.rig)
    found = merge_calibrations({"a": some("a", range(5)), "b": some("b", range(8, 16))}, GROUPS, world.rig, last=last)
    assert set(found.cameras) == set(last.cameras)
    assert world.position_errors(found).max() < 1e-8
    anew = merge_calibrations({"b": some("b", range(8, 16))}, GROUPS, world.rig, last=last)
    assert set(anew.cameras) == {f"cam{number}" for number in range(8, 16)}, "two worlds are not mixed"
    assert anew.reference in anew.cameras


def test_a_restarted_camera_does_not_hold_the_clock() -> None:
    world = World(4)
    last = merge_calibrations(world.parts, GROUPS, world.rig)
    reference = last.reference
    shifted = {
        hub: replace(part, cameras={
            name: replace(one, time_map=TimeMap(one.time_map.clock_rate, one.time_map.time_offset - 50.0),
                          lag_time=one.lag_time + 50.0) if name == reference else one
            for name, one in part.cameras.items()})
        for hub, part in world.parts.items()
    }  # fmt: skip
    boots = {hub: {name: "new" if name == reference else "" for name in part.cameras} for hub, part in shifted.items()}
    found = merge_calibrations(shifted, GROUPS, world.rig, boots, last, {})
    kept = next(name for name in found.cameras if name != reference)
    assert found.cameras[kept].time_map.time_offset == pytest.approx(last.cameras[kept].time_map.time_offset, abs=1e-6)
    assert found.cameras[reference].time_map.time_offset == pytest.approx(-50.0, abs=1e-2)


def test_control_points_of_one_group_fix_the_world_of_all() -> None:
    world = World(5)
    cameras = dict(world.rig.cameras)
    for name in ("cam0", "cam3", "cam6"):
        cameras[name] = replace(cameras[name], position=world.poses[name].position)
    found = merge_calibrations(world.parts, GROUPS, replace(world.rig, cameras=cameras))
    assert found.scale == "metric"
    for name, camera in found.cameras.items():
        assert np.allclose(camera.pose.position, world.poses[name].position, atol=1e-6)


def test_a_part_that_shares_too_few_is_left_out_with_a_reason() -> None:
    world = World(6)
    alone = {f"cam{number}" for number in range(10, 14)}  # of b's, without its borders
    only = {name: camera for name, camera in world.parts["b"].cameras.items() if name in alone}
    parts = {hub: replace(part, cameras={n: c for n, c in part.cameras.items() if n not in alone})
             for hub, part in world.parts.items()} | {"b": replace(world.parts["b"], cameras=only)}  # fmt: skip
    found = merge_calibrations(parts, GROUPS, world.rig)
    assert set(found.refused) == alone
    assert alone.isdisjoint(found.cameras)
    with pytest.raises(Refused):
        merge_calibrations({}, GROUPS, world.rig)
