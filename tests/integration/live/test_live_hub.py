"""The live hub on messages: missing data, solving, restarts, duplicates, deterministic output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from deploy.agents.answer_store import AnswerStore
from deploy.agents.assembly import write_last
from hub.live.agent import status_message
from hub.live.live_hub import KnownCalibration, LiveHub, LiveSettings
from hub.live.solver import InlineSolver, SolverAnswer, SolverJob
from protocols.core.clocks import NANOSECONDS, CameraTime
from protocols.core.ranges import MAX_DISTORTION
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import SessionBuilder
from protocols.session.calibration import read_calibration
from protocols.session.rig import Rig
from tests.support.rigs import Session, simulate
from tests.support.session_messages import info_messages, row_messages

SETTINGS = LiveSettings(window_s=60.0, interval_s=2.0)


def messages(session: Session, boot: str = "boot0", shift_s: float = 0.0) -> list[Message]:
    """Camera infos first, then one observation a row, as agents publish them."""
    begins = {name: session.time[session.of_camera(name)].min() for name in session.rig.cameras}
    order = np.argsort(session.time - np.array([begins[name] for name in session.camera]))
    rows = row_messages(session, lambda _: boot, order.tolist(), lambda i: float(session.time[i] + shift_s))
    return [*info_messages(session, lambda _: boot), *rows]


def feed(hub: LiveHub, stream: list[Message], batch: int = 200) -> list[Message]:
    """Feed the stream in batches half a second apart, then solve finally."""
    out: list[Message] = []
    for tick, begin in enumerate(range(0, len(stream), batch)):
        for message in stream[begin : begin + batch]:
            hub.handle(message)
        out += hub.tick(0.5 * tick)
    return out + hub.tick(1e6, final=True)


def calibrations(published: list[Message]) -> list[pb.Calibration]:
    return [message for message in published if isinstance(message, pb.Calibration)]


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(71, 3, 20)


def test_it_reports_what_is_missing_until_it_can_solve(session: Session) -> None:
    hub = LiveHub(SETTINGS)
    (silent,) = calibrations(hub.tick(0.0))
    assert "0 of at least 2 cameras" in silent.reason
    stream = messages(session)
    hub.handle(stream[0])
    hub.handle(stream[3])
    (first,) = calibrations(hub.tick(3.0))
    assert first.status == "collecting"
    assert "1 of at least 2 cameras" in first.reason
    last = calibrations(feed(LiveHub(SETTINGS), stream))[-1]
    assert last.status == "solved"
    assert {camera.camera for camera in last.cameras} == {"cam0", "cam1", "cam2"}


def test_the_calibration_is_correct_and_its_std_consistent(session: Session) -> None:
    hub = LiveHub(SETTINGS)
    feed(hub, messages(session))
    assert hub.calibration is not None
    for name, camera in hub.calibration.cameras.items():
        error = session.clock_error(name, hub.calibration.reference, camera.time_map)
        assert abs(error) < 1e-3
        assert abs(error) <= 5.0 * camera.time_offset_std


def test_the_same_messages_give_the_same_bytes(session: Session) -> None:
    runs = [
        [m.SerializeToString(deterministic=True) for m in feed(LiveHub(SETTINGS), messages(session))] for _ in range(2)
    ]
    assert runs[0] == runs[1]


def test_duplicate_and_reordered_messages_have_no_effect(session: Session) -> None:
    stream = messages(session)
    shuffled = [stream[i] for i in np.random.default_rng(0).permutation(len(stream))]
    plain, noisy = LiveHub(SETTINGS), LiveHub(SETTINGS)
    # All at once: an answer also depends, within its std, on the answer that it started from.
    last = calibrations(feed(plain, stream, batch=10**9))[-1]
    again = calibrations(feed(noisy, [*shuffled, *stream[:500]], batch=10**9))[-1]
    assert last.cameras == again.cameras


def test_a_restarted_camera_has_another_clock(session: Session) -> None:
    """Its clock restarts: the two boot ids must not be mixed, and the longer one is used."""
    builder = SessionBuilder()
    stream = messages(session)
    for message in stream:
        builder.handle(message)
    for message in messages(session, boot="boot1", shift_s=5000.0)[:400]:
        builder.handle(message)
    _, observations = builder.build()
    assert builder.boot("cam0") == "boot0"
    for name in ("cam0", "cam1", "cam2"):
        (track,) = observations.of_camera(name)
        assert np.ptp(track.time) < 30.0


def test_a_restarted_reference_camera_leaves_the_reference_clock_as_it_is(session: Session, tmp_path: Path) -> None:
    """The clock went back to that of the new run, and nothing was tracked until it had caught up."""
    first, again = messages(session), messages(session, boot="boot1", shift_s=-5000.0)
    begin = len(first) // 2
    # cam0 alone has the other boot id from there on: the stream of a rig whose reference camera was restarted.
    rest = [new if new.camera == "cam0" else old for old, new in zip(first, again, strict=True)]  # type: ignore[attr-defined]
    hub, step = LiveHub(SETTINGS), 50
    stream = first[:begin] + rest[:3] + rest[begin:]
    tracks: list[pb.Track] = []
    for tick, at in enumerate(range(0, len(stream), step)):
        for message in stream[at : at + step]:
            hub.handle(message)
        out = hub.tick(10.0 * tick)
        tracks += [message for message in out if isinstance(message, pb.Track)]
        if at < begin <= at + step:
            assert hub.calibration is not None
            before = hub.calibration
    assert hub.calibration is not None
    assert set(hub.calibration.cameras) == set(before.cameras) == {"cam0", "cam1", "cam2"}
    assert hub.boot_ids["cam0"] == "boot1"
    for name in ("cam1", "cam2"):
        now, then = hub.calibration.cameras[name], before.cameras[name]
        at_s = CameraTime(then.lag_time)
        moved = now.time_map.reference_from_camera(at_s) - then.time_map.reference_from_camera(at_s)
        assert abs(moved) < 0.01, "the clock of before"
    times = [one.reference_time_ns / NANOSECONDS for one in tracks if one.state == "confirmed"]
    newest = session.time[session.of_camera("cam0")].max()
    assert times[-1] > newest - 2.0, "tracked to the end"
    store = AnswerStore(tmp_path)
    assert hub.session is not None
    store.keep(hub.calibration, hub.session[0], hub.boot_ids, hub.links.delays)
    store.close()
    kept = AnswerStore(tmp_path).load()
    assert kept is not None
    base = kept[0].cameras[kept[0].reference].time_map
    assert (base.clock_rate, base.time_offset) == (1.0, 0.0), "a file's reference clock is one of its cameras'"


def test_when_all_cameras_were_restarted_they_are_tracked_again_as_soon_as_they_are_located(session: Session) -> None:
    """The answer on the clocks of before was from more rows, so it stayed until there were as many: without a track."""
    long = simulate(71, 3, 50)
    rows = [one for one in messages(long, "boot1", 5000.0) if isinstance(one, pb.Observation)]
    began = [one for one in messages(long) if isinstance(one, pb.Observation)]

    def between(stream: list[pb.Observation], begin: float, end: float, shift: float) -> list[Message]:
        true = [long.true_time(one.camera, one.device_time_ns / NANOSECONDS - shift) for one in stream]
        return [one for at, one in sorted(zip(true, stream, strict=True), key=lambda x: x[0]) if begin <= at < end]

    hub, named = LiveHub(SETTINGS), 0
    infos = messages(long)[:3]
    stream = [*infos, *between(began, 0.0, 35.0, 0.0), *between(rows, 35.0, 45.0, 5000.0)]
    for number, message in enumerate(stream):
        hub.handle(message)
        if number % 20 == 19:
            hub.tick(number / 100.0)
            if message.boot_id == "boot1" and hub.boot_ids["cam0"] == "boot0":  # type: ignore[attr-defined]
                state, reason = hub.state(number / 100.0)
                assert (state, "restarted and not located since" in reason) == ("degraded", True)
                named += 1
    assert named
    assert set(hub.boot_ids.values()) == {"boot1"}
    assert hub.state(len(stream) / 100.0)[0] == "calibrated"
    assert hub.counters["not_better"] == 0


def test_a_restarted_camera_is_named_until_it_is_located_again() -> None:
    """After the first answer without it the hub was calibrated, whether or not it came back."""
    session = simulate(71, 3, 35)
    began = [one for one in messages(session) if isinstance(one, pb.Observation)]
    again = [one for one in messages(session, "boot1", 5000.0) if isinstance(one, pb.Observation)]
    hub, states, restarted = LiveHub(SETTINGS), list[tuple[str, str]](), False
    for message in messages(session)[:3]:
        hub.handle(message)
    for number, (old, new) in enumerate(zip(began, again, strict=True)):
        late = old.camera == "cam2" and session.true_time("cam2", old.device_time_ns / NANOSECONDS) > 20.0
        restarted |= late
        hub.handle(new if late else old)
        if number % 20 == 19:
            hub.tick(number / 100.0)
            states += [hub.state(number / 100.0)] if restarted else []
    assert states[-1][1].endswith("2 cameras calibrated")
    assert all(state == "degraded" and "cam2: restarted and not located since" in reason for state, reason in states)


def test_a_moved_camera_is_named_where_it_was_measured_before() -> None:
    """Its old position bent the world of all cameras by centimetres and degrees, and the hub was calibrated."""
    moved = simulate(71, 4, 40).turned("cam1", 25.0, 0.15)
    rig = Rig({}, distances=(("cam0", "cam1", 5.0),))
    hub = LiveHub(SETTINGS, rig=rig)
    feed(hub, messages(moved))
    assert hub.counters["moved"] == 1
    state, reason = hub.state(1e6)
    assert state == "degraded"
    assert "cam1: moved from where the rig's references say" in reason
    assert reason.endswith("4 cameras calibrated"), "who comes days later reads what is wrong then"
    assert "4 cameras calibrated, moved: cam1 (" in hub.state(60.0)[1]


def test_a_camera_whose_lens_is_refuted_does_not_come_back_with_every_search() -> None:
    """Joined again, its lens was not tested before the next full search: in and out, at a wrong place."""
    session = simulate(73, 5, 40)
    hub, out, stream = LiveHub(SETTINGS), list[Message](), list[tuple[float, pb.Observation]]()
    for message in messages(session):
        if isinstance(message, pb.Observation):
            clock = session.clocks[message.camera]
            sent = clock.reference_from_camera(CameraTime(message.device_time_ns / NANOSECONDS))
            stream.append((float(sent) + 0.03, message))
        elif isinstance(message, pb.CameraInfo):
            if message.camera == "cam3":
                message.matrix[0], message.matrix[4] = 1.15 * message.matrix[0], 1.15 * message.matrix[4]
            hub.handle(message)
    stream.sort(key=lambda sent: sent[0])
    for number, (arrival, message) in enumerate(stream):
        hub.handle(message, arrival)
        if number % 200 == 199:
            out += hub.tick(arrival - stream[0][0])
    found = [one for one in calibrations(out) if one.status == "solved"]
    refuted = [any(each.camera == "cam3" for each in one.refused) for one in found]
    assert all(refuted[refuted.index(True) :])
    assert len(found) - refuted.index(True) > 5
    assert "lens is refuted" in found[-1].refused[0].reason


def test_of_a_long_recording_the_intervals_with_shared_motion_are_kept() -> None:
    """Ten seconds of motion, then a target at rest: what moved is kept, the rest only as far as it is new."""
    builder = SessionBuilder(window_s=20.0)
    for frame in range(3000):
        moment = frame / 30.0
        u = 100.0 + 30.0 * (frame % 7) if moment < 10.0 else 100.0
        for camera in ("a", "b"):
            detection = pb.Detection(u=u, v=50.0, score=1.0)
            builder.handle(
                pb.Observation(
                    camera=camera, boot_id="b0", sequence=frame, device_time_ns=round(moment * NANOSECONDS),
                    detections=[detection],
                ),
                moment,
            )  # fmt: skip
        builder.handle(pb.CameraInfo(camera="a", width=640, height=480), moment)
        builder.handle(pb.CameraInfo(camera="b", width=640, height=480), moment)
    _, observations = builder.build()
    (track,) = observations.of_camera("a")
    assert len(track) / 30.0 <= 20.0 + 2.0
    assert track.time[0] < 0.1
    assert (track.time < 10.0).sum() == 300
    assert track.time[-1] > 99.9
    assert 10.0 <= builder.shared_motions_s()["a"] <= 12.0
    runs = builder.ranges()
    assert [(camera, first) for camera, _, first, _, _ in runs if first == 0] == [("a", 0), ("b", 0)]
    assert sum(count for camera, *_, count in runs if camera == "a") == len(track)


def test_a_flood_and_equal_times_cost_only_their_camera() -> None:
    builder = SessionBuilder(window_s=20.0)
    for camera in ("a", "b"):
        builder.handle(pb.CameraInfo(camera=camera, width=640, height=480))
    for frame in range(40_000):
        for camera in ("a", "b") if frame < 60 else ("a",):
            time_ns = round((frame // 2 if camera == "a" else frame) / 30.0 * NANOSECONDS)
            detection = pb.Detection(u=float(frame % 600), v=50.0, score=1.0)
            message = pb.Observation(camera=camera, boot_id="b0", sequence=frame, device_time_ns=time_ns)
            message.detections.append(detection)
            builder.handle(message, 1.0)
    _, observations = builder.build()
    assert len(observations.of_camera("b")[0]) == 60
    assert len(observations.of_camera("a")[0]) <= 4000
    assert builder.counters["flooded"] == 32_000


def hostile(session: Session, rate_hz: float = 0.0, distortion: float = 0.0) -> list[Message]:
    """The session with a nominal rate and a lens of cam2 that are not true."""
    stream = messages(session)
    for message in stream:
        if isinstance(message, pb.CameraInfo) and message.camera == "cam2":
            message.fps = rate_hz or message.fps
            message.distortions[0] = distortion or message.distortions[0]
    return stream


def test_a_nominal_rate_that_no_row_agrees_with_does_not_sample_the_path(session: Session) -> None:
    """The path was sampled at any rate that a camera's info gave: 100,000 Hz took minutes to publish."""
    hub = LiveHub(SETTINGS)
    feed(hub, hostile(session, rate_hz=100_000.0), batch=10**9)
    assert hub.calibration is not None
    assert len(hub.calibration.trajectories[0].time) < 20.0 * 121.0


