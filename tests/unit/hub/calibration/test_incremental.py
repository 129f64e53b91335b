"""Incremental calibration: as good as from scratch, in a gauge that holds, and what it says of cameras that change."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hub.bundle import clock_steps
from hub.bundle.problem import ClockStep
from hub.calibration.incremental import _clock_step, update_calibration
from hub.calibration.pipeline import calibrate
from hub.clocks.external_prior import ERROR_BOUND_S, ArrivalPriors, ExternalClockPrior
from protocols.core.clocks import CameraTime
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.pose import Pose, fit_similarity
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from tests.support.rigs import Session, simulate


def until(session: Session, true_s: float, **since: float) -> Observations:
    """The rows until a true time; of the named cameras only those since another."""
    true = session.true
    begin = np.array([since.get(camera, -np.inf) for camera in session.camera])
    return session.observations(np.flatnonzero((true <= true_s) & (true >= begin)))


def priors(session: Session, **wrong: float) -> dict[str, ExternalClockPrior]:
    """Arrival priors, right within 0.1 s except for the named cameras' errors."""
    rng = np.random.default_rng(5)
    return {
        name: ExternalClockPrior(
            "", -session.shown(name, 0.0) + rng.uniform(0.0, 0.1) + wrong.get(name, 0.0), ERROR_BOUND_S
        )
        for name in session.rig.cameras
    }


def moved_stds(before: Calibration, after: Calibration) -> float:
    """Largest move of a camera's centre between two answers, in stds."""
    out = []
    for name, camera in after.cameras.items():
        if name in before.cameras:
            std = float(np.linalg.norm(np.hypot(camera.position_std, before.cameras[name].position_std)))
            move = float(np.linalg.norm(camera.pose.position - before.cameras[name].pose.position))
            out.append(move / max(std, 1e-12))
    return float(max(out))


def test_growing_rows_refine_the_answer_in_a_gauge_that_holds() -> None:
    session = simulate(3, 4, 50)
    last: Calibration | None = None
    for seconds in (20.0, 26.0, 32.0, 38.0, 44.0, 50.0):
        found = update_calibration(
            session.rig, until(session, seconds), last, full=last is None, search=last is None
        ).calibration
        for name, camera in found.cameras.items():
            at = CameraTime(camera.lag_time)
            error = float(camera.time_map.reference_from_camera(at)) - session.shown(
                found.reference, session.true_time(name, camera.lag_time)
            )
            assert abs(error) <= 4.0 * camera.time_offset_std + 1e-6
        if last is not None:
            assert moved_stds(last, found) < 3.0
            assert found.reference == last.reference
        last = found
    assert last is not None
    scratch = calibrate(session.rig, until(session, 50.0))
    for name, camera in last.cameras.items():
        at = CameraTime(camera.lag_time)
        difference = float(camera.time_map.reference_from_camera(at)) - float(
            scratch.cameras[name].time_map.reference_from_camera(at)
        )
        assert abs(difference) <= camera.time_offset_std + 1e-6


def test_a_late_camera_joins_by_resection_within_its_arrival_bound() -> None:
    session = simulate(11, 4, 40)
    first = update_calibration(session.rig, without(until(session, 25.0), "cam3"), None).calibration
    assert set(first.cameras) == {"cam0", "cam1", "cam2"}
    joined = update_calibration(
        session.rig, until(session, 40.0, cam3=28.0), first, full=False, arrivals=priors(session)
    ).calibration
    assert "cam3" in joined.cameras
    camera = joined.cameras["cam3"]
    truth = session.shown(joined.reference, session.true_time("cam3", camera.lag_time))
    assert abs(float(camera.time_map.reference_from_camera(CameraTime(camera.lag_time))) - truth) < 2e-3


