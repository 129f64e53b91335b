"""Tracking of people by the hub: from a log with a given calibration, and live over Zenoh."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from deploy.cli import run
from deploy.demo.people import score_log
from deploy.offline.exchange import session_log
from deploy.offline.follow.calibration import read_given_calibration
from deploy.offline.follow.source import read_follow_input
from deploy.simulation.session import camera_tables
from edge import scenes
from edge.scenes.people.scene import PeopleScene
from hub.live.agent import run_hub, status_message
from hub.live.live_hub import KnownCalibration, LiveHub, LiveSettings, merge_rigs
from hub.live.solver import SolverJob, _unlike_others, run_job
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, read_calibration
from protocols.session.observations import Observations, Track
from protocols.session.rig import Rig, RigCamera
from protocols.topics import CAMERA_INFO, OBSERVATION, PREDICTION, TRACK
from tests.support import rigs
from tests.support.crowds import NAMES, boxes_csv, ends, lens, write_calibration
from tests.support.people_traffic import Traffic, film
from tests.support.samples import camera_info, eventually
from tests.support.threads import running

SCENE = scenes.get_people_scene(21, 4, 3)


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    """Eight seconds."""
    return film(SCENE, 8.0, 21)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene's own calibration, z up."""
    _, tables = camera_tables(SCENE, "people")
    tables["metadata"]["up"] = [0.0, 0.0, 1.0]
    file = tmp_path_factory.mktemp("known") / "known.toml"
    file.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def log(traffic: Traffic, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The messages of the cameras, as written by a recorder."""
    file = tmp_path_factory.mktemp("log") / "people.mcap"
    with LogWriter(file, {}) as writer:
        for info in traffic.infos:
            writer.write(CAMERA_INFO, info.camera, "yard", info, 0)
        for arrival, message in traffic.arrivals:
            writer.write(OBSERVATION, message.camera, "yard", message, round(arrival * NANOSECONDS))
    return file


def test_a_replayed_log_tracks_everybody_with_equal_bytes(log: Path, known: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        arguments = ["replay", str(log), "--through", "hub", "--calibration", str(known)]
        assert run([*arguments, "--out", str(tmp_path / f"{name}.mcap")]) == 0
    messages = [
        [
            (m.topic.name, m.log_time_ns, m.message.SerializeToString(deterministic=True))
            for m in LogReader(f).messages()
        ]
        for f in (tmp_path / "one.mcap", tmp_path / "two.mcap")
    ]
    assert messages[0] == messages[1]
    both = tmp_path / "both.mcap"
    with LogWriter(both, {}) as writer:
        for file in (log, tmp_path / "one.mcap"):
            for logged in LogReader(file).messages():
                writer.write(logged.topic, logged.agent, "yard", logged.message, logged.log_time_ns)
    comparison, rows = score_log(both, SCENE)
    assert comparison.on_floor.mota > 0.85, "confirmation takes 0.4 s of eight"
    assert comparison.on_floor.switches == 0
    assert comparison.on_floor.error < 0.10
    assert comparison.on_floor.truths - comparison.begun.truths == 50 * comparison.people, "5 s, ten times a second"
    assert comparison.begun.mota > comparison.on_floor.mota
    assert len(rows) > 100
    heads = [m.message for m in LogReader(tmp_path / "one.mcap").messages([PREDICTION])]
    assert any(target.face for message in heads for camera in message.cameras for target in camera.targets)  # type: ignore[attr-defined]


def test_what_is_waited_for_of_people_is_said_of_people(traffic: Traffic) -> None:
    """The page said `0 of 90 detections` of cameras that each saw four people."""
    hub = LiveHub()
    for message in traffic.messages():
        hub.handle(message)
    for name in hub.stream.people.cameras:
        hub.handle(camera_info(name))
    assert all(re.fullmatch(r"[1-9]\d* of 40 s of people", one.reason) for one in hub.progress()), hub.progress()
    status = status_message(hub, "hub", "boot", 0, [])
    assert "observed too briefly yet" in status.message
    assert "motion shared" not in status.message


def test_lags_by_people_are_right_within_their_stds() -> None:
    """By feet too they were 25 ms off at stds of 9. With two people of one height it takes feet to begin."""
    scene = scenes.get_people_scene(9, 3, 2)
    people = (replace(one, height=height) for one, height in zip(scene.people, (1.75, 1.76), strict=True))
    scene = replace(scene, people=tuple(people))
    hub, traffic, due = LiveHub(), film(scene, 60.0, 9), 30.0
    for info in traffic.infos:
        hub.handle(info)
    for at, message in traffic.arrivals:
        hub.handle(message, 1e9 + at)
        if at > due:
            hub.tick(at)
            due = at + 6.0
        if hub.calibration is not None and len(hub.calibration.cameras) == 3:
            break
    found = hub.calibration
    assert found is not None, hub.refusal
    assert len(found.cameras) == 3
    for name, camera in found.cameras.items():
        true = scene.true_time_map(name, found.reference)
        error = camera.lag - (true.clock_rate - 1.0) * camera.lag_time - true.time_offset
        assert abs(error) <= 3.0 * camera.lag_std <= 0.015


@pytest.mark.parametrize(("stated", "up"), [(np.array([0.0, -2.0, 0.0]), [0, -1, 0]), (None, None)])
def test_up_is_where_a_known_calibration_states_it(known: Path, stated: Floats | None, up: list[float] | None) -> None:
    """Of one whose world has y down people were tracked as if z were up."""
    rig, cameras = read_calibration(known)
    hub = LiveHub(LiveSettings(), known=KnownCalibration(replace(rig, up=stated), cameras))
    assert hub.tracking is not None
    given = hub.tracking.tracker.parameters.up
    assert (None if given is None else given.tolist()) == up


@pytest.mark.parametrize("through", [[], ["--through", "uav"]])
def test_a_calibration_is_for_the_hub_only(
    log: Path, known: Path, tmp_path: Path, through: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "x.mcap")] if through else []
    assert run(["replay", str(log), *through, *out, "--calibration", str(known)]) == 2
    assert "--calibration goes with --through hub" in capsys.readouterr().err


def test_a_reloaded_answer_is_verified_by_people_where_there_is_no_marker(known: Path) -> None:
    """It waited for markers: a restarted hub of such a rig was "not verified yet" for good, and solved nothing more.

    And walkers are numbered anew by each job: answers were mapped onto other people's paths, all cameras to one point.
    """
    traffic, cameras = film(SCENE, 23.0, 21), read_calibration(known)[1]
    delays = {message.camera: 1e9 + at - message.device_time_ns / NANOSECONDS for at, message in traffic.arrivals}
    answer = Calibration(cameras, traffic.reference, "metric", "m", "joint", "1")
    hub, jobs = LiveHub(), list[SolverJob]()
    submit = hub.solver.submit
    hub.solver.submit = lambda job, now: (jobs.append(job), submit(job, now))[1]  # type: ignore[method-assign,func-returns-value]
    hub.reload(answer, dict.fromkeys(cameras, "boot0"), delays)
    for info in traffic.infos:
        hub.handle(info)
    states = set()
    for at, message in traffic.arrivals:
        hub.handle(message, 1e9 + at)
        hub.tick(at)
        states.add(hub.state(at)[0])
        if hub.counters["verified"]:
            break
    assert "degraded" in states
    assert hub.state(at) == ("calibrated", "4 cameras calibrated")
    for later in (2.0, 4.0):
        hub.tick(at + later, final=True)
    assert hub.counters["solved"] == 2
    assert hub.calibration is not None
    assert hub.calibration.trajectories
    assert [job.last is None or job.last.trajectories for job in jobs] == [()] * 3


@pytest.mark.parametrize("given", [False, True])
def test_people_who_walk_from_one_view_to_the_next_contradict_no_calibration(known: Path, given: bool) -> None:
    """A restarted hub threw a right calibration away, and a given one was `degraded`: their clocks shared no time."""
    traffic, (rig, cameras) = film(SCENE, 80.0, 21), read_calibration(known)
    delays = {message.camera: 1e9 + at - message.device_time_ns / NANOSECONDS for at, message in traffic.arrivals}
    hub = LiveHub(LiveSettings(track=False), known=KnownCalibration(rig, cameras) if given else None)
    hub.reload(
        Calibration(cameras, traffic.reference, "metric", "m", "joint", "1"), dict.fromkeys(cameras, "boot0"), delays
    )
    for info in traffic.infos:
        hub.handle(info)
    for at, message in traffic.arrivals:
        if message.camera != f"cam{int(at // 40.0)}":
            del message.detections[:]
        hub.handle(message, 1e9 + at)
        hub.tick(at)
    assert sum(hub.stream.people.seconds(name) > 40.0 for name in cameras) == 2
    assert hub.calibration is not None
    assert set(hub.calibration.cameras) == set(cameras)
    reason = hub.state(at)[1]
    assert (
        reason == ("" if given else "the calibration was reloaded and is not verified yet; ") + "4 cameras calibrated"
    )


def test_a_camera_with_a_finer_image_was_not_moved(known: Path) -> None:
    cameras = read_calibration(known)[1]
    lens = cameras["cam3"].intrinsics
    finer = replace(lens, matrix=lens.matrix * np.array([[3.0], [3.0], [1.0]]))
    cameras["cam3"] = replace(cameras["cam3"], intrinsics=finer)
    sigmas = dict.fromkeys(cameras, 1.0)
    assert _unlike_others({**sigmas, "cam3": 3.0}, cameras) == ()
    assert [text[:4] for text in _unlike_others({**sigmas, "cam2": 3.0}, cameras)] == ["cam2"]


def test_what_is_seen_is_the_target_whatever_the_hubs_own_file_says() -> None:
    own = Rig({}, metadata={"target": "charuco:7x5", "scene": "yard"})
    assert merge_rigs(Rig({}, metadata={"target": "person"}), own).metadata == {"target": "person", "scene": "yard"}
    assert merge_rigs(Rig({}), own).metadata["target"] == "charuco:7x5"


def test_what_the_hubs_own_file_leaves_out_of_a_camera_is_as_the_camera_tells() -> None:
    """With a table for a distance, of a size only, a camera lost its lens: it was refused, or another one estimated."""
    heard = rigs.simulate(5, 2, 2).rig
    own = Rig({"cam0": RigCamera("cam0", (1280, 720), position=np.ones(3))}, distances=(("cam0", "cam1", 3.0),))
    merged = merge_rigs(heard, own)
    assert merged.cameras["cam0"].intrinsics is heard.cameras["cam0"].intrinsics
    assert merged.cameras["cam0"].fps == heard.cameras["cam0"].fps
    assert merged.cameras["cam0"].position is own.cameras["cam0"].position
    assert merged.cameras["cam1"] is heard.cameras["cam1"]


@pytest.mark.parametrize(("turned", "state"), [(0.0, "calibrated"), (0.02, "degraded"), (0.14, "degraded")])
def test_a_given_calibration_is_tested_by_people_where_there_is_no_marker(
    known: Path, turned: float, state: str
) -> None:
    """A tripod that was kicked between two films was not noticed: the calibration was tested by markers alone."""
    rig, cameras = read_calibration(known)
    pose = cameras["cam1"].pose
    moved = Pose(so3.exp(np.array([0.0, turned, 0.0])) @ pose.rotation, pose.position)
    cameras["cam1"] = replace(cameras["cam1"], pose=moved, rms_px=0.2)
    hub, traffic = LiveHub(known=KnownCalibration(rig, cameras)), film(SCENE, 24.0, 21)
    for message in (*traffic.infos, *traffic.messages()):
        hub.handle(message)
    hub.tick(1.0)
    found, reason = hub.state(1.0)
    assert found == state, reason
    assert ("cam1: " in reason and "was it moved" in reason) == (turned > 0.0), reason


@pytest.mark.parametrize("turned", [0.0, 0.09])
def test_people_whom_colours_do_not_tell_apart_name_a_camera_that_is_turned(tmp_path: Path, turned: float) -> None:
    """Each test calibrated the rig anew by where people stand: 25 s of CPU for a minute of a crowd."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    seconds = 110.0 if turned else 60.0
    (tmp_path / "boxes.csv").write_text(boxes_csv(seconds), encoding="utf-8")
    found = read_follow_input(tmp_path / "boxes.csv", known, "person", tmp_path).observations
    hub = LiveHub(known=KnownCalibration(known.rig, known.calibration.cameras))
    for name in NAMES:
        hub.handle(session_log.camera_info(known.rig, name))
    said, next_tick = dict[float, str](), 0.0
    for message in sorted(found, key=lambda one: one.device_time_ns):
        at = message.device_time_ns / NANOSECONDS
        if message.camera == "right" and at > 40.0:
            for one in message.detections:
                for point in (one.head, one.foot):
                    point[0] += turned * lens().focal
                one.u += turned * lens().focal
        hub.handle(message, 1e9 + at)
        if at >= next_tick:
            next_tick = at + 2.0
            hub.tick(at)
            said[at] = hub.state(at)[1]
    named = [at for at, text in said.items() if "right: its people are 0" in text]
    assert bool(named) == bool(turned), said
    assert all(50.0 < at < 100.0 for at in named[:1])
    assert turned == 0.0 or named[-1] >= 108.0


def given_job(folder: Path, labelled: tuple[str, ...], turned: float, late: float = 0.0) -> SolverJob:
    """A test of a given calibration by people, of whom two are labelled in some cameras; "back" turned and late."""
    known = read_given_calibration(write_calibration(folder / "calibration.toml"))
    offsets = dict.fromkeys(NAMES, 0.0) | {"back": late}
    (folder / "boxes.csv").write_text(boxes_csv(40.0, offsets=offsets), encoding="utf-8")
    people = read_follow_input(folder / "boxes.csv", known, "person", folder).observations
    for one in people:
        for person in one.detections if one.camera == "back" else ():
            person.head[0] += turned * lens().focal
            person.foot[0] += turned * lens().focal
    time, rng, tracks = np.arange(200) / 5.0, np.random.default_rng(3), dict[tuple[str, str], Track]()
    for name in labelled:
        heads = np.array([ends(name, at)[0] for at in time]) + rng.normal(0.0, 1.0, (200, 3, 2))
        for k in range(2):
            stamps = time - offsets[name]
            tracks[name, f"{k}-head"] = Track(
                name, f"{k}-head", np.arange(200), stamps, heads[:, k], np.full(200, np.nan)
            )
    rig = replace(known.rig, metadata={**known.rig.metadata, "target": "person"})
    return SolverJob(1, rig, Observations(tracks), known.calibration, verify=True, given=True, people=tuple(people))


def test_labelled_people_and_places_both_test_a_given_calibration(tmp_path: Path) -> None:
    """Of both answers that of more cameras was taken: a clock 2 s off, and a camera without a label, were silent."""
    late = run_job(given_job(tmp_path, NAMES, 0.0, 2.0)).calibration
    assert late is not None
    assert list(late.refused) == ["back"]
    turned = run_job(given_job(tmp_path, NAMES[:2], 0.09)).calibration
    assert turned is not None
    assert any(text.startswith("back: its people are 0.") for text in turned.warnings)
    right = run_job(given_job(tmp_path, NAMES, 0.0)).calibration
    assert right is not None
    assert (dict(right.refused), right.warnings) == ({}, ())


def test_too_few_people_are_no_news_of_a_given_calibration(tmp_path: Path) -> None:
    """The fault of a camera that was named was forgotten when people had left all views but one."""
    job = given_job(tmp_path, (), 0.09)
    assert run_job(job).calibration is not None
    alone = tuple(one for one in job.people if one.camera == "back")
    lying = tuple(pb.Observation.FromString(one.SerializeToString()) for one in job.people)
    for one in lying:
        for person in one.detections:
            person.head[:], person.foot[:] = list(person.foot), list(person.head)
    for people in (alone, job.people[::60], lying):
        answer = run_job(replace(job, people=people))
        assert answer.calibration is None
        assert not answer.permanent
        assert not answer.failed


def test_tracks_and_predictions_come_over_the_bus(traffic: Traffic, known: Path) -> None:
    """Observations in over a real router; tracks and predictions out."""
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    hub = LiveHub(LiveSettings(), known=KnownCalibration(*read_calibration(known)))
    with Router(endpoint), open_bus("yard", config) as bus, open_bus("yard", config) as cameras:
        tracks, predictions = cameras.subscribe(TRACK), cameras.subscribe(PREDICTION)
        publishers = {c.name: cameras.publisher(OBSERVATION, c.name) for c in SCENE.cameras}
        with running(lambda stop: run_hub(hub, bus, "hub", stop)) as stop:
            for publisher in publishers.values():
                assert publisher.wait_matched(20.0)
            for number, message in enumerate(traffic.messages()):
                publishers[message.camera].put(message)
                if number % 8 == 0:  # about twice as fast as it was filmed: the lag is half a second of that
                    stop.wait(0.05)
                    sent = number + 1
                    assert eventually(lambda sent=sent: hub.counters["observations"] >= sent, 20.0), hub.counters
            received_tracks: list[pb.Track] = []

            def all_received() -> bool:
                received_tracks.extend(r.message for r in tracks.drain() if isinstance(r.message, pb.Track))
                return hub.tracking is not None and hub.tracking.counters["track.frames"] >= 0.9 * len(traffic.arrivals)

            assert eventually(all_received, 60.0)
            assert eventually(lambda: all_received() and len({t.label for t in received_tracks}) >= 3, 20.0)
            last = predictions.drain()[-1].message
    assert {t.state for t in received_tracks} <= {"confirmed", "coasting", "lost"}
    assert all(t.kind == "person" for t in received_tracks)
    newest = max(received_tracks, key=lambda t: t.reference_time_ns)
    truth = SCENE.centres(np.array([traffic.true_time_ns(newest.reference_time_ns)]))[0]
    assert np.linalg.norm(truth[:, :2] - np.array(newest.position)[:2], axis=1).min() < 0.3
    assert isinstance(last, pb.Prediction)
    assert {camera.camera for camera in last.cameras} == {c.name for c in SCENE.cameras}


def test_people_of_whom_no_row_is_left_are_refused(traffic: Traffic, monkeypatch: pytest.MonkeyPatch) -> None:
    hub = LiveHub()
    for message in traffic.messages():
        hub.handle(message)
    monkeypatch.setattr("hub.tracking.calibration.people._matches_colour", lambda *_: False)
    with pytest.raises(Refused, match="colours of the people are ambiguous"):
        hub.stream.build(of_marker=False)


def without_colours(scene: PeopleScene, seconds: float, seed: int) -> Traffic:
    traffic = film(scene, seconds, seed)
    for message in traffic.messages():
        for one in message.detections:
            one.ClearField("colour")
    return traffic


def test_unlabelled_people_calibrate_the_hub_and_are_tracked() -> None:
    """By a log of the same messages `calibrate` answered; the hub waited for colours that were not there.

    A camera that joins later is found, and a hub that is restarted verifies the answer in the same way.
    """
    scene = scenes.get_people_scene(9341, 4, 4)
    traffic, hub, tracks = without_colours(scene, 72.0, 9341), LiveHub(), list[pb.Track]()
    for info in traffic.infos:
        hub.handle(info)
    reasons, joins, due = set(), 36.0, 0.0
    for at, message in traffic.arrivals:
        if message.camera == "cam3" and at < joins:
            continue
        hub.handle(message, 1e9 + at)
        if at >= due:  # each job takes seconds of the test
            reasons.add(hub.state(at)[1].partition(" (")[0])
            tracks += [one for one in hub.tick(at) if isinstance(one, pb.Track)]
            due = at + (16.0 if hub.calibration is not None else 8.0)
        elif hub.tracking is not None:
            tracks += [one for one in hub.tracking.tick(at) if isinstance(one, pb.Track)]
        if hub.calibration is not None and len(hub.calibration.cameras) == 4:
            break
    assert "people observed too briefly yet" in reasons
    found = hub.calibration
    assert found is not None, hub.refusal
    assert set(found.cameras) == {camera.name for camera in scene.cameras}, found.refused
    assert len({one.label for one in tracks if one.state == "confirmed"}) >= 3
    for name, camera in found.cameras.items():
        true = scene.true_time_map(name, found.reference)
        error = camera.lag - (true.clock_rate - 1.0) * camera.lag_time - true.time_offset
        assert abs(error) <= 3.0 * camera.lag_std <= 0.03
    again = LiveHub()
    again.reload(found, hub.boot_ids, hub.delays)
    for info in traffic.infos:
        again.handle(info)
    again.tick(40.0)  # the frames arrive at the hub's time, of which it knows by its ticks
    for at, message in traffic.arrivals:
        if at > 28.0:
            again.handle(message, 1e9 + at)
    for now in (80.0, 81.0, 82.0):
        again.tick(now)
    assert again.counters["verified"], again.state(82.0)