def test_a_lens_that_cannot_be_costs_only_its_camera(session: Session) -> None:
    """The largest distortion that messages may have; of 1e308 the polynomial had no roots, which ended the hub."""
    hub = LiveHub(SETTINGS)
    feed(hub, hostile(session, distortion=MAX_DISTORTION), batch=10**9)
    assert hub.calibration is not None
    assert set(hub.calibration.cameras) == {"cam0", "cam1"}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda u, v: (u / 1280, v / 720), "fractions of it; multiply u by its width"),
        (lambda u, v: (v, u), "swap u and v"),
        (lambda u, v: (2 * u, 2 * v), "pixels of a larger one"),
        (lambda u, v: (u / 2, v / 2), "its rows are pixels of pictures of 1/2 the size"),
        (lambda u, v: (u, 719 - v), "its image is mirrored"),
    ],
)
def test_a_camera_whose_pixels_are_of_another_image_is_named(
    change: Callable[[float, float], tuple[float, float]], reason: str
) -> None:
    """Such cameras were told to wave the ball elsewhere, or that they fit at no lag yet."""
    session = simulate(3, 4, 30.0)
    stream = messages(session)
    for message in stream:
        if message.camera == "cam3" and isinstance(message, pb.Observation):  # type: ignore[attr-defined]
            one = message.detections[0]
            one.u, one.v = change(one.u, one.v)
    hub = LiveHub(SETTINGS)
    feed(hub, stream)
    assert hub.calibration is not None
    assert set(hub.calibration.cameras) == {"cam0", "cam1", "cam2"}
    assert reason in next(one.reason for one in hub.progress() if one.camera == "cam3")