def test_between_two_searches_a_camera_keeps_the_reason_of_the_last() -> None:
    """The page said of a camera whose pixels are in another unit that it waits, for ever."""
    session = simulate(11, 4, 30)
    rows = until(session, 30.0)
    scaled = {
        key: replace(track, pixels=track.pixels / 1000.0) if key[0] == "cam3" else track
        for key, track in rows.tracks.items()
    }
    rows = replace(rows, tracks=scaled)
    first = update_calibration(session.rig, without(until(session, 20.0), "cam3"), None).calibration
    waiting = update_calibration(session.rig, rows, first, full=False, search=False).calibration
    assert waiting.refused == {"cam3": "waits for the next search of its lag; before: no observations"}
    searched = update_calibration(session.rig, rows, waiting, full=True).calibration
    reason = searched.refused["cam3"]
    for found in (
        searched,
        replace(searched, refused={"cam3": f"waits for the next search of its lag; before: {reason}"}),
    ):
        again = update_calibration(session.rig, rows, found, full=False, search=False).calibration
        assert again.refused == {"cam3": f"waits for the next search of its lag; before: {reason}"}


def test_a_late_camera_without_a_lens_joins_and_has_it_estimated() -> None:
    session = simulate(11, 4, 45)
    true = session.rig.cameras["cam3"]
    assert true.intrinsics is not None
    rig = replace(session.rig, cameras=session.rig.cameras | {"cam3": replace(true, intrinsics=None)})
    first = update_calibration(rig, without(until(session, 25.0), "cam3"), None).calibration
    rows = until(session, 45.0, cam3=10.0)
    waiting = update_calibration(rig, rows, first, full=False, arrivals=priors(session)).calibration
    assert "no intrinsics" in waiting.refused["cam3"]
    joined = update_calibration(rig, rows, waiting, full=True, arrivals=priors(session)).calibration
    again = update_calibration(rig, rows, joined, full=False, search=False).calibration
    for found in (joined, again):
        assert not found.refused
        camera = found.cameras["cam3"]
        error = np.log(camera.intrinsics.focal / true.intrinsics.focal)
        assert abs(error) < max(4.0 * camera.focal_std, 0.004)
        truth = session.shown(found.reference, session.true_time("cam3", camera.lag_time))
        assert abs(float(camera.time_map.reference_from_camera(CameraTime(camera.lag_time))) - truth) < 2e-3


@pytest.mark.parametrize("error", [-3.0, 0.7, 5.0])
def test_a_wrong_arrival_gives_no_wrong_lag(error: float) -> None:
    session = simulate(11, 4, 40)
    first = update_calibration(session.rig, without(until(session, 25.0), "cam3"), None).calibration
    rows = until(session, 40.0, cam3=28.0)
    wrong = priors(session, cam3=error)
    found = update_calibration(session.rig, rows, first, full=False, arrivals=wrong).calibration
    assert "cam3" not in found.cameras
    assert "arrival" in found.refused["cam3"]
    full = update_calibration(session.rig, rows, found, full=True, arrivals=wrong).calibration
    camera = full.cameras["cam3"]
    truth = session.shown(full.reference, session.true_time("cam3", camera.lag_time))
    assert abs(float(camera.time_map.reference_from_camera(CameraTime(camera.lag_time))) - truth) < 2e-3


@pytest.mark.parametrize(("shift_m", "turn_rad"), [(0.0, 0.035), (0.05, 0.0), (0.05, 0.035)])
def test_a_moved_camera_is_found_again_where_it_stands(shift_m: float, turn_rad: float) -> None:
    """It must neither drag the others nor lose its clock."""
    session = simulate(21, 4, 40, windows=[(0, 40)] * 4)
    pose = session.poses["cam2"]
    moved = Pose(
        so3.exp(np.array([0.0, turn_rad, 0.0])) @ pose.rotation, pose.position + shift_m * np.array([0.6, 0.0, 0.8])
    )
    bumped = session.moved("cam2", 30.0, moved)
    last = update_calibration(session.rig, until(bumped, 29.0), None).calibration
    update = update_calibration(session.rig, until(bumped, 34.0), last, full=False)
    assert list(update.moved) == ["cam2"]
    assert abs(session.true_time("cam2", update.moved["cam2"]) - 30.0) < 0.3
    found = update.calibration
    assert moved_stds(last, replace(found, cameras={n: c for n, c in found.cameras.items() if n != "cam2"})) < 3.0
    names = list(session.poses)
    truth = [moved if name == "cam2" else session.poses[name] for name in names]
    world = fit_similarity(
        np.array([found.cameras[name].pose.position for name in names]), np.array([one.position for one in truth])
    )
    for name, one in zip(names, truth, strict=True):
        placed = world.pose(found.cameras[name].pose)
        assert so3.angle_between(placed.rotation, one.rotation) < 0.005
    before, after = last.cameras["cam2"].time_map, found.cameras["cam2"].time_map
    at = CameraTime(update.moved["cam2"])
    assert abs(float(before.reference_from_camera(at)) - float(after.reference_from_camera(at))) < 3e-3


