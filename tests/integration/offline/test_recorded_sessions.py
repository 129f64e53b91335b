"""Calibration from a log makes of its messages what a live hub would: people apart, clock segments, clock priors."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from deploy.cli import run
from edge import scenes
from hub.api import RecordedSession, calibrate, read_session, triangulate
from protocols.core.clocks import CameraTime
from protocols.core.errors import InputError, Refused
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, OBSERVATION, STATUS
from tests.integration.live.test_external_clock_prior import clock_status, regular_session
from tests.integration.live.test_live_hub import messages
from tests.support import crowds
from tests.support.people_traffic import film
from tests.support.rigs import simulate

TOPICS = {"CameraInfo": CAMERA_INFO, "Observation": OBSERVATION, "AgentStatus": STATUS}


def recorded(file: Path, content: Iterable[Message], times_ns: Iterable[int] | None = None) -> Path:
    file.parent.mkdir(exist_ok=True)
    with LogWriter(file, {}) as writer:
        for message, time_ns in zip(content, times_ns or itertools.count(0, 10**6), strict=False):
            agent = getattr(message, "camera", "") or getattr(message, "agent", "")
            writer.write(TOPICS[message.DESCRIPTOR.name], agent, "yard", message, time_ns)
    return file


def test_a_clock_prior_in_the_log_selects_among_ambiguous_lags(tmp_path: Path) -> None:
    session = regular_session(900)
    plain = recorded(tmp_path / "plain.mcap", messages(session))
    with pytest.raises(Refused):
        calibrate(plain)
    statuses = [clock_status(session, name) for name in ("cam0", "cam1")]
    found = calibrate(recorded(tmp_path / "ntp.mcap", [*statuses, *messages(session)])).calibration
    assert abs(session.clock_error("cam1", "cam0", found.cameras["cam1"].time_map)) < 2e-3
    assert any("external clock priors" in warning for warning in found.warnings)


def test_a_clock_that_is_set_in_the_middle_of_a_log_costs_the_shorter_side(tmp_path: Path) -> None:
    session = simulate(72, 3, 40)
    content = []
    for message in messages(session):
        if isinstance(message, pb.Observation) and message.camera == "cam1" and message.sequence >= 850:
            message.device_time_ns += 7 * 10**9
        content.append(message)
    found = calibrate(recorded(tmp_path / "set.mcap", content)).calibration
    camera = found.cameras["cam1"]
    reference = float(camera.time_map.reference_from_camera(CameraTime(camera.lag_time)))
    true = session.true_time("cam1", camera.lag_time) - session.true_time("cam0", reference)
    assert abs(true) < 3e-3
    (warning,) = [text for text in found.warnings if "clock of cam1 stepped" in text]
    assert "+7.0" in warning


def written(
    lost: Collection[str], stepped: Collection[str], size: float, times: str
) -> tuple[list[Message], list[int]]:
    """Three cameras of 25 to 30 fps: 12 s after the start some lose 0.8 s of frames, uncounted, or their clocks step.

    times: what the log has, arrivals ("real"), nothing ("none"), or the cameras' own times ("own").
    """
    session = simulate(72, 3, 30, drops=0.0)
    content, log_ns, missing = list[Message](), list[int](), Counter[str]()
    for message in messages(session):
        true = 0.0
        if isinstance(message, pb.Observation):
            camera = message.camera
            true = session.true_time(camera, message.device_time_ns * 1e-9)
            if camera in lost and 12.0 <= true < 12.8:
                missing[camera] += 1
                continue
            message.frame -= missing[camera]
            message.device_time_ns += round(1e9 * size) if camera in stepped and true >= 16.0 else 0
        own = getattr(message, "device_time_ns", 0)
        log_ns.append({"real": round(1e9 * true) + 10**18, "none": 0, "own": max(own, 0)}[times])
        content.append(message)
    order = np.argsort(log_ns, kind="stable") if times == "real" else range(len(content))
    return [content[i] for i in order], [log_ns[i] for i in order]


@pytest.mark.parametrize("times", ["real", "none", "own"])
def test_frames_lost_uncounted_are_no_step_of_a_clock(tmp_path: Path, times: str) -> None:
    content, log_ns = written(["cam0", "cam1", "cam2"], [], 0.0, times)
    session = read_session(recorded(tmp_path / "lost.mcap", content, log_ns))
    assert not session.warnings
    assert len(session.observations) == sum(isinstance(message, pb.Observation) for message in content)


@pytest.mark.parametrize(
    ("stepped", "times"), [(["cam1"], "real"), (["cam1"], "none"), (["cam1"], "own"), (["cam1", "cam2"], "real")]
)
@pytest.mark.parametrize("size", [0.3, 9.0])
def test_clocks_that_are_set_are_told_from_lost_frames(
    tmp_path: Path, stepped: list[str], size: float, times: str
) -> None:
    """Two clocks at once, as of one machine, are told by the log's times."""
    session = read_session(recorded(tmp_path / "set.mcap", *written(["cam1"], stepped, size, times)))
    assert len(session.warnings) == len(stepped), "that of each, and no restart"
    for name in stepped:
        (step,) = [text for text in session.warnings if f"clock of {name} stepped by" in text]
        assert float(step.split("stepped by ")[1].split()[0]) == pytest.approx(size, abs=0.02)