@pytest.mark.parametrize("known", [False, True])
def test_a_camera_that_sends_other_images_than_the_hubs_file_is_for_is_named(session: Session, known: bool) -> None:
    """720p where rig.toml has the lens of 1080p: it was calibrated, turned by 12 degrees, and nothing said so."""
    cameras, lens = dict(session.rig.cameras), session.lens("cam1")
    matrix = lens.matrix * np.array([[1.5], [1.5], [1.0]])
    larger = replace(lens, width=1920, height=1080, matrix=matrix)
    cameras["cam1"] = replace(cameras["cam1"], size=(1920, 1080), intrinsics=larger)
    rig = replace(session.rig, cameras=cameras)
    hub = LiveHub(SETTINGS, rig)
    feed(hub, messages(session))
    assert hub.calibration is not None
    if known:
        given = hub.calibration.cameras
        hub = LiveHub(SETTINGS, known=KnownCalibration(replace(rig, metadata={"reference": "cam0"}), given))
        feed(hub, messages(session))
    else:
        assert set(hub.calibration.cameras) == {"cam0", "cam2"}
    assert "cam1 sends images of 1280x720, and the hub's file is for 1920x1080" in hub.state(1e6)[1]


def test_pictures_of_another_size_are_refused_by_a_hub_too() -> None:
    """Half the pixels of all cameras gave an answer of two of them, with a clock step that none had."""
    stream = messages(simulate(3, 4, 30.0))
    for message in stream:
        for one in message.detections if isinstance(message, pb.Observation) else ():
            one.u, one.v = one.u / 2, one.v / 2
    hub = LiveHub(SETTINGS)
    feed(hub, stream)
    assert hub.calibration is None
    state, text = hub.state(1e6)
    assert state == "searching"
    assert "upper left of its picture" in text
    assert "as those of pictures of 1/2 the size" in text


