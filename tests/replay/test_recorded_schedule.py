"""A log holds the schedule of its hub's solver: a replay gives the live answers bit for bit, however slow it was."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.logs.diff import compare_logs
from deploy.logs.replay_hub import replay_through_hub
from edge.scenes import get_people_scene
from hub.live.live_hub import LiveHub, LiveSettings
from hub.live.scheduled_hub import ScheduledHub
from hub.live.solver import InlineSolver, SolverAnswer, SolverJob
from protocols.core.clocks import NANOSECONDS
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, PREDICTION, SOLVER_EVENT, TRACK
from tests.integration.live.test_live_hub import messages
from tests.support.people_traffic import film
from tests.support.rigs import simulate

TOPICS = {topic.message: topic for topic in (CALIBRATION, TRACK, PREDICTION, SOLVER_EVENT, OBSERVATION, CAMERA_INFO)}


class LateSolver(InlineSolver):
    """Answers some seconds after the job, as a worker on a slow board does; ``delays``: in turn."""

    def __init__(self, delays: list[float]) -> None:
        super().__init__()
        self.delays, self.due = delays, 0.0

    def submit(self, job: object, now: float) -> None:
        super().submit(job, now)  # type: ignore[arg-type]
        self.due = now + self.delays[job.number % len(self.delays)]  # type: ignore[attr-defined]

    def poll(self, now: float) -> SolverAnswer | None:
        return super().poll(now) if now >= self.due else None


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a live hub; the camera cam3 joins late."""
    session = simulate(31, 4, 30)
    stream: list[tuple[float, pb.Observation]] = []
    file = tmp_path_factory.mktemp("live") / "live.mcap"
    hub = LiveHub(LiveSettings(interval_s=1.0, window_s=16.0), solver=LateSolver([0.3, 2.4, 1.1]))
    with LogWriter(file) as log:

        def write(message: object, moment: float) -> None:
            agent = "hub" if not isinstance(message, pb.Observation | pb.CameraInfo) else message.camera
            topic = TOPICS[message.DESCRIPTOR.name]  # type: ignore[attr-defined]
            log.write(topic, agent, "local", message, round((1e3 + moment) * NANOSECONDS))  # type: ignore[arg-type]

        for message in messages(session):
            if isinstance(message, pb.Observation):
                true = session.true_time(message.camera, message.device_time_ns / NANOSECONDS)
                if message.camera != "cam3" or true > 16.0:
                    stream.append((true, message))
            else:
                hub.handle(message)
                write(message, 0.0)
        for moment, message in sorted(stream, key=lambda item: item[0]):
            hub.handle(message, 1e3 + moment)
            write(message, moment)
            for published in hub.tick(moment):
                write(published, moment)
    assert hub.calibration is not None
    assert len(hub.calibration.cameras) == 4
    return file


def answers(log: Path) -> list[list[bytes]]:
    out = []
    for logged in LogReader(log).messages([CALIBRATION]):
        assert isinstance(logged.message, pb.Calibration)
        if logged.message.status == "solved":
            out.append([camera.SerializeToString(deterministic=True) for camera in logged.message.cameras])
    return out


@pytest.fixture(scope="module")
def again(live: Path) -> Path:
    out = live.with_name("again.mcap")
    replay_through_hub(live, out)
    return out


def test_a_replay_repeats_the_live_answers_bit_for_bit(live: Path, again: Path) -> None:
    assert len(answers(live)) > 5
    assert answers(again) == answers(live)
    comparison = compare_logs(live, again, {}, ["calibration"])
    assert (comparison.equal, comparison.compared) == (True, len(answers(live)))


def test_a_second_replay_gives_equal_bytes(live: Path, again: Path, tmp_path: Path) -> None:
    replay_through_hub(live, tmp_path / "second.mcap")
    assert (tmp_path / "second.mcap").read_bytes() == again.read_bytes()
    assert TRACK in {logged.topic for logged in LogReader(again).messages()}


def test_a_job_by_people_is_repeated() -> None:
    """Its event names no rows: the replay left it out, and tracked nobody."""
    hub, traffic = ScheduledHub(), film(get_people_scene(21, 4, 3), 36.0, 21)
    jobs: list[SolverJob] = []
    hub.solver.submit = lambda job, now: jobs.append(job)  # type: ignore[method-assign]
    for info in traffic.infos:
        hub.handle(info)
    for message in traffic.messages():
        for one in message.detections:
            one.ClearField("colour")
        hub.handle(message)
    hub.handle(pb.SolverEvent(schema_version=1, job=1, kind="submitted"))
    hub.tick(36.0)
    assert [len(job.people) > 1000 for job in jobs] == [True]
    assert jobs[0].load > 1.0
