"""A hub that was killed goes on from its last answer: unverified until the rows agree, and never where they do not."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from deploy.agents.answer_store import HISTORY, LAST, AnswerStore
from deploy.agents.assembly import write_last
from hub.live.live_hub import LiveHub, LiveSettings
from hub.live.scheduled_hub import ScheduledHub
from hub.live.solver import JobSchedule, SolverJob
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.core.errors import InputError, Refused
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import read_calibration
from tests.integration.live.test_live_hub import messages
from tests.support.rigs import Session, simulate

SETTINGS = LiveSettings(interval_s=2.0)


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(71, 3, 24)


def play(
    hub: LiveHub, session: Session, begin: float, end: float, clock: float = 1e9, log: list[Message] | None = None
) -> list[pb.Calibration]:
    """Play a part of the session at its true times; ``clock``: of the hub when the session began; log: of it."""
    kept = [] if log is None else log
    stream = []
    for message in messages(session):
        if isinstance(message, pb.Observation):
            true = session.true_time(message.camera, message.device_time_ns / NANOSECONDS)
            stream.append((true, message))
        else:
            hub.handle(message, clock + begin)
            kept.append(message)
    out = []
    for true, message in sorted(stream, key=lambda item: item[0]):
        if begin <= true < end:
            hub.handle(message, clock + true + 0.05)
            published = hub.tick(true)
            kept += [message, *(one for one in published if isinstance(one, pb.SolverEvent))]
            out += [one for one in published if isinstance(one, pb.Calibration)]
    return out


@pytest.fixture(scope="module")
def kept(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("state")
    hub, store = LiveHub(SETTINGS), AnswerStore(folder)
    play(hub, session, 0.0, 18.0)
    assert hub.calibration is not None
    assert hub.session is not None
    store.keep(hub.calibration, hub.session[0], hub.boot_ids, hub.links.delays)
    store.close()
    return folder


def restarted(folder: Path) -> LiveHub:
    hub, last = LiveHub(SETTINGS), AnswerStore(folder).load()
    assert last is not None
    hub.reload(*last)
    return hub


def test_a_killed_hub_tracks_again_within_seconds(session: Session, kept: Path) -> None:
    assert (kept / LAST).is_file()
    assert len(list((kept / HISTORY).glob("*.toml"))) == 1
    hub = restarted(kept)
    first = next(one for one in play(hub, session, 18.0, 18.5) if one.status == "solved")
    assert first.state == "degraded"
    last = AnswerStore(kept).load()
    assert last is not None
    for one in first.cameras:
        camera = last[0].cameras[one.camera]
        assert 0.0 < abs(one.lag_time_s) == abs(camera.lag_time)
        assert (one.time_offset_std > 0.0) == (one.camera != last[0].reference), "a lag is shown where its std holds"
    assert hub.unverified
    assert "not verified" in hub.state(18.5)[1]
    play(hub, session, 18.5, 22.0)
    assert not hub.unverified
    assert hub.counters["verified"] == 1
    assert hub.state(22.0)[0] == "calibrated"
    assert hub.calibration is not None
    for name, camera in hub.calibration.cameras.items():
        assert abs(session.clock_error(name, hub.calibration.reference, camera.time_map)) < 1e-3


def maps(message: pb.Calibration) -> list[float]:
    """Clocks and positions; the file of a reloaded answer keeps their last bits but one."""
    return [value for one in message.cameras for value in (one.time_offset, one.clock_rate, *one.translation)]


def test_a_replay_of_the_log_verifies_the_reloaded_answer_too(session: Session, kept: Path) -> None:
    log: list[Message] = []
    play(LiveHub(SETTINGS), session, 0.0, 18.0, log=log)
    hub = restarted(kept)
    verified = [one for one in play(hub, session, 18.0, 22.0, log=log) if one.state == "calibrated"]
    replayed, out = ScheduledHub(), []
    for message in log:
        replayed.handle(message)
        out += [one for one in replayed.tick(0.0) if isinstance(one, pb.Calibration)]
    assert replayed.counters["verified"] == hub.counters["verified"] == 1
    assert [maps(one) for one in out[-len(verified) :]] == [pytest.approx(maps(one), rel=1e-12) for one in verified]


def without(hub: LiveHub, camera: str) -> None:
    """Nothing of that camera reaches the hub, as behind a link that is cut."""
    handle = hub.handle
    hub.handle = lambda message, *more: None if getattr(message, "camera", "") == camera else handle(message, *more)  # type: ignore[method-assign,assignment]


def test_a_restarted_camera_is_left_out_of_what_the_others_verify(session: Session, kept: Path) -> None:
    hub = restarted(kept)
    assert hub._reloaded is not None
    hub._reloaded.boots = {**hub._reloaded.boots, "cam1": "before"}
    play(hub, session, 18.0, 22.0)
    assert (hub.counters["solver_failures"], hub.counters["verified"]) == (0, 1)
    assert hub.state(22.0) == ("degraded", "cam1: restarted and not located since; 2 cameras calibrated")
    assert hub.calibration is not None
    assert set(hub.calibration.cameras) == {"cam0", "cam2"}
    found = hub.for_files()
    assert found is not None
    assert found[0].cameras.keys() == {"cam0", "cam1", "cam2"}, "in the files as it was"
    assert hub.boot_ids["cam1"] == "before"


def test_a_camera_that_is_not_heard_keeps_its_pose_over_two_restarts(
    session: Session, kept: Path, tmp_path: Path
) -> None:
    """The first answer after a restart replaced calibration.toml, without the camera behind the cut link."""
    before = AnswerStore(kept).load()
    assert before is not None
    hub = restarted(kept)
    without(hub, "cam1")
    play(hub, session, 14.0, 20.0)
    assert (hub.counters["verified"], hub.results > 0, hub.counters["solver_failures"]) == (1, True, 0)
    assert hub.calibration is not None
    assert hub.session is not None
    assert any("cam1" in warning for warning in hub.calibration.warnings)
    assert hub.state(20.0)[1] == "no frames from cam1 (none since this hub was started); 3 cameras calibrated"
    store = AnswerStore(tmp_path, copy=tmp_path / "calibration.toml")
    store.keep(hub.calibration, hub.session[0], hub.boot_ids, hub.delays)
    store.close()
    write_last(hub, tmp_path)
    for file in ("calibration.toml", "current.toml"):
        pose = read_calibration(tmp_path / file)[1]["cam1"].pose
        assert pose.position == pytest.approx(before[0].cameras["cam1"].pose.position, abs=1e-9)
    assert hub.forget_silent(20.0) == ["cam1"]
    assert hub.calibration.warnings == ()

    again = restarted(tmp_path)
    play(again, session, 20.0, 24.0)
    assert again.counters["verified"] == 1
    assert again.state(24.0)[0] == "calibrated"
    assert again.calibration is not None
    clock = again.calibration.cameras["cam1"].time_map
    assert abs(session.clock_error("cam1", again.calibration.reference, clock)) < 1e-3


def restart(hub: LiveHub, camera: str) -> None:
    """From here on the camera's agent is another process, whose clock has begun anew."""
    handle = hub.handle

    def changed(message: Message, *more: float) -> None:
        if getattr(message, "camera", "") == camera:
            message.boot_id = "another"  # type: ignore[attr-defined]
            if isinstance(message, pb.Observation):
                message.device_time_ns -= 5_000 * NANOSECONDS
        handle(message, *more)

    hub.handle = changed  # type: ignore[method-assign,assignment]