def test_a_repeated_time_stamp_does_not_refuse_the_session_of_a_log(session: Session) -> None:
    """Two frames of one time, or of one number, refused all cameras."""
    builder = SessionBuilder()
    stream = messages(session)
    for message in stream:
        builder.handle(message)
    twice = pb.Observation()
    twice.CopyFrom(stream[-1])
    twice.sequence += 1_000_000
    builder.handle(twice)
    _, observations = builder.build()
    assert sum(len(track) for track in observations.tracks.values()) == len(stream) - 3
    twice.sequence += 1
    twice.device_time_ns += 1_000_000
    builder.handle(twice)
    _, observations = builder.build()
    assert sum(len(track) for track in observations.tracks.values()) == len(stream) - 2


class StuckSolver(InlineSolver):
    """Answers the first job and no other."""

    def submit(self, job: SolverJob, now: float) -> None:
        if job.number == 1:
            super().submit(job, now)

    @property
    def busy(self) -> bool:
        return True


def test_ill_health_of_a_calibrated_hub_is_told(session: Session) -> None:
    """Cameras that fall silent, and a solver that does not answer: degraded, in the status that /readyz reports."""
    hub = LiveHub(SETTINGS)
    feed(hub, messages(session))
    now = max(hub.links.last_frame.values())
    assert hub.state(now)[0] == "calibrated"
    state, text = hub.state(now + 5.0)
    assert state == "degraded"
    assert "no frames from cam0 (5 s), cam1 (5 s), cam2 (5 s)" in text
    hub._now = now
    status = status_message(hub, "hub", "b0", 0, [], now + 5.0)
    assert status.state == "degraded"
    hub.solver = StuckSolver()
    hub._submitted_at = now - 11.0
    assert "the solver is behind: 11 s for one job" in hub.state(now)[1]
    assert {one.camera: one.state for one in hub.progress()} == dict.fromkeys(session.rig.cameras, "calibrated")


