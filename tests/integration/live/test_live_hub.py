"""The live hub on messages: missing data, solving, restarts, duplicates, deterministic output."""

from __future__ import annotations

import time

import numpy as np
import pytest
from google.protobuf.message import Message

from hub.live.live_hub import LiveHub, LiveSettings
from protocols.core.clocks import NANOSECONDS
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import SessionBuilder
from tests.support.rigs import Session, simulate

SETTINGS = LiveSettings(window_s=60.0, interval_s=2.0)


def messages(session: Session, boot: str = "boot0", shift_s: float = 0.0) -> list[Message]:
    """Camera infos first, then one observation a row, as agents publish them."""
    out: list[Message] = []
    for name, camera in session.rig.cameras.items():
        lens = camera.intrinsics
        assert lens is not None
        out.append(
            pb.CameraInfo(
                schema_version=1,
                camera=name,
                boot_id=boot,
                width=lens.width,
                height=lens.height,
                fps=camera.fps,
                matrix=lens.matrix.ravel().tolist(),
                distortions=lens.distortions.tolist(),
                fisheye=lens.fisheye,
            )
        )
    counts: dict[str, int] = {}
    for i in np.argsort(
        session.time - np.array([session.time[np.array(session.camera) == c].min() for c in session.camera])
    ):
        name = session.camera[i]
        counts[name] = counts.get(name, -1) + 1
        out.append(
            pb.Observation(
                schema_version=1,
                camera=name,
                boot_id=boot,
                sequence=counts[name],
                frame=int(session.frame[i]),
                device_time_ns=round((session.time[i] + shift_s) * NANOSECONDS),
                detections=[pb.Detection(u=session.pixels[i, 0], v=session.pixels[i, 1], score=1.0, label="marker")],
            )
        )
    return out


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


def test_a_solve_reports_its_progress_to_the_watchdog(session: Session) -> None:
    hub = LiveHub(LiveSettings(window_s=100.0))
    for message in messages(session):
        hub.handle(message)
    beats: list[float] = []
    hub.on_progress = lambda: beats.append(time.process_time())
    began = time.process_time()
    hub.tick(1000.0)
    ended = time.process_time()
    assert hub.calibration is not None
    silent = np.diff([began, *beats, ended])
    assert silent.max() < 0.7 * (ended - began), "one pause is most of the solve"
    assert len(beats) > 8


def test_the_same_messages_give_the_same_bytes(session: Session) -> None:
    runs = [
        [m.SerializeToString(deterministic=True) for m in feed(LiveHub(SETTINGS), messages(session))] for _ in range(2)
    ]
    assert runs[0] == runs[1]


def test_duplicate_and_reordered_messages_have_no_effect(session: Session) -> None:
    stream = messages(session)
    shuffled = [stream[i] for i in np.random.default_rng(0).permutation(len(stream))]
    plain, noisy = LiveHub(SETTINGS), LiveHub(SETTINGS)
    last = calibrations(feed(plain, stream))[-1]
    again = calibrations(feed(noisy, [*shuffled, *stream[:500]]))[-1]
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


def test_observations_older_than_the_window_are_dropped(session: Session) -> None:
    builder = SessionBuilder(window_s=5.0)
    for message in messages(session):
        builder.handle(message)
    _, observations = builder.build()
    for name in ("cam0", "cam1", "cam2"):
        (track,) = observations.of_camera(name)
        assert 4.0 < np.ptp(track.time) <= 5.0