def test_a_restarted_camera_keeps_its_pose_in_the_files_until_it_is_located_again(
    session: Session, kept: Path, tmp_path: Path
) -> None:
    """Whoever copied calibration.toml meanwhile had one camera less; after another restart, fps was missing too."""
    hub, file = LiveHub(SETTINGS), tmp_path / "calibration.toml"
    play(hub, session, 0.0, 12.0)
    assert hub.calibration is not None
    before = hub.calibration.cameras["cam0"].pose.position
    restart(hub, "cam0")
    until = 12.0
    while "cam0" in hub.calibration.cameras and until < 18.0:
        play(hub, session, until, until + 1.0)
        until += 1.0
    assert set(hub.calibration.cameras) == {"cam1", "cam2"}
    found = hub.for_files()
    assert found is not None
    assert ("cam0" in hub.calibration.refused, "cam0" in found[0].refused) == (True, False)
    assert any("cam0: restarted" in warning for warning in found[0].warnings)
    store = AnswerStore(tmp_path, copy=file)
    store.keep(found[0], found[1], hub.boot_ids, hub.delays)
    store.close()
    write_last(hub, tmp_path / "last")
    for written in (file, tmp_path / "last" / "calibration.toml"):
        assert read_calibration(written)[1]["cam0"].pose.position == pytest.approx(before, abs=0.01)

    again = restarted(tmp_path)
    without(again, "cam0")
    play(again, session, until, until + 4.0)
    found = again.for_files()
    assert found is not None
    AnswerStore(tmp_path, copy=file)._write(found[0], found[1], {})
    rig, cameras = read_calibration(file)
    assert cameras["cam0"].pose.position == pytest.approx(before, abs=0.01)
    assert (rig.cameras["cam0"].fps, found[1].cameras["cam0"].position) == (session.rig.cameras["cam0"].fps, None)

    play(hub, session, until, 24.0)
    found = hub.for_files()
    assert found is not None
    assert hub.boot_ids["cam0"] == "another"
    assert found[0].cameras["cam0"] is hub.calibration.cameras["cam0"]
    assert found[0].warnings == ()