def test_the_folder_of_a_recording_is_calibrated_and_triangulated_as_its_log(tmp_path: Path) -> None:
    recorded(tmp_path / "parts" / "a.mcap", messages(simulate(72, 3, 20)))
    out, track = tmp_path / "out", tmp_path / "track.csv"
    assert run(["calibrate", str(tmp_path / "parts"), "--out", str(out)]) == 0
    known = ["--calibration", str(out / "calibration.toml")]
    assert run(["triangulate", str(tmp_path / "parts"), *known, "--out", str(track)]) == 0
    assert track.exists()


def test_people_in_a_log_become_labelled_walkers(tmp_path: Path) -> None:
    traffic = film(scenes.get_people_scene(21, 4, 2), 45.0, 21)
    content = [*traffic.infos, *(message for _, message in traffic.arrivals)]
    session = read_session(recorded(tmp_path / "people.mcap", content))
    assert {label.partition("-")[2] for _, label in session.observations.tracks} == {"head", "foot"}
    assert np.all([label.startswith("walker") for _, label in session.observations.tracks])


def test_several_people_in_a_log_have_no_points_to_triangulate(tmp_path: Path) -> None:
    traffic = film(scenes.get_people_scene(21, 3, 2), 8.0, 21)
    log = recorded(tmp_path / "people.mcap", [*traffic.infos, *(message for _, message in traffic.arrivals)])
    known = crowds.write_calibration(tmp_path / "calibration.toml")
    with pytest.raises(InputError, match="several unlabelled people"):
        triangulate(log, known)


def test_of_people_before_and_after_a_clock_was_set_the_longer_side_counts(tmp_path: Path) -> None:
    traffic = film(scenes.get_people_scene(21, 3, 2), 20.0, 21)
    content: list[Message] = [*traffic.infos]
    for _, message in traffic.arrivals:
        if message.camera == "cam1" and message.sequence >= 150:
            message.device_time_ns -= 60 * 10**9
        content.append(message)
    session = read_session(recorded(tmp_path / "set.mcap", content))
    assert isinstance(session, RecordedSession)
    assert sum(message.camera == "cam1" for message in session.people) > 140
    assert any("clock of cam1 stepped" in warning for warning in session.warnings)


def test_people_in_a_log_who_wear_one_colour_are_told_by_where_they_are(tmp_path: Path) -> None:
    scene = scenes.get_people_scene(9505, 3, 3)
    traffic = film(scene, 22.0, 9505)
    for _, message in traffic.arrivals:
        for one in message.detections:
            one.colour.CopyFrom(pb.Colour(red=90, green=90, blue=90))
    found = calibrate(
        recorded(tmp_path / "uniform.mcap", [*traffic.infos, *(message for _, message in traffic.arrivals)])
    )
    assert sorted(found.cameras) == sorted(one.name for one in scene.cameras)
    for name, camera in found.cameras.items():
        true = scene.true_time_map(name, found.calibration.reference)
        moment = CameraTime(camera.lag_time)
        off = camera.time_map.reference_from_camera(moment) - true.reference_from_camera(moment)
        assert abs(off) < 4.0 * camera.lag_std + 1e-9