@pytest.mark.parametrize(("seed", "degrees", "seen_s"), [(2, 1.0, 25.0), (3, 3.0, 26.5), (4, 3.0, 25.0)])
def test_of_cameras_of_different_rates_the_fastest_is_named_where_it_was_moved(
    seed: int, degrees: float, seen_s: float
) -> None:
    """The path follows it: others were named, or nobody, or a clock step, and the world was turned for good."""
    session = simulate(seed, 4, 30, fps=(30, 24, 60, 12.5), windows=[(0, 30)] * 4)
    last = update_calibration(session.rig, until(session, 21.0), None).calibration
    turned = session.turned("cam2", 22.0, np.radians(degrees))
    update = update_calibration(session.rig, until(turned, seen_s), last, full=False)
    assert list(update.moved) == ["cam2"]
    assert turned.turn_error({name: camera.pose for name, camera in update.calibration.cameras.items()}) < 0.01


@pytest.mark.parametrize(("seed", "name"), [(2, "cam2"), (5, "cam1")])
def test_a_camera_with_false_detections_is_not_the_one_that_was_moved(seed: int, name: str) -> None:
    """Without it, whose rows cost most, the others seem to fit best."""
    session = simulate(seed, 3, 30, fps=(30, 24, 60), windows=[(0, 30)] * 3)
    rng = np.random.default_rng(seed)
    false = (np.array(session.camera) == "cam0") & (rng.random(len(session.time)) < 0.15)
    pixels = np.where(false[:, None], rng.uniform(0.0, 400.0, session.pixels.shape), session.pixels)
    session = replace(session, pixels=pixels)
    last = update_calibration(session.rig, until(session, 24.0), None).calibration
    turned = session.turned(name, 25.0, np.radians(2.0))
    assert list(update_calibration(session.rig, until(turned, 28.0), last, full=False).moved) == [name]


def test_where_the_path_follows_one_camera_alone_there_is_no_clock_step() -> None:
    """What rounding left of the information of such a step made it 1e19 s, and the solver failed for a minute."""
    session = simulate(43, 4, 50, fps=(28, 34, 17, 43), fastest=0.4, windows=[(0, 50), (0, 43), (0, 50), (0, 50)])
    last = calibrate(session.rig, until(session, 38.0))
    update = update_calibration(session.rig, until(session.turned("cam3", 40.0, 0.17), 48.5), last, full=False)
    assert list(update.moved) == ["cam3"]


def test_a_camera_moved_after_a_long_time_is_found_within_seconds() -> None:
    """A division into two poses began with the last quarter of the rows, the better half of which is from before."""
    session = simulate(33, 4, 60, fastest=0.4)
    last = calibrate(session.rig, until(session, 50.0))
    turned = session.turned("cam1", 55.0, np.radians(8.0))
    update = update_calibration(session.rig, until(turned, 57.5), last, full=False)
    assert list(update.moved) == ["cam1"]
    assert abs(session.true_time("cam1", update.moved["cam1"]) - 55.0) < 0.3
    assert turned.turn_error({name: camera.pose for name, camera in update.calibration.cameras.items()}) < 0.01


@pytest.mark.parametrize("seed", [34, 35])
def test_a_move_is_dated_right_as_soon_as_it_is_found(seed: int) -> None:
    """Of a long window the sides of a division lasted 4 s: rows before the move were taken for its new place's."""
    session = simulate(seed, 4, 112, fastest=0.4)
    last = calibrate(session.rig, until(session, 107.0))
    turned = session.turned("cam1", 108.0, np.radians(12.0))
    for seconds in (1.5, 2.0, 3.0):
        update = update_calibration(session.rig, until(turned, 108.0 + seconds), last, full=False)
        assert set(update.moved) <= {"cam1"}
        assert all(abs(session.true_time("cam1", since) - 108.0) < 0.3 for since in update.moved.values())
    assert update.moved