class RefusingSolver(InlineSolver):
    """A solver to which the rows of cam1 contradict every answer."""

    def submit(self, job: SolverJob, now: float) -> None:
        self._answer = SolverAnswer(job.number, reason="no two cameras", refused={"cam1": "only 10 % fit"})


@pytest.mark.parametrize("gone", ["cam0", "cam2"])
def test_a_camera_that_was_taken_away_is_forgotten_on_request(session: Session, gone: str, tmp_path: Path) -> None:
    """One renamed or removed kept the hub degraded for ever. cam0 is the reference."""
    stream = messages(session)
    hub = LiveHub(SETTINGS)
    half = len(stream) // 2
    for number, message in enumerate(stream[:half]):
        hub.handle(message)
        if number % 100 == 99:
            hub.tick(0.01 * number)
    assert hub.calibration is not None
    before = hub.calibration.cameras
    assert set(before) == {"cam0", "cam1", "cam2"}
    now = 0.01 * half
    assert hub.forget_silent(now) == [], "none is silent"
    rest = [message for message in stream[half:] if message.camera != gone]  # type: ignore[attr-defined]
    for number, message in enumerate(rest):
        hub.handle(message)
        if number % 100 == 99:
            hub.tick(now + 0.01 * number)
    now += 0.01 * len(rest)
    assert hub.state(now)[0] == "degraded"
    hub.links.notices[gone] = "left out until it is restarted"
    assert hub.forget_silent(now) == [gone]
    assert gone not in hub.links.notices
    assert hub.state(now)[0] == "calibrated"
    (published, *_) = calibrations(hub.tick(now))
    assert gone not in [one.camera for one in (*published.cameras, *published.progress, *published.refused)]
    hub.tick(now + 5.0, final=True)
    hub.tick(now + 6.0)
    assert set(hub.calibration.cameras) == set(before) - {gone}
    for name, camera in hub.calibration.cameras.items():  # on the clock and in the world of before
        at = before[name].lag_time
        shift = (camera.time_map.clock_rate - before[name].time_map.clock_rate) * at
        assert abs(shift + camera.time_map.time_offset - before[name].time_map.time_offset) < 1e-3
    assert not any(gone in one.text for one in hub.guidance.advice(9))
    assert hub.session is not None
    store = AnswerStore(tmp_path)
    store.keep(hub.calibration, hub.session[0], hub.boot_ids, hub.links.delays)
    store.close()
    kept = AnswerStore(tmp_path).load()
    assert kept is not None, "a reference camera that is not in it made the file unreadable"
    for name, camera in kept[0].cameras.items():
        assert abs(session.clock_error(name, kept[0].reference, camera.time_map)) < 1e-3
        assert (camera.time_offset_std > 0.0) == (name != kept[0].reference)
    write_last(hub, tmp_path / "out")
    _, written = read_calibration(tmp_path / "out" / "calibration.toml")
    path = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1, usecols=0)
    spans = [written[name].time_map.reference_from_camera(CameraTime(written[name].lag_time)) for name in written]
    assert all(path[0] < span < path[-1] for span in spans)