def test_a_camera_that_comes_back_goes_on_from_its_pose(session: Session, kept: Path) -> None:
    hub = restarted(kept)
    without(hub, "cam1")
    play(hub, session, 12.0, 18.0)
    del hub.handle
    play(hub, session, 18.0, 24.0)
    assert hub.calibration is not None
    assert hub.calibration.warnings == ()
    assert hub.state(24.0) == ("calibrated", "3 cameras calibrated")
    clock = hub.calibration.cameras["cam1"].time_map
    assert abs(session.clock_error("cam1", hub.calibration.reference, clock)) < 1e-3


@pytest.mark.parametrize("by", ["pixels", "failures"])
def test_a_camera_that_is_heard_and_left_out_of_the_job_is_not_calibrated(
    session: Session, by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was "calibrated", and "not heard since"."""
    hub = LiveHub(SETTINGS)
    play(hub, session, 0.0, 16.0)
    if by == "pixels":
        monkeypatch.setattr("hub.live.live_hub.pixel_faults", lambda *_: {"cam1": InputError("beyond its image")})
    else:
        monkeypatch.setattr(JobSchedule, "readmit", lambda schedule, _: setattr(schedule, "left_out", "cam1"))
    play(hub, session, 16.0, 20.0)
    assert hub.calibration is not None
    assert (set(hub.calibration.cameras), hub.calibration.warnings) == ({"cam0", "cam2"}, ())
    assert [one.state for one in hub.progress()] == ["calibrated", "searching", "calibrated"]


def test_a_hub_that_finds_nothing_after_its_restart_keeps_the_files_of_before(
    session: Session, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was stopped before anything moved, and calibration.toml was removed."""
    file = tmp_path / "calibration.toml"
    file.write_bytes((kept / LAST).read_bytes())
    hub = LiveHub(SETTINGS)
    hub.session, hub.refusal = (session.rig, session.observations()), Refused("the point hardly moves")
    write_last(hub, tmp_path)
    assert file.read_bytes() == (kept / LAST).read_bytes()
    assert f"no answer: the point hardly moves; kept: {file}, of before" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [file]


def test_where_the_solver_fails_a_reloaded_answer_is_dropped_in_time(
    session: Session, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = restarted(kept)

    def fail(job: SolverJob) -> None:
        raise KeyError(job.number)

    monkeypatch.setattr("hub.live.solver._verified", fail)
    play(hub, session, 4.0, 24.0)
    assert hub.counters["solver_failures"] > 0
    assert not hub.unverified
    assert hub.calibration is not None, "an answer of its own"


def test_a_camera_that_was_moved_meanwhile_is_not_believed(session: Session, kept: Path) -> None:
    hub = restarted(kept)
    reloaded = hub._reloaded
    assert reloaded is not None
    cameras = reloaded.calibration.cameras
    pose = cameras["cam1"].pose
    wrong = dataclasses.replace(cameras["cam1"], pose=Pose(pose.rotation, pose.position + np.array([0, 1, 0])))
    reloaded.calibration = dataclasses.replace(reloaded.calibration, cameras={**cameras, "cam1": wrong})
    play(hub, session, 18.0, 22.0)
    assert hub.calibration is None or "cam1" not in hub.calibration.cameras


@pytest.mark.parametrize("change", ["boots", "clocks", "other cameras"])
def test_what_was_restarted_or_set_since_is_left_out(session: Session, kept: Path, change: str) -> None:
    hub = restarted(kept)
    reloaded = hub._reloaded
    assert reloaded is not None
    if change == "boots":
        reloaded.boots = dict.fromkeys(reloaded.boots, "another")
    elif change == "other cameras":
        renamed = {f"x{name}": camera for name, camera in reloaded.calibration.cameras.items()}
        reloaded.calibration = dataclasses.replace(reloaded.calibration, cameras=renamed)
    published = play(hub, session, 4.0, 20.0, 1e9 + (100.0 if change == "clocks" else 0.0))
    assert not hub.unverified
    assert hub.counters["verified"] == 0
    assert hub.calibration is not None, "an answer of its own"
    assert published[0].status != "solved"


def test_a_disk_that_cannot_be_written_is_told(session: Session, kept: Path, tmp_path: Path) -> None:
    last = AnswerStore(kept).load()
    assert last is not None
    blocked = tmp_path / "file"
    blocked.write_text("", encoding="utf-8")
    store = AnswerStore(tmp_path, copy=blocked / "calibration.toml")
    assert "not a folder" in store.problem, "before the first answer"
    store.keep(last[0], session.rig, last[1], last[2])
    store.close()
    assert "file" in store.problem
    assert AnswerStore(tmp_path / "none").load() is None
    (kept / "broken").mkdir(exist_ok=True)
    (kept / "broken" / LAST).write_text("[cam0\n", encoding="utf-8")
    assert AnswerStore(kept / "broken").load() is None


def test_after_a_power_cut_the_last_answer_holds_on_new_clocks_if_it_is_configured(
    session: Session, kept: Path
) -> None:
    """Every camera's clock has begun anew, and the hub's own was never set."""
    hub, last = LiveHub(SETTINGS), AnswerStore(kept).load(of_any_age=True)
    assert last is not None
    calibration, boots, delays, _ = last
    hub_clock = 1e9 + 18.0 + 0.05
    shift = {"cam0": 500.0, "cam1": -300.0, "cam2": 40.0}
    before = {}
    for name, camera in calibration.cameras.items():  # as if the clocks had shown so much more before the cut
        rate, offset = camera.time_map.clock_rate, camera.time_map.time_offset
        moved = TimeMap(rate, offset + shift[calibration.reference] - rate * shift[name])
        before[name] = dataclasses.replace(camera, time_map=moved)
    wrong_by = 1.7e9
    hub.reload(
        dataclasses.replace(calibration, cameras=before),
        dict.fromkeys(boots, "another"),
        {name: delay - shift[name] - wrong_by for name, delay in delays.items()},
        arrival=hub_clock - wrong_by,
    )
    first = next(one for one in play(hub, session, 18.0, 18.5) if one.status == "solved")
    assert {camera.camera for camera in first.cameras} == set(before)
    assert first.state == "degraded"
    for one in first.cameras:
        assert abs(one.lag_time_s - hub.links.camera_time[one.camera]) < 1.0, "on its new clock"
        assert one.time_offset_std >= 1e-3, "no better than the delays"
    assert "not verified" in hub.state(18.5)[1]
    play(hub, session, 18.5, 22.0)
    assert hub.counters["verified"] == 1
    assert hub.state(22.0)[0] == "calibrated"
    assert hub.calibration is not None
    for name, camera in hub.calibration.cameras.items():
        assert abs(session.clock_error(name, hub.calibration.reference, camera.time_map)) < 2e-3


def test_the_history_is_in_order_and_bounded_though_the_clock_was_set_back(
    session: Session, kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    last = AnswerStore(kept).load()
    assert last is not None
    store = AnswerStore(tmp_path / "state", history=3, copy=tmp_path / "calibration.toml")
    for year in (2026, 1970, 1970, 2027, 1970):
        moment = time.struct_time((year, 1, 1, 0, 0, 0, 0, 1, 0))
        monkeypatch.setattr("deploy.agents.answer_store.time.gmtime", lambda moment=moment: moment)
        store.keep(last[0], session.rig, last[1], last[2])
        assert store._pending is not None
        store._pending.result()
    store.close()
    names = sorted(path.name for path in (tmp_path / "state" / HISTORY).iterdir())
    assert names == [f"00000{number}-{year}0101T000000Z.toml" for number, year in ((3, 1970), (4, 2027), (5, 1970))]
    current = tmp_path / "state" / LAST
    assert (current.is_symlink(), current.resolve().name) == (True, names[-1])
    _, cameras = read_calibration(tmp_path / "calibration.toml")
    assert cameras.keys() == last[0].cameras.keys()