@pytest.mark.parametrize(("seed", "angle"), [(4, 0.09), (10, 0.09), (4, -0.03), (12, 0.3)])
def test_a_move_of_one_of_two_cameras_is_named_and_the_rows_since_then_are_used(seed: int, angle: float) -> None:
    """It is no clock step, and the path does not follow both poses."""
    session = simulate(seed, 2, 40, windows=[(0, 40)] * 2)
    last = update_calibration(session.rig, until(session, 20.0), None).calibration
    turned = session.turned("cam1", 20.0, angle)
    update = update_calibration(session.rig, until(turned, 32.0), last, full=False)
    for name, time in update.moved.items():
        assert abs(turned.true_time(name, time) - 20.0) < 0.3
    found = update.calibration
    (warning,) = [text for text in found.warnings if "was moved" in text]
    assert warning.startswith("one of cam0, cam1 was moved at cam0's time")
    assert not any(camera.clock_steps for camera in found.cameras.values())
    assert turned.turn_error({name: camera.pose for name, camera in found.cameras.items()}) < 0.01
    assert abs(turned.clock_error("cam1", found.reference, found.cameras["cam1"].time_map)) < 2e-3


@pytest.mark.parametrize("seed", [4, 10])
def test_a_move_of_one_of_two_cameras_is_no_clock_step_before_it_can_be_named(seed: int) -> None:
    session = simulate(seed, 2, 40, windows=[(0, 40)] * 2)
    last = update_calibration(session.rig, until(session, 20.0), None).calibration
    found = update_calibration(
        session.rig, until(session.turned("cam1", 20.0, 0.09), 21.5), last, full=False
    ).calibration
    assert not any(camera.clock_steps for camera in found.cameras.values())
    assert session.turn_error({name: camera.pose for name, camera in found.cameras.items()}) < 0.01


def test_what_a_clock_step_explains_only_a_part_of_is_a_contradiction_until_the_move_can_be_named() -> None:
    session = simulate(14, 2, 40, windows=[(0, 40)] * 2)
    last = update_calibration(session.rig, until(session, 20.0), None).calibration
    rows = until(session.turned("cam1", 20.0, 0.09), 22.5)
    with pytest.raises(Refused, match=r"the rows contradict the calibration since .*: a camera was moved") as refusal:
        update_calibration(session.rig, rows, last, full=False)
    assert set(refusal.value.cameras) == set(session.rig.cameras), "a hub keeps the last answer and names the reason"


def test_cameras_that_see_nothing_any_more_stay_as_they_were() -> None:
    session = simulate(3, 4, 40)
    last = update_calibration(session.rig, until(session, 30.0), None).calibration
    found = update_calibration(session.rig, without(until(session, 40.0), "cam3"), last, full=False).calibration
    assert found.cameras["cam3"] == last.cameras["cam3"]
    assert moved_stds(last, found) < 3.0


def test_the_published_clock_goes_on_without_its_camera() -> None:
    session = simulate(3, 4, 40)
    last = update_calibration(session.rig, until(session, 30.0), None).calibration
    rest = replace(last, cameras={name: camera for name, camera in last.cameras.items() if name != last.reference})
    rows = without(until(session, 40.0), last.reference)
    found = update_calibration(session.rig, rows, rest, full=False).calibration
    assert found.reference == last.reference
    for name, camera in rest.cameras.items():
        at = CameraTime(camera.lag_time)
        change = float(found.cameras[name].time_map.reference_from_camera(at)) - float(
            camera.time_map.reference_from_camera(at)
        )
        assert abs(change) < 4.0 * max(camera.time_offset_std, 1e-4)


def test_too_few_rows_for_an_answer_are_refused() -> None:
    session = simulate(3, 3, 20)
    with pytest.raises(Refused):
        update_calibration(session.rig, until(session, 3.2), None)


def without(observations: Observations, camera: str) -> Observations:
    return replace(observations, tracks={k: t for k, t in observations.tracks.items() if k[0] != camera})


def test_arrival_priors_need_steady_delays() -> None:
    steady, backlog = ArrivalPriors(), ArrivalPriors()
    for frame in range(600):
        time = frame / 30.0
        steady.handle("a", "b0", time, 1000.0 + time + 0.05 + 0.02 * (frame % 5))
        backlog.handle("a", "b0", time, 1000.0 + 0.1 * time)
    prior = steady.priors()["a"]
    assert abs(prior.unix_minus_camera - 1000.05) < 1e-9
    assert backlog.priors() == {}
    steady.handle("a", "b1", 5.0, 1030.0)
    assert steady.priors() == {}, "another boot is another clock"