@pytest.mark.parametrize(
    ("pose", "clock", "scale", "said"),
    [
        (lambda pose: pose, 0.0, "arbitrary", ""),
        (
            lambda pose: Pose(pose.rotation.T, -pose.rotation @ pose.position),
            0.0,
            "arbitrary",
            "rotation and translation are world from",
        ),
        (lambda pose: pose, 1e4, "arbitrary", "was its clock set anew?"),
        (lambda pose: Pose(pose.rotation, 2000.0 * pose.position), 0.0, "metric", "seem not to be in m"),
    ],
)
def test_a_given_calibration_that_the_rows_contradict_is_named(
    session: Session, pose: Callable[[Pose], Pose], clock: float, scale: str, said: str
) -> None:
    """A hub with one of another convention, unit or run of the cameras was `calibrated`, and tracked nobody."""
    stream = messages(session)
    hub = LiveHub(SETTINGS)
    feed(hub, stream)
    assert hub.calibration is not None
    assert hub.session is not None
    cameras = {
        name: replace(camera, pose=pose(camera.pose)) if clock == 0.0 else camera
        for name, camera in hub.calibration.cameras.items()
    }
    if clock:
        for number, (name, camera) in enumerate(cameras.items()):
            one = camera.time_map
            cameras[name] = replace(camera, time_map=replace(one, time_offset=one.time_offset + clock * number))
    metadata = {"reference": hub.calibration.reference, "scale": scale}
    given = LiveHub(SETTINGS, known=KnownCalibration(replace(hub.session[0], metadata=metadata), cameras))
    assert given.state(0.0)[0] != "refused"
    for number, message in enumerate(stream):
        given.handle(message)
        if number % 200 == 199:
            given.tick(0.01 * number)
    state, text = given.state(0.01 * len(stream))
    assert state == ("degraded" if said else "calibrated"), text
    assert said in text


@pytest.mark.parametrize("step", [0.0, 3.0])
def test_under_a_given_calibration_a_camera_that_is_moved_is_named_and_a_clock_that_is_set_is_not(step: float) -> None:
    """Rows from before spoke for it, for half an hour where they had more motion; a clock's step was undone later."""
    session = simulate(5, 4, 90.0, fps=(10.0, 15.0, 30.0, 5.0))
    given, true = session.true_cameras(), session.true
    later = session.of_camera("cam1") & (true > 40.0)
    hub = LiveHub(LiveSettings(track=False), known=KnownCalibration(session.rig, given))
    if step:
        session = replace(session, time=session.time + step * later)
    else:
        session = session.turned("cam1", 40.0, 0.08)
    order, published = np.argsort(true), list[Message]()
    for message in info_messages(session, lambda _: "boot0"):
        hub.handle(message)
    rows = row_messages(session, lambda _: "boot0", order.tolist(), lambda i: float(session.time[i]))
    for number, (message, at) in enumerate(zip(rows, true[order].tolist(), strict=True)):
        hub.handle(message, at)
        published += hub.tick(at) if number % 20 == 0 else []
    assert ("the given calibration: cam1: " in hub.state(90.0)[1]) == (not step)
    last = next(one for one in calibrations(published)[-1].cameras if one.camera == "cam1")
    offset = given["cam1"].time_map.time_offset - given["cam1"].time_map.clock_rate * step
    assert last.time_offset == pytest.approx(offset, abs=0.01)


@pytest.mark.parametrize(("name", "said"), [("cam9", "not heard of rig's cam9; not in it: cam1, cam2"), ("cam1", "")])
def test_a_wrong_name_in_the_hubs_rig_is_named_in_the_status(session: Session, name: str, said: str) -> None:
    """Its table was silently without effect."""
    camera = session.rig.cameras["cam0"]
    hub = LiveHub(SETTINGS, Rig({"cam0": camera, name: replace(camera, name=name)}))
    feed(hub, [one for one in messages(session) if isinstance(one, pb.CameraInfo | pb.Observation)][:60])
    text = status_message(hub, "hub", "b0", 0, [], 0.0).message
    assert (said in text) if said else ("rig's" not in text)


def test_a_camera_that_is_left_out_is_named_in_the_status(session: Session) -> None:
    stream = messages(session)
    for message in [one for one in stream if isinstance(one, pb.Observation) and one.camera == "cam0"]:
        silent = pb.Observation()
        silent.CopyFrom(message)
        silent.camera = "cam9"
        stream.insert(stream.index(message), silent)
    hub = LiveHub(SETTINGS)
    feed(hub, stream)
    assert hub.calibration is not None
    assert "cam9" not in hub.calibration.cameras
    assert "heard but not calibrated: cam9 (no CameraInfo yet" in status_message(hub, "hub", "b0", 0, [], 0.0).message


def test_an_answer_that_the_newest_rows_contradict_is_kept_and_the_hub_says_so(session: Session) -> None:
    hub, stream = LiveHub(SETTINGS), messages(session)
    feed(hub, stream[:-200])
    hub.solver = RefusingSolver()
    for tick, message in enumerate(stream[-200:]):
        hub.handle(message)
        hub.tick(2e6 + tick)
    assert hub.calibration is not None
    assert "no two cameras" in hub.state(hub._now)[1]


def test_more_rows_replace_an_answer_whatever_their_stds_and_the_session_is_the_answers(session: Session) -> None:
    """An early answer may have stds that are too small: it must not keep out those that follow."""
    hub = LiveHub(SETTINGS)
    stream = messages(session)
    feed(hub, stream[: len(stream) // 2])
    assert hub.calibration is not None
    assert hub.session is not None
    early, rows = hub.calibration, len(hub.session[1])
    tiny = {name: replace(camera, position_std=1e-9 * camera.position_std) for name, camera in early.cameras.items()}
    hub.calibration = replace(early, cameras=tiny)
    for message in stream[len(stream) // 2 :]:
        hub.handle(message)
    hub.tick(2e6, final=True)
    assert hub.counters["not_better"] == 0
    assert hub.calibration.cameras["cam1"].position_std.max() > 1e-7 * early.cameras["cam1"].position_std.max()
    assert len(hub.session[1]) > 1.5 * rows


@pytest.mark.parametrize("calibrated", [False, True])
def test_rows_that_cannot_be_put_together_do_not_end_the_hub(
    session: Session, calibrated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """People whose colours matched nobody gave no row at all, and the hub ended with a traceback."""
    hub, stream = LiveHub(SETTINGS), messages(session)
    feed(hub, stream[:-200] if calibrated else [])

    def fails(*_: object, **given: object) -> None:
        raise IndexError("out of bounds")

    monkeypatch.setattr(hub.stream, "build", fails)
    for message in stream if not calibrated else stream[-200:]:
        hub.handle(message)
    hub.tick(2e6)
    assert hub.counters["bad_sessions"] == 1
    assert "IndexError: out of bounds" in hub.state(2e6)[1]
    assert (hub.calibration is not None) == calibrated


def test_a_last_job_searches_for_every_camera_that_is_not_tied(session: Session) -> None:
    """A hub that is stopped soon after a search must not leave a camera out that waits for the next one."""
    hub = LiveHub(SETTINGS)
    stream = messages(session)
    late = [m for m in stream if isinstance(m, pb.Observation) and m.camera == "cam2"]
    early = [m for m in stream if not (isinstance(m, pb.Observation) and m.camera == "cam2")]
    for message in early:
        hub.handle(message)
    hub.tick(10.0)
    assert hub.calibration is not None
    for message in late:
        hub.handle(message)
    hub.tick(10.5, final=True)
    assert set(hub.calibration.cameras) == {"cam0", "cam1", "cam2"}