@pytest.mark.parametrize(("camera", "size"), [("cam2", 0.03), ("cam0", -0.06), ("cam1", 0.015)])
def test_a_clock_step_inside_the_window_is_recognised_and_the_map_is_that_after_it(camera: str, size: float) -> None:
    """It is no move of the camera, and the time that is published does not step with the reference camera's clock."""
    session = simulate(2, 3, 45)
    mine = session.of_camera(camera)
    at = float(np.quantile(session.time[mine], 0.6))
    begin = session.true_time(camera, at)
    stepped = replace(session, time=session.time + np.where(mine & (session.time >= at), size, 0.0))
    true = session.true
    last: Calibration | None = None
    for seconds in (begin - 3.0, begin + 3.0, begin + 6.0, 45.0):
        rows = stepped.observations(np.flatnonzero(true <= seconds))
        update = update_calibration(session.rig, rows, last, full=last is None, search=last is None)
        assert not update.moved
        last = update.calibration
        assert {name: len(one.clock_steps) for name, one in last.cameras.items() if one.clock_steps} == (
            {} if seconds < begin else {camera: 1}
        )
        published = session.shown("cam0", seconds)
        for name, one in last.cameras.items():
            shown = session.shown(name, seconds) + (size if name == camera and seconds >= begin else 0.0)
            error = float(one.time_map.reference_from_camera(CameraTime(shown))) - published
            assert abs(error) < 2e-3
    ((when, found, std),) = last.cameras[camera].clock_steps
    assert abs(when - at) < 0.7
    assert abs(found - size) < 4.0 * std < 4e-3


def test_a_step_that_only_rejected_rows_ask_for_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a second point with the same label: the rows that it moved away were rejected, and lags 30 to 115 ms off."""
    session = simulate(3, 4, 30)
    last = update_calibration(session.rig, until(session, 25.0), None).calibration
    false = [ClockStep(0, 2.0, 0.06, np.inf, 1e4)]
    monkeypatch.setattr(clock_steps, "find_clock_step", lambda problem, state: false.pop() if false else None)
    found = update_calibration(session.rig, session.observations(), last, full=False, search=False).calibration
    assert not any(one.clock_steps for one in found.cameras.values())


@pytest.mark.parametrize(("more", "is_step"), [(0.04, True), (0.1, False), (-160_938.0, False)])
def test_a_known_step_grows_to_no_more_than_stamps_hide(
    monkeypatch: pytest.MonkeyPatch, more: float, is_step: bool
) -> None:
    """What was left of one was added to it, whatever its size."""
    monkeypatch.setattr(clock_steps, "find_clock_step", lambda *_: None)
    monkeypatch.setattr(clock_steps, "remaining_step", lambda *_: ClockStep(0, 2.0, more, 1e-4, 0.0))
    prepared: Any = SimpleNamespace(time_scale=lambda _: 1.0, time_origins={"cam0": 0.0})
    reconstruction: Any = SimpleNamespace(names=["cam0"], problem=None, state=None)
    found = _clock_step({"cam0": ((2.0, 0.15, 1e-3),)}, prepared, reconstruction)
    assert found == (("cam0", (2.0, more, 1e-4)) if is_step else None)


def test_the_first_answer_of_a_window_with_a_clock_step_holds_after_it() -> None:
    session = simulate(1, 4, 40)
    mine = session.of_camera("cam2")
    at = float(np.quantile(session.time[mine], 0.8))
    stepped = replace(session, time=session.time + np.where(mine & (session.time >= at), 0.03, 0.0))
    found = update_calibration(session.rig, stepped.observations(), None).calibration
    assert len(found.cameras["cam2"].clock_steps) == 1
    shown = CameraTime(session.shown("cam2", 40.0) + 0.03)
    error = float(found.cameras["cam2"].time_map.reference_from_camera(shown)) - session.shown(found.reference, 40.0)
    assert abs(error) < 2.0 * found.cameras["cam2"].time_offset_std < 4e-3
